"""What measured signals do to the machine beside its input: in textbooks, measured disturbances."""

import dataclasses
from typing import ClassVar

from rotflex_jax.effects.base import Domain, Force, Probe, Scalar, Scale, driven_place, register
from rotflex_jax.errors import InputError
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class MeasuredDisturbance(Force):
    """A torque in proportion to a signal that was measured beside input and outputs.

        tau = gain signal

    A machine on a moving base is the usual case: with the acceleration of the base as the signal, the gain
    at each port is minus the inertia that the base carries along. The current of a second motor is another.
    The signal is held over each sample, as the input is.

    Not for a function of the machine's own outputs, which would explain themselves. The measured motion of a
    neighbouring body is fine, even where this machine moves that one too.

    Args:
        at: Port and name of the signal, `"arm: acceleration of link 1 [rad/s^2]"`; recordings have it among
            their `signals`.
        gain: Torque per unit of the signal [N m, per the unit in its name].

    Raises:
        InputError: `at` does not name both.

    Source: Ljung, System Identification, 1999, section 1.2 (measured disturbances).

    >>> MeasuredDisturbance(at="arm: acceleration of the base [m/s^2]", gain=-0.02).signal
    'acceleration of the base [m/s^2]'
    """

    name: ClassVar[str] = "measured_disturbance"
    title: ClassVar[str] = "measured disturbance"
    equation: ClassVar[str] = "tau = gain * signal"
    acts_on: ClassVar[Domain] = "signal"
    amplitudes: ClassVar[tuple[str, ...]] = ("gain",)
    # Any signal stands in the place of this one.
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
        """One direction."""
        return [[{"gain": 0.1 * scale.torque / scale.signal}]]

    def sentence(self) -> str:
        """In words."""
        per = f" per {self.signal_unit}" if self.signal_unit else ""
        return f"the {self.signal_name} acts at the {self.port} ({self.gain:.3g} N m{per})"
