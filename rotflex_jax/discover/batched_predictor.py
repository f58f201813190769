"""Innovations and their slopes for several parameter sets in one call."""

import dataclasses
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from rotflex_jax.discover.supermodel import ReducedModel, SuperModel
from rotflex_jax.fit.dataset import StackedRecordings
from rotflex_jax.fit.problem import predicted
from rotflex_jax.mechanism import Mechanism, Solver
from rotflex_jax.mechanism.assembly import whole_state
from rotflex_jax.mechanism.sensitivities import (
    RecordingSamples,
    RunParameters,
    TangentDirections,
    outputs_with_sensitivities,
)
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import cores, double_precision

# Parameter sets per call for values alone, where further ones cost nearly nothing. Slopes run one set a call:
# their directions fill the vector units, so more sets would only take longer to compile.
PARAMETER_SETS_PER_CALL = 4


class ParameterSet(NamedTuple):
    """What one hypothesis runs with on all recordings; stacked, a leading axis is added.

    Attributes:
        values: Parameter values of each recording.
        x0: First states of the windows of each recording, of the effects that the gates switch on.
        gates: One factor per effect.
        K: Gains of the predictor.
    """

    values: Float[Any, "*L R P"]
    x0: Float[Any, "*L R W m"]
    gates: Float[Any, "*L E"]
    K: Float[Any, "*L R n C"]


class Directions(NamedTuple):
    """Directions along which the innovations of a parameter set are differentiated.

    Attributes:
        values: Of the parameters of each recording.
        x0: Of the first state, the same in every window.
        gates: Of the gates.
    """

    values: Float[Any, "D R P"]
    x0: Float[Any, "D m"]
    gates: Float[Any, "D E"]


@persistent_jit(static=2)
def _innovations(
    structure: Mechanism,
    solver: Solver,
    parameter_sets: ParameterSet,
    data: StackedRecordings,
    window: jax.Array,
) -> jax.Array:
    def one(p: ParameterSet) -> jax.Array:
        y_hat = predicted(structure, solver, p.values, p.x0, p.gates, data, p.K, window)
        return jnp.where(data.seen[:, :, None] > 0, data.y - y_hat, 0.0)

    return jax.vmap(one)(parameter_sets)


@persistent_jit(static=2)
def _slopes(
    structure: Mechanism,
    solver: Solver,
    parameter_set: ParameterSet,
    directions: Directions,
    data: StackedRecordings,
    window: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    x0 = whole_state(structure, parameter_set.x0)
    x0_ways = jnp.pad(directions.x0, ((0, 0), (0, x0.shape[-1] - parameter_set.x0.shape[-1])))

    def one(recording: Any) -> tuple[jax.Array, jax.Array]:
        values, x0, K, dvalues, (u, y, seen, Ts), window = recording
        numbers = RunParameters(values, parameter_set.gates, x0, K)
        ways = TangentDirections(dvalues, directions.gates, x0_ways)
        run = RecordingSamples(u, y, seen, Ts, window)
        y_hat, J = outputs_with_sensitivities(structure, solver, numbers, ways, run)
        return y_hat, jnp.moveaxis(J, -1, 0)

    rows = (parameter_set.values, x0, parameter_set.K, jnp.swapaxes(directions.values, 0, 1), data, window)
    y_hat, J = jax.lax.map(one, rows)
    # Not a product: beyond its last sample a run may diverge.
    seen = data.seen[:, :, None] > 0
    J = jnp.where(seen[None], -jnp.swapaxes(J, 0, 1), 0.0)
    return jnp.where(seen, data.y - y_hat, 0.0), J


def _stacked(parameter_sets: list[ParameterSet]) -> ParameterSet:
    """Leading axis over parameter sets; a short batch is filled up with copies of its last one."""
    full = parameter_sets + [parameter_sets[-1]] * (PARAMETER_SETS_PER_CALL - len(parameter_sets))
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *full)


@dataclasses.dataclass(frozen=True)
class BatchedPredictor:
    """Runs hypotheses: one super-model, one solver, one set of recordings.

    Attributes:
        supermodel: What is compiled, each reduced model of it once.
        solver: Integration rule.
        data: The recordings.
        constants: Values of the baseline's parameters that the recordings know, nan for the others; None
            where they know none.
        compiled: Programs that have run once, and so may run on several threads.
    """

    supermodel: SuperModel
    solver: Solver
    data: StackedRecordings
    constants: Float[np.ndarray, "R B"] | None = None
    compiled: set[Any] = dataclasses.field(default_factory=set)

    def restrict(self, parameter_set: ParameterSet, model: ReducedModel) -> ParameterSet:
        """A parameter set with what the recordings know, without what a reduced model leaves out."""
        values = parameter_set.values
        if self.constants is not None:
            values = values.copy()
            known = ~np.isnan(self.constants)
            values[:, : known.shape[1]][known] = self.constants[known]
        return ParameterSet(
            values[:, model.parameters],
            parameter_set.x0,
            parameter_set.gates[np.array(model.effects)],
            parameter_set.K[:, np.array(model.states)],
        )

    def innovations(
        self, parameter_sets: list[ParameterSet], window: Int[np.ndarray, "R N"]
    ) -> Float[np.ndarray, "L R N C"]:
        """Innovations of any number of parameter sets; `window` has the window of each sample."""

        def run(job: tuple[ReducedModel, list[int]]) -> np.ndarray:
            model, indices = job
            with double_precision():
                batch = _stacked([self.restrict(parameter_sets[i], model) for i in indices])
                data, index = self.on_device(), jnp.asarray(window)
                e = _innovations(model.mechanism.structure, self.solver, batch, data, index)
                return np.asarray(e)[: len(indices)]

        size = PARAMETER_SETS_PER_CALL
        jobs: list[tuple[ReducedModel, list[int]]] = []
        for model, indices in self._by_structure([p.gates for p in parameter_sets]):
            jobs += [(model, indices[i : i + size]) for i in range(0, len(indices), size)]
        out = np.empty((len(parameter_sets), *self.data.y.shape))
        results = self.run_jobs(run, jobs, lambda job: ("innovations", job[0].effects))
        for (_, indices), e in zip(jobs, results, strict=True):
            out[indices] = e
        return out

    def slopes(
        self,
        parameter_sets: list[ParameterSet],
        directions: list[Directions],
        window: Int[np.ndarray, "R N"],
    ) -> tuple[Float[np.ndarray, "L R N C"], Float[np.ndarray, "L D R N C"]]:
        """Innovations and their slopes along the directions given for each parameter set.

        The number D is that of the parameter set with the most; slopes of the others end in zeros.
        """

        def run(job: tuple[ReducedModel, list[int]]) -> tuple[np.ndarray, np.ndarray]:
            model, (i,) = job
            d = directions[i]
            along = Directions(d.values[..., model.parameters], d.x0, d.gates[:, model.effects])
            with double_precision():
                structure, inputs = model.mechanism.structure, self.restrict(parameter_sets[i], model)
                data, index = self.on_device(), jnp.asarray(window)
                e, J = _slopes(structure, self.solver, inputs, along, data, index)
                return np.asarray(e), np.asarray(J)

        gates = [np.vstack([p.gates, d.gates]) for p, d in zip(parameter_sets, directions, strict=True)]
        jobs = [(model, [i]) for model, indices in self._by_structure(gates) for i in indices]
        counts = [len(d.x0) for d in directions]
        results = self.run_jobs(run, jobs, lambda job: ("slopes", counts[job[1][0]], job[0].effects))
        e = np.empty((len(parameter_sets), *self.data.y.shape))
        J = np.zeros((len(parameter_sets), max(counts), *self.data.y.shape))
        for (_, (i,)), found in zip(jobs, results, strict=True):
            e[i], J[i, : counts[i]] = found
        return e, J

    def _by_structure(self, gates: list[np.ndarray]) -> list[tuple[ReducedModel, list[int]]]:
        """Which parameter sets run on which reduced model."""
        groups: dict[tuple[int, ...], tuple[ReducedModel, list[int]]] = {}
        for i, g in enumerate(gates):
            model = self.supermodel.active(g)
            groups.setdefault(model.effects, (model, []))[1].append(i)
        return list(groups.values())

    def run_jobs(
        self, run: Callable[[Any], Any], jobs: list[Any], program: Callable[[Any], Any]
    ) -> list[Any]:
        """Results of jobs side by side; of each new `program` (its name for a job) one job compiles first."""
        names = [program(job) for job in jobs]
        new = {name: i for i, name in enumerate(names) if name not in self.compiled}
        done: dict[int, Any] = {}
        for batch in (list(new.values()), [i for i in range(len(jobs)) if i not in new.values()]):
            done.update(zip(batch, _on_threads(run, [jobs[i] for i in batch]), strict=True))
        self.compiled.update(new)
        return [done[i] for i in range(len(jobs))]

    def on_device(self) -> StackedRecordings:
        """The recordings as arrays of JAX; call it inside the precision that is wanted."""
        return jax.tree.map(jnp.asarray, self.data)


def _on_threads(run: Callable[[Any], Any], jobs: list[Any]) -> list[Any]:
    """Results of independent calls, on as many threads as there are cores.

    A scan keeps one core busy however many parameter sets it carries; compiled code runs outside of Python's
    lock.

    Args:
        run: What to call; no two threads may compile the same.
        jobs: Its arguments.
    """
    return list(_threads().map(run, jobs))


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores())
