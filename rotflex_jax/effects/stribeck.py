"""Dry friction that is larger near standstill."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import DryFriction, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Stribeck(DryFriction):
    """Friction that falls from a breakaway level to a constant one as the motion picks up.

        |tau| = level + excess exp(-(v/speed)^2) while sliding, up to level + excess at rest

    Not without slow crossings in the recording: where the port is quick at every reversal, the
    excess cannot be told from a little more of the constant level.

    Args:
        at: Port.
        level: Friction torque at high speed [N m].
        excess: How much more it is at standstill [N m].
        speed: Speed over which the excess is lost [rad/s].

    Source: Stribeck 1902; Bo and Pavelescu 1982 with exponent 2.
    """

    name: ClassVar[str] = "stribeck"
    title: ClassVar[str] = "friction that is larger near standstill (Stribeck)"
    equation: ClassVar[str] = (
        "tau = -(level + excess * exp(-(v / speed)^2)) * sign(v), holds while |tau| <= level + excess"
    )
    amplitudes: ClassVar[tuple[str, ...]] = ("level", "excess")
    contains: ClassVar[tuple[str, ...]] = ("coulomb",)
    searched: ClassVar[tuple[str, ...]] = ("hub", "arm", "joint")

    level: float = parameter(0.02, unit="N m", lower=0.0, meaning="friction torque at speed")
    excess: float = parameter(0.01, unit="N m", lower=0.0, meaning="additional friction torque at standstill")
    # A shape has no value at which the effect is absent; the bound keeps the quotient finite.
    speed: float = parameter(0.2, unit="rad/s", lower=1e-4, meaning="speed over which the excess is lost")

    def limit(self, position: Scalar, speed: Scalar, direction: Scalar) -> Scalar:
        """Level [N m] that opposes motion at |speed| [rad/s]."""
        return self.level + self.excess * jnp.exp(-jnp.square(speed / self.speed))

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two directions at each of three speeds."""
        torque = 0.1 * scale.torque
        speeds = [max(share * scale.speed, 1e-3) for share in (0.05, 0.2, 0.6)]
        return [
            [
                {"level": torque, "excess": 0.0, "speed": speed},
                {"level": 0.0, "excess": torque, "speed": speed},
            ]
            for speed in speeds
        ]

    def sentence(self) -> str:
        """In words."""
        return (
            f"friction at the {self.at} falls from {self.level + self.excess:.3g} N m at "
            f"standstill to {self.level:.3g} N m within about {2 * self.speed:.2g} rad/s"
        )
