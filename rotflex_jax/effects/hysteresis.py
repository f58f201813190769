"""Friction and hysteresis with a state: Dahl, LuGre, Bouc-Wen."""

import dataclasses
import math
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.base import DRY_FRICTION, Memory, Probe, Scalar, Scale, register
from rotflex_jax.parameters import parameter

# Share of the hysteretic part below which a sentence calls Bouc-Wen hysteresis a spring.
LEAST_HYSTERETIC = 0.05


@register
@dataclasses.dataclass(frozen=True)
class Dahl(Memory):
    """Friction with presliding: it builds up over a small displacement after each reversal.

        dz/dt = speed/presliding - |speed|/presliding z,    tau = -level z

    The state `z` approaches 1 while the port slides forwards and -1 while it slides backwards. At rest it
    does not change, so the torque keeps its value. After a reversal the torque approaches the level in the
    other direction: a displacement of `presliding` reduces the difference to a share exp(-1). There is no
    breakaway level, and a port under a vibrating load creeps. Not for a recording in which the presliding is
    below the resolution of the sensor: there the effect is equivalent to Coulomb friction, which is simpler.

    Args:
        at: Port.
        level: Friction torque while the port slides [N m].
        presliding: Displacement over which the torque builds up [rad].

    Source: Dahl 1968, equation with exponent 1.
    """

    name: ClassVar[str] = "dahl"
    title: ClassVar[str] = "Dahl friction"
    law_of: ClassVar[str] = DRY_FRICTION
    equation: ClassVar[str] = "dz/dt = speed / presliding * (1 - z * sign(speed)), tau = -level * z"
    amplitudes: ClassVar[tuple[str, ...]] = ("level",)
    contains: ClassVar[tuple[str, ...]] = ("coulomb",)
    searched: ClassVar[tuple[str, ...]] = ("hub", "joint")

    level: float = parameter(0.02, unit="N m", lower=0.0, meaning="friction torque when it slides")
    # The limit of zero presliding is Coulomb friction; the bound keeps the rate finite.
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
        """One direction of the score test at each of three displacements."""
        torque = 0.1 * scale.torque
        return [[{"level": torque, "presliding": size}] for size in (0.001, 0.003, 0.01)]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return (
            f"a friction torque of {self.level:.3g} N m at the {self.at} that builds up over "
            f"{self.presliding:.2g} rad ({math.degrees(self.presliding):.2g} degrees) after each "
            "reversal"
        )


@register
@dataclasses.dataclass(frozen=True)
class LuGre(Memory):
    """The friction model of Lund and Grenoble; its state is the normalised deflection of elastic bristles.

        g = 1 + rise exp(-(speed/slow)^2)
        dz/dt = (speed - |speed| z / g) / presliding
        tau = -(level z + damping exp(-(speed/slow)^2) presliding dz/dt)

    The state `z` is the deflection of the bristles divided by `presliding`. It is 1 while the port slides
    fast forwards and -1 backwards; while it slides slowly, its magnitude is up to `1 + rise`. At rest the
    state does not change, so the torque keeps its value. After a reversal the torque builds up in the other
    direction over a displacement of about `presliding`.

    In the usual symbols `level` is Fc, `level rise` is Fs - Fc, `level / presliding` is sigma0 and
    `damping` is sigma1; sigma2 is viscous damping, which is a separate effect. Not for a recording in which
    the presliding is below the resolution of the sensor: there the effect is equivalent to Stribeck friction,
    which is simpler.

    The rise and the damping of the bristles decrease with the speed: at `slow` a share exp(-1) of each is
    left. With a constant damping, friction could generate energy at speeds where `damping |speed|` exceeds
    `4 level g`, and a fit to a fast machine would use this damping to describe impacts. With the damping of
    this law, friction generates energy at no speed if `damping slow` is below `9 level`; check a larger
    fitted value.

    Args:
        at: Port.
        level: Friction torque while the port slides fast [N m].
        rise: Breakaway level divided by `level`, minus one [-].
        slow: Speed over which the rise and the damping of the bristles are lost [rad/s].
        presliding: Displacement over which the torque builds up [rad].
        damping: Damping of the bristles at rest [N m s/rad].

    Source: Canudas de Wit, Olsson, Åström and Lischinsky, IEEE Trans. Automatic Control 40, 1995,
    equations 1 to 4; damping that falls with the speed: Åström and Canudas de Wit, IEEE Control Systems
    Magazine 28(6), 2008, 101-114.
    """

    name: ClassVar[str] = "lugre"
    title: ClassVar[str] = "LuGre friction"
    law_of: ClassVar[str] = DRY_FRICTION
    equation: ClassVar[str] = (
        "g = 1 + rise * exp(-(speed/slow)**2), dz/dt = (speed - |speed| * z / g) / presliding, "
        "tau = -(level * z + damping * exp(-(speed/slow)**2) * presliding * dz/dt)"
    )
    amplitudes: ClassVar[tuple[str, ...]] = ("level", "damping")
    contains: ClassVar[tuple[str, ...]] = ("coulomb", "stribeck", "dahl")
    searched: ClassVar[tuple[str, ...]] = ("hub", "joint")

    level: float = parameter(0.02, unit="N m", lower=0.0, meaning="friction torque when it slides fast")
    # Where the port hardly slides (large rise, small level), only the product of rise and level shows.
    rise: float = parameter(0.5, unit="", lower=0.0, upper=10.0, meaning="breakaway level over it, less one")
    slow: float = parameter(
        0.3,
        unit="rad/s",
        lower=1e-3,
        meaning="speed over which the rise and the damping of the bristles are lost",
    )
    # The limit of zero presliding is Stribeck friction; the bound keeps the rate finite.
    presliding: float = parameter(
        0.003, unit="rad", lower=1e-6, meaning="displacement over which it builds up"
    )
    damping: float = parameter(0.0, unit="N m s/rad", lower=0.0, typical=0.01, meaning="of the bristles")

    def flow(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Time derivative of the state [1/s]."""
        g = 1 + self.rise * self._fading(speed)
        return (speed - jnp.abs(speed) * z / g) / self.presliding

    def force(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        bending = self.presliding * self.flow(z, position, speed, drive)
        return -(self.level * z + self.damping * self._fading(speed) * bending)

    def _fading(self, speed: Scalar) -> Scalar:
        """Factor by which the rise and the damping of the bristles are reduced at this speed [-]."""
        return jnp.exp(-((speed / self.slow) ** 2))

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two directions, friction and damping of the bristles, at each of two displacements."""
        torque, slow = 0.1 * scale.torque, 0.15 * scale.speed + 1e-3
        friction = {"level": torque, "damping": 0.0, "rise": 0.5, "slow": slow}
        bristles = friction | {"level": 0.0, "damping": 0.3 * torque / slow}
        return [[a | {"presliding": size} for a in (friction, bristles)] for size in (0.001, 0.005)]

    def sentence(self) -> str:
        """A sentence about the friction, the damping of the bristles or both, without a negligible one."""
        breakaway, bristles = self.level * (1 + self.rise), self.damping * self.slow  # torques [N m]
        # `slow` may be far above the speeds that occur, so only a rounding error of a fit is no level.
        has_level = breakaway > 1e-6 * bristles or not bristles
        levels = f"with a Coulomb level of {self.level:.3g} N m" if has_level else "without a Coulomb level"
        if has_level and f"{breakaway:.3g}" != f"{self.level:.3g}":
            levels += f" and a breakaway level of {breakaway:.3g} N m"
        damps = f"; presliding damping {self.damping:.3g} N m s/rad below {self.slow:.2g} rad/s"
        return (
            f"friction of the {self.at} {levels}, which builds up over {self.presliding:.2g} rad "
            f"({math.degrees(self.presliding):.2g} degrees) after each reversal"
        ) + (damps if bristles > 1e-3 * breakaway else "")


@register
@dataclasses.dataclass(frozen=True)
class BoucWen(Memory):
    """Hysteresis of Bouc and Wen, normalised so that the state stays between -1 and 1.

        dz/dt = speed/width - (beta |speed| z + (1 - beta) speed |z|) / width,    tau = -level z

    With `beta` of 1 this is Dahl friction, with `beta` of 0 a spring that saturates and loses no energy. At
    rest the state does not change, so the torque keeps its value. While state and speed have the same sign,
    `beta` has no influence: the state approaches 1 or -1, and a displacement of `width` reduces the
    difference to a share exp(-1). After a reversal, until the state changes its sign, it changes more slowly
    the smaller `beta` is. A recording that hardly shows this part of the motion cannot distinguish the effect
    from Dahl friction.

    With `beta` below one half, the state changes faster and faster after a reversal until it changes its
    sign. A step that linearises the law could move it far beyond 1, so the state is limited to its range.

    Args:
        at: Port.
        level: Torque at saturation [N m].
        width: Displacement over which the torque builds up [rad].
        beta: Share of the hysteretic part [-].

    Source: R. Bouc 1967; Y.-K. Wen, J. Eng. Mech. Div. 102, 1976, with exponent 1.
    """

    name: ClassVar[str] = "bouc_wen"
    title: ClassVar[str] = "Bouc-Wen hysteresis"
    law_of: ClassVar[str] = DRY_FRICTION
    equation: ClassVar[str] = (
        "dz/dt = (speed - beta * |speed| * z - (1 - beta) * speed * |z|) / width, tau = -level * z"
    )
    amplitudes: ClassVar[tuple[str, ...]] = ("level",)
    contains: ClassVar[tuple[str, ...]] = ("coulomb", "dahl")
    searched: ClassVar[tuple[str, ...]] = ("hub", "joint")
    limits: ClassVar[tuple[float, float]] = (-1.0, 1.0)

    level: float = parameter(0.02, unit="N m", lower=0.0, meaning="torque at saturation")
    width: float = parameter(0.02, unit="rad", lower=1e-6, meaning="deflection over which it builds up")
    beta: float = parameter(0.5, unit="", lower=0.0, upper=1.0, meaning="share of the hysteretic part")

    def flow(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Time derivative of the state [1/s]."""
        turning, fixed = jnp.abs(speed) * z, speed * jnp.abs(z)
        return (speed - self.beta * turning - (1 - self.beta) * fixed) / self.width

    def force(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        return -self.level * z

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test at each of two widths."""
        torque = 0.1 * scale.torque
        widths = (0.1 * scale.position, 0.4 * scale.position)
        return [[{"level": torque, "width": width, "beta": 0.5}] for width in widths]

    def sentence(self) -> str:
        """The effect with its values, in one sentence; without a hysteretic part it is a spring."""
        width = f"{self.width:.2g} rad ({math.degrees(self.width):.2g} degrees)"
        if self.beta < LEAST_HYSTERETIC:
            return (
                f"a spring at the {self.at} that saturates at {self.level:.3g} N m over {width}; "
                f"beta = {round(self.beta, 2):g}: {'hardly any' if self.beta >= 0.005 else 'no'} hysteresis"
            )
        return (
            f"the {self.at} has a hysteretic torque of up to {self.level:.3g} N m that builds up over "
            f"{width} after each reversal"
        )
