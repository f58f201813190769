"""Sensor errors: gain, bias, nonlinearity, rectification."""

import dataclasses
import math
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.base import Probe, Scalar, Scale, Sensing, register
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


@register
@dataclasses.dataclass(frozen=True)
class SensorCubic(Sensing):
    """A reading that is linear for small values and has a cubic error for large ones.

        y = value + cubic value^3

    Not beyond the value at which the slope of the reading changes sign (`3 |cubic| value^2 = 1` for a
    negative `cubic`), where the characteristic has no inverse.

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


@register
@dataclasses.dataclass(frozen=True)
class Rectifier(Sensing):
    """A reading with different gains below and above zero.

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

    def measure(self, value: Scalar) -> Scalar:
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
