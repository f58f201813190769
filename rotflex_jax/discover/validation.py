"""Hypotheses on validation data: likelihood in blocks, short free runs, the two horizons of a search.

As in `Model.simulate_windows`, positions and speeds at the start of a window come from its first samples. For
states that no sensor measures, values are given here, while `Model.simulate_windows` takes them from a run
over the whole recording. That method is not used here, since it would be compiled again for every candidate.
"""

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.batched_predictor import BatchedPredictor, Directions, ParameterSet
from rotflex_jax.discover.hypothesis import Hypothesis, embed_initial_state
from rotflex_jax.discover.likelihood import DIVERGED, LikelihoodProblem, in_blocks, refit
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.fit.coordinates import FitCoordinates
from rotflex_jax.fit.dataset import Dataset, Windows
from rotflex_jax.mechanism import Solver
from rotflex_jax.metrics import counted, window_starts, windowed_rmse
from rotflex_jax.models.model import Model
from rotflex_jax.optimise.damped_least_squares import NormalEquations, Rules, minimise_together
from rotflex_jax.runtime.xla import on_threads

# Rules of the fit of a window's first state. A few samples determine it well, so the fit is hardly damped.
FIRST_STATE_RULES = Rules(enough_share=1e-9, damping=1e-6, least=1e-6)
MAX_FIRST_STATE_STEPS = 12


class _FirstState(NamedTuple):
    """First positions and speeds of one window."""

    recording: int
    window: int
    samples: slice
    state: Float[np.ndarray, " s"]


@dataclasses.dataclass(frozen=True)
class ShortRuns:
    """Free runs over the windows of some recordings.

    Attributes:
        predictor: Computes the runs.
        dataset: The recordings.
        windows: Windows at whose beginnings the runs start again.
    """

    predictor: BatchedPredictor
    dataset: Dataset
    windows: Windows

    def outputs(self, run: ParameterSet, directions: int) -> list[Float[np.ndarray, "_ C"]]:
        """Outputs of free runs over each recording; as measured where a sample does not count.

        Args:
            run: Parameters and first states (R, W, m). First positions and speeds are fitted, starting from
                those of `windows`; other states keep the values given here. The gain is not used.
            directions: Number of directions of the compiled slopes: the number that fits of this structure
                have, and at least one for each coordinate of a first state.
        """
        run = run._replace(K=np.zeros_like(run.K))
        found = run._replace(x0=self._first_states(run, directions))
        y_hat = self.dataset.data.y - self.predictor.innovations([found], self.windows.index)[0]
        return [np.asarray(y_hat[r, : recording.N]) for r, recording in enumerate(self.dataset.recordings)]

    def _first_states(self, run: ParameterSet, directions: int) -> Float[np.ndarray, "R W m"]:
        """First states whose positions and speeds are fitted to the first samples of each window."""
        size, (R, P) = self.windows.first_states.shape[-1], run.values.shape
        x0_tangents = np.eye(directions, run.x0.shape[-1])
        x0_tangents[size:] = 0.0
        tangents = Directions(
            np.zeros((directions, R, P)), x0_tangents, np.zeros((directions, len(run.gates)))
        )

        def started_at(points: list[_FirstState]) -> ParameterSet:
            x0 = run.x0.copy()
            for p in points:
                x0[p.recording, p.window, :size] = p.state
            return run._replace(x0=x0)

        def linearise(points: list[_FirstState]) -> list[NormalEquations]:
            def equations(_: int, e: np.ndarray, J: np.ndarray) -> list[NormalEquations]:
                heads = ((J[:size, p.recording, p.samples], e[p.recording, p.samples]) for p in points)
                return [NormalEquations.of(slopes.reshape(size, -1).T, w.ravel()) for slopes, w in heads]

            # One run over each recording serves all of its windows.
            index = self.windows.index
            return self.predictor.of_slopes(equations, [started_at(points)], [tangents], index)[0]

        found = minimise_together(
            linearise,
            self._rough_states(),
            FIRST_STATE_RULES,
            move=lambda p, step: p._replace(state=p.state + step),
            max_steps=MAX_FIRST_STATE_STEPS,
        )
        return started_at([m.x for m in found]).x0

    def _rough_states(self) -> list[_FirstState]:
        out = []
        for r, recording in enumerate(self.dataset.recordings):
            for w, samples in self.windows.of(r):
                first = slice(samples.start, samples.start + recording.n_init)
                out.append(_FirstState(r, w, first, self.windows.first_states[r, w]))
        return out


# Rules of the fit of first states, calibrations and friction. The problem is nearly linear, so the damping is
# small from the start, but not zero: recordings need not determine every state.
ADAPTATION_RULES = Rules(enough=0.05, damping=1e-6, least=1e-6, increase=30)
MAX_ADAPTATION_STEPS = 20


@dataclasses.dataclass(frozen=True)
class ValidatedHypothesis:
    """A fitted hypothesis, evaluated on validation data.

    Attributes:
        hypothesis: The hypothesis, fitted to the training recordings.
        blocks: Evidence of each half second of the validation recordings, as in `Hypothesis.blocks`.
        adapted: The same physics with first states and calibrations of the validation recordings, and with
            their friction where it differs between runs.
        window_rmse: Root mean square error of short free runs, by channel.
        location: The effect by which it exceeds the hypothesis that it is compared with.
        parameter_count: Number of parameters of this effect.
        free_run: The same structure fitted to free runs, with its own parameters.
        folds: Where runs validate each other, the fits without each of them.
    """

    hypothesis: Hypothesis
    blocks: Float[np.ndarray, " B"]
    adapted: Hypothesis
    window_rmse: Float[np.ndarray, " C"]
    location: EffectLocation | None = None
    parameter_count: int = 0
    free_run: "ValidatedHypothesis | None" = None
    folds: tuple[Hypothesis, ...] = ()

    def with_trained_calibrations(self, s: SuperModel) -> Hypothesis:
        """The hypothesis on the validation recordings, with the mean calibrations of training recordings.

        The phase of a periodic disturbance keeps its adapted value, since recordings never share it. So does
        friction that differs between runs: it has the size of the run, or was fitted to the recording.

        Args:
            s: The super-model of the hypothesis.
        """
        if self.folds:
            trained = [h.local_z[k] for k, h in enumerate(self.folds)]
            local_z = self.adapted.local_z.copy()
            local_z[:, len(self.hypothesis.free) :] = trained
        else:
            local_z = np.tile(self.hypothesis.local_z.mean(axis=0), (len(self.adapted.x0), 1))
        own = [k for k, i in enumerate(self.adapted.local) if i in s.phased or i in self.adapted.sizes]
        local_z[:, own] = self.adapted.local_z[:, own]
        return dataclasses.replace(self.adapted, local_z=local_z)

    def of_runs(self, indices: Sequence[int | None]) -> list[Hypothesis]:
        """The hypothesis for some recordings: one for each if friction differs between runs, else one.

        Args:
            indices: For each recording, the index of a validation recording of the same run, whose friction
                it has; None if there is none.
        """
        h = self.hypothesis
        return [h if k is None else with_friction_of(self.adapted, k, h) for k in indices] if h.sizes else [h]

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of the validation recordings [nat]."""
        return float(np.sum(self.blocks))


def with_friction_of(adapted: Hypothesis, recording: int, h: Hypothesis) -> Hypothesis:
    """A hypothesis with the friction of one run for all of its recordings.

    Args:
        adapted: The same structure on other recordings.
        recording: Index of the one of them that belongs to the run.
        h: The hypothesis.
    """
    local_z = h.local_z.copy()
    for i in h.sizes:
        local_z[:, h.local.index(i)] = adapted.local_z[recording, adapted.local.index(i)]
    return dataclasses.replace(h, local_z=local_z)


@dataclasses.dataclass(frozen=True)
class ValidationSet:
    """Recordings that no hypothesis is fitted to, and by which hypotheses are compared.

    Attributes:
        problem: The likelihood of these recordings.
        window_seconds: Length of the windows of short free runs [s].
        chosen: Indices of the recordings that count; all if empty.
        folds: Where runs validate each other, one fold for each recording.
        built_in: Effects that are in the equations of every model of `model_of`, with a gate of zero where
            they are off.
    """

    problem: LikelihoodProblem
    window_seconds: float
    chosen: tuple[int, ...] = ()
    folds: "tuple[Fold, ...]" = ()
    built_in: frozenset[EffectLocation] = frozenset()

    @classmethod
    def leave_one_out(cls, problem: LikelihoodProblem, window_seconds: float) -> "ValidationSet":
        """Each training recording validates what was fitted to the others.

        Args:
            problem: Likelihood of the training recordings, of which there are at least two.
            window_seconds: Length of the windows of short free runs [s].
        """
        every = range(len(problem.seen))
        folds = tuple(
            Fold(
                problem.of_recordings([r for r in every if r != k]),
                cls(problem.of_recordings([k]), window_seconds, (k,)),
            )
            for k in every
        )
        return cls(problem, window_seconds, folds=folds)

    def with_solver(self, solver: Solver) -> "ValidationSet":
        """The same recordings with another integration rule."""
        problem = self.problem.with_solver(solver)
        if self.folds:
            return self.leave_one_out(problem, self.window_seconds)
        return dataclasses.replace(self, problem=problem)

    @property
    def counted(self) -> tuple[int, ...]:
        """Indices of the recordings that count."""
        return self.chosen or tuple(range(len(self.problem.dataset.recordings)))

    def model_of(self, h: Hypothesis, locations: Iterable[EffectLocation], recording: int) -> Model:
        """The model of one recording with some effects on.

        Args:
            h: Gives the parameter values.
            locations: Effects that are on.
            recording: Index of the recording, which may have its own calibrations.
        """
        s, on = self.problem.supermodel, frozenset(locations)
        gates = s.gates(on)
        reduced = s.active(s.gates(on | self.built_in))
        mechanism = reduced.mechanism.with_values(h.values(s)[recording, reduced.parameters])
        return Model(mechanism, self.problem.predictor.solver, tuple(gates[list(reduced.effects)]))

    def models_as_trained(
        self, found: "ValidatedHypothesis", locations: Iterable[EffectLocation]
    ) -> list[Model]:
        """The model of each recording with some effects on and with the mean calibrations of training."""
        h, on = found.with_trained_calibrations(self.problem.supermodel), frozenset(locations)
        return [self.model_of(h, on, i) for i in range(len(self.problem.dataset.recordings))]

    @functools.cached_property
    def short_runs(self) -> ShortRuns:
        """Free runs over short windows."""
        p = self.problem
        windows = p.windows
        if not p.free_run:
            model = Model(p.supermodel.baseline, p.predictor.solver)
            windows = Windows.of_seconds(model, p.dataset, self.window_seconds).filled_up(p.windows.number)
        return ShortRuns(p.predictor, p.dataset, windows)

    def short_run_errors(
        self, h: Hypothesis, locations: Iterable[EffectLocation], inner: Hypothesis | None = None
    ) -> Float[np.ndarray, " C"]:
        """Root mean square error of short free runs with some effects on.

        Args:
            h: Gives the parameters.
            locations: Effects that are on.
            inner: Hypothesis fitted to free runs over these windows, which gives first values of states that
                no sensor measures; if None, `h` gives them.
        """
        s, on, first = self.problem.supermodel, tuple(locations), self.short_runs.windows.first_states
        x0 = embed_initial_state(s, on, first)
        known = (inner or h).initial_state_for(s, on)
        size, same = first.shape[-1], known.shape[1]
        x0[:, :same, size:] = known[..., size:]
        start = ParameterSet(h.values(s), x0, s.gates(on), h.K)
        runs = self.short_runs.outputs(start, self.problem.directions_of(h))
        return self.window_rmse([runs[i] for i in self.counted])

    def window_rmse(self, runs: Sequence[Float[np.ndarray, "_ C"]]) -> Float[np.ndarray, " C"]:
        """Root mean square error of short free runs over the recordings that count, without first samples.

        It is infinite where runs diverge.
        """
        dataset = self.problem.dataset
        recordings = [dataset.recordings[i] for i in self.counted]
        measured = [np.asarray(dataset.data.y[i])[: dataset.recordings[i].N] for i in self.counted]
        rmse = windowed_rmse(recordings, measured, runs, self.window_seconds)
        return np.nan_to_num(rmse, nan=np.inf, posinf=np.inf)


class Fold(NamedTuple):
    """One recording that validates hypotheses fitted to the others."""

    train: LikelihoodProblem
    validation: ValidationSet


def _cross_validated(
    validation: ValidationSet,
    h: Hypothesis,
    near: ValidatedHypothesis | None,
    inner: Hypothesis | None,
) -> ValidatedHypothesis:
    """A hypothesis fitted without each recording in turn, and evaluated on the one that was left out."""
    fits, found = [], []
    for fold in validation.folds:
        start = fold.train.with_likelihood(h)
        fitted = refit(fold.train, [start], alternations=1)[0]
        # This fit does not know the calibrations of the recording that is left out: it gets their mean.
        k, own = len(fits), fitted.local_z.copy()
        rest = dataclasses.replace(
            fitted, local_z=np.delete(own, k, axis=0), x0=np.delete(fitted.x0, k, axis=0)
        )
        own[k] = rest.mean_local_z(fold.train.supermodel)
        fits.append(dataclasses.replace(fitted, local_z=own))
        found.append(validate(fold.validation, fits[-1], near, inner))
    own = np.array([v.adapted.local_z[k] for k, v in enumerate(found)])
    local_z = np.hstack([np.array([f.z[list(h.free)] for f in fits]), own])
    adapted = dataclasses.replace(
        h,
        free=(),
        local=(*h.free, *h.local),
        local_z=local_z,
        x0=np.array([v.adapted.x0[k] for k, v in enumerate(found)]),
        K=np.array([v.adapted.K[k] for k, v in enumerate(found)]),
    )
    # Errors of all recordings together, in which each sample has the same weight.
    scored = [counted(r, validation.window_seconds).sum() for r in validation.problem.dataset.recordings]
    rmse = np.sqrt(np.average([v.window_rmse**2 for v in found], axis=0, weights=scored))
    blocks = np.concatenate([v.blocks for v in found])
    return ValidatedHypothesis(h, blocks, adapted, rmse, folds=tuple(fits))


class _OwnStep(NamedTuple):
    """How far a fit has moved the local parameters and first states of one recording."""

    recording: int
    step: Float[np.ndarray, " O"]


def carried_over(problem: LikelihoodProblem, h: Hypothesis) -> Hypothesis:
    """A trained hypothesis on other recordings, with measured first states and the mean calibrations.

    Friction that differs between runs has the size of the run, or the mean for a run that was not trained.
    """
    first = problem.windows.first_states
    local_z = np.tile(h.mean_local_z(problem.supermodel), (len(first), 1))
    sizes = [h.local.index(i) for i in h.sizes]
    for own, k in zip(local_z, problem.trained or (None,) * len(first), strict=True):
        if k is not None:
            own[sizes] = h.local_z[k, sizes]
    start = dataclasses.replace(
        h,
        x0=embed_initial_state(problem.supermodel, h.locations, first),
        local_z=local_z,
        K=np.zeros((len(first), *h.K.shape[1:])),
        densities=np.array(-np.inf),
    )
    return problem.with_process_noise(start, h.process_noise)


def validate(
    validation: ValidationSet,
    h: Hypothesis,
    near: ValidatedHypothesis | None = None,
    inner: Hypothesis | None = None,
) -> ValidatedHypothesis:
    """Evaluate a trained hypothesis on validation recordings: log-likelihood in blocks, short free runs.

    Physics and process noise keep their trained values. First state and calibrations, which belong to one
    recording, are fitted to it by least squares. So is friction that differs between runs, if no recording of
    the run was trained. The covariance of the innovations is estimated on the validation recordings too.
    Where no model is complete, the covariance of the training recordings measures how flexible a model is: a
    richer model has a smaller one, and would be penalised for it on other recordings, however well it
    predicts them.

    Args:
        validation: The validation recordings.
        h: Trained hypothesis.
        near: Another validated hypothesis, whose first states may be better to start from: where the sensors
            do not determine a state, different first guesses end in different minima.
        inner: Hypothesis fitted to free runs over the same recordings; see `ValidationSet.short_run_errors`.
    """
    if validation.folds:
        return _cross_validated(validation, h, near, inner)
    problem = validation.problem
    current = carried_over(problem, h)
    starts = [current]
    if near is not None:
        x0 = near.adapted.initial_state_for(problem.supermodel, h.locations)
        starts.append(dataclasses.replace(current, x0=x0))
    tried = problem.innovations(starts)
    best = int(np.argmin(_costs(h, tried, problem.seen)))
    current, e = starts[best], tried[best]
    if not np.all(np.isfinite(e)):
        lost = np.full_like(in_blocks(problem.seen, problem.dataset.data), DIVERGED)
        return ValidatedHypothesis(h, lost, current, np.full(e.shape[-1], np.inf))
    current = adapted_to_recordings(problem, current, friction=True)
    blocks = problem.with_likelihood(current).blocks
    errors = validation.short_run_errors(current, h.locations, inner)
    return ValidatedHypothesis(h, blocks, current, errors)


def adapted_to_recordings(
    problem: LikelihoodProblem,
    h: Hypothesis,
    prior: Float[np.ndarray, " R"] | None = None,
    friction: bool = False,
) -> Hypothesis:
    """The hypothesis with first states and calibrations fitted to each recording, and friction if asked for.

    The recordings are independent problems, but one call of the predictor evaluates all of them.

    Args:
        problem: Likelihood of the recordings.
        h: Hypothesis from which the fit starts.
        prior: Weight, for each recording, of the sum of squares of its calibrations in unconstrained
            coordinates, where the unit is their usual size; zero if None.
        friction: Whether friction that differs between runs is fitted too, to validation recordings of runs
            that were not trained. The prior does not concern it. Where training recordings validate each
            other, it is never fitted.
    """
    seen, first = problem.seen, len(h.free)
    weight = np.zeros(len(h.x0)) if prior is None else prior
    coordinates = FitCoordinates(0, len(h.local), h.x0.shape[-1], problem.windows)
    own = [coordinates.of_recording(r) for r in range(len(h.x0))]
    sizes = [h.local.index(i) for i in h.sizes]
    offsets = [k for k in range(len(h.local)) if k not in sizes]
    with_friction = problem.of_other_runs if friction else []

    def joined(points: list[_OwnStep]) -> Hypothesis:
        step = np.zeros(coordinates.size)
        for p in points:
            step[own[p.recording]] = p.step
        return coordinates.moved(h, step)

    def linearise(points: list[_OwnStep]) -> list[NormalEquations]:
        here = joined(points)

        def whitened(_: int, e: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            w = h.whitener(e, seen)
            return w, *coordinates.sums(w, h.whitener(J[first : h.moved], seen))

        w, H, g = problem.of_slopes(whitened, [here])[0]
        equations = []
        for p in points:
            r, row = p.recording, own[p.recording]
            gradient, curvature = g[row], H[np.ix_(row, row)]
            gradient[offsets] += weight[r] * here.local_z[r, offsets]
            curvature[offsets, offsets] += weight[r]
            if r not in with_friction:
                gradient[sizes], curvature[sizes], curvature[:, sizes] = 0.0, 0.0, 0.0
                curvature[sizes, sizes] = 1.0
            cost = 0.5 * float(np.sum(w[r] ** 2) + weight[r] * np.sum(here.local_z[r, offsets] ** 2))
            equations.append(NormalEquations(np.array([cost]), gradient, curvature))
        return equations

    found = minimise_together(
        linearise,
        [_OwnStep(r, np.zeros(len(row))) for r, row in enumerate(own)],
        ADAPTATION_RULES,
        move=lambda p, step: p._replace(step=p.step + step),
        max_steps=MAX_ADAPTATION_STEPS,
    )
    return joined([m.x for m in found])


def _costs(h: Hypothesis, innovations: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Half the squared size of each row of innovations (H, R, N, C); infinite where a run diverges."""
    return np.nan_to_num(0.5 * np.sum(h.whitener(innovations, seen) ** 2, axis=(1, 2, 3)), nan=np.inf)


@dataclasses.dataclass(frozen=True)
class SearchHorizon:
    """Training and validation recordings at one horizon.

    Attributes:
        problem: The likelihood of the training recordings.
        validation: The validation recordings.
    """

    problem: LikelihoodProblem
    validation: ValidationSet

    def with_solver(self, solver: Solver) -> "SearchHorizon":
        """The same recordings with another integration rule."""
        return SearchHorizon(self.problem.with_solver(solver), self.validation.with_solver(solver))


@dataclasses.dataclass(frozen=True)
class Horizons:
    """Both horizons; windows are data of the compiled programs, so the same programs serve both.

    Attributes:
        prediction: Prediction of each sample from the samples before it, with the likeliest process noise.
        free_run: Simulation from the voltage alone, started again every few seconds.
    """

    prediction: SearchHorizon
    free_run: SearchHorizon

    @classmethod
    def of(
        cls, model: Model, train: LikelihoodProblem, validation: LikelihoodProblem | None, seconds: float
    ) -> "Horizons":
        """Both horizons, from the likelihoods of predictions.

        Args:
            model: The user's model.
            train: Likelihood of predictions of the training recordings.
            validation: Likelihood of predictions of the validation recordings; if None, each training
                recording validates what was fitted to the others.
            seconds: Length of a free run [s].
        """
        problems = (train, *([validation] if validation else []))
        recordings = [r for p in problems for r in p.dataset.recordings]
        number = max(len(window_starts(r, seconds)[0]) for r in recordings)
        whole = [dataclasses.replace(p, windows=Windows.whole(p.dataset).filled_up(number)) for p in problems]
        cut = [
            p.of_free_runs(Windows.of_seconds(model, p.dataset, seconds).filled_up(number)) for p in problems
        ]
        if validation is None:
            sets = [ValidationSet.leave_one_out(p[0], seconds) for p in (whole, cut)]
        else:
            sets = [ValidationSet(p[1], seconds) for p in (whole, cut)]
        return cls(SearchHorizon(whole[0], sets[0]), SearchHorizon(cut[0], sets[1]))

    def with_solver(self, solver: Solver) -> "Horizons":
        """Both horizons with another integration rule."""
        return Horizons(self.prediction.with_solver(solver), self.free_run.with_solver(solver))

    def validated(
        self, prediction: Hypothesis, free_run: Hypothesis, near: ValidatedHypothesis | None = None
    ) -> ValidatedHypothesis:
        """One structure, fitted at both horizons, evaluated on validation data.

        Args:
            prediction: The structure fitted to predictions.
            free_run: The structure fitted to free runs.
            near: Another validated structure; see `validate`.
        """
        runs = validate(self.free_run.validation, free_run, near.free_run if near else None)
        found = validate(self.prediction.validation, prediction, near, runs.adapted)
        return dataclasses.replace(found, free_run=runs)

    def all_validated(
        self, fits: Sequence[tuple[Hypothesis, Hypothesis]], near: ValidatedHypothesis | None = None
    ) -> list[ValidatedHypothesis]:
        """Several structures validated in parallel, each with its fits to predictions and to free runs."""
        return on_threads(lambda fit: self.validated(fit[0], fit[1], near), fits)


def as_free_run(problem: LikelihoodProblem, h: Hypothesis) -> Hypothesis:
    """A hypothesis of free runs from measured first states with the parameters of one fitted to predictions.

    Args:
        problem: Likelihood of free runs over the same recordings.
        h: Hypothesis fitted to predictions; nothing is fitted again.
    """
    x0 = embed_initial_state(problem.supermodel, h.locations, problem.windows.first_states)
    no_noise = dict.fromkeys(problem.ports, 0.0)
    start = problem.with_process_noise(dataclasses.replace(h, x0=x0), no_noise)
    return problem.with_likelihood(start)


def as_prediction(problem: LikelihoodProblem, h: Hypothesis, like: Hypothesis) -> Hypothesis:
    """A hypothesis of predictions with the least process noise and the parameters of another one.

    Args:
        problem: Likelihood of predictions of the same recordings.
        h: Gives the parameters, such as those fitted to free runs; nothing is fitted again.
        like: The same structure fitted to predictions, which gives the first states.
    """
    least = dict.fromkeys(problem.ports, problem.process_noise_range[0])
    start = dataclasses.replace(like, z=h.z, local_z=h.local_z)
    return problem.with_likelihood(problem.with_process_noise(start, least))
