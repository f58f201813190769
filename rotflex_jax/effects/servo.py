"""Motors under the position loop of their own firmware: hobby servos."""

import dataclasses
import math
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.base import Force, Linear, Scalar, Stamp, register
from rotflex_jax.parameters import parameter

DYNAMIXEL_GAIN_SCALE = 4096 / (2 * math.pi) / (256 * 885)
"""Duty per radian of error and per unit of the P gain of a Dynamixel X: counts of the encoder per radian, by
the divisor 256 of the gain and the 885 counts of full duty [1/rad]. The logged duty of an XL-330 agrees to
0.3 %; its manual gives the divisor 128."""


@register
@dataclasses.dataclass(frozen=True)
class PositionServo(Linear, Force):
    """A motor behind a gear under the position loop of its firmware; the input is the goal angle.

        duty = min(max(gain gain_scale (goal - (position - period / 2 speed)), -limit), limit)
        tau = torque_constant / resistance (supply duty - torque_constant speed)

    Angle, speed and torque are those of the output shaft, so that the torque constant contains the gear's
    ratio and stands for the back-EMF as well. Firmware computes a duty from the angle once in every period
    and holds it, so that on average it acts half a period late on the angle, here to first order: a loss of
    damping, which a fit would take for less back-EMF. That it reads whole counts makes steps in the torque
    far below friction and is left out. Not for a servo whose I or D gain is set, or that plans a profile
    towards its goal.

    Where the duty is below its limit, the loop is linear and the step integrates it exactly; the limit takes
    away a torque beyond that, by the rule for smooth torques. There a step must be short against the loop,
    `Ts sqrt(stiffness / inertia)` below 0.15 for errors of about a count of an encoder, with the stiffness
    `torque_constant / resistance * supply * gain * gain_scale`: above it use `Exponential(order=4)` or
    `substeps`.

    Gain, limit and supply are known, and the gain may differ between recordings (`Recording.constants`).
    Torque constant and resistance follow from a motion under a known load; with viscous damping at the
    same port only if that is known, for back-EMF and damping add up.

    Args:
        at: Port the servo drives.
        gain: P gain of the firmware, in its own unit.
        gain_scale: Duty per angle for a gain of one [1/rad].
        limit: Largest duty, 1 for the whole supply.
        supply: Supply voltage [V].
        period: Control period of the firmware [s].
        torque_constant: Torque per current, equal to voltage per speed [N m/A].
        resistance: Of the armature [ohm].

    Source: Duclusaud, Passault, Padois, Ly 2024, Extended friction models for the physics simulation of
        servo actuators, arXiv 2410.08650, section II; Robotis, XL330-M288-T e-manual, control tables 84 and
        124.
    """

    name: ClassVar[str] = "position_servo"
    title: ClassVar[str] = "motor under a position loop"
    equation: ClassVar[str] = (
        "tau = torque_constant / resistance * (supply * duty - torque_constant * speed), "
        "duty = min(max(gain * gain_scale * (v - position + period / 2 * speed), -limit), limit)"
    )
    amplitudes: ClassVar[tuple[str, ...]] = ("torque_constant",)
    motor: ClassVar[bool] = True
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

    @property
    def _torque_per_duty(self) -> Scalar:
        """At rest [N m]."""
        return self.torque_constant * self.supply / self.resistance

    def stamp(self) -> Stamp:
        """Entries of the equations of motion below the limit."""
        stiffness = self._torque_per_duty * self.gain * self.gain_scale
        braking = self.torque_constant**2 / self.resistance - stiffness * self.period / 2
        return Stamp(stiffness=stiffness, drive=stiffness, damping=braking)

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] that the limit takes away; `voltage` is the goal [rad]."""
        duty = self.gain * self.gain_scale * (voltage - position + self.period / 2 * speed)
        # Not `clip`, which splits the derivative between the two branches on the limit itself.
        above = jnp.where(duty > self.limit, self.limit - duty, 0.0)
        return self._torque_per_duty * jnp.where(duty < -self.limit, -self.limit - duty, above)

    def sentence(self) -> str:
        """In words."""
        stall = self._torque_per_duty * self.limit
        speed = math.inf if self.torque_constant == 0 else self.supply * self.limit / self.torque_constant
        return (
            f"the servo holds the {self.at} at its goal with {self.stamp().stiffness:.3g} N m/rad, gives up "
            f"to {stall:.3g} N m at rest and runs free at {speed:.3g} rad/s"
        )
