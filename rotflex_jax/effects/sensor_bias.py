"""A sensor whose zero is off."""

import dataclasses
import math
from typing import ClassVar

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Probe, Scalar, Scale, Sensing
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class SensorBias(Sensing):
    """A constant error of the reading.

        y = value + bias

    Not searched at the servo angle: a joint that turns freely has no zero of its own, so a bias
    there is the unknown angle at the start.

    Args:
        at: Channel.
        bias: Reading at zero [rad].

    Source: Any sensor's data sheet, zero offset.
    """

    name: ClassVar[str] = "sensor_bias"
    title: ClassVar[str] = "constant error of a sensor"
    equation: ClassVar[str] = "y = value + bias"
    ports: ClassVar[tuple[str, ...]] = ("theta", "alpha")
    amplitudes: ClassVar[tuple[str, ...]] = ("bias",)
    searched: ClassVar[tuple[str, ...]] = ("alpha",)

    bias: float = parameter(0.0, unit="rad", typical=0.01, meaning="reading at zero")

    def measure(self, value: Scalar) -> Scalar:
        """Reading [rad]."""
        return value + self.bias

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction."""
        return [[{"bias": 0.05 * scale.position}]]

    def sentence(self) -> str:
        """In words."""
        return (
            f"the sensor of {self.at} reads {self.bias:+.3g} rad "
            f"({math.degrees(self.bias):+.2g} degrees) at zero"
        )
