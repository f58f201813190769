"""Rotary flexible joints: a servo turns a hub, two springs carry the arm on it.

Each of two equal, preloaded springs runs from an anchor on the hub to the arm:

    length(alpha)^2 = (R cos(alpha) - d)^2 + (R sin(alpha) -+ r)^2

with the anchors at the distances `d` (hub) and `R` (arm) from the axis along the arm, and `r` to
the side.

The coordinates are the hub angle `theta` and the deflection `alpha` of the arm relative to the hub, so
the absolute angle of the arm is `theta + alpha`. A positive voltage turns the hub forwards and leaves the
arm behind, so the first deflection is negative.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from rotflex_jax.checks import instance, known_arguments, names, shown
from rotflex_jax.effects import Inertia, Motor, Spring, Viscous
from rotflex_jax.errors import InputError
from rotflex_jax.joints.arguments import plain
from rotflex_jax.mechanism import Mechanism

INCH = 0.0254

# Sideways distance of the anchors on the hub [m].
SIDE = 1.25 * INCH


class SpringType(NamedTuple):
    """A spring of the kit.

    Attributes:
        length: Free length [m].
        preload: Force at which the coils begin to open [N].
        rate: Further force per length [N/m].
    """

    length: float
    preload: float
    rate: float


# Spring 1 is the softest; spring 2 is the default of the manufacturer.
SPRINGS: dict[int, SpringType] = {
    1: SpringType(1.00 * INCH, 0.85, 187.0),
    2: SpringType(1.25 * INCH, 1.33, 312.8),
    3: SpringType(1.25 * INCH, 1.78, 565.25),
}

# Distance from the axis along the arm [m].
HUB_ANCHORS: dict[str, float] = {"A": 1.25 * INCH, "B": 1.00 * INCH, "C": 0.75 * INCH}
ARM_ANCHORS: dict[int, float] = {1: 4.0 * INCH, 2: 3.5 * INCH, 3: 3.0 * INCH}


@known_arguments
def spring_stiffness(
    spring: int = 2, hub_anchor: str = "B", arm_anchor: int = 2, *, preload_only: bool = False
) -> float:
    """Stiffness of the joint at small deflections, from the geometry of the springs.

        K = 2 (rate R^2 r^2 / D + F (R d / sqrt(D) - R^2 r^2 / D^1.5))
        D = r^2 + (R - d)^2,   F = preload + rate (sqrt(D) - length)

    Not at deflections above about 0.1 rad, where the springs soften by a few per mille.

    Args:
        spring: 1, 2 or 3; see `SPRINGS`.
        hub_anchor: "A", "B" or "C".
        arm_anchor: 1, 2 or 3.
        preload_only: Take the preload as the whole force at the working length, as the manufacturer did
            before 2010.

    Returns:
        Stiffness [N m/rad].

    Raises:
        InputError: The setting does not exist.

    Source: Quanser, config_rotflex.m, 2010; with `preload_only` config_flexjoint.m, 2002.

    >>> round(spring_stiffness(2, "B", 2), 4)
    1.2485
    """
    spring, hub_anchor, arm_anchor = map(plain, (spring, hub_anchor, arm_anchor))
    for what, value, known in (
        ("spring", spring, SPRINGS),
        ("hub_anchor", hub_anchor, HUB_ANCHORS),
        ("arm_anchor", arm_anchor, ARM_ANCHORS),
    ):
        if not isinstance(value, str | int) or value not in known:
            raise InputError(
                f"{what} was given {shown(value)}, but the kit has {', '.join(map(repr, known))}; "
                "choose one of these."
            )
    kit, d, R, r = SPRINGS[spring], HUB_ANCHORS[hub_anchor], ARM_ANCHORS[arm_anchor], SIDE
    D = r**2 + (R - d) ** 2
    stretch = 0.0 if preload_only else kit.rate * (D**0.5 - kit.length)
    force = kit.preload + stretch
    return 2 * (kit.rate * (R * r) ** 2 / D + force * (R * d / D**0.5 - (R * r) ** 2 / D**1.5))


@known_arguments
def spring_settings() -> dict[tuple[int, str, int], float]:
    """Stiffness [N m/rad] of all 27 settings (spring, hub anchor, arm anchor)."""
    return {
        (spring, hub, arm): spring_stiffness(spring, hub, arm)
        for spring in SPRINGS
        for hub in HUB_ANCHORS
        for arm in ARM_ANCHORS
    }


PORTS = {"hub": (1.0, 0.0), "joint": (0.0, 1.0), "arm": (1.0, 1.0)}
SENSORS = {"theta": ("hub", "position"), "alpha": ("joint", "position"), "speed": ("hub", "speed")}
"""Sensors of a joint: name -> port and measured quantity."""
_BOTH = ("theta", "alpha")

# SRV02 in high gear: converted from oz in/A and V/kRPM; efficiency of the motor times that of the gearbox.
_TORQUE_CONSTANT = 1.088 * 0.2780139 * INCH
_BACK_EMF = 0.804e-3 * 60 / (2 * math.pi)
_EFFICIENCY = 0.69 * 0.90
_GEAR_RATIO = 70.0


@known_arguments
def flexible_joint(
    *,
    hub_inertia: float,
    arm_inertia: float,
    stiffness: float,
    motor: Motor,
    hub_damping: float = 0.0,
    joint_damping: float = 0.0,
    sensors: str | Sequence[str] = _BOTH,
) -> Mechanism:
    """A rotary flexible joint of any make: motor at the hub, spring between hub and arm.

        hub_inertia theta'' + arm_inertia (theta'' + alpha'') = motor - hub_damping theta'
        arm_inertia (theta'' + alpha'') = -stiffness alpha - joint_damping alpha'

    Angles and voltage determine torques only up to a common factor, so the inertia of the arm is trusted, and
    all parameters of the motor except its torque constant. The hub inertia, the stiffness, the torque
    constant and both dampers are free.

    If only the deflection is measured, four parameters describe all linear dynamics from voltage to
    deflection. A model without dry friction then leaves one combination of the five free parameters open, and
    they have no intervals. Friction at the hub determines this combination: when it holds the hub depends on
    the motion of the hub, which a wrong torque constant would scale.

    The free torque constant stands for its product with the efficiency, which is not known well. For a
    measured joint of the manufacturer the estimate is 0.0097 N m/A instead of 0.0077; with a back-EMF
    constant that follows it, the damping of the hub becomes negative. Therefore the two constants are tied
    only if the motor has `tied=True`. Otherwise the back-EMF constant is trusted, and the estimate of the
    hub damping states how it depends on the back-EMF constant.

    Args:
        hub_inertia: Inertia of hub, motor and gears, reflected to the hub [kg m^2].
        arm_inertia: Inertia of the arm [kg m^2].
        stiffness: Stiffness of the joint [N m/rad].
        motor: Motor with its gear.
        hub_damping: Viscous damping in addition to that of the motor [N m s/rad].
        joint_damping: Viscous damping of the deflection [N m s/rad].
        sensors: What is measured: `theta`, `alpha`, the `speed` of the hub; or several, as `"theta+alpha"`.

    Returns:
        Mechanism with these outputs.

    Raises:
        InputError: No sensor, an unknown sensor, or one sensor twice.

    Source: Lagrange's equations; Quanser, Rotary Flexible Joint workbook, 2011.
    """
    measured = _measured(sensors)
    instance(motor, Motor, "motor", "give rotflex_jax.effects.Motor('hub', ...)")
    held = [name for name in motor.values if name != "torque_constant"]
    return Mechanism(
        coordinates=("theta", "alpha"),
        ports=PORTS,
        effects=(
            Inertia(at="hub", inertia=hub_inertia),
            Inertia(at="arm", inertia=arm_inertia),
            Spring(at="joint", stiffness=stiffness),
            motor,
            Viscous(at="hub", coefficient=hub_damping),
            Viscous(at="joint", coefficient=joint_damping),
        ),
        outputs={sensor: SENSORS[sensor] for sensor in measured},
        trusted=("arm.inertia.inertia", *(f"{motor.at}.motor.{name}" for name in held)),
    )


def _measured(sensors: str | Sequence[str]) -> tuple[str, ...]:
    given = tuple(sensors.split("+")) if isinstance(sensors, str) else names(sensors, "sensors")
    if not given or not set(given) <= set(SENSORS) or len(set(given)) < len(given):
        raise InputError(
            f"Argument `sensors` must be one or several of {', '.join(map(repr, SENSORS))}, but is "
            f"{shown('+'.join(given))}; write for instance sensors='theta'."
        )
    return given


@known_arguments
def paper(
    *,
    hub_inertia: float = 0.0021,
    arm_inertia: float = 0.0059,
    stiffness: float = 1.61,
    torque_constant: float = 0.00767,
    back_emf: float = 0.00767,
    resistance: float = 2.6,
    gear_ratio: float = 70.0,
    efficiency: float = 1.0,
    inductance: float | None = None,
    hub_damping: float = 0.0,
    joint_damping: float = 0.0,
    tied: bool = False,
    sensors: str | Sequence[str] = _BOTH,
) -> Mechanism:
    """The joint of the paper "Nonlinear Identification of a Rotary Flexible Joint Experiment".

    By default there is no loss in the gear and no damping except that of the motor. Not for a module of the
    manufacturer's later series, whose arm is lighter and whose gear loses more than a third: use
    `quanser_2010`.

    Args:
        hub_inertia: Inertia of hub, motor and gears, reflected to the hub [kg m^2].
        arm_inertia: Inertia of the arm [kg m^2].
        stiffness: Stiffness of the joint [N m/rad].
        torque_constant: Torque constant of the motor [N m/A].
        back_emf: Back-EMF constant of the motor [V s/rad].
        resistance: Armature resistance [ohm].
        gear_ratio: Turns of the motor per turn of the hub.
        efficiency: Efficiency of motor and gear.
        inductance: Armature inductance [H], 0.18 mH according to the manufacturer; None for a current that
            follows the voltage at once.
        hub_damping: Viscous damping at the hub in addition to that of the motor [N m s/rad].
        joint_damping: Viscous damping of the deflection [N m s/rad].
        tied: Whether `back_emf` equals the torque constant, also in fits; for a known efficiency.
        sensors: Measured quantities; see `flexible_joint`.

    Returns:
        Mechanism with the outputs `theta` and `alpha`, or with the outputs of the given sensors.

    Source: Table of parameters of that paper; its stiffness is in N m/rad, not N/m as printed.

    >>> joint = paper(inductance=0.18e-3)
    >>> joint.channels
    ('theta', 'alpha')
    >>> paper(sensors="alpha").channels
    ('alpha',)
    """
    return flexible_joint(
        hub_inertia=hub_inertia,
        arm_inertia=arm_inertia,
        stiffness=stiffness,
        motor=Motor(
            at="hub",
            torque_constant=torque_constant,
            back_emf=back_emf,
            resistance=resistance,
            gear_ratio=gear_ratio,
            efficiency=efficiency,
            inductance=inductance,
            tied=tied,
        ),
        hub_damping=hub_damping,
        joint_damping=joint_damping,
        sensors=sensors,
    )


@known_arguments
def quanser_2002(
    arm: int = 2,
    *,
    spring: int = 2,
    hub_anchor: str = "B",
    arm_anchor: int = 2,
    inductance: float | None = None,
    tied: bool = False,
    sensors: str | Sequence[str] = _BOTH,
) -> Mechanism:
    """The joint of the manufacturer on an SRV02 servo, according to the manufacturer's files of 2002.

    These take the preload of the springs as their whole force, and assume little damping at the hub.

    Args:
        arm: Position of the short arm on the main arm: 1, 2 or 3 outwards, 0 for no short arm.
        spring: 1, 2 or 3; see `SPRINGS`.
        hub_anchor: "A", "B" or "C".
        arm_anchor: 1, 2 or 3.
        inductance: Armature inductance [H], or None.
        tied: Whether the back-EMF constant equals the torque constant, also in fits; for a known efficiency.
        sensors: Measured quantities; see `flexible_joint`.

    Returns:
        Mechanism with the outputs `theta` and `alpha`, or with the outputs of the given sensors.

    Source: Quanser, config_servo_exp.m and config_flexjoint.m, 2002.
    """
    stiffness = spring_stiffness(spring, hub_anchor, arm_anchor, preload_only=True)
    return _srv02(arm, stiffness, hub_damping=0.004, inductance=inductance, tied=tied, sensors=sensors)


@known_arguments
def quanser_2010(
    arm: int = 2,
    *,
    spring: int = 2,
    hub_anchor: str = "B",
    arm_anchor: int = 2,
    inductance: float | None = None,
    tied: bool = False,
    sensors: str | Sequence[str] = _BOTH,
) -> Mechanism:
    """The joint of the manufacturer on an SRV02 servo, according to the manufacturer's files of 2010.

    Args:
        arm: Position of the short arm on the main arm: 1, 2 or 3 outwards, 0 for no short arm.
        spring: 1, 2 or 3; see `SPRINGS`.
        hub_anchor: "A", "B" or "C".
        arm_anchor: 1, 2 or 3.
        inductance: Armature inductance [H], or None.
        tied: Whether the back-EMF constant equals the torque constant, also in fits; for a known efficiency.
        sensors: Measured quantities; see `flexible_joint`.

    Returns:
        Mechanism with the outputs `theta` and `alpha`, or with the outputs of the given sensors.

    Source: Quanser, config_srv02.m and config_rotflex.m, 2010.
    """
    stiffness = spring_stiffness(spring, hub_anchor, arm_anchor)
    return _srv02(arm, stiffness, hub_damping=0.015, inductance=inductance, tied=tied, sensors=sensors)


@known_arguments
def arm_inertia(arm: int = 2) -> float:
    """Moment of inertia [kg m^2] of the manufacturer's arm about the axis of the joint.

    The main arm has 64 g and 11.75 in. It is alone (0) or carries a short arm of 30 g and 6 in, whose centre
    is 9, 10 or 11 in from the axis (1, 2, 3).

    Source: Quanser, config_rotflex.m, 2010.

    >>> round(arm_inertia(2), 7)
    0.0038938
    """
    centres = {0: None, 1: 9 * INCH, 2: 10 * INCH, 3: 11 * INCH}
    arm = plain(arm)
    if not isinstance(arm, int) or arm not in centres:
        raise InputError(
            f"arm was given {shown(arm)}, but the short arm sits at 1, 2 or 3, or is left off (0); "
            "choose one of these."
        )
    main = 0.064 * (11.75 * INCH) ** 2 / 3
    centre = centres[arm]
    return main if centre is None else main + 0.030 * ((6 * INCH) ** 2 / 12 + centre**2)


@known_arguments
def hub_inertia(tachometer: bool = True, body: float = 0.0005) -> float:
    """Moment of inertia [kg m^2] of the manufacturer's servo and the body on it, reflected to the load shaft.

    Args:
        tachometer: Whether the motor has a tachometer.
        body: Inertia of the body on the load shaft; by default the body of the joint [kg m^2].

    Source: Quanser, config_servo_exp.m, 2002, and config_srv02.m, 2010, in high gear.

    >>> round(hub_inertia(), 8)
    0.00258418
    """
    disc = lambda mass, diameter: mass * (diameter / 2 * INCH) ** 2 / 2  # noqa: E731
    gears = disc(0.005, 0.5) + 2 * disc(0.030, 1.5) + disc(0.083, 2.5)
    # Rotor and tachometer, converted from oz in s^2.
    motor = (5.523e-5 + (1e-5 if tachometer else 0.0)) * 0.2780139 * INCH
    return gears + _GEAR_RATIO**2 * 0.90 * motor + body


def srv02_motor(inductance: float | None = None, *, tied: bool = False) -> Motor:
    """Motor and gear of the manufacturer's servo.

    Args:
        inductance: Armature inductance [H], or None.
        tied: Whether the back-EMF constant equals the torque constant, also in fits.

    Source: Quanser, config_srv02.m, 2010, in high gear.
    """
    return Motor(
        at="hub",
        torque_constant=_TORQUE_CONSTANT,
        back_emf=_BACK_EMF,
        resistance=2.6,
        gear_ratio=_GEAR_RATIO,
        efficiency=_EFFICIENCY,
        inductance=inductance,
        tied=tied,
    )


def _srv02(
    arm: int,
    stiffness: float,
    *,
    hub_damping: float,
    inductance: float | None,
    tied: bool,
    sensors: str | Sequence[str],
) -> Mechanism:
    return flexible_joint(
        hub_inertia=hub_inertia(),
        arm_inertia=arm_inertia(arm),
        stiffness=stiffness,
        motor=srv02_motor(inductance, tied=tied),
        hub_damping=hub_damping,
        sensors=sensors,
    )
