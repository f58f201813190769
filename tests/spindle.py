"""A spindle with a sensor of speed only, and recordings of it by an independent simulator."""

import numpy as np

import rotflex_jax as rf
from rotflex_jax.effects import CATALOG, Inertia, Motor, Viscous

MOTOR = ("torque_constant", "back_emf", "resistance", "gear_ratio", "efficiency")
SPINDLE = rf.Mechanism(
    coordinates=["phi"],
    ports={"shaft": (1,)},
    effects=[
        Motor("shaft", torque_constant=0.05, back_emf=0.05, resistance=2.0, gear_ratio=1.0, efficiency=1.0),
        Inertia(at="shaft", inertia=0.017),
        Viscous(at="shaft"),
    ],
    outputs={"tacho": ("shaft", "speed")},
    trusted=[f"shaft.motor.{name}" for name in MOTOR],
)
PAIRS = [(CATALOG[name], "shaft") for name in ("coulomb", "quadratic_drag")]


def spun(N: int = 1500, seed: int = 1, inner: int = 10) -> rf.Recording:
    """Speed of an inertia of 0.02 kg m^2 with friction that sticks, by `inner` Euler steps per sample."""
    rng, Ts, level = np.random.default_rng(seed), 0.004, 0.03
    waves = zip([2.5, 2.0, 1.5, 1.0], [0.23, 0.61, 1.37, 2.9], rng.uniform(0, 6, 4), strict=True)
    u = sum(a * np.sin(2 * np.pi * f * Ts * np.arange(N) + p) for a, f, p in waves)
    speed, h, w = np.empty(N), Ts / inner, 0.0
    for k in range(N):
        speed[k] = w
        for _ in range(inner):
            free = w + h * (0.05 * (u[k] - 0.05 * w) / 2.0 - 0.01 * w) / 0.02
            held = h * level / 0.02
            w = 0.0 if abs(free) <= held else free - np.sign(free) * held
    y = speed + 0.01 * rng.standard_normal(N)
    return rf.Recording(u=u, y=y, Ts=Ts, channels="tacho", units="rad/s", accept="units")
