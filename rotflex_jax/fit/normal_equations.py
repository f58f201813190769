"""A run, its squared error and the normal equations of that in one pass over the samples.

The scan carries the state, its slopes along every direction, and the sums

    cost = sum e'e / 2,   g = sum J'e,   H = sum J'J,   e = (y - y_hat) / s,   J = de/dp

so that nothing of the length of a recording is stored. A fit that wants no more than these three is
several times quicker with it than with the slopes of all samples, as long as small loops are compiled
into one function (`enable_fast_loops`).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.effects.kinds import Actuation
from rotflex_jax.mechanism import Mechanism, Solver
from rotflex_jax.mechanism.assembly import driven_voltage, effects_of, rest_state
from rotflex_jax.mechanism.sensors import read_outputs
from rotflex_jax.mechanism.simulate import FreeStep


class Sums(NamedTuple):
    """Of one recording, by D directions: the moved parameters, then positions and speeds of the start."""

    cost: Float[Array, ""]
    g: Float[Array, " D"]
    H: Float[Array, "D D"]


def normal_equations(
    structure: Mechanism,
    solver: Solver,
    values: Float[Array, " P"],
    ways: Float[Array, "K P"],
    x0: Float[Array, " m"],
    recording: Any,
    scale: Float[Array, " C"],
) -> Sums:
    """Half the squared error of a free run, its slope, and the product of the Jacobian with itself.

    Args:
        structure: Mechanism without numbers; static.
        solver: Integration rule; static.
        values: Parameter values.
        ways: How the values move with each moved coordinate.
        x0: First positions and speeds.
        recording: Voltage (N,), outputs (N, C), which samples count (N,), sampling period.
        scale: Size of the error of each channel.

    Returns:
        The sums, by K + m directions.
    """
    u, y, seen, Ts = recording
    K, m = len(ways), len(x0)
    gates = jnp.ones(len(structure.effects), u.dtype)
    rest = jnp.asarray(rest_state(structure, np.float64))[m:]
    x = jnp.concatenate([x0, rest])
    dx = jnp.zeros((K + m, len(x)), u.dtype).at[K + jnp.arange(m), jnp.arange(m)].set(1.0)
    ways = jnp.concatenate([ways, jnp.zeros((m, len(values)), u.dtype)])
    prepare = lambda p: solver.prepare(structure, p, gates, Ts)  # noqa: E731
    c, dc = prepare(values), _along(prepare, values, ways)
    step = FreeStep(structure, solver)
    drive = lambda p: solver.inputs(driven_voltage(structure.with_values(p), gates, u, Ts))  # noqa: E731
    moving = bool(effects_of(structure, Actuation))
    v = drive(values)
    dv = jnp.moveaxis(_along(drive, values, ways), 0, 1) if moving else None

    def read(x: Array, p: Array) -> Array:
        return read_outputs(structure.with_values(p), gates, x)

    def turn(carry: Any, sample: Any) -> tuple[Any, None]:
        x, dx, sums = carry
        w, dw, target, counts = sample
        e = (read(x, values) - target) / scale * counts
        J = jax.vmap(lambda d, p: jax.jvp(read, (x, values), (d, p))[1])(dx, ways) / scale[None] * counts
        J = J.astype(e.dtype)
        here = (
            sums[0] + jnp.sum(e * e) / 2,
            sums[1] + jnp.sum(J * e[None], axis=1),
            sums[2] + sum(J[:, None, k] * J[None, :, k] for k in range(len(e))),
        )
        if dw is None:
            slope = lambda d, q: jax.jvp(lambda x, c: step(x, w, c), (x, c), (d, q))[1]  # noqa: E731
            later = jax.vmap(slope)(dx, dc)
        else:
            slope = lambda d, r, q: jax.jvp(step, (x, w, c), (d, r, q))[1]  # noqa: E731
            later = jax.vmap(slope)(dx, dw, dc)
        return (step(x, w, c), later, here), None

    none = (jnp.zeros((), u.dtype), jnp.zeros(K + m, u.dtype), jnp.zeros((K + m, K + m), u.dtype))
    return Sums(*jax.lax.scan(turn, (x, dx, none), (v, dv, y, seen))[0][2])


def _along(f: Any, values: Array, ways: Array) -> Any:
    """Derivative of `f` along each way."""
    return jax.vmap(lambda way: jax.jvp(f, (values,), (way,))[1])(ways)
