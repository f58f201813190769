"""A sensor that is out of calibration."""

import dataclasses
from typing import ClassVar

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Probe, Scalar, Scale, Sensing
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class SensorGain(Sensing):
    """A reading in constant proportion to the true value, but not equal to it.

        y = (1 + error) value

    Only the ratio of the two sensors' gains can be found, since a common factor is one of torque;
    it is searched at the deflection and relative to the sensor of the servo angle.

    Args:
        at: Channel.
        error: Relative error of the gain.

    Source: Any sensor's data sheet, sensitivity tolerance.
    """

    name: ClassVar[str] = "sensor_gain"
    title: ClassVar[str] = "sensor out of calibration"
    equation: ClassVar[str] = "y = (1 + error) * value"
    ports: ClassVar[tuple[str, ...]] = ("theta", "alpha")
    amplitudes: ClassVar[tuple[str, ...]] = ("error",)
    searched: ClassVar[tuple[str, ...]] = ("alpha",)
    relative: ClassVar[bool] = True

    # The bound keeps the gain positive: a sensor that reads nothing is not out of calibration.
    error: float = parameter(0.0, unit="", typical=0.05, lower=-0.9, meaning="relative error of the gain")

    def measure(self, value: Scalar) -> Scalar:
        """Reading [unit of the channel]."""
        return (1.0 + self.error) * value

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction."""
        return [[{"error": 0.05}]]

    def sentence(self) -> str:
        """In words."""
        more = "more" if self.error >= 0 else "less"
        return f"the sensor of {self.at} reads {abs(self.error):.2%} {more} than the true value"
