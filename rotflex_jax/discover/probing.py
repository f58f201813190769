"""Slopes of innovations along candidates that are switched off, whatever states these bring."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.discover.lanes import Bench, Directions, Lane, cut
from rotflex_jax.discover.supermodel import Candidate, Part
from rotflex_jax.fit.residuals import Data, each_recording
from rotflex_jax.mechanism import Mechanism, Solver
from rotflex_jax.mechanism.absent import Numbers, Samples, absent_slopes, run_slopes
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.mechanism.programs import kept
from rotflex_jax.precision import double_precision


@kept(static=2)
def _run_slopes(structure: Mechanism, solver: Solver, lane: Lane, data: Data) -> jax.Array:
    def one(values: Any, x0: Any, K: Any, *samples: Any) -> Any:
        return run_slopes(structure, solver, Numbers(values, lane.gates, x0, K), Samples(*samples))

    return each_recording(one, (0,) * 7)(lane.values, lane.x0, lane.K, *data)


@kept(static=2)
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

    J = each_recording(one, in_axes=(0, 0, 0, 0, 1, 0, 0, 0, 0), out_axes=1)(
        lane.values, lane.x0, lane.K, A, along.values, *data
    )
    return jnp.where(data.seen[None, :, :, None] > 0, -J, 0.0)


class Absent(NamedTuple):
    """Candidates to be probed together.

    Attributes:
        family: Candidates that the program has; none of them sudden.
        lane: The hypothesis with some of them put in, at zero amplitude or with a closed gate.
        directions: Along these.
    """

    family: Sequence[Candidate]
    lane: Lane
    directions: Directions


def probe(bench: Bench, now: Lane, absent: Sequence[Absent]) -> np.ndarray:
    """Slopes (L, D, R, N, C) of innovations along absent candidates.

    Args:
        bench: Where hypotheses run.
        now: The hypothesis as it is.
        absent: What to probe.
    """
    s = bench.supermodel
    part = s.part(now.gates)
    with double_precision():
        A = _run_slopes(part.mechanism.structure, bench.solver, cut(now, part), bench.on_device())

    def run(job: tuple[Part, Absent]) -> np.ndarray:
        whole, (_, lane, d) = job
        along = Directions(d.values[..., whole.parameters], d.x0, d.gates[:, whole.effects])
        with double_precision():
            present = jnp.array([whole.states.index(i) for i in part.states])
            structure = whole.mechanism.structure
            J = _probed(structure, bench.solver, cut(lane, whole), present, A, along, bench.on_device())
            return np.asarray(J)

    jobs = [(s.probed(now.gates, a.family), a) for a in absent]
    return np.stack(bench.each(run, jobs, lambda job: ("probes", part.effects, job[0].effects)))
