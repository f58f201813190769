"""A voltage that follows its command with a first-order lag."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Actuation, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Lag(Actuation):
    """An amplifier or filter of first order between command and motor.

        time dv/dt = u - v

    Exact in the mean and in the first moment over each sample. The recording's first command counts
    as having been there for ever. Not to be told from a pure delay by slow inputs: both turn the
    phase, only the lag takes amplitude.

    Args:
        at: Always `input`.
        time: Time constant [s].

    Source: Any first-order low-pass; L. Ljung, System Identification, 2nd ed., 1999, section 2.2.
    """

    name: ClassVar[str] = "lag"
    title: ClassVar[str] = "first-order lag of the input"
    equation: ClassVar[str] = "time * dv/dt = u - v"
    searched: ClassVar[tuple[str, ...]] = ("input",)
    stage: ClassVar[int] = 4

    time: float = parameter(0.006, unit="s", lower=1e-7, meaning="time constant")

    def drive(self, voltage: jax.Array, Ts: Scalar) -> jax.Array:
        """Voltage [V] to hold over each sample."""
        slow = self.time / Ts
        fade = jnp.exp(-1 / slow)
        behind = -slow * jnp.expm1(-1 / slow)  # mean of exp(-t / time) over a sample
        # Its first moment about the middle of the sample.
        early = slow * (behind - fade) - behind / 2

        def sample(v: jax.Array, u: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            return u + fade * (v - u), (u + behind * (v - u), early * (v - u))

        mean, moment = jax.lax.scan(sample, voltage[0], voltage)[1]
        # A mean forgets when in the sample it came: a pulse and its opposite one sample later.
        return mean - jnp.diff(moment, prepend=0.0)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two time constants, each an alternative."""
        return [[{"time": 0.003}], [{"time": 0.012}]]

    def sentence(self) -> str:
        """In words."""
        return f"the voltage follows its command with a lag of {1e3 * self.time:.3g} ms"
