"""A run that carries its slopes along several directions from sample to sample.

    x[k+1] = f(x[k], v[k], c),   dx[k+1] = df/dx dx[k] + df/dv dv[k] + df/dc dc

State and slopes advance together and nothing of the length of the run is stored but what is asked for. The
directions come last, side by side, so that vector units work on all at once; the state goes through the same
arithmetic in every lane, which costs less than to keep it apart. `propagate.states` stores the slopes of the
step instead: it serves reverse mode, and effects that are absent.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rotflex_jax.effects.kinds import Actuation, Gear, Memory
from rotflex_jax.mechanism.absent import Numbers, Samples
from rotflex_jax.mechanism.assembly import driven_voltage, effects_of
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.sensors import read_outputs
from rotflex_jax.mechanism.simulate import FreeStep, PredictorStep, Solver
from rotflex_jax.mechanism.step import Exponential

Fold = Callable[[Any, Array, Array, Any], tuple[Any, Any]]
"""`fold(sums, y_hat, J, (y, seen))` to new sums and what is kept: outputs (C,), their slopes (C, D)."""


class Ways(NamedTuple):
    """Directions in which a run is differentiated: values (D, P), gates (D, E), first state (D, n)."""

    values: Any
    gates: Any
    x0: Any


def fold_outputs(
    structure: Mechanism,
    solver: Solver,
    numbers: Numbers,
    ways: Ways,
    samples: Samples,
    fold: Fold,
    first: Any,
) -> tuple[Any, Any]:
    """Goes through the outputs of a run and their slopes, sample by sample.

    Forward mode only. Not for a prediction of hundreds of directions, which no longer fit into the
    processor's nearest memory.

    Args:
        structure: Mechanism without numbers; static.
        solver: Integration rule; static.
        numbers: Where it runs; a free run where the gain is None.
        ways: Directions.
        samples: The recording.
        fold: What to do with the outputs of a sample.
        first: Sums to begin with.

    Returns:
        The last sums, and what was kept (N, ...).
    """
    values, gates, x0, K = numbers
    D = len(ways.x0)
    lanes = functools.partial(jax.tree.map, lambda a: jnp.broadcast_to(a[..., None], (*jnp.shape(a), D)))
    wide = _side_by_side(structure, solver)

    def prepare(p: Array, g: Array) -> Any:
        return solver.prepare(structure, p, g, samples.Ts)

    def drive(p: Array, g: Array) -> Any:
        return solver.inputs(driven_voltage(structure.with_values(p), g, samples.u, samples.Ts))

    def read(x: Array, p: Array, g: Array) -> Array:
        return read_outputs(structure.with_values(p), g, x)

    def along(f: Callable[[Array, Array], Any]) -> Any:
        slope = lambda *way: jax.jvp(f, (values, gates), way)[1]  # noqa: E731
        return jax.vmap(slope, out_axes=-1)(ways.values, ways.gates)

    c, dc = prepare(values, gates), along(prepare)
    dv = along(drive) if effects_of(structure, Actuation) else None
    free, predictor = FreeStep(structure, solver), PredictorStep(structure, solver)

    def step(v: Any, x: Array, c: Any, sample: Any) -> Array:
        if K is None:
            return free(x, v, c)
        return predictor(x, (v, *sample), (c, lanes(K) if wide else K))

    def later(x: Array, dx: Array, v: Any, dv: Any, sample: Any) -> tuple[Array, Array]:
        at, way = (v, x, c), (dv, dx, dc)
        if wide:
            at, sample = lanes(at), lanes(sample)
        f: Callable[..., Array] = lambda *at: step(at[0], at[1], at[2], sample)  # noqa: E731
        if dv is None:  # nothing of the voltage moves
            f, at, way = functools.partial(f, at[0]), at[1:], way[1:]
        if wide:
            end, slopes = jax.jvp(f, at, way)
            return end[:, 0], slopes
        slopes = jax.vmap(lambda *way: jax.jvp(f, at, way)[1], in_axes=-1, out_axes=-1)(*way)
        return f(*at), slopes

    def turn(carry: Any, sample: Any) -> Any:
        (x, dx, sums), (v, dv, here) = carry, sample
        J = jax.jvp(read, lanes((x, values, gates)), (dx, ways.values.T, ways.gates.T))[1]
        sums, kept = fold(sums, read(x, values, gates), J, here)
        return (*later(x, dx, v, dv, here), sums), kept

    measured = (samples.y, samples.seen)
    start = (jnp.asarray(x0), jnp.asarray(ways.x0).T, first)
    (_, _, sums), kept = jax.lax.scan(turn, start, (drive(values, gates), dv, measured))
    return sums, kept


def _side_by_side(structure: Mechanism, solver: Solver) -> bool:
    """Whether the step takes constants of each direction's own."""
    driven = any(e.driven_by == "motor" for _, e in effects_of(structure, Memory))
    return isinstance(solver, Exponential) and not effects_of(structure, Gear) and not driven


def outputs_with_slopes(
    structure: Mechanism, solver: Solver, numbers: Numbers, ways: Ways, samples: Samples
) -> tuple[Float[Array, "N C"], Float[Array, "N C D"]]:
    """Outputs of a run and their slopes along some directions; arguments as in `fold_outputs`.

    Forward mode only, and several times quicker than `jax.jacfwd` of a run.
    """
    keep: Fold = lambda sums, y, J, _: (sums, (y, J))  # noqa: E731
    return fold_outputs(structure, solver, numbers, ways, samples, keep, ())[1]
