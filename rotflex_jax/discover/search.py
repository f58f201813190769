"""The search: fit, score, refit, decide, repeat; then leave out what is not needed and report."""

import dataclasses
import functools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from rotflex_jax import checks
from rotflex_jax.discover.checkpoint import (
    AddedEffect,
    KeptStage,
    beginning,
    digest_of_search,
    kept,
    milestone,
    not_kept,
    read_stages,
    restored,
)
from rotflex_jax.discover.conclusion import assess_stages, end_state, signs, with_proposal
from rotflex_jax.discover.discovery import Discovery
from rotflex_jax.discover.evaluation import (
    Evaluation,
    PairedEstimates,
    difference_notes,
    disagreement,
    estimates,
    evaluate,
    own_estimates,
    paired_estimates,
    process_noise_gain,
)
from rotflex_jax.discover.hypothesis import (
    CandidateStart,
    Hypothesis,
    generalisations,
    is_physical,
    parameter_count,
    without,
)
from rotflex_jax.discover.input_reading import nats_if_smooth, smooth_note
from rotflex_jax.discover.likelihood import (
    LikelihoodProblem,
    choose_process_noise,
    correct_discretisation_bias,
    refit,
)
from rotflex_jax.discover.localise import locate
from rotflex_jax.discover.pairs import find_pair, is_unexplained
from rotflex_jax.discover.probabilities import Probabilities, fitted_sets, probabilities
from rotflex_jax.discover.result import (
    ConditionalInterval,
    HorizonGain,
    Ranked,
    Round,
    Stage,
    conditional_note,
    excluding,
)
from rotflex_jax.discover.score_test import (
    Score,
    ScoreTest,
    promising_at_both,
    residual_lines,
    score_test,
)
from rotflex_jax.discover.selection import (
    best_window_rmse,
    choose,
    describe,
    helps,
    horizon_gains,
    replaced_by,
    runs_clearly_better,
    validate_from_best_states,
)
from rotflex_jax.discover.stepwise import (
    Eliminated,
    assign_calibrations,
    calibration_notes,
    disturbance_notes,
    eliminate,
    fit_baseline,
    merge_effects,
    nested_models,
    refit_candidates,
    refit_near_predictions,
    remaining_rivals,
)
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel, build, checked_candidates, scales
from rotflex_jax.discover.validation import (
    Horizons,
    SearchHorizon,
    ValidatedHypothesis,
    ValidationSet,
    as_free_run,
    validate,
)
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.effects.base import Effect
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import padded_length, prepare, process_noise_ports
from rotflex_jax.fit.plausibility import Reach, Remark, at_bounds, beyond_recordings, check_signs
from rotflex_jax.mechanism import Exponential, Mechanism
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import SHORTEST_TO_FIT, check_apart, listed
from rotflex_jax.runtime.persistent_jit import clear_compilation_caches
from rotflex_jax.runtime.xla import one_thread

Progress = Callable[[str], None]

# Candidates of both rankings together that are refitted in a round, the best of each beside them, and rounds.
REFITTED, ROUNDS = 4, 4


@dataclasses.dataclass
class SearchState:
    """What a search has found so far.

    Attributes:
        model: The user's model.
        horizons: The training and validation recordings as predictions and as free runs.
        say: Called with lines of progress.
        current: The best model so far, fitted at both horizons.
        ranking: Scores of all candidates beside the baseline, of predictions and of free runs.
        scores: Effects that were added, in order -> the penalised score that put them forward [nat].
        rivals: Effects that were added -> those that were not distinguished from them.
        passed: Baseline and the models after each round.
        worth: What the last test of need gave each effect and calibration [nat].
        order: Effects and calibrations of the machine, in order.
        own: Calibrations that belong to the training recordings alone.
        notes: Remarks for a reader.
        gains: Effects that were added -> what they gained at both horizons.
        final: The model that is reported, with the parameters of `reported`.
        tried: Models fitted and validated at both horizons on the way.
        alternatives: Models fitted and validated at the reported horizon beside the final one.
        merged: The final model with one effect in the place of several, where it has one.
        in_place_of: That effect -> the one of several whose place in the order it took.
        machine: Calibrations that belong to the machine.
        tests: Score tests of the model of `tested`, of predictions and of free runs.
        tested: The model whose score tests were made last.
        resumed: After how many rounds of a search that was stopped this one went on.
        smooth_nats: What the model gains with an input that is smooth between samples [nat]; zero if unclear.
        digest: Of all that the models depend on.
    """

    model: Model
    horizons: Horizons
    say: Progress
    current: ValidatedHypothesis
    digest: str = ""
    resumed: int = 0
    smooth_nats: float = 0.0
    ranking: list[tuple[Score, float]] = dataclasses.field(default_factory=list)
    scores: dict[EffectLocation, float] = dataclasses.field(default_factory=dict)
    rivals: dict[EffectLocation, list[EffectLocation]] = dataclasses.field(default_factory=dict)
    passed: list[ValidatedHypothesis] = dataclasses.field(default_factory=list)
    worth: dict[EffectLocation, float] = dataclasses.field(default_factory=dict)
    order: list[EffectLocation] = dataclasses.field(default_factory=list)
    own: list[EffectLocation] = dataclasses.field(default_factory=list)
    notes: tuple[str, ...] = ()
    gains: dict[EffectLocation, tuple[HorizonGain, HorizonGain | None]] = dataclasses.field(
        default_factory=dict
    )
    final: Hypothesis | None = None
    tried: list[ValidatedHypothesis] = dataclasses.field(default_factory=list)
    alternatives: list[ValidatedHypothesis] = dataclasses.field(default_factory=list)
    merged: ValidatedHypothesis | None = None
    in_place_of: dict[EffectLocation, EffectLocation] = dataclasses.field(default_factory=dict)
    machine: list[EffectLocation] = dataclasses.field(default_factory=list)
    tests: tuple[ScoreTest, ScoreTest] | None = None
    tested: Hypothesis | None = None

    @functools.cached_property
    def reach(self) -> Reach:
        """How far the signals of the training recordings go."""
        return Reach.of(self.model, self.problem.dataset.recordings)

    def is_plausible(self, h: Hypothesis, location: EffectLocation) -> bool:
        """Whether the parameters of an effect are physical, and of sizes that the recordings reach."""
        s = self.problem.supermodel
        if not is_physical(s, h, location):
            return False
        m = s.clean(h.mean_values(s), h.locations)
        return not beyond_recordings(m, self.reach, [m.effect(*location)])

    @property
    def problem(self) -> LikelihoodProblem:
        """The likelihood of predictions of the training recordings."""
        return self.horizons.prediction.problem

    @property
    def validation(self) -> ValidationSet:
        """Predictions of the validation recordings."""
        return self.horizons.prediction.validation

    @property
    def reported(self) -> SearchHorizon:
        """The horizon whose parameters a user gets: that of predictions, unless free runs are clearly better.

        Where the model is complete both give the same within their scatter, and predictions have the narrower
        intervals.
        """
        runs = self.current.free_run
        if runs is None or not runs_clearly_better(runs.window_rmse, self.current.window_rmse):
            return self.horizons.prediction
        return self.horizons.free_run

    def at(self, horizon: SearchHorizon, found: ValidatedHypothesis) -> ValidatedHypothesis:
        """A validated structure with the parameters of one horizon."""
        return found.free_run if horizon is self.horizons.free_run and found.free_run else found

    def reached(self, label: str, added: Sequence[AddedEffect] = ()) -> None:
        """Report the error of the current model, after effects were added."""
        channels, recording = self.model.mechanism.channels, self.validation.problem.dataset.recordings[0]
        units = {c: recording.units[recording.channels.index(c)] for c in channels}
        line = milestone(label, channels, units, best_window_rmse(self.current), self.problem.noise)
        if (runs := self.current.free_run) is not None:
            stage = KeptStage(kept(self.current.hypothesis), kept(runs.hypothesis), tuple(added))
            line.kept = stage.to_dict(self.digest)
        self.say(line)


@one_thread
# A refit may diverge; its cost is then not finite.
@np.errstate(over="ignore", invalid="ignore")
def discover(
    mechanism: Mechanism | Model,
    train: Recording | Sequence[Recording],
    validation: Recording | Sequence[Recording] | None = None,
    *,
    test: Recording | Sequence[Recording] | None = None,
    candidates: Iterable[tuple[type[Effect], str]] | None = None,
    rounds: int = ROUNDS,
    window_seconds: float = 2.0,
    calibrate_seconds: float = 2.0,
    resume: str | Path | None = None,
    progress: Progress | None = None,
) -> Discovery:
    """Find the physical effects that a model lacks, and say how sure that is.

    The baseline is fitted as a predictor whose process noise the data choose, and to free runs of a few
    seconds; all candidate effects are scored at once by the slopes of its errors at both horizons; the best
    are refitted at both; likelihood on validation data decides, for one effect or for a set that the
    recordings cannot distinguish. Repeated until nothing is gained, then every effect must show that the
    model is worse without it.

    Args:
        mechanism: The user's model; its parameter values are the start.
        train: Recordings to fit.
        validation: Recordings that decide between models, none of which is fitted to them; at most their own
            first state and offsets are adapted when likelihoods are compared, and only the first `n_init`
            samples for the errors reported. They also help to estimate the noise of the sensors, and the
            model that was chosen is fitted to them once, to see whether its parameters are the same there.
            Without any, every training recording validates what was fitted to the others.
        test: Recordings that have no say in anything; the errors on them are reported beside.
        candidates: (effect class, port) pairs; if None the catalogue's first family, at the places that
            answer to those of the flexible joint (`mechanism.roles`).
        rounds: Most effects to add; two that are added together count as two.
        window_seconds: Length of short free runs [s].
        calibrate_seconds: The errors reported as calibrated allow each recording that no fit saw the offsets
            that its own first seconds give [s]; 0 for none.
        resume: `NAME.stopped.json` that a stopped search of the same recordings has left: the search goes on
            after the rounds in it, which count among `rounds`.
        progress: Called with a line of text at each stage.

    Returns:
        Discovery.

    Raises:
        InputError: No recording, channels that the model lacks, or one that moves against the model; a file
            to go on from that another search has left.
    """
    started, say = time.perf_counter(), checks.progress(progress)
    clear_compilation_caches()
    model, rounds = Model.of(mechanism), checks.whole(rounds, "rounds", 0)
    checks.positive(window_seconds, "window_seconds")
    checks.number(calibrate_seconds, "calibrate_seconds", least=0, unit="s", example="2.0")
    if candidates is not None:
        candidates = checked_candidates(model.mechanism, candidates)
    trained = listed(train, "train", SHORTEST_TO_FIT)
    held_back = _several(validation, "validation")
    seen = (*trained, *held_back)
    horizons = _prepare(model, trained, held_back, candidates, window_seconds)
    tested = _several(test, "test")
    reason = "errors are reported on data that had no say; give other recordings, or leave `test` out"
    check_apart(seen, tested, "to search and to test", reason)
    evaluation = Evaluation.of(model, horizons, tested, calibrate_seconds)
    s = horizons.prediction.problem.supermodel
    digest = digest_of_search(model, s, window_seconds, trained, held_back)
    if resume is None:
        say(beginning("baseline", "fitting the model as it is"))
        state = _fit_as_it_is(model, horizons, say, digest)
    else:
        state = _as_it_was(model, horizons, say, digest, resume)
    while len(state.scores) < rounds:
        left = len(state.problem.supermodel.candidates) - len(state.scores)
        say(beginning("score", f"round {len(state.scores) + 1}: scoring {left} candidates"))
        promising_scores, starts, runs_starts = _score_candidates(state)
        if starts:
            say(beginning("refit", "refitting " + ", ".join(str(start.location) for start in starts)))
            if _decide(state, _refit(state, starts, runs_starts), promising_scores):
                continue
        if len(state.scores) + 2 > rounds or not _add_pair(state):
            break
    say(beginning("needed", "checking that each effect is needed"))
    _simplify(state)
    say(beginning("finish", "simulating the validation recordings"))
    return with_proposal(_report(state, evaluation, started))


def _several(recordings: Recording | Sequence[Recording] | None, name: str) -> tuple[Recording, ...]:
    if recordings is None or (isinstance(recordings, Sequence) and not len(recordings)):
        return ()
    return listed(recordings, name, SHORTEST_TO_FIT)


def _prepare(
    model: Model,
    train: tuple[Recording, ...],
    held_back: tuple[Recording, ...],
    candidates: Iterable[tuple[type[Effect], str]] | None,
    window_seconds: float,
) -> Horizons:
    """Training and validation recordings under one super-model, at both horizons."""
    m = model.mechanism
    if not m.free_names:
        raise InputError("All parameters are trusted, but discovery fits the model; release one.")
    if not held_back and len(train) < 2:
        raise InputError(
            "One recording was given for training and none for validation, but a search decides on data that "
            "no fit has seen; give a second recording, or the two parts of recording.split(0.7)."
        )
    _check_apart(train, held_back)
    check_signs(model, (*train, *held_back))
    dataset = prepare(model, train, length=padded_length(train), noise_of=held_back)
    wanted = list(search_places(m) if candidates is None else candidates)
    supermodel = build(m, wanted, scales(model, train, dataset.torque_scale))
    _check_constants(m, supermodel, (*train, *held_back))
    ports = tuple(process_noise_ports(m, 1.0))
    # The super-model has friction contacts at every port, of which few are ever switched on.
    solver = model.solver
    solver = dataclasses.replace(solver, passes=2) if isinstance(solver, Exponential) else solver
    problem = LikelihoodProblem.of(supermodel, solver, dataset, ports)
    if not held_back:
        return Horizons.of(model, problem, None, window_seconds)
    # One length for both, where that makes no run on training data longer, is compiled for once.
    length = max(padded_length(train), padded_length(held_back))
    of_validation = prepare(model, held_back, length=length, like=dataset)
    other = LikelihoodProblem.of(supermodel, solver, of_validation, ports)
    return Horizons.of(model, problem, other, window_seconds)


def _check_apart(train: Sequence[Recording], held_back: Sequence[Recording]) -> None:
    """Refuses data that were fitted in the place of data that no fit has seen."""
    reason = "a search decides on data that no fit has seen; give another recording, or the two parts of "
    reason += "recording.split(0.7)"
    for k, a in enumerate(train):
        check_apart([a], held_back or train[k + 1 :], "to fit and to validate", reason)


def _check_constants(m: Mechanism, s: SuperModel, recordings: Sequence[Recording]) -> None:
    """Refuses constants of effects that the search may add: it fits these."""
    added = set(s.mechanism.parameter_names) - set(m.parameter_names)
    for recording in recordings:
        if known := sorted(added & set(recording.constants)):
            raise InputError(
                f"The recording has the constant {known[0]!r}, but the model has no such effect and a search "
                "fits what it adds; add the effect to the model, or leave the constant out."
            )


def _fit_as_it_is(model: Model, horizons: Horizons, say: Progress, digest: str) -> SearchState:
    """The user's model, fitted and validated."""
    h = fit_baseline(horizons.prediction.problem)
    problem = horizons.free_run.problem
    current = horizons.validated(h, refit(problem, [as_free_run(problem, h)])[0])
    state = SearchState(model, horizons, say, current, digest, passed=[current], tried=[current])
    state.reached("as it is")
    state.smooth_nats = nats_if_smooth(state.problem, h)
    for line in smooth_note(state.smooth_nats):
        say(line)
    return state


def _as_it_was(model: Model, horizons: Horizons, say: Progress, digest: str, path: str | Path) -> SearchState:
    """What a search that was stopped had found, validated again."""
    stages = read_stages(path, digest)
    say(f"going on after {len(stages) - 1} finished rounds")
    # All of them before any is reported: what is reported is what a file of rounds so far keeps.
    found: list[ValidatedHypothesis] = []
    for stage in stages:
        try:
            h = restored(horizons.prediction.problem, stage.prediction)
            runs = restored(horizons.free_run.problem, stage.free_run)
        except (ArithmeticError, AttributeError, IndexError, KeyError, TypeError, ValueError):
            raise not_kept(path) from None
        found.append(horizons.validated(h, runs, found[-1] if found else None))
    first, *later = found
    state = SearchState(model, horizons, say, first, digest, len(later), passed=[first], tried=[first])
    if later:
        _rank(state)
    state.reached("as it is")
    for reached, stage in zip(later, stages[1:], strict=True):
        _add(state, reached, stage.added)
    return state


def _rank(state: SearchState) -> tuple[list[Score], list[Score]]:
    """Scores of all candidates beside the current model, of predictions and of free runs."""
    listed, runs = (test.listed for test in _score_tests(state, state.current))
    if not state.ranking:
        by_runs = {x.location: x.nats for x in runs}
        state.ranking = [(x, by_runs[x.location]) for x in listed]
    return listed, runs


def _score_tests(state: SearchState, beside: ValidatedHypothesis) -> tuple[ScoreTest, ScoreTest]:
    """Score tests of predictions and of free runs beside a model; those made last are kept."""
    assert beside.free_run
    if state.tests is None or state.tested is not beside.hypothesis:
        state.tested = beside.hypothesis
        lines = residual_lines(state.problem, beside.hypothesis)
        state.tests = (
            score_test(state.problem, beside.hypothesis, lines),
            score_test(state.horizons.free_run.problem, beside.free_run.hypothesis, lines),
        )
    return state.tests


def _score_candidates(
    state: SearchState,
) -> tuple[list[Score], list[CandidateStart], list[CandidateStart]]:
    """Scores worth a refit, and starts at both horizons: theirs, and effects that contain one that is on."""
    current, s = state.current, state.problem.supermodel
    listed, runs = _rank(state)
    chosen = promising_at_both(listed, runs, REFITTED)
    known = {x.location for x, _ in chosen}
    further = [c for c in generalisations(s, current.hypothesis) if c.location not in known]
    return (
        [x for x, _ in chosen],
        [*(x.start for x, _ in chosen), *further],
        [*(y.start for _, y in chosen), *further],
    )


def _refit(
    state: SearchState, starts: list[CandidateStart], runs_starts: list[CandidateStart]
) -> list[ValidatedHypothesis]:
    """The current model with each candidate, refitted and validated; what is not plausible is left out."""
    current, s, horizons = state.current, state.problem.supermodel, state.horizons
    assert current.free_run
    grown = refit_candidates(state.problem, current.hypothesis, starts)
    # A shape that predictions have found is worth a start of free runs.
    informed = [
        dataclasses.replace(y, others=(*y.others, h.mean_values(s)[s.parameter_indices(y.location)]))
        for y, h in zip(runs_starts, grown, strict=True)
    ]
    problem = horizons.free_run.problem
    runs = refit_candidates(problem, current.free_run.hypothesis, informed)
    runs = refit_near_predictions(problem, runs, grown)
    validated = [
        dataclasses.replace(
            horizons.validated(h, f, current),
            location=c.location,
            parameter_count=parameter_count(s, h, c.location),
        )
        for h, f, c in zip(grown, runs, starts, strict=True)
        if state.is_plausible(h, c.location) and state.is_plausible(f, c.location)
    ]
    validated = validate_from_best_states(state.validation, validated)
    state.tried += validated
    return validated


def _decide(state: SearchState, candidates: list[ValidatedHypothesis], scored: list[Score]) -> bool:
    """Add the candidate that validation data prefer; False where they prefer none."""
    data, current = state.problem.dataset.data, state.current
    for candidate in candidates:
        state.say("  " + describe(candidate, current))
    winner, rivals = choose(candidates, current, data, state.problem.noise)
    if winner is None or winner.location is None:
        return False
    if more := _refit_replaced(state, winner, [c.location for c in candidates if c.location]):
        scored = [*scored, *(s for s, _ in more)]
        winner, rivals = choose([*candidates, *(c for _, c in more)], current, data, state.problem.noise)
        assert winner and winner.location
    nats = next((s.nats for s in scored if s.location == winner.location), 0.0)
    not_distinguished = tuple(r.location for r in rivals if r.location)
    added = AddedEffect(winner.location, nats, not_distinguished, horizon_gains(winner, current))
    _add(state, winner, [added])
    return True


def _refit_replaced(
    state: SearchState, winner: ValidatedHypothesis, tried: Sequence[EffectLocation]
) -> list[tuple[Score, ValidatedHypothesis]]:
    """Candidates in whose place the winner may stand, refitted without it, where it leaves something."""
    if not is_unexplained(state.horizons, winner):
        return []
    before = tuple(t.listed for t in _score_tests(state, state.current))
    after = tuple(t.listed for t in _score_tests(state, winner))
    assert winner.location
    locations = replaced_by(winner.location, before, after, tried)
    if not locations:
        return []
    state.say("refitting what it may stand for: " + ", ".join(map(str, locations)))
    first, second = ({x.location: x for x in listed} for listed in before)
    more = _refit(state, [first[p].start for p in locations], [second[p].start for p in locations])
    for candidate in more:
        state.say("  " + describe(candidate, state.current))
    return [(first[c.location], c) for c in more if c.location]


def _add_pair(state: SearchState) -> bool:
    """Add two effects that are needed together, where something is left; False where there are none."""
    if state.tests is None or not is_unexplained(state.horizons, state.current):
        return False
    state.say(beginning("pairs", "scoring pairs of candidates"))
    tests = _score_tests(state, state.current)
    pair, tried = find_pair(state.horizons, state.current, tests, state.is_plausible, state.say, state.tried)
    state.tried += tried
    if pair is None:
        return False
    nats = {x.location: x.nats for x in tests[0].listed}
    _add(
        state,
        pair.found,
        [
            AddedEffect(p, nats.get(p, 0.0), tuple(pair.rivals[p]), horizon_gains(pair.found, less))
            for p, less in pair.members.items()
        ],
    )
    return True


def _add(state: SearchState, found: ValidatedHypothesis, added: Sequence[AddedEffect]) -> None:
    """One model more, with the effects that led to it."""
    for effect in added:
        state.scores[effect.location] = effect.score
        state.rivals[effect.location] = list(effect.rivals)
        state.gains[effect.location] = effect.gains
    state.current = dataclasses.replace(found, location=None, parameter_count=0)
    state.passed.append(state.current)
    state.reached("+ " + " + ".join(str(effect.location) for effect in added), added)


def _simplify(state: SearchState) -> None:
    """Leave out what is not needed, assign calibrations, merge effects, correct the discretisation bias."""
    horizons, added = state.horizons, list(state.scores)
    assert state.current.free_run
    needed = eliminate(horizons, state.current.hypothesis, state.current.free_run.hypothesis, added)
    final, state.worth = needed.prediction, needed.worth
    state.current = horizons.validated(final, needed.free_run, state.current)
    state.tried.insert(0, state.current)
    order = [p for p in added if p in final.locations]
    order += sorted(set(final.locations) - set(order), key=lambda p: -state.worth[p])
    reported = state.reported
    problem, validation = reported.problem, reported.validation
    assigned = assign_calibrations(problem, validation, state.at(reported, state.current).hypothesis, order)
    final, order, notes = assigned.final, assigned.order, assigned.notes
    found = [p for p in order if p in state.scores]
    rivals, swapped = remaining_rivals(problem, validation, final, state.rivals, found)
    state.machine = [p for p in order if p not in state.scores]
    state.alternatives = [*swapped, *(_left_out(state, needed) if reported is horizons.prediction else ())]
    if one := merge_effects(problem, validation, final, order):
        final, notes = one.final, (*notes, one.note)
        state.scores[one.effect] = state.scores[one.simpler]
        state.gains[one.effect] = state.gains[one.simpler]
        state.in_place_of[one.effect] = one.simpler
        order = [one.effect if p == one.simpler else p for p in order if p not in one.replaced[1:]]
        state.merged = one.validated
        rivals[one.effect] = [*rivals.get(one.simpler, []), *(one.replaced if one.same_count else ())]
    state.order, state.own, state.notes, state.rivals = order, assigned.own, notes, rivals
    state.final = correct_discretisation_bias(problem, final)


def _left_out(state: SearchState, needed: Eliminated) -> list[ValidatedHypothesis]:
    """The final model without each effect, on validation data; only those that no round has fitted."""
    s = state.problem.supermodel
    if state.validation.folds:  # a fit for each recording, for a comparison that decides nothing
        return []
    known = {frozenset(v.hypothesis.locations) - set(s.calibrations) for v in state.tried}
    return [
        validate(state.validation, h, state.current)
        for h in needed.without
        if frozenset(h.locations) - set(s.calibrations) not in known
    ]


def _probabilities(state: SearchState, is_explained: bool) -> Probabilities:
    """Probabilities of the sets that were fitted, the one that is reported first."""
    reported, horizons = state.reported, state.horizons
    sets = fitted_sets(horizons, state.tried, state.alternatives, reported, state.machine)
    if state.merged:
        sets = fitted_sets(horizons, (), [state.merged], reported, ()) + sets
    return probabilities(sets, is_explained=is_explained)


def _report(state: SearchState, evaluation: Evaluation, started: float) -> Discovery:
    """Every nested model evaluated, the error of the baseline localised, and the verdict."""
    reported, model, order = state.reported, state.model, state.order
    problem, validation, final = reported.problem, reported.validation, state.final
    assert final
    passed = [state.at(reported, v).hypothesis for v in state.passed]
    models = nested_models(problem, final, order, state.own, passed)
    near = state.at(reported, state.current)
    validated = [validate(validation, h, near) for h in models]
    stages = []
    for k, v in enumerate(validated):
        stage = evaluate(problem, validation, model.solver, v, order[:k])
        stage = _with_process_noise(state, stage, v.hypothesis)
        stages.append(evaluation.of_stage(stage, v, order[:k]))
    train, held_back = problem.dataset.recordings, validation.problem.dataset.recordings
    longest, channels = max((*train, *held_back), key=lambda r: r.N), model.mechanism.channels
    seconds, noise = validation.window_seconds, problem.noise
    residual = model.measured(longest) - stages[0].model.simulate_windows(longest, seconds)
    floor = dict(zip(channels, noise.tolist(), strict=True))
    pairs = paired_estimates(reported, validated[-1], stages[-1].estimates)
    m = stages[-1].model.mechanism
    remarks = (*at_bounds(stages[-1].estimates), *beyond_recordings(m, state.reach))
    explained = assess_stages(stages[0], stages[-1], floor, held_back).is_explained
    rounds = _rounds(state, stages, pairs, remarks, {} if explained else _stand_ins(state))
    conditional = _conditional(state)
    listed = [s for s, _ in state.ranking]
    verdict, sentence = end_state(stages[0], rounds, stages[-1], floor, listed, held_back)
    return Discovery(
        verdict=verdict,
        sentence=sentence,
        train=train,
        validation=held_back,
        test=evaluation.recordings,
        baseline=stages[0],
        rounds=rounds,
        ranking=tuple(
            Ranked(*s.location, s.nats, s.excited, s.orthogonal_fraction, s.detection_limit, runs)
            for s, runs in state.ranking
        ),
        where=locate(longest, residual, channels, noise, model.mechanism, window_seconds=seconds),
        noise_floor=floor,
        elapsed_s=time.perf_counter() - started,
        notes=(
            *smooth_note(state.smooth_nats),
            *_resumed(state.resumed),
            *conditional_note(conditional),
            *calibration_notes(problem.supermodel, validated[-1], state.own),
            *disturbance_notes(problem.supermodel, validated[-1]),
            *difference_notes(problem.supermodel, pairs),
            *state.notes,
            *(f"{remark.sentence}." for remark in remarks),
        ),
        remarks=remarks,
        probabilities=_probabilities(state, verdict is not Verdict.UNEXPLAINED),
        conditional=conditional,
    )


def _conditional(state: SearchState) -> tuple[ConditionalInterval, ...]:
    """Parameters of the machine on which predictions and free runs of the final structure do not agree."""
    horizons, s = state.horizons, state.problem.supermodel
    if (runs := state.current.free_run) is None:
        return ()
    own = {s.mechanism.parameter_names[i] for i in state.current.hypothesis.local}
    each = (
        [e for e in estimates(at.problem, found.hypothesis) if e.name not in own]
        for at, found in ((horizons.prediction, state.current), (horizons.free_run, runs))
    )
    return excluding(*each)


def _resumed(count: int) -> tuple[str, ...]:
    """That a search went on from what another one had found, in a sentence."""
    if not count:
        return ()
    found = "one round" if count == 1 else f"{count} rounds"
    return (
        f"The search went on after {found} of one that was stopped; the time, and the sets of effects that "
        "have a probability, are those of the rest.",
    )


def _with_process_noise(state: SearchState, stage: Stage, h: Hypothesis) -> Stage:
    """A stage with the process noise that predictions with its parameters ask for."""
    problem = state.problem
    if stage.horizon == "prediction":
        return stage
    near = state.current.hypothesis
    # First states that were fitted: a run from measured ones drifts, which would count as random torque.
    fitted = dataclasses.replace(h, x0=near.initial_state_for(problem.supermodel, h.locations))
    start = problem.with_process_noise(fitted, near.process_noise)
    h = problem.evaluated(start, problem.innovations([start])[0])
    h = choose_process_noise(problem, h, wide=True)
    gain = process_noise_gain(problem, h)
    return dataclasses.replace(stage, process_noise=h.process_noise, process_noise_nats=gain)


def _rounds(
    state: SearchState,
    stages: Sequence[Stage],
    pairs: Sequence[PairedEstimates],
    remarks: Sequence[Remark],
    stands_in: Mapping[EffectLocation, tuple[str, ...]],
) -> tuple[Round, ...]:
    """What was added, in order, each effect with the stage that it led to.

    Args:
        state: What was found.
        stages: Models, each with one effect more.
        pairs: The last one fitted to different recordings.
        remarks: On parameters of the last one.
        stands_in: Signs that effects of an unexplained model stand in for something else.
    """
    mechanism = stages[-1].model.mechanism
    return tuple(
        Round(
            effect=location.effect,
            port=location.port,
            equivalent=tuple(state.rivals.get(location, [])),
            parameters=own_estimates(stage, location),
            stage=stage,
            score=state.scores.get(location, state.worth.get(location, 0.0)),
            held_out_gain_nats=_gain_of_predictions(state, location, stage, before),
            sentence=mechanism.sentence(mechanism.effect(*location)),
            equation=mechanism.effect(*location).equation,
            doubts=(
                *_doubts(state, location, pairs),
                *_beyond(remarks, location),
                *stands_in.get(location, ()),
            ),
            prediction=state.gains.get(location, (None, None))[0],
            free_run=state.gains.get(location, (None, None))[1],
        )
        for location, before, stage in zip(state.order, stages, stages[1:], strict=False)
    )


def _stand_ins(state: SearchState) -> dict[EffectLocation, tuple[str, ...]]:
    """Signs that effects stand in for something else, of the final model at both horizons."""
    gains = {p: at.gain + at.training_gain for p, (at, _) in state.gains.items()}
    found = signs((state.horizons.prediction, state.horizons.free_run), state.current, gains)
    # One effect in the place of several has the signs of the one whose place in the order it took.
    return found | {new: found[old] for new, old in state.in_place_of.items() if old in found}


def _gain_of_predictions(state: SearchState, location: EffectLocation, stage: Stage, before: Stage) -> float:
    """Log-likelihood of predictions that an effect gains on validation data [nat]; NaN if unknown."""
    if stage.horizon == "prediction":
        return stage.log_likelihood - before.log_likelihood
    if location in state.gains:
        return state.gains[location][0].gain
    current, s = state.current, state.problem.supermodel
    if location not in current.hypothesis.locations:
        return float("nan")
    # A calibration of a model whose parameters are those of free runs.
    less = refit(state.problem, [without(s, current.hypothesis, location)], alternations=1)[0]
    return current.log_likelihood - validate(state.validation, less, current).log_likelihood


def _beyond(remarks: Sequence[Remark], location: EffectLocation) -> tuple[str, ...]:
    """Which numbers of an effect the recordings do not speak for."""
    head = f"{location.port}.{location.effect}."
    return tuple(
        r.sentence for r in remarks if r.kind == "beyond the recordings" and r.parameter.startswith(head)
    )


def _doubts(
    state: SearchState, location: EffectLocation, pairs: Sequence[PairedEstimates]
) -> tuple[str, ...]:
    """Why an effect that is distinguished from others may still stand in for something else, in words."""
    if location not in state.gains:  # a calibration, which has shown by other means that the machine has it
        return ()
    reasons = []
    prediction, runs = state.gains[location]
    if not helps(prediction):
        reasons.append("predictions on validation data are no better with it")
    if runs is not None and not helps(runs):
        reasons.append("free runs over validation data are no better with it")
    differs = disagreement(pairs, location)
    return (*reasons, differs) if differs else tuple(reasons)
