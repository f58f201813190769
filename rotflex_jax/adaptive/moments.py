"""Second and fourth moments of regressors, from which the theory of LMS follows.

    R = E[phi phi'],    S(W) = E[phi phi' W phi phi']

They are exact for a Gaussian input, or sample moments of the regressors of any recording.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from rotflex_jax.basis import Orthogonalised, Volterra
from rotflex_jax.basis.volterra import Index, indices
from rotflex_jax.errors import InputError


def exponents(terms: Sequence[Index], size: int) -> Int[np.ndarray, "P {size}"]:
    """Monomials as powers: z0 z0 z2, that is (0, 0, 2), of a vector of three is 2, 0, 1."""
    powers = np.zeros((len(terms), size), dtype=np.int64)
    for row, term in enumerate(terms):
        np.add.at(powers[row], list(term), 1)
    return powers


class GaussianMoments:
    """Moments of a zero-mean Gaussian vector, each computed once and stored.

        E[z_i z^b] = sum_j b_j R_ij E[z^(b - e_j)]

    Every entry is paired with each of the others in turn, and equal partners count as often as they occur.

    Args:
        covariance: covariance of the vector.

    Source: Isserlis 1918, Biometrika 12; Wick 1950.

    >>> GaussianMoments(np.eye(2)).moment((4, 2))  # E[z0^4] E[z1^2]
    3.0
    """

    def __init__(self, covariance: Float[np.ndarray, "n n"]) -> None:
        self.covariance = checked_covariance(covariance)
        self._rows = self.covariance.tolist()
        self._known: dict[tuple[int, ...], float] = {(0,) * len(self._rows): 1.0}

    def moment(self, powers: tuple[int, ...]) -> float:
        """E[z0^powers0 z1^powers1 ...]."""
        if powers in self._known:
            return self._known[powers]
        total = 0.0
        if sum(powers) % 2 == 0:
            i = next(k for k, power in enumerate(powers) if power)
            rest = [*powers]
            rest[i] -= 1
            for j, count in enumerate(rest):
                if count:
                    rest[j] -= 1
                    total += count * self._rows[i][j] * self.moment(tuple(rest))
                    rest[j] += 1
        self._known[powers] = total
        return total

    def products(
        self, left: Int[np.ndarray, "A n"], right: Int[np.ndarray, "B n"]
    ) -> Float[np.ndarray, "A B"]:
        """E[z^left_a z^right_b] for the powers `left` and `right`."""
        # Many entries are the same product: number the different ones, and compute each once.
        base = int(left.max(initial=0) + right.max(initial=0)) + 1
        if base ** left.shape[1] >= 2**62:
            raise InputError(
                f"Moments of degree {base - 1} of {left.shape[1]} entries are too many to number; "
                "use regressors of a simulated or recorded input instead."
            )
        weight = base ** np.arange(left.shape[1], dtype=np.int64)
        codes, where = np.unique(np.add.outer(left @ weight, right @ weight), return_inverse=True)
        digits = codes[:, None] // weight % base
        values = np.array([self.moment(tuple(row)) for row in digits.tolist()])
        return values[where].reshape(len(left), len(right))


def checked_covariance(covariance: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """The covariance in float64.

    Raises:
        InputError: the matrix is not square, symmetric and finite, or has negative eigenvalues.
    """
    R = np.asarray(covariance, dtype=float)
    if R.ndim != 2 or R.shape[0] != R.shape[1] or not len(R) or not np.all(np.isfinite(R)):
        raise InputError(
            f"A covariance must be a square matrix of finite numbers, but has the shape {R.shape}; "
            "give for instance ar1_covariance(0.5, 5)."
        )
    if (
        not np.allclose(R, R.T, atol=1e-9 * np.abs(R).max())
        or np.linalg.eigvalsh(R)[0] < -1e-9 * np.abs(R).max()
    ):
        raise InputError(
            "A covariance must be symmetric without negative eigenvalues, but the one given is not; "
            "compute it from the regressors as phi' phi / N."
        )
    return R


MOMENT_BYTES = 2**29
"""Memory that fourth moments may take [bytes]: 8 (P (P + 1) / 2)^2 exactly, 8 N P from samples."""


@dataclasses.dataclass(frozen=True, eq=False)
class Moments:
    """Moments of a vector of regressors.

    Attributes:
        R: E[phi phi'].
        pairs: S as a matrix over packed symmetric matrices, D = P (P + 1) / 2; None for samples.
        samples: regressors over which all moments are means; None for exact moments.
    """

    R: Float[np.ndarray, "P P"]
    pairs: Float[np.ndarray, "D D"] | None = None
    samples: Float[np.ndarray, "N P"] | None = None

    @classmethod
    def gaussian(
        cls,
        covariance: Float[np.ndarray, "n n"],
        degrees: Sequence[int] = (0, 1, 2),
        layout: str = "triangular",
    ) -> "Moments":
        """Exact moments of monomials of a zero-mean Gaussian vector.

        Up to degree 2 with the constant, five entries (P = 21) need 0.4 MB and almost no time, ten entries
        (P = 66) 40 MB, twelve (P = 91) 140 MB. The computation of bounds needs about four times as much.
        Sixteen entries (P = 153) would need 1.1 GB: use `of_regressors`.

        Args:
            covariance: covariance of the entries, for instance `ar1_covariance(0.5, 5)`.
            degrees: degrees of the monomials; 0 is the constant.
            layout: "triangular", or "full" with every product as often as it can be written.

        Raises:
            InputError: the matrix is no covariance, or the moments need too much memory.

        Source: Isserlis 1918, Biometrika 12.

        >>> white = Moments.gaussian(np.eye(5), degrees=(2,))
        >>> [float(v) for v in np.unique(white.eigenvalues.round(9))]
        [1.0, 2.0, 7.0]
        """
        return cls._of_monomials(
            covariance, [i for d in degrees for i in indices(len(covariance), d, layout)]
        )

    @classmethod
    def of_basis(cls, basis: Volterra | Orthogonalised, covariance: Float[np.ndarray, "n n"]) -> "Moments":
        """Exact moments of the regressors of a Volterra series under a zero-mean Gaussian input.

        Args:
            basis: Volterra series, orthogonalised or not.
            covariance: covariance of the outputs of its bank.

        Raises:
            InputError: as in `gaussian`, or the covariance does not fit the bank.
        """
        if isinstance(basis, Orthogonalised):
            return cls.of_basis(basis.volterra, covariance).transformed(np.asarray(basis.transform))
        if len(covariance) != basis.bank.size:
            raise InputError(
                f"The bank has {basis.bank.size} outputs, but the covariance is that of {len(covariance)}; "
                "give the covariance of the bank's outputs."
            )
        return cls._of_monomials(covariance, basis.indices)

    @classmethod
    def _of_monomials(cls, covariance: Float[np.ndarray, "n n"], terms: Sequence[Index]) -> "Moments":
        wick = GaussianMoments(covariance)
        powers = exponents(terms, len(wick.covariance))
        P = len(powers)
        needed = 8 * (P * (P + 1) // 2) ** 2
        if needed > MOMENT_BYTES:
            raise InputError(
                f"The fourth moments of {P} regressors take {needed / 2**20:.0f} MB, but "
                f"{MOMENT_BYTES // 2**20} MB are allowed; make regressors of a long simulated input and use "
                "Moments.of_regressors."
            )
        i, j = np.triu_indices(P)
        length = np.where(i == j, 1.0, np.sqrt(2.0))
        both = powers[i] + powers[j]
        return cls(wick.products(powers, powers), wick.products(both, both) * np.outer(length, length))

    @classmethod
    def of_regressors(cls, phi: Float[np.ndarray, "N P"]) -> "Moments":
        """Sample moments of regressors, for any input.

        Fourth moments of squares are eighth moments of the input. With about ten thousand samples, bounds are
        accurate to about 5 %; a few hundred samples only give the order of magnitude.

        Args:
            phi: regressors, for instance `basis.regressors(recording.u)`.

        Raises:
            InputError: `phi` is no matrix of finite numbers, or the moments need too much memory.
        """
        phi = np.asarray(phi, dtype=float)
        if phi.ndim != 2 or not phi.size or not np.all(np.isfinite(phi)):
            raise InputError(
                f"Argument `phi` must be a matrix (N, P) of finite numbers, but has the shape {phi.shape}; "
                "give one row per sample."
            )
        if phi.nbytes > MOMENT_BYTES:
            raise InputError(
                f"Argument `phi` takes {phi.nbytes / 2**20:.0f} MB, but {MOMENT_BYTES / 2**20:.0f} MB are "
                "allowed; thin it, for instance phi[::10]."
            )
        return cls(phi.T @ phi / len(phi), samples=phi)

    @property
    def size(self) -> int:
        """Number of regressors P."""
        return len(self.R)

    @property
    def eigenvalues(self) -> Float[np.ndarray, " P"]:
        """Eigenvalues of R in ascending order."""
        return np.linalg.eigvalsh(self.R)

    @property
    def condition(self) -> float:
        """Condition number of R, the ratio of the slowest to the fastest time constant of LMS."""
        values = self.eigenvalues
        return float(values[-1] / values[0]) if values[0] > 0 else float("inf")

    def S(self, W: Float[np.ndarray, "P P"]) -> Float[np.ndarray, "P P"]:
        """E[phi phi' W phi phi'] of a symmetric matrix W."""
        if self.pairs is not None:
            return unpack(self.pairs @ pack(W))
        assert self.samples is not None
        square = np.sum((self.samples @ W) * self.samples, axis=1, keepdims=True)
        return self.samples.T @ (self.samples * square) / len(self.samples)

    def transformed(self, T: Float[np.ndarray, "P Q"]) -> "Moments":
        """Moments of the regressors phi T: other regressors of the same span, or some of the regressors.

        >>> Moments.gaussian(np.eye(2), (1,)).transformed(np.array([[2.0], [0.0]])).R
        array([[4.]])
        """
        R = T.T @ self.R @ T
        if self.pairs is None:
            assert self.samples is not None
            return Moments(R, samples=self.samples @ T)
        half = pack(T.T @ unpack(self.pairs) @ T)
        return Moments(R, pack(T.T @ unpack(half.T) @ T))


def ar1_covariance(a: float, memory: int) -> Float[np.ndarray, "memory memory"]:
    """Covariance a^|i - j| of successive samples of u[k] = a u[k-1] + sqrt(1 - a^2) w[k].

    Args:
        a: correlation of neighbouring samples; exp(-2 pi fc Ts) for a corner frequency fc.
        memory: number of samples.

    Raises:
        InputError: there is no stationary process with this correlation.

    >>> ar1_covariance(0.5, 3)[0]
    array([1.  , 0.5 , 0.25])
    """
    if not -1 < a < 1 or memory < 1:
        raise InputError(
            f"An AR(1) input needs -1 < a < 1 and a memory from 1, but a is {a:g} and memory {memory}; "
            "correct it."
        )
    lag = np.arange(memory)
    return np.asarray(float(a) ** np.abs(lag[:, None] - lag), dtype=float)


def pack(W: Float[np.ndarray, "... P P"]) -> Float[np.ndarray, "... D"]:
    """Symmetric matrices as vectors of the same length (Frobenius norm), D = P (P + 1) / 2."""
    i, j = np.triu_indices(W.shape[-1])
    return W[..., i, j] * np.where(i == j, 1.0, np.sqrt(2.0))


def unpack(v: Float[np.ndarray, "... D"]) -> Float[np.ndarray, "... P P"]:
    """The matrices that `pack` made vectors of."""
    P = round((np.sqrt(8 * v.shape[-1] + 1) - 1) / 2)
    i, j = np.triu_indices(P)
    W = np.zeros((*v.shape[:-1], P, P))
    W[..., i, j] = W[..., j, i] = v / np.where(i == j, 1.0, np.sqrt(2.0))
    return W
