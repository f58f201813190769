"""The effects that a recording may hide: their names, ports, default sizes and look-alikes."""

from __future__ import annotations

from collections.abc import Mapping

from arena import plant as p

Place = tuple[str, str]
"""An effect's name and its port: ``("coulomb", "hub")``."""

# Which coefficients a parameter sets. Friction has one column per direction of motion.
_TORQUE: dict[str, dict[str, tuple[int, ...]]] = {
    "coulomb": {"level": (p.FRICTION_PLUS, p.FRICTION_MINUS)},
    "coulomb_asymmetric": {"level_plus": (p.FRICTION_PLUS,), "level_minus": (p.FRICTION_MINUS,)},
    "stribeck": {
        "level": (p.FRICTION_PLUS, p.FRICTION_MINUS),
        "excess": (p.STRIBECK,),
        "speed": (p.STRIBECK_SPEED,),
    },
    "viscous": {"coefficient": (p.VISCOUS,)},
    "quadratic_drag": {"coefficient": (p.DRAG,)},
    "quadratic_spring": {"coefficient": (p.QUADRATIC,)},
    "cubic_spring": {"coefficient": (p.CUBIC,)},
    "gravity": {"moment": (p.GRAVITY,), "phase": (p.PHASE,)},
}
_VOLTAGE: dict[str, dict[str, tuple[int, ...]]] = {
    "dead_zone": {"width": (p.DEAD_PLUS, p.DEAD_MINUS)},
    "saturation": {"limit": (p.LIMIT,)},
    "voltage_offset": {"offset": (p.OFFSET,)},
}
_CHANNELS = {"theta": 0, "alpha": 1}

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
    ("gravity", "hub"): {"moment": 0.03, "phase": 0.6},
    ("gravity", "arm"): {"moment": 0.03, "phase": 0.6},
    ("dead_zone", "input"): {"width": 0.2},
    ("saturation", "input"): {"limit": 1.2},
    ("voltage_offset", "input"): {"offset": 0.25},
    ("sensor_bias", "alpha"): {"bias": 0.01},
}
"""Parameters at ``size = 1``: N m, N m s/rad, N m s^2/rad^2, N m/rad^2, N m/rad^3, rad/s, V, rad.

A bias of `theta` is left out: it shifts an origin that nobody knows.
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
}
r"""Answers that no recording can tell from the truth, alone or together with the symmetric form.

With mean level ``F`` and half difference ``d`` an asymmetric friction is ``F Sgn(s) + d``, a
symmetric one and a constant torque ``d``. At the hub that torque is a voltage ``-d / g``. At the
joint it moves the equilibrium by ``-d / K``, and every law sees only motion about it, so it is a
bias of the deflection sensor. At the arm, ``p = (1, 1)``, it is both. The identities are exact
while no other effect depends on what is shifted (dead zone, spring of higher order).
"""

ABSORBED: set[Place] = {("viscous", "hub"), ("viscous", "joint")}
"""Effects that only enlarge a constant which the textbook joint already has free."""

UNSEEN: dict[Place, set[str]] = {
    ("dead_zone", "input"): {"prbs"},
    ("saturation", "input"): {"prbs"},
}
"""Inputs that cannot show an effect: on two levels these two are a change of gain."""

# Shapes keep their value when the size of an effect is scaled; a limit bites harder when lower.
_SHAPES = {"speed", "phase"}
_INVERSE = {"limit"}


def parameters(place: Place, size: float = 1.0) -> dict[str, float]:
    """Default parameters of an effect, its strength multiplied by `size`.

    Args:
        place: name and port.
        size: factor on every torque, voltage or angle; a limit is divided by it.

    Returns:
        Parameter names and values.

    Raises:
        ValueError: if the arena has no such effect at that port.
    """
    if place not in DEFAULTS:
        known = ", ".join(f"{name} at {port}" for name, port in DEFAULTS)
        raise ValueError(f"The arena has no {place[0]} at {place[1]}; it has {known}.")
    values = dict(DEFAULTS[place])
    for name in values:
        if name in _INVERSE:
            values[name] /= size
        elif name not in _SHAPES:
            values[name] *= size
    return values


def laws(effects: Mapping[Place, Mapping[str, float]]) -> p.Laws:
    """The plant's coefficient tables with the given effects in them.

    Effects of one kind at one port add up, friction levels included; a limit replaces.

    Args:
        effects: parameters of every effect by name and port.

    Returns:
        Tables for `arena.plant.simulate`.
    """
    tables = p.Laws()
    for (effect, port), values in effects.items():
        for name, value in values.items():
            if effect in _TORQUE:
                for column in _TORQUE[effect][name]:
                    tables.torque[p.PORTS[port], column] += value
            elif effect in _VOLTAGE:
                for entry in _VOLTAGE[effect][name]:
                    tables.volts[entry] = value if entry == p.LIMIT else tables.volts[entry] + value
            else:
                tables.bias[_CHANNELS[port]] += value
    return tables
