"""Parameter sets side by side: innovations and their slopes for several of them in one call."""

import dataclasses
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.discover.supermodel import Part, SuperModel
from rotflex_jax.fit.residuals import Data, predicted
from rotflex_jax.mechanism import Mechanism, Solver
from rotflex_jax.mechanism.absent import Numbers, Samples
from rotflex_jax.mechanism.assembly import whole_state
from rotflex_jax.mechanism.programs import kept
from rotflex_jax.mechanism.tangents import Ways, outputs_with_slopes
from rotflex_jax.precision import double_precision
from rotflex_jax.threads import cores

# Lanes per call for values alone, where lanes come nearly free. Slopes run one lane a call: their
# directions fill the vector units, so more lanes would only take longer to compile.
LANES = 4


class Lane(NamedTuple):
    """Numbers of one hypothesis for all recordings; stacked, a leading axis is added."""

    values: Any  # (R, P)
    x0: Any  # (R, m), of the part of the super-model that the gates need
    gates: Any  # (E,)
    K: Any  # (R, n, C)


class Directions(NamedTuple):
    """Tangents (D, ...) in which a lane is differentiated."""

    values: Any  # (D, R, P)
    x0: Any  # (D, m), the same in every recording
    gates: Any  # (D, E)


@kept(static=2)
def _innovations(structure: Mechanism, solver: Solver, lanes: Lane, data: Data) -> jax.Array:
    def one(lane: Lane) -> jax.Array:
        y_hat = predicted(structure, solver, lane.values, lane.x0, lane.gates, data, lane.K)
        return jnp.where(data.seen[:, :, None] > 0, data.y - y_hat, 0.0)

    return jax.vmap(one)(lanes)


@kept(static=2)
def _slopes(
    structure: Mechanism, solver: Solver, lane: Lane, along: Directions, data: Data
) -> tuple[jax.Array, jax.Array]:
    starts = whole_state(structure, lane.x0)
    x0_ways = jnp.pad(along.x0, ((0, 0), (0, starts.shape[1] - lane.x0.shape[1])))

    def one(recording: Any) -> tuple[jax.Array, jax.Array]:
        values, x0, K, dvalues, samples = recording
        numbers = Numbers(values, lane.gates, x0, K)
        ways = Ways(dvalues, along.gates, x0_ways)
        y_hat, J = outputs_with_slopes(structure, solver, numbers, ways, Samples(*samples))
        return y_hat, jnp.moveaxis(J, -1, 0)

    each = (lane.values, starts, lane.K, jnp.swapaxes(along.values, 0, 1), data)
    y_hat, J = jax.lax.map(one, each)
    # Not a product: beyond its last sample a run may diverge.
    seen = data.seen[:, :, None] > 0
    J = jnp.where(seen[None], -jnp.swapaxes(J, 0, 1), 0.0)
    return jnp.where(seen, data.y - y_hat, 0.0), J


def _stacked(parts: list[Lane]) -> Lane:
    """Leading axis over lanes; a short batch is filled up with copies of its last lane."""
    full = parts + [parts[-1]] * (LANES - len(parts))
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *full)


def cut(lane: Lane, part: Part) -> Lane:
    """The numbers of a lane that a part of the super-model needs."""
    states = np.array(part.states)
    return Lane(
        lane.values[:, part.parameters], lane.x0, lane.gates[np.array(part.effects)], lane.K[:, states]
    )


@dataclasses.dataclass(frozen=True)
class Bench:
    """Where hypotheses are run: one super-model, one solver, one set of recordings.

    Attributes:
        supermodel: What is compiled, each part of it once.
        solver: Integration rule.
        data: The recordings.
        compiled: Which programs have run once, and so may run on several threads.
    """

    supermodel: SuperModel
    solver: Solver
    data: Data
    compiled: set[Any] = dataclasses.field(default_factory=set)

    def innovations(self, lanes: list[Lane]) -> np.ndarray:
        """Innovations (L, R, N, C) of any number of lanes."""

        def run(job: tuple[Part, list[int]]) -> np.ndarray:
            part, places = job
            with double_precision():
                stack = _stacked([cut(lanes[i], part) for i in places])
                e = _innovations(part.mechanism.structure, self.solver, stack, self.on_device())
                return np.asarray(e)[: len(places)]

        jobs: list[tuple[Part, list[int]]] = []
        for part, places in self._by_part([lane.gates for lane in lanes]):
            jobs += [(part, places[i : i + LANES]) for i in range(0, len(places), LANES)]
        out = np.empty((len(lanes), *self.data.y.shape))
        for (_, places), e in zip(jobs, self.each(run, jobs, _named("innovations")), strict=True):
            out[places] = e
        return out

    def slopes(self, lanes: list[Lane], directions: list[Directions]) -> tuple[np.ndarray, np.ndarray]:
        """Innovations (L, R, N, C) and their slopes (L, D, R, N, C)."""

        def run(job: tuple[Part, list[int]]) -> tuple[np.ndarray, np.ndarray]:
            part, (i,) = job
            d = directions[i]
            along = Directions(d.values[..., part.parameters], d.x0, d.gates[:, part.effects])
            with double_precision():
                structure = part.mechanism.structure
                e, J = _slopes(structure, self.solver, cut(lanes[i], part), along, self.on_device())
                return np.asarray(e), np.asarray(J)

        gates = [np.vstack([lane.gates, d.gates]) for lane, d in zip(lanes, directions, strict=True)]
        jobs = [(part, [i]) for part, places in self._by_part(gates) for i in places]
        found = dict(zip([i for _, (i,) in jobs], self.each(run, jobs, _named("slopes")), strict=True))
        return tuple(np.stack([found[i][k] for i in range(len(lanes))]) for k in (0, 1))  # type: ignore

    def _by_part(self, gates: list[np.ndarray]) -> list[tuple[Part, list[int]]]:
        """Which lanes run on which part of the super-model."""
        groups: dict[tuple[int, ...], tuple[Part, list[int]]] = {}
        for i, g in enumerate(gates):
            part = self.supermodel.part(g)
            groups.setdefault(part.effects, (part, []))[1].append(i)
        return list(groups.values())

    def each(self, run: Callable[[Any], Any], jobs: list[Any], program: Callable[[Any], Any]) -> list[Any]:
        """Results of jobs side by side; of each new `program` (its name for a job) one compiles."""
        names = [program(job) for job in jobs]
        new = {name: i for i, name in enumerate(names) if name not in self.compiled}
        done: dict[int, Any] = {}
        for turn in (list(new.values()), [i for i in range(len(jobs)) if i not in new.values()]):
            done.update(zip(turn, _side_by_side(run, [jobs[i] for i in turn]), strict=True))
        self.compiled.update(new)
        return [done[i] for i in range(len(jobs))]

    def on_device(self) -> Data:
        """The recordings as arrays of JAX; call it inside the precision that is wanted."""
        return jax.tree.map(jnp.asarray, self.data)


def _named(what: str) -> Callable[[tuple[Part, list[int]]], Any]:
    """Name of the program that runs a job: what it computes, on which part of the super-model."""
    return lambda job: (what, job[0].effects)


def _side_by_side(run: Callable[[Any], Any], parts: list[Any]) -> list[Any]:
    """Results of independent calls, on as many threads as there are cores.

    A scan keeps one core busy whatever its width; compiled code runs outside of Python's lock.

    Args:
        run: What to call; no two threads may compile the same.
        parts: Its arguments.
    """
    return list(_threads().map(run, parts))


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores())
