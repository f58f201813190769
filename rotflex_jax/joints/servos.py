"""Hobby servos under the position loop of their firmware: the input is a goal angle."""

import dataclasses
from typing import Literal, get_args

from rotflex_jax.checks import number, one_of
from rotflex_jax.effects import (
    CurrentMeter,
    DutyMeter,
    Gravity,
    Inertia,
    PidServo,
    PositionLoop,
    PositionServo,
)
from rotflex_jax.effects.base import Memory
from rotflex_jax.effects.motor import DYNAMIXEL_GAIN_SCALE
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.quantity import Units

FREE_FALL = 9.80665
"""Acceleration of free fall [m/s^2]."""

FIRMWARE = (
    "gain",
    "gain_scale",
    "limit",
    "supply",
    "period",
    "derivative",
    "dead_band",
    "source_resistance",
    "enabled",
    "integral",
    "anti_windup",
)
"""Parameters of `PositionServo` and `PidServo` that their user or the firmware has set."""

ServoKind = Literal["xl330", "sts3215"]
METERS: dict[str, type[Memory]] = {"current": CurrentMeter, "duty": DutyMeter}
"""Reading of a servo -> the effect that shows it."""


def position_servo(
    inertia: float = 0.005, *, servo: PositionLoop | None = None, weight: float = 0.0
) -> Mechanism:
    """A joint on a hobby servo, from goal angle to angle.

        inertia theta'' = servo(goal, theta, theta') - sine sin(theta) - cosine cos(theta)

    The firmware is trusted, and so is the inertia: goal and angle determine torques only up to a common
    factor. Torque constant, resistance and both amplitudes of the weight are free. Where the gain is not
    known, release it: stiffness, damping and largest torque are three numbers for three.

    Args:
        inertia: Of the joint with rotor and gear [kg m^2].
        servo: The servo with its firmware; None for a Dynamixel XL-330.
        weight: Torque of the weight when the angle is a quarter turn, where to start [N m].

    Returns:
        Mechanism with the output `theta` [rad] and the port `hub`; its input is the goal [rad].

    Source: Newton 1687; the servo as in `rotflex_jax.effects.PositionServo`.

    >>> position_servo().free_names[:2]
    ('hub.position_servo.torque_constant', 'hub.position_servo.resistance')
    """
    driven = dataclasses.replace(servo or PositionServo(), at="hub")
    return Mechanism(
        coordinates=("theta",),
        ports={"hub": (1.0,)},
        effects=(Inertia(at="hub", inertia=inertia), driven, Gravity(at="hub", sine=weight)),
        outputs={"theta": "hub"},
        trusted=(*(f"hub.{driven.name}.{n}" for n in FIRMWARE if n in driven.values), "hub.inertia.inertia"),
        units=Units(input="rad"),
    )


def xl330_pendulum(
    mass: float = 0.49,
    length: float = 0.1,
    *,
    gain: float = 400.0,
    supply: float = 7.4,
    rotor_inertia: float = 0.002,
) -> Mechanism:
    """A Dynamixel XL-330 with a pendulum on its shaft, from goal angle to angle, zero at the lowest point.

        (mass length^2 + rotor_inertia) theta'' = servo(goal, theta, theta') - mass g length sin(theta)

    The weight is known and sets the scale of all torques, so the inertia is free beside torque constant and
    resistance, and so is the cosine of the weight, by which the zero of the encoder may be off the lowest
    point. Gain and supply follow the recording where it knows them. Friction is not in it: without any, a
    fit takes it for back-EMF.

    Args:
        mass: At the end of the pendulum [kg].
        length: Of the pendulum [m].
        gain: P gain of the firmware, where a recording does not know it.
        supply: Supply voltage, where a recording does not know it [V].
        rotor_inertia: Of rotor and gear, seen behind the gear, where to start [kg m^2].

    Returns:
        Mechanism with the output `theta` [rad] and the port `hub`; its input is the goal [rad].

    Source: Duclusaud, Passault, Padois, Ly 2024, arXiv 2410.08650, section II.

    >>> xl330_pendulum().free_names[:3]
    ('hub.inertia.inertia', 'hub.position_servo.torque_constant', 'hub.position_servo.resistance')
    """
    return (
        position_servo(
            mass * length**2 + rotor_inertia,
            servo=PositionServo(gain=gain, supply=supply),
            weight=mass * FREE_FALL * length,
        )
        .release("hub.inertia.inertia")
        .trust("hub.gravity.sine")
    )


def sts3215(
    inertia: float = 0.03,
    *,
    gain: float = 32.0,
    supply: float = 7.4,
    dead_band: float = 0.0,
    weight: float = 0.0,
) -> Mechanism:
    """A joint on a Feetech STS3215 of 7.4 V, as arms like the SO-101 have, from goal angle to angle.

        inertia theta'' = servo(goal, theta, theta') - sine sin(theta) - cosine cos(theta)

    `position_servo` with the duty per angle, the largest duty and the motor that were measured at such a
    servo. The P gain is a register of the servo, 32 when it is new; arms often have less. Not with a speed or
    acceleration limit set in the servo, which plans a profile towards the goal.

    Args:
        inertia: Of the joint with rotor and gear; that of the rotor behind the gear is 0.028 [kg m^2].
        gain: P gain, register 21 of the servo.
        supply: Supply voltage [V].
        dead_band: Error that the servo takes for none [rad]; a count is 1.53 mrad.
        weight: Torque of the weight when the angle is a quarter turn, where to start [N m].

    Returns:
        Mechanism with the output `theta` [rad] and the port `hub`; its input is the goal [rad].

    Source: Duclusaud, Passault, Padois, Ly 2024, arXiv 2410.08650, and the numbers of this servo published
        with it: 0.166 duty per radian and unit of the gain, at most 0.97, by an oscilloscope; torque
        constant, resistance and rotor as fitted there by model M1.

    >>> round(sts3215(gain=16).effect("position_servo", "hub").stamp().stiffness, 2)
    8.87
    """
    servo = PositionServo(
        gain=gain,
        gain_scale=0.166,
        limit=0.97,
        supply=supply,
        torque_constant=1.21,
        resistance=2.68,
        dead_band=dead_band or None,
    )
    return position_servo(inertia, servo=servo, weight=weight)


def servo(
    kind: ServoKind = "xl330",
    inertia: float | None = None,
    *,
    gain: float | None = None,
    integral: float | None = None,
    derivative: float | None = None,
    dead_band: float | None = None,
    supply: float = 7.4,
    source_resistance: float | None = None,
    weight: float = 0.0,
    sensors: str = "theta",
) -> Mechanism:
    """A joint on a servo of a known kind, with what its log has, from goal angle to angle.

        inertia theta'' = servo(goal, theta, theta') - sine sin(theta) - cosine cos(theta)

    `position_servo` with the numbers of the kind; with an I gain the loop is a `PidServo`. The parameter
    `enabled` is there too: a stretch of a log in which the torque is off is a recording of its own, with
    `constants={"hub.position_servo.enabled": 0.0}` (`hub.pid_servo.enabled`). Not with a speed or
    acceleration limit set in the servo, which plans a profile towards its goal.

    The gains are those that the servo's registers have. For the XL-330 the manual's ratios of the three gains
    and the size that logs show for the P gain are taken, half of the manual's; for the STS3215 the P gain was
    measured, and I and D gain are the duty per error and second, or per speed, that the caller says.

    Args:
        kind: "xl330", a Dynamixel XL-330; "sts3215", a Feetech STS3215 of 7.4 V.
        inertia: Of the joint with rotor and gear [kg m^2]; None for a bare arm of that size.
        gain: P gain, as new if None: 400 and 32.
        integral: I gain, or None: in counts of the register for the XL-330, else [1/(rad s)].
        derivative: D gain, or None: in counts of the register for the XL-330, else [s/rad].
        dead_band: Error that the servo takes for none [rad], or None.
        supply: Supply voltage [V].
        source_resistance: Of supply and cable [ohm], or None.
        weight: Torque of the weight when the angle is a quarter turn, where to start [N m].
        sensors: What the log has: "theta", "theta+current" [A], "theta+duty" or "theta+current+duty".

    Returns:
        Mechanism with these outputs and the port `hub`; its input is the goal [rad].

    Raises:
        InputError: Another kind, or sensors that are none of these.

    Source: Robotis, XL330-M288-T e-manual, control tables 80 to 84; else as `xl330_pendulum` and `sts3215`.

    >>> servo("sts3215", gain=16, sensors="theta+current").channels
    ('theta', 'current')
    >>> servo("xl330", integral=100).effect("pid_servo", "hub").values["integral"] > 0
    True
    """
    one_of(kind, "kind", get_args(ServoKind))
    combined = ("theta", "theta+current", "theta+duty", "theta+current+duty")
    channels = one_of(sensors, "sensors", combined).split("+")
    if kind == "xl330":
        preset = position_servo(0.005 if inertia is None else inertia, weight=weight)
        # By error in counts and periods: duty = P e / 256 + I sum(e) / 131072 - D change / 32, over 885.
        per_sum, per_change = DYNAMIXEL_GAIN_SCALE / (512 * 1e-3), 8 * DYNAMIXEL_GAIN_SCALE * 1e-3
        if integral is not None:
            integral = per_sum * number(integral, "integral", least=0, example="100")
        if derivative is not None:
            derivative = per_change * number(derivative, "derivative", least=0, example="100")
    else:
        preset = sts3215(0.03 if inertia is None else inertia, weight=weight)
    known = preset.effect("position_servo", "hub").values | {"supply": supply, "enabled": 1.0}
    given = {"gain": gain, "derivative": derivative, "dead_band": dead_band, "integral": integral}
    given["source_resistance"] = source_resistance
    known |= {name: value for name, value in given.items() if value is not None}
    law = PidServo if integral is not None else PositionServo
    driven = law(at="hub", **known)
    machine = position_servo(preset.effect("inertia", "hub").values["inertia"], servo=driven, weight=weight)
    shown = [METERS[c]("hub") for c in channels if c in METERS]
    return dataclasses.replace(
        machine,
        effects=(*machine.effects, *shown),
        outputs={c: ("hub", c) if c in METERS else "hub" for c in channels},
        trusted=machine.trusted | {f"hub.{e.name}.time" for e in shown},
    )
