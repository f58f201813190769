"""Weight on an axis that is not vertical, or an unbalanced mass."""

import dataclasses
import math
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Force, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Gravity(Force):
    """The weight of an unbalanced mass on a tilted axis.

        tau = -(sine sin(position) + cosine cos(position))

    Two amplitudes instead of one and an angle, because the zero of the angle is where the recording
    began. Not where the port travels only a few degrees: the sine is a spring there, the cosine a
    constant torque.

    Args:
        at: Port.
        sine: Amplitude of the sine [N m].
        cosine: Amplitude of the cosine [N m].

    Source: Newton 1687, the pendulum.
    """

    name: ClassVar[str] = "gravity"
    title: ClassVar[str] = "weight of an unbalanced mass"
    equation: ClassVar[str] = "tau = -(sine * sin(position) + cosine * cos(position))"
    ports: ClassVar[tuple[str, ...]] = ("hub", "arm")
    amplitudes: ClassVar[tuple[str, ...]] = ("sine", "cosine")
    searched: ClassVar[tuple[str, ...]] = ("hub", "arm")
    turning: ClassVar[bool] = True

    sine: float = parameter(0.0, unit="N m", typical=0.02, meaning="amplitude of the sine")
    cosine: float = parameter(0.0, unit="N m", typical=0.02, meaning="amplitude of the cosine")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        return -(self.sine * jnp.sin(position) + self.cosine * jnp.cos(position))

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two directions."""
        torque = 0.1 * scale.torque
        return [[{"sine": torque, "cosine": 0.0}, {"sine": 0.0, "cosine": torque}]]

    def sentence(self) -> str:
        """In words."""
        torque = math.hypot(self.sine, self.cosine)
        # The torque vanishes and restores where the mass hangs lowest.
        lowest = math.degrees(math.atan2(-self.cosine, self.sine))
        return (
            f"weight turns the {self.at} with up to {torque:.3g} N m towards its lowest point at "
            f"{round(lowest)} degrees"
        )
