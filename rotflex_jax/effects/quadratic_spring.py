"""A spring that is stiffer to one side."""

import dataclasses
from typing import ClassVar

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Force, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class QuadraticSpring(Force):
    """The quadratic term of a spring that is stiffer to one side, as two unlike springs give.

        tau = -stiffness position^2

    Not far outside the deflections of the recording: to one side it pulls outwards.

    Args:
        at: Port.
        stiffness: Quadratic stiffness [N m/rad^2], positive where positive deflection is stiffer.

    Source: Second-order Taylor term of any spring law.
    """

    name: ClassVar[str] = "quadratic_spring"
    title: ClassVar[str] = "spring that is stiffer to one side"
    equation: ClassVar[str] = "tau = -stiffness * position^2"
    ports: ClassVar[tuple[str, ...]] = ("joint",)
    amplitudes: ClassVar[tuple[str, ...]] = ("stiffness",)
    searched: ClassVar[tuple[str, ...]] = ("joint",)

    stiffness: float = parameter(0.0, unit="N m/rad^2", typical=1.0, meaning="quadratic stiffness")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        return -self.stiffness * position * position

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction."""
        return [[{"stiffness": 0.1 * scale.torque / scale.position**2}]]

    def sentence(self) -> str:
        """In words."""
        side = "positive" if self.stiffness >= 0 else "negative"
        torque = abs(self.stiffness) * 0.1**2
        return (
            f"the spring at the {self.at} is stiffer towards {side} deflection, by "
            f"{torque:.3g} N m at 0.1 rad ({self.stiffness:.3g} N m/rad^2)"
        )
