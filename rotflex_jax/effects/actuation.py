"""Effects on the voltage before the motor: dead zone, saturation, offset, drift, disturbance, delay, lag."""

import dataclasses
import math
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rotflex_jax.effects.base import Actuation, Period, Probe, Scale, register, within
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class DeadZone(Actuation):
    """A dead zone of the amplifier: small voltages have no effect, larger ones are reduced by its width.

        v -> v - positive if v > positive, v + negative if v < -negative, 0 between

    Not for a motor that fails to start because of friction: that is Coulomb friction at the hub,
    which acts in motion too. A two-level input cannot show a dead zone.

    Args:
        at: Always `input`.
        positive: Width above zero [V].
        negative: Width below zero [V].

    Source: Tao and Kokotović 1994.
    """

    name: ClassVar[str] = "dead_zone"
    title: ClassVar[str] = "input dead zone"
    equation: ClassVar[str] = "v -> v - positive if v > positive, v + negative if v < -negative, 0 between"
    amplitudes: ClassVar[tuple[str, ...]] = ("positive", "negative")
    searched: ClassVar[tuple[str, ...]] = ("input",)
    stage: ClassVar[int] = 2

    positive: float = parameter(0.1, unit="V", lower=0.0, meaning="width above zero")
    negative: float = parameter(0.1, unit="V", lower=0.0, meaning="width below zero")

    def drive(self, voltage: Float[Array, " N"], Ts: Period) -> Float[Array, " N"]:
        """Voltage [V] at the motor."""
        below = jnp.where(voltage < -self.negative, voltage + self.negative, 0.0)
        return jnp.where(voltage > self.positive, voltage - self.positive, below)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two directions of the score test, one for each side."""
        width = 0.05 * scale.voltage
        return [[{"positive": width, "negative": 0.0}, {"positive": 0.0, "negative": width}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return f"voltages between {-self.negative:.3g} V and {self.positive:.3g} V have no effect"


@register
@dataclasses.dataclass(frozen=True)
class Saturation(Actuation):
    """Saturation of the amplifier, symmetric.

        v -> min(max(v, -limit), limit)

    Inactive only at an infinite limit, so it has no amplitude; a limit above the largest recorded voltage has
    no effect. Not for a voltage that was recorded behind the amplifier, where it is already limited.

    Args:
        at: Always `input`.
        limit: Largest magnitude of the voltage [V].

    Source: Quanser, SRV02 user manual, 2011 (5 V through the cable of gain 1).
    """

    name: ClassVar[str] = "saturation"
    title: ClassVar[str] = "input saturation"
    equation: ClassVar[str] = "v -> min(max(v, -limit), limit)"
    searched: ClassVar[tuple[str, ...]] = ("input",)
    stage: ClassVar[int] = 0

    limit: float = parameter(5.0, unit="V", lower=0.0, meaning="largest voltage")

    def drive(self, voltage: Float[Array, " N"], Ts: Period) -> Float[Array, " N"]:
        """Voltage [V] at the motor."""
        return within(voltage, -self.limit, self.limit)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test at each of four limits."""
        return [[{"limit": share * scale.voltage}] for share in (0.9, 0.7, 0.5, 0.3)]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return f"the amplifier gives no more than {self.limit:.3g} V either way"


@register
@dataclasses.dataclass(frozen=True)
class AmplifierSaturation(Actuation):
    """Gradual saturation of the amplifier, without a corner at the limit.

        v -> limit tanh(v / limit)

    Inactive only at an infinite limit, so it has no amplitude; a limit far above the largest recorded
    voltage has no effect. Not for a supply that cuts off at its voltage (`saturation`).

    Args:
        at: Always `input`.
        limit: Magnitude that the output approaches [V].

    Source: H. K. Khalil, Nonlinear Systems, 3rd ed., 2002, section 1.2.7.
    """

    name: ClassVar[str] = "amplifier_saturation"
    title: ClassVar[str] = "gradual amplifier saturation"
    equation: ClassVar[str] = "v -> limit * tanh(v / limit)"
    # A recording hardly distinguishes it from the hard limit, which is searched.
    searched: ClassVar[tuple[str, ...]] = ()
    stage: ClassVar[int] = 0

    limit: float = parameter(10.0, unit="V", lower=1e-3, meaning="voltage that it approaches")

    def drive(self, voltage: Float[Array, " N"], Ts: Period) -> Float[Array, " N"]:
        """Voltage [V] at the motor."""
        return self.limit * jnp.tanh(voltage / self.limit)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test at each of three limits."""
        return [[{"limit": share * scale.voltage}] for share in (2.4, 1.2, 0.6)]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return f"the amplifier saturates gradually and gives less than {self.limit:.3g} V either way"


@register
@dataclasses.dataclass(frozen=True)
class VoltageOffset(Actuation):
    """A constant offset of the amplifier.

        v -> v + offset

    Where amplifier and motor are otherwise linear, it is equivalent to a constant torque at the motor's port.
    An offset changes slowly with time, so each recording may need its own.

    Args:
        at: Always `input`.
        offset: Voltage added [V].

    Source: Any amplifier's data sheet, input offset.
    """

    name: ClassVar[str] = "voltage_offset"
    title: ClassVar[str] = "voltage offset"
    equation: ClassVar[str] = "v -> v + offset"
    amplitudes: ClassVar[tuple[str, ...]] = ("offset",)
    searched: ClassVar[tuple[str, ...]] = ("input",)
    per_recording: ClassVar[bool] = True
    stage: ClassVar[int] = 1

    offset: float = parameter(0.0, unit="V", typical=0.05, meaning="voltage added")

    def drive(self, voltage: Float[Array, " N"], Ts: Period) -> Float[Array, " N"]:
        """Voltage [V] with the offset."""
        return voltage + self.offset

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test."""
        return [[{"offset": 0.05 * scale.voltage}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        side = "below" if self.offset < 0 else "above"
        return f"the motor voltage is {abs(self.offset):.3g} V {side} the command"


@register
@dataclasses.dataclass(frozen=True)
class VoltageDrift(Actuation):
    """An offset that grows linearly from the first sample on: an amplifier or a bearing that warms up.

        v -> v + rate t

    The time `t` is zero at the first sample of the recording that a model is given; add `voltage_offset` for
    the value there. The drift belongs to a recording, not to the machine, so an estimate does not apply to
    another run. A part of another recording (`split`, `slice`) and a window of a fit (`window_seconds`)
    therefore start at zero again: fit the drift to whole recordings, and add `rate * part.start` to the
    voltage of a later part. Windows of one simulation (`simulate_windows`) share the time of their recording.

    Args:
        at: Always `input`.
        rate: Change of the offset with time [V/s].

    Source: Any amplifier's data sheet, drift of the input offset.
    """

    name: ClassVar[str] = "voltage_drift"
    title: ClassVar[str] = "drifting voltage offset"
    equation: ClassVar[str] = "v -> v + rate * t"
    amplitudes: ClassVar[tuple[str, ...]] = ("rate",)
    searched: ClassVar[tuple[str, ...]] = ("input",)
    per_recording: ClassVar[bool] = True
    stage: ClassVar[int] = 1

    rate: float = parameter(0.0, unit="V/s", typical=1e-3, meaning="change of the offset with time")

    def drive(self, voltage: Float[Array, " N"], Ts: Period) -> Float[Array, " N"]:
        """Voltage [V] with the mean of the offset over each sample."""
        return voltage + self.rate * Ts * (jnp.arange(voltage.shape[0], dtype=voltage.dtype) + 0.5)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test."""
        return [[{"rate": 1e-3 * scale.voltage}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return f"the offset of the voltage drifts by {1e3 * self.rate:+.3g} mV per second"


@register
@dataclasses.dataclass(frozen=True)
class PeriodicDisturbance(Actuation):
    """A sinusoidal disturbance that acts on the motor: ripple of the supply, a fan, an unbalance nearby.

        v -> v + sine sin(2 pi frequency t) + cosine cos(2 pi frequency t)

    The time `t` is zero at the first sample of the recording that a model is given, as for `voltage_drift`.
    The voltage of each sample is changed by the mean of the disturbance over the sample.

    A sinusoidal torque at the motor's port is equivalent to this voltage times the torque of the motor per
    volt at rest: `efficiency torque_constant gear_ratio / resistance` for a `motor` without inductance. A
    sinusoidal torque at another port is not equivalent to a voltage: no amplitude and phase then explain both
    angles.

    Sine and cosine belong to a recording, not to the machine. The phase in another run is unknown, so their
    estimates do not apply to it. A search of several recordings estimates one frequency for all of them. Not
    for a torque that depends on the angle, which also has spectral lines if a machine turns at constant speed
    (`cogging`).

    Args:
        at: Always `input`.
        sine: Amplitude of the sine, which is zero at the first sample [V].
        cosine: Amplitude of the cosine [V].
        frequency: Frequency of the disturbance [Hz].

    Source: L. Ljung, System Identification, 2nd ed., 1999, section 14.1 (disturbances in the data).
    """

    name: ClassVar[str] = "periodic_disturbance"
    title: ClassVar[str] = "periodic disturbance"
    equation: ClassVar[str] = (
        "v -> v + sine * sin(2 * pi * frequency * t) + cosine * cos(2 * pi * frequency * t)"
    )
    amplitudes: ClassVar[tuple[str, ...]] = ("sine", "cosine")
    searched: ClassVar[tuple[str, ...]] = ("input",)
    per_recording: ClassVar[bool] = True
    line: ClassVar[str] = "frequency"
    stage: ClassVar[int] = 1

    sine: float = parameter(0.0, unit="V", typical=0.05, meaning="amplitude of the sine")
    cosine: float = parameter(0.0, unit="V", typical=0.05, meaning="amplitude of the cosine")
    frequency: float = parameter(1.0, unit="Hz", lower=1e-3, meaning="frequency")

    def drive(self, voltage: Float[Array, " N"], Ts: Period) -> Float[Array, " N"]:
        """Voltage [V] with the mean of the disturbance over each sample."""
        middle = 2 * jnp.pi * self.frequency * Ts * (jnp.arange(voltage.shape[0], dtype=voltage.dtype) + 0.5)
        wave = self.sine * jnp.sin(middle) + self.cosine * jnp.cos(middle)
        return voltage + jnp.sinc(self.frequency * Ts) * wave

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two directions of the score test, a quarter of a period apart; a search sets the frequency."""
        amplitude = 0.05 * scale.voltage
        return [
            [
                {"sine": amplitude, "cosine": 0.0, "frequency": 1.0},
                {"sine": 0.0, "cosine": amplitude, "frequency": 1.0},
            ]
        ]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        size = math.hypot(self.sine, self.cosine)
        return f"a disturbance of {self.frequency:.4g} Hz acts on the motor like {size:.3g} V of the input"


def _held(mean: Float[Array, " N"], moment: Float[Array, " N"]) -> Float[Array, " N"]:
    """Voltage that, held over each sample, moves a machine like a voltage with this mean and first moment."""
    # A first moment acts like a pulse that is followed by its opposite one sample later.
    return mean - jnp.diff(moment, prepend=0.0)


@register
@dataclasses.dataclass(frozen=True)
class Delay(Actuation):
    """A pure delay between command and motor, of any length.

        v(t) = u(t - time)

    Mean and first moment of the voltage over each sample are exact, also if the delay is not a multiple of
    the sampling period. Before the recording the command has its first value. A slow input cannot distinguish
    the delay from a first-order lag (`lag`).

    Args:
        at: Always `input`.
        time: Delay [s].

    Source: L. Ljung, System Identification, 2nd ed., 1999, section 4.2 (`nk`); Laakso and others,
    Splitting the unit delay, 1996, equation 42 (Lagrange interpolation) with N = 2.
    """

    name: ClassVar[str] = "delay"
    title: ClassVar[str] = "input delay"
    law_of: ClassVar[str] = "late input"
    vanishes_with: ClassVar[tuple[str, ...]] = ("time",)
    equation: ClassVar[str] = "v(t) = u(t - time)"
    searched: ClassVar[tuple[str, ...]] = ("input",)
    stage: ClassVar[int] = 3
    changes_within_samples: ClassVar[bool] = True

    time: float = parameter(0.004, unit="s", lower=0.0, meaning="delay")

    def drive(self, voltage: Float[Array, " N"], Ts: Period) -> Float[Array, " N"]:
        """Voltage [V] to hold over each sample."""
        return _held(*self.within_samples(voltage, Ts))

    def within_samples(
        self, voltage: Float[Array, " N"], Ts: Period
    ) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
        """Mean over each sample and first moment about its middle [V]."""
        # A delay of n + f samples: the older of two neighbouring commands fills the share f of a sample.
        late = self.time / Ts
        whole = jnp.floor(late)
        part = late - whole
        newer = jnp.arange(voltage.shape[0]) - whole.astype(int)
        command = lambda k: voltage[jnp.maximum(k, 0)]  # noqa: E731
        mean = part * command(newer - 1) + (1 - part) * command(newer)
        # The older command comes first within a sample.
        return mean, part * (1 - part) / 2 * (command(newer) - command(newer - 1))

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two delays, each an alternative."""
        return [[{"time": 0.0021}], [{"time": 0.0081}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return f"the voltage comes {1e3 * self.time:.3g} ms later than its command"


@register
@dataclasses.dataclass(frozen=True)
class Lag(Actuation):
    """An amplifier or filter of first order between command and motor.

        time dv/dt = u - v

    Mean and first moment of the voltage over each sample are exact. Before the recording the command has its
    first value. A slow input cannot distinguish the lag from a pure delay (`delay`): both shift the phase
    alike, and there the lag hardly reduces the amplitude.

    Args:
        at: Always `input`.
        time: Time constant [s].

    Source: Any first-order low-pass; L. Ljung, System Identification, 2nd ed., 1999, section 2.2.
    """

    name: ClassVar[str] = "lag"
    title: ClassVar[str] = "input lag"
    law_of: ClassVar[str] = "late input"
    vanishes_with: ClassVar[tuple[str, ...]] = ("time",)
    equation: ClassVar[str] = "time * dv/dt = u - v"
    searched: ClassVar[tuple[str, ...]] = ("input",)
    stage: ClassVar[int] = 4
    changes_within_samples: ClassVar[bool] = True

    time: float = parameter(0.006, unit="s", lower=1e-7, meaning="time constant")

    def drive(self, voltage: Float[Array, " N"], Ts: Period) -> Float[Array, " N"]:
        """Voltage [V] to hold over each sample."""
        return _held(*self.within_samples(voltage, Ts))

    def within_samples(
        self, voltage: Float[Array, " N"], Ts: Period
    ) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
        """Mean over each sample and first moment about its middle [V]."""
        slow = self.time / Ts
        fade = jnp.exp(-1 / slow)
        behind = -slow * jnp.expm1(-1 / slow)  # mean of exp(-t / time) over a sample
        # First moment of exp(-t / time) about the middle of the sample.
        early = slow * (behind - fade) - behind / 2

        def sample(v: jax.Array, u: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            return u + fade * (v - u), (u + behind * (v - u), early * (v - u))

        return jax.lax.scan(sample, voltage[0], voltage)[1]

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two time constants, each an alternative."""
        return [[{"time": 0.003}], [{"time": 0.012}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return f"the voltage follows its command with a lag of {1e3 * self.time:.3g} ms"
