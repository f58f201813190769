"""The stepwise search: fit the baseline, add, remove, swap and merge effects, assign calibrations."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rotflex_jax.discover.hypothesis import (
    CandidateStart,
    Hypothesis,
    Whitener,
    embed_initial_state,
    handed_over,
    is_physical,
    parameter_count,
    replacing,
    usual_start,
    with_candidate,
    with_effect,
    with_own_friction,
    without,
)
from rotflex_jax.discover.likelihood import (
    MIN_DECREASE_NATS,
    LikelihoodProblem,
    choose_process_noise,
    levenberg_marquardt,
    refit,
)
from rotflex_jax.discover.selection import (
    FREE_RUN_BETTER,
    FREE_RUN_Z,
    TRAIN_Z,
    WINDOWS_BETTER,
    distinguished,
    log_best_ratio,
    mean_log_ratio,
    needed_gain,
    paired_gain,
    runs_clearly_better,
)
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.discover.validation import (
    Horizons,
    ValidatedHypothesis,
    ValidationSet,
    as_free_run,
    validate,
)
from rotflex_jax.effects import CATALOG
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.assembly import Layout
from rotflex_jax.runtime.persistent_jit import make_ahead
from rotflex_jax.runtime.xla import on_threads


def fit_baseline(problem: LikelihoodProblem) -> Hypothesis:
    """The user's model with calibrations, fitted from a short, a medium and a very long prediction horizon.

    A large process noise gives a short horizon, a small one a long horizon. The likeliest fit is returned.
    """
    least, most = problem.process_noise_range
    intensities = (most, np.sqrt(least * most), least)
    # From parameters far off, a fit converges safely only with a short horizon: all paths begin with one.
    near = problem.with_process_noise(values_given(problem), dict.fromkeys(problem.ports, 100 * most))
    problem.make_ahead([near])
    near = refit(problem, [near], alternations=0)[0]
    paths = [problem.with_process_noise(near, dict.fromkeys(problem.ports, q)) for q in intensities]
    return max(refit(problem, paths, wide=True), key=lambda h: h.log_likelihood)


def fit_free_run_baseline(problem: LikelihoodProblem, prediction: Hypothesis) -> Hypothesis:
    """The user's model fitted to free runs, from the fit to predictions and from the given values.

    Where a model lacks what holds a machine at rest, the likeliest predictor may be a machine that hardly
    moves, with an inertia that grows without limit. There the slopes of all parameters vanish, and a fit to
    free runs would not leave this point.

    Args:
        problem: Likelihood of free runs.
        prediction: The user's model fitted to predictions.
    """
    starts = [as_free_run(problem, h) for h in (prediction, values_given(problem))]
    able = [h for h in starts if np.isfinite(h.log_likelihood)] or starts[:1]
    return max(refit(problem, able), key=lambda h: h.log_likelihood)


# A positive parameter is far from its given value if a fit has changed it by more than this factor.
FAR_FROM_GIVEN = 10.0


def far_from_given(s: SuperModel, h: Hypothesis) -> list[int]:
    """Indices of positive parameters of the user's model that a fit has moved far from their given values."""
    i = np.array(s.baseline_free)
    given, found = s.mechanism.values[i], h.mean_values(s)[i]
    positive = np.minimum(given, found) > 0
    i, ratio = i[positive], found[positive] / given[positive]
    return i[np.abs(np.log(ratio)) > np.log(FAR_FROM_GIVEN)].tolist()


def as_given(horizons: Horizons) -> ValidatedHypothesis:
    """The user's model with its given values and the likeliest process noise for them, validated."""
    problem = horizons.prediction.problem
    h = choose_process_noise(problem, values_given(problem), wide=True)
    return horizons.validated(h, as_free_run(horizons.free_run.problem, h))


def values_given(problem: LikelihoodProblem) -> Hypothesis:
    """The user's model with its given values and all calibrations at zero."""
    s, first = problem.supermodel, problem.windows.first_states
    R, C = len(first), len(s.mechanism.channels)
    z = s.transform.unconstrain(s.mechanism.values)
    for i in s.local:
        z[i] = 0.0
    return Hypothesis(
        locations=s.calibrations,
        free=tuple(s.baseline_free),
        local=tuple(s.local),
        z=z,
        local_z=np.zeros((R, len(s.local))),
        x0=embed_initial_state(s, s.calibrations, first),
        K=np.zeros((R, Layout.of(s.mechanism.structure).size, C)),
        process_noise={},
        whitener=Whitener.of_noise(problem.noise),
    )


# Steps of the fit from each shape of a candidate before the best shape is chosen.
SHAPE_CHOICE_STEPS = 6
# A refit may start at these shares of the amplitude that the score test suggests, or of a listed delay.
START_SHARES = (1.0, 0.4, 0.1, 0.02)
# A refit that gains less than this share of the gain that the score test expects has missed the optimum.
STUCK_SHARE = 0.5
# A model with one more effect is no worse at its optimum. If the score test expects a gain of a candidate but
# its refit ends worse than the model without it, the refit starts again from this share.
NEARLY_ABSENT = 1e-3


def refit_candidates(
    problem: LikelihoodProblem, current: Hypothesis, starts: Sequence[CandidateStart]
) -> list[Hypothesis]:
    """The current model with each candidate added and refitted.

    The amplitude that the score test suggests is too large where an effect is strongly nonlinear. So a refit
    starts at the likeliest of several shares of this amplitude, and at the shape with which a few steps gain
    most. If a refit gains far less than the score test expects, it starts again from a small amplitude of
    every shape. If it is still worse than the current model, it starts from a very small one. A refit to free
    runs also starts from the fit of each candidate that its effect contains. An effect with memory replaces
    the simpler effect that it contains, since the two in parallel would be a third effect.
    """
    s = problem.supermodel
    for c in starts:
        make_ahead(problem.slopes, [with_candidate(s, current, c, START_SHARES[0])])
    # Each candidate has one thread from start to end, so none waits for the slowest one after every stage.
    refitted = on_threads(lambda c: _refit_candidate(problem, current, c), starts)
    return refit_from_contained(problem, refitted, starts)


def refit_from_contained(
    problem: LikelihoodProblem, refitted: list[Hypothesis], starts: Sequence[CandidateStart]
) -> list[Hypothesis]:
    """Refits repeated from the fits of the candidates that their effects contain; the likelier is kept.

    At its optimum an effect is no worse than an effect that it contains. A refit that is worse starts again
    from the fit with the contained effect. So does every refit to free runs, whose cost has many minima.
    """
    again = [
        (i, replacing(problem.supermodel, refitted[j], [b.location], a, START_SHARES[-1]))
        for i, a in enumerate(starts)
        for j, b in enumerate(starts)
        if a is not b
        and a.location.contains(b.location)
        and (problem.free_run or refitted[i].log_likelihood < refitted[j].log_likelihood)
    ]
    return refit_from(problem, refitted, again)


def _refit_candidate(problem: LikelihoodProblem, current: Hypothesis, start: CandidateStart) -> Hypothesis:
    """The current model with one candidate, refitted as in `refit_candidates`, without other candidates."""
    s = problem.supermodel
    grown = [[with_candidate(s, current, shape, x) for x in START_SHARES] for shape in start.shapes]
    likeliest = [problem.likeliest(row) for row in grown]
    if len(likeliest) > 1:
        likeliest = levenberg_marquardt(problem, likeliest, max_steps=SHAPE_CHOICE_STEPS)
    begun = max(likeliest, key=lambda h: h.log_likelihood)
    (refitted,) = refit(problem, [begun])
    if refitted.log_likelihood - current.log_likelihood >= STUCK_SHARE * max(start.expected_gain, 0.0):
        return refitted
    again = refit(problem, [row[-1] for row in grown if row[-1] is not begun])
    refitted = max([refitted, *again], key=lambda h: h.log_likelihood)
    no_worse = refitted.log_likelihood > current.log_likelihood - MIN_DECREASE_NATS
    if no_worse or start.expected_gain <= 0 or not any(s.candidates[start.location].scaled):
        return refitted
    nearly = [with_candidate(s, current, shape, NEARLY_ABSENT) for shape in start.shapes]
    return max([refitted, *refit(problem, nearly)], key=lambda h: h.log_likelihood)


def refit_from(
    problem: LikelihoodProblem, refitted: list[Hypothesis], starts: list[tuple[int, Hypothesis]]
) -> list[Hypothesis]:
    """Refits of candidates, some of them repeated from other starts; the likelier fit of each is kept.

    Args:
        problem: The likelihood.
        refitted: Fits so far, one for each candidate.
        starts: Index of a candidate and another start for it.
    """
    best = list(refitted)
    fitted = refit(problem, [h for _, h in starts]) if starts else []
    for (i, _), h in zip(starts, fitted, strict=True):
        best[i] = max(best[i], h, key=lambda x: x.log_likelihood)
    return best


def refit_near_predictions(
    problem: LikelihoodProblem, refitted: list[Hypothesis], predictions: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """Refits to free runs, repeated from the fits to predictions; the likelier fit of each is kept.

    The cost of free runs has many local minima. A minimum near the parameters of predictions may be better.

    Args:
        problem: Likelihood of free runs.
        refitted: Models fitted to free runs.
        predictions: The same structures, fitted to predictions.
    """
    begun = enumerate(on_threads(lambda h: as_free_run(problem, h), predictions))
    return refit_from(problem, refitted, [(i, h) for i, h in begun if np.isfinite(h.log_likelihood)])


class Eliminated(NamedTuple):
    """A model after backward elimination: only the effects that are needed at one of the horizons.

    Attributes:
        prediction: The model fitted to predictions.
        free_run: The model fitted to free runs.
        worth: Each effect that was tested -> its gain in log-likelihood of training predictions [nat].
        without: For each effect that was tested, the model without it, refitted to predictions.
    """

    prediction: Hypothesis
    free_run: Hypothesis
    worth: dict[EffectLocation, float]
    without: list[Hypothesis]


def eliminate(horizons: Horizons, h: Hypothesis, runs: Hypothesis, added: list[EffectLocation]) -> Eliminated:
    """Backward elimination: drop, one at a time, effects without which the model is as good at both horizons.

    The effect added last is not tested, since it has just passed the tests of its round. Effects added
    earlier may have become unnecessary, and calibrations have not been tested yet.

    Args:
        horizons: Training and validation recordings at both horizons.
        h: The model fitted to predictions.
        runs: The same structure fitted to free runs.
        added: Effects in the order in which they were added.

    Returns:
        The model with the effects that are needed, and the results of the last test of each.
    """
    problem, runs_problem = horizons.prediction.problem, horizons.free_run.problem
    s, rivals = problem.supermodel, []
    while tested := [p for p in h.locations if p not in added[-1:]]:
        rivals = refit_without(problem, h, tested, alternations=1)
        worth = {p: h.log_likelihood - r.log_likelihood for p, r in zip(tested, rivals, strict=True)}
        count = {p: parameter_count(s, h, p) for p in worth}
        needed = {p: needed_gain(count[p], problem.measured_values) for p in worth}
        surplus = {p: worth[p] - needed[p] for p in worth}
        for p, r in zip(tested, rivals, strict=True):
            if p in s.calibrations:
                continue
            # An effect whose gain comes from a few moments of the recording only is not needed.
            if paired_gain(h.blocks, r.blocks)[1] < TRAIN_Z:
                surplus[p] = min(surplus[p], -1.0)
        needless = sorted((p for p in tested if surplus[p] < 0), key=lambda p: surplus[p])
        without_each = dict(zip(tested, rivals, strict=True))
        as_it_is = functools.cache(functools.partial(horizons.validated, h, runs))
        drop = next(
            (
                p
                for p in needless
                if p not in added or not _need(horizons, as_it_is, runs, p, without_each[p])
            ),
            None,
        )
        if drop is None:
            break
        h = without_each[drop]
        (runs,) = refit_without(runs_problem, runs, [drop])
    else:
        worth, rivals = {}, []
    return Eliminated(h, runs, worth, rivals)


def refit_without(
    problem: LikelihoodProblem, h: Hypothesis, locations: Sequence[EffectLocation], alternations: int = 3
) -> list[Hypothesis]:
    """The model without each of some effects in turn, refitted.

    If the model has a law that contains the effect and can take over its size, a second fit starts with this
    size in the law. The likelier fit is kept. A fit from the size that the law has beside the effect may end
    in another minimum, as if both were needed.

    Args:
        problem: The likelihood.
        h: The model.
        locations: Effects that are left out, one at a time.
        alternations: See `refit`.
    """
    s = problem.supermodel
    starts = [(without(s, h, p), handed_over(s, h, p)) for p in locations]
    given = [[start for start in each if start is not None] for each in starts]
    fits = iter(refit(problem, [start for each in given for start in each], alternations=alternations))
    return [max((next(fits) for _ in each), key=lambda fit: fit.log_likelihood) for each in given]


def _need(
    horizons: Horizons,
    as_it_is: Callable[[], ValidatedHypothesis],
    runs: Hypothesis,
    location: EffectLocation,
    less: Hypothesis,
) -> bool:
    """Whether free runs are clearly worse without an effect, over training or over validation recordings.

    Args:
        horizons: Training and validation recordings at both horizons.
        as_it_is: Gives the model with all effects, validated at both horizons.
        runs: The model fitted to free runs.
        location: The effect.
        less: The model without the effect, fitted to predictions.
    """
    problem = horizons.free_run.problem
    (less_runs,) = refit_without(problem, runs, [location], alternations=1)
    gain, z = paired_gain(runs.blocks, less_runs.blocks)
    if z > FREE_RUN_Z and gain / len(runs.blocks) > FREE_RUN_BETTER:
        return True
    # A fit without the effect may describe the training recordings with parameters that fail on others.
    return log_best_ratio(as_it_is(), horizons.validated(less, less_runs, as_it_is())) < -FREE_RUN_BETTER


class RemainingRivals(NamedTuple):
    """Rivals of the effects that were found: effects that may stand in their places.

    Attributes:
        alike: Each effect that was found -> rivals that the recordings cannot exclude in its place.
        swapped: The final model with each rival in the place of the effect, refitted and validated.
    """

    alike: dict[EffectLocation, list[EffectLocation]]
    swapped: list[ValidatedHypothesis]


def remaining_rivals(
    problem: LikelihoodProblem,
    validation: ValidationSet,
    final: ValidatedHypothesis,
    rivals: dict[EffectLocation, list[EffectLocation]],
    found: list[EffectLocation],
) -> RemainingRivals:
    """Rivals that the recordings cannot exclude, tested in the final model in the place of a found effect.

    Two effects that were not distinguished in their round may be distinguished once all other effects are in
    the model. A rival that was itself found in another round does not count.
    """
    s = problem.supermodel
    remaining = {p: [r for r in rivals[p] if r not in found] for p in found}
    # A periodic disturbance remains a rival without a test: it was refitted at its frequency in its round.
    pairs = [(p, r) for p in found for r in remaining[p] if not CATALOG[r.effect].line]
    if not pairs or len(found) == 1:
        return RemainingRivals(remaining, [])
    swapped = []
    for p, r in pairs:
        less, shapes = without(s, final.hypothesis, p), usual_start(s, r).shapes
        start = problem.likeliest([with_effect(s, less, c, x) for c in shapes for x in START_SHARES])
        has_own = set(s.parameter_indices(p)).intersection(final.hypothesis.sizes)
        swapped.append(with_own_friction(s, start, r) if has_own else start)
    validated = on_threads(lambda h: validate(validation, h), refit(problem, swapped))
    alike = {pair for pair, t in zip(pairs, validated, strict=True) if not distinguished(final, t)}
    left = {p: [r for r in remaining[p] if (p, r) in alike or CATALOG[r.effect].line] for p in found}
    return RemainingRivals(left, validated)


def nested_models(
    problem: LikelihoodProblem,
    final: Hypothesis,
    order: Sequence[EffectLocation],
    own: Sequence[EffectLocation],
    passed: Sequence[Hypothesis],
) -> list[Hypothesis]:
    """The baseline, then models with one more effect at a time, each refitted; the final model last.

    If the search has fitted a model with the same effects (calibrations aside), the refit starts from it,
    else from the final model. Calibrations that belong to single recordings (`own`) are in every model.
    """
    s, below = problem.supermodel, []
    calibrations = set(s.calibrations)
    for k in range(len(order)):
        wanted = {*order[:k], *own}
        known = [h for h in passed if wanted - calibrations == set(h.locations) - calibrations]
        h = known[0] if known and wanted <= set(known[0].locations) else final
        for location in set(h.locations) - wanted:
            h = without(s, h, location)
        below.append(h)
    return [*(refit(problem, below, wide=True, alternations=2) if below else []), final]


# Log-likelihood that one effect may lose against several, beyond the penalty for the parameters saved [nat].
MERGE_LOSS_NATS = 2.0


@dataclasses.dataclass(frozen=True)
class MergedEffects:
    """One effect that replaces several effects.

    Attributes:
        final: The hypothesis with the one effect.
        effect: The one effect.
        simpler: The effect among the replaced ones that it contains.
        replaced: The simpler effect and the calibrations that it replaces.
        same_count: Whether the one effect has as many parameters as they have together. Then the data do not
            prefer it.
        validated: The hypothesis on validation data.
    """

    final: Hypothesis
    effect: EffectLocation
    simpler: EffectLocation
    replaced: tuple[EffectLocation, ...]
    same_count: bool
    validated: ValidatedHypothesis

    @property
    def note(self) -> str:
        """The replacement in a sentence, for the reader of the result."""
        several = " and ".join(map(titled, self.replaced))
        count = "as many parameters" if self.same_count else "more parameters"
        return (
            f"{several} together are the same as {titled(self.effect)}, with {count} "
            "and more effects; the one effect is reported."
        )


def titled(location: EffectLocation) -> str:
    """An effect and its port in words."""
    return f"{CATALOG[location.effect].title} at {location.port}"


def merge_effects(
    problem: LikelihoodProblem,
    validation: ValidationSet,
    final: ValidatedHypothesis,
    order: Sequence[EffectLocation],
) -> MergedEffects | None:
    """Find one effect that explains as much as an effect of the final model and the machine's calibrations.

    A constant torque at the hub looks like a voltage offset, a constant torque at the joint like an offset of
    the deflection. An asymmetric friction is a symmetric friction and a constant torque. Calibrations are in
    every model of the search, so they explain the asymmetry before an asymmetric friction can. If one effect
    explains as much as several, it is the better answer.

    Args:
        problem: Likelihood of the training recordings.
        validation: The validation recordings.
        final: The final model.
        order: Its effects and the calibrations that belong to the machine.
    """
    s, h = problem.supermodel, final.hypothesis
    calibrations = [p for p in order if p in s.calibrations]
    pairs = [
        (simple, rich)
        for simple in order
        if simple not in calibrations
        for rich in s.candidates
        if calibrations and rich.contains(simple) and rich not in order
        if CATALOG[rich.effect].state_part != "memory"
    ]
    if not pairs:
        return None
    starts = []
    for simple, rich in pairs:
        bare = h
        level = max(h.mean_values(s)[s.parameter_indices(simple)])
        for location in (simple, *calibrations):
            bare = without(s, bare, location)
        c = s.candidates[rich]
        values = np.where(c.amplitudes, level, np.array(c.probes[0][0]))
        starts.append(with_effect(s, bare, CandidateStart(rich, values), 1.0))
    fitted = refit(problem, starts, alternations=1)
    (simple, rich), one = max(zip(pairs, fitted, strict=True), key=lambda pair: pair[1].log_likelihood)
    before = parameter_count(s, h, simple) + len(h.x0) * len(calibrations)
    saved = before - len(s.parameter_indices(rich))
    allowed = MERGE_LOSS_NATS + 0.5 * saved * np.log(problem.measured_values)
    if saved < 0 or one.log_likelihood < h.log_likelihood - allowed or not is_physical(s, one, rich):
        return None
    kept = [rich if p == simple else p for p in order if p not in calibrations]
    validated = validate(validation, one)
    errors = validation.short_run_errors(validated.with_trained_calibrations(s), kept)
    several = validation.short_run_errors(final.with_trained_calibrations(s), order)
    if mean_log_ratio(errors, several) > WINDOWS_BETTER:
        return None
    return MergedEffects(one, rich, simple, (simple, *calibrations), saved == 0, validated)


@dataclasses.dataclass(frozen=True)
class AssignedCalibrations:
    """Which calibrations of a final model belong to the machine, and which to single recordings.

    Attributes:
        final: The final model, on validation data.
        order: Effects and calibrations of the machine, in order.
        own: Calibrations that belong to the training recordings alone.
        notes: A remark for the reader if all calibrations were left out.
    """

    final: ValidatedHypothesis
    order: list[EffectLocation]
    own: list[EffectLocation]
    notes: tuple[str, ...]


def assign_calibrations(
    problem: LikelihoodProblem, validation: ValidationSet, final: Hypothesis, order: list[EffectLocation]
) -> AssignedCalibrations:
    """Decide whether calibrations of the final model belong to the machine, to recordings, or to neither."""
    calibrations = [p for p in order if p in problem.supermodel.calibrations]
    validated = validate(validation, final)
    order, own = _split_calibrations(validation, validated, order)
    bare = _better_without(problem, validation, validated, order)
    if bare is None:
        return AssignedCalibrations(validated, order, own, ())
    note = (
        f"The training data are likelier with {' and '.join(map(titled, calibrations))}, but runs over "
        "validation data are better with a model fitted without; left out."
    )
    return AssignedCalibrations(bare, [p for p in order if p in bare.hypothesis.locations], [], (note,))


def _split_calibrations(
    validation: ValidationSet, final: ValidatedHypothesis, order: list[EffectLocation]
) -> tuple[list[EffectLocation], list[EffectLocation]]:
    """Effects and calibrations of the machine, and calibrations that belong to the training recordings alone.

    A calibration belongs to the machine if its trained value makes free runs over the validation recordings
    clearly better.
    """
    s = validation.problem.supermodel
    kept, own, trained = list(order), [], final.with_trained_calibrations(s)
    for location in [p for p in order if p in s.calibrations]:
        with_it = validation.short_run_errors(trained, kept)
        less = validation.short_run_errors(trained, [p for p in kept if p != location])
        if mean_log_ratio(with_it, less) > -WINDOWS_BETTER:
            kept.remove(location)
            own.append(location)
    return kept, own


def _better_without(
    problem: LikelihoodProblem,
    validation: ValidationSet,
    final: ValidatedHypothesis,
    order: Sequence[EffectLocation],
) -> ValidatedHypothesis | None:
    """The final model fitted without calibrations, if its free runs over validation data are better; or None.

    Training recordings may have offsets that the validation recordings do not share. A fit with such offsets
    may then give worse parameters than a fit without any.
    """
    bare, s = final.hypothesis, problem.supermodel
    calibrations = set(bare.locations) & set(s.calibrations)
    if not calibrations:
        return None
    for location in calibrations:
        bare = without(s, bare, location)
    alone = validate(validation, refit(problem, [bare])[0])
    with_them = validation.short_run_errors(final.with_trained_calibrations(s), order)
    locations = [p for p in order if p in bare.locations]
    without_them = validation.short_run_errors(alone.with_trained_calibrations(s), locations)
    return alone if runs_clearly_better(without_them, with_them) else None


def calibration_notes(
    s: SuperModel, final: ValidatedHypothesis, own: Sequence[EffectLocation], used: Mechanism
) -> tuple[str, ...]:
    """Sentences on calibrations that differ between recordings, with their values.

    Args:
        s: The super-model.
        final: The final model, with calibrations of the training and of the validation recordings.
        own: Calibrations that the search does not carry over to other recordings.
        used: The mechanism of the model to use, which may have values that are common to all runs.
    """
    common = used.named_values
    out = []
    for location in own:
        for i in s.parameter_indices(location):
            unit, name = s.mechanism.parameter_specifications[i].unit, s.mechanism.parameter_names[i]
            columns = (h.values(s)[:, i] for h in (final.hypothesis, final.adapted))
            out.append(
                f"{titled(location)} belongs to each recording, not to the machine: "
                f"{_where_fitted(final, *([f'{v:+.3g} {unit}' for v in each] for each in columns))}; it was "
                "fitted, "
                + (
                    f"and the model to use has {common[name]:+.3g} {unit}."
                    if name in common
                    else "but not carried over."
                )
            )
    return tuple(out)


def disturbance_notes(s: SuperModel, final: ValidatedHypothesis) -> tuple[str, ...]:
    """Sentences on periodic disturbances, whose size and phase belong to each recording."""
    out = []
    for location in [p for p in final.hypothesis.locations if CATALOG[p.effect].line]:
        amplitudes = [i for i in s.parameter_indices(location) if i in s.phased]
        unit = s.mechanism.parameter_specifications[amplitudes[0]].unit
        sizes = (
            [f"{np.hypot(*row):.3g} {unit}" for row in h.values(s)[:, amplitudes]]
            for h in (final.hypothesis, final.adapted)
        )
        out.append(
            f"{titled(location)} comes from outside and belongs to each recording, not to the machine: "
            f"{_where_fitted(final, *sizes)}. Size and phase were fitted "
            "to each: errors on validation data are those with it, errors on test recordings those without."
        )
    return tuple(out)


def _where_fitted(final: ValidatedHypothesis, trained: Sequence[str], adapted: Sequence[str]) -> str:
    """Values of each training and of each validation recording in words."""
    first, second = ", ".join(trained), ", ".join(adapted)
    if final.folds:  # the same recordings
        return f"{first} in the recordings ({second} where the model is fitted to the others)"
    return f"{first} in the training data, {second} in the validation data"
