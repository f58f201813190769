"""A linear spring."""

import dataclasses
from typing import ClassVar

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Linear, Probe, Scale, Stamp
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Spring(Linear):
    """A linear torsion spring.

        tau = -stiffness position

    Not for deflections at which the geometry of the springs shows: add a quadratic or cubic term.

    Args:
        at: Port.
        stiffness: Torque per angle [N m/rad].

    Source: Hooke 1678.
    """

    name: ClassVar[str] = "spring"
    title: ClassVar[str] = "linear spring"
    equation: ClassVar[str] = "tau = -stiffness * position"
    amplitudes: ClassVar[tuple[str, ...]] = ("stiffness",)

    stiffness: float = parameter(1.0, unit="N m/rad", lower=0.0, meaning="torque per angle")

    def stamp(self) -> Stamp:
        """Entries of the equations of motion."""
        return Stamp(stiffness=self.stiffness)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction."""
        return [[{"stiffness": 0.1 * scale.torque / scale.position}]]

    def sentence(self) -> str:
        """In words."""
        return f"a spring of {self.stiffness:.3g} N m/rad pulls the {self.at} back"
