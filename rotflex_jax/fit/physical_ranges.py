"""Ranges that fitted parameters are kept in: what a machine can be, beyond what the equations allow."""

import numpy as np
from jaxtyping import Float

from rotflex_jax.effects.base import Effect, Linear
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.parameters import Transform, specifications

_DAMPING = "N m s/rad"


def physical_ranges(m: Mechanism) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Least and largest unconstrained value of each parameter.

    They are the physical ranges that effects declare. A damping coefficient may fall below its own range as
    far as others damp the same port: then it corrects them, as with a back-EMF constant that is trusted and
    too large, and what stays is the damping of a machine. A start outside widens the range.

    Args:
        m: With the values at the start.
    """
    low, high = [], []
    for effect in m.effects:
        others = sum(_static_damping(e) for e in m.effects if e is not effect and e.at == effect.at)
        for spec in specifications(effect).values():
            corrects = isinstance(effect, Linear) and spec.unit == _DAMPING
            low.append(spec.physical[0] - (max(others, 0.0) if corrects else 0.0))
            high.append(spec.physical[1])
    values, transform = m.values, Transform.of(m.parameter_specifications)
    low, high = np.minimum(low, values), np.maximum(high, values)
    # An end beyond a declared bound is never reached. A coordinate runs with its parameter but where that
    # has only an upper bound, and no effect declares such a one.
    ends = (low > transform.lower, low, -np.inf), (high < transform.upper, high, np.inf)
    lowest, highest = (
        np.where(inside, transform.unconstrain(np.where(inside, end, values)), none)
        for inside, end, none in ends
    )
    return lowest, highest


def _static_damping(effect: Effect) -> float:
    """Damping of a linear effect at its port, a motor's through its current at constant speed too."""
    if not isinstance(effect, Linear):
        return 0.0
    stamp = effect.stamp()
    through = 0.0
    if len(stamp.own):
        own, torque = np.array(stamp.own, float), np.array(stamp.torque, float)
        through = float(torque @ np.linalg.pinv(own) @ np.array(stamp.from_speed, float))
    return float(stamp.damping) + through
