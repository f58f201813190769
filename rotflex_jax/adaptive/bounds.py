"""How large a step size of LMS may be, how fast it then learns, and what it costs in the end.

The theory takes successive regressors as independent. Those of a delay line are not, and the weights
run away earlier: stay below a third of the mean-square bound on real signals. The bound on the mean
alone is of no use for a Volterra series; it is given to show how far it lies off.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from rotflex_jax.adaptive.meansquare import MeanSquare
from rotflex_jax.adaptive.moments import Moments
from rotflex_jax.errors import InputError

PRACTICAL = 3.0
"""Share of the mean-square bound (one over this) that a tapped delay line was found to bear."""

StepSizes = float | Float[np.ndarray, " P"]


def mean_bound(moments: Moments, direction: StepSizes = 1.0) -> float:
    """Factor on the step sizes `direction` below which the mean of the weights converges.

        c < 2 / largest eigenvalue of diag(direction) R

    Not a limit to work with: long before it the squares of the weights grow without bound.

    Args:
        moments: of the regressors.
        direction: step sizes that are scaled together; with the default the bound on a common one.

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
        moments: of the regressors.
        direction: step sizes that are scaled together; with the default the bound on a common one.

    Source: Feuer and Weinstein 1985, IEEE Trans. ASSP 33, carried over to moments of any regressors.

    >>> round(mean_square_bound(Moments.gaussian(np.eye(5), (1,))), 4)  # 2 / (M + 2)
    0.2857
    """
    exact, _ = recursion(moments, direction)
    return float(1 / exact.ratio())


@dataclasses.dataclass(frozen=True, eq=False)
class Stability:
    """What step sizes do, as far as theory can say.

    Attributes:
        mu: step sizes (P,).
        mean_factor: by how much all of them could grow before the mean diverges.
        factor: by how much before the mean square does; below one it already does.
        radius: factor per sample of the squared weight errors in the end.
        rates: eigenvalues of diag(mu) R, falling: one over the time constants of the modes.
        coefficient_times: samples for which each weight keeps its own error (area under its decay).
        misadjustment: excess error over the smallest error, in the long run; infinite beyond the bound.
        small_step: the same by 1/2 sum mu E[phi^2], good below some 4 %.
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
        """Of the mean weights along every mode [samples], rising."""
        return 1 / self.rates

    @property
    def sentence(self) -> str:
        """Inside or outside the bound, and by how much."""
        if not self.stable:
            return f"outside the mean-square bound: {1 / self.factor:.3g} times too large"
        if self.factor < PRACTICAL:
            return (
                f"inside the mean-square bound by a factor of {self.factor:.3g} only, where a delay line "
                f"may still run away (keep {PRACTICAL:g})"
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

    Leakage is left out of account. Not for NLMS and its kin, whose steps depend on the regressors.

    Args:
        moments: of the regressors.
        mu: step size, one or one per weight; weights with 0 do not move and count as known.

    Raises:
        InputError: step sizes that are negative, not finite, all zero or of the wrong number.
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


def recursion(moments: Moments, mu: StepSizes) -> tuple[MeanSquare, np.ndarray]:
    """The mean-square recursion of the weights that move, and which these are (P,)."""
    sizes = step_sizes(moments, mu)
    moving = sizes > 0
    kept = moments if moving.all() else moments.transformed(np.eye(moments.size)[:, moving])
    return MeanSquare(kept, sizes[moving]), moving


def step_sizes(moments: Moments, mu: StepSizes) -> Float[np.ndarray, " P"]:
    """One step size per weight, checked.

    Raises:
        InputError: they are negative, not finite, all zero or of the wrong number.
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
