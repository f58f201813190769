"""Simulated flexible joints with known effects, on which a method can be tested.

S0 is the paper's joint as listed, which is linear. The others add effects that a real joint may have. Only
the joint itself comes from the paper: **every friction level, dead zone and spring term here is an
assumption**, since no measured values have been published for this module.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, Inexact, Real

from rotflex_jax.effects import (
    Coulomb,
    CoulombAsymmetric,
    CubicSpring,
    DeadZone,
    QuadraticSpring,
    VoltageOffset,
)
from rotflex_jax.effects.base import Effect
from rotflex_jax.errors import InputError
from rotflex_jax.joints import SPRINGS, paper
from rotflex_jax.joints.rotary_flexible import ARM_ANCHORS, HUB_ANCHORS, SIDE, SpringType
from rotflex_jax.mechanism import Exponential, Mechanism, simulate

LONGEST_SIMULATION_STEP = 2.5e-4
"""Longest step of the simulation [s]; with friction, the error of the deflection is about 1e-5 (NMSE)."""


@dataclasses.dataclass(frozen=True)
class Scenario:
    """Effects that are added to the paper's joint.

    Attributes:
        about: The effects in words, with values.
        odd: Whether the negative voltage gives the negative motion, so that all kernels of even degree are
            zero.
        effects: Function of the port of the arm's friction, "joint" or "arm", that returns the effects.
    """

    about: str
    odd: bool
    effects: Callable[[str], tuple[Effect, ...]]


def _friction(hub: float, arm: float, band: float) -> Callable[[str], tuple[Effect, ...]]:
    return lambda at: (
        Coulomb("hub", level=hub),
        Coulomb(at, level=arm),
        DeadZone(positive=band, negative=band),
    )


_S1 = _friction(0.03, 0.003, 0.1)

SCENARIOS: dict[str, Scenario] = {
    "S0": Scenario("the joint as the paper lists it, linear", True, lambda at: ()),
    "S1": Scenario(
        "friction of 0.03 N m at the hub and 0.003 N m at the arm, dead zone of ±0.1 V, all symmetric",
        True,
        _S1,
    ),
    "S2": Scenario(
        "friction of 0.06 N m at the hub and 0.005 N m at the arm, dead zone of ±0.2 V, all symmetric",
        True,
        _friction(0.06, 0.005, 0.2),
    ),
    "S3": Scenario(
        "unequal friction at the hub, 0.045 N m forwards and 0.015 N m backwards, 0.003 N m at the arm, "
        "dead zone of ±0.1 V",
        False,
        lambda at: (CoulombAsymmetric("hub", forward=0.045, backward=0.015), *_S1(at)[1:]),
    ),
    "S4": Scenario(
        "friction of 0.03 N m at the hub and 0.003 N m at the arm, dead zone of 0.25 V above zero and "
        "none below",
        False,
        lambda at: (*_S1(at)[:2], DeadZone(positive=0.25, negative=0.0)),
    ),
    "S5s": Scenario(
        "no friction; an artificial spring with K2 = 3 N m/rad² and K3 = 10 N m/rad³",
        False,
        lambda at: (QuadraticSpring("joint", stiffness=3.0), CubicSpring("joint", stiffness=10.0)),
    ),
    "S5p": Scenario(
        "different springs (3 on the left, 2 on the right, in the holes C and 3), friction and dead zone as "
        "in S1",
        False,
        lambda at: (*_unlike_springs(), *_S1(at)),
    ),
    "S6": Scenario(
        "friction of 0.03 N m at the hub and 0.003 N m at the arm, dead zone of ±0.1 V, an amplifier that "
        "adds 0.3 V",
        False,
        lambda at: (*_S1(at), VoltageOffset(offset=0.3)),
    ),
    "S7": Scenario(
        "no friction; an artificial hardening spring with K3 = 60 N m/rad³",
        True,
        lambda at: (CubicSpring("joint", stiffness=60.0),),
    ),
}
"""Name -> scenario."""


def plant(name: str, arm_friction: str = "joint", **parameters: Any) -> Mechanism:
    """The mechanism of a scenario.

    Args:
        name: One of `SCENARIOS`.
        arm_friction: Port of the arm's friction: "joint", the bearing between hub and arm, or "arm",
            against the table. The paper's "rotational speeds of the two rotating masses" allows both.
        **parameters: Arguments of `joints.paper`, for instance `efficiency=0.621`.

    Returns:
        The paper's joint with the effects of the scenario, outputs `theta` and `alpha`.

    Raises:
        InputError: There is no such scenario or port.

    >>> [effect.name for effect in plant("S1").effects[-3:]]
    ['coulomb', 'coulomb', 'dead_zone']
    """
    if name not in SCENARIOS:
        raise InputError(
            f"Scenario {name!r} was asked for, but there are {', '.join(SCENARIOS)}; choose one of these."
        )
    if arm_friction not in ("joint", "arm"):
        raise InputError(
            f"arm_friction was given {arm_friction!r}, but the arm's friction acts at 'joint' (against the "
            "hub) or at 'arm' (against the table); choose one of these."
        )
    if name == "S5p":
        parameters.setdefault("stiffness", spring_series(3, 2, "C", 3)[1])
    mechanism = paper(**parameters)
    for effect in SCENARIOS[name].effects(arm_friction):
        mechanism = mechanism + effect
    return mechanism


def response(
    mechanism: Mechanism, u: Real[np.ndarray, " N"], Ts: float, *, step: float = LONGEST_SIMULATION_STEP
) -> Float[np.ndarray, "N C"]:
    """Outputs from rest, in float64; sample k is the output at the start of `u[k]`.

    Args:
        mechanism: Mechanism from `plant`, or any other.
        u: Voltage [V], held over each sample.
        Ts: Sampling period [s].
        step: Longest step of the integration [s]; with dry friction, one step per sample is sufficient only
            for fast sampling.
    """
    substeps = max(1, int(np.ceil(Ts / step - 1e-9)))
    return simulate(mechanism, np.asarray(u, float), Ts, solver=Exponential(substeps=substeps))


def spring_series(
    left: int, right: int, hub_anchor: str, arm_anchor: int
) -> tuple[float, float, float, float]:
    """Power series of the torque of two springs, which may differ, about their balance angle.

        tau = K a + K2 a^2 + K3 a^3,   a = alpha - alpha_0,   tau = dU/dalpha

    The torque is an analytic function, so its series is a mean over a circle in the complex plane
    (Cauchy), exact to rounding. Not for deflections beyond about 0.3 rad.

    Args:
        left: Spring 1, 2 or 3 on the side of positive angles.
        right: Spring 1, 2 or 3 on the other side.
        hub_anchor: Anchor at the hub, "A", "B" or "C".
        arm_anchor: Anchor at the arm, 1, 2 or 3.

    Returns:
        alpha_0 [rad], K [N m/rad], K2 [N m/rad^2], K3 [N m/rad^3].

    >>> [round(float(term), 3) + 0.0 for term in spring_series(3, 3, "C", 3)]
    [0.0, 1.6, 0.0, -0.631]
    """
    d, R, r = HUB_ANCHORS[hub_anchor], ARM_ANCHORS[arm_anchor], SIDE
    alpha, radius = 0.0, 0.1
    turns = np.exp(2j * np.pi * np.arange(32) / 32)
    for _ in range(20):
        angles = alpha + radius * turns
        torque = sum(_torque(SPRINGS[kit], d, R, side, angles) for kit, side in ((left, r), (right, -r)))
        series = [float(np.mean(torque / turns**n).real) / radius**n for n in range(4)]
        alpha -= series[0] / series[1]
    return alpha, series[1], series[2], series[3]


def _torque(
    kit: SpringType, d: float, R: float, side: float, alpha: Inexact[np.ndarray, " K"]
) -> Inexact[np.ndarray, " K"]:
    """Torque of one spring, from its length: dU/dalpha = force dlength/dalpha [N m]."""
    along, aside = R * np.cos(alpha) - d, R * np.sin(alpha) - side
    length = np.sqrt(along**2 + aside**2)
    force = kit.preload + kit.rate * (length - kit.length)
    return force * R * (aside * np.cos(alpha) - along * np.sin(alpha)) / length


def _unlike_springs() -> tuple[Effect, ...]:
    _, _, K2, K3 = spring_series(3, 2, "C", 3)
    return QuadraticSpring("joint", stiffness=K2), CubicSpring("joint", stiffness=K3)
