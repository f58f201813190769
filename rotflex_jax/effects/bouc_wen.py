"""A hysteretic torque: it depends on where the motion last turned."""

import dataclasses
import math
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Memory, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class BoucWen(Memory):
    """Hysteresis of Bouc and Wen, normalised so that the state stays within -1 and 1.

        dz/dt = speed/width - (beta |speed| z + (1 - beta) speed |z|) / width,    tau = -level z

    `beta` is the share that depends on the way of turning: 1 is Dahl friction, 0 a spring that
    saturates and has no loss. Not to be told from Dahl friction by a recording without small
    reversals: the two differ only where the motion turns before the state has saturated.

    Args:
        at: Port.
        level: Torque at saturation [N m].
        width: Deflection over which it builds up [rad].
        beta: Share of the hysteretic part.

    Source: R. Bouc 1967; Y.-K. Wen, J. Eng. Mech. Div. 102, 1976, with exponent 1.
    """

    name: ClassVar[str] = "bouc_wen"
    title: ClassVar[str] = "hysteresis (Bouc-Wen)"
    equation: ClassVar[str] = (
        "dz/dt = (speed - beta * |speed| * z - (1 - beta) * speed * |z|) / width, tau = -level * z"
    )
    amplitudes: ClassVar[tuple[str, ...]] = ("level",)
    contains: ClassVar[tuple[str, ...]] = ("coulomb", "dahl")
    searched: ClassVar[tuple[str, ...]] = ("hub", "joint")

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
        """One direction at each of two widths."""
        torque = 0.1 * scale.torque
        widths = (0.1 * scale.position, 0.4 * scale.position)
        return [[{"level": torque, "width": width, "beta": 0.5}] for width in widths]

    def sentence(self) -> str:
        """In words."""
        return (
            f"the {self.at} has a hysteretic torque of up to {self.level:.3g} N m that builds up over "
            f"{self.width:.2g} rad ({math.degrees(self.width):.2g} degrees) after each reversal"
        )
