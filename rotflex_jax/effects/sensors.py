"""Sensor errors: gain, bias, nonlinearity, rectification, an encoder out of centre, cross-talk, delay."""

import dataclasses
import math
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.effects.base import Beside, Probe, Scalar, Scale, Sensing, Stamp, StatePart, register
from rotflex_jax.parameters import parameter

# A sensor that reads less than half of the true value or more than twice has another scale, not an error.
_OUT_OF_CALIBRATION = (-0.5, 1.0)
# Limits of the eccentricity of an encoder disc, as a share of its radius. Over a part of a turn, a larger
# eccentricity would act like a gain error of the sensor.
_OUT_OF_CENTRE = (-0.05, 0.05)
# Limits of cross-talk. A larger share means wrong connections, for which no search is needed.
_CROSSED = (-0.1, 0.1)


@register
@dataclasses.dataclass(frozen=True)
class SensorGain(Sensing):
    """A reading that is proportional to the true value, but not equal to it.

        y = (1 + error) value

    Only the ratio of the gains of the two sensors can be identified, since a common factor is equivalent to a
    factor of the torque. The error is searched at the deflection, relative to the sensor of the servo angle.

    Args:
        at: Channel.
        error: Relative error of the gain [-].

    Source: Any sensor's data sheet, sensitivity tolerance.
    """

    name: ClassVar[str] = "sensor_gain"
    title: ClassVar[str] = "sensor gain error"
    equation: ClassVar[str] = "y = (1 + error) * value"
    ports: ClassVar[tuple[str, ...]] = ("theta", "alpha")
    amplitudes: ClassVar[tuple[str, ...]] = ("error",)
    searched: ClassVar[tuple[str, ...]] = ("alpha",)
    relative: ClassVar[bool] = True

    # The bound keeps the gain positive: a sensor with a gain of zero measures nothing.
    error: float = parameter(
        0.0,
        unit="",
        typical=0.05,
        lower=-0.9,
        physical=_OUT_OF_CALIBRATION,
        meaning="relative error of the gain",
    )

    def measure(self, value: Scalar) -> Scalar:
        """Reading [unit of the channel]."""
        return (1.0 + self.error) * value

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test."""
        return [[{"error": 0.05}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        more = "more" if self.error >= 0 else "less"
        return f"the sensor of {self.at} reads {abs(self.error):.2%} {more} than the true value"


@register
@dataclasses.dataclass(frozen=True)
class SensorBias(Sensing):
    """A constant error of the reading.

        y = value + bias

    Not searched at the servo angle: a joint that turns freely has no fixed zero, so a bias there is
    equivalent to the unknown angle at the start.

    Args:
        at: Channel.
        bias: Reading at zero [rad].

    Source: Any sensor's data sheet, zero offset.
    """

    name: ClassVar[str] = "sensor_bias"
    title: ClassVar[str] = "sensor bias"
    equation: ClassVar[str] = "y = value + bias"
    ports: ClassVar[tuple[str, ...]] = ("theta", "alpha")
    amplitudes: ClassVar[tuple[str, ...]] = ("bias",)
    searched: ClassVar[tuple[str, ...]] = ("alpha",)
    per_recording: ClassVar[bool] = True

    bias: float = parameter(0.0, unit="rad", typical=0.01, meaning="reading at zero")

    def measure(self, value: Scalar) -> Scalar:
        """Reading [rad]."""
        return value + self.bias

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test."""
        return [[{"bias": 0.05 * scale.position}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
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
        cubic: Relative error per square of the value [1/(unit of the channel)^2].

    Source: Any sensor's data sheet, linearity; first odd term of a Taylor series.
    """

    name: ClassVar[str] = "sensor_cubic"
    title: ClassVar[str] = "nonlinear sensor"
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

    def largest_reading(self) -> float:
        """For a negative `cubic` the reading at `3 |cubic| value^2 = 1`, beyond which readings fall again."""
        return 2.0 / 3.0 / math.sqrt(-3.0 * float(self.cubic)) if self.cubic < 0 else math.inf

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction: five percent at the largest readings."""
        return [[{"cubic": 0.05 / (3 * scale.position) ** 2}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
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
    value). Not for a sensor with an offset: its kink is not at zero, so this effect would compare the gains
    below and above the wrong point.

    Args:
        at: Channel.
        loss: Share of the negative values that is lost [-].

    Source: P. Horowitz and W. Hill, The Art of Electronics, 3rd ed., 2015, section 1.6.
    """

    name: ClassVar[str] = "rectifier"
    title: ClassVar[str] = "rectifying sensor"
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
        """One direction of the score test."""
        return [[{"loss": 0.05}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        if self.loss >= 0:
            return f"the sensor of {self.at} loses {self.loss:.2%} of what is below zero"
        return f"the sensor of {self.at} reads {-self.loss:.2%} more below zero than above"


@register
@dataclasses.dataclass(frozen=True)
class EccentricEncoder(Sensing):
    """An encoder whose disc does not turn about its centre: an error that repeats once per turn.

        y = value + cosine cos(value) + sine sin(value)

    The law has two amplitudes, because the phase is unknown: the angle is zero where the recording began. An
    eccentricity `e` of a disc of radius `r` gives an amplitude of `e / r`. Not for an encoder shaft that
    turns much less than once: there the effect is equivalent to a bias, a gain error and a curvature
    (`sensor_cubic`).

    Args:
        at: Channel of an angle, equal to the angle of the encoder shaft.
        cosine: Amplitude of the cosine [rad].
        sine: Amplitude of the sine [rad].

    Source: J. R. R. Mayer, High-resolution of rotary encoder analog quadrature signals, IEEE Trans.
    Instrumentation and Measurement 43, 1994; any encoder's data sheet, runout of the disc.
    """

    name: ClassVar[str] = "eccentric_encoder"
    title: ClassVar[str] = "eccentric encoder"
    equation: ClassVar[str] = "y = value + cosine * cos(value) + sine * sin(value)"
    ports: ClassVar[tuple[str, ...]] = ("theta", "alpha")
    amplitudes: ClassVar[tuple[str, ...]] = ("cosine", "sine")
    searched: ClassVar[tuple[str, ...]] = ("theta",)
    turning: ClassVar[bool] = True

    # From an amplitude of one on, the reading is no longer monotonic.
    cosine: float = parameter(
        0.0,
        unit="rad",
        typical=0.01,
        lower=-0.9,
        upper=0.9,
        physical=_OUT_OF_CENTRE,
        meaning="amplitude of the cosine",
    )
    sine: float = parameter(
        0.0,
        unit="rad",
        typical=0.01,
        lower=-0.9,
        upper=0.9,
        physical=_OUT_OF_CENTRE,
        meaning="amplitude of the sine",
    )

    def measure(self, value: Scalar) -> Scalar:
        """Reading [rad]."""
        return value + self.cosine * jnp.cos(value) + self.sine * jnp.sin(value)

    @classmethod
    def needs(cls) -> tuple[str, ...]:
        """A sensor of a position."""
        return ("position",)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two directions of the score test, cosine and sine."""
        return [[{"cosine": 0.01, "sine": 0.0}, {"cosine": 0.0, "sine": 0.01}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        size = math.hypot(self.cosine, self.sine)
        return (
            f"the sensor of {self.at} is out of centre: its error of up to {size:.3g} rad "
            f"({math.degrees(size):.2g} degrees) repeats once per turn"
        )


@register
@dataclasses.dataclass(frozen=True)
class CrossTalk(Sensing):
    """A share of another channel in a reading: crossed wires, or two sensors whose axes are coupled.

        y = value + share other

    `other` is the true value of the other channel, or of the first of several others. Not for the sensor of
    the servo angle: a share of the deflection there is the angle at another place of the shaft.

    Args:
        at: Channel that the other one disturbs.
        share: Share of the other channel in the reading [unit of the channel per unit of the other].

    Source: P. Horowitz and W. Hill, The Art of Electronics, 3rd ed., 2015, section 8.16.
    """

    name: ClassVar[str] = "cross_talk"
    title: ClassVar[str] = "sensor cross-talk"
    equation: ClassVar[str] = "y = value + share * other"
    ports: ClassVar[tuple[str, ...]] = ("theta", "alpha")
    amplitudes: ClassVar[tuple[str, ...]] = ("share",)
    searched: ClassVar[tuple[str, ...]] = ("alpha",)
    relative: ClassVar[bool] = True
    beside: ClassVar[Beside] = "other"

    share: float = parameter(
        0.0, unit="", typical=0.01, physical=_CROSSED, meaning="share of the other channel"
    )

    def measure(self, value: Scalar, other: Scalar) -> Scalar:
        """Reading [unit of the channel]."""
        return value + self.share * other

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test."""
        return [[{"share": 0.01}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return f"the sensor of {self.at} also reads {self.share:+.3g} times what the other sensor should"


@register
@dataclasses.dataclass(frozen=True)
class ChannelDelay(Sensing):
    """A delay of the reading of one sensor relative to the other sensors.

        y(t) = value(t - time)

    The distance covered during the delay follows from the speed by a filter of order two, the Pade
    approximation of the delay, which the step integrates exactly together with the machine. Its relative
    error is `(W time)^5 / 720` at the angular frequency `W`, 0.0001 at 16 Hz for 6 ms. A jump of the voltage
    gives a corner of the speed, which the filter smooths: use the effect for delays of a few samples only.
    The same delay of all sensors is equivalent to a delay of the input (`delay`). Before the start the
    machine is assumed to be at rest.

    Args:
        at: Channel of a position or a speed.
        time: Delay [s].

    Source: G. H. Golub and C. F. Van Loan, Matrix Computations, 4th ed., 2013, section 9.3.1, for the
    approximation of order (2, 2).
    """

    name: ClassVar[str] = "channel_delay"
    title: ClassVar[str] = "sensor delay"
    equation: ClassVar[str] = "y(t) = value(t - time)"
    vanishes_with: ClassVar[tuple[str, ...]] = ("time",)
    ports: ClassVar[tuple[str, ...]] = ("theta", "alpha")
    searched: ClassVar[tuple[str, ...]] = ("theta", "alpha")
    relative: ClassVar[bool] = True
    beside: ClassVar[Beside] = "states"
    state_part: ClassVar[StatePart | None] = "linear"

    # Below the bound no sample shows the delay, and the filter is too fast for the step's matrix exponential.
    time: float = parameter(0.002, unit="s", lower=5e-5, meaning="delay")

    @property
    def order(self) -> int:
        """Two states: the true value less the reading, and the rate of this difference times the delay."""
        return 2

    def stamp(self) -> Stamp:
        """Filter from the speed: time / (1 + s time/2 + s^2 time^2/12), states of equal size."""
        fast = 1.0 / self.time
        return Stamp(
            own=((0.0, fast), (-12.0 * fast, -6.0 * fast)),
            from_speed=(0.0, 12.0),
            from_voltage=(0.0, 0.0),
            torque=(0.0, 0.0),
        )

    def measure(self, value: Scalar, states: tuple[Scalar, Scalar], derivative: int) -> Scalar:
        """Reading [unit of the channel], of the position (derivative 0) or of the speed (1)."""
        behind, rate = states
        return value - (behind if derivative == 0 else rate / self.time)

    @classmethod
    def needs(cls) -> tuple[str, ...]:
        """A sensor of a position or a speed."""
        return ("position or speed",)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two delays, each an alternative."""
        return [[{"time": 0.001}], [{"time": 0.004}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return f"the sensor of {self.at} reads what was true {1e3 * self.time:.3g} ms ago"
