"""Viscous damping."""

import dataclasses
import math
from typing import ClassVar

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Linear, Probe, Scale, Stamp
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Viscous(Linear):
    """Viscous damping, a torque proportional to the speed.

        tau = -coefficient speed

    The coefficient has no bound: it is what is left when the motor's own damping has been taken
    off, and comes out negative where the trusted back-EMF constant is too large. Not for friction
    that is as large at low speed as at high speed: that is Coulomb friction.

    Args:
        at: Port.
        coefficient: Torque per speed [N m s/rad].

    Source: Stokes 1851.
    """

    name: ClassVar[str] = "viscous"
    title: ClassVar[str] = "viscous damping"
    equation: ClassVar[str] = "tau = -coefficient * speed"
    amplitudes: ClassVar[tuple[str, ...]] = ("coefficient",)
    searched: ClassVar[tuple[str, ...]] = ("hub", "arm", "joint")

    coefficient: float = parameter(
        0.0, unit="N m s/rad", typical=0.01, physical=(0.0, math.inf), meaning="torque per speed"
    )

    def stamp(self) -> Stamp:
        """Entries of the equations of motion."""
        return Stamp(damping=self.coefficient)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction."""
        return [[{"coefficient": 0.1 * scale.torque / scale.speed}]]

    def sentence(self) -> str:
        """In words."""
        if self.coefficient < 0:
            return (
                f"the {self.at} is damped less than the rest of the model says, by "
                f"{-self.coefficient:.3g} N m s/rad"
            )
        return f"the {self.at} is damped in proportion to its speed, {self.coefficient:.3g} N m s/rad"
