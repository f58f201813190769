"""How a run would change if effects that are off came in: slopes along them, without running each.

An effect whose amplitude is zero acts on nothing, so the run itself and its slopes `A[k]` are those of
the mechanism without it. What it would add is a forcing `b[k]` of the same recursion,

    dx[k+1] = A[k] dx[k] + b[k],

evaluated along the run, with the effect's own states driven by the run as it is. Many absent effects
therefore cost one forcing each, whatever states they bring.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.propagate import forcing, recursion, slopes, states
from rotflex_jax.mechanism.sensors import read_outputs
from rotflex_jax.mechanism.simulate import PredictorStep, Solver, driven


class Numbers(NamedTuple):
    """What a predictor run of one structure needs.

    Attributes:
        values: Parameter values (P,).
        gates: One factor per effect (E,).
        x0: First state (n,).
        K: Gain (n, C).
    """

    values: Any
    gates: Any
    x0: Any
    K: Any


class Samples(NamedTuple):
    """One recording: voltage (N,), outputs (N, C), which samples correct the state (N,), period."""

    u: Any
    y: Any
    seen: Any
    Ts: Any


def run_slopes(structure: Mechanism, solver: Solver, numbers: Numbers, samples: Samples) -> jax.Array:
    """Slopes of the step `A[k]` (N, n, n) along a predictor run.

    Args:
        structure: Without the absent effects; static.
        solver: Integration rule; static.
        numbers: Of this structure.
        samples: The recording.
    """
    step = PredictorStep(structure, solver)
    _, v, c = driven(structure, solver, numbers.values, numbers.gates, samples.u, samples.Ts)
    inputs, constants = (v, samples.y, samples.seen), (c, numbers.K)
    return slopes(step, states(step, numbers.x0, inputs, constants), inputs, constants)


def absent_slopes(
    structure: Mechanism,
    solver: Solver,
    numbers: Numbers,
    samples: Samples,
    present: jax.Array,
    A: jax.Array,
    dvalues: jax.Array,
    dgates: jax.Array,
) -> jax.Array:
    """Slopes of the predicted outputs (D, N, C) along effects that act on nothing yet.

    Args:
        structure: With all effects; static.
        solver: Integration rule; static.
        numbers: Every absent effect at zero amplitude, or with its gate closed.
        samples: The recording.
        present: Places of the states (r,) that do not belong to absent effects.
        A: From `run_slopes` without the absent effects (N, r, r).
        dvalues: Directions in the values (D, P).
        dgates: Directions in the gates (D, E).
    """
    step = PredictorStep(structure, solver)

    def prepared(values: jax.Array, gates: jax.Array) -> Any:
        return driven(structure, solver, values, gates, samples.u, samples.Ts)[1:]

    v, c = prepared(numbers.values, numbers.gates)
    inputs, constants = (v, samples.y, samples.seen), (c, numbers.K)
    X = states(step, numbers.x0, inputs, constants)
    still = (jnp.zeros_like(samples.y), jnp.zeros_like(samples.seen))

    def along(dv: jax.Array, dg: jax.Array) -> jax.Array:
        way = (numbers.values, numbers.gates), (dv, dg)
        dvoltage, dc = jax.jvp(prepared, *way)[1]
        b = forcing(step, X, inputs, (dvoltage, *still), constants, (dc, jnp.zeros_like(numbers.K)))
        dx = recursion(A, b[:, present], jnp.zeros_like(numbers.x0[present]))
        dX = jnp.zeros_like(X).at[:, present].set(dx)
        read = lambda x, values, gates: read_outputs(structure.with_values(values), gates, x)  # noqa: E731
        return jax.jvp(read, (X.T, *way[0]), (dX.T, *way[1]))[1].T

    return jax.vmap(along)(dvalues, dgates)
