"""Hypotheses on validation data: likelihood in blocks, errors of short free runs, and what is reported."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.hypothesis import Hypothesis, embed_initial_state
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.result import Stage
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.whitening import log_likelihood
from rotflex_jax.fit import inference
from rotflex_jax.fit.dataset import StackedRecordings
from rotflex_jax.fit.inference import Combination, RecordingSlopes, curvature, sandwich
from rotflex_jax.mechanism import Solver
from rotflex_jax.metrics import windowed_rmse
from rotflex_jax.models.model import Model
from rotflex_jax.optimise.damped_least_squares import NormalEquations, Rules, minimise_together
from rotflex_jax.parameters import Estimate

# Log-likelihoods are compared block by block, so that their scatter shows what is chance.
BLOCK_SECONDS = 0.5
# Log-likelihood per block [nat] of a model that diverges: finite, so that it can be compared.
DIVERGED_NATS = -1e9
# Of the fit of first states and calibrations. Most steps are nearly linear, so the damping is small from the
# start, but not nothing: recordings need not determine every state.
ADAPTATION_RULES = Rules(enough=0.05, damping=1e-6, least=1e-6, increase=30)
MAX_ADAPTATION_STEPS = 20


@dataclasses.dataclass(frozen=True)
class ValidatedHypothesis:
    """A fitted hypothesis on validation data.

    Attributes:
        hypothesis: Fitted to the training recordings.
        blocks: Log-likelihood of each half second of the validation recordings [nat].
        adapted: The same physics, with first states and calibrations of the validation recordings.
        window_rmse: Error of short free runs of each channel.
        location: What it adds to the hypothesis it is compared with.
        parameter_count: How many parameters that takes.
    """

    hypothesis: Hypothesis
    blocks: Float[np.ndarray, " B"]
    adapted: Hypothesis
    window_rmse: Float[np.ndarray, " C"]
    location: EffectLocation | None = None
    parameter_count: int = 0

    @property
    def with_trained_calibrations(self) -> Hypothesis:
        """The hypothesis on the validation recordings with calibrations as trained, not as adapted."""
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
    """

    problem: LikelihoodProblem
    window_seconds: float

    def model_of(self, h: Hypothesis, locations: Iterable[EffectLocation], recording: int) -> Model:
        """A model of one recording, with these effects on; all share the super-model's compiled code."""
        s = self.problem.supermodel
        gates = s.gates(locations)
        reduced = s.active(gates)
        mechanism = reduced.mechanism.with_values(h.values(s)[recording, reduced.parameters])
        return Model(mechanism, self.problem.predictor.solver, tuple(gates[list(reduced.effects)]))

    def short_run_errors(self, h: Hypothesis, locations: Iterable[EffectLocation]) -> Float[np.ndarray, " C"]:
        """Root mean square error of short free runs with these effects on."""
        on, recordings = tuple(locations), enumerate(self.problem.dataset.recordings)
        runs = [self.model_of(h, on, i).simulate_windows(r, self.window_seconds) for i, r in recordings]
        return self.window_rmse(runs)

    def window_rmse(self, runs: Sequence[Float[np.ndarray, "_ C"]]) -> Float[np.ndarray, " C"]:
        """Root mean square error of short free runs, their first samples not counted."""
        dataset = self.problem.dataset
        measured = [np.asarray(y)[: r.N] for y, r in zip(dataset.data.y, dataset.recordings, strict=True)]
        return windowed_rmse(dataset.recordings, measured, runs, self.window_seconds)


class _OwnCoordinates(NamedTuple):
    """Unconstrained values of what belongs to one recording alone: local parameters, then first states."""

    recording: int
    x: Float[np.ndarray, " d"]


def validate(
    validation: ValidationSet, h: Hypothesis, near: ValidatedHypothesis | None = None
) -> ValidatedHypothesis:
    """Log-likelihood of validation recordings under a trained hypothesis, in blocks.

    Physics and process noise are the trained ones. What belongs to one recording alone (first state,
    calibrations) is fitted to it, by least squares with secant slopes. So is the size of the innovations:
    where no model is complete, their size in training measures how flexible a model is, and a richer model
    would be penalised elsewhere for its smaller size, however well it predicts there.

    Args:
        validation: The validation recordings.
        h: Trained hypothesis.
        near: Another validated hypothesis, whose first states may be better to start from: where the sensors
            do not determine a state, different first guesses end in different minima.
    """
    problem, first = validation.problem, validation.problem.dataset.first_states
    s, data, R = problem.supermodel, problem.dataset.data, len(first)
    current = dataclasses.replace(
        h,
        x0=embed_initial_state(s, h.locations, first),
        local_z=np.tile(h.local_z.mean(axis=0), (R, 1)),
        K=np.zeros((R, *h.K.shape[1:])),
        densities=np.array(-np.inf),
    )
    current = problem.with_process_noise(current, h.process_noise)
    starts = [current]
    if near is not None:
        starts.append(dataclasses.replace(current, x0=near.adapted.initial_state_for(s, h.locations)))
    tried = problem.innovations(starts)
    best = int(np.argmin(_costs(h, tried, problem.seen)))
    current, e = starts[best], tried[best]
    if not np.all(np.isfinite(e)):
        lost = np.full_like(in_blocks(problem.seen, data), DIVERGED_NATS)
        return ValidatedHypothesis(h, lost, current, np.full(e.shape[-1], np.inf))
    current = _adapted(problem, current)
    e = problem.innovations([current])[0]
    blocks = in_blocks(problem.evaluated(current, e).densities, data)
    return ValidatedHypothesis(h, blocks, current, validation.short_run_errors(current, h.locations))


def _adapted(problem: LikelihoodProblem, h: Hypothesis) -> Hypothesis:
    """The hypothesis with what belongs to each recording alone fitted to it.

    The recordings are independent problems, which share each run.
    """
    seen, nudge, local = problem.seen, 1e-6, len(h.local)

    def own(w: np.ndarray, point: _OwnCoordinates) -> np.ndarray:
        return w[..., point.recording, :, :].reshape(*w.shape[:-3], -1)

    def joined(points: list[_OwnCoordinates]) -> Hypothesis:
        out = dataclasses.replace(h, local_z=h.local_z.copy(), x0=h.x0.copy())
        for r, x in points:
            out.local_z[r], out.x0[r] = x[:local], x[local:]
        return out

    def linearise(points: list[_OwnCoordinates]) -> list[NormalEquations]:
        here = joined(points)
        whitened = h.whitener(problem.innovations([here, *_perturbed(here, nudge)]), seen)
        w, slopes = whitened[0], (whitened[1:] - whitened[0]) / nudge
        return [NormalEquations.of(own(slopes, p).T, own(w, p)) for p in points]

    def costs(points: list[_OwnCoordinates]) -> list[float]:
        w = h.whitener(problem.innovations([joined(points)])[0], seen)
        return [0.5 * float(np.sum(own(w, p) ** 2)) for p in points]

    starts = [_OwnCoordinates(r, x) for r, x in enumerate(np.hstack([h.local_z, h.x0]))]
    found = minimise_together(
        linearise,
        starts,
        ADAPTATION_RULES,
        costs=costs,
        move=lambda p, step: p._replace(x=p.x + step),
        max_steps=MAX_ADAPTATION_STEPS,
    )
    return joined([m.x for m in found])


def _costs(h: Hypothesis, innovations: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Half the squared size of each row of innovations (H, R, N, C); infinite where a run diverges."""
    return np.nan_to_num(0.5 * np.sum(h.whitener(innovations, seen) ** 2, axis=(1, 2, 3)), nan=np.inf)


def _perturbed(h: Hypothesis, nudge: float) -> list[Hypothesis]:
    """The hypothesis with each local parameter and each first state moved a little in every recording."""
    out = []
    for k in range(len(h.local)):
        local_z = h.local_z.copy()
        local_z[:, k] += nudge
        out.append(dataclasses.replace(h, local_z=local_z))
    for k in range(h.x0.shape[1]):
        x0 = h.x0.copy()
        x0[:, k] += nudge
        out.append(dataclasses.replace(h, x0=x0))
    return out


def in_blocks(density: Float[np.ndarray, "R N"], data: StackedRecordings) -> Float[np.ndarray, " B"]:
    """Sums over blocks; the last, shorter block of each recording joins its neighbour."""
    out = []
    for row, seen, Ts in zip(density, data.seen, data.Ts, strict=True):
        N = int(seen.sum())
        width = max(round(BLOCK_SECONDS / float(Ts)), 1)
        edges = np.arange(0, max(N - width, 0) + 1, width)
        out.append(np.add.reduceat(row[:N], edges))
    return np.concatenate(out)


def evaluate(
    problem: LikelihoodProblem,
    validation: ValidationSet,
    solver: Solver,
    validated: ValidatedHypothesis,
    locations: Sequence[EffectLocation],
) -> Stage:
    """What is reported of a hypothesis: estimates with intervals, its free runs and their errors.

    Args:
        problem: With the training recordings.
        validation: The validation recordings.
        solver: Of the model that a user gets.
        validated: The hypothesis with its validation likelihood.
        locations: What the stage's model has; calibrations that belong to the training recordings alone
            are in the hypothesis, but not here.
    """
    h, s, seconds = validated.hypothesis, problem.supermodel, validation.window_seconds
    recordings, trained = validation.problem.dataset.recordings, validated.with_trained_calibrations
    models = [validation.model_of(trained, locations, i) for i in range(len(recordings))]
    pairs = list(zip(models, recordings, strict=True))
    simulated = tuple(m.simulate(r) for m, r in pairs)
    windowed = tuple(m.simulate_windows(r, seconds) for m, r in pairs)
    channels = s.baseline.channels
    errors = [y_hat - m.measured(r) for y_hat, (m, r) in zip(simulated, pairs, strict=True)]
    whole = np.concatenate([e[r.n_init :] for e, r in zip(errors, recordings, strict=True)])
    return Stage(
        model=Model(s.clean(h.mean_values(s), locations), solver),
        estimates=estimates(problem, h),
        held_out_rmse=dict(zip(channels, np.sqrt(np.mean(whole**2, axis=0)).tolist(), strict=True)),
        held_out_rmse_windows=dict(zip(channels, validation.window_rmse(windowed).tolist(), strict=True)),
        simulated=simulated,
        windowed=windowed,
        window_seconds=seconds,
        process_noise=h.process_noise,
        process_noise_nats=_process_noise_gain(problem, h),
        log_likelihood=validated.log_likelihood,
    )


def _process_noise_gain(problem: LikelihoodProblem, h: Hypothesis) -> float:
    """Log-likelihood that process torques gain over a free run with the same parameters [nat]."""
    free_run = problem.with_process_noise(h, dict.fromkeys(problem.ports, problem.process_noise_range[0]))
    e = problem.innovations([h, free_run])
    with_noise, without = (log_likelihood(x, problem.seen, problem.noise, 0) for x in e)
    return with_noise - without


def estimates(problem: LikelihoodProblem, h: Hypothesis) -> tuple[Estimate, ...]:
    """Parameters of the baseline and of what was added, intervals robust to correlated residuals."""
    s, seen = problem.supermodel, problem.seen
    e, J = problem.slopes([h])
    w = h.whitener(e[0], seen)
    W = h.whitener(J[0, : h.moved], seen)
    R, shared, each = len(h.x0), len(h.free), h.moved - len(h.free)
    parts = []
    for r in range(R):
        inside, own = seen[r] > 0, shared + r * each + np.arange(each)
        slopes = np.moveaxis(W[:, r], 0, -1)[inside]
        parts.append(RecordingSlopes(slopes, w[r][inside], np.concatenate([np.arange(shared), own])))
    covariance = sandwich(parts, curvature(parts, shared + R * each))
    values, derivative = h.physical(s)
    clean = s.clean(values.mean(axis=0), h.locations)
    indices = [s.mechanism.parameter_names.index(name) for name in clean.parameter_names]

    def combination(i: int) -> Combination | None:
        if i in h.free:
            return Combination([h.free.index(i)], derivative[:1, i])
        if i in h.local:
            return Combination(
                (shared + each * np.arange(R) + h.local.index(i)).tolist(), derivative[:, i] / R
            )
        return None

    def note(i: int) -> str:
        differs = i in h.local and R > 1
        return "mean of " + ", ".join(f"{v:.3g}" for v in values[:, i]) if differs else ""

    return inference.estimates(
        clean.parameter_names,
        values.mean(axis=0)[indices],
        clean.parameter_specifications,
        [combination(i) for i in indices],
        covariance,
        [note(i) for i in indices],
    )


def own_estimates(stage: Stage, location: EffectLocation) -> dict[str, Estimate]:
    """Estimates of one effect of a stage, by short name."""
    head = f"{location.port}.{location.effect}."
    return {e.name.removeprefix(head): e for e in stage.estimates if e.name.startswith(head)}
