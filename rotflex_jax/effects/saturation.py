"""A limit of the voltage."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Actuation, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Saturation(Actuation):
    """The amplifier gives no more than its limit, the same both ways.

        v -> min(max(v, -limit), limit)

    Absent only at an infinite limit, so it has no amplitude; a limit above the largest recorded
    voltage does nothing. Not for a command that was recorded after the limit.

    Args:
        at: Always `input`.
        limit: Largest voltage [V].

    Source: Quanser, SRV02 user manual, 2011 (5 V through the cable of gain 1).
    """

    name: ClassVar[str] = "saturation"
    title: ClassVar[str] = "saturation of the input"
    equation: ClassVar[str] = "v -> min(max(v, -limit), limit)"
    searched: ClassVar[tuple[str, ...]] = ("input",)
    stage: ClassVar[int] = 0

    limit: float = parameter(5.0, unit="V", lower=0.0, meaning="largest voltage")

    def drive(self, voltage: jax.Array, Ts: Scalar) -> jax.Array:
        """Voltage [V] that is left."""
        # Not `clip`, which splits the derivative between the two branches on the limit itself.
        above = jnp.where(voltage > self.limit, self.limit, voltage)
        return jnp.where(voltage < -self.limit, -self.limit, above)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction at each of four limits."""
        return [[{"limit": share * scale.voltage}] for share in (0.9, 0.7, 0.5, 0.3)]

    def sentence(self) -> str:
        """In words."""
        return f"the amplifier gives no more than {self.limit:.3g} V either way"
