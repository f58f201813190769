"""Effects of signals that are measured beside the input: measured disturbances."""

import dataclasses
from typing import ClassVar

from rotflex_jax.effects.base import Domain, Force, Probe, Scalar, Scale, driven_place, register
from rotflex_jax.errors import InputError
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class MeasuredDisturbance(Force):
    """A torque proportional to a measured signal other than input and outputs.

        tau = gain signal

    The usual example is a machine on a moving base: with the acceleration of the base as the signal, the gain
    at each port is minus the inertia that the base carries along. Another example is the current of a second
    motor. The signal is constant over each sample. The torque does not depend on the motion of the machine,
    so it acts in the same way at rest and in motion.

    Not for a signal that is computed from the machine's own outputs: the model would then explain an output
    by the same output. The measured motion of a neighbouring body is allowed, even if this machine also moves
    that body.

    Args:
        at: Port and name of the signal, such as `"arm: acceleration of link 1 [rad/s^2]"`. Each recording
            must have the signal among its `signals`.
        gain: Torque per unit of the signal [N m per unit of the signal].

    Raises:
        InputError: If `at` does not name a port and a signal, or the gain is not finite.

    Source: L. Ljung, System Identification, 2nd ed., 1999, section 1.2 (measured disturbances).

    >>> MeasuredDisturbance(at="arm: acceleration of the base [m/s^2]", gain=-0.02).signal
    'acceleration of the base [m/s^2]'
    """

    name: ClassVar[str] = "measured_disturbance"
    title: ClassVar[str] = "measured disturbance"
    equation: ClassVar[str] = "tau = gain * signal"
    acts_on: ClassVar[Domain] = "signal"
    amplitudes: ClassVar[tuple[str, ...]] = ("gain",)
    # The word `signal` stands for the name of any measured signal.
    ports: ClassVar[tuple[str, ...]] = ("hub: signal", "arm: signal", "joint: signal")
    searched: ClassVar[tuple[str, ...]] = ports

    gain: float = parameter(0.0, unit="N m", typical=0.01, meaning="torque per unit of the signal")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.signal:
            raise InputError(
                f"MeasuredDisturbance was given at={self.at!r}, but it needs a port and the name of a "
                f'signal; write at="{driven_place(self.at or "arm", "acceleration of the base [m/s^2]")}".'
            )

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port for a value of the signal, the last argument."""
        return self.gain * voltage

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test."""
        return [[{"gain": 0.1 * scale.torque / scale.signal}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        per = f" per {self.signal_unit}" if self.signal_unit else ""
        return f"the {self.signal_name} acts at the {self.port} ({self.gain:.3g} N m{per})"
