"""Friction that yields elastically before it slides."""

import dataclasses
import math
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Memory, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Dahl(Memory):
    """Friction with presliding: it builds up over a small displacement after each reversal.

        dz/dt = speed/presliding - |speed|/presliding z,    tau = -level z

    Not for a recording in which the presliding is smaller than the sensor resolves: it is Coulomb
    friction there, and simpler. It has no breakaway level and creeps under a vibrating load.

    Args:
        at: Port.
        level: Friction torque when it slides [N m].
        presliding: Displacement over which it builds up [rad].

    Source: Dahl 1968, equation with exponent 1.
    """

    name: ClassVar[str] = "dahl"
    title: ClassVar[str] = "friction with presliding (Dahl)"
    equation: ClassVar[str] = "dz/dt = speed / presliding * (1 - z * sign(speed)), tau = -level * z"
    amplitudes: ClassVar[tuple[str, ...]] = ("level",)
    contains: ClassVar[tuple[str, ...]] = ("coulomb",)
    searched: ClassVar[tuple[str, ...]] = ("hub", "joint")

    level: float = parameter(0.02, unit="N m", lower=0.0, meaning="friction torque when it slides")
    # Coulomb friction is the limit of none at all; the bound keeps the rate finite.
    presliding: float = parameter(
        0.003, unit="rad", lower=1e-6, meaning="displacement over which it builds up"
    )

    def flow(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Time derivative of the state [1/s]."""
        # |speed| instead of speed sign(speed): its derivative at rest is zero, not undefined.
        return speed / self.presliding - jnp.abs(speed) / self.presliding * z

    def force(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        return -self.level * z

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction at each of three displacements."""
        torque = 0.1 * scale.torque
        return [[{"level": torque, "presliding": size}] for size in (0.001, 0.003, 0.01)]

    def sentence(self) -> str:
        """In words."""
        return (
            f"the {self.at} meets a friction torque of {self.level:.3g} N m that builds up over "
            f"{self.presliding:.2g} rad ({math.degrees(self.presliding):.2g} degrees) after each "
            "reversal"
        )
