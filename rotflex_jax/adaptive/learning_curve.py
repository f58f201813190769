"""Learning curve of LMS as predicted by theory: mean weights, excess error, settling time."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Real

from rotflex_jax.adaptive.moments import Moments, pack
from rotflex_jax.adaptive.step_sizes import StepSizes, pack_sum, recursion, step_sizes
from rotflex_jax.checks import vector, whole
from rotflex_jax.errors import InputError

LONGEST_SETTLING = 1e8
"""Settling times above this count as infinite [samples]."""


@dataclasses.dataclass(frozen=True, eq=False)
class LearningCurve:
    """Predicted averages over many runs.

    Attributes:
        times: numbers of processed samples.
        weights: mean weights.
        excess: mean squared error less the smallest mean squared error [output^2].
    """

    times: Float[np.ndarray, " K"]
    weights: Float[np.ndarray, "K P"]
    excess: Float[np.ndarray, " K"]


def settling_step_size(eigenvalue: float, samples: float, within: float = 0.05) -> float:
    """Step size with which a mode is within a share of its final value after a number of samples.

        mu = ln(1 / within) / (samples eigenvalue)

    Args:
        eigenvalue: eigenvalue of R for the mode [regressor^2].
        samples: number of samples.
        within: remaining share; 0.05 gives ln 20.

    Raises:
        InputError: a number is not positive, or the share is not below one.

    >>> [round(settling_step_size(eigenvalue, 7000), 6) for eigenvalue in (1, 2, 7)]
    [0.000428, 0.000214, 6.1e-05]
    """
    if not (eigenvalue > 0 and samples > 0 and 0 < within < 1):
        raise InputError(
            "A settling needs a positive eigenvalue and number of samples and a share between 0 and 1, but "
            f"they are {eigenvalue:g}, {samples:g} and {within:g}; correct them."
        )
    return float(np.log(1 / within) / (samples * eigenvalue))


def learning_curve(
    moments: Moments,
    mu: StepSizes,
    weights: Float[np.ndarray, " P"],
    times: Real[np.ndarray, " K"],
    *,
    noise: float = 0.0,
    start: Float[np.ndarray, " P"] | None = None,
) -> LearningCurve:
    """Mean weights and excess error of LMS, exact for independent samples.

    Above about seventy regressors it needs much time and memory, since the whole recursion is decomposed.

    Args:
        moments: moments of the regressors.
        mu: step size, one or one per weight.
        weights: best weights, to which the mean converges.
        times: numbers of processed samples, in any order.
        noise: smallest mean squared error J0.
        start: first weights; zero if None.

    Raises:
        InputError: the step sizes are not valid, as in `analyse`, or the weights are not one for each
            regressor.
    """
    exact, moving = recursion(moments, mu)
    best, first = _ends(moments, weights, start)
    t = np.asarray(times, dtype=float)
    delta = (first - best)[moving] / exact.root
    along = exact.vectors.T @ delta
    decay = (1 - exact.values) ** t[:, None]
    mean = np.tile(first, (len(t), 1))
    still = delta - exact.vectors @ along  # weight errors in directions without any signal do not change
    mean[:, moving] = best[moving] + exact.root * (still + (decay * along) @ exact.vectors.T)
    diagonal = 1 - pack_sum(exact.values)
    rates, modes = np.linalg.eigh(np.diag(diagonal) + exact.dense())
    begin = modes.T @ pack(np.outer(along, along))
    drive = modes.T @ pack(np.diag(exact.values) * noise)
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable recursion overflows
        power = rates ** t[:, None]
        C = power * begin + (1 - power) / (1 - rates) * drive
        excess = C @ (modes.T @ pack(np.diag(exact.values)))
    return LearningCurve(t, mean, excess)


def _ends(
    moments: Moments, weights: Float[np.ndarray, " P"], start: Float[np.ndarray, " P"] | None
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Best and first weights, as many as there are regressors."""
    example = f"numpy.ones({moments.size})"
    first = np.zeros(moments.size) if start is None else start
    best = vector(weights, "weights", moments.size, example=example)
    return best, vector(first, "start", moments.size, example=example)


def settling_samples(
    moments: Moments,
    mu: StepSizes,
    weights: Float[np.ndarray, " P"],
    coefficient: int,
    *,
    within: float = 0.05,
    start: Float[np.ndarray, " P"] | None = None,
) -> float:
    """Samples after which the mean of one weight stays within a share of its final value.

    Args:
        moments: moments of the regressors.
        mu: step size, one or one per weight.
        weights: best weights; all of them matter, since slow modes mix them.
        coefficient: index of the weight, whose best value is not zero.
        within: the share.
        start: first weights; zero if None.

    Returns:
        The number of samples; infinite if the weight never settles.

    Raises:
        InputError: the best value of the weight is zero, or there is no such weight.
    """
    exact, moving = recursion(moments, mu)
    best, first = _ends(moments, weights, start)
    coefficient = whole(coefficient, "coefficient", 0, moments.size - 1)
    if best[coefficient] == 0:
        raise InputError(
            f"Weight {coefficient} has the best value 0, and no share of it can be taken; choose another one."
        )
    if not moving[coefficient]:
        return float("inf") if first[coefficient] != best[coefficient] else 0.0
    row = int(np.sum(moving[:coefficient]))
    delta = (first - best)[moving] / exact.root
    along = exact.vectors.T @ delta
    share = exact.root[row] * exact.vectors[row] * along / best[coefficient]
    left = (exact.root[row] * delta[row] / best[coefficient]) - share.sum()

    def outside(t: np.ndarray) -> np.ndarray:
        return np.abs(left + (1 - exact.values) ** t[:, None] @ share) > within

    if exact.values[-1] >= 2 or abs(left) > within:
        return float("inf")
    # After this time even the sum of all sizes is inside; before it look for the last time outside.
    slowest = np.abs(1 - exact.values).max()
    total = np.abs(share).sum()
    end = np.log(max(total, 2 * within) / (within - abs(left))) / -np.log(slowest) + 2
    if end > LONGEST_SETTLING:
        return float("inf")
    grid = np.unique(np.r_[0, np.geomspace(1, end, 4000).round(), np.ceil(end)])
    bad = np.flatnonzero(outside(grid))
    if not len(bad):
        return 0.0
    low, high = grid[bad[-1]], grid[bad[-1] + 1]
    while high - low > 1:
        middle = np.floor((low + high) / 2)
        low, high = (middle, high) if outside(np.array([middle]))[0] else (low, middle)
    return float(high)


def settling_factor(
    moments: Moments,
    direction: StepSizes,
    weights: Float[np.ndarray, " P"],
    coefficient: int,
    samples: float,
    *,
    scaled: Bool[np.ndarray, " P"] | None = None,
    within: float = 0.05,
) -> float:
    """Factor on step sizes with which one weight settles after the given number of samples.

    Args:
        moments: moments of the regressors.
        direction: step size, one or one per weight.
        weights: best weights.
        coefficient: index of the weight.
        samples: number of samples after which the weight should have settled.
        scaled: mask of the step sizes that the factor multiplies, for instance the step sizes of the
            quadratic weights only; all of them if None.
        within: share of the final value within which the weight has settled.

    Returns:
        The smallest such factor; infinite if no factor is sufficient. Compare it with `mean_square_bound`.
    """
    base = step_sizes(moments, direction)
    mask = np.ones(moments.size, dtype=bool) if scaled is None else np.asarray(scaled, dtype=bool)

    def in_time(log_factor: float) -> bool:
        mu = np.where(mask, base * np.exp(log_factor), base)
        return settling_samples(moments, mu, weights, coefficient, within=within) <= samples

    # The settling time is not monotone, since the mean overshoots with large factors: the first factor from
    # below is taken.
    low = -12.0
    while not in_time(low + 0.25):
        low += 0.25
        if low > 12:
            return float("inf")
    high = low + 0.25
    while high - low > 1e-4:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if in_time(middle) else (middle, high)
    return float(np.exp(high))
