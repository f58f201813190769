"""Slopes of innovations along candidates that are switched off, whatever states these bring."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.discover.lanes import Bench, Directions, Lane, cut
from rotflex_jax.fit.residuals import Data
from rotflex_jax.mechanism import Mechanism, Solver
from rotflex_jax.mechanism.absent import Numbers, Samples, absent_slopes, run_slopes
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.precision import double_precision


@functools.partial(jax.jit, static_argnums=(0, 1))
def _run_slopes(structure: Mechanism, solver: Solver, lane: Lane, data: Data) -> jax.Array:
    def one(values: Any, x0: Any, K: Any, *samples: Any) -> Any:
        return run_slopes(structure, solver, Numbers(values, lane.gates, x0, K), Samples(*samples))

    return jax.vmap(one)(lane.values, lane.x0, lane.K, *data)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _probed(
    structure: Mechanism,
    solver: Solver,
    lane: Lane,
    present: jax.Array,
    A: jax.Array,
    along: Directions,
    data: Data,
) -> jax.Array:
    def one(values: Any, x0: Any, K: Any, A: Any, dvalues: Any, *samples: Any) -> Any:
        rest = jnp.asarray(rest_state(structure, np.float64))
        numbers = Numbers(values, lane.gates, rest.at[present].set(x0), K)
        slopes = (present, A, dvalues, along.gates)
        return absent_slopes(structure, solver, numbers, Samples(*samples), *slopes)

    J = jax.vmap(one, in_axes=(0, 0, 0, 0, 1, 0, 0, 0, 0), out_axes=1)(
        lane.values, lane.x0, lane.K, A, along.values, *data
    )
    return -J * data.seen[None, :, :, None]


def probe(bench: Bench, now: Lane, lanes: list[Lane], directions: list[Directions]) -> np.ndarray:
    """Slopes (L, D, R, N, C) of innovations along absent candidates.

    Args:
        bench: Where hypotheses run.
        now: The hypothesis as it is.
        lanes: The hypothesis with absent candidates put in, at zero amplitude or with a closed gate.
        directions: Along these candidates, for each lane; none of them sudden.
    """
    s = bench.supermodel
    part, whole = s.part(now.gates), s.probed(now.gates)
    structure = whole.mechanism.structure
    with double_precision():
        present = jnp.array([whole.states.index(i) for i in part.states])
        A = _run_slopes(part.mechanism.structure, bench.solver, cut(now, part), bench.on_device())

    def run(i: int) -> np.ndarray:
        d = directions[i]
        along = Directions(d.values[..., whole.parameters], d.x0, d.gates[:, whole.effects])
        with double_precision():
            lane = cut(lanes[i], whole)
            J = _probed(structure, bench.solver, lane, present, A, along, bench.on_device())
            return np.asarray(J)

    return np.stack(bench.each(run, list(range(len(lanes))), lambda _: ("probes", len(present))))
