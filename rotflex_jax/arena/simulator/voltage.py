"""Path of the voltage to the motor: limiter, offset, dead zone, then delay, then lag."""

from __future__ import annotations

import numpy as np

from rotflex_jax.arena.simulator.compiled import compiled
from rotflex_jax.arena.simulator.tables import DEAD_MINUS, DEAD_PLUS, DELAY, LAG, LIMIT, OFFSET, Values


def amplified(u: Values, volts: Values) -> Values:
    """Voltages after limiter, offset and dead zone [V]."""
    v = np.minimum(np.maximum(u, -volts[LIMIT]), volts[LIMIT]) + volts[OFFSET]
    return np.where(
        v > volts[DEAD_PLUS],
        v - volts[DEAD_PLUS],
        np.where(v < -volts[DEAD_MINUS], v + volts[DEAD_MINUS], 0.0),
    )


def _split(steps: float) -> tuple[int, float]:
    """Whole steps of a delay, and the remaining part of a step."""
    whole = int(np.floor(steps + 1e-9))
    rest = steps - whole
    return whole, rest if rest > 1e-9 else 0.0


def delayed(v: Values, steps: float, before: float) -> Values:
    """Mean over each step of a voltage that is delayed by `steps` steps; until then it is `before`."""
    whole, rest = _split(steps)
    # A change inside a step counts for the rest of the step.
    padded = np.concatenate([np.full(whole + 1, before), v])
    return (1 - rest) * padded[1 : v.size + 1] + rest * padded[: v.size]


@compiled
def _lagged(v, ratio, state):
    out = np.empty_like(v)
    left = np.exp(-ratio)
    mean = (1 - left) / ratio
    for k in range(v.size):
        out[k] = v[k] + (state - v[k]) * mean
        state = v[k] + (state - v[k]) * left
    return out, state


def lagged(v: Values, ratio: float, before: float) -> Values:
    """Mean over each step of ``dx/dt = (v - x) / time``; `ratio` is the length of a step over ``time``."""
    return _lagged(v, ratio, before)[0]


def supply(u: Values, volts: Values, substeps: int, h: float) -> Values:
    """Mean voltage at the motor in every integration step.

    Before the record the input is zero, and delay and lag are in steady state.

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


class Path:
    """The same path sample by sample, for a voltage that a controller computes; gives the rows of `supply`.

    Args:
        volts: coefficients of the path.
        substeps: integration steps per sample.
        h: length of a step [s].
    """

    def __init__(self, volts: Values, substeps: int, h: float):
        self.volts, self.substeps, self.h = volts, substeps, h
        before = float(amplified(np.zeros(1), volts)[0])
        self.late = volts[DELAY] / h
        self.past = np.full(_split(self.late)[0] + 1, before)
        self.lagging = before

    def __call__(self, u: float) -> Values:
        """Voltage at the motor in every step of the next sample [V], ``(substeps,)``."""
        v = np.repeat(amplified(np.array([u]), self.volts), self.substeps)
        if self.volts[DELAY] > 0:
            n, rest = self.substeps, _split(self.late)[1]
            line = np.concatenate([self.past, v])
            v = (1 - rest) * line[1 : n + 1] + rest * line[:n]
            self.past = line[n:]
        if self.volts[LAG] > 0:
            v, self.lagging = _lagged(v, self.h / self.volts[LAG], self.lagging)
        return v
