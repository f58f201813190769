"""A voltage that comes later than its command."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Actuation, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Delay(Actuation):
    """A pure delay between command and motor, of any length.

        v(t) = u(t - time)

    Exact in the mean and in the first moment, also where the delay is no multiple of the sampling
    period: what is held over the samples moves a mass as far as what jumps inside them. Before the
    recording the command counts as its first value. Not to be told from a first-order lag by slow
    inputs.

    Args:
        at: Always `input`.
        time: Delay [s].

    Source: L. Ljung, System Identification, 2nd ed., 1999, section 4.2 (`nk`); Laakso and others,
    Splitting the unit delay, 1996, equation 42 (Lagrange interpolation) with N = 2.
    """

    name: ClassVar[str] = "delay"
    title: ClassVar[str] = "delay of the input"
    equation: ClassVar[str] = "v(t) = u(t - time)"
    searched: ClassVar[tuple[str, ...]] = ("input",)
    stage: ClassVar[int] = 3

    time: float = parameter(0.004, unit="s", lower=0.0, meaning="delay")

    def drive(self, voltage: jax.Array, Ts: Scalar) -> jax.Array:
        """Voltage [V] to hold over each sample."""
        # A delay of n + f samples: the older of two neighbouring commands fills the share f of a sample.
        late = self.time / Ts
        whole = jnp.floor(late)
        part = late - whole
        newer = jnp.arange(voltage.shape[0]) - whole.astype(int)
        command = lambda k: voltage[jnp.maximum(k, 0)]  # noqa: E731
        mean = part * command(newer - 1) + (1 - part) * command(newer)
        # The older one comes first, which a mean forgets: a pulse and its opposite one sample later.
        late_half = part * (1 - part) / 2
        return mean - late_half * (command(newer) - 2 * command(newer - 1) + command(newer - 2))

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two delays, each an alternative."""
        return [[{"time": 0.0021}], [{"time": 0.0081}]]

    def sentence(self) -> str:
        """In words."""
        return f"the voltage comes {1e3 * self.time:.3g} ms later than its command"
