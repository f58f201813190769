"""Damping that is stronger in one direction."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Force, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class ViscousAsymmetric(Force):
    """What damping has on top of its mean where it is unequal in the two directions.

        tau = -asymmetry |speed|

    With viscous damping `c` beside it, the port meets `c + asymmetry` forwards and `c - asymmetry`
    backwards: a screw, a worm or a seal. Not for a recording of one speed: there it cannot be told
    from a constant torque, and a fit without it reports it as one.

    Args:
        at: Port.
        asymmetry: Half the difference of the damping forwards and backwards [N m s/rad].

    Source: B. Armstrong-Hélouvry, P. Dupont and C. Canudas de Wit 1994, section 2, on friction that
        depends on the direction.
    """

    name: ClassVar[str] = "viscous_asymmetric"
    title: ClassVar[str] = "damping, unequal in the two directions"
    equation: ClassVar[str] = "tau = -asymmetry * |speed|"
    ports: ClassVar[tuple[str, ...]] = ("hub", "arm", "joint", "axis")
    amplitudes: ClassVar[tuple[str, ...]] = ("asymmetry",)
    searched: ClassVar[tuple[str, ...]] = ("axis",)

    asymmetry: float = parameter(
        0.0, unit="N m s/rad", typical=1e-3, meaning="half the difference between the directions"
    )

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        return -self.asymmetry * jnp.abs(speed)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction."""
        return [[{"asymmetry": 0.1 * scale.torque / scale.speed}]]

    def sentence(self) -> str:
        """In words."""
        way = "forwards" if self.asymmetry >= 0 else "backwards"
        return (
            f"damping at the {self.at} is {2 * abs(self.asymmetry):.3g} N m s/rad stronger {way} than the "
            "other way"
        )
