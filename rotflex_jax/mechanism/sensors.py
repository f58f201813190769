"""What the sensors read: true positions and speeds, then what each sensor makes of them."""

import jax
import jax.numpy as jnp

from rotflex_jax.effects.kinds import Sensing
from rotflex_jax.mechanism.assembly import Layout, effects_of
from rotflex_jax.mechanism.combine import combined, in_each
from rotflex_jax.mechanism.mechanism import Mechanism


def true_outputs(structure: Mechanism, x: jax.Array) -> jax.Array:
    """What perfect sensors would read (C, ...) at states (n, ...)."""
    return combined(Layout.of(structure).output_rows, x)


def sensed(mechanism: Mechanism, gates: jax.Array, y: jax.Array) -> jax.Array:
    """Sensor readings (C, ...) of true outputs (C, ...)."""
    for i, effect in effects_of(mechanism, Sensing):
        c = mechanism.channels.index(effect.at)
        read = y[c] + gates[i] * (in_each(effect, lambda e, true: e.measure(true), y[c]) - y[c])
        y = jnp.concatenate([y[:c], read[None], y[c + 1 :]])
    return y


def read_outputs(mechanism: Mechanism, gates: jax.Array, x: jax.Array) -> jax.Array:
    """Sensor readings (C, ...) of states (n, ...)."""
    return sensed(mechanism, gates, true_outputs(mechanism.structure, x))


def read_with_sign(mechanism: Mechanism, gates: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Readings, and whether they rise (1), fall (-1) or stay (0) as the true value rises.

    The gain is that of straight sensors. What a rectifier reads falls below zero: corrected with the
    gain's own sign, the state would run away from the measurement.
    """
    true = true_outputs(mechanism.structure, x)
    if not effects_of(mechanism, Sensing):
        return true, jnp.ones_like(true)
    read, slope = jax.jvp(lambda y: sensed(mechanism, gates, y), (true,), (jnp.ones_like(true),))
    return read, jnp.sign(slope)
