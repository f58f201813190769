"""Restarts of a fit with many local minima: whether they are needed, where they begin, when they end."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

# If the error of a channel exceeds its noise by this factor, the fit may not have found the least cost.
MISSING = 3.0
# Standard deviations of the distance from the best end so far, as a share of each parameter. A near start
# leaves a local minimum for a neighbouring one, a far start may find another valley.
NEAR, FAR = 0.3, 1.0
# Least size that is taken for an unconstrained coordinate near zero.
LEAST_SIZE = 0.3
# When this many ends have the same cost, further restarts are unlikely to find a lower one.
AGREEING_ENDS = 3


def misses_something(rms: Float[np.ndarray, " C"], noise: Float[np.ndarray, " C"]) -> bool:
    """Whether an error exceeds the noise so far that the least cost may be elsewhere."""
    return not np.all(rms < MISSING * noise)


def moved_by_chance(
    z: Float[np.ndarray, " K"], bounded: Bool[np.ndarray, " K"], distance: float, random: np.random.Generator
) -> Float[np.ndarray, " K"]:
    """Unconstrained parameters at a random distance from given ones.

    The coordinate of a parameter with a bound moves by distance n, so that its distance from a single bound
    is multiplied by exp(distance n). Any other coordinate moves by distance n times its size, at least
    `LEAST_SIZE`. n is a standard normal number, limited to -2 to 2.

    Args:
        z: The given parameters.
        bounded: Which of them have a bound.
        distance: `NEAR` or `FAR`.
        random: Generator of n.
    """
    size = np.where(bounded, 1.0, np.maximum(np.abs(z), LEAST_SIZE))
    return z + distance * size * np.clip(random.standard_normal(len(z)), -2, 2)


def enough(costs: Sequence[float], tolerance: float) -> bool:
    """Whether `AGREEING_ENDS` ends have the least cost, within a tolerance: no further restart is needed."""
    least = min(costs)
    return bool(np.isfinite(least)) and sum(cost <= least + tolerance for cost in costs) >= AGREEING_ENDS
