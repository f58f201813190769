"""The result of a search: evaluated nested models, localised errors of the baseline, and the verdict."""

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence

from rotflex_jax.discover.checkpoint import beginning
from rotflex_jax.discover.conclusion import end_state, signs
from rotflex_jax.discover.discovery import Discovery
from rotflex_jax.discover.evaluation import (
    Evaluation,
    PairedEstimates,
    difference_notes,
    disagreement,
    errors_by_noise,
    estimates,
    evaluate,
    own_estimates,
    paired_estimates,
)
from rotflex_jax.discover.final_fit import Refused, fit_to_all
from rotflex_jax.discover.friction_of_runs import own_friction_notes
from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.integration_step import finer_integration
from rotflex_jax.discover.likelihood import choose_process_noise, process_noise_gain
from rotflex_jax.discover.localise import locate_in_windows
from rotflex_jax.discover.probabilities import Probabilities, fitted_sets, probabilities
from rotflex_jax.discover.result import (
    ConditionalInterval,
    FinalFit,
    KnownRuns,
    Ranked,
    Round,
    Stage,
    Where,
    assess_stages,
    conditional_note,
    excluding,
    longest_recording,
)
from rotflex_jax.discover.search_state import SearchState
from rotflex_jax.discover.selection import helps
from rotflex_jax.discover.stepwise import (
    calibration_notes,
    disturbance_notes,
    far_from_given,
    nested_models,
    refit_without,
    titled,
)
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.validation import ValidatedHypothesis, ValidationSet, validate
from rotflex_jax.effects import CATALOG, ChannelDelay, SensorBias
from rotflex_jax.effects.labels import effect_phrase
from rotflex_jax.fit.plausibility import BEYOND_RECORDINGS, Remark, at_bounds, beyond_recordings
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import on_threads


@dataclasses.dataclass(frozen=True)
class EvaluatedModels:
    """The final model of a search and the models that led to it, evaluated on validation and test data.

    Attributes:
        stages: Baseline, and the models after each effect.
        final: The final model at the horizon that is reported.
        pairs: Its parameters fitted to training and to validation data.
        remarks: Remarks on its parameters.
        rounds: Effects that were added, in order.
        where: Where the error of the baseline is large.
        test: Test recordings, used for no fit and no choice.
        final_fit: The final model fitted to training and validation recordings, or why this fit was refused;
            None if the final model explains its recordings.
    """

    stages: tuple[Stage, ...]
    final: ValidatedHypothesis
    pairs: Sequence[PairedEstimates]
    remarks: tuple[Remark, ...]
    rounds: tuple[Round, ...]
    where: tuple[Where, ...]
    test: tuple[Recording, ...]
    final_fit: FinalFit | Refused | None


def evaluate_models(state: SearchState, evaluation: Evaluation) -> EvaluatedModels:
    """Evaluate every nested model, and localise the error of the baseline."""
    state.say(beginning("finish", "simulating the validation recordings"))
    reported, model, order = state.reported, state.model, state.order
    problem, validation, final = reported.problem, reported.validation, state.final
    assert final
    passed = [state.at(reported, v).hypothesis for v in state.passed]
    models = nested_models(problem, final, order, state.own, passed)
    # Nested models share the programs of the largest.
    every = frozenset(problem.supermodel.calibrations).union(*(h.locations for h in models))
    evaluation = evaluation.with_built_in(every)
    built = dataclasses.replace(validation, built_in=every)
    near = state.at(reported, state.current)
    validated = on_threads(lambda h: validate(validation, h, near), models)

    def stage(k: int) -> Stage:
        found = evaluate(problem, built, model.solver, validated[k], order[:k])
        found = _with_process_noise(state, found, validated[k].hypothesis, corrected=k == len(models) - 1)
        return evaluation.of_stage(found, validated[k], order[:k])

    stages = on_threads(stage, range(len(models)))
    stages[-1] = _with_expected_errors(state, stages, built, validated[-1])
    train, held_back = problem.dataset.recordings, validation.problem.dataset.recordings
    longest = longest_recording(train, held_back)
    seconds, noise = validation.window_seconds, problem.noise
    of_run = KnownRuns.of(train, held_back).index(longest) or 0
    as_it_is = built.model_of(models[0], (), of_run)
    runs = as_it_is.simulate_windows(longest, seconds)
    pairs = paired_estimates(reported, validated[-1], stages[-1].estimates)
    m = stages[-1].model.mechanism
    remarks = (*at_bounds(stages[-1].estimates), *beyond_recordings(m, state.reach))
    explained = assess_stages(stages[0], stages[-1], state.noise_floor).is_explained
    return EvaluatedModels(
        stages=tuple(stages),
        final=validated[-1],
        pairs=pairs,
        remarks=remarks,
        rounds=_rounds(state, stages, pairs, remarks, {} if explained else stand_ins(state)),
        where=locate_in_windows(model, longest, runs, noise, seconds),
        test=evaluation.recordings,
        final_fit=None if explained else fit_to_all(state, stages[-1], validated[-1], evaluation),
    )


def conclude(state: SearchState, evaluated: EvaluatedModels, started: float) -> Discovery:
    """The result of a search, with its verdict.

    Args:
        state: The search with what it has found.
        evaluated: Its models, evaluated.
        started: Time at which the search began, by `time.perf_counter` [s].
    """
    baseline, final = evaluated.stages[0], evaluated.stages[-1]
    supermodel, remarks = state.problem.supermodel, evaluated.remarks
    held_back = state.validation.problem.dataset.recordings
    conditional, last = _conditional(state, final), evaluated.final_fit
    used = last.model if isinstance(last, FinalFit) else final.model
    scores = [s for s, _ in state.ranking]
    verdict, sentence = end_state(baseline, evaluated.rounds, final, state.noise_floor, scores)
    return Discovery(
        verdict=verdict,
        sentence=sentence,
        train=state.problem.dataset.recordings,
        validation=held_back,
        test=evaluated.test,
        baseline=baseline,
        rounds=evaluated.rounds,
        ranking=tuple(
            Ranked(*s.location, s.nats, s.excited, s.orthogonal_fraction, s.detection_limit, runs)
            for s, runs in state.ranking
        ),
        where=evaluated.where,
        noise_floor=state.noise_floor,
        elapsed_s=time.perf_counter() - started,
        notes=(
            *state.reading_notes,
            *state.step_note,
            *_resumed(state.resumed),
            *conditional_note(conditional),
            *calibration_notes(supermodel, evaluated.final, state.own, used.mechanism),
            *_run_notes(state, evaluated.test),
            *own_friction_notes(evaluated.final, state.validation, isinstance(last, FinalFit)),
            *disturbance_notes(supermodel, evaluated.final),
            *difference_notes(supermodel, evaluated.pairs, evaluated.final.hypothesis.sizes),
            *_far_baseline(state),
            *state.notes,
            *([last.sentence] if isinstance(last, Refused) else []),
            *(f"{remark.sentence}." for remark in remarks),
        ),
        remarks=remarks,
        probabilities=_probabilities(state, assess_stages(baseline, final, state.noise_floor).misfit),
        conditional=conditional,
        final_fit=last if isinstance(last, FinalFit) else None,
    )


def _probabilities(state: SearchState, misfit: float) -> Probabilities:
    """Probabilities of the sets that were fitted; the set that is reported comes first in the evidence."""
    reported, horizons = state.reported, state.horizons
    sets = fitted_sets(horizons, state.tried, state.alternatives, reported, state.machine)
    if state.merged:
        sets = fitted_sets(horizons, (), [state.merged], reported, ()) + sets
    return probabilities(sets, misfit=misfit)


def _conditional(state: SearchState, final: Stage) -> tuple[ConditionalInterval, ...]:
    """Parameters of the final model on which fits to predictions and to free runs disagree.

    Those of effects that were merged into another one are left out.
    """
    horizons, s = state.horizons, state.problem.supermodel
    if (runs := state.current.free_run) is None:
        return ()
    own = {s.mechanism.parameter_names[i] for i in state.current.hypothesis.local}
    names = {e.name for e in final.estimates} - own
    each = (
        [e for e in estimates(at.problem, found.hypothesis) if e.name in names]
        for at, found in ((horizons.prediction, state.current), (horizons.free_run, runs))
    )
    return excluding(*each)


def _far_baseline(state: SearchState) -> tuple[str, ...]:
    """A sentence on parameters of the user's model that the fit of the baseline has moved far."""
    s, first = state.problem.supermodel, state.passed[0]
    names, specs = s.mechanism.parameter_names, s.mechanism.parameter_specifications
    found = {
        i: v.hypothesis.mean_values(s)[i]
        for v in (first.free_run, first)
        if v
        for i in far_from_given(s, v.hypothesis)
    }
    moved = [
        f"{names[i]} from {s.mechanism.values[i]:.3g} to {value:.3g} {specs[i].unit}".strip()
        for i, value in sorted(found.items())
    ]
    if not moved:
        return ()
    return (
        f"The fit of the model as it is has moved {' and '.join(moved)}, as happens where the values given "
        "are far off or where friction holds a machine at rest"
        + ("; candidates were also tried beside the values given." if state.ranking else "."),
    )


def _run_notes(state: SearchState, test: Sequence[Recording]) -> tuple[str, ...]:
    """A sentence on offsets that are left out for test recordings of other runs."""
    held_back = state.validation.problem.dataset.recordings
    runs = KnownRuns.of(state.problem.dataset.recordings, held_back)
    offsets = [p for p in state.order if p in state.problem.supermodel.calibrations]
    if not offsets or runs.compared or all(runs.index(r) is not None for r in test):
        return ()
    return (
        f"{' and '.join(map(titled, offsets))} was seen in one run: errors on test recordings of other runs "
        "are without it, as is the model that `model_of` gives for them.",
    )


def _resumed(count: int) -> tuple[str, ...]:
    """A sentence that a search continued from a stopped search, given the number of its finished rounds."""
    if not count:
        return ()
    found = "one round" if count == 1 else f"{count} rounds"
    return (
        f"The search went on after {found} of one that was stopped; the time, and the sets of effects that "
        "have a probability, are those of the rest.",
    )


def _with_process_noise(state: SearchState, stage: Stage, h: Hypothesis, corrected: bool) -> Stage:
    """A stage with the likeliest process noise for predictions with its parameters, and the gain by it.

    Args:
        state: The search with what it has found.
        stage: The model.
        h: Its hypothesis.
        corrected: Whether its parameters are corrected for the discretisation bias
            (`correct_discretisation_bias`). Then predictions use the finer integration too, since the error
            of the coarser integration would count as a random torque.
    """
    problem = state.problem
    if stage.horizon == "prediction" and not corrected:
        return stage
    if stage.horizon == "free_run":
        near = state.current.hypothesis
        # First states are fitted ones: runs from measured ones drift, which would count as a random torque.
        fitted = dataclasses.replace(h, x0=near.initial_state_for(problem.supermodel, h.locations))
        h = choose_process_noise(problem, fitted, wide=True)
    finer = finer_integration(problem, h) if corrected else None
    gain = process_noise_gain(finer or problem, h)
    return dataclasses.replace(stage, process_noise=h.process_noise, process_noise_nats=gain)


def _with_expected_errors(
    state: SearchState, stages: Sequence[Stage], validation: ValidationSet, final: ValidatedHypothesis
) -> Stage:
    """The last stage; with the errors that noise alone causes, if the verdict depends on these.

    Args:
        state: The search with what it has found.
        stages: The evaluated models.
        validation: The validation recordings.
        final: The last model.
    """
    stage = stages[-1]
    end = assess_stages(stages[0], stage, state.noise_floor)
    if end.at_noise or not end.torque_free:
        return stage
    models = validation.models_as_trained(final, state.order)
    return dataclasses.replace(stage, expected=errors_by_noise(validation, models))


def _rounds(
    state: SearchState,
    stages: Sequence[Stage],
    pairs: Sequence[PairedEstimates],
    remarks: Sequence[Remark],
    stands_in: Mapping[EffectLocation, tuple[str, ...]],
) -> tuple[Round, ...]:
    """The rounds of a search: each effect that was added, in order, with the stage that it led to.

    Args:
        state: The search with what it has found.
        stages: Models, each with one effect more than the one before.
        pairs: Estimates of the last model from different recordings.
        remarks: Remarks on parameters of the last model.
        stands_in: Effects of an unexplained model -> signs that they stand in for something else.
    """
    mechanism = stages[-1].model.mechanism
    return tuple(
        Round(
            effect=location.effect,
            port=location.port,
            equivalent=tuple(state.rivals.get(location, [])),
            parameters=own_estimates(stage, location),
            stage=stage,
            score=state.scores.get(location, state.worth.get(location, math.nan)),
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


def stand_ins(state: SearchState) -> dict[EffectLocation, tuple[str, ...]]:
    """Effects of the final model -> signs that they stand in for something else, from both horizons."""
    gains = {p: at.gain + at.training_gain for p, (at, _) in state.gains.items()}
    found = signs((state.horizons.prediction, state.horizons.free_run), state.current, gains)
    for bias, reason in _biases_beside_other_faults(state.order).items():
        found[bias] = (*found.get(bias, ()), reason)
    # One effect that replaces several gets the signs of the effect whose place in the order it has taken.
    return found | {new: found[old] for new, old in state.in_place_of.items() if old in found}


def _biases_beside_other_faults(order: Sequence[EffectLocation]) -> dict[EffectLocation, str]:
    """Sensor biases of channels with another fault -> a clause that this fault may look like a bias."""
    apart, found = (SensorBias.name, ChannelDelay.name), {}
    faults = [p for p in order if CATALOG[p.effect].acts_on == "channel" and p.effect not in apart]
    for bias in (p for p in order if p.effect == SensorBias.name):
        same = [effect_phrase(p.effect, p.port) for p in faults if p.port == bias.port]
        if same:
            named = " and ".join(same)
            found[bias] = f"{bias.port} has another fault ({named}), a part of which may look like a bias"
    return found


def _gain_of_predictions(state: SearchState, location: EffectLocation, stage: Stage, before: Stage) -> float:
    """Gain of an effect in log-likelihood of predictions of validation data [nat]; NaN if unknown."""
    if stage.horizon == "prediction":
        return stage.log_likelihood - before.log_likelihood
    if location in state.gains:
        return state.gains[location][0].gain
    current = state.current
    if location not in current.hypothesis.locations:
        return float("nan")
    # A calibration has no gain from a round. The stages were fitted to free runs, so predictions are
    # refitted.
    (less,) = refit_without(state.problem, current.hypothesis, [location], alternations=1)
    return current.log_likelihood - validate(state.validation, less, current).log_likelihood


def _beyond(remarks: Sequence[Remark], location: EffectLocation) -> tuple[str, ...]:
    """Remarks on parameters of an effect with values far beyond what the recordings reach."""
    head = location.name_prefix
    return tuple(r.sentence for r in remarks if r.kind == BEYOND_RECORDINGS and r.parameter.startswith(head))


def _doubts(
    state: SearchState, location: EffectLocation, pairs: Sequence[PairedEstimates]
) -> tuple[str, ...]:
    """Reasons why an effect that is distinguished from others may still stand in for something else.

    There are none for a calibration of the machine. Two other tests have established it: training data are
    likelier with it by more than the penalty for its values (`eliminate`), and free runs over validation data
    are clearly better with its trained value (`assign_calibrations`).
    """
    if location not in state.gains:
        return ()
    reasons = []
    prediction, runs = state.gains[location]
    if not helps(prediction):
        reasons.append("predictions on validation data are no better with it")
    if runs is not None and not helps(runs):
        reasons.append("free runs over validation data are no better with it")
    names, current = state.problem.supermodel.mechanism.parameter_names, state.current.hypothesis
    differs = disagreement(pairs, location, [names[i] for i in current.sizes])
    return (*reasons, differs) if differs else tuple(reasons)
