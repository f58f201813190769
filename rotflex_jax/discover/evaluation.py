"""Evaluation of fitted models: errors of free runs, with and without own offsets of each run, and estimates.

The rounds of a search do not depend on this module; the final fit compares structures by its errors.
"""

import dataclasses
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.hypothesis import Hypothesis, with_all_calibrations
from rotflex_jax.discover.likelihood import (
    BLOCK_SECONDS,
    LikelihoodProblem,
    process_noise_gain,
    refit,
)
from rotflex_jax.discover.result import KnownRuns, RunErrors, Stage
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.discover.validation import (
    Horizons,
    SearchHorizon,
    ValidatedHypothesis,
    ValidationSet,
    adapted_to_recordings,
    carried_over,
)
from rotflex_jax.effects import CATALOG
from rotflex_jax.fit import inference
from rotflex_jax.fit.coordinates import FitCoordinates
from rotflex_jax.fit.dataset import Windows, padded_length, prepare
from rotflex_jax.fit.held_constants import with_held_constants
from rotflex_jax.fit.inference import Combination, curvature, sandwich
from rotflex_jax.fit.plausibility import check_signs
from rotflex_jax.mechanism import Solver
from rotflex_jax.metrics import windowed_rmse
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Estimate
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import ACCEPTABLE
from rotflex_jax.runtime.persistent_jit import make_ahead

# Two estimates agree if they differ by no more than this share, however narrow their intervals are.
SAME_SIZE = 0.25
# Recordings that are drawn to find the error by noise alone.
NOISE_DRAWS = 20
# Largest number of fits of the offsets of a recording; each uses the size of the errors that the last one
# left.
MOST_OFFSET_FITS = 8


def calibrate(problem: LikelihoodProblem, h: Hypothesis, seconds: float) -> Hypothesis:
    """A trained hypothesis with offsets that are fitted to the beginning of each recording.

    Offsets belong to a run, not to the machine: an amplifier's offset of 0.04 V moves a servo by degrees
    within seconds. They are fitted to free runs over the first seconds, together with the first state, while
    everything else keeps its trained value. A prior expects offsets of usual size. Errors of a free run are
    correlated over about half a second, so a block of this length counts as one measurement against the
    prior. The size of the errors is common to all recordings. For a recording no longer than `seconds`, no
    data are left on which the offsets could be tested.

    Args:
        problem: Likelihood of free runs over recordings to which the hypothesis was not fitted.
        h: Trained hypothesis.
        seconds: Length of the part of each recording that is used [s].
    """
    start = with_all_calibrations(problem.supermodel, carried_over(problem, h))
    early = problem.first_seconds(seconds)
    prior = BLOCK_SECONDS / np.asarray(problem.dataset.data.Ts)
    own = start
    # Errors caused by an offset do not measure how well it is determined: the size of errors is updated.
    for _ in range(MOST_OFFSET_FITS):
        own = early.with_likelihood(own)
        if not np.isfinite(own.log_likelihood):
            return start
        before, own = own, adapted_to_recordings(early, own, prior)
        if np.array_equal(own.x0, before.x0) and np.array_equal(own.local_z, before.local_z):
            break  # further fits would change nothing either
    return own


class FreeRuns(NamedTuple):
    """Free runs over recordings, each with a model of its own.

    Attributes:
        whole: One run over each recording.
        windows: Runs over each recording that start again every few seconds.
        errors: Errors of both.
    """

    whole: tuple[Float[np.ndarray, "_ C"], ...]
    windows: tuple[Float[np.ndarray, "_ C"], ...]
    errors: RunErrors


def free_runs(validation: ValidationSet, models: Sequence[Model]) -> FreeRuns:
    """Free runs over the recordings of a validation set, with one model for each recording."""
    recordings, channels = validation.problem.dataset.recordings, models[0].mechanism.channels
    pairs = list(zip(models, recordings, strict=True))
    whole = tuple(m.simulate(r) for m, r in pairs)
    windows = tuple(m.simulate_windows(r, validation.window_seconds) for m, r in pairs)
    e = [(y_hat - m.measured(r))[r.n_init :] for y_hat, (m, r) in zip(whole, pairs, strict=True)]
    total = np.nan_to_num(np.sqrt(np.mean(np.concatenate(e) ** 2, axis=0)), nan=np.inf, posinf=np.inf)
    short = validation.window_rmse(windows)
    by_channel = (dict(zip(channels, errors.tolist(), strict=True)) for errors in (total, short))
    return FreeRuns(whole, windows, RunErrors(*by_channel))


def errors_by_noise(validation: ValidationSet, models: Sequence[Model]) -> dict[str, float]:
    """Errors that short free runs would have by noise alone, if each machine were exactly its model.

    Recordings of such machines are drawn: the runs over windows of the models, with sensor noise. Runs over
    windows start from their first samples, so this noise moves their first states too. Where motions that
    start close to each other separate, as in a pendulum near its highest point, it causes most of the error.

    Args:
        validation: Free runs over the recordings.
        models: The model of each recording.

    Returns:
        Channel -> root mean square error [unit of the channel]; empty where a run diverges.
    """
    problem, seconds, channels = validation.problem, validation.window_seconds, models[0].mechanism.channels
    rng, drawn = np.random.default_rng(0), []
    for model, recording in zip(models, problem.dataset.recordings, strict=True):
        right = model.simulate_windows(recording, seconds)
        if not np.all(np.isfinite(right)):
            return {}
        for _ in range(NOISE_DRAWS):
            measured = right + problem.noise * rng.standard_normal(right.shape)
            like = dataclasses.replace(
                recording,
                y=measured,
                channels=channels,
                units=tuple(map(recording.unit, channels)),
                resolution=None,
                accept=ACCEPTABLE,
            )
            drawn.append((like, measured, model.simulate_windows(like, seconds)))
    recordings, measured, simulated = zip(*drawn, strict=True)
    rmse = windowed_rmse(recordings, measured, simulated, seconds)
    return dict(zip(channels, np.nan_to_num(rmse, nan=np.inf).tolist(), strict=True))


def errors_with_own_calibration(
    validation: ValidationSet,
    trained: Sequence[Hypothesis],
    locations: Sequence[EffectLocation],
    seconds: float,
) -> RunErrors:
    """Errors of free runs with the offsets of each recording fitted to its own first seconds.

    Args:
        validation: Free runs over the recordings.
        trained: One hypothesis for all recordings; or one for each, which is fitted without it, or which has
            what is known of its run.
        locations: Effects of the model; all calibrations are added.
        seconds: Length of the part of each recording to which its offsets are fitted [s].
    """
    problem = validation.problem
    on = list(dict.fromkeys([*locations, *problem.supermodel.calibrations]))
    if len(trained) == 1:
        own = [calibrate(problem, trained[0], seconds)] * len(problem.seen)
    else:
        own = [calibrate(problem.of_recordings([k]), h, seconds) for k, h in enumerate(trained)]
    return free_runs(validation, [validation.model_of(h, on, i) for i, h in enumerate(own)]).errors


def errors_as_trained(
    validation: ValidationSet, trained: Sequence[Hypothesis], locations: Sequence[EffectLocation]
) -> RunErrors:
    """Errors of free runs with trained parameters and without periodic disturbances.

    Args:
        validation: Free runs over the recordings.
        trained: One hypothesis for all recordings, or one for each.
        locations: Effects of the model.
    """
    s = validation.problem.supermodel
    means = [_with_own_values(s, h, h.mean_local_z(s)[None]) for h in trained]
    each = _for_each(means, len(validation.problem.dataset.recordings))
    return free_runs(validation, [validation.model_of(h, locations, 0) for h in each]).errors


def _for_each(trained: Sequence[Hypothesis], count: int) -> Sequence[Hypothesis]:
    """One hypothesis for each recording; a single one is repeated."""
    return [trained[0]] * count if len(trained) == 1 else trained


def _with_own_values(s: SuperModel, h: Hypothesis, local_z: Float[np.ndarray, "R L"]) -> Hypothesis:
    """A trained hypothesis for R recordings with given local values and no periodic disturbance.

    Only for `ValidationSet.model_of`: first states and gains are copies of those of the first recording.
    """
    return dataclasses.replace(
        h,
        local_z=local_z * [i not in s.phased for i in h.local],
        x0=np.repeat(h.x0[:1], len(local_z), axis=0),
        K=np.repeat(h.K[:1], len(local_z), axis=0),
        densities=np.array(-np.inf),
    )


def errors_on_test(
    test: ValidationSet,
    trained: Sequence[Hypothesis],
    own: Float[np.ndarray, "K L"],
    locations: Sequence[EffectLocation],
    runs: KnownRuns,
    of_runs: Sequence[EffectLocation] = (),
) -> RunErrors:
    """Errors of free runs over test recordings, each with the offsets that are known of its run.

    A recording of a run that was fitted has the offsets of that run. A recording of another run has only the
    offsets of the machine, and no offsets that a single run has shown. Periodic disturbances are left out.

    Args:
        test: Free runs over the test recordings.
        trained: One hypothesis for all recordings; or one for each, with what is known of its run.
        own: Unconstrained values of the local parameters in each of the fitted recordings.
        locations: Effects of the model.
        runs: The fitted recordings.
        of_runs: Further calibrations that the model has for recordings of the fitted runs.
    """
    s, recordings, models = test.problem.supermodel, test.problem.dataset.recordings, []
    machine = [p for p in locations if runs.compared or p not in s.calibrations]
    for h, r in zip(_for_each(trained, len(recordings)), recordings, strict=True):
        k = runs.index(r)
        local, on = (h.mean_local_z(s), machine) if k is None else (own[k], [*locations, *of_runs])
        models.append(test.model_of(_with_own_values(s, h, local[None]), on, 0))
    return free_runs(test, models).errors


def evaluate(
    problem: LikelihoodProblem,
    validation: ValidationSet,
    solver: Solver,
    validated: ValidatedHypothesis,
    locations: Sequence[EffectLocation],
) -> Stage:
    """Evaluate a hypothesis for the report: estimates with intervals, free runs and their errors.

    Args:
        problem: Likelihood of the training recordings.
        validation: The validation recordings.
        solver: Integration rule of the model that a user gets.
        validated: The hypothesis with its validation likelihood.
        locations: Effects of the stage's model. Calibrations that belong to the training recordings alone are
            in the hypothesis, but not among them.
    """
    h, s = validated.hypothesis, problem.supermodel
    trained = validated.with_trained_calibrations(s)
    every = range(len(validation.problem.dataset.recordings))
    runs = free_runs(validation, validation.models_as_trained(validated, locations))
    differ = s.phased.intersection(h.local).union(h.sizes)
    values, adapted, names = h.values(s), trained.values(s), s.mechanism.parameter_names
    of_each = [s.clean(adapted[i], locations) for i in every] if differ else []
    of_validation = {names[i]: tuple(adapted[:, i].tolist()) for i in h.sizes if not validation.folds}
    return Stage(
        model=Model(s.clean(h.mean_values(s), locations), solver),
        estimates=estimates(problem, h),
        held_out_rmse=runs.errors.whole,
        held_out_rmse_windows=runs.errors.windows,
        simulated=runs.whole,
        windowed=runs.windows,
        window_seconds=validation.window_seconds,
        process_noise=h.process_noise,
        process_noise_nats=0.0 if problem.free_run else process_noise_gain(problem, h),
        log_likelihood=validated.log_likelihood,
        horizon="free_run" if problem.free_run else "prediction",
        of_validation=tuple(Model(m, solver) for m in of_each),
        friction_of_runs={names[i]: tuple(values[:, i].tolist()) for i in h.sizes},
        friction_of_validation=of_validation,
    )


def estimates(problem: LikelihoodProblem, h: Hypothesis) -> tuple[Estimate, ...]:
    """Estimates of all parameters of a hypothesis, with intervals that allow for correlated residuals."""
    s, seen = problem.supermodel, problem.seen
    e, J = problem.slopes([h])
    w = h.whitener(e[0], seen)
    W = h.whitener(J[0, : h.moved], seen)
    R, coordinates = len(h.x0), FitCoordinates.of(h, problem.windows)
    parts = coordinates.parts(w, np.moveaxis(W, 0, -1), seen)
    covariance = sandwich(parts, curvature(parts, coordinates.size))
    values, derivative = h.physical(s)
    mean = h.mean_values(s)
    clean = s.clean(mean, h.locations)
    indices = [s.mechanism.parameter_names.index(name) for name in clean.parameter_names]

    def combination(i: int) -> Combination | None:
        if i in h.free:
            return Combination([h.free.index(i)], derivative[:1, i])
        if i in h.local and i in s.phased:  # first recording, as in the model: phases have no mean
            return Combination([int(coordinates.local_columns(0)[h.local.index(i)])], derivative[:1, i])
        if i in h.local:
            return Combination(
                [int(coordinates.local_columns(r)[h.local.index(i)]) for r in range(R)], derivative[:, i] / R
            )
        return None

    def note(i: int) -> str:
        if i not in h.local or R == 1:
            return ""
        which = "first of" if i in s.phased else "mean of"
        return f"{which} " + ", ".join(f"{v:.3g}" for v in values[:, i])

    found = inference.estimates(
        clean.parameter_names,
        mean[indices],
        clean.parameter_specifications,
        [combination(i) for i in indices],
        covariance,
        [note(i) for i in indices],
    )
    return with_held_constants(clean, found)


def differing(
    training: Sequence[Estimate], validation: Sequence[Estimate]
) -> list[tuple[Estimate, Estimate]]:
    """Parameters whose estimates from two sets of recordings disagree.

    Two estimates agree if their difference is within two of its standard deviations, or if it is no more than
    the share `SAME_SIZE` of the larger one, since intervals of an incomplete model are too narrow.

    Args:
        training: Estimates from the training recordings.
        validation: Estimates of the same model from the validation recordings.
    """
    found, other = [], {e.name: e for e in validation}
    for a in training:
        if a.name not in other or not a.free:
            continue
        b = other[a.name]
        spread = np.nan_to_num(np.hypot(a.std, b.std), nan=np.inf)
        difference = abs(a.value - b.value)
        if difference > 2 * spread and difference > SAME_SIZE * max(abs(a.value), abs(b.value)):
            found.append((a, b))
    return found


class PairedEstimates(NamedTuple):
    """Estimates of one model that was fitted twice, to recordings that have nothing in common.

    Attributes:
        training: Estimates from the first recordings.
        other: Estimates from the other recordings.
        where: The other recordings, in words.
    """

    training: Sequence[Estimate]
    other: Sequence[Estimate]
    where: str


def disagreement(
    pairs: Sequence[PairedEstimates], location: EffectLocation, own: Collection[str] = ()
) -> str:
    """A clause that the size of an effect differs between recordings, or is not determined; otherwise empty.

    Args:
        pairs: Pairs of fits to compare.
        location: The effect; for an effect with a value for each recording, the clause is empty.
        own: Names of sizes that each recording has for itself; they are left out.
    """
    head, kind = location.name_prefix, CATALOG[location.effect]
    names = {location.full_name(n) for n in kind.amplitudes}.difference(own)
    if kind.per_recording or not names:
        return ""
    for training, other, where in pairs:
        for a, b in differing(training, other):
            if a.name in names:
                return (
                    f"{a.name.removeprefix(head)} is {a.value:.3g} {a.unit} fitted to one part of the "
                    f"recordings and {b.value:.3g} {b.unit} fitted to {where}"
                )
        if not any(e.name in names and np.isfinite(e.std) for e in other):
            return f"{where} alone {'does' if where.startswith('recording') else 'do'} not determine its size"
    return ""


def difference_notes(
    s: SuperModel, pairs: Sequence[PairedEstimates], sizes: Collection[int] = ()
) -> tuple[str, ...]:
    """Sentences on parameters of the machine that differ between recordings by more than their intervals.

    Args:
        s: The super-model, whose calibrations and effects with a value for each recording are left out.
        pairs: Pairs of fits to compare.
        sizes: Indices of sizes of friction that each recording has for itself; they are left out too.
    """
    own = {s.mechanism.parameter_names[i] for i in (*s.local, *sizes)}
    for effect in s.mechanism.effects:
        if effect.per_recording:
            own |= {n for n in s.mechanism.parameter_names if n.startswith(effect.name_prefix)}
    return tuple(
        f"{a.name} is {a.value:.3g} {a.unit} fitted to one part of the recordings and {b.value:.3g} {b.unit} "
        f"fitted to {where}: more than the intervals allow."
        for training, other, where in pairs
        for a, b in differing(training, other)
        if a.name not in own
    )


def own_estimates(stage: Stage, location: EffectLocation) -> dict[str, Estimate]:
    """Estimates of one effect of a stage, by short name."""
    head = location.name_prefix
    return {e.name.removeprefix(head): e for e in stage.estimates if e.name.startswith(head)}


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Recordings on which final models are evaluated, with and without offsets of their own.

    Attributes:
        validation: Free runs over the validation recordings.
        test: Free runs over test recordings; None without test recordings.
        calibrate_seconds: Length of the part of a recording to which its own offsets are fitted [s].
        runs: The runs of the training recordings.
    """

    validation: ValidationSet
    test: ValidationSet | None
    calibrate_seconds: float
    runs: KnownRuns

    @classmethod
    def of(
        cls, model: Model, horizons: Horizons, test: Sequence[Recording], calibrate_seconds: float
    ) -> "Evaluation":
        """The evaluation on the recordings of a search and on test recordings.

        Raises:
            InputError: If a recording lacks a channel of the model, or moves against the signs of the model.
        """
        validation, other = horizons.free_run.validation, None
        train = horizons.free_run.problem.dataset.recordings
        runs = KnownRuns.of(train, validation.problem.dataset.recordings)
        if test:
            check_signs(model, test)
            problem, seconds = validation.problem, validation.window_seconds
            length = max(problem.seen.shape[1], padded_length(test))
            dataset = prepare(model, test, length=length, like=problem.dataset)
            s, solver, number = problem.supermodel, problem.predictor.solver, problem.windows.number
            whole = LikelihoodProblem.of(s, solver, dataset, problem.ports, runs.indices(test))
            cut = whole.of_free_runs(Windows.of_seconds(model, dataset, seconds).filled_up(number))
            other = ValidationSet(cut, seconds)
        return cls(validation, other, calibrate_seconds, runs)

    def make_ahead(self, found: ValidatedHypothesis, longest: Recording) -> None:
        """Compile in advance the programs that the evaluation of nested models needs.

        Args:
            found: A model with the effects that the largest of the nested models will have, as far as known.
            longest: The recording on which errors of the baseline are localised.
        """
        h, s, seconds = found.adapted, self.validation.problem.supermodel, self.validation.window_seconds
        built = self.with_built_in(frozenset(s.calibrations).union(h.locations)).validation
        recording, model = built.problem.dataset.recordings[0], built.model_of(h, h.locations, 0)
        make_ahead(lambda: (model.simulate(recording), model.simulate_windows(recording, seconds)))
        make_ahead(model.simulate_windows, longest, seconds)

    def with_built_in(self, effects: frozenset[EffectLocation]) -> "Evaluation":
        """The same evaluation with models that all contain these effects, on or off, to share programs."""
        return dataclasses.replace(
            self,
            validation=dataclasses.replace(self.validation, built_in=effects),
            test=dataclasses.replace(self.test, built_in=effects) if self.test else None,
        )

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """Test recordings, used for no fit and no choice."""
        return self.test.problem.dataset.recordings if self.test else ()

    def of_stage(
        self, stage: Stage, validated: ValidatedHypothesis, locations: Sequence[EffectLocation]
    ) -> Stage:
        """A stage with its errors on test recordings, and with calibrated errors.

        Args:
            stage: The stage with its errors on validation recordings.
            validated: The hypothesis of the stage.
            locations: Effects of the model of the stage.
        """
        h, found = validated.hypothesis, dict[str, Any](calibrate_seconds=self.calibrate_seconds)
        if self.calibrate_seconds:
            each = validated.folds or validated.of_runs(range(len(self.validation.problem.seen)))
            found["calibrated"] = errors_with_own_calibration(
                self.validation, each, locations, self.calibrate_seconds
            )
        if self.test:
            held_back = () if validated.folds else self.validation.problem.dataset.recordings
            each = validated.of_runs(KnownRuns(held_back, True).indices(self.recordings))
            found["test"] = errors_on_test(self.test, each, h.local_z, locations, self.runs)
            if self.calibrate_seconds:
                found["test_calibrated"] = errors_with_own_calibration(
                    self.test, each, locations, self.calibrate_seconds
                )
        return dataclasses.replace(stage, **found)


def paired_estimates(
    horizon: SearchHorizon, found: ValidatedHypothesis, trained: Sequence[Estimate]
) -> tuple[PairedEstimates, ...]:
    """Estimates of a model from the training recordings and from the validation recordings.

    The fit to the validation recordings starts from the trained parameters. Parameters that agree are
    properties of the machine. Where runs validate each other, each is fitted alone and compared with the fit
    to the others. No choice of effects depends on these fits.

    Args:
        horizon: The recordings.
        found: The model.
        trained: Its estimates from all training recordings.
    """
    folds = horizon.validation.folds
    if folds:
        fits = zip(folds, found.folds, strict=True)
        return tuple(
            PairedEstimates(estimates(f.train, h), _fitted_to(f.validation.problem, h), f"recording {k}")
            for k, (f, h) in enumerate(fits, 1)
        )
    other = _fitted_to(horizon.validation.problem, found.adapted)
    return (PairedEstimates(trained, other, "the validation data"),)


def _fitted_to(problem: LikelihoodProblem, start: Hypothesis) -> tuple[Estimate, ...]:
    """Estimates from a fit to the recordings of a problem; none if the start diverges there."""
    begun = problem.with_likelihood(start)
    if not np.isfinite(begun.log_likelihood):
        return ()
    return estimates(problem, refit(problem, [begun], alternations=1)[0])
