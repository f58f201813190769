"""Hobby servos with the position loop of their firmware: the input is a goal angle."""

import dataclasses
from typing import Literal, get_args

from rotflex_jax.checks import instance, known_arguments, number, one_of
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
from rotflex_jax.joints.arguments import known_number
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.quantity import Units

FREE_FALL = 9.80665
"""Standard acceleration of gravity [m/s^2]."""

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
"""Parameters of `PositionServo` and `PidServo` that the user or the firmware sets."""

ServoKind = Literal["xl330", "sts3215"]
METERS: dict[str, type[Memory]] = {"current": CurrentMeter, "duty": DutyMeter}
"""Reading of a servo -> the effect that provides it."""


@known_arguments
def position_servo(
    inertia: float = 0.005, *, servo: PositionLoop | None = None, weight: float = 0.0
) -> Mechanism:
    """A joint on a hobby servo, from goal angle to angle.

        inertia theta'' = servo(goal, theta, theta') - sine sin(theta) - cosine cos(theta)

    The parameters of the firmware are trusted, and so is the inertia: goal and angle determine torques only
    up to a common factor. Torque constant, resistance and both amplitudes of the weight are free. If the gain
    is not known, release it: stiffness, damping and largest torque then determine the three parameters.

    Args:
        inertia: Inertia of the joint with rotor and gear [kg m^2].
        servo: The servo with its firmware; None for a Dynamixel XL-330.
        weight: Start value of the torque of the weight when the angle is a quarter turn [N m].

    Returns:
        Mechanism with the output `theta` [rad] and the port `hub`; its input is the goal [rad].

    Source: Newton 1687; the servo as in `rotflex_jax.effects.PositionServo`.

    >>> position_servo().free_names[:2]
    ('hub.position_servo.torque_constant', 'hub.position_servo.resistance')
    """
    if servo is not None:
        instance(servo, PositionLoop, "servo", "give rotflex_jax.effects.PositionServo('hub', ...)")
    driven = dataclasses.replace(servo or PositionServo(), at="hub")
    return Mechanism(
        coordinates=("theta",),
        ports={"hub": (1.0,)},
        effects=(Inertia(at="hub", inertia=inertia), driven, Gravity(at="hub", sine=weight)),
        outputs={"theta": "hub"},
        trusted=(*(f"hub.{driven.name}.{n}" for n in FIRMWARE if n in driven.values), "hub.inertia.inertia"),
        units=Units(input="rad"),
    )


@known_arguments
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

    The weight is known and sets the scale of all torques. Therefore the inertia is free, as are the torque
    constant and the resistance. The cosine amplitude of the weight is free as well: it describes an encoder
    zero that is not at the lowest point. If the recording has the gain and the supply as constants, these
    values are used. The model has no friction; a fit of it attributes friction to the back-EMF.

    Args:
        mass: Mass at the end of the pendulum [kg].
        length: Length of the pendulum [m].
        gain: P gain of the firmware, for recordings without this constant.
        supply: Supply voltage, for recordings without this constant [V].
        rotor_inertia: Start value of the inertia of rotor and gear, at the output of the gear [kg m^2].

    Returns:
        Mechanism with the output `theta` [rad] and the port `hub`; its input is the goal [rad].

    Source: Duclusaud, Passault, Padois, Ly 2024, arXiv 2410.08650, section II.

    >>> xl330_pendulum().free_names[:3]
    ('hub.inertia.inertia', 'hub.position_servo.torque_constant', 'hub.position_servo.resistance')
    """
    mass = known_number(mass, "mass", above=0, unit="kg", example="0.49")
    length = known_number(length, "length", above=0, unit="m", example="0.1")
    rotor_inertia = known_number(rotor_inertia, "rotor_inertia", least=0, unit="kg m^2", example="0.002")
    return (
        position_servo(
            mass * length**2 + rotor_inertia,
            servo=PositionServo(gain=gain, supply=supply),
            weight=mass * FREE_FALL * length,
        )
        .release("hub.inertia.inertia")
        .trust("hub.gravity.sine")
    )


@known_arguments
def sts3215(
    inertia: float = 0.03,
    *,
    gain: float = 32.0,
    supply: float = 7.4,
    dead_band: float = 0.0,
    weight: float = 0.0,
) -> Mechanism:
    """A joint on a 7.4 V Feetech STS3215, a servo of arms such as the SO-101, from goal angle to angle.

        inertia theta'' = servo(goal, theta, theta') - sine sin(theta) - cosine cos(theta)

    This is `position_servo` with the duty per angle, the largest duty and the motor constants that were
    measured on such a servo. The P gain is a register of the servo, 32 when it is new; arms often have a
    lower gain. Not for a servo with a speed or acceleration limit, which plans a profile towards the goal.

    Args:
        inertia: Inertia of the joint with rotor and gear; the rotor alone, at the output of the gear, has
            0.028 [kg m^2].
        gain: P gain, register 21 of the servo.
        supply: Supply voltage [V].
        dead_band: Error up to which the servo does not react [rad]; a count is 1.53 mrad.
        weight: Start value of the torque of the weight when the angle is a quarter turn [N m].

    Returns:
        Mechanism with the output `theta` [rad] and the port `hub`; its input is the goal [rad].

    Source: Duclusaud, Passault, Padois, Ly 2024, arXiv 2410.08650, and the values of this servo published
        with it: 0.166 duty per radian and unit of the gain, at most 0.97, measured with an oscilloscope;
        torque constant, resistance and rotor as fitted there with model M1.

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


@known_arguments
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
    """A joint on a servo of a known kind, with the readings of its log as outputs, driven by a goal angle.

        inertia theta'' = servo(goal, theta, theta') - sine sin(theta) - cosine cos(theta)

    This is `position_servo` with the constants of the kind; with an I gain the loop is a `PidServo`. The
    parameter `enabled` exists too: a stretch of a log in which the torque is off is a separate recording with
    `constants={"hub.position_servo.enabled": 0.0}` (or `hub.pid_servo.enabled`). Not for a servo with a speed
    or acceleration limit, which plans a profile towards its goal.

    The gains are the values in the registers of the servo. For the XL-330, the ratios of the three gains come
    from the manual, and the size comes from the P gain that logs show, half of the value in the manual. For
    the STS3215 the P gain was measured; I and D gain are given as duty per error and second, and per speed.

    Args:
        kind: "xl330", a Dynamixel XL-330; "sts3215", a Feetech STS3215 of 7.4 V.
        inertia: Inertia of the joint with rotor and gear [kg m^2]; None for a bare arm of that size.
        gain: P gain; the factory value, 400 or 32, if None.
        integral: I gain, or None: in counts of the register for the XL-330, else [1/(rad s)].
        derivative: D gain, or None: in counts of the register for the XL-330, else [s/rad].
        dead_band: Error up to which the servo does not react [rad], or None.
        supply: Supply voltage [V].
        source_resistance: Resistance of supply and cable [ohm], or None.
        weight: Start value of the torque of the weight when the angle is a quarter turn [N m].
        sensors: Readings in the log: "theta", "theta+current" [A], "theta+duty" or "theta+current+duty".

    Returns:
        Mechanism with these outputs and the port `hub`; its input is the goal [rad].

    Raises:
        InputError: The kind or the sensors are not among these.

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
        # With the error e in counts at each period:
        # duty = (P e / 256 + I sum(e) / 131072 - D change / 32) / 885.
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
