"""Independent simulator of a turntable, a machine of a user; it imports nothing of the toolkit.

A motor turns a platter through a belt. An encoder sits on the motor; a frequency-to-voltage converter
measures the speed of the platter, without its sign. Hidden effects are dry friction in the bearing of the
platter, with true sticking, and a magnetic brake.

    python tests/turntable.py FILE    # writes the recording of the notebook
"""

import sys
from typing import NamedTuple

import numba
import numpy as np


class Truth(NamedTuple):
    """Parameters of the machine, in SI units."""

    motor_inertia: float = 0.002
    platter_inertia: float = 0.006
    belt: float = 6.0
    belt_damping: float = 0.004
    torque_per_volt: float = 0.075
    back_emf: float = 0.01125  # braking torque per speed, by the back-EMF
    motor_damping: float = 0.002
    friction: float = 0.0
    brake: float = 0.0
    knee: float = 4.0


@numba.njit
def _run(u, Ts, p, steps):
    motor_inertia, platter_inertia, belt, belt_damping, gain, emf, damping, friction, brake, knee = p
    phi = psi = motor = platter = 0.0
    h = Ts / steps
    y = np.zeros((len(u), 2))
    for i in range(len(u)):
        y[i, 0], y[i, 1] = phi, platter
        for _ in range(steps):
            pull = belt * (psi - phi) + belt_damping * (platter - motor)
            load = -pull - brake * platter / (1 + (platter / knee) ** 2)
            motor_next = motor + h * (gain * u[i] - (emf + damping) * motor + pull) / motor_inertia
            free = platter + h * load / platter_inertia
            grip = h * friction / platter_inertia
            platter_next = 0.0 if abs(free) <= grip else free - np.sign(free) * grip
            phi += h * (motor + motor_next) / 2
            psi += h * (platter + platter_next) / 2
            motor, platter = motor_next, platter_next
    return y


def record(seed: int, truth: Truth, seconds: float = 12.0, Ts: float = 0.004):
    """Voltage (N,), readings of encoder and tacho (N, 2): 1000 counts a turn, noise of 0.03 rad/s."""
    rng = np.random.default_rng(seed)
    t = Ts * np.arange(round(seconds / Ts))
    f = np.geomspace(0.1, 12.0, 18)
    tones = np.sin(2 * np.pi * (f * t[:, None] + rng.random(len(f)))) / np.sqrt(f + 0.5)
    u = tones.sum(axis=1)
    u *= 4.5 / np.max(np.abs(u))
    y = _run(u, Ts, np.array(truth), 400)
    count = 2 * np.pi / 1000
    encoder = np.round(y[:, 0] / count) * count
    tacho = np.abs(y[:, 1]) + 0.03 * rng.standard_normal(len(u))
    return u, np.column_stack([encoder, tacho])


FOR_THE_NOTEBOOK = Truth(friction=0.03, brake=0.03)


def write(path: str) -> None:
    """Write the recording of the notebook."""
    u, y = record(1, FOR_THE_NOTEBOOK)
    table = np.column_stack([0.004 * np.arange(len(u)), u, y])
    np.savetxt(path, table, delimiter=",", header="t,voltage,encoder,tacho", comments="", fmt="%.6g")


if __name__ == "__main__":
    write(sys.argv[1])
