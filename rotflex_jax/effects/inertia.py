"""A moment of inertia."""

import dataclasses
from typing import ClassVar

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Linear, Probe, Scale, Stamp
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Inertia(Linear):
    """A moment of inertia that turns with the port.

        T = 1/2 inertia speed^2

    Not for a mass whose leverage changes with the position: the inertia is constant.

    Args:
        at: Port.
        inertia: Moment of inertia [kg m^2].

    Source: Lagrange's equations.
    """

    name: ClassVar[str] = "inertia"
    title: ClassVar[str] = "moment of inertia"
    equation: ClassVar[str] = "T = 1/2 * inertia * speed^2"
    amplitudes: ClassVar[tuple[str, ...]] = ("inertia",)

    inertia: float = parameter(0.002, unit="kg m^2", lower=0.0, meaning="moment of inertia")

    def stamp(self) -> Stamp:
        """Entries of the equations of motion."""
        return Stamp(inertia=self.inertia)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction."""
        acceleration = scale.speed**2 / scale.position
        return [[{"inertia": 0.1 * scale.torque / acceleration}]]

    def sentence(self) -> str:
        """In words."""
        return f"the {self.at} carries a moment of inertia of {self.inertia:.3g} kg m^2"
