"""How an output answers each of the last input samples, at every sample of a trajectory.

A trajectory `x[t+1] = F(x[t], v[t])` has the slopes `A[t] = dF/dx`, `B[t] = dF/dv`, which follow from the
states alone and are formed for all samples at once. The answer to the voltage k samples ago is then
`A[t-1] ... A[t-k+1] B[t-k]`, a recursion over the lag in which all samples go side by side.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rotflex_jax.effects.kinds import Actuation
from rotflex_jax.mechanism.assembly import driven_voltage, effects_of
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.programs import kept
from rotflex_jax.mechanism.propagate import chunks, joined, states
from rotflex_jax.mechanism.sensors import read_outputs
from rotflex_jax.mechanism.simulate import FreeStep, Solver


@kept(static=4)
def slopes(
    structure: Mechanism,
    solver: Solver,
    output: int,
    reach: int,
    values: jax.Array,
    gates: jax.Array,
    x0: jax.Array,
    u: jax.Array,
    Ts: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The output (N,) and its derivatives `dy[t] / du[t-k]` (reach, N); those of t < k mean nothing.

    Args:
        structure: `mechanism.structure`; static.
        solver: Integration rule; static.
        output: Index of the output; static.
        reach: Number of lags, from 0; static.
        values: Parameter values (P,).
        gates: One factor per effect.
        x0: First state (n,).
        u: Voltage (N,) [V].
        Ts: Sampling period [s].
    """
    mechanism = structure.with_values(values)
    c = solver.prepare(structure, values, gates, Ts)
    v = driven_voltage(mechanism, gates, u, Ts)
    step = FreeStep(structure, solver)
    X = states(step, x0, v, c)
    read = lambda x: read_outputs(mechanism, gates, x)[output]  # noqa: E731

    def local(here: Any) -> tuple[jax.Array, ...]:
        """The output, slopes of the next state along states and voltage, and slopes of the output."""
        x, w = here
        size = len(x0) + 1
        ways = jnp.broadcast_to(jnp.eye(size, dtype=x.dtype)[:, :, None], (size, size, len(w)))
        slope = lambda way: jax.jvp(lambda q, r: step(q, r, c), (x, w), (way[:-1], way[-1]))[1]  # noqa: E731
        reading = lambda way: jax.jvp(read, (x,), (way[:-1],))[1]  # noqa: E731
        return read(x), jax.vmap(slope)(ways), jax.vmap(reading)(ways[:-1])

    pieces = jax.lax.map(local, chunks((X, v)))
    y, AB, row = (jnp.moveaxis(joined(piece, len(u)), 0, -1) for piece in pieces)
    A, B = AB[:-1], AB[-1]

    def back(dx: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        """From the state's answer to the voltage k samples ago to that k + 1 samples ago."""
        return jnp.roll(jnp.sum(A * dx[:, None], axis=0), 1, axis=1), jnp.sum(row * dx, axis=0)

    # The voltage of a sample acts on the next state at the earliest.
    later = jax.lax.scan(back, jnp.roll(B, 1, axis=1), None, length=reach)[1]
    answers = jnp.concatenate([jnp.zeros_like(later[:1]), later[: reach - 1]])
    if effects_of(mechanism, Actuation):
        answers = _commanded(mechanism, gates, u, Ts, answers)
    return y, answers


def _commanded(
    mechanism: Mechanism, gates: jax.Array, u: jax.Array, Ts: jax.Array, answers: jax.Array
) -> jax.Array:
    """Answers to the commanded voltage from answers to the driven one.

    dy[t] / du[t-k] = sum_m dy[t] / dv[t-k+m]  dv[t-k+m] / du[t-k]
    """
    drive = lambda w: driven_voltage(mechanism, gates, w, Ts)  # noqa: E731
    slope = lambda way: jax.jvp(drive, (u,), (way,))[1]  # noqa: E731
    at = jnp.arange(len(u))[None, :] - jnp.arange(len(answers))[:, None]
    own, probe = slope(jnp.ones_like(u)), jax.random.normal(jax.random.key(0), u.shape, u.dtype)
    # An actuator without memory answers each sample by its own, whatever the samples are.
    at_once = jnp.allclose(slope(probe), own * probe, rtol=1e-9, atol=1e-12)
    return jax.lax.cond(at_once, lambda: answers * own[at], lambda: _remembered(slope, u, at, answers))


def _remembered(
    slope: Callable[[jax.Array], jax.Array], u: jax.Array, at: jax.Array, answers: jax.Array
) -> jax.Array:
    """The sum of `_commanded` over all m below `reach`.

    The slopes of the actuator come from combs, whose teeth are so far apart (`reach`) that their
    answers do not overlap: the one at a sample belongs to the latest tooth.
    """
    reach, time = len(answers), jnp.arange(len(u))
    combs = jax.lax.map(lambda p: slope((time % reach == p).astype(u.dtype)), jnp.arange(reach))
    lag = jnp.arange(reach)[:, None]

    def add(m: jax.Array, total: jax.Array) -> jax.Array:
        """What reaches the motor m samples after its command."""
        moved = jnp.roll(answers * combs[(at - m) % reach, at], m, axis=0)
        return total + jnp.where(lag >= m, moved, 0.0)

    return jax.lax.fori_loop(0, reach, add, jnp.zeros_like(answers))
