"""The last fit of a search that ends unexplained: the structure that was chosen, to all that had a say.

A search fits its models to training recordings alone, so that validation data can compare them. Once these
have chosen, they are as good to learn from as the others: friction differs with the amplitude of the motion
and from run to run, and half of the recordings show half of that.

Parameters of an incomplete model depend on what they are fitted to. Those of the search suit predictions, or
free runs that each have a first state of their own, which may hide a drift of the model. Whoever uses a model
starts it from a measured state. So this fit is to free runs over windows from what their first samples show,
unless validation data speak against that clearly, tried on the training recordings alone. Validation data
also decide whether recordings have offsets that the search could do without. A run of which nothing is known
gets what the fitted runs have in common of them.

In a search each free run has a first state of its own, which hides much of what distinguishes one law of
friction from another. From measured first states it shows: a law that the search cannot exclude takes the
place of the one that it has found where these runs prefer it beyond doubt.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Float

from rotflex_jax.discover.evaluation import (
    Evaluation,
    errors_as_trained,
    errors_on_test,
    errors_with_own_calibration,
    free_runs,
)
from rotflex_jax.discover.hypothesis import (
    Hypothesis,
    replacing,
    usual_start,
    with_all_calibrations,
    with_effect,
    without,
)
from rotflex_jax.discover.in_place import other_laws
from rotflex_jax.discover.likelihood import BLOCK_SECONDS
from rotflex_jax.discover.result import FinalFit, RunErrors, Stage
from rotflex_jax.discover.search_state import SearchState
from rotflex_jax.discover.selection import FREE_RUN_BETTER, FREE_RUN_Z, paired_gain
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.discover.validation import ValidatedHypothesis
from rotflex_jax.effects import CATALOG
from rotflex_jax.errors import InputError
from rotflex_jax.fit.greybox import fit
from rotflex_jax.fit.result import Fit
from rotflex_jax.mechanism import Solver
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Estimate, Transform
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import joined

# Errors of a fit from measured first states over those of the search, both fitted to training recordings,
# up to which the former is taken: logarithm of their ratio on validation data, mean over channels.
MOST_WORSE = 0.2
# Where runs validate each other, at most so many fits, each without a share of them, say how well a way does.
MOST_FOLDS = 3


@dataclasses.dataclass(frozen=True)
class _Structure:
    """What is fitted.

    Attributes:
        starts: The final model, with the calibrations of its recordings, as the search has fitted it and
            with the usual shapes of what was found.
        local: Parameters that each recording has for itself.
        own: Calibrations that are not carried over to other recordings.
        on: What is on in the model that a user gets.
        hypothesis: The same as the search has it.
        supermodel: What it is a hypothesis of.
        window_seconds: Length of free runs [s].
    """

    starts: tuple[Model, ...]
    local: tuple[str, ...]
    own: tuple[EffectLocation, ...]
    on: tuple[EffectLocation, ...]
    hypothesis: Hypothesis
    supermodel: SuperModel
    window_seconds: float

    @classmethod
    def of(
        cls,
        s: SuperModel,
        solver: Solver,
        h: Hypothesis,
        on: Sequence[EffectLocation],
        window_seconds: float,
    ) -> "_Structure":
        """That of a hypothesis; arguments as the attributes."""
        values = {tuple(v.tolist()): v for v in (h.mean_values(s), _with_usual_shapes(s, h))}
        starts = tuple(Model(s.clean(v, h.locations), solver) for v in values.values())
        free = starts[0].mechanism.free_names
        local = [s.mechanism.parameter_names[i] for i in h.local]
        own = tuple(p for p in h.locations if p in s.calibrations and p not in on)
        local = tuple(n for n in local if n in free)
        return cls(starts, local, own, tuple(on), h, s, window_seconds)

    def with_law(self, found: EffectLocation, law: EffectLocation) -> "_Structure":
        """The structure with another law in the place of one that was found."""
        s, h, start = self.supermodel, self.hypothesis, usual_start(self.supermodel, law)
        if found.effect in CATALOG[law.effect].contains:
            h = replacing(s, h, [found], start, 1.0)
        else:
            h = with_effect(s, without(s, h, found), start, 1.0)
        on = [law if p == found else p for p in self.on]
        return _Structure.of(s, self.starts[0].solver, h, on, self.window_seconds)

    def fitted(self, recordings: Sequence[Recording]) -> Fit:
        """The structure fitted to free runs of recordings, the likelier of the ends from its starts.

        Parameters of predictions may lead to another local minimum of free runs than usual ones: to stiff,
        damped bristles of a friction instead of soft ones.
        """
        how = {"first": "measured", "window_seconds": self.window_seconds}
        ends = [fit(model, list(recordings), local=self.local, **how) for model in self.starts]
        return min(ends, key=lambda end: float(np.nan_to_num(end.cost, nan=np.inf)))

    def as_hypothesis(self, found: Fit) -> Hypothesis:
        """A fit in the terms of the search, what recordings have for themselves at its mean."""
        s, m = self.supermodel, found.model.mechanism
        rows = [s.mechanism.parameter_names.index(n) for n in m.parameter_names]
        z = self.hypothesis.z.copy()
        z[rows] = Transform.of(m.parameter_specifications).unconstrain(m.values)
        local_z = np.tile(z[list(self.hypothesis.local)], (len(self.hypothesis.x0), 1))
        return dataclasses.replace(self.hypothesis, z=z, local_z=local_z)

    def own_values(self, found: Fit, count: int) -> Float[np.ndarray, "K L"]:
        """Unconstrained values of the local parameters of the search in each of the fitted recordings."""
        s, m = self.supermodel, found.model.mechanism
        transform = Transform.of(m.parameter_specifications)
        z = np.array([transform.unconstrain(found.model_of(k).mechanism.values) for k in range(count)])
        return z[:, [m.parameter_names.index(s.mechanism.parameter_names[i]) for i in self.hypothesis.local]]

    def validated(self, h: Hypothesis, folds: Sequence[Hypothesis] = ()) -> ValidatedHypothesis:
        """A hypothesis, or one for each recording, as errors are evaluated; nothing is adapted."""
        return ValidatedHypothesis(h, np.zeros(0), h, np.zeros(0), folds=tuple(folds))

    def with_common_offsets(self, found: Fit) -> tuple["_Structure", Fit]:
        """The structure that carries over what runs have in common of their offsets, and the fit with that.

        The offset of a run is that of the machine plus a deviation of the run. By the values of K runs, with
        mean m and variance s^2 (of K - 1 degrees of freedom), that of the machine is estimated as

            m max(0, 1 - s^2 / (K m^2)):

        their mean where they agree, zero where it is no larger than its standard deviation.

        This is an empirical Bayes estimate with a prior of mean zero; it is better than the mean where what
        runs have in common is small against their scatter.

        Source: after B. Efron and C. Morris, "Stein's estimation rule and its competitors - an empirical
        Bayes approach", Journal of the American Statistical Association 68 (1973) 117-130.
        """
        s, common, carried = self.supermodel, dict[str, Estimate](), list[EffectLocation]()
        for location in self.own:
            names = [s.mechanism.parameter_names[i] for i in s.parameter_indices(location)]
            shared = {n: _common(found.local[n]) for n in names if n in found.local}
            if any(e.value for e in shared.values()):
                common |= shared
                carried.append(location)
        left = tuple(p for p in self.own if p not in carried)
        mechanism = found.model.mechanism.with_values({n: e.value for n, e in common.items()})
        found = dataclasses.replace(
            found,
            model=dataclasses.replace(found.model, mechanism=mechanism),
            parameters=tuple(common.get(e.name, e) for e in found.parameters),
        )
        return dataclasses.replace(self, own=left, on=(*self.on, *carried)), found

    def carried(self, found: Fit) -> Model:
        """The model of a fit without what belongs to the recordings that were fitted."""
        m = found.model.mechanism
        for location in self.own:
            m = m.without(*location)
        return dataclasses.replace(found.model, mechanism=m)


def _common(of_runs: Sequence[Estimate]) -> Estimate:
    """What runs have in common by the estimates of each; see `_Structure.with_common_offsets`.

    Its interval has the width of that of their mean, by how they differ.
    """
    values = [e.value for e in of_runs]
    count, mean = len(values), float(np.mean(values))
    std = float(np.std(values, ddof=1)) / np.sqrt(count)
    value = mean * max(0.0, 1.0 - (std / mean) ** 2) if mean else 0.0
    half = float(scipy.special.stdtrit(count - 1, 0.975)) * std
    note = "common to runs with " + ", ".join(f"{v:.3g}" for v in values)
    return dataclasses.replace(of_runs[0], value=value, std=std, ci95=(value - half, value + half), note=note)


def _with_usual_shapes(s: SuperModel, h: Hypothesis) -> Float[np.ndarray, " P"]:
    """Parameter values with amplitudes in the unit of an effect's first parameter as fitted, others as usual.

    An effect without such an amplitude is left as it is.
    """
    values, specs = h.mean_values(s), s.mechanism.parameter_specifications
    for location in s.without_calibrations(h.locations):
        candidate, indices = s.candidates[location], s.parameter_indices(location)
        sizes = np.array([specs[i].unit for i in indices]) == specs[indices[0]].unit
        kept = np.asarray(candidate.amplitudes) & sizes
        if kept.any():
            values[indices] = np.where(kept, values[indices], np.array(candidate.probes[0][0]))
    return values


class Refused(NamedTuple):
    """Why the final model was not fitted to all that had a say.

    Attributes:
        sentence: For the notes of a result.
    """

    sentence: str


def fit_to_all(
    state: SearchState, stage: Stage, final: ValidatedHypothesis, evaluation: Evaluation
) -> FinalFit | Refused:
    """The final model fitted once more, to training and validation recordings together.

    Args:
        state: What was found.
        stage: The final model as it is reported.
        final: The same as a hypothesis.
        evaluation: The recordings that errors are reported on.

    Returns:
        The fit; or why there is none: validation data speak against it, it does worse on them than the model
        that has not seen them, or it has a periodic disturbance, whose phase no other recording shares.
    """
    if state.problem.supermodel.phased.intersection(final.hypothesis.local):
        return _refused(state, "it has a periodic disturbance, whose phase no other recording shares")
    state.say("fitting what was chosen to all recordings that had a say")
    try:
        return _fitted_to_all(state, stage, final.hypothesis, evaluation)
    except InputError as error:  # some recordings cannot be fitted alone: no reason to lose what was found
        return _refused(state, str(error).rstrip("."))


def _refused(state: SearchState, why: str) -> Refused:
    """A reason as a sentence."""
    used = "all recordings" if state.validation.folds else "training and validation recordings together"
    return Refused(f"The model to use is that of the search, not one fitted to {used}: {why}.")


def _worse(ratio: float, seconds: float) -> str:
    """That errors are larger, by the logarithm of their ratio."""
    if np.isinf(ratio):
        return "its runs of the validation data diverge"
    return f"its errors over {seconds:g} s on validation data are {np.exp(ratio):.3g} times as large"


class _Tried(NamedTuple):
    """A structure fitted without the validation data.

    Attributes:
        structure: What is fitted.
        fits: To the training recordings; where runs validate each other, one without each of them.
        errors: On the validation recordings, with their own offsets if these count.
    """

    structure: _Structure
    fits: Sequence[Fit]
    errors: RunErrors

    @classmethod
    def of(cls, state: SearchState, structure: _Structure, evaluation: Evaluation) -> "_Tried":
        """A structure, fitted and validated."""
        train = state.problem.dataset.recordings
        if state.validation.folds:
            fits = _without_each(structure, train)
        else:
            fits = [structure.fitted(joined(train))]
        return cls(structure, fits, _on_validation(structure, fits, evaluation))


def _fitted_to_all(
    state: SearchState, stage: Stage, h: Hypothesis, evaluation: Evaluation
) -> FinalFit | Refused:
    train, validation, s = state.problem.dataset.recordings, state.validation, state.problem.supermodel
    held_back = () if validation.folds else validation.problem.dataset.recordings
    searched = stage.calibrated or RunErrors(stage.held_out_rmse, stage.held_out_rmse_windows)
    variants = {v.locations: v for v in (h, with_all_calibrations(s, h))}
    structures = [
        _Structure.of(s, state.model.solver, v, state.order, validation.window_seconds)
        for v in variants.values()
    ]
    tried = [_Tried.of(state, structure, evaluation) for structure in structures]
    best = min(tried, key=lambda each: log_error_ratio(each.errors, searched))
    if (ratio := log_error_ratio(best.errors, searched)) > MOST_WORSE:
        others = "the other recordings" if validation.folds else "the training recordings"
        worse = _worse(ratio, validation.window_seconds)
        return _refused(state, f"fitted in that way to {others} alone, {worse}")
    recordings = joined((*train, *held_back))
    found = best.structure.fitted(recordings)
    laws = []
    for location in [p for p in state.order if p in state.scores]:
        law, best, found = _with_better_law(state, location, best, found, recordings, evaluation, searched)
        laws += [(location, law)] if law else []
    structure, fits, trained = best
    # A fit to recordings that does worse on them than one that has not seen them has failed; without their
    # offsets it may be a little worse by chance.
    bare = RunErrors(stage.held_out_rmse, stage.held_out_rmse_windows)
    if evaluation.runs.compared and len(recordings) > 1:
        # What most runs have in common may be far from what a run of validation data has.
        options = [structure.with_common_offsets(found), (structure, found)]
    else:
        options = [(_with_offsets_that_help(structure, fits, evaluation), found)]
    for structure, found in options:
        carried = log_error_ratio(_as_carried(structure, [found] * len(fits), evaluation), bare)
        if carried <= MOST_WORSE:
            break
    own = log_error_ratio(_on_validation(structure, [found] * len(fits), evaluation), searched)
    if carried > MOST_WORSE or own > 0:
        worse = _worse(carried if carried > MOST_WORSE else own, validation.window_seconds)
        return _refused(state, f"{worse}, although it was fitted to them")
    return _reported(structure, found, recordings, evaluation, trained, searched, laws)


def _with_better_law(
    state: SearchState,
    location: EffectLocation,
    best: _Tried,
    found: Fit,
    recordings: tuple[Recording, ...],
    evaluation: Evaluation,
    searched: RunErrors,
) -> tuple[EffectLocation | None, _Tried, Fit]:
    """The law that free runs of all recordings prefer in the place of one that was found, if there is one.

    Laws of the same thing that the search cannot exclude take part, and those that contain the one found.

    Args:
        state: What was found.
        location: The effect.
        best: The structure with the law that was found.
        found: The same fitted to all recordings.
        recordings: All that had a say.
        evaluation: With the validation recordings.
        searched: Errors of the search's own fit on them.

    Returns:
        The law, or None; the structure to use and its fit.
    """
    s, h = state.problem.supermodel, best.structure.hypothesis
    able = []
    for law in other_laws(s, location):
        special_case = law.effect in CATALOG[location.effect].contains
        possible = law in state.rivals.get(location, []) or location.effect in CATALOG[law.effect].contains
        if possible and not special_case and law not in h.locations:
            structure = best.structure.with_law(location, law)
            end = structure.fitted(recordings)
            if _runs_prefer(end, found, recordings, best.structure.window_seconds):
                able.append((end, structure, law))
    for end, structure, law in sorted(able, key=lambda each: each[0].cost):
        tried = _Tried.of(state, structure, evaluation)
        if log_error_ratio(tried.errors, searched) <= MOST_WORSE:
            return law, tried, end
    return None, best, found


def _runs_prefer(a: Fit, b: Fit, recordings: Sequence[Recording], seconds: float) -> bool:
    """Whether free runs of a fit leave a tenth less than those of another one, over most half seconds.

    Args:
        a: Fitted to the recordings.
        b: The same, of another structure.
        recordings: Those that were fitted.
        seconds: How long each free run is [s].
    """
    smaller = float(np.mean([np.log(a.noise[c] / b.noise[c]) for c in b.noise]))
    if not smaller < -FREE_RUN_BETTER:
        return False
    blocks = [np.concatenate([_blocks(x, k, r, seconds) for k, r in enumerate(recordings)]) for x in (a, b)]
    return paired_gain(*blocks)[1] > FREE_RUN_Z


def _blocks(found: Fit, k: int, recording: Recording, seconds: float) -> Float[np.ndarray, " B"]:
    """Log-likelihood of each half second of free runs over a fitted recording, the `k`-th [nat]."""
    model, noise = found.model_of(k), np.array(list(found.noise.values()))
    e = (model.simulate_windows(recording, seconds) - model.measured(recording)) / noise
    starts = np.arange(0, recording.N, max(round(BLOCK_SECONDS / recording.Ts), 1))
    return np.add.reduceat(-np.sum(0.5 * e**2 + np.log(noise), axis=1), starts)


def _with_offsets_that_help(structure: _Structure, fits: Sequence[Fit], evaluation: Evaluation) -> _Structure:
    """The structure that carries over the offsets with which runs of validation data are better."""
    for location in structure.own:
        left = tuple(p for p in structure.own if p != location)
        more = dataclasses.replace(structure, own=left, on=(*structure.on, location))
        errors = (_as_carried(each, fits, evaluation) for each in (more, structure))
        if log_error_ratio(*errors) < 0:
            structure = more
    return structure


def log_error_ratio(a: RunErrors, b: RunErrors) -> float:
    """Logarithm of errors `a` over windows by errors `b`, mean over channels.

    Infinite where runs of `a` diverge, minus infinity where those of `b` alone do.
    """
    before, after = (np.array([x.windows[c] for c in b.windows]) for x in (b, a))
    if not np.isfinite(after).all():
        return np.inf
    if not np.isfinite(before).all():
        return -np.inf
    least = np.finfo(float).tiny
    return float(np.mean(np.log(np.maximum(after, least) / np.maximum(before, least))))


def _without_each(structure: _Structure, train: Sequence[Recording]) -> list[Fit]:
    """For each training recording a fit to others; of many, every third one is left out at a time."""
    folds, each = min(len(train), MOST_FOLDS), range(len(train))
    fits = [structure.fitted([train[k] for k in each if k % folds != fold]) for fold in range(folds)]
    return [fits[k % folds] for k in each]


def _on_validation(structure: _Structure, fits: Sequence[Fit], evaluation: Evaluation) -> RunErrors:
    """Errors on the validation recordings of one fit, or of one for each, with own offsets if these count."""
    validation, seconds = evaluation.validation, evaluation.calibrate_seconds
    if not seconds:
        return _as_carried(structure, fits, evaluation)
    each = [structure.as_hypothesis(found) for found in fits]
    found = structure.validated(each[0], each if validation.folds else ())
    return errors_with_own_calibration(validation, found, structure.on, seconds)


def _as_carried(structure: _Structure, fits: Sequence[Fit], evaluation: Evaluation) -> RunErrors:
    """The same with what the fits carry over, and nothing of the recordings' own."""
    validation, each = evaluation.validation, [structure.as_hypothesis(found) for found in fits]
    if not validation.folds:
        return errors_as_trained(validation, each[0], structure.on)
    return free_runs(validation, [validation.model_of(h, structure.on, 0) for h in each]).errors


def _reported(
    structure: _Structure,
    found: Fit,
    fitted: tuple[Recording, ...],
    evaluation: Evaluation,
    trained: RunErrors,
    searched: RunErrors,
    laws: Sequence[tuple[EffectLocation, EffectLocation]],
) -> FinalFit:
    """A fit with its errors on recordings that had no say."""
    test = calibrated = None
    seconds = evaluation.calibrate_seconds
    if evaluation.test:
        h = structure.as_hypothesis(found)
        runs = evaluation.runs._replace(recordings=fitted)
        own = structure.own_values(found, len(fitted))
        # Of one run alone, validation data have said already whether its own offsets do any good.
        of_runs = structure.own if runs.compared else ()
        test = errors_on_test(evaluation.test, h, own, structure.on, runs, of_runs)
        if seconds:
            validated = structure.validated(h)
            calibrated = errors_with_own_calibration(evaluation.test, validated, structure.on, seconds)
    return FinalFit(
        fit=found,
        recordings=fitted,
        model=structure.carried(found),
        trained=trained,
        searched=searched,
        test=test,
        test_calibrated=calibrated,
        laws=tuple(laws),
    )
