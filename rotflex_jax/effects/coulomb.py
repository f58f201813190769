"""Dry friction of a constant level: the same both ways, or one level each way."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import DryFriction, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Coulomb(DryFriction):
    """Constant (Coulomb) friction, with true sticking.

        tau = -level sign(speed) while sliding, any |tau| <= level at rest

    Not where the level falls as the motion starts: that is Stribeck friction.

    Args:
        at: Port.
        level: Friction torque [N m].

    Source: Coulomb 1785.
    """

    name: ClassVar[str] = "coulomb"
    title: ClassVar[str] = "constant (Coulomb) friction"
    equation: ClassVar[str] = "tau = -level * sign(speed), holds while |tau| <= level"
    amplitudes: ClassVar[tuple[str, ...]] = ("level",)
    searched: ClassVar[tuple[str, ...]] = ("hub", "arm", "joint")
    steady: ClassVar[bool] = True

    level: float = parameter(0.02, unit="N m", lower=0.0, meaning="friction torque")

    def limit(self, position: Scalar, speed: Scalar, direction: Scalar) -> Scalar:
        """Level [N m] that opposes motion in `direction`."""
        return self.level

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction."""
        return [[{"level": 0.1 * scale.torque}]]

    def sentence(self) -> str:
        """In words."""
        return (
            f"the {self.at} meets a constant friction torque of {self.level:.3g} N m whichever way it turns"
        )


@register
@dataclasses.dataclass(frozen=True)
class CoulombAsymmetric(DryFriction):
    """Constant friction with a level for each way of turning.

        tau = -forward while speed > 0, backward while speed < 0, between the two at rest

    On most recordings it cannot be told from symmetric friction together with a constant torque (a
    voltage offset at the hub, a shift of the deflection at the joint), which it equals exactly
    wherever it slides.

    Args:
        at: Port.
        forward: Level that opposes positive motion [N m].
        backward: Level that opposes negative motion [N m].

    Source: Armstrong-Hélouvry, Dupont and Canudas de Wit 1994, section 2.
    """

    name: ClassVar[str] = "coulomb_asymmetric"
    title: ClassVar[str] = "constant friction, unequal in the two directions"
    equation: ClassVar[str] = (
        "tau = -forward if speed > 0, +backward if speed < 0, holds while -forward <= tau <= backward"
    )
    amplitudes: ClassVar[tuple[str, ...]] = ("forward", "backward")
    contains: ClassVar[tuple[str, ...]] = ("coulomb",)
    searched: ClassVar[tuple[str, ...]] = ("hub", "arm", "joint")
    steady: ClassVar[bool] = True

    forward: float = parameter(0.02, unit="N m", lower=0.0, meaning="friction torque against positive motion")
    backward: float = parameter(
        0.02, unit="N m", lower=0.0, meaning="friction torque against negative motion"
    )

    def limit(self, position: Scalar, speed: Scalar, direction: Scalar) -> Scalar:
        """Level [N m] that opposes motion in `direction`."""
        return jnp.where(direction > 0, self.forward, self.backward)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two directions, one for each way of turning."""
        torque = 0.1 * scale.torque
        return [[{"forward": torque, "backward": 0.0}, {"forward": 0.0, "backward": torque}]]

    def sentence(self) -> str:
        """In words."""
        return (
            f"the {self.at} meets a friction torque of {self.forward:.3g} N m turning forwards and "
            f"{self.backward:.3g} N m turning backwards"
        )
