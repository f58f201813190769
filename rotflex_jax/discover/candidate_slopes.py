"""Slopes of the innovations along effects that are absent: directions, and the programs that compute slopes.

Laws that act at ports, on the voltage or on readings are evaluated along the run of the hypothesis. The steps
of this run are differentiated once for all laws (`mechanism.inactive_laws`). Effects that enter the matrices
of the integration step need a program that contains them (`mechanism.sensitivities`).
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from rotflex_jax.discover.batched_predictor import BatchedPredictor, Directions, ParameterSet, ProgramSamples
from rotflex_jax.discover.supermodel import Candidate, ReducedModel, SuperModel
from rotflex_jax.effects.base import Effect
from rotflex_jax.fit.dataset import StackedRecordings
from rotflex_jax.fit.problem import each_recording
from rotflex_jax.mechanism import Exponential, Mechanism, Solver
from rotflex_jax.mechanism.assembly import Layout, rest_state
from rotflex_jax.mechanism.inactive_laws import (
    InactiveLaws,
    PortResponses,
    RunResponses,
    adds_to_step,
    friction_responses,
    law_sensitivities,
    run_responses,
    signal_sensitivities,
)
from rotflex_jax.mechanism.sensitivities import (
    LinearisedRun,
    RecordingSamples,
    RunParameters,
    inactive_sensitivities,
)
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision

# Directions per run of a program whose integration step contains the candidates.
PROBES_PER_BATCH = 4
# Largest number of lines at which a periodic disturbance is tried, the clearest ones first.
MOST_LINES = 2


@persistent_jit(static=3, optimisation_level=0)
def _run_responses(
    structure: Mechanism,
    solver: Solver,
    ports: tuple[str, ...],
    parameter_set: ParameterSet,
    samples: ProgramSamples,
) -> RunResponses:
    def one(values: Any, x0: Any, K: Any, *samples: Any) -> RunResponses:
        parameters = RunParameters(values, parameter_set.gates, x0, K)
        return run_responses(structure, solver, ports, parameters, RecordingSamples(*samples))

    p, (data, window, _) = parameter_set, samples
    return each_recording(one, (0,) * 8)(p.values, p.x0, p.K, *data, window)


@persistent_jit(static=3, optimisation_level=0)
def _friction_responses(
    structure: Mechanism,
    solver: Solver,
    ports: tuple[str, ...],
    parameter_set: ParameterSet,
    samples: ProgramSamples,
    X: jax.Array,
) -> PortResponses:
    def one(values: Any, x0: Any, K: Any, X: Any, *samples: Any) -> PortResponses:
        parameters = RunParameters(values, parameter_set.gates, x0, K)
        return friction_responses(structure, solver, ports, parameters, RecordingSamples(*samples), X)

    p, (data, window, _) = parameter_set, samples
    return each_recording(one, (0,) * 9)(p.values, p.x0, p.K, X, *data, window)


def _of_innovations(J: jax.Array, data: StackedRecordings) -> jax.Array:
    """Slopes of innovations from slopes of predictions; zero where a sample does not count."""
    return jnp.where(data.seen[None, :, :, None] > 0, -J, 0.0)


@persistent_jit(static=2)
def _law_slopes(
    effects: tuple[Effect, ...],
    ports: tuple[str, ...],
    laws: InactiveLaws,
    samples: ProgramSamples,
    responses: RunResponses,
    at_ports: PortResponses,
) -> jax.Array:
    def one(responses: Any, at_ports: Any, *samples: Any) -> jax.Array:
        return law_sensitivities(effects, ports, laws, RecordingSamples(*samples), responses, at_ports)

    data, window, _ = samples
    J = each_recording(one, (0,) * 7, out_axes=1)(responses, at_ports, *data, window)
    return _of_innovations(J, data)


@persistent_jit(static=2)
def _signal_slopes(
    structure: Mechanism,
    solver: Solver,
    values: jax.Array,
    gates: jax.Array,
    directions: Directions,
    samples: ProgramSamples,
    responses: RunResponses,
) -> jax.Array:
    def one(values: Any, dvalues: Any, responses: Any, *samples: Any) -> jax.Array:
        tangents = (values, gates, dvalues, directions.gates)
        return signal_sensitivities(structure, solver, *tangents, RecordingSamples(*samples), responses)

    data, window, _ = samples
    axes = (1, 1, *(0,) * 6)
    J = each_recording(one, axes, out_axes=1)(values, directions.values, responses, *data, window)
    return _of_innovations(J, data)


@persistent_jit(static=3)
def _inactive_slopes(
    structure: Mechanism,
    solver: Solver,
    inactive: tuple[int, ...],
    parameter_set: ParameterSet,
    present: jax.Array,
    run: LinearisedRun,
    directions: Directions,
    samples: ProgramSamples,
) -> jax.Array:
    def one(values: Any, x0: Any, K: Any, run: Any, dvalues: Any, *samples: Any) -> Any:
        rest = jnp.broadcast_to(rest_state(structure, np.float64), (len(x0), K.shape[0]))
        parameters = RunParameters(values, parameter_set.gates, rest.at[:, present].set(x0), K)
        given = (parameters, RecordingSamples(*samples), present, run, dvalues, directions.gates)
        return inactive_sensitivities(structure, solver, inactive, *given)

    data, window, _ = samples
    J = each_recording(one, in_axes=(0, 0, 0, 0, 1, 0, 0, 0, 0, 0), out_axes=1)(
        parameter_set.values, parameter_set.x0, parameter_set.K, run, directions.values, *data, window
    )
    return _of_innovations(J, data)


@dataclasses.dataclass(frozen=True)
class Probe:
    """One direction of the score test.

    Attributes:
        candidate: The candidate to which the direction belongs.
        shape: Index of the shape among the candidate's probes.
        member: Index of the parameter vector within the shape.
    """

    candidate: Candidate
    shape: int
    member: int

    @property
    def values(self) -> Float[np.ndarray, " p"]:
        """Values of the candidate's parameters at which slopes are computed; amplitudes are zero."""
        c = self.candidate
        return np.where(c.amplitudes, 0.0, c.probes[self.shape][0])

    @property
    def along(self) -> Float[np.ndarray, " p"]:
        """Direction in these values; zero for a candidate without amplitudes, whose gate varies instead."""
        c = self.candidate
        return np.where(c.amplitudes, c.probes[self.shape][self.member], 0.0)

    @classmethod
    def of(cls, c: Candidate) -> "list[Probe]":
        """All probes of a candidate, shape by shape."""
        return [cls(c, shape, k) for shape, group in enumerate(c.probes) for k in range(len(group))]


def _packed(probes: Sequence[Probe]) -> list[list[Probe]]:
    """Batches of probes that share a parameter set, with at most one shape of each candidate in a batch."""
    batches: list[list[Probe]] = []
    # Candidates with most shapes need most batches, so they come first and others fill these up.
    ordered = sorted(probes, key=lambda p: -len(p.candidate.probes))
    for _, group in itertools.groupby(ordered, key=lambda p: (p.candidate.location, p.shape)):
        own = list(group)
        with_space = [b for b in batches if len(b) + len(own) <= PROBES_PER_BATCH]
        if suitable := [b for b in with_space if all(p.candidate is not own[0].candidate for p in b)]:
            suitable[0].extend(own)
        else:
            batches.append(own)
    return batches


def _with_probes(current: ParameterSet, probes: Sequence[Probe]) -> ParameterSet:
    """The hypothesis with candidates on at zero amplitude, or off where they have no amplitude."""
    values, gates = current.values.copy(), current.gates.copy()
    for p in probes:
        c = p.candidate
        values[:, c.parameters] = p.values
        gates[c.effect] = 1.0 if any(c.amplitudes) else 0.0
    return current._replace(values=values, gates=gates)


def _directions(current: ParameterSet, probes: Sequence[Probe], count: int) -> Directions:
    """Directions of probes: in the values of amplitudes, or in the gate of an effect without amplitudes."""
    (R, P), m, E = current.values.shape, current.x0.shape[-1], len(current.gates)
    d = Directions(np.zeros((count, R, P)), np.zeros((count, m)), np.zeros((count, E)))
    for row, p in enumerate(probes):
        c = p.candidate
        # A disturbance has another phase in each recording: only the recording with the line counts.
        affected = slice(None) if c.line is None else c.recordings[p.shape]
        for i, size in zip(c.parameters, p.along, strict=True):
            d.values[row, affected, i] = size
        d.gates[row, c.effect] = 0.0 if any(c.amplitudes) else 1.0
    return d


def _laws(own: Sequence[Sequence[Probe]]) -> InactiveLaws:
    """Values and directions of the laws of some candidates.

    If all shapes of a candidate have the same number of members, the members of a shape share its values.
    Otherwise each member has values of its own.
    """
    values, along = [], []
    for probes in own:
        counts = {len(list(shape)) for _, shape in itertools.groupby(probes, key=lambda p: p.shape)}
        members = counts.pop() if len(counts) == 1 else 1
        values.append(np.array([p.values for p in probes[::members]]))
        along.append(np.array([p.along for p in probes]).reshape(len(values[-1]), members, -1))
    return InactiveLaws(tuple(values), tuple(along))


class Slopes(NamedTuple):
    """Slopes of innovations along some directions.

    Attributes:
        probes: The directions.
        J: Slopes along these directions.
    """

    probes: Sequence[Probe]
    J: Float[np.ndarray, "D R N C"]


@dataclasses.dataclass(frozen=True)
class _Kinds:
    """Candidates by the way in which a run responds to them.

    Attributes:
        laws: Kind of law -> laws at ports. Laws of the hypothesis are included, so that nothing is compiled
            for the other candidates when an effect is found.
        signals: Candidates that change the voltage or a reading, including those of the hypothesis.
        others: All other candidates that are absent from the hypothesis.
    """

    laws: dict[str, list[Candidate]]
    signals: list[Candidate]
    others: list[Candidate]

    @classmethod
    def of(cls, s: SuperModel, active: ReducedModel, solver: Solver) -> "_Kinds":
        """The candidates of a super-model, given the reduced model that is active."""
        found = cls({}, [], [])
        for c in s.candidates.values():
            e, absent = s.mechanism.effects[c.effect], c.effect not in active.effects
            if c.threshold:
                continue
            at_port = e.acts_at_port
            if not adds_to_step(e, active.mechanism.structure, solver) or (at_port and c.line is not None):
                found.others.extend([c] * absent)
            elif at_port:
                kind = "friction" if e.dry_contact else e.state_part or "torque"
                found.laws.setdefault(kind, []).append(c)
            else:
                found.signals.append(c)
        return found

    def ports(self, friction: bool) -> tuple[str, ...]:
        """Ports at which laws add friction levels, or torques."""
        of_kind = (found for kind, found in self.laws.items() if (kind == "friction") == friction)
        return tuple(sorted({c.location.port for found in of_kind for c in found}))


def candidate_sensitivities(
    predictor: BatchedPredictor,
    current: ParameterSet,
    tried: Sequence[Candidate],
    window: Int[np.ndarray, "R N"],
) -> list[Slopes]:
    """Slopes of innovations along candidates that are not active.

    Programs contain all absent candidates, so nothing is compiled when a line in the spectrum comes or goes.

    Args:
        predictor: Runs hypotheses.
        current: Parameter set of the hypothesis.
        tried: Candidates to probe at all of their shapes, none of them with a threshold.
        window: Window of each sample.
    """
    s, solver = predictor.supermodel, predictor.solver
    of_signals = dataclasses.replace(solver, passes=None) if isinstance(solver, Exponential) else solver
    active = s.active(current.gates)
    structure = active.mechanism.structure
    if isinstance(solver, Exponential) and solver.passes is not None:
        # A contact with level zero never sticks, so only contacts of the hypothesis are coupled.
        solver = dataclasses.replace(solver, passes=min(solver.passes, Layout.of(structure).contacts + 1))
    kinds, asked = _Kinds.of(s, active, solver), {c.location: c for c in tried}
    with double_precision():
        inputs, samples = predictor.restrict(current, active), predictor.on_device(window)
        responses = _run_responses(structure, solver, kinds.ports(friction=False), inputs, samples)
    cut = lambda J, listed: np.asarray(J)[: len(listed), :, : window.shape[1]]  # noqa: E731

    def along_laws(kind: str) -> Slopes:
        family, ports = kinds.laws[kind], kinds.ports(kind == "friction")
        # Active or untried candidates are in the program too; their slopes are dropped at the end.
        own = [Probe.of(asked.get(c.location, c)) for c in family]
        listed = [p for group in own for p in group]
        effects = tuple(s.mechanism.structure.effects[c.effect] for c in family)
        with double_precision():
            at_ports, laws = responses.torques, _laws(own)
            if kind == "friction":
                at_ports = _friction_responses(structure, solver, ports, inputs, samples, responses.run.X)
            return Slopes(
                listed, cut(_law_slopes(effects, ports, laws, samples, responses, at_ports), listed)
            )

    def along_signals() -> Slopes:
        every = s.with_family(current.gates, kinds.signals).effects
        effects, given = s.mechanism.effects, len(s.baseline.effects)
        # Laws at ports are included only if they are in the user's model, which all hypotheses share.
        model = s.only(i for i in every if i < given or not effects[i].acts_at_port)
        listed = [p for c in kinds.signals if c.location in asked for p in Probe.of(asked[c.location])]
        count = sum(len(g) * (1 if c.line is None else MOST_LINES) for c in kinds.signals for g in c.probes)
        points = [predictor.restrict(_with_probes(current, [p]), model) for p in listed]
        points += [predictor.restrict(current, model)] * (count - len(points))
        along = _directions(current, listed, count).restrict(model)
        with double_precision():
            values, gates = (np.array([getattr(p, what) for p in points]) for what in ("values", "gates"))
            own = [active.states.index(i) for i in model.states]
            run = responses.run._replace(X=np.asarray(responses.run.X)[..., own])
            given = (values, gates, along, samples, responses._replace(run=run, torques=None))
            return Slopes(listed, cut(_signal_slopes(model.mechanism.structure, of_signals, *given), listed))

    def along_others(family: Sequence[Candidate], listed: Sequence[Probe]) -> Slopes:
        model = s.with_family(current.gates, family)
        along = _directions(current, listed, max(len(listed), PROBES_PER_BATCH)).restrict(model)
        inputs = predictor.restrict(_with_probes(current, listed), model)
        inactive = tuple(model.effects.index(c.effect) for c in family)
        with double_precision():
            present = np.array([model.states.index(i) for i in active.states])
            given = (inputs, present, responses.run, along, samples)
            return Slopes(
                listed, cut(_inactive_slopes(model.mechanism.structure, solver, inactive, *given), listed)
            )

    jobs: list[tuple[Any, Callable[[], Slopes]]] = [
        (("laws", kind, active.effects), functools.partial(along_laws, kind)) for kind in kinds.laws
    ]
    if kinds.signals:
        jobs.append((("signals", active.effects), along_signals))
    for family in [kinds.others] if kinds.laws else s.families(kinds.others):
        probes = [p for c in family if c.location in asked for p in Probe.of(asked[c.location])]
        name = ("others", active.effects, *(c.effect for c in family))
        jobs += [(name, functools.partial(along_others, family, b)) for b in _packed(probes)]
    found = predictor.run_jobs(lambda job: job[1](), jobs, lambda job: job[0])
    wanted = [[p.candidate.location in asked for p in slopes.probes] for slopes in found]
    return [Slopes(list(itertools.compress(f.probes, w)), f.J[w]) for f, w in zip(found, wanted, strict=True)]
