"""Friction of bristles that bend before they slip, with a breakaway level."""

import dataclasses
import math
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Memory, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class LuGre(Memory):
    """The friction model of Lund and Grenoble, with a state that is 1 while the port slides fast.

        g = 1 + rise exp(-(speed/slow)^2)
        dz/dt = (speed - |speed| z / g) / presliding
        tau = -(level z + damping presliding dz/dt)

    In the usual symbols `level` is Fc, `level rise` is Fs - Fc, `level / presliding` is sigma0 and
    `damping` is sigma1; sigma2 is viscous damping, which has an effect of its own. Not for a
    recording in which the presliding is smaller than the sensor resolves: there it is Stribeck
    friction, and simpler. The damping of the bristles may give energy at speeds where `damping
    |speed|` exceeds `4 level g`: a fitted value that large is not physical.

    Args:
        at: Port.
        level: Friction torque when it slides fast [N m].
        rise: Breakaway level over `level`, less one.
        slow: Speed over which the rise is lost [rad/s].
        presliding: Displacement over which the torque builds up [rad].
        damping: Of the bristles [N m s/rad].

    Source: Canudas de Wit, Olsson, Åström and Lischinsky, IEEE Trans. Automatic Control 40, 1995,
    equations 1 to 4.
    """

    name: ClassVar[str] = "lugre"
    title: ClassVar[str] = "friction with presliding and breakaway (LuGre)"
    equation: ClassVar[str] = (
        "g = 1 + rise * exp(-(speed/slow)**2), dz/dt = (speed - |speed| * z / g) / presliding, "
        "tau = -(level * z + damping * presliding * dz/dt)"
    )
    amplitudes: ClassVar[tuple[str, ...]] = ("level", "damping")
    contains: ClassVar[tuple[str, ...]] = ("coulomb", "stribeck", "dahl")
    searched: ClassVar[tuple[str, ...]] = ("hub", "joint")

    level: float = parameter(0.02, unit="N m", lower=0.0, meaning="friction torque when it slides fast")
    # Where it hardly slides at all (a large rise, a small level), only their product shows.
    rise: float = parameter(0.5, unit="", lower=0.0, upper=10.0, meaning="breakaway level over it, less one")
    slow: float = parameter(0.3, unit="rad/s", lower=1e-3, meaning="speed over which the rise is lost")
    # Stribeck friction is the limit of none at all; the bound keeps the rate finite.
    presliding: float = parameter(
        0.003, unit="rad", lower=1e-6, meaning="displacement over which it builds up"
    )
    damping: float = parameter(0.0, unit="N m s/rad", lower=0.0, typical=0.01, meaning="of the bristles")

    def flow(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Time derivative of the state [1/s]."""
        g = 1 + self.rise * jnp.exp(-((speed / self.slow) ** 2))
        return (speed - jnp.abs(speed) * z / g) / self.presliding

    def force(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        bending = self.presliding * self.flow(z, position, speed, drive)
        return -(self.level * z + self.damping * bending)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Friction and damping of the bristles, at each of two displacements."""
        torque, slow = 0.1 * scale.torque, 0.15 * scale.speed + 1e-3
        friction = {"level": torque, "damping": 0.0, "rise": 0.5, "slow": slow}
        bristles = friction | {"level": 0.0, "damping": 0.3 * torque / slow}
        return [[a | {"presliding": size} for a in (friction, bristles)] for size in (0.001, 0.005)]

    def sentence(self) -> str:
        """In words."""
        return (
            f"the {self.at} sticks up to {self.level * (1 + self.rise):.3g} N m and slides at "
            f"{self.level:.3g} N m, its friction building up over {self.presliding:.2g} rad "
            f"({math.degrees(self.presliding):.2g} degrees)"
        )
