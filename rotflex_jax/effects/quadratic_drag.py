"""Drag that grows with the square of the speed."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Force, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class QuadraticDrag(Force):
    """Drag of a body in air or liquid.

        tau = -coefficient speed |speed|

    Not for slow motion: below the speeds of the recording it vanishes against viscous damping.

    Args:
        at: Port; `arm` for the drag of a paddle, since the air knows the absolute speed.
        coefficient: Torque per speed squared [N m s^2/rad^2].

    Source: Newton 1687; Rayleigh 1876.
    """

    name: ClassVar[str] = "quadratic_drag"
    title: ClassVar[str] = "quadratic (air) drag"
    equation: ClassVar[str] = "tau = -coefficient * speed * |speed|"
    amplitudes: ClassVar[tuple[str, ...]] = ("coefficient",)
    searched: ClassVar[tuple[str, ...]] = ("hub", "arm", "joint")

    coefficient: float = parameter(1e-3, unit="N m s^2/rad^2", lower=0.0, meaning="torque per speed squared")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        return -self.coefficient * speed * jnp.abs(speed)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction."""
        return [[{"coefficient": 0.1 * scale.torque / scale.speed**2}]]

    def sentence(self) -> str:
        """In words."""
        return f"drag slows the {self.at} with the square of its speed, {self.coefficient:.3g} N m at 1 rad/s"
