"""Step sizes of LMS: stability bounds, rate of convergence and excess error.

The regressors include the step sizes, `x = sqrt(mu) phi`, and the second moments C of the weight errors are
scaled accordingly; the factor `c` multiplies all step sizes. With `R = E[x x']`, `A(C) = R C + C R` and
`S(C) = E[x x' C x x']`

    C <- C - c A(C) + c^2 S(C) + c J0 R

A and S are symmetric, and A is diagonal over the eigenvectors of R. So all results follow from the
eigenvalues of `A^-1/2 S A^-1/2`, of which the largest is one over the largest stable `c`.

The theory assumes that successive regressors are independent. The regressors of a delay line are not, and the
weights diverge earlier: stay below a third of the mean-square bound on real signals. The bound on the mean
alone is of no use for a Volterra series; it is given for comparison.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rotflex_jax.adaptive.moments import Moments, pack, unpack
from rotflex_jax.errors import InputError

# Largest number of pairs of directions for which a full eigenvalue decomposition is the fastest method.
MOST_DENSE_PAIRS = 700
# Directions with less than this share of the largest eigenvalue count as not excited.
UNEXCITED = 1e-12


class MeanSquare:
    """The recursion over the directions in which the weights move.

    Args:
        moments: of the regressors.
        mu: step sizes, all positive.

    Attributes:
        values: eigenvalues of R with the step sizes in it, ascending, without unexcited directions.
        vectors: their directions, in scaled weights (P, r).
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
        self._dense: Float[np.ndarray, "D D"] | None = None

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
            # Blocks of samples, so that their products need no more than about 30 MB.
            blocks = np.array_split(samples, -(-len(samples) * self.size // 4_000_000))
            products = (pack(x[:, :, None] * x[:, None, :]) for x in blocks)
            self._dense = sum((p.T @ p for p in products), np.zeros((self.size, self.size))) / len(samples)
        return self._dense

    def S(self, v: Float[np.ndarray, " D"]) -> Float[np.ndarray, " D"]:
        """E[x x' C x x'] of a packed C, over the directions."""
        if self.along.pairs is not None or self.size <= MOST_DENSE_PAIRS:
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
        """Spectral radius of the recursion (c = 1): final decay of the squared errors per sample.

        The recursion maps covariances to covariances, so its eigenvalue of largest size is positive.
        """
        diagonal = 1 - pack_sum(self.values)
        return _largest(
            self.size,
            lambda: np.diag(diagonal) + self.dense(),
            lambda v: diagonal * v + self.S(v),
        )

    def steady(self) -> Float[np.ndarray, "r r"]:
        """Steady state of C for J0 = 1 (c = 1), which must be stable."""
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
    """Largest eigenvalue of a symmetric operator, by the faster of two methods."""
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

    if size <= MOST_DENSE_PAIRS:
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


POWER_ITERATIONS = 60
"""Number of power iterations for the worst covariance; the error of the bound is the square of its error."""


class Margin(eqx.Module):
    """Factor by which step sizes lie inside the mean-square bound, traced.

        factor = min over C of <C, A(C)> / <C, S(C)>

    At the worst C the quotient does not depend on C to first order. So C is held constant in derivatives, and
    no derivative of an eigenvalue is needed.

    Args:
        moments: moments of the regressors, which are few enough for S as a matrix.
        least: least factor, above which the penalty is zero.
    """

    R: Float[Array, "P P"]
    S: Float[Array, "D D"]
    lengths: Float[Array, " D"]
    least: Float[Array, ""]

    def __init__(self, moments: Moments, least: float = 1.0) -> None:
        if moments.pairs is not None:
            S = moments.pairs
        else:
            exact = MeanSquare(moments, np.ones(moments.size))
            S = Moments(np.diag(exact.values), pairs=exact.dense()).transformed(exact.vectors.T).pairs
        i, j = np.triu_indices(moments.size)
        self.R, self.S = jnp.asarray(moments.R), jnp.asarray(S)
        self.lengths = jnp.asarray(np.where(i == j, 1.0, np.sqrt(2.0)))
        self.least = jnp.asarray(float(least))

    def penalty(self, mu: Float[Array, "*P"]) -> Float[Array, ""]:
        """Square of the logarithm of `least` over the factor; zero if the factor is above `least`."""
        sizes = jnp.broadcast_to(mu, self.R.shape[:1])
        return jax.nn.relu(jnp.log(self.least) - self.log_factor(sizes)) ** 2

    def log_factor(self, mu: Float[Array, " P"]) -> Float[Array, ""]:
        """Logarithm of the factor; below zero outside of the bound."""
        i, j = np.triu_indices(len(mu))
        root = jnp.sqrt(mu + 1e-12 * jnp.max(mu))
        scale = root[i] * root[j]
        R = self.R * root[:, None] * root[None, :]
        values, V = jnp.linalg.eigh(jax.lax.stop_gradient(R))
        values = jnp.maximum(values, 1e-12 * values[-1])

        def power_iteration(_: Any, C: Float[Array, "P P"]) -> Float[Array, "P P"]:
            image = self._unpack(scale * (self.S @ (scale * self._pack(C))))
            image = V @ ((V.T @ image @ V) / (values[:, None] + values[None, :])) @ V.T
            return image / jnp.linalg.norm(image)

        C = jax.lax.stop_gradient(
            jax.lax.fori_loop(0, POWER_ITERATIONS, power_iteration, jnp.eye(len(mu), dtype=mu.dtype))
        )
        c = scale * self._pack(C)
        return jnp.log(2 * jnp.sum(C * (R @ C))) - jnp.log(c @ self.S @ c)

    def _pack(self, C: Float[Array, "P P"]) -> Float[Array, " D"]:
        i, j = np.triu_indices(C.shape[0])
        return C[i, j] * self.lengths

    def _unpack(self, c: Float[Array, " D"]) -> Float[Array, "P P"]:
        P = self.R.shape[0]
        i, j = np.triu_indices(P)
        W = jnp.zeros((P, P), c.dtype).at[i, j].set(c / self.lengths)
        return W.at[j, i].set(W[i, j])


PRACTICAL_MARGIN = 3.0
"""Factor inside the mean-square bound with which LMS on a tapped delay line was stable in experiments."""

StepSizes = float | Float[np.ndarray, " P"]


def mean_bound(moments: Moments, direction: StepSizes = 1.0) -> float:
    """Factor on the step sizes `direction` below which the mean of the weights converges.

        c < 2 / largest eigenvalue of diag(direction) R

    Not a limit for practice: the squares of the weights grow without bound at much smaller step sizes.

    Args:
        moments: moments of the regressors.
        direction: step sizes that the factor multiplies; the default gives the bound on a common step size.

    >>> mean_bound(Moments.gaussian(np.eye(5), (1,)))
    2.0
    """
    exact, _ = recursion(moments, direction)
    return float(2 / exact.values[-1])


def mean_square_bound(moments: Moments, direction: StepSizes = 1.0) -> float:
    """Factor on the step sizes `direction` below which the squares of the weight errors converge.

        c < 1 / largest eigenvalue of A^-1 S,   A(C) = R C + C R,   S(C) = E[x x' C x x'],   x = sqrt(mu) phi

    Exact for independent samples. The rule of thumb 2 / (3 trace R) is several times too large for
    quadratic regressors of a coloured input.

    Args:
        moments: moments of the regressors.
        direction: step sizes that the factor multiplies; the default gives the bound on a common step size.

    Source: Feuer and Weinstein 1985, IEEE Trans. ASSP 33, carried over to moments of any regressors.

    >>> round(mean_square_bound(Moments.gaussian(np.eye(5), (1,))), 4)  # 2 / (M + 2)
    0.2857
    """
    exact, _ = recursion(moments, direction)
    return float(1 / exact.ratio())


@dataclasses.dataclass(frozen=True, eq=False)
class Stability:
    """Stability, convergence and excess error of LMS with given step sizes, by theory.

    Attributes:
        mu: step sizes.
        mean_factor: factor on all step sizes at which the mean diverges.
        factor: factor at which the mean square diverges; below one it already does.
        radius: final factor per sample of the squared weight errors.
        rates: eigenvalues of diag(mu) R, descending: one over the time constants of the modes.
        coefficient_times: samples for which each weight keeps its own error (area under its decay).
        misadjustment: excess error over the smallest error, in steady state; infinite beyond the bound.
        small_step: approximate misadjustment 1/2 sum mu E[phi^2], which is good below about 4 %.
    """

    mu: Float[np.ndarray, " P"]
    mean_factor: float
    factor: float
    radius: float
    rates: Float[np.ndarray, " r"]
    coefficient_times: Float[np.ndarray, " P"]
    misadjustment: float
    small_step: float

    @property
    def stable(self) -> bool:
        """Whether the squares of the weight errors stay bounded, for independent samples."""
        return self.factor > 1

    @property
    def time_constants(self) -> Float[np.ndarray, " r"]:
        """Time constants of the mean weights along every mode [samples], ascending."""
        return 1 / self.rates

    @property
    def sentence(self) -> str:
        """Whether the step sizes are inside the mean-square bound, and by which factor, in words."""
        if not self.stable:
            return f"outside the mean-square bound: {1 / self.factor:.3g} times too large"
        if self.factor < PRACTICAL_MARGIN:
            return (
                f"inside the mean-square bound by a factor of {self.factor:.3g} only, where a delay line "
                f"may still run away (keep {PRACTICAL_MARGIN:g})"
            )
        return f"inside the mean-square bound by a factor of {self.factor:.3g}"

    def __str__(self) -> str:
        slow, fast = self.time_constants[-1], self.time_constants[0]
        return "\n".join(
            [
                self.sentence,
                f"bound on the mean     {self.mean_factor:.3g} times these step sizes",
                f"time constants        {fast:.3g} to {slow:.3g} samples over {len(self.rates)} modes",
                f"excess in the end     {self.misadjustment:.3g} of the smallest error"
                f" (small-step rule {self.small_step:.3g})",
            ]
        )


def analyse(moments: Moments, mu: StepSizes) -> Stability:
    """Stability, speed and excess error of LMS with these step sizes.

    Leakage is neglected. Not for NLMS and similar filters, whose steps depend on the regressors.

    Args:
        moments: moments of the regressors.
        mu: step size, one or one per weight; weights with 0 do not change and count as known.

    Raises:
        InputError: step sizes are negative, not finite or all zero, or their number is wrong.
    """
    exact, moving = recursion(moments, mu)
    sizes = np.zeros(moments.size)
    sizes[moving] = exact.root**2
    factor = float(1 / exact.ratio())
    times = np.full(moments.size, np.inf)
    times[moving] = np.sum(exact.vectors**2 / exact.values, axis=1)
    misadjustment = float(np.diag(exact.steady()) @ exact.values) if factor > 1 else float("inf")
    return Stability(
        mu=sizes,
        mean_factor=float(2 / exact.values[-1]),
        factor=factor,
        radius=exact.radius(),
        rates=exact.values[::-1],
        coefficient_times=times,
        misadjustment=misadjustment,
        small_step=0.5 * float(sizes @ np.diag(moments.R)),
    )


def recursion(moments: Moments, mu: StepSizes) -> tuple[MeanSquare, Bool[np.ndarray, " P"]]:
    """The mean-square recursion of the weights with a positive step size, and the mask of these weights."""
    sizes = step_sizes(moments, mu)
    moving = sizes > 0
    those = moments if moving.all() else moments.transformed(np.eye(moments.size)[:, moving])
    return MeanSquare(those, sizes[moving]), moving


def step_sizes(moments: Moments, mu: StepSizes) -> Float[np.ndarray, " P"]:
    """One step size per weight, checked.

    Raises:
        InputError: step sizes are negative, not finite or all zero, or their number is wrong.
    """
    mu = np.asarray(mu, dtype=float)
    if mu.ndim > 1 or mu.size not in (1, moments.size):
        raise InputError(
            f"There are {mu.size} step sizes for {moments.size} regressors; give one, or one for each."
        )
    sizes = np.broadcast_to(mu.ravel(), (moments.size,)).copy()
    if not np.all(np.isfinite(sizes)) or sizes.min() < 0 or not sizes.max() > 0:
        raise InputError(
            f"Step sizes must be finite and not negative, with one above zero, but lie between "
            f"{sizes.min():g} and {sizes.max():g}; correct them."
        )
    return sizes
