"""The simulated machine of the settings, and the source of each of its parameters."""

import dataclasses
from typing import Any

from rotflex_jax.effects import Saturation
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.reproduce.plants import plant
from rotflex_jax.reproduce.settings import ASSUMPTION, PAPER, Settings

SYMMETRIC_SCENARIO = "S1"

ASSUMED_BECAUSE = {
    "hub.motor.back_emf": "taken equal to the torque constant, as in SI units it is; the paper lists one",
    "hub.viscous.coefficient": "none beside the motor's own; the paper lists none",
    "joint.viscous.coefficient": "none; the paper lists none",
}


def linear_joint(s: Settings) -> Mechanism:
    """The paper's joint, linear, with the constants that it lists."""
    return plant("S0", efficiency=s.efficiency, inductance=s.inductance or None)


def machine(s: Settings) -> Mechanism:
    """The scenario's joint behind an amplifier that saturates, its parameters changed by `s.plant`.

    Raises:
        InputError: A parameter that this machine does not have, or out of its range.
    """
    return _scenario(s).with_values(dict(s.plant))


def symmetric_twin(s: Settings) -> Mechanism:
    """The same with friction and dead zone that are equal in both directions, and nothing else."""
    twin = _scenario(dataclasses.replace(s, scenario=SYMMETRIC_SCENARIO))
    known = {name: value for name, value in s.plant if name in twin.parameter_names}
    return twin.with_values(known)


def machine_rows(s: Settings) -> list[dict[str, Any]]:
    """The machine's parameters as rows of the settings' table: the paper's constants, then what is assumed.

    >>> [row["name"] for row in machine_rows(Settings()) if row["source"] == "paper"][:2]
    ['hub.inertia.inertia', 'arm.inertia.inertia']
    """
    before, after = _scenario(s), machine(s)
    listed = dict(zip(linear_joint(s).parameter_names, linear_joint(s).values, strict=True))
    settings_of_their_own = {"hub.motor.efficiency", "hub.motor.inductance", "input.saturation.limit"}
    rows = []
    for name, spec, default, value in zip(
        after.parameter_names, after.parameter_specifications, before.values, after.values, strict=True
    ):
        if name in settings_of_their_own:
            continue
        paper = listed.get(name) == default and name not in ASSUMED_BECAUSE
        rows.append(
            {
                "name": name,
                "default": float(default),
                "unit": spec.unit,
                "source": PAPER if paper else ASSUMPTION,
                "why": "its table"
                if paper
                else ASSUMED_BECAUSE.get(name, f"{spec.meaning}; scenario {s.scenario}"),
                "choices": (),
                "value": float(value),
                "changed": bool(value != default),
            }
        )
    return rows


def _scenario(s: Settings) -> Mechanism:
    numbers = {"efficiency": s.efficiency, "inductance": s.inductance or None}
    return plant(s.scenario, s.arm_friction, **numbers) + Saturation(limit=s.saturation)
