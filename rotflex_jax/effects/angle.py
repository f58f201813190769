"""Torques that depend on the absolute angle: gravity and cogging."""

import dataclasses
import math
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.base import HALF_A_PERIOD, Force, Probe, Scalar, Scale, register
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Gravity(Force):
    """The weight of an unbalanced mass on an axis that is not vertical.

        tau = -(sine sin(position) + cosine cos(position))

    The law has two amplitudes, because the angle at which the mass hangs lowest is unknown: the angle is zero
    where the recording began. Not for a port that travels only a few degrees: there the sine is equivalent to
    a spring and the cosine to a constant torque.

    Args:
        at: Port.
        sine: Amplitude of the sine [N m].
        cosine: Amplitude of the cosine [N m].

    Source: Newton 1687, the pendulum.
    """

    name: ClassVar[str] = "gravity"
    title: ClassVar[str] = "gravity torque"
    law_of: ClassVar[str] = "torque that depends on the angle"
    equation: ClassVar[str] = "tau = -(sine * sin(position) + cosine * cos(position))"
    ports: ClassVar[tuple[str, ...]] = ("hub", "arm")
    amplitudes: ClassVar[tuple[str, ...]] = ("sine", "cosine")
    searched: ClassVar[tuple[str, ...]] = ("hub", "arm")
    turning: ClassVar[bool] = True

    sine: float = parameter(0.0, unit="N m", typical=0.02, meaning="amplitude of the sine")
    cosine: float = parameter(0.0, unit="N m", typical=0.02, meaning="amplitude of the cosine")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        return -(self.sine * jnp.sin(position) + self.cosine * jnp.cos(position))

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two directions of the score test, sine and cosine."""
        torque = 0.1 * scale.torque
        return [[{"sine": torque, "cosine": 0.0}, {"sine": 0.0, "cosine": torque}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        torque = math.hypot(self.sine, self.cosine)
        # Where the mass hangs lowest, the torque is zero and has a restoring slope.
        lowest = math.degrees(math.atan2(-self.cosine, self.sine))
        return (
            f"weight turns the {self.at} with up to {torque:.3g} N m towards its lowest point at "
            f"{round(lowest)} degrees"
        )


@register
@dataclasses.dataclass(frozen=True)
class Cogging(Force):
    """A torque that repeats with the angle: magnets of the motor, a gear or bearing that is not round.

        tau = -(sine sin(periods position) + cosine cos(periods position))

    The law has two amplitudes, because the phase is unknown: the angle is zero where the recording began. Not
    for a port that travels less than about half a period: there the torque is equivalent to a spring or a
    constant torque. A torque that repeats once per turn is the weight of an unbalanced mass (`gravity`).

    Args:
        at: Port.
        sine: Amplitude of the sine [N m].
        cosine: Amplitude of the cosine [N m].
        periods: Repetitions of the torque [per turn of the port].

    Source: D. Hanselman, Brushless Permanent Magnet Motor Design, 2nd ed., 2003, chapter 4.
    """

    name: ClassVar[str] = "cogging"
    title: ClassVar[str] = "cogging torque"
    law_of: ClassVar[str] = "torque that depends on the angle"
    equation: ClassVar[str] = "tau = -(sine * sin(periods * position) + cosine * cos(periods * position))"
    ports: ClassVar[tuple[str, ...]] = ("hub", "arm")
    amplitudes: ClassVar[tuple[str, ...]] = ("sine", "cosine")
    contains: ClassVar[tuple[str, ...]] = ("gravity",)
    searched: ClassVar[tuple[str, ...]] = ("hub", "arm")
    turning: ClassVar[bool] = True
    repeats: ClassVar[str] = "periods"

    sine: float = parameter(0.0, unit="N m", typical=0.02, meaning="amplitude of the sine")
    cosine: float = parameter(0.0, unit="N m", typical=0.02, meaning="amplitude of the cosine")
    periods: float = parameter(8.0, unit="per turn", lower=0.1, meaning="repetitions")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        phase = self.periods * position
        return -(self.sine * jnp.sin(phase) + self.cosine * jnp.cos(phase))

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Sine and cosine for each number of periods that the travel can show."""
        torque = 0.1 * scale.torque
        known = (2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 18, 20, 24)
        counts = [n for n in known if n * scale.position > HALF_A_PERIOD] or known[-1:]
        return [
            [
                {"sine": torque, "cosine": 0.0, "periods": float(n)},
                {"sine": 0.0, "cosine": torque, "periods": float(n)},
            ]
            for n in counts
        ]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        torque = math.hypot(self.sine, self.cosine)
        return (
            f"a torque of up to {torque:.3g} N m at the {self.at} repeats {self.periods:.3g} times per turn"
        )
