"""An offset of the voltage that changes while the recording runs."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Actuation, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class VoltageDrift(Actuation):
    """An offset that grows steadily from the first sample on: an amplifier or a bearing that warms up.

        v -> v + rate t

    Beside it a constant offset for the value at the beginning. It belongs to a recording, hardly ever
    to a machine: not for predictions of another run. Time counts from the first sample of whatever
    recording a model is given, so a part that was cut from another (`split`, `slice`) and a window of a fit
    (`window_seconds`) begin at zero again: fit it to whole recordings, and add `rate * part.start` to the
    voltage of a later part. Windows of one simulation (`simulate_windows`) share their recording's time.

    Args:
        at: Always `input`.
        rate: Change of the offset with time [V/s].

    Source: Any amplifier's data sheet, drift of the input offset.
    """

    name: ClassVar[str] = "voltage_drift"
    title: ClassVar[str] = "offset of the voltage that drifts"
    equation: ClassVar[str] = "v -> v + rate * t"
    amplitudes: ClassVar[tuple[str, ...]] = ("rate",)
    stage: ClassVar[int] = 1

    rate: float = parameter(0.0, unit="V/s", typical=1e-3, meaning="change of the offset with time")

    def drive(self, voltage: jax.Array, Ts: Scalar) -> jax.Array:
        """Voltage [V] with the offset, its mean over each sample."""
        return voltage + self.rate * Ts * (jnp.arange(voltage.shape[0], dtype=voltage.dtype) + 0.5)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction."""
        return [[{"rate": 1e-3 * scale.voltage}]]

    def sentence(self) -> str:
        """In words."""
        return f"the offset of the voltage drifts by {1e3 * self.rate:+.3g} mV per second"
