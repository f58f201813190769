r"""Whether a hidden effect is visible in a run, computed with the simulator alone.

The plant runs again under the recorded voltage, with and without the effect, from the true state at the
beginning of each window. From the difference :math:`d` of the readings, the part is removed that other
constants could explain to first order,

.. math::
    d_\perp = d - S (S^+ d), \qquad
    S = \partial y / \partial (J_h, K, k_t, B_h, B_j, \mathrm{offset}, \mathrm{bias}),

and the effect is visible if the root mean square of :math:`d_\perp` is many standard deviations of the sensor
noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotflex_jax.arena.simulator.closed_loop import Loop, Sensors
from rotflex_jax.arena.simulator.motion import MEMORY
from rotflex_jax.arena.simulator.plant import Plant, run, tables_of
from rotflex_jax.arena.simulator.tables import OFFSET, Laws, Values
from rotflex_jax.arena.simulator.voltage import supply

STEP = 50e-6
"""Integration step of these comparisons [s]; the true run has a finer one."""

WINDOW = 2.0
"""Length of a free run [s]."""

_CHANGES = {"J_hub": 0.02, "K": 0.01, "k_t": 0.02}
_DAMPERS = {"B_hub": 2e-4, "B_joint": 1e-4}
_OFFSET = 0.01


def free_runs(plant: Plant, laws: Laws, sensors: Sensors, loop: Loop, Ts: float) -> Values:
    """Readings of the plant under the recorded voltage; each window starts at the true state.

    Args:
        plant: physical constants.
        laws: effects in addition to these constants; if the true plant has further hysteretic torques, these
            must come last in its state.
        sensors: sensors of the angles.
        loop: the recorded run.
        Ts: sampling period [s].

    Returns:
        Readings without noise and quantisation [rad], ``(N, 2)``.
    """
    substeps = max(1, round(Ts / STEP))
    h, N = Ts / substeps, loop.u.size
    drive = plant.torque_per_volt * supply(loop.u, laws.volts, substeps, h) + loop.torque[:, None]
    tables, size = tables_of(plant, laws), MEMORY + len(laws.hysteresis)
    states = np.empty((N, size))
    window = round(WINDOW / Ts)
    for a in range(0, N, window):
        start = np.ascontiguousarray(loop.states[a, :size])
        first = (loop.first + a) * substeps
        states[a : a + window] = run(drive[a : a + window], h, tables, start, first)
    return sensors.clean(states, laws.sensors)


def distinctness(
    plant: Plant, laws: Laws, without: Laws, sensors: Sensors, loop: Loop, Ts: float
) -> tuple[float, float]:
    """Root mean square of what only the effect explains, in units of the sensor noise, for theta and alpha.

    Args:
        plant: physical constants.
        laws: all effects of the true plant.
        without: the same effects except one.
        sensors: sensors of the angles.
        loop: the recorded run of the true plant.
        Ts: sampling period [s].
    """
    scale = sensors.deviation()
    bare = free_runs(plant, without, sensors, loop, Ts)
    difference = (free_runs(plant, laws, sensors, loop, Ts) - bare) / scale
    changed = [(replace(plant, **{n: getattr(plant, n) * (1 + e)}), without) for n, e in _CHANGES.items()]
    changed += [(replace(plant, **{n: getattr(plant, n) + e}), without) for n, e in _DAMPERS.items()]
    volts = without.volts.copy()
    volts[OFFSET] += _OFFSET
    changed.append((plant, replace(without, volts=volts)))
    columns = [((free_runs(p, t, sensors, loop, Ts) - bare) / scale).ravel() for p, t in changed]
    columns.append(np.tile([0.0, 1.0], loop.u.size))
    S = np.stack(columns, axis=1)
    S = S / np.maximum(np.linalg.norm(S, axis=0), 1e-12)
    d = difference.ravel()
    left = (d - S @ np.linalg.lstsq(S, d, rcond=1e-8)[0]).reshape(-1, 2)
    theta, alpha = np.sqrt(np.mean(left**2, axis=0))
    return float(theta), float(alpha)
