"""Damping: viscous, different in each direction, quadratic."""

import dataclasses
import math
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.base import Force, Linear, Probe, Scalar, Scale, Stamp, register
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Viscous(Linear):
    """Viscous damping, a torque proportional to the speed.

        tau = -coefficient speed

    The coefficient adds to the damping by the back-EMF of a motor at the port, and is estimated as negative
    if the trusted back-EMF constant is too large. A fit lets it fall below zero by no more than other effects
    damp its port. So at a port without a motor the least estimate is zero, while a model may be given any
    coefficient. Not for friction that is as large at low speed as at high speed: that is Coulomb friction.

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
        """One direction of the score test."""
        return [[{"coefficient": 0.1 * scale.torque / scale.speed}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        if self.coefficient < 0:
            return (
                f"the {self.at} is damped less than the rest of the model says, by "
                f"{-self.coefficient:.3g} N m s/rad"
            )
        return f"the {self.at} is damped in proportion to its speed, {self.coefficient:.3g} N m s/rad"


@register
@dataclasses.dataclass(frozen=True)
class ViscousAsymmetric(Force):
    """The difference between viscous damping in the two directions.

        tau = -asymmetry |speed|

    Together with viscous damping `c` at the port, the damping is `c + asymmetry` forwards and `c - asymmetry`
    backwards, as in a screw, a worm gear or a seal. Not for a recording at one speed: there it is equivalent
    to a constant torque, and a fit without this effect reports a constant torque.

    Args:
        at: Port.
        asymmetry: Half the difference of the damping forwards and backwards [N m s/rad].

    Source: B. Armstrong-Hélouvry, P. Dupont and C. Canudas de Wit 1994, section 2, on friction that
        depends on the direction.
    """

    name: ClassVar[str] = "viscous_asymmetric"
    title: ClassVar[str] = "asymmetric damping"
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
        """One direction of the score test."""
        return [[{"asymmetry": 0.1 * scale.torque / scale.speed}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        side = "forwards" if self.asymmetry >= 0 else "backwards"
        return (
            f"damping at the {self.at} is {2 * abs(self.asymmetry):.3g} N m s/rad stronger {side} than the "
            "other way"
        )


@register
@dataclasses.dataclass(frozen=True)
class QuadraticDrag(Force):
    """Drag of a body in air or liquid.

        tau = -coefficient speed |speed|

    Not for slow motion: at low speeds it is negligible compared with viscous damping.

    Args:
        at: Port; `arm` for the drag of a paddle, since drag depends on the absolute speed.
        coefficient: Torque per speed squared [N m s^2/rad^2].

    Source: Newton 1687; Rayleigh 1876.
    """

    name: ClassVar[str] = "quadratic_drag"
    title: ClassVar[str] = "quadratic drag"
    equation: ClassVar[str] = "tau = -coefficient * speed * |speed|"
    amplitudes: ClassVar[tuple[str, ...]] = ("coefficient",)
    searched: ClassVar[tuple[str, ...]] = ("hub", "arm", "joint")

    coefficient: float = parameter(1e-3, unit="N m s^2/rad^2", lower=0.0, meaning="torque per speed squared")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        return -self.coefficient * speed * jnp.abs(speed)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test."""
        return [[{"coefficient": 0.1 * scale.torque / scale.speed**2}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return f"drag slows the {self.at} with the square of its speed, {self.coefficient:.3g} N m at 1 rad/s"
