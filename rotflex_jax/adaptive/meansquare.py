"""The exact recursion of the squared weight errors of LMS, for independent samples.

Step sizes are taken into the regressors, `x = sqrt(mu) phi`, and the squared weight errors are scaled
accordingly; `c` multiplies all step sizes together. With `R = E[x x']`, `A(C) = R C + C R` and
`S(C) = E[x x' C x x']`

    C <- C - c A(C) + c^2 S(C) + c J0 R

A and S are symmetric, and A is diagonal over the eigenvectors of R. So everything comes from the
eigenvalues of `A^-1/2 S A^-1/2`, whose largest is one over the largest stable `c`.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from rotflex_jax.adaptive.moments import Moments, pack, unpack

# Up to this many pairs of directions a full eigenvalue decomposition is the quickest.
DENSE = 700
# Directions with less than this share of the largest eigenvalue are not excited at all.
UNEXCITED = 1e-12


class MeanSquare:
    """The recursion over the directions in which the weights move.

    Args:
        moments: of the regressors.
        mu: step sizes (P,), all positive.

    Attributes:
        values: eigenvalues of R with the step sizes in it, rising; unexcited directions left out.
        vectors: their directions (P, r), in scaled weights.
        root: square roots of the step sizes (P,).
        along: moments of the regressors, scaled and turned into these directions.
    """

    def __init__(self, moments: Moments, mu: Float[np.ndarray, " P"]) -> None:
        self.moments = moments
        self.root = np.sqrt(mu)
        values, vectors = np.linalg.eigh(moments.R * np.outer(self.root, self.root))
        excited = values > UNEXCITED * values[-1]
        self.values, self.vectors = values[excited], vectors[:, excited]
        self.along = moments.transformed(self.root[:, None] * self.vectors)
        self._dense: np.ndarray | None = None

    @property
    def size(self) -> int:
        """Length of a packed matrix over the excited directions."""
        r = len(self.values)
        return r * (r + 1) // 2

    def dense(self) -> Float[np.ndarray, "D D"]:
        """S as a matrix over packed symmetric matrices."""
        if self.along.pairs is not None:
            return self.along.pairs
        if self._dense is None:
            samples = self.along.samples
            assert samples is not None
            # Blocks of samples, so that their products stay within some 30 MB.
            blocks = np.array_split(samples, -(-len(samples) * self.size // 4_000_000))
            products = (pack(x[:, :, None] * x[:, None, :]) for x in blocks)
            self._dense = sum((p.T @ p for p in products), np.zeros((self.size, self.size))) / len(samples)
        return self._dense

    def S(self, v: Float[np.ndarray, " D"]) -> Float[np.ndarray, " D"]:
        """E[x x' C x x'] of a packed C, over the directions."""
        if self.along.pairs is not None or self.size <= DENSE:
            return self.dense() @ v
        return pack(self.along.S(unpack(v)))

    def ratio(self) -> float:
        """Largest eigenvalue of A^-1 S; the recursion is stable for c below one over it."""
        half = pack_sum(self.values) ** -0.5
        return _largest(
            self.size,
            lambda: self.dense() * np.outer(half, half),
            lambda v: half * self.S(half * v),
        )

    def radius(self) -> float:
        """Spectral radius of the recursion (c = 1): by what the squared errors shrink per sample in the end.

        The recursion keeps covariances covariances, so its eigenvalue of largest size is positive.
        """
        diagonal = 1 - pack_sum(self.values)
        return _largest(
            self.size,
            lambda: np.diag(diagonal) + self.dense(),
            lambda v: diagonal * v + self.S(v),
        )

    def steady(self) -> Float[np.ndarray, "r r"]:
        """What C settles at for J0 = 1 (c = 1), which must be stable."""
        from scipy.sparse.linalg import LinearOperator, cg

        half = pack_sum(self.values) ** -0.5
        operator = LinearOperator(
            (self.size, self.size),
            matvec=lambda v: v - half * self.S(half * v),  # pyright: ignore[reportCallIssue]
            dtype=np.dtype(float),  # pyright: ignore[reportCallIssue]
        )
        solution, _ = cg(operator, half * pack(np.diag(self.values)), rtol=1e-10, maxiter=2000)
        return unpack(half * solution)


def pack_sum(values: Float[np.ndarray, " r"]) -> Float[np.ndarray, " D"]:
    """The diagonal of A over packed matrices: v_i + v_j."""
    i, j = np.triu_indices(len(values))
    return values[i] + values[j]


def _largest(size: int, dense: Callable[[], np.ndarray], apply: Callable[[np.ndarray], np.ndarray]) -> float:
    """Largest eigenvalue of a symmetric operator, by whichever way is quicker."""
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

    if size <= DENSE:
        return float(np.linalg.eigvalsh(dense())[-1])
    operator = LinearOperator((size, size), matvec=apply, dtype=float)  # pyright: ignore[reportCallIssue]
    # The matrix that belongs to the largest eigenvalue is a covariance: the identity is a good start.
    start = pack(np.eye(round((np.sqrt(8 * size + 1) - 1) / 2)))
    try:
        return float(
            eigsh(
                operator,
                k=1,
                which="LA",
                v0=start,
                tol=1e-6,  # pyright: ignore[reportArgumentType]
                return_eigenvectors=False,
            )[0]
        )
    except ArpackNoConvergence as error:
        return float(np.max(error.eigenvalues, initial=np.nan))
