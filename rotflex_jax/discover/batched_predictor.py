"""Innovations and their slopes for several parameter sets, computed in parallel on threads."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from rotflex_jax.discover.supermodel import ReducedModel, SuperModel
from rotflex_jax.fit.dataset import StackedRecordings, padded_windows
from rotflex_jax.fit.problem import predicted
from rotflex_jax.mechanism import Mechanism, Solver
from rotflex_jax.mechanism.assembly import whole_state
from rotflex_jax.mechanism.sensitivities import (
    RecordingSamples,
    RunParameters,
    TangentDirections,
    accumulate_outputs,
)
from rotflex_jax.models.model import program_length
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision, on_threads

Used = TypeVar("Used")


class ProgramSamples(NamedTuple):
    """Recordings as inputs of compiled programs, padded to a common length.

    Attributes:
        data: The recordings, with zeros beyond their ends.
        window: Window of each sample.
        count: Number of samples of each recording that are run, up to the last one that counts.
    """

    data: StackedRecordings
    window: Int[Any, "R N"]
    count: Int[Any, " R"]


class ParameterSet(NamedTuple):
    """Numbers with which one hypothesis runs on all recordings.

    Attributes:
        values: Parameter values for each recording.
        x0: First states of the windows of each recording, for the model with the effects that are on.
        gates: Gate of each effect.
        K: Gains of the predictor for each recording.
    """

    values: Float[Any, "R P"]
    x0: Float[Any, "R W m"]
    gates: Float[Any, " E"]
    K: Float[Any, "R n C"]


class Directions(NamedTuple):
    """Directions along which the innovations of a parameter set are differentiated.

    Attributes:
        values: Directions in the parameters of each recording.
        x0: Directions in the first state, the same in every window.
        gates: Directions in the gates.
    """

    values: Float[Any, "D R P"]
    x0: Float[Any, "D m"]
    gates: Float[Any, "D E"]

    def restrict(self, model: ReducedModel) -> "Directions":
        """The directions in the coordinates of a reduced model."""
        return Directions(self.values[..., model.parameters], self.x0, self.gates[:, model.effects])


@persistent_jit(static=2)
def _innovations(
    structure: Mechanism,
    solver: Solver,
    p: ParameterSet,
    samples: ProgramSamples,
) -> jax.Array:
    data, window, count = samples
    y_hat = predicted(structure, solver, p.values, p.x0, p.gates, data, p.K, window, count.max())
    return jnp.where(data.seen[:, :, None] > 0, data.y - y_hat, 0.0)


@persistent_jit(static=2)
def _slopes(
    structure: Mechanism,
    solver: Solver,
    parameter_set: ParameterSet,
    directions: Directions,
    samples: ProgramSamples,
) -> tuple[jax.Array, jax.Array]:
    x0 = whole_state(structure, parameter_set.x0)
    x0_tangents = jnp.pad(directions.x0, ((0, 0), (0, x0.shape[-1] - parameter_set.x0.shape[-1])))

    def one(values: Any, x0: Any, K: Any, dvalues: Any, given: ProgramSamples) -> tuple[jax.Array, jax.Array]:
        parameters = RunParameters(values, parameter_set.gates, x0, K)
        tangents = TangentDirections(dvalues, directions.gates, x0_tangents)

        def place(sums: Any, y_hat: jax.Array, J: jax.Array, sample: Any) -> Any:
            (k, e, slopes), (y, seen) = sums, sample
            # `where` and not a product, since samples that do not count may be infinite.
            here, J = (jnp.where(seen > 0, a, 0.0) for a in (y - y_hat, -J.T))
            put = jax.lax.dynamic_update_slice_in_dim
            return (k + 1, put(e, here[None], k, 0), put(slopes, J[:, None], k, 1)), None

        none = jnp.zeros((len(x0_tangents), *given.data.y.shape), given.data.y.dtype)
        run = RecordingSamples(*given.data, given.window, given.count)
        start = (0, none[0], none)
        sums, _ = accumulate_outputs(structure, solver, parameters, tangents, run, place, start)
        return sums[1:]

    rows = (parameter_set.values, x0, parameter_set.K, jnp.swapaxes(directions.values, 0, 1), samples)
    if len(x0) == 1:
        e, J = one(*jax.tree.map(lambda a: a[0], rows))
        return e[None], J[:, None]
    e, J = jax.lax.map(lambda row: one(*row), rows)
    return e, jnp.swapaxes(J, 0, 1)


@dataclasses.dataclass(frozen=True)
class BatchedPredictor:
    """Runs hypotheses with one super-model and one solver on one set of recordings.

    Attributes:
        supermodel: The super-model; each of its reduced models is compiled once.
        solver: Integration rule.
        data: The recordings.
        constants: Constants of the recordings: known values of the baseline's parameters, nan for other
            parameters; None if there are no constants.
        compiled: Programs that have run once, and so may run on several threads.
    """

    supermodel: SuperModel
    solver: Solver
    data: StackedRecordings
    constants: Float[np.ndarray, "R B"] | None = None
    compiled: set[Any] = dataclasses.field(default_factory=set)
    # Cache of `on_device`, by the identity of the windows, which are kept with the samples.
    _placed: dict[int, tuple[Any, ProgramSamples]] = dataclasses.field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def restrict(self, parameter_set: ParameterSet, model: ReducedModel) -> ParameterSet:
        """A parameter set in the coordinates of a reduced model, with the constants of the recordings.

        The number of windows is filled up, so that recordings of other lengths share programs.
        """
        values, number = parameter_set.values, parameter_set.x0.shape[1]
        filled = padded_windows(number)
        if self.constants is not None:
            values = values.copy()
            known = ~np.isnan(self.constants)
            values[:, : known.shape[1]][known] = self.constants[known]
        return ParameterSet(
            values[:, model.parameters],
            parameter_set.x0[:, np.minimum(np.arange(filled), number - 1)],
            parameter_set.gates[np.array(model.effects)],
            parameter_set.K[:, np.array(model.states)],
        )

    def innovations(
        self, parameter_sets: list[ParameterSet], window: Int[np.ndarray, "R N"]
    ) -> Float[np.ndarray, "L R N C"]:
        """Innovations of any number of parameter sets; `window` has the window of each sample."""
        return np.stack(self.of_innovations(lambda _, e: e, parameter_sets, window))

    def of_innovations(
        self,
        use: Callable[[int, Float[np.ndarray, "R N C"]], Used],
        parameter_sets: list[ParameterSet],
        window: Int[np.ndarray, "R N"],
    ) -> list[Used]:
        """Results of a function of the index and innovations of each parameter set.

        The function is called on the thread that has run the program.
        """

        def run(job: tuple[ReducedModel, int]) -> Used:
            model, i = job
            with double_precision():
                inputs = self.restrict(parameter_sets[i], model)
                e = _innovations(model.mechanism.structure, self.solver, inputs, self.on_device(window))
            return use(i, np.asarray(e)[:, : window.shape[1]])

        jobs = [(self.supermodel.active(p.gates), i) for i, p in enumerate(parameter_sets)]
        return self.run_jobs(run, jobs, lambda job: ("innovations", job[0].effects))

    def slopes(
        self,
        parameter_sets: list[ParameterSet],
        directions: list[Directions],
        window: Int[np.ndarray, "R N"],
    ) -> tuple[Float[np.ndarray, "L R N C"], Float[np.ndarray, "L D R N C"]]:
        """Innovations and their slopes along the directions given for each parameter set.

        D is the largest number of directions of a parameter set; slopes of the others are filled up with
        zeros.
        """
        found = self.of_slopes(lambda _, e, J: (e, J), parameter_sets, directions, window)
        slopes = np.zeros((len(found), max(len(d.x0) for d in directions), *self.data.y.shape))
        for filled, (_, J) in zip(slopes, found, strict=True):
            filled[: len(J)] = J
        return np.stack([e for e, _ in found]), slopes

    def of_slopes(
        self,
        use: Callable[[int, Float[np.ndarray, "R N C"], Float[np.ndarray, "D R N C"]], Used],
        parameter_sets: list[ParameterSet],
        directions: list[Directions],
        window: Int[np.ndarray, "R N"],
    ) -> list[Used]:
        """Results of a function of the index, innovations and slopes of each parameter set.

        The function is called on the thread that has run the program, and slopes are not kept.
        """

        def run(job: tuple[ReducedModel, int]) -> Used:
            model, i = job
            along = directions[i].restrict(model)
            with double_precision():
                structure, inputs = model.mechanism.structure, self.restrict(parameter_sets[i], model)
                e, J = _slopes(structure, self.solver, inputs, along, self.on_device(window))
            return use(i, np.asarray(e)[:, : window.shape[1]], np.asarray(J)[:, :, : window.shape[1]])

        gates = [np.vstack([p.gates, d.gates]) for p, d in zip(parameter_sets, directions, strict=True)]
        jobs = [(self.supermodel.active(g), i) for i, g in enumerate(gates)]
        return self.run_jobs(run, jobs, lambda job: ("slopes", len(directions[job[1]].x0), job[0].effects))

    def has_innovations(self, gates: Float[np.ndarray, " E"]) -> bool:
        """Whether the program of innovations of the model with these gates has run before."""
        return ("innovations", self.supermodel.active(gates).effects) in self.compiled

    def run_jobs(
        self, run: Callable[[Any], Any], jobs: list[Any], program: Callable[[Any], Any]
    ) -> list[Any]:
        """Results of jobs that run in parallel; of each new program, one job runs first and compiles it.

        Args:
            run: Function of a job.
            jobs: The jobs.
            program: Gives the name of the program that a job needs.
        """
        names = [program(job) for job in jobs]
        new = {name: i for i, name in enumerate(names) if name not in self.compiled}
        done: dict[int, Any] = {}
        for batch in (list(new.values()), [i for i in range(len(jobs)) if i not in new.values()]):
            done.update(zip(batch, on_threads(run, [jobs[i] for i in batch]), strict=True))
        self.compiled.update(new)
        return [done[i] for i in range(len(jobs))]

    def on_device(self, window: Int[np.ndarray, "R N"]) -> ProgramSamples:
        """The recordings as padded JAX arrays, the inputs of programs; to be called in double precision."""
        found = self._placed.get(id(window))
        if found is None:
            N, seen = window.shape[1], self.data.seen > 0
            more = program_length(N) - N
            fill = lambda a: np.pad(a, ((0, 0), (0, more), (0, 0))[: a.ndim])  # noqa: E731
            u, y, counts, Ts = self.data
            data = StackedRecordings(fill(u), fill(y), fill(counts), Ts)
            count = np.where(seen.any(axis=1), N - np.argmax(seen[:, ::-1], axis=1), 0)
            samples = ProgramSamples(data, np.pad(window, ((0, 0), (0, more)), "edge"), count)
            found = self._placed[id(window)] = window, jax.device_put(samples)
        return found[1]
