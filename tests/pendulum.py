"""A pendulum that goes over its top, and recordings of it by an independent simulator."""

import numpy as np

import rotflex_jax as rf
from rotflex_jax.effects import CurrentDrive, Gravity, Inertia, Viscous
from rotflex_jax.mechanism import Units

GAIN = 0.35
PENDULUM = rf.Mechanism(
    coordinates=["q"],
    ports={"shaft": (1,)},
    effects=[
        CurrentDrive(at="shaft", gain=GAIN),
        Inertia(at="shaft", inertia=0.01),
        Viscous(at="shaft", coefficient=0.01),
        Gravity(at="shaft"),
    ],
    outputs={"angle": "shaft"},
    units=Units("rad", "N m", input="A"),
    trusted=["shaft.current_drive.gain"],
)


def swung(seconds: float, seed: int, level: float = 0.06, excess: float = 0.05) -> rf.Recording:
    """Angle by an encoder of 4096 counts at 100 Hz; the current steps every 0.25 s.

    Friction falls from `level + excess` at standstill to `level`, and sticks. Leapfrog steps of 0.1 ms.
    """
    inertia, weight, damping, slow, Ts, inner = 0.012, 0.45, 0.008, 0.4, 0.01, 100
    rng, N, h = np.random.default_rng(seed), round(seconds / 0.01), 0.01 / 100
    u = np.repeat(rng.uniform(-1.6, 1.6, N // 25 + 1), 25)[:N]
    angle, q, w = np.empty(N), 0.0, 0.0
    for k in range(N):
        angle[k] = q
        for _ in range(inner):
            q += 0.5 * h * w
            free = w + h * (GAIN * u[k] - weight * np.sin(q) - damping * w) / inertia
            held = h * (level + excess * np.exp(-((w / slow) ** 2))) / inertia
            w = 0.0 if abs(free) <= held else free - np.sign(free) * held
            q += 0.5 * h * w
    count = 2 * np.pi / 4096
    y = np.round(angle / count) * count
    return rf.Recording(u, y, Ts, channels="angle", input_name="current", input_unit="A")
