"""The way of a voltage to the motor: limiter, offset, dead zone, then delay, then lag."""

from __future__ import annotations

import numpy as np

from arena.compiled import compiled
from arena.tables import DEAD_MINUS, DEAD_PLUS, DELAY, LAG, LIMIT, OFFSET, Array


def amplified(u: Array, volts: Array) -> Array:
    """Voltages behind limiter, offset and dead zone [V]."""
    v = np.minimum(np.maximum(u, -volts[LIMIT]), volts[LIMIT]) + volts[OFFSET]
    return np.where(
        v > volts[DEAD_PLUS],
        v - volts[DEAD_PLUS],
        np.where(v < -volts[DEAD_MINUS], v + volts[DEAD_MINUS], 0.0),
    )


def delayed(v: Array, steps: float, before: float) -> Array:
    """Mean over each step of a voltage that comes `steps` steps late, `before` until then."""
    whole = int(np.floor(steps + 1e-9))
    part = max(steps - whole, 0.0)
    part = part if part > 1e-9 else 0.0
    padded = np.concatenate([np.full(whole + 1, before), v])
    # A change inside a step counts for the part of the step that it is there.
    return (1 - part) * padded[1 : v.size + 1] + part * padded[: v.size]


@compiled
def _lagged(v, ratio, state):
    out = np.empty_like(v)
    left = np.exp(-ratio)
    mean = (1 - left) / ratio
    for k in range(v.size):
        out[k] = v[k] + (state - v[k]) * mean
        state = v[k] + (state - v[k]) * left
    return out


def lagged(v: Array, ratio: float, before: float) -> Array:
    """Mean over each step of ``dx/dt = (v - x) / time``, `ratio` being step over time."""
    return _lagged(v, ratio, before)


def supply(u: Array, volts: Array, substeps: int, h: float) -> Array:
    """Mean voltage at the motor in every integration step.

    Ahead of the record the input is zero, and delay and lag have settled on what that gives.

    Args:
        u: input [V], ``(N,)``, held over each sample.
        volts: coefficients of the path.
        substeps: integration steps per sample.
        h: length of a step [s].

    Returns:
        Voltage [V], ``(N, substeps)``.
    """
    v = np.repeat(amplified(u, volts), substeps)
    before = float(amplified(np.zeros(1), volts)[0])
    if volts[DELAY] > 0:
        v = delayed(v, volts[DELAY] / h, before)
    if volts[LAG] > 0:
        v = lagged(v, h / volts[LAG], before)
    return v.reshape(u.size, substeps)
