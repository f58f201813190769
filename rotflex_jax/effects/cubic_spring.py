"""A spring that hardens or softens with deflection."""

import dataclasses
from typing import ClassVar

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Force, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class CubicSpring(Force):
    """The cubic term of a spring: it hardens, or softens where the stiffness is negative.

        tau = -stiffness position^3

    Not far outside the deflections of the recording: a softening cubic pulls outwards there.

    Args:
        at: Port.
        stiffness: Cubic stiffness [N m/rad^3].

    Source: Duffing 1918.
    """

    name: ClassVar[str] = "cubic_spring"
    title: ClassVar[str] = "cubic spring (hardening or softening)"
    equation: ClassVar[str] = "tau = -stiffness * position^3"
    ports: ClassVar[tuple[str, ...]] = ("joint",)
    amplitudes: ClassVar[tuple[str, ...]] = ("stiffness",)
    searched: ClassVar[tuple[str, ...]] = ("joint",)

    stiffness: float = parameter(0.0, unit="N m/rad^3", typical=10.0, meaning="cubic stiffness")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        return -self.stiffness * position * position * position

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction."""
        return [[{"stiffness": 0.1 * scale.torque / scale.position**3}]]

    def sentence(self) -> str:
        """In words."""
        verb = "hardens" if self.stiffness >= 0 else "softens"
        # A tenth of a radian is a deflection people can picture.
        torque = abs(self.stiffness) * 0.1**3
        return (
            f"the spring at the {self.at} {verb} with deflection, by {torque:.3g} N m at 0.1 rad "
            f"({self.stiffness:.3g} N m/rad^3)"
        )
