"""A sensor whose reading bends with the third power."""

import dataclasses
from typing import ClassVar

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Probe, Scalar, Scale, Sensing
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class SensorCubic(Sensing):
    """A reading that is straight for small values and bends, the same both ways, for large ones.

        y = value + cubic value^3

    Not beyond the value at which the reading turns back (`3 |cubic| value^2 = 1` for a negative
    `cubic`): a sensor like that has no inverse.

    Args:
        at: Channel.
        cubic: Relative error per square of the value [1/unit^2].

    Source: Any sensor's data sheet, linearity; first odd term of a Taylor series.
    """

    name: ClassVar[str] = "sensor_cubic"
    title: ClassVar[str] = "sensor that is not straight"
    equation: ClassVar[str] = "y = value + cubic * value**3"
    ports: ClassVar[tuple[str, ...]] = ("theta", "alpha")
    amplitudes: ClassVar[tuple[str, ...]] = ("cubic",)
    searched: ClassVar[tuple[str, ...]] = ("theta", "alpha")

    cubic: float = parameter(
        0.0, unit="1/unit^2", typical=3.0, meaning="relative error per square of the value"
    )

    def measure(self, value: Scalar) -> Scalar:
        """Reading [unit of the channel]."""
        return value + self.cubic * value * value * value

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction: five percent at the largest readings."""
        return [[{"cubic": 0.05 / (3 * scale.position) ** 2}]]

    def sentence(self) -> str:
        """In words."""
        more = "more" if self.cubic >= 0 else "less"
        return (
            f"the sensor of {self.at} is not straight: it reads {abs(self.cubic):.3g} times the cube of "
            f"the value {more} than the true value"
        )
