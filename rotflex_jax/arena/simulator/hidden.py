"""The effects that a recording may hide: their names, ports, default sizes and equivalent effects."""

from __future__ import annotations

from rotflex_jax.arena.simulator.laws import Place

DEFAULTS: dict[Place, dict[str, float]] = {
    ("coulomb", "hub"): {"level": 0.03},
    ("coulomb", "arm"): {"level": 0.006},
    ("coulomb", "joint"): {"level": 0.006},
    ("coulomb_asymmetric", "hub"): {"level_plus": 0.045, "level_minus": 0.015},
    ("coulomb_asymmetric", "arm"): {"level_plus": 0.009, "level_minus": 0.003},
    ("coulomb_asymmetric", "joint"): {"level_plus": 0.009, "level_minus": 0.003},
    ("stribeck", "hub"): {"level": 0.02, "excess": 0.03, "speed": 0.4},
    ("stribeck", "arm"): {"level": 0.004, "excess": 0.006, "speed": 0.4},
    ("stribeck", "joint"): {"level": 0.004, "excess": 0.006, "speed": 0.4},
    ("viscous", "hub"): {"coefficient": 0.01},
    ("viscous", "arm"): {"coefficient": 0.005},
    ("viscous", "joint"): {"coefficient": 0.006},
    ("quadratic_drag", "hub"): {"coefficient": 0.008},
    ("quadratic_drag", "arm"): {"coefficient": 0.004},
    ("quadratic_drag", "joint"): {"coefficient": 0.004},
    ("cubic_spring", "joint"): {"coefficient": 40.0},
    ("quadratic_spring", "joint"): {"coefficient": 1.5},
    ("joint_play", "joint"): {"play": 0.006},
    ("gravity", "hub"): {"moment": 0.03, "phase": 0.6},
    ("gravity", "arm"): {"moment": 0.03, "phase": 0.6},
    ("cogging", "hub"): {"amplitude": 0.02, "phase": 0.6, "periods": 8.0},
    ("cogging", "arm"): {"amplitude": 0.02, "phase": 0.6, "periods": 8.0},
    ("dahl", "hub"): {"level": 0.03, "presliding": 0.01},
    ("dahl", "joint"): {"level": 0.006, "presliding": 0.01},
    ("lugre", "hub"): {
        "level": 0.03,
        "rise": 0.5,
        "speed": 0.3,
        "presliding": 0.004,
        "damping": 0.01,
    },
    ("lugre", "joint"): {
        "level": 0.006,
        "rise": 0.5,
        "speed": 0.3,
        "presliding": 0.004,
        "damping": 0.002,
    },
    ("bouc_wen", "hub"): {"level": 0.03, "width": 0.02, "beta": 0.5},
    ("bouc_wen", "joint"): {"level": 0.02, "width": 0.02, "beta": 0.5},
    ("second_mode", "hub"): {"inertia": 4e-4, "frequency": 18.0, "damping": 0.03},
    ("second_mode", "arm"): {"inertia": 8e-4, "frequency": 10.0, "damping": 0.03},
    ("backlash", "hub"): {"play": 0.011},
    ("heating", "hub"): {"rate": 1.1, "time": 30.0},
    ("dead_zone", "input"): {"width": 0.2},
    ("saturation", "input"): {"limit": 1.2},
    ("voltage_offset", "input"): {"offset": 0.25},
    ("lag", "input"): {"time": 0.006},
    ("delay", "input"): {"time": 0.0045},
    ("sensor_bias", "alpha"): {"bias": 0.01},
    ("sensor_gain", "alpha"): {"error": 0.05},
    ("sensor_gain", "theta"): {"error": 0.05},
    ("sensor_cubic", "alpha"): {"cubic": 6.0},
    ("sensor_cubic", "theta"): {"cubic": 0.005},
    ("rectifier", "alpha"): {"loss": 0.15},
}
"""Parameters at ``size = 1``: N m, N m s/rad, N m s^2/rad^2, N m/rad^2, N m/rad^3, rad, rad/s, V, s,
Hz, kg m^2, 1/rad^2; heat in 1/((N m)^2 s).

A bias of `theta` is left out: it only shifts an unknown origin.
"""

OUTSIDE: dict[Place, dict[str, float]] = {
    ("patchy_friction", "hub"): {"level": 0.04, "share": 0.8},
    ("drifting_spring", "joint"): {"drift": 0.01},
    ("shaking", "arm"): {"amplitude": 0.02, "frequency": 1.7},
    ("slack_cable", "hub"): {"level": 0.05, "width": 0.1, "time": 0.3},
    ("worm", "hub"): {"loss": 0.5, "speed": 1.5},
}
r"""Effects that are not in the catalogue of the package: a good search reports that an effect is missing.

Friction of level ``F (1 + r sin 3 theta)``; a stiffness that grows by 1 % per second; a torque
``A sin 2 pi f t`` that is not measured; a cable whose torque builds up over an angle and decays at rest,
``x' = (s - |s| x) / w - x / T``; a gear that transmits less at high speed, ``1 - loss |s| / (|s| + s_0)`` of
the motor torque.
"""

EQUIVALENT: dict[Place, set[Place]] = {
    ("coulomb_asymmetric", "hub"): {("voltage_offset", "input"), ("coulomb", "hub")},
    ("coulomb_asymmetric", "joint"): {("sensor_bias", "alpha"), ("coulomb", "joint")},
    ("coulomb_asymmetric", "arm"): {
        ("voltage_offset", "input"),
        ("sensor_bias", "alpha"),
        ("coulomb", "arm"),
    },
    ("voltage_offset", "input"): {("coulomb_asymmetric", "hub")},
    ("sensor_bias", "alpha"): {("coulomb_asymmetric", "joint")},
    ("sensor_gain", "alpha"): {("sensor_gain", "theta")},
    ("sensor_gain", "theta"): {("sensor_gain", "alpha")},
}
r"""Answers that no recording can distinguish from the truth, alone or together with symmetric friction.

With mean level ``F`` and half difference ``d``, asymmetric friction is ``F Sgn(s) + d``: symmetric friction
and a constant torque ``d``. At the hub this torque is equivalent to a voltage ``-d / g``. At the joint it
moves the equilibrium by ``-d / K``, and every law depends only on the motion about it, so it is equivalent to
a bias of the deflection sensor. At the arm, ``p = (1, 1)``, it is equivalent to both together. This is exact
while no other effect depends on the shifted quantity (dead zone, nonlinear spring).

Only the ratio of the two sensor gains can be identified: two readings that are too large by the same factor
are the readings of a joint with a stronger motor. This is exact while every torque is proportional to angles,
speeds and voltage.

A law that contains the true law as a special case is not listed, since it has a needless parameter: the
Bouc-Wen law with ``beta = 1`` is Dahl's law, and so is LuGre's law without rise and damping.
"""

ABSORBED: set[Place] = {("viscous", "hub"), ("viscous", "joint")}
"""Effects that only enlarge a free constant of the textbook joint."""

UNSEEN: dict[Place, set[str]] = {
    ("dead_zone", "input"): {"prbs"},
    ("saturation", "input"): {"prbs"},
}
"""Inputs that cannot show an effect: with two levels of voltage, these two effects only change the gain."""

SHAPES: dict[str, set[str]] = {
    "stribeck": {"speed"},
    "gravity": {"phase"},
    "cogging": {"phase", "periods"},
    "dahl": {"presliding"},
    "lugre": {"rise", "speed", "presliding"},
    "bouc_wen": {"width", "beta"},
    "second_mode": {"frequency", "damping"},
    "heating": {"time"},
    "shaking": {"frequency"},
    "slack_cable": {"width", "time"},
    "patchy_friction": {"share"},
    "worm": {"speed"},
}
"""Parameters that keep their value when the size of an effect is scaled."""

# Parameters with a stronger effect at a smaller value.
_INVERSE = {"limit"}


def parameters(place: Place, size: float = 1.0) -> dict[str, float]:
    """Default parameters of an effect, its strength multiplied by `size`.

    Args:
        place: name and port.
        size: factor on every torque, voltage, time or angle; a limit is divided by it.

    Returns:
        Parameter names and values.

    Raises:
        ValueError: if the arena has no such effect at that port.
    """
    known = {**DEFAULTS, **OUTSIDE}
    if place not in known:
        names = ", ".join(f"{name} at {port}" for name, port in known)
        raise ValueError(f"The arena has no {place[0]} at {place[1]}; it has {names}.")
    values = dict(known[place])
    for name in values:
        if name in _INVERSE:
            values[name] /= size
        elif name not in SHAPES.get(place[0], set()):
            values[name] *= size
    return values
