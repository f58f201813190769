"""A sensor that loses part of the negative half."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Probe, Scalar, Scale, Sensing
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Rectifier(Sensing):
    """A reading with another gain below zero than above it.

        y = value if value > 0, (1 - loss) value otherwise

    A loss of 1 is a half-wave rectifier, a loss of 2 a full-wave one (the reading is the absolute
    value). Not for a sensor with an offset: where the kink lies elsewhere than at zero, this
    compares gains about the wrong point.

    Args:
        at: Channel.
        loss: Share of the negative values that is lost.

    Source: P. Horowitz and W. Hill, The Art of Electronics, 3rd ed., 2015, section 1.6.
    """

    name: ClassVar[str] = "rectifier"
    title: ClassVar[str] = "sensor with another gain below zero (rectifier)"
    equation: ClassVar[str] = "y = value if value > 0, (1 - loss) * value otherwise"
    ports: ClassVar[tuple[str, ...]] = ("theta", "alpha")
    amplitudes: ClassVar[tuple[str, ...]] = ("loss",)
    searched: ClassVar[tuple[str, ...]] = ("alpha",)

    loss: float = parameter(0.0, unit="", typical=0.2, meaning="share of the negative values that is lost")

    def measure(self, value: Scalar) -> jax.Array:
        """Reading [unit of the channel]."""
        return jnp.where(jnp.asarray(value) > 0, value, (1.0 - self.loss) * value)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction."""
        return [[{"loss": 0.05}]]

    def sentence(self) -> str:
        """In words."""
        if self.loss >= 0:
            return f"the sensor of {self.at} loses {self.loss:.2%} of what is below zero"
        return f"the sensor of {self.at} reads {-self.loss:.2%} more below zero than above"
