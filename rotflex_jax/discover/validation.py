"""Hypotheses on validation data: likelihood in blocks, free-run errors, runs that validate each other."""

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.batched_predictor import ParameterSet
from rotflex_jax.discover.hypothesis import Hypothesis, embed_initial_state
from rotflex_jax.discover.likelihood import DIVERGED, LikelihoodProblem, in_blocks
from rotflex_jax.discover.refit import refit
from rotflex_jax.discover.short_runs import ShortRuns
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.fit.coordinates import FitCoordinates
from rotflex_jax.fit.windows import Windows
from rotflex_jax.metrics import windowed_rmse
from rotflex_jax.models.model import Model
from rotflex_jax.optimise.damped_least_squares import NormalEquations, Rules, minimise_together

# Of the fit of first states and calibrations. Most steps are nearly linear, so the damping is small from the
# start, but not nothing: recordings need not determine every state.
ADAPTATION_RULES = Rules(enough=0.05, damping=1e-6, least=1e-6, increase=30)
MAX_ADAPTATION_STEPS = 20


@dataclasses.dataclass(frozen=True)
class ValidatedHypothesis:
    """A fitted hypothesis on validation data.

    Attributes:
        hypothesis: Fitted to the training recordings.
        blocks: What each half second of the validation recordings says for it; see `Hypothesis`.
        adapted: The same physics, with first states and calibrations of the validation recordings.
        window_rmse: Error of short free runs of each channel.
        location: What it adds to the hypothesis it is compared with.
        parameter_count: How many parameters that takes.
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

    @property
    def with_trained_calibrations(self) -> Hypothesis:
        """The hypothesis on the validation recordings with calibrations as trained, not as adapted."""
        if self.folds:
            trained = [h.local_z[k] for k, h in enumerate(self.folds)]
            local_z = self.adapted.local_z.copy()
            local_z[:, len(self.hypothesis.free) :] = trained
        else:
            local_z = np.tile(self.hypothesis.local_z.mean(axis=0), (len(self.adapted.x0), 1))
        return dataclasses.replace(self.adapted, local_z=local_z)

    @property
    def log_likelihood(self) -> float:
        """Of the validation recordings [nat]."""
        return float(np.sum(self.blocks))


@dataclasses.dataclass(frozen=True)
class ValidationSet:
    """Recordings that no fit has seen, which decide between hypotheses.

    Attributes:
        problem: The likelihood of these recordings.
        window_seconds: Length of the windows of short free runs [s].
        chosen: Indices of the recordings that count; all if empty.
        folds: Where runs validate each other: for each, the others to fit and itself to validate.
    """

    problem: LikelihoodProblem
    window_seconds: float
    chosen: tuple[int, ...] = ()
    folds: "tuple[Fold, ...]" = ()

    @classmethod
    def leave_one_out(cls, problem: LikelihoodProblem, window_seconds: float) -> "ValidationSet":
        """Each training recording validates what was fitted to the others.

        Args:
            problem: The training recordings, two at least.
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

    @property
    def counted(self) -> tuple[int, ...]:
        """Indices of the recordings that count."""
        return self.chosen or tuple(range(len(self.problem.dataset.recordings)))

    def model_of(self, h: Hypothesis, locations: Iterable[EffectLocation], recording: int) -> Model:
        """A model of one recording, with these effects on; all share the super-model's compiled code."""
        s = self.problem.supermodel
        gates = s.gates(locations)
        reduced = s.active(gates)
        mechanism = reduced.mechanism.with_values(h.values(s)[recording, reduced.parameters])
        return Model(mechanism, self.problem.predictor.solver, tuple(gates[list(reduced.effects)]))

    @functools.cached_property
    def short_runs(self) -> ShortRuns:
        """Free runs over short windows."""
        p = self.problem
        windows = p.windows
        if not p.free_run:
            model = Model(p.supermodel.baseline, p.predictor.solver)
            windows = Windows.of_seconds(model, p.dataset, self.window_seconds, p.windows.number)
        return ShortRuns(p.predictor, p.dataset, windows)

    def short_run_errors(
        self, h: Hypothesis, locations: Iterable[EffectLocation], inner: Hypothesis | None = None
    ) -> Float[np.ndarray, " C"]:
        """Root mean square error of short free runs with these effects on.

        Args:
            h: Gives the parameters.
            locations: What is on.
            inner: Fitted to the free runs over these windows, gives first states that no sensor measures; `h`
                itself if None.
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
        """Root mean square error of short free runs of the recordings that count, without first samples."""
        dataset = self.problem.dataset
        recordings = [dataset.recordings[i] for i in self.counted]
        measured = [np.asarray(dataset.data.y[i])[: dataset.recordings[i].N] for i in self.counted]
        return windowed_rmse(recordings, measured, runs, self.window_seconds)


class Fold(NamedTuple):
    """One recording that validates what was fitted to the others."""

    train: LikelihoodProblem
    validation: ValidationSet


def _cross_validated(
    validation: ValidationSet,
    h: Hypothesis,
    near: ValidatedHypothesis | None,
    inner: Hypothesis | None,
) -> ValidatedHypothesis:
    """A hypothesis fitted without each recording in turn, on the one that was left out."""
    fits, found = [], []
    for fold in validation.folds:
        start = fold.train.evaluated(h, fold.train.innovations([h])[0])
        fitted = refit(fold.train, [start], alternations=1)[0]
        # What belongs to the run that is left out is not known to this fit.
        k, own = len(fits), fitted.local_z.copy()
        own[k] = np.delete(own, k, axis=0).mean(axis=0)
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
    rmse = np.sqrt(np.mean([v.window_rmse**2 for v in found], axis=0))
    blocks = np.concatenate([v.blocks for v in found])
    return ValidatedHypothesis(h, blocks, adapted, rmse, folds=tuple(fits))


class _OwnStep(NamedTuple):
    """How far what belongs to one recording alone has moved: its own parameters and first states."""

    recording: int
    step: Float[np.ndarray, " O"]


def carried_over(problem: LikelihoodProblem, h: Hypothesis) -> Hypothesis:
    """A trained hypothesis on other recordings: from measured first states, with the mean calibrations."""
    first = problem.windows.first_states
    start = dataclasses.replace(
        h,
        x0=embed_initial_state(problem.supermodel, h.locations, first),
        local_z=np.tile(h.local_z.mean(axis=0), (len(first), 1)),
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
    """Log-likelihood of validation recordings under a trained hypothesis, in blocks.

    Physics and process noise are the trained ones. What belongs to one recording alone (first state,
    calibrations) is fitted to it, by least squares. So is the size of the innovations:
    where no model is complete, their size in training measures how flexible a model is, and a richer model
    would be penalised elsewhere for its smaller size, however well it predicts there.

    Args:
        validation: The validation recordings.
        h: Trained hypothesis.
        near: Another validated hypothesis, whose first states may be better to start from: where the sensors
            do not determine a state, different first guesses end in different minima.
        inner: Fitted to free runs over the same recordings; see `ValidationSet.short_run_errors`.
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
    current = adapted_to_recordings(problem, current)
    blocks = problem.evaluated(current, problem.innovations([current])[0]).blocks
    errors = validation.short_run_errors(current, h.locations, inner)
    return ValidatedHypothesis(h, blocks, current, errors)


def adapted_to_recordings(
    problem: LikelihoodProblem, h: Hypothesis, prior: Float[np.ndarray, " R"] | None = None
) -> Hypothesis:
    """The hypothesis with what belongs to each recording alone fitted to it.

    The recordings are independent problems, which share each run.

    Args:
        problem: The recordings.
        h: Where the fit starts.
        prior: For each recording the weight of the squared unconstrained values of its local parameters,
            which are in units of their usual size; zero if None.
    """
    seen, first = problem.seen, len(h.free)
    weight = np.zeros(len(h.x0)) if prior is None else prior
    coordinates = FitCoordinates(0, len(h.local), h.x0.shape[-1], problem.windows)
    own = [coordinates.of_recording(r) for r in range(len(h.x0))]

    def joined(points: list[_OwnStep]) -> Hypothesis:
        step = np.zeros(coordinates.size)
        for p in points:
            step[own[p.recording]] = p.step
        return coordinates.moved(h, step)

    def linearise(points: list[_OwnStep]) -> list[NormalEquations]:
        here = joined(points)
        e, J = problem.slopes([here])
        w = h.whitener(e[0], seen)
        H, g = coordinates.sums(w, h.whitener(J[0, first : h.moved], seen))
        equations = []
        for p in points:
            r, row = p.recording, own[p.recording]
            gradient, curvature = g[row], H[np.ix_(row, row)]
            each = np.arange(len(h.local))
            gradient[each] += weight[r] * here.local_z[r]
            curvature[each, each] += weight[r]
            cost = 0.5 * float(np.sum(w[r] ** 2) + weight[r] * np.sum(here.local_z[r] ** 2))
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
