"""A constant voltage that nobody commanded."""

import dataclasses
from typing import ClassVar

import jax

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Actuation, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class VoltageOffset(Actuation):
    """A constant offset of the amplifier.

        v -> v + offset

    Without other nonlinearities it is the same as a constant torque at the motor's port, and it
    drifts: a recording may need an offset of its own.

    Args:
        at: Always `input`.
        offset: Voltage added [V].

    Source: Any amplifier's data sheet, input offset.
    """

    name: ClassVar[str] = "voltage_offset"
    title: ClassVar[str] = "constant offset of the voltage"
    equation: ClassVar[str] = "v -> v + offset"
    amplitudes: ClassVar[tuple[str, ...]] = ("offset",)
    searched: ClassVar[tuple[str, ...]] = ("input",)
    stage: ClassVar[int] = 1

    offset: float = parameter(0.0, unit="V", typical=0.05, meaning="voltage added")

    def drive(self, voltage: jax.Array, Ts: Scalar) -> jax.Array:
        """Voltage [V] with the offset."""
        return voltage + self.offset

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction."""
        return [[{"offset": 0.05 * scale.voltage}]]

    def sentence(self) -> str:
        """In words."""
        return f"the motor sees {self.offset:+.3g} V more than was commanded"
