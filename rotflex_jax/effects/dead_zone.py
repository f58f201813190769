"""A band of voltages that has no effect."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Actuation, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class DeadZone(Actuation):
    """A dead zone of the amplifier: small voltages do nothing, larger ones lose its width.

        v -> v - positive if v > positive, v + negative if v < -negative, 0 between

    Not for a motor that fails to start because of friction: that is Coulomb friction at the hub,
    which takes its toll in motion too. A two-level input cannot show it.

    Args:
        at: Always `input`.
        positive: Width above zero [V].
        negative: Width below zero [V].

    Source: Tao and Kokotović 1994.
    """

    name: ClassVar[str] = "dead_zone"
    title: ClassVar[str] = "dead zone of the input"
    equation: ClassVar[str] = "v -> v - positive if v > positive, v + negative if v < -negative, 0 between"
    amplitudes: ClassVar[tuple[str, ...]] = ("positive", "negative")
    searched: ClassVar[tuple[str, ...]] = ("input",)
    stage: ClassVar[int] = 2

    positive: float = parameter(0.1, unit="V", lower=0.0, meaning="width above zero")
    negative: float = parameter(0.1, unit="V", lower=0.0, meaning="width below zero")

    def drive(self, voltage: jax.Array, Ts: Scalar) -> jax.Array:
        """Voltage [V] that is left."""
        below = jnp.where(voltage < -self.negative, voltage + self.negative, 0.0)
        return jnp.where(voltage > self.positive, voltage - self.positive, below)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two directions, one on each side."""
        width = 0.05 * scale.voltage
        return [[{"positive": width, "negative": 0.0}, {"positive": 0.0, "negative": width}]]

    def sentence(self) -> str:
        """In words."""
        return f"voltages between {-self.negative:.3g} V and {self.positive:.3g} V have no effect"
