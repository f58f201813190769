"""Restarts of a fit with many local minima: whether they are needed, where they begin, when to end."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

# Runs that miss a channel by more than so many times its noise lack something, and may miss the least cost.
MISSING = 3.0
# Standard deviations of the distance from the best end so far, as a share of each parameter. Near it a fit
# leaves a local minimum for the next one, far from it another valley is found.
NEAR, FAR = 0.3, 1.0
# Least size of an unconstrained coordinate that is near zero.
LEAST_SIZE = 0.3
# Where so many ends have the same cost, further restarts are unlikely to find a lower one.
AGREEING_ENDS = 3


def misses_something(rms: Float[np.ndarray, " C"], noise: Float[np.ndarray, " C"]) -> bool:
    """Whether errors are so far beyond the noise that the least cost may be elsewhere."""
    return not np.all(rms < MISSING * noise)


def moved_by_chance(
    z: Float[np.ndarray, " K"], bounded: Bool[np.ndarray, " K"], distance: float, random: np.random.Generator
) -> Float[np.ndarray, " K"]:
    """Unconstrained parameters at a random distance from some.

    The coordinate of a parameter with a bound moves by distance n, so that its distance from a single bound
    is multiplied by exp(distance n). Another one moves by distance n times its size, `LEAST_SIZE` at least.
    n is a standard normal number, cut at 2.

    Args:
        z: The parameters.
        bounded: Which of them have a bound.
        distance: `NEAR` or `FAR`.
        random: Where n comes from.
    """
    size = np.where(bounded, 1.0, np.maximum(np.abs(z), LEAST_SIZE))
    return z + distance * size * np.clip(random.standard_normal(len(z)), -2, 2)


def enough(costs: Sequence[float], tolerance: float) -> bool:
    """Whether so many ends have the least cost, within a tolerance, that no further restart is needed."""
    least = min(costs)
    return bool(np.isfinite(least)) and sum(cost <= least + tolerance for cost in costs) >= AGREEING_ENDS
