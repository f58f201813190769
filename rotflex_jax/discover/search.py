"""The search: prepare, fit, score, refit and decide, leave out, evaluate, and the verdict."""

import dataclasses
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rotflex_jax import checks
from rotflex_jax.checks import Progress
from rotflex_jax.discover.checkpoint import beginning, digest_of_search
from rotflex_jax.discover.conclusion import with_proposal
from rotflex_jax.discover.discovery import Discovery
from rotflex_jax.discover.evaluation import Evaluation
from rotflex_jax.discover.forward_selection import (
    ROUNDS,
    add_best,
    add_dry_friction,
    add_pair,
    score_candidates,
)
from rotflex_jax.discover.in_place import take_better_laws, undecided_rivals
from rotflex_jax.discover.integration_step import (
    correct_discretisation_bias,
    finer_integration,
    shorten_steps,
)
from rotflex_jax.discover.likelihood import LikelihoodProblem, refit
from rotflex_jax.discover.pairs import is_unexplained, pairs_passed_by
from rotflex_jax.discover.result import KnownRuns, longest_recording
from rotflex_jax.discover.search_state import SearchState, as_it_was, fit_as_it_is
from rotflex_jax.discover.selection import is_poor
from rotflex_jax.discover.stepwise import (
    Eliminated,
    assign_calibrations,
    eliminate,
    merge_effects,
    remaining_rivals,
)
from rotflex_jax.discover.summary import conclude, evaluate_models
from rotflex_jax.discover.supermodel import SuperModel, build, checked_candidates, scales
from rotflex_jax.discover.validation import (
    Horizons,
    ValidatedHypothesis,
    as_free_run,
    as_prediction,
    validate,
)
from rotflex_jax.effects.base import Effect
from rotflex_jax.effects.labels import effect_phrase
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import padded_length, padded_windows, prepare, process_noise_ports
from rotflex_jax.fit.plausibility import check_signs
from rotflex_jax.mechanism import Exponential, Mechanism
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.models.model import Model, program_length
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import (
    SHORTEST_TO_FIT,
    check_apart,
    common_signals,
    listed,
    listed_if_given,
)
from rotflex_jax.runtime.persistent_jit import clear_compilation_caches, loaded_ahead
from rotflex_jax.runtime.xla import on_threads, one_thread

# A second fit of the same model replaces the first one if it is likelier by more than this [nat].
BETTER_FIT_NATS = 1.0


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
    """Find the physical effects that a model lacks, and how certain each of them is.

    The baseline is fitted to predictions, together with its process noise, and to free runs of a few seconds.
    The score test rates all candidates at once at both horizons, by the slopes of the errors. The best
    candidates are refitted at both horizons. Validation data then decide for one effect, or for a set of
    effects that the recordings cannot distinguish. This is repeated until no candidate passes. At the end, an
    effect is left out if the model is no worse without it.

    Args:
        mechanism: The user's model; its parameter values are the start.
        train: Training recordings, to which models are fitted.
        validation: Validation recordings, which decide between models; no model is fitted to them before it
            is chosen. For the comparison of likelihoods, only first states and offsets are fitted to them,
            and friction that differs from that of the training run if they are of another run. For reported
            errors, first states come from the first `n_init` samples, and such friction and size and phase of
            a periodic disturbance from the whole recording. They also help to estimate the noise of the
            sensors. The final model is fitted to them once, to compare its parameters. If the search ends
            unexplained, `Discovery.model` is fitted to them as well. Without validation recordings, every
            training recording validates what was fitted to the others.
        test: Test recordings, used for no fit and no choice; errors on them are reported.
        candidates: (effect class, port) pairs; if None, the effects of the catalogue that a search tries, at
            the places that correspond to their places on the flexible joint (`mechanism.roles`). Each of the
            `signals` that all recordings have is tried as a torque at each of these ports.
        rounds: Largest number of effects to add; two effects that are added together count as two.
        window_seconds: Length of short free runs [s].
        calibrate_seconds: For errors that are reported as calibrated, offsets are fitted to this length at
            the beginning of each validation and test recording [s]; 0 to leave these errors out.
        resume: `NAME.stopped.json` that a stopped search of the same recordings has left. The search
            continues after the rounds in this file, which count among `rounds`.
        progress: Called with a line of text at each stage.

    Returns:
        Discovery.

    Raises:
        InputError: If there is no recording, if a recording lacks a channel of the model or moves against the
            signs of the model, or if another search has left the file to continue from.
    """
    started, say = time.perf_counter(), checks.progress(progress)
    clear_compilation_caches()
    model, rounds = Model.of(mechanism).without_gates(), checks.whole(rounds, "rounds", 0)
    checks.positive(window_seconds, "window_seconds")
    checks.number(calibrate_seconds, "calibrate_seconds", least=0, unit="s", example="2.0")
    # 1. Prepare: one super-model with every candidate built in, the recordings at both horizons.
    trained = listed(train, "train", SHORTEST_TO_FIT)
    held_back, tested = (
        listed_if_given(() if given is None else given, name, SHORTEST_TO_FIT)
        for name, given in (("validation", validation), ("test", test))
    )
    model, left_out = _with_signals(model, (*trained, *held_back), tested)
    if candidates is not None:
        candidates = checked_candidates(model.mechanism, candidates)
    horizons = _prepare(model, trained, held_back, candidates, window_seconds)
    reason = "test recordings are used for no fit and no choice; give others, or leave `test` out"
    check_apart((*trained, *held_back), tested, "to search and to test", reason)
    evaluation = Evaluation.of(model, horizons, tested, calibrate_seconds)
    supermodel = horizons.prediction.problem.supermodel
    digest = digest_of_search(model, supermodel, window_seconds, trained, held_back)
    with loaded_ahead(*_kind_of_programs(horizons)):
        # 2. Fit the baseline, or restore what a stopped search had found.
        if resume is None:
            state = fit_as_it_is(model, horizons, say, digest)
        else:
            state = as_it_was(model, horizons, say, digest, resume)
        state.reading_notes += (*left_out, *_not_tried(candidates or (), supermodel))
        # 3. and 4. Add effects; go on in shorter steps of integration if the present ones cause the error.
        _add_effects(state, rounds, evaluation)
        while shorten_steps(state):
            evaluation = Evaluation.of(state.model, state.horizons, tested, calibrate_seconds)
            _add_effects(state, rounds, evaluation)
        # 5. Leave out what is not needed, and check whether single steps have missed a pair.
        _simplify(state)
        _check_pairs(state)
        # 6. Evaluate every nested model, and localise the errors of the baseline.
        evaluated = evaluate_models(state, evaluation)
        # 7. Conclude with the verdict, and with the next experiment if the verdict is ambiguous.
        return with_proposal(conclude(state, evaluated, started))


def _add_effects(state: SearchState, rounds: int, evaluation: Evaluation) -> None:
    """Add effects until none passes, or until there are as many as `rounds`."""
    while len(state.scores) < rounds:
        # 3. Score all candidates.
        promising = score_candidates(state)
        # 4. Refit the best candidates and decide; if none passes alone, try two together.
        if add_best(state, promising) or add_dry_friction(state, promising):
            continue
        if not add_pair(state, rounds):
            break
    _make_ahead(state, evaluation)  # what shorter steps and the end of a search need, beside the refits
    _refit_from_other_horizon(state)


def _with_signals(
    model: Model, deciding: Sequence[Recording], tested: Sequence[Recording]
) -> tuple[Model, tuple[str, ...]]:
    """The model with the signals that all training and validation recordings have; a note on other signals.

    Raises:
        InputError: If a test recording lacks one of these signals.
    """
    every = dict.fromkeys(name for r in deciding for name in r.signals)
    common = common_signals(deciding)
    for name, r in ((name, r) for name in common for r in tested):
        if name not in r.signals:
            raise InputError(
                f"The recordings to fit and to validate have the signal {name!r}, but a recording to test "
                "lacks it; add it there, or leave it out of all."
            )
    apart = [repr(name) for name in every if name not in common]
    note = f"Not all recordings have the signal {', '.join(apart)}, so it was not tried as a disturbance."
    known = dict.fromkeys((*model.mechanism.signals, *common))
    model = dataclasses.replace(model, mechanism=model.mechanism.with_signals(tuple(known)))
    return model, (note,) if apart else ()


def _not_tried(candidates: Iterable[tuple[type[Effect], str]], s: SuperModel) -> tuple[str, ...]:
    """A sentence on given candidates that a search does not try."""
    names = [effect_phrase(cls.name, at) for cls, at in candidates if (cls.name, at) not in s.candidates]
    reason = "the model has them, every search fits them, or they state no size at which to try them"
    return (f"Not among the candidates, since {reason}: {', '.join(names)}.",) if names else ()


def _kind_of_programs(horizons: Horizons) -> tuple[Any, ...]:
    """Key that is equal for searches which use the same programs, apart from the effects found."""
    sets = (horizons.prediction.problem, horizons.prediction.validation.problem)
    shapes = tuple((program_length(p.seen.shape[1]), *p.dataset.data.y.shape[::2]) for p in sets)
    problem = sets[0]
    windows = padded_windows(problem.windows.number)
    return problem.supermodel.mechanism.structure, problem.predictor.solver, shapes, windows


def _prepare(
    model: Model,
    train: tuple[Recording, ...],
    held_back: tuple[Recording, ...],
    candidates: Iterable[tuple[type[Effect], str]] | None,
    window_seconds: float,
) -> Horizons:
    """Training and validation recordings with one super-model, at both horizons."""
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
    # Two passes are enough: the super-model has friction contacts at every port, but few are ever switched
    # on.
    solver = model.solver
    solver = dataclasses.replace(solver, passes=2) if isinstance(solver, Exponential) else solver
    problem = LikelihoodProblem.of(supermodel, solver, dataset, ports)
    if not held_back:
        return Horizons.of(model, problem, None, window_seconds)
    # Validation data are padded to the length of training data, unless they are longer: then programs are
    # compiled once for both.
    length = max(padded_length(train), padded_length(held_back))
    of_validation = prepare(model, held_back, length=length, like=dataset)
    runs = KnownRuns.of(train, held_back)
    other = LikelihoodProblem.of(supermodel, solver, of_validation, ports, runs.indices(held_back))
    return Horizons.of(model, problem, other, window_seconds)


def _check_apart(train: Sequence[Recording], held_back: Sequence[Recording]) -> None:
    """Refuse validation data that are also training data."""
    reason = "a search decides on data that no fit has seen; give another recording, or the two parts of "
    reason += "recording.split(0.7)"
    for k, a in enumerate(train):
        check_apart([a], held_back or train[k + 1 :], "to fit and to validate", reason)


def _check_constants(m: Mechanism, s: SuperModel, recordings: Sequence[Recording]) -> None:
    """Refuse constants of a recording that belong to effects which the search may add, since it fits them."""
    added = set(s.mechanism.parameter_names) - set(m.parameter_names)
    for recording in recordings:
        if known := sorted(added & set(recording.constants)):
            raise InputError(
                f"The recording has the constant {known[0]!r}, but the model has no such effect and a search "
                "fits what it adds; add the effect to the model, or leave the constant out."
            )


def _make_ahead(state: SearchState, evaluation: Evaluation) -> None:
    """Compile in advance the programs that the end of a search needs for the effects found so far."""
    h = state.at(state.reported, state.current).hypothesis
    if fine := finer_integration(state.reported.problem, h):
        fine.make_ahead([h])
    deciding = (p.dataset.recordings for p in (state.problem, state.validation.problem))
    evaluation.make_ahead(state.current, longest_recording(*deciding))


def _simplify(state: SearchState) -> None:
    """Simplify the model that was found, and correct its discretisation bias.

    Needless effects are left out, better laws replace others, calibrations are assigned to the machine or to
    recordings, and several effects are merged into one where one is as good.
    """
    state.say(beginning("needed", "checking that each effect is needed"))
    needed, poor = _eliminate(state), is_poor(state.current, state.problem.noise)
    swaps = take_better_laws(state) if poor else ()
    if swaps:  # with another law, other effects and calibrations may be unnecessary
        needed = _eliminate(state)
    final = state.current.hypothesis
    order = state.in_order(final.locations)
    order += sorted(set(final.locations) - set(order), key=lambda p: -state.worth[p])
    reported = state.reported
    problem, validation = reported.problem, reported.validation
    assigned = assign_calibrations(problem, validation, state.at(reported, state.current).hypothesis, order)
    final, order, notes = assigned.final.hypothesis, assigned.order, (*swaps, *assigned.notes)
    found = [p for p in order if p in state.scores]
    if poor:
        rivals, swapped = undecided_rivals(state), []
    else:
        rivals, swapped = remaining_rivals(problem, validation, assigned.final, state.rivals, found)
    state.machine = [p for p in order if p not in state.scores]
    of_predictions = reported is state.horizons.prediction
    state.alternatives = [*swapped, *(_left_out(state, needed) if of_predictions else ())]
    if one := merge_effects(problem, validation, assigned.final, order):
        final, notes = one.final, (*notes, one.note)
        state.scores[one.effect] = state.scores[one.simpler]
        state.gains[one.effect] = state.gains[one.simpler]
        state.in_place_of[one.effect] = one.simpler
        order = [one.effect if p == one.simpler else p for p in order if p not in one.replaced[1:]]
        state.merged = one.validated
        before = [p for p in rivals.get(one.simpler, []) if p != one.effect]
        rivals[one.effect] = [*before, *(one.replaced if one.same_count else ())]
    state.order, state.own, state.notes, state.rivals = order, assigned.own, notes, rivals
    state.final = correct_discretisation_bias(problem, final)


def _refit_from_other_horizon(state: SearchState) -> None:
    """Fit the present model at each horizon from its fit at the other one too, and keep the likelier fits.

    A process noise that was likely beside parameters that were not yet right may stay likely beside the
    parameters that are fitted with it, and a fit to free runs may end in a local minimum. Where motions that
    start close to each other separate, as in a pendulum, either would say that something is missing.
    """
    horizons, h, runs = state.horizons, state.current.hypothesis, state.current.free_run
    assert runs
    r = runs.hypothesis
    if not is_unexplained(horizons, state.current) or r.local != h.local:
        return
    prediction, free_run = horizons.prediction.problem, horizons.free_run.problem
    least = [as_prediction(prediction, parameters, h) for parameters in (r, h)]
    found = max([h, *refit(prediction, least)], key=lambda fit: fit.log_likelihood)
    (other,) = refit(free_run, [as_free_run(free_run, found)])
    better = [
        new.log_likelihood > old.log_likelihood + BETTER_FIT_NATS for new, old in ((found, h), (other, r))
    ]
    if any(better):
        fits = found if better[0] else h, other if better[1] else r
        state.take_refit(horizons.validated(*fits, state.current))


def _eliminate(state: SearchState) -> Eliminated:
    """Leave out what is not needed; the model that is left joins the models that were tried."""
    assert state.current.free_run
    h, runs = state.current.hypothesis, state.current.free_run.hypothesis
    needed = eliminate(state.horizons, h, runs, list(state.scores))
    state.worth = needed.worth
    for location in (p for p in state.scores if p in h.locations):
        if location not in needed.prediction.locations:
            state.say(f"  left out: {location}")
            state.hand_over(location, needed.prediction)
        elif 0 < needed.worth.get(location, 0.0) < np.inf:
            lost = f"{needed.worth[location]:.0f} nats less of predictions on training data"
            state.say(f"  without {location}: {lost}")
    state.current = state.horizons.validated(needed.prediction, needed.free_run, state.current)
    state.tried.insert(0, state.current)
    return needed


def _check_pairs(state: SearchState) -> None:
    """Fit the best pairs of the start that were not found; they join the sets that have probabilities."""
    if state.start is None or state.validation.folds:  # with folds, it would take a fit for each recording
        return
    beside, pairs = state.start
    given = state.horizons, beside, pairs, state.current, state.is_plausible, state.say
    tried, alike = pairs_passed_by(*given, known=state.tried)
    state.tried += tried
    for a, b in alike:
        names = " and ".join(effect_phrase(p.effect, p.port) for p in (a, b))
        state.notes = (
            *state.notes,
            f"Two effects fitted at once do as well on data that no fit has seen as what was found: {names}.",
        )


def _left_out(state: SearchState, needed: Eliminated) -> list[ValidatedHypothesis]:
    """The final model without each effect in turn, validated; without models that a round has fitted."""
    effects = state.problem.supermodel.without_calibrations
    if state.validation.folds:  # with folds, it would take a fit for each recording, and it decides nothing
        return []
    known = {effects(v.hypothesis.locations) for v in state.tried}
    unknown = [h for h in needed.without if effects(h.locations) not in known]
    return on_threads(lambda h: validate(state.validation, h, state.current), unknown)
