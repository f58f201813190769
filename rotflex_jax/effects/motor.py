"""The motor: driven by voltage or by current, its heating and saturation, the position loop of a servo.

The meters that show a motor's current and duty are here as well.
"""

import dataclasses
import math
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.base import (
    Drive,
    Force,
    Linear,
    Memory,
    Probe,
    Scalar,
    Scale,
    Stamp,
    StatePart,
    register,
    within,
)
from rotflex_jax.errors import InputError
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Motor(Linear):
    """A voltage-driven direct-current motor behind a gear, with back-EMF.

        tau = efficiency torque_constant gear_ratio i
        inductance di/dt = v - resistance i - back_emf gear_ratio speed

    Without an inductance the current follows the voltage immediately. Not for a motor on a current
    amplifier, whose torque does not depend on the back-EMF (`current_drive`).

    In SI units the torque constant and the back-EMF constant of a motor are equal. `tied` keeps them equal: a
    fit of the torque constant then also changes the back-EMF constant. Do not tie them if the efficiency is a
    guess: the fitted torque constant then also contains the true losses of the gear, and the back-EMF
    constant would follow it away from its true value.

    Args:
        at: Port that the gear drives.
        torque_constant: Torque at the motor shaft per current [N m/A].
        back_emf: Voltage per speed of the motor shaft [V s/rad].
        resistance: Armature resistance [ohm].
        gear_ratio: Turns of the motor per turn of the port [-].
        efficiency: Efficiency of motor and gear together, 1 without losses [-].
        inductance: Armature inductance [H], or None.
        tied: Whether `back_emf` always equals the torque constant, whatever value is given for it.

    Raises:
        InputError: If `tied` is not True or False, or a value is out of its bounds.

    Source: Quanser, SRV02 user manual, 2011, table 3.1 and the section on modelling.
    """

    name: ClassVar[str] = "motor"
    title: ClassVar[str] = "direct-current motor"
    equation: ClassVar[str] = (
        "tau = efficiency * torque_constant * gear_ratio * i, "
        "inductance * di/dt = v - resistance * i - back_emf * gear_ratio * speed"
    )
    amplitudes: ClassVar[tuple[str, ...]] = ("torque_constant",)
    motor: ClassVar[bool] = True
    has_current: ClassVar[bool] = True

    at: str = "hub"
    torque_constant: float = parameter(0.00767, unit="N m/A", lower=0.0, meaning="torque per current")
    back_emf: float = parameter(0.00767, unit="V s/rad", lower=0.0, meaning="voltage per speed")
    resistance: float = parameter(2.6, unit="ohm", lower=1e-6, meaning="armature resistance")
    gear_ratio: float = parameter(70.0, unit="", lower=0.0, meaning="motor turns per load turn")
    efficiency: float = parameter(
        1.0, unit="", lower=0.0, physical=(0.0, 1.0), meaning="efficiency of motor and gear"
    )
    inductance: float | None = parameter(
        None, unit="H", typical=2e-4, lower=1e-9, meaning="armature inductance"
    )

    tied: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.tied, bool):
            raise InputError(
                f"Motor was given tied={self.tied!r}, but it needs True or False; say whether the back-EMF "
                "constant is the torque constant."
            )
        if self.tied:
            object.__setattr__(self, "back_emf", self.torque_constant)
        super().__post_init__()

    @property
    def follows(self) -> dict[str, str]:
        """The back-EMF constant follows the torque constant, if they are tied."""
        return {"back_emf": "torque_constant"} if self.tied else {}

    @property
    def torque_per_current(self) -> Scalar:
        """Torque at the port per armature current [N m/A]."""
        return self.efficiency * self.torque_constant * self.gear_ratio

    @property
    def order(self) -> int:
        """One state, the current, if there is an inductance; otherwise none."""
        return 0 if self.inductance is None else 1

    def stamp(self) -> Stamp:
        """Entries of the equations of motion."""
        gain = self.efficiency * self.torque_constant * self.gear_ratio
        emf = self.back_emf * self.gear_ratio
        if self.inductance is None:
            return Stamp(drive=gain / self.resistance, damping=gain * emf / self.resistance)
        return Stamp(
            own=((-self.resistance / self.inductance,),),
            from_speed=(-emf / self.inductance,),
            from_voltage=(1.0 / self.inductance,),
            torque=(gain,),
        )

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        gain = self.torque_per_current / self.resistance
        speed = math.inf if self.back_emf == 0 else 1 / (self.back_emf * self.gear_ratio)
        return (
            f"the motor gives the {self.at} {gain:.3g} N m per volt at rest and runs free at "
            f"{speed:.3g} rad/s per volt"
        )


@register
@dataclasses.dataclass(frozen=True)
class CurrentDrive(Linear):
    """A motor on a current amplifier: torque proportional to the command, without back-EMF.

        tau = gain v

    Not for a motor on a voltage amplifier, where the back-EMF brakes the motor: use `Motor`.

    Args:
        at: Port that the motor drives.
        gain: Torque per command [N m/V].

    Source: M. W. Spong, S. Hutchinson and M. Vidyasagar, Robot Modeling and Control, 2006, section 6.1.
    """

    name: ClassVar[str] = "current_drive"
    title: ClassVar[str] = "motor on a current amplifier"
    equation: ClassVar[str] = "tau = gain * v"
    volts_of_input: ClassVar[bool] = True
    amplitudes: ClassVar[tuple[str, ...]] = ("gain",)
    motor: ClassVar[bool] = True

    at: str = "hub"
    gain: float = parameter(0.1, unit="N m/V", lower=0.0, meaning="torque per command")

    def stamp(self) -> Stamp:
        """Entries of the equations of motion."""
        return Stamp(drive=self.gain)

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return f"the drive gives the {self.at} {self.gain:.3g} N m/V"


@register
@dataclasses.dataclass(frozen=True)
class Heating(Memory):
    """The resistance of the armature rises with its temperature: `R` becomes `R (1 + rate z)`.

        dz/dt = m^2 / (1 + rate z) - z / time,    tau = -rate z / (1 + rate z) m

    `z` is the heat of the armature in (N m)^2 s, zero for the cold motor. `m` is the torque that the cold
    motor would give at this port, so `tau` is the lost torque. Without current the motor cools with the time
    constant `time`. A recording that is much shorter than `time` does not determine `time`. Not for a
    recording in which `z` hardly varies: the loss is then equivalent to a lower torque constant.

    Args:
        at: Port of the motor.
        rate: Relative rise of the resistance per second and squared torque [1/((N m)^2 s)].
        time: Time constant of cooling [s].

    Source: First-order thermal model of an armature; J. F. Gieras, Permanent Magnet Motor
    Technology, 3rd ed., 2010, section 8.4.
    """

    name: ClassVar[str] = "heating"
    title: ClassVar[str] = "motor heating"
    equation: ClassVar[str] = (
        "dz/dt = m**2 / (1 + rate * z) - z / time, tau = -rate * z / (1 + rate * z) * m, "
        "m torque of the cold motor"
    )
    ports: ClassVar[tuple[str, ...]] = ("hub",)
    amplitudes: ClassVar[tuple[str, ...]] = ("rate",)
    driven_by: ClassVar[Drive] = "motor"
    searched: ClassVar[tuple[str, ...]] = ("hub",)

    rate: float = parameter(0.5, unit="1/((N m)^2 s)", lower=0.0, meaning="rise of the resistance by heat")
    time: float = parameter(30.0, unit="s", lower=1e-2, meaning="time constant of cooling")

    def flow(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Time derivative of the state [(N m)^2]."""
        return drive * drive / (1 + self.rate * z) - z / self.time

    def force(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        return -self.rate * z / (1 + self.rate * z) * drive

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test at each of two time constants of cooling."""
        return [[{"rate": 0.01 / scale.torque**2, "time": time}] for time in (10.0, 100.0)]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return (
            f"the motor at the {self.at} warms up: its resistance rises by {self.rate:.3g} per second and "
            f"(N m)^2 of torque, and cools with a time constant of {self.time:.3g} s"
        )


@register
@dataclasses.dataclass(frozen=True)
class TorqueSaturation(Force):
    """The torque of a motor grows less than in proportion to its current: `m` becomes `m / (1 + loss |m|)`.

        tau = -loss |m| / (1 + loss |m|) m

    `m` is the torque at this port that the motor would give without saturation, in proportion to its current,
    and `tau` is the lost torque. It depends on the current and not on the speed, so a reversal of the motion
    alone does not change it. Small torques are nearly equal to `m`; at `m = 1 / loss` half of `m` is lost,
    and the remaining torque stays below `1 / loss`. The causes are that the iron of a small motor saturates
    and that the field of the armature weakens the main field. Not for a motor that runs at one level of
    torque, where the loss is equivalent to a lower torque constant.

    Args:
        at: Port of the motor.
        loss: Relative loss of torque per torque without saturation [1/(N m)].

    Source: A. E. Fitzgerald, C. Kingsley and S. D. Umans, Electric Machinery, 6th ed., 2003, section 7.3, on
        the effect of the armature's field. The formula is the simplest with one parameter and a limit.
    """

    name: ClassVar[str] = "torque_saturation"
    title: ClassVar[str] = "saturating torque of the motor"
    equation: ClassVar[str] = (
        "tau = -loss * |m| / (1 + loss * |m|) * m, m torque of the motor in proportion to its current"
    )
    ports: ClassVar[tuple[str, ...]] = ("hub",)
    amplitudes: ClassVar[tuple[str, ...]] = ("loss",)
    driven_by: ClassVar[Drive] = "motor"
    # A motor that only accelerates an inertia is rarely at a large torque for long.
    searched: ClassVar[tuple[str, ...]] = ("loaded",)

    loss: float = parameter(0.5, unit="1/(N m)", lower=0.0, meaning="relative loss of torque per torque")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port; the last argument is the torque in proportion to the current [N m]."""
        share = self.loss * jnp.abs(jnp.asarray(voltage))
        return -share / (1 + share) * voltage

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test."""
        return [[{"loss": 0.1 / scale.torque}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        half = 1 / max(self.loss, 1e-12)
        return (
            f"the torque of the motor at the {self.at} grows less than in proportion to its current: half of "
            f"it is lost where that would give {half:.3g} N m"
        )


DYNAMIXEL_GAIN_SCALE = 4096 / (2 * math.pi) / (256 * 885)
"""Duty per radian of error and per unit of the P gain of a Dynamixel X [1/rad]: counts of the encoder per
radian, divided by 256 (the divisor of the gain) and by 885 (the counts of full duty). The logged duty of an
XL-330 agrees to 0.3 %; its manual gives the divisor 128."""


@dataclasses.dataclass(frozen=True)
class PositionLoop(Linear):
    """Common base class of servos under a position loop: motor, settings of the firmware, limit of the duty.

    The class itself is no effect. `PositionServo` has a P gain and optionally a D gain, `PidServo` also has
    an I gain.
    """

    amplitudes: ClassVar[tuple[str, ...]] = ("torque_constant",)
    motor: ClassVar[bool] = True
    has_current: ClassVar[bool] = True
    has_duty: ClassVar[bool] = True
    exact_step: ClassVar[bool] = False

    at: str = "hub"
    gain: float = parameter(400.0, unit="", lower=0.0, meaning="P gain of the firmware")
    gain_scale: float = parameter(
        DYNAMIXEL_GAIN_SCALE, unit="1/rad", lower=0.0, meaning="duty per angle for a gain of one"
    )
    limit: float = parameter(1.0, unit="", lower=0.0, physical=(0.0, 1.0), meaning="largest duty")
    supply: float = parameter(7.4, unit="V", lower=0.0, meaning="supply voltage")
    period: float = parameter(1e-3, unit="s", lower=0.0, meaning="control period of the firmware")
    torque_constant: float = parameter(
        0.35, unit="N m/A", lower=0.0, meaning="torque per current, voltage per speed"
    )
    resistance: float = parameter(3.4, unit="ohm", lower=1e-6, meaning="armature resistance")
    derivative: float | None = parameter(
        None, unit="s/rad", typical=0.05, lower=0.0, meaning="duty per speed of the D gain"
    )
    dead_band: float | None = parameter(
        None, unit="rad", typical=0.003, lower=0.0, meaning="error that the firmware takes for none"
    )
    source_resistance: float | None = parameter(
        None, unit="ohm", typical=0.3, lower=0.0, meaning="resistance of supply and cable"
    )
    enabled: float | None = parameter(
        None,
        unit="",
        typical=1.0,
        lower=0.0,
        physical=(0.0, 1.0),
        meaning="1 where the torque is on, 0 where it is off",
    )

    @property
    def further_parts(self) -> tuple[str, ...]:
        """Optional parts that were given and that most servos lack, as texts with their sizes."""
        declared = self.declared()
        names = ("derivative", "dead_band", "source_resistance", "integral")
        parts = {n: self.values.get(n) for n in names}
        said = [f"{n} of {v:.4g} {declared[n].unit}" for n, v in parts.items() if v]
        return (*said, *(["torque that is off"] if self.enabled == 0 else []))

    @property
    def torque_per_current(self) -> Scalar:
        """Torque at the port per armature current [N m/A]."""
        return self.torque_constant

    @property
    def _torque_per_volt(self) -> Scalar:
        """Torque at rest per voltage of the armature [N m/V]; zero where the torque is off."""
        found = self.torque_constant / self.resistance
        return found if self.enabled is None else self.enabled * found

    @property
    def _torque_per_duty(self) -> Scalar:
        """Torque at rest per duty [N m]."""
        return self._torque_per_volt * self.supply

    def stamp(self) -> Stamp:
        """Entries of the equations of motion below the limit, without an I gain."""
        stiffness = self._torque_per_duty * self.gain * self.gain_scale
        braking = self._torque_per_volt * self.torque_constant - stiffness * self.period / 2
        if self.derivative is not None:
            braking = braking + self._torque_per_duty * self.derivative
        return Stamp(stiffness=stiffness, drive=stiffness, damping=braking)

    def _error(self, position: Scalar, speed: Scalar, goal: Scalar) -> Scalar:
        """Goal less the angle that the firmware uses, on average half a control period old [rad]."""
        return goal - position + self.period / 2 * speed

    def _counted(self, error: Scalar) -> Scalar:
        """Part of an error beyond the dead band of the firmware [rad]."""
        return error if self.dead_band is None else error - within(error, -self.dead_band, self.dead_band)

    def _wanted(self, position: Scalar, speed: Scalar, goal: Scalar) -> tuple[Scalar, Scalar]:
        """Duty of P and D gain before the limit: first of the linear loop, then with the dead band."""
        error = self._error(position, speed, goal)
        linear = wanted = self.gain * self.gain_scale * error
        if self.dead_band is not None:
            wanted = self.gain * self.gain_scale * self._counted(error)
        if self.derivative is not None:
            linear, wanted = linear - self.derivative * speed, wanted - self.derivative * speed
        return linear, wanted

    def duty(self, position: Scalar, speed: Scalar, goal: Scalar, integral: Scalar | None = None) -> Scalar:
        """Duty that the firmware gives, zero with the torque off; `integral` is the duty of the I gain."""
        wanted = self._wanted(position, speed, goal)[1]
        given = within(wanted if integral is None else wanted + integral, -self.limit, self.limit)
        return given if self.enabled is None else self.enabled * given

    def _beyond(
        self, position: Scalar, speed: Scalar, goal: Scalar, integral: Scalar | None = None
    ) -> Scalar:
        """Torque [N m] by which the motor differs from the linear loop."""
        linear, wanted = self._wanted(position, speed, goal)
        before = wanted if integral is None else wanted + integral
        # The effect of the limit as a difference: below the limit it is exactly zero, without rounding.
        off = within(before, -self.limit, self.limit) - before
        if self.dead_band is not None:
            off = off + (wanted - linear)
        if integral is not None:
            off = off + integral
        if self.source_resistance is None:
            return self._torque_per_duty * off
        duty = linear + off
        share = self.source_resistance / self.resistance * duty
        supply = (self.supply + share * self.torque_constant * speed) / (1 + share * duty)
        return self._torque_per_volt * ((supply - self.supply) * duty + self.supply * off)

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        stall = self._torque_per_duty * self.limit
        speed = math.inf if self.torque_constant == 0 else self.supply * self.limit / self.torque_constant
        return (
            f"the servo holds the {self.at} at its goal with {self.stamp().stiffness:.3g} N m/rad, gives up "
            f"to {stall:.3g} N m at rest and runs free at {speed:.3g} rad/s"
        )


@register
@dataclasses.dataclass(frozen=True)
class PositionServo(PositionLoop, Force):
    """A motor behind a gear under the position loop of its firmware; the input is the goal angle.

        duty = min(max(gain gain_scale (goal - (position - period / 2 speed)), -limit), limit)
        tau = torque_constant / resistance (supply duty - torque_constant speed)

    and with the optional parts, which are omitted unless they are given

        duty = min(max(gain gain_scale band(goal - ...) - derivative speed, -limit), limit),
        band(e) = 0 for |e| <= dead_band,  e - dead_band sign(e) beyond
        supply - source_resistance duty i  in the place of the supply,  i the current of the armature
        enabled tau  in the place of tau

    Angle, speed and torque are quantities of the output shaft, so the torque constant contains the gear ratio
    and also determines the back-EMF. The firmware computes the duty from the angle once in every period and
    holds it, so on average the duty is half a period late. The model contains this delay to first order: it
    reduces the damping, which a fit would otherwise attribute to a smaller back-EMF. The quantisation of the
    angle is neglected, since the steps that it causes in the torque are far below friction. The D gain acts
    on the measured speed alone, since a goal that is held between samples has no speed. Not for a servo with
    an I gain, or for a servo that plans a profile towards its goal.

    While the duty is below its limit, the loop is linear and the step integrates it exactly. At the limit the
    step subtracts a torque, by the rule for smooth torques. There the step must be short compared with the
    loop: `Ts sqrt(stiffness / inertia)` below 0.15 gives errors of about one count of an encoder, with the
    stiffness `torque_constant / resistance * supply * gain * gain_scale`. Above 0.15 use
    `Exponential(order=4)` or `substeps`.

    Gain, limit and supply are known, and the gain may differ between recordings (`Recording.constants`).
    A motion under a known load identifies torque constant and resistance; with viscous damping at the same
    port only if the damping is known, since back-EMF and damping add up.

    Args:
        at: Port that the servo drives.
        gain: P gain of the firmware, in its own unit.
        gain_scale: Duty per angle for a gain of one [1/rad].
        limit: Largest duty, 1 for the whole supply [-].
        supply: Supply voltage [V].
        period: Control period of the firmware [s].
        torque_constant: Torque per current, equal to voltage per speed [N m/A].
        resistance: Armature resistance [ohm].
        derivative: Duty per speed that the D gain subtracts [s/rad], or None.
        dead_band: Largest error of the angle that the firmware ignores [rad], or None.
        source_resistance: Resistance of supply and cable, which lowers the voltage under load [ohm], or None.
        enabled: 1 where the torque is on, 0 where it is off; None for a servo whose torque is always on.

    Source: Duclusaud, Passault, Padois, Ly 2024, Extended friction models for the physics simulation of
        servo actuators, arXiv 2410.08650, section II; Robotis, XL330-M288-T e-manual, control tables 84 and
        124.
    """

    name: ClassVar[str] = "position_servo"
    title: ClassVar[str] = "motor under a position loop"
    equation: ClassVar[str] = (
        "tau = torque_constant / resistance * (supply * duty - torque_constant * speed), "
        "duty = min(max(gain * gain_scale * (v - position + period / 2 * speed), -limit), limit); where "
        "given, dead_band off the error, derivative * speed off the duty, source_resistance * duty * current "
        "off the supply, enabled times tau"
    )

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] by which the motor differs from the linear loop; `voltage` is the goal [rad]."""
        return self._beyond(position, speed, voltage)


@register
@dataclasses.dataclass(frozen=True)
class PidServo(PositionLoop, Memory):
    """A motor behind a gear under a PID loop of its firmware; the input is the goal angle.

        wanted = gain gain_scale band(e) - derivative speed + z
        e = goal - (position - period / 2 speed)
        duty = min(max(wanted, -limit), limit)
        dz/dt = integral band(e) - anti_windup (wanted - duty)

    The motor, `band` and the other optional parts are those of `PositionServo`; `enabled` multiplies `dz/dt`
    too. The state `z` is the duty of the I gain. While the duty is at its limit, the duty beyond the limit is
    fed back to the integral (back-calculation), as in the firmware of a Dynamixel X. Its manual shows an
    anti-windup gain without a value: release `anti_windup` if a log reaches the limit. A large value keeps
    the integral from growing at the limit.

    The step treats the I part as a torque that is linear in time over the step; the rest of the loop is exact
    below the limit. Not for a servo without an I gain: `PositionServo` has one state less.

    Args:
        at: Port that the servo drives.
        gain: P gain of the firmware, in its own unit.
        gain_scale: Duty per angle for a gain of one [1/rad].
        limit: Largest duty, 1 for the whole supply [-].
        supply: Supply voltage [V].
        period: Control period of the firmware [s].
        torque_constant: Torque per current, equal to voltage per speed [N m/A].
        resistance: Armature resistance [ohm].
        derivative: Duty per speed that the D gain subtracts [s/rad], or None.
        dead_band: Largest error of the angle that the firmware ignores [rad], or None.
        source_resistance: Resistance of supply and cable, which lowers the voltage under load [ohm], or None.
        enabled: 1 where the torque is on, 0 where it is off; None for a servo whose torque is always on.
        integral: Duty per error and second of the I gain [1/(rad s)].
        anti_windup: Rate of the back-calculation, which reduces the integral at the limit [1/s].

    Source: Robotis, XM430-W210 e-manual, section on the position PID gains (control tables 80, 82, 84, and
        the anti-windup gain K_a); K. J. Astrom and T. Hagglund, PID Controllers, 2nd ed., 1995, section 3.5.
    """

    name: ClassVar[str] = "pid_servo"
    title: ClassVar[str] = "motor under a PID position loop"
    equation: ClassVar[str] = (
        "tau = torque_constant / resistance * (supply * duty - torque_constant * speed), "
        "duty = min(max(wanted, -limit), limit), wanted = gain * gain_scale * e + z, "
        "e = v - position + period / 2 * speed, dz/dt = integral * e - anti_windup * (wanted - duty), "
        "where given, dead_band off e, derivative * speed off wanted, source_resistance * duty * "
        "current off the supply, enabled times tau and dz/dt"
    )
    state_part: ClassVar[StatePart | None] = "memory"

    integral: float = parameter(1.0, unit="1/(rad s)", lower=0.0, meaning="duty per error and second")
    anti_windup: float = parameter(
        100.0, unit="1/s", lower=0.0, meaning="rate at which a duty beyond the limit is led back"
    )

    def flow(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Time derivative of the duty of the I gain [1/s]; `drive` is the goal [rad]."""
        error = self._counted(self._error(position, speed, drive))
        wanted = self._wanted(position, speed, drive)[1] + z
        rate = self.integral * error - self.anti_windup * (wanted - within(wanted, -self.limit, self.limit))
        return rate if self.enabled is None else self.enabled * rate

    def force(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Torque [N m] by which the motor differs from a loop without limit and I gain."""
        return self._beyond(position, speed, drive, z)


@dataclasses.dataclass(frozen=True)
class Meter(Memory):
    """Reading of a quantity of the motor by an instrument: a first-order filter without torque.

        dz/dt = (x - z) / time

    The class itself is no effect. The state is the reading, which an output shows: `outputs={"current":
    ("hub", "current")}`. Over a sample the filter uses the value of the motor in the middle of the sample. So
    a reading is averaged at least over the preceding sample.
    """

    ports: ClassVar[tuple[str, ...]] = ("hub",)

    at: str = "hub"
    time: float = parameter(0.005, unit="s", lower=1e-5, meaning="time constant of the filter")

    def flow(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Time derivative of the reading [its unit per s]."""
        return (drive - z) / self.time

    def force(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """No torque [N m]."""
        return 0.0 * drive

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return f"the reading of the {self.shows} follows the motor at the {self.at} within {self.time:.3g} s"


@register
@dataclasses.dataclass(frozen=True)
class CurrentMeter(Meter):
    """Shows the current of the motor at its port, filtered.

        dz/dt = (i - z) / time

    For a log that contains the current, as servos and drives write it. Goal and angle alone determine the
    torques of a servo only up to a common factor. A current in amperes determines this factor, since the
    torque per current equals the back-EMF per speed; an inertia that is otherwise trusted may then be
    released. A current in counts of unknown size needs an additional `SensorGain` and does not determine the
    factor. Not for a current amplifier, whose current is the input.

    Args:
        at: Port of the motor.
        time: Time constant of the filter [s].

    Source: Robotis, XM430-W210 e-manual, control table 126; first-order low-pass filter.
    """

    name: ClassVar[str] = "current_meter"
    title: ClassVar[str] = "reading of the motor's current"
    equation: ClassVar[str] = "dz/dt = (i - z) / time, i current of the motor, tau = 0"
    driven_by: ClassVar[Drive] = "current"
    shows: ClassVar[str] = "current"

    @classmethod
    def needs(cls) -> tuple[str, ...]:
        """A motor whose torque per current is known."""
        return ("motor whose current is known",)


@register
@dataclasses.dataclass(frozen=True)
class DutyMeter(Meter):
    """Shows the duty that the firmware of a servo gives its motor, filtered.

        dz/dt = (duty - z) / time

    For a log with the duty, the PWM or the load as a share of the supply. The firmware computes the duty from
    goal and angle, so the duty checks the settings of the firmware and contains little information about the
    motor.

    Args:
        at: Port of the servo.
        time: Time constant of the filter [s].

    Source: Robotis, XL330-M288-T e-manual, control table 124; first-order low-pass filter.
    """

    name: ClassVar[str] = "duty_meter"
    title: ClassVar[str] = "reading of a servo's duty"
    equation: ClassVar[str] = "dz/dt = (duty - z) / time, duty of the servo, tau = 0"
    driven_by: ClassVar[Drive] = "duty"
    shows: ClassVar[str] = "duty"

    @classmethod
    def needs(cls) -> tuple[str, ...]:
        """A servo, whose firmware has a duty."""
        return ("servo",)
