"""The search: fit, score, refit, decide, repeat; then leave out what is not needed and report."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.bias_correction import correct_discretisation_bias
from rotflex_jax.discover.discovery import Discovery
from rotflex_jax.discover.end_state import end_state
from rotflex_jax.discover.hypothesis import CandidateStart, Hypothesis, generalisations, is_physical
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.localise import locate
from rotflex_jax.discover.proposal import with_proposal
from rotflex_jax.discover.result import Ranked, Round, Stage
from rotflex_jax.discover.score_test import Score, promising, scores
from rotflex_jax.discover.selection import choose, describe, validate_from_best_states
from rotflex_jax.discover.stepwise import (
    assign_calibrations,
    calibration_notes,
    eliminate,
    fit_baseline,
    merge_effects,
    nested_models,
    refit_candidates,
    remaining_rivals,
)
from rotflex_jax.discover.supermodel import EffectLocation, build, scales
from rotflex_jax.discover.validation import (
    ValidatedHypothesis,
    ValidationSet,
    evaluate,
    own_estimates,
    validate,
)
from rotflex_jax.effects.base import Effect
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import padded_length, prepare, process_noise_ports
from rotflex_jax.fit.signs import check_signs
from rotflex_jax.mechanism import Exponential, Mechanism
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.persistent_jit import clear_compilation_caches
from rotflex_jax.runtime.xla import one_thread
from rotflex_jax.text.numbers import as_read


class Milestone(str):
    """A line with the validation error of a model that was reached.

    Attributes:
        label: What the model is.
        errors: Channel -> error of short free runs [unit of the channel].
        floor: Channel -> noise of the sensor [unit of the channel].
        units: Channel -> unit in which people read it.
        factors: Channel -> what its own unit is in that one.
    """

    label: str
    errors: dict[str, float]
    floor: dict[str, float]
    units: dict[str, str]
    factors: dict[str, float]


def milestone(
    label: str,
    channels: Sequence[str],
    units: Mapping[str, str],
    errors: Float[np.ndarray, " C"],
    floor: Float[np.ndarray, " C"],
) -> Milestone:
    """A line with the errors that it names.

    Args:
        label: What the model is.
        channels: Outputs of the model, in order.
        units: Channel -> its own unit.
        errors: Validation error of short free runs, by channel. While a search runs, their first states
            are fitted; its result has the errors from states estimated from the first samples alone.
        floor: Noise of the sensor, by channel.

    >>> line = milestone("+ coulomb at hub", ["theta"], {"theta": "rad"}, np.array([0.01]), np.array([5e-4]))
    >>> line, line.errors
    ('+ coulomb at hub: held-out error theta 0.573 deg', {'theta': 0.01})
    """
    read = {c: as_read(1.0, units[c]) for c in channels}
    by_name = dict(zip(channels, (float(e) for e in errors), strict=True))
    listed = ", ".join(f"{c} {read[c][0] * e:.3g} {read[c][1]}" for c, e in by_name.items())
    line = Milestone(f"{label}: held-out error {listed}")
    line.label, line.errors = label, by_name
    line.floor = dict(zip(channels, (float(f) for f in floor), strict=True))
    line.units = {c: unit for c, (_, unit) in read.items()}
    line.factors = {c: factor for c, (factor, _) in read.items()}
    return line


Progress = Callable[[str], None]

# Candidates that are refitted in a round, and rounds at most.
REFITTED, ROUNDS = 4, 4


@dataclasses.dataclass
class SearchState:
    """What a search has found so far.

    Attributes:
        model: The user's model.
        problem: The likelihood of the training recordings.
        validation: The validation recordings.
        say: Called with lines of progress.
        current: The best model so far.
        ranking: Scores of all candidates beside the baseline.
        scores: Effects that were added, in order -> the penalised score that put them forward [nat].
        rivals: Effects that were added -> those that were not distinguished from them.
        passed: Baseline and the models after each round.
        worth: What the last test of need gave each effect and calibration [nat].
        order: Effects and calibrations of the machine, in order.
        own: Calibrations that belong to the training recordings alone.
        notes: Remarks for a reader.
    """

    model: Model
    problem: LikelihoodProblem
    validation: ValidationSet
    say: Progress
    current: ValidatedHypothesis
    ranking: list[Score] = dataclasses.field(default_factory=list)
    scores: dict[EffectLocation, float] = dataclasses.field(default_factory=dict)
    rivals: dict[EffectLocation, list[EffectLocation]] = dataclasses.field(default_factory=dict)
    passed: list[Hypothesis] = dataclasses.field(default_factory=list)
    worth: dict[EffectLocation, float] = dataclasses.field(default_factory=dict)
    order: list[EffectLocation] = dataclasses.field(default_factory=list)
    own: list[EffectLocation] = dataclasses.field(default_factory=list)
    notes: tuple[str, ...] = ()

    def reached(self, label: str) -> None:
        """Report the error of the current model."""
        channels, recording = self.model.mechanism.channels, self.validation.problem.dataset.recordings[0]
        units = {c: recording.units[recording.channels.index(c)] for c in channels}
        self.say(milestone(label, channels, units, self.current.window_rmse, self.problem.noise))


@one_thread
# A refit may diverge; its cost is then not finite.
@np.errstate(over="ignore", invalid="ignore")
def discover(
    mechanism: Mechanism | Model,
    train: Recording | Sequence[Recording],
    test: Recording | Sequence[Recording],
    *,
    candidates: Iterable[tuple[type[Effect], str]] | None = None,
    rounds: int = ROUNDS,
    window_seconds: float = 2.0,
    progress: Progress | None = None,
) -> Discovery:
    """Find the physical effects that a model lacks, and say how sure that is.

    The baseline is fitted as a predictor whose process noise the data choose; all candidate effects are
    scored at once by the slope of its innovations; the best are refitted; likelihood on validation data
    decides, for one effect or for a set that the recordings cannot distinguish. Repeated until nothing is
    gained, then every effect must show that the model is worse without it.

    Args:
        mechanism: The user's model; its parameter values are the start.
        train: Recordings to fit.
        test: Validation recordings, which no fit sees; at most their own first state and offsets are adapted
            when likelihoods are compared, and only the first `n_init` samples for the errors reported.
        candidates: (effect class, port) pairs; if None the catalogue's first family, at the places that
            answer to those of the flexible joint (`mechanism.roles`).
        rounds: Most effects to add.
        window_seconds: Length of the windows of the short validation runs [s].
        progress: Called with a line of text at each stage.

    Returns:
        Discovery.

    Raises:
        InputError: No recording, channels that the model lacks, or one that moves against the model.
    """
    started, say = time.perf_counter(), progress or (lambda _: None)
    clear_compilation_caches()
    model = mechanism if isinstance(mechanism, Model) else Model(mechanism)
    problem, validation = _prepare(model, _several(train), _several(test), candidates, window_seconds)
    say("fitting the model as it is")
    state = _fit_as_it_is(model, problem, validation, say)
    for number in range(rounds):
        left = len(problem.supermodel.candidates) - len(state.scores)
        say(f"round {number + 1}: scoring {left} candidates")
        promising_scores, starts = _score_candidates(state)
        if not starts:
            break
        say("refitting " + ", ".join(str(start.location) for start in starts))
        refitted = _refit(state, starts)
        if not _decide(state, refitted, promising_scores):
            break
    say("checking that each effect is needed")
    _simplify(state)
    say("simulating the validation recordings")
    return with_proposal(_report(state, started))


def _several(recordings: Recording | Sequence[Recording]) -> tuple[Recording, ...]:
    return (recordings,) if isinstance(recordings, Recording) else tuple(recordings)


def _prepare(
    model: Model,
    train: tuple[Recording, ...],
    held_back: tuple[Recording, ...],
    candidates: Iterable[tuple[type[Effect], str]] | None,
    window_seconds: float,
) -> tuple[LikelihoodProblem, ValidationSet]:
    """The likelihood of training and of validation recordings under one super-model."""
    m = model.mechanism
    if not m.free_names:
        raise InputError("All parameters are trusted, but discovery fits the model; release one.")
    check_signs(model, (*train, *held_back))
    dataset = prepare(model, train, length=padded_length(train), noise_of=held_back)
    wanted = list(search_places(m) if candidates is None else candidates)
    supermodel = build(m, wanted, scales(model, train, dataset.torque_scale))
    ports = tuple(process_noise_ports(m, 1.0))
    # The super-model has friction contacts at every port, of which few are ever switched on.
    solver = model.solver
    solver = dataclasses.replace(solver, passes=2) if isinstance(solver, Exponential) else solver
    # One length for both, where that makes no run on training data longer, is compiled for once.
    length = max(padded_length(train), padded_length(held_back))
    of_validation = prepare(model, held_back, length=length, like=dataset)
    problem = LikelihoodProblem.of(supermodel, solver, dataset, ports)
    other = LikelihoodProblem.of(supermodel, solver, of_validation, ports)
    return problem, ValidationSet(other, window_seconds)


def _fit_as_it_is(
    model: Model, problem: LikelihoodProblem, validation: ValidationSet, say: Progress
) -> SearchState:
    """The user's model, fitted and validated."""
    current = validate(validation, fit_baseline(problem))
    state = SearchState(model, problem, validation, say, current, passed=[current.hypothesis])
    state.reached("as it is")
    return state


def _score_candidates(state: SearchState) -> tuple[list[Score], list[CandidateStart]]:
    """Scores worth a refit, and all starts: theirs, and effects that contain one that is on."""
    listed = scores(state.problem, state.current.hypothesis)
    state.ranking = state.ranking or listed
    chosen = promising(listed, REFITTED)
    further = generalisations(state.problem.supermodel, state.current.hypothesis)
    known = {s.location for s in chosen}
    return chosen, [*(s.start for s in chosen), *(c for c in further if c.location not in known)]


def _refit(state: SearchState, starts: list[CandidateStart]) -> list[ValidatedHypothesis]:
    """The current model with each candidate, refitted and validated; those that are not physical left out."""
    current, s = state.current, state.problem.supermodel
    grown = refit_candidates(state.problem, current.hypothesis, starts)
    validated = [
        dataclasses.replace(
            validate(state.validation, h, current), location=c.location, parameter_count=len(c.values)
        )
        for h, c in zip(grown, starts, strict=True)
        if is_physical(s, h, c.location)
    ]
    return validate_from_best_states(state.validation, validated)


def _decide(state: SearchState, candidates: list[ValidatedHypothesis], scored: list[Score]) -> bool:
    """Add the candidate that validation data prefer; False where they prefer none."""
    data, current = state.problem.dataset.data, state.current
    for candidate in candidates:
        state.say("  " + describe(candidate, current, data))
    winner, rivals = choose(candidates, current, data, state.problem.noise)
    if winner is None or winner.location is None:
        return False
    location = winner.location
    state.scores[location] = next((s.nats for s in scored if s.location == location), 0.0)
    state.rivals[location] = [r.location for r in rivals if r.location]
    state.current = dataclasses.replace(winner, location=None, parameter_count=0)
    state.passed.append(winner.hypothesis)
    state.reached(f"+ {location}")
    return True


def _simplify(state: SearchState) -> None:
    """Leave out what is not needed, assign calibrations, merge effects, correct the discretisation bias."""
    problem, validation, added = state.problem, state.validation, list(state.scores)
    final, state.worth = eliminate(problem, state.current.hypothesis, added)
    order = [p for p in added if p in final.locations]
    order += sorted(set(final.locations) - set(order), key=lambda p: -state.worth[p])
    assigned = assign_calibrations(problem, validation, final, order)
    final, order, notes = assigned.final, assigned.order, assigned.notes
    found = [p for p in order if p in state.scores]
    rivals = remaining_rivals(problem, validation, final, state.rivals, found)
    if one := merge_effects(problem, validation, final, order):
        final, notes = one.final, (*notes, one.note)
        state.scores[one.effect] = state.scores[one.simpler]
        order = [one.effect if p == one.simpler else p for p in order if p not in one.replaced[1:]]
        rivals[one.effect] = [*rivals.get(one.simpler, []), *(one.replaced if one.same_count else ())]
    state.order, state.own, state.notes, state.rivals = order, assigned.own, notes, rivals
    final = correct_discretisation_bias(problem, final)
    state.current = dataclasses.replace(state.current, hypothesis=final)


def _report(state: SearchState, started: float) -> Discovery:
    """Every nested model evaluated, the error of the baseline localised, and the verdict."""
    problem, validation, model, order = state.problem, state.validation, state.model, state.order
    models = nested_models(problem, state.current.hypothesis, order, state.own, state.passed)
    validated = [validate(validation, h, state.current) for h in models]
    stages = [evaluate(problem, validation, model.solver, v, order[:k]) for k, v in enumerate(validated)]
    train, held_back = problem.dataset.recordings, validation.problem.dataset.recordings
    longest, channels = max((*train, *held_back), key=lambda r: r.N), model.mechanism.channels
    seconds, noise = validation.window_seconds, problem.noise
    residual = model.measured(longest) - stages[0].model.simulate_windows(longest, seconds)
    floor = dict(zip(channels, noise.tolist(), strict=True))
    rounds = _rounds(state, stages)
    verdict, sentence = end_state(rounds, stages[-1], floor, state.ranking, held_back)
    return Discovery(
        verdict=verdict,
        sentence=sentence,
        train=train,
        test=held_back,
        baseline=stages[0],
        rounds=rounds,
        ranking=tuple(
            Ranked(*s.location, s.nats, s.excited, s.orthogonal_fraction, s.detection_limit)
            for s in state.ranking
        ),
        where=locate(longest, residual, channels, noise, model.mechanism, window_seconds=seconds),
        noise_floor=floor,
        elapsed_s=time.perf_counter() - started,
        notes=(*calibration_notes(problem.supermodel, validated[-1], state.own), *state.notes),
    )


def _rounds(state: SearchState, stages: Sequence[Stage]) -> tuple[Round, ...]:
    """What was added, in order, each effect with the stage that it led to."""
    mechanism = stages[-1].model.mechanism
    return tuple(
        Round(
            effect=location.effect,
            port=location.port,
            equivalent=tuple(state.rivals.get(location, [])),
            parameters=own_estimates(stage, location),
            stage=stage,
            score=state.scores.get(location, state.worth.get(location, 0.0)),
            held_out_gain_nats=stage.log_likelihood - before.log_likelihood,
            sentence=mechanism.sentence(mechanism.effect(*location)),
            equation=mechanism.effect(*location).equation,
        )
        for location, before, stage in zip(state.order, stages, stages[1:], strict=False)
    )
