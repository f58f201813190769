"""A motor that is told its current, not its voltage."""

import dataclasses
from typing import ClassVar

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Linear, Probe, Scale, Stamp
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class CurrentDrive(Linear):
    """A motor on a current amplifier: torque in proportion to the command, without back-EMF.

        tau = gain v

    Not for a motor on a voltage amplifier, whose back-EMF brakes it: `Motor`.

    Args:
        at: Port it drives.
        gain: Torque per command [N m/V].

    Source: M. W. Spong, S. Hutchinson and M. Vidyasagar, Robot Modeling and Control, 2006, section 6.1.
    """

    name: ClassVar[str] = "current_drive"
    title: ClassVar[str] = "motor on a current amplifier"
    equation: ClassVar[str] = "tau = gain * v"
    amplitudes: ClassVar[tuple[str, ...]] = ("gain",)
    motor: ClassVar[bool] = True

    at: str = "hub"
    gain: float = parameter(0.1, unit="N m/V", lower=0.0, meaning="torque per command")

    def stamp(self) -> Stamp:
        """Entries of the equations of motion."""
        return Stamp(drive=self.gain)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """None: a recording with a command has its drive in the model from the start."""
        return []

    def sentence(self) -> str:
        """In words."""
        return f"the drive gives the {self.at} {self.gain:.3g} N m/V"
