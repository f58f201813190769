"""A spring that is loose about its rest position."""

import dataclasses
import math
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Force, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class JointPlay(Force):
    """Play of a spring: within it, part or all of the stiffness is missing.

        tau = stiffness min(max(position, -play), play)

    It comes on top of the linear spring at the port. With `stiffness` equal to the spring's, the
    spring gives no torque at all within the play; a smaller value is a spring that is softer there.
    Not for play between motor and gear: that is `backlash`.

    Args:
        at: Port.
        play: Deflection to each side that is free [rad].
        stiffness: What the spring lacks within the play [N m/rad].

    Source: M. Nordin and P.-O. Gutman, Controlling mechanical systems with backlash, Automatica 38,
    2002, the dead-zone model.
    """

    name: ClassVar[str] = "joint_play"
    title: ClassVar[str] = "play of the spring"
    equation: ClassVar[str] = "tau = stiffness * min(max(position, -play), play), beside the spring"
    ports: ClassVar[tuple[str, ...]] = ("hub", "arm", "joint")
    amplitudes: ClassVar[tuple[str, ...]] = ("play",)
    searched: ClassVar[tuple[str, ...]] = ("joint",)

    play: float = parameter(0.005, unit="rad", lower=0.0, meaning="free deflection to each side")
    stiffness: float = parameter(1.6, unit="N m/rad", lower=0.0, meaning="what the spring lacks there")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        # Not `clip`: at no play it would halve the derivative with respect to the play.
        above = jnp.where(position > self.play, self.play, position)
        return self.stiffness * jnp.where(position < -self.play, -self.play, above)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction, the spring wholly missing."""
        return [[{"play": 0.05 * scale.position, "stiffness": scale.stiffness}]] if scale.stiffness else []

    def sentence(self) -> str:
        """In words."""
        return (
            f"the {self.at} is loose by {self.play:.2g} rad ({math.degrees(self.play):.2g} degrees) to "
            f"each side: {self.stiffness:.3g} N m/rad of its spring are missing there"
        )
