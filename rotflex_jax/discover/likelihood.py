"""The likelihood of recordings under a hypothesis, and the refits that maximise it.

A search uses two horizons. A one-step prediction uses every sample. But where another part of the model is
wrong, its state follows the data within a few samples, and slow effects are no longer visible. A free run
over a few seconds shows slow effects. It is a predictor with gain zero that starts again at each window. Its
errors are correlated from sample to sample, although its likelihood assumes independent errors. So the
significance of its gains follows from their scatter between blocks of time.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from rotflex_jax.discover.batched_predictor import BatchedPredictor, Directions, ParameterSet, Used
from rotflex_jax.discover.hypothesis import Hypothesis, Whitener, fit_whitener
from rotflex_jax.discover.supermodel import SuperModel
from rotflex_jax.fit.coordinates import FitCoordinates
from rotflex_jax.fit.dataset import Dataset, StackedRecordings, Windows, torque_scale
from rotflex_jax.mechanism import Solver, kalman_gains
from rotflex_jax.mechanism.assembly import Layout
from rotflex_jax.optimise.damped_least_squares import NormalEquations, Rules, minimise, step_limits
from rotflex_jax.recording.recording import of_one_run
from rotflex_jax.runtime.persistent_jit import make_ahead
from rotflex_jax.runtime.xla import on_threads

# Length of the blocks by which hypotheses are compared [s]. The scatter of the blocks shows what is chance.
BLOCK_SECONDS = 0.5
# Value of a block where a model diverges; finite, so that blocks can be compared.
DIVERGED = -1e9
# A run diverges if its errors exceed this many times the noise of a sensor.
LARGEST_ERROR = 1e6
# Least and largest process noise that is tried, as shares of the intensity of a random torque that is as
# large as the motor's torque and drawn again at each sample.
MIN_PROCESS_NOISE_SHARE, MAX_PROCESS_NOISE_SHARE = 1e-9, 1e-3


@dataclasses.dataclass(frozen=True)
class LikelihoodProblem:
    """Log-likelihood of a dataset as a function of hypotheses; one for training, one for validation.

    Attributes:
        predictor: Runs hypotheses on the dataset.
        dataset: The recordings, with the sensor noise and the torque scale.
        ports: Ports at which process noise acts.
        windows: Windows at whose beginnings runs start again.
        free_run: Whether runs are free runs, in which no measurement corrects the state.
        trained: For each recording, the index of the training recording of the same run, or None; empty for
            training recordings.
    """

    predictor: BatchedPredictor
    dataset: Dataset
    ports: tuple[str, ...]
    windows: Windows
    free_run: bool = False
    trained: tuple[int | None, ...] = ()

    @classmethod
    def of(
        cls,
        supermodel: SuperModel,
        solver: Solver,
        dataset: Dataset,
        ports: tuple[str, ...],
        trained: tuple[int | None, ...] = (),
    ) -> "LikelihoodProblem":
        """The one-step prediction of a dataset by a super-model."""
        predictor = BatchedPredictor(supermodel, solver, dataset.data, dataset.constants)
        return cls(predictor, dataset, ports, Windows.whole(dataset), trained=trained)

    def with_solver(self, solver: Solver) -> "LikelihoodProblem":
        """The same likelihood with another integration rule."""
        predictor = self.predictor
        other = BatchedPredictor(predictor.supermodel, solver, predictor.data, predictor.constants)
        return dataclasses.replace(self, predictor=other)

    def of_free_runs(self, windows: Windows) -> "LikelihoodProblem":
        """The likelihood of free runs over windows, with the same compiled programs."""
        return dataclasses.replace(self, windows=windows, free_run=True)

    def first_seconds(self, seconds: float) -> "LikelihoodProblem":
        """The same likelihood of only the first seconds of each recording."""
        data = self.dataset.data
        return self.counting(np.arange(data.seen.shape[1]) * data.Ts[:, None] < seconds)

    def of_recordings(self, chosen: Sequence[int]) -> "LikelihoodProblem":
        """The same likelihood of only some recordings; arrays keep their shapes, for compiled code."""
        return self.counting(np.isin(np.arange(len(self.seen)), chosen)[:, None])

    def counting(self, samples: Bool[np.ndarray, "R #N"]) -> "LikelihoodProblem":
        """The same likelihood of only some samples."""
        data = self.dataset.data
        data = data._replace(seen=data.seen * samples)
        return self.of_dataset(dataclasses.replace(self.dataset, data=data))

    def of_dataset(self, dataset: Dataset) -> "LikelihoodProblem":
        """The same likelihood of other data of the same shape, with the same windows and programs."""
        predictor = dataclasses.replace(self.predictor, data=dataset.data)
        return dataclasses.replace(self, predictor=predictor, dataset=dataset)

    @property
    def supermodel(self) -> SuperModel:
        """Baseline, calibrations and candidates."""
        return self.predictor.supermodel

    @property
    def seen(self) -> Float[np.ndarray, "R N"]:
        """One where a sample counts."""
        return self.dataset.data.seen

    @property
    def noise(self) -> Float[np.ndarray, " C"]:
        """Standard deviation of the sensor noise of each channel."""
        return self.dataset.noise

    @property
    def measured_values(self) -> float:
        """Number of measured values that count."""
        return float(np.sum(self.seen)) * self.dataset.data.y.shape[-1]

    @functools.cached_property
    def several_runs(self) -> bool:
        """Whether the recordings are of more than one run."""
        first, *others = self.dataset.recordings
        return not all(of_one_run(first, other) for other in others)

    @property
    def of_other_runs(self) -> list[int]:
        """Indices of the validation recordings of runs that were not trained; none of other recordings."""
        return [k for k, trained in enumerate(self.trained) if trained is None]

    @property
    def block_counts(self) -> list[int]:
        """Number of blocks of each recording."""
        return [len(sums) for sums in _in_blocks_of_each(self.seen, self.dataset.data)]

    @property
    def direction_count(self) -> int:
        """Usual number of directions of slopes, enough for the baseline with a few effects."""
        s = self.supermodel
        count = len(s.baseline_free) + len(s.local) + 2 * len(s.baseline.coordinates) + 4
        return _multiple_of_four(count)

    def directions_of(self, h: Hypothesis) -> int:
        """Number of directions of slopes that is used for a hypothesis."""
        return max(self.direction_count, _multiple_of_four(h.moved))

    def step_limits(self, h: Hypothesis) -> Float[np.ndarray, " P"]:
        """Largest step of each common parameter of a hypothesis, followed by each local one."""
        z = np.concatenate([h.z[list(h.free)], np.abs(h.local_z).max(axis=0)])
        return step_limits(self.supermodel.transform.bounded[[*h.free, *h.local]], z)

    @property
    def process_noise_range(self) -> tuple[float, float]:
        """Least and largest intensity of process noise that is tried [(N m)^2 s].

        With the least, the predictor is practically a free run. With the largest, its memory is still long
        compared with the sampling period: a predictor that forgets within a few samples follows any motion,
        and its likelihood no longer distinguishes one model from another.
        """
        unit = self._intensity(self.dataset.torque_scale)
        return MIN_PROCESS_NOISE_SHARE * unit, MAX_PROCESS_NOISE_SHARE * unit

    def least_process_noise(self, h: Hypothesis) -> float:
        """Least intensity of process noise, from the motor torque of a hypothesis [(N m)^2 s].

        `process_noise_range` uses the motor torque of the user's model instead.
        """
        s = self.supermodel
        motor = torque_scale(s.clean(h.mean_values(s), ()), self.dataset.data)
        return MIN_PROCESS_NOISE_SHARE * self._intensity(motor)

    def _intensity(self, torque: float) -> float:
        """Intensity of a random torque of this size that is drawn again at each sample [(N m)^2 s]."""
        return torque**2 * float(self.dataset.data.Ts[0])

    def with_process_noise(self, h: Hypothesis, intensity: dict[str, float]) -> Hypothesis:
        """The hypothesis with another process noise and its gains."""
        return dataclasses.replace(h, K=self.gains(h, [intensity])[0], process_noise=intensity)

    def gains(
        self, h: Hypothesis, intensities: Sequence[dict[str, float]]
    ) -> list[Float[np.ndarray, "R n C"]]:
        """Kalman gains of the baseline's linear part for each recording, one array per intensity."""
        s, periods, found = self.supermodel, np.asarray(self.dataset.data.Ts).tolist(), {}
        if self.free_run:
            shape = (len(periods), Layout.of(s.mechanism.structure).size, len(self.noise))
            return [np.zeros(shape) for _ in intensities]
        mechanism = s.clean(h.values(s).mean(axis=0), ())
        rows = list(zip(periods, self.dataset.constants, strict=True))
        keys = [(Ts, known.tobytes()) for Ts, known in rows]
        for key, (Ts, known) in zip(keys, rows, strict=True):
            if key not in found:
                # Parameters of a learned map come last; they are never constants of a recording.
                values = mechanism.values.copy()
                values[: len(known)] = np.where(np.isnan(known), values[: len(known)], known)
                here = mechanism.with_values(values)
                found[key] = kalman_gains(here, intensities, self.noise, Ts)
        K = np.stack([found[key] for key in keys], axis=1)
        full = np.zeros((*K.shape[:2], Layout.of(s.mechanism.structure).size, K.shape[3]))
        full[:, :, s.baseline_states] = K
        return list(full)

    def innovations(self, hypotheses: Sequence[Hypothesis]) -> Float[np.ndarray, "H R N C"]:
        """Innovations of hypotheses."""
        return self.innovations_of([h.parameter_set(self.supermodel) for h in hypotheses])

    def innovations_of(self, parameter_sets: list[ParameterSet]) -> Float[np.ndarray, "L R N C"]:
        """Innovations of parameter sets."""
        return self.predictor.innovations(parameter_sets, self.windows.index)

    def channel_errors(self, h: Hypothesis) -> Float[np.ndarray, " C"]:
        """Root mean square innovation of each channel, in its unit."""
        e = self.innovations([h])[0][self.seen > 0]
        return np.sqrt(np.mean(e**2, axis=0))

    def make_ahead(self, hypotheses: Sequence[Hypothesis]) -> None:
        """Compile programs of innovations on another thread, for hypotheses whose slopes are needed first."""
        s = self.supermodel
        for locations, h in {frozenset(h.locations): h for h in hypotheses}.items():
            if not self.predictor.has_innovations(s.gates(locations)):
                make_ahead(self.innovations, [h])

    def slopes(
        self, hypotheses: Sequence[Hypothesis]
    ) -> tuple[Float[np.ndarray, "H R N C"], Float[np.ndarray, "H D R N C"]]:
        """Innovations of hypotheses, and their slopes along all coordinates that a fit moves.

        The number of directions is rounded up to one of a few numbers, since each number is compiled.
        """
        return self.predictor.slopes(*self._with_directions(hypotheses), self.windows.index)

    def of_slopes(
        self,
        use: Callable[[int, Float[np.ndarray, "R N C"], Float[np.ndarray, "D R N C"]], Used],
        hypotheses: Sequence[Hypothesis],
    ) -> list[Used]:
        """Results of a function of the index, innovations and slopes of each hypothesis."""
        return self.predictor.of_slopes(use, *self._with_directions(hypotheses), self.windows.index)

    def _with_directions(
        self, hypotheses: Sequence[Hypothesis]
    ) -> tuple[list[ParameterSet], list[Directions]]:
        s = self.supermodel
        directions = [h.directions(s, self.directions_of(h)) for h in hypotheses]
        return [h.parameter_set(s) for h in hypotheses], directions

    def whitener(self, e: Float[np.ndarray, "R N C"]) -> Whitener:
        """The whitener fitted to innovations; for free runs, channels count as uncorrelated."""
        return fit_whitener(e, self.seen, self.noise, channels_apart=self.free_run)

    def log_likelihood(self, e: Float[np.ndarray, "R N C"]) -> float:
        """Log-likelihood of innovations with the whitener that is fitted to them [nat].

        It is minus infinity where a run diverges.
        """
        if self._diverges(e):
            return -np.inf
        return float(np.sum(self.whitener(e).log_densities(e, self.seen)))

    def log_likelihoods(self, hypotheses: Sequence[Hypothesis]) -> Float[np.ndarray, " H"]:
        """Log-likelihoods of hypotheses as they are [nat], each with a whitener fitted to its innovations."""
        parameter_sets = [h.parameter_set(self.supermodel) for h in hypotheses]
        each = self.predictor.of_innovations
        return np.array(each(lambda _, e: self.log_likelihood(e), parameter_sets, self.windows.index))

    def likeliest(self, hypotheses: Sequence[Hypothesis]) -> Hypothesis:
        """The likeliest of some hypotheses as they are, such as starts of one fit."""
        return hypotheses[int(np.argmax(self.log_likelihoods(hypotheses)))]

    def with_likelihood(self, h: Hypothesis) -> Hypothesis:
        """The hypothesis, run once, with the whitener and the likelihood of its innovations."""
        return self.evaluated(h, self.innovations([h])[0])

    def evaluated(self, h: Hypothesis, e: Float[np.ndarray, "R N C"]) -> Hypothesis:
        """The hypothesis with the whitener, the likelihood and the blocks of given innovations."""
        if self._diverges(e):
            scale = Whitener.of_noise(self.noise)
            blocks = np.full_like(in_blocks(self.seen, self.dataset.data), DIVERGED)
            return dataclasses.replace(h, whitener=scale, densities=np.array(-np.inf), blocks=blocks)
        whitener = self.whitener(e)
        densities = whitener.log_densities(e, self.seen)
        blocks = self._error_blocks(e) if self.free_run else in_blocks(densities, self.dataset.data)
        return dataclasses.replace(h, whitener=whitener, densities=densities, blocks=blocks)

    def _diverges(self, e: np.ndarray) -> bool:
        """Whether a run is not finite, or so far off that the covariance of its errors has no inverse."""
        return not np.all(np.isfinite(e)) or bool(np.any(np.abs(e) > LARGEST_ERROR * self.noise))

    def _error_blocks(self, e: np.ndarray) -> np.ndarray:
        """Minus the logarithm of the root mean square error of each block, mean over channels.

        The variance of the sensor noise is added, so that an error below it gains nothing more. Errors of
        free runs are correlated from sample to sample, and large where the model drifts. With
        log-likelihoods, a few blocks would decide. Here the factor by which the error decreases counts, and
        all blocks have the same weight.
        """
        data = self.dataset.data
        counts = in_blocks(data.seen, data)
        channels = np.moveaxis(e, -1, 0)
        squares = np.array([in_blocks(c**2 * data.seen, data) / np.maximum(counts, 1) for c in channels])
        return -0.5 * np.mean(np.log(squares + self.noise[:, None] ** 2), axis=0)


def _multiple_of_four(count: int) -> int:
    return -(-count // 4) * 4


def block_edges(N: int, Ts: float) -> Int[np.ndarray, " B"]:
    """First sample of each block of N samples; a shorter rest at the end joins the last block."""
    width = max(round(BLOCK_SECONDS / Ts), 1)
    return np.arange(0, max(N - width, 0) + 1, width)


def in_blocks(values: Float[np.ndarray, "R N"], data: StackedRecordings) -> Float[np.ndarray, " B"]:
    """Sums over the blocks of each recording, for all recordings in one array."""
    return np.concatenate(_in_blocks_of_each(values, data))


def _in_blocks_of_each(
    values: Float[np.ndarray, "R N"], data: StackedRecordings
) -> list[Float[np.ndarray, " B"]]:
    """Sums over the blocks of each recording."""
    out = []
    for row, seen, Ts in zip(values, data.seen, data.Ts, strict=True):
        N = int(seen.sum())
        out.append(np.add.reduceat(row[:N], block_edges(N, float(Ts))) if N else np.zeros(0))
    return out


# Levenberg-Marquardt stops at this decrease of the negative log-likelihood [nat]. A relative tolerance would
# leave tens of nats on a long recording and cause false discoveries.
MIN_DECREASE_NATS = 0.3
# The damping is small from the start, since a refit starts near its optimum. Refused steps raise it quickly.
# At 100 a step is a hundredth of a scaled gradient step; a fit whose cost does not fall by such a step ends.
REFIT_RULES = Rules(enough=MIN_DECREASE_NATS, damping=1e-4, least=1e-9, increase=20, largest=100)
# Largest number of steps of a fit.
MAX_STEPS = 12
# Largest number of alternations of a refit beyond the usual number, and least gain of each of them [nat].
EXTRA_ALTERNATIONS, EXTRA_ALTERNATION_NATS = 5, 10.0


@dataclasses.dataclass
class _Point:
    """A hypothesis during its fit, with its innovations and their slopes once it was run."""

    hypothesis: Hypothesis
    innovations: Float[np.ndarray, "R N C"] | None = None
    slopes: Float[np.ndarray, "D R N C"] | None = None


def levenberg_marquardt(
    problem: LikelihoodProblem, hypotheses: Sequence[Hypothesis], max_steps: int = MAX_STEPS
) -> list[Hypothesis]:
    """Hypotheses fitted with fixed whiteners and process noise, and then evaluated with new whiteners."""
    return on_threads(lambda h: _fitted(problem, _Point(h), max_steps).hypothesis, hypotheses)


def _fitted(problem: LikelihoodProblem, start: _Point, max_steps: int = MAX_STEPS) -> _Point:
    """One hypothesis, fitted as in `levenberg_marquardt`."""
    h, seen = start.hypothesis, problem.seen
    coordinates = FitCoordinates.of(h, problem.windows)

    def linearise(point: _Point) -> NormalEquations:
        here = point.hypothesis
        if point.innovations is None or point.slopes is None:
            run = problem.of_slopes(lambda _, e, J: (e, J[: here.moved]), [here])
            ((point.innovations, point.slopes),) = run
        w = here.whitener(point.innovations, seen)
        H, g = coordinates.sums(w, here.whitener(point.slopes, seen))
        return NormalEquations(np.array([0.5 * np.sum(w**2)]), g, H)

    def cost(point: _Point) -> float:
        e = problem.innovations([point.hypothesis])[0]
        point.innovations = e
        return 0.5 * float(np.sum(point.hypothesis.whitener(e, seen) ** 2))

    # A trial computes slopes too, since most steps of predictions are accepted. Half of the steps of free
    # runs are refused, several in a row; after a refused step, a run without slopes comes first.
    found = minimise(
        linearise,
        start,
        REFIT_RULES,
        cost=cost,
        costs_after=1,
        limit=coordinates.step_limit(problem.step_limits(h)),
        move=lambda p, step: _Point(coordinates.moved(p.hypothesis, step)),
        max_steps=max_steps,
    ).x
    evaluated = problem.evaluated(found.hypothesis, found.innovations)
    return dataclasses.replace(found, hypothesis=evaluated)


def _grid(
    center: dict[str, float], factors: Sequence[float] | Float[np.ndarray, " F"]
) -> list[dict[str, float]]:
    """Intensities times factors: all combinations for up to two ports, else one port at a time."""
    ports = list(center)
    if len(ports) <= 2:
        mesh = np.stack(np.meshgrid(*[factors] * len(ports), indexing="ij"), -1).reshape(-1, len(ports))
    else:
        mesh = np.array(
            [[f if i == j else 1.0 for j in range(len(ports))] for i in range(len(ports)) for f in factors]
        )
    return [{p: center[p] * f for p, f in zip(ports, row, strict=True)} for row in mesh]


def choose_process_noise(problem: LikelihoodProblem, h: Hypothesis, wide: bool = False) -> Hypothesis:
    """The hypothesis with the likeliest process noise within `process_noise_range`, found on a grid.

    With intensity zero the predictor is a free run; with a large intensity it follows the data within a few
    samples. If the model is right, the least intensity of the grid is the likeliest. If a larger one is, the
    model lacks something.

    Args:
        problem: The likelihood; of free runs, the hypothesis is returned unchanged.
        h: The hypothesis, whose parameters stay as they are.
        wide: Whether to search the whole range first, and not only near the present intensities.
    """
    if problem.free_run:
        return h
    least, most = problem.process_noise_range
    best, tried = h, list[dict[str, float]]()

    def likeliest(trials: list[dict[str, float]]) -> Hypothesis:
        """The likeliest of the best so far and new trials; intensities that were tried are not run again."""
        new = [t for k, t in enumerate(trials) if t not in (*trials[:k], *tried)]
        if not new:
            return best
        runs = [
            dataclasses.replace(best, K=K, process_noise=intensity)
            for intensity, K in zip(new, problem.gains(best, new), strict=True)
        ]
        as_it_is = best.parameter_set(problem.supermodel)
        parameter_sets = [as_it_is._replace(K=run.K) for run in runs]
        evaluated = problem.predictor.of_innovations(
            lambda i, e: problem.evaluated(runs[i], e), parameter_sets, problem.windows.index
        )
        # Before the first trials the likelihood of the best so far is not known for this problem.
        known = [best] if tried else []
        tried.extend(new)
        return max([*known, *evaluated], key=lambda run: run.log_likelihood)

    if wide:
        best = likeliest(_grid(dict.fromkeys(problem.ports, most), np.geomspace(least, most, 4) / most))
    for factor in (10.0, 10**0.5):
        trials = _grid(best.process_noise, (1 / factor, 1.0, factor))
        best = likeliest([{p: min(max(v, least), most) for p, v in t.items()} for t in trials])
    return best


def process_noise_gain(problem: LikelihoodProblem, h: Hypothesis) -> float:
    """Log-likelihood per measured value that process noise gains over a free run [nat].

    Both have the same parameters. The free run has the least process noise, which is relative to the fitted
    torque of the motor, so the values given by the user do not matter.
    """
    least = dict.fromkeys(problem.ports, problem.least_process_noise(h))
    free_run = problem.with_process_noise(h, least)
    with_noise, without = problem.log_likelihoods([h, free_run])
    return (with_noise - without) / problem.measured_values


def refit(
    problem: LikelihoodProblem, hypotheses: Sequence[Hypothesis], wide: bool = False, alternations: int = 3
) -> list[Hypothesis]:
    """Fit parameters and process noise of each hypothesis in turn until its likelihood converges.

    Usually little is left to gain after the given number of alternations. A hypothesis that still gains much
    continues for at most `EXTRA_ALTERNATIONS`: stopped too early, the right effect may look worse than a
    wrong one that has converged.

    Args:
        problem: The likelihood.
        hypotheses: Where the fits start.
        wide: Whether the first choice of process noise searches the whole range.
        alternations: Usual number of alternations; 0 to fit the parameters alone.
    """
    if alternations and not problem.free_run:
        problem.make_ahead(hypotheses)
    return on_threads(lambda h: _refitted(problem, h, wide, alternations), hypotheses)


def _refitted(problem: LikelihoodProblem, h: Hypothesis, wide: bool, alternations: int) -> Hypothesis:
    """One hypothesis, refitted as in `refit`."""
    current = _fitted(problem, _Point(h))
    for k in range(alternations + EXTRA_ALTERNATIONS if alternations else 0):
        before = current.hypothesis
        start = choose_process_noise(problem, before, wide and k == 0)
        # Free runs have no process noise: the next fit starts from slopes that are known.
        new = _fitted(problem, current if start is before else _Point(start))
        gain = new.hypothesis.log_likelihood - before.log_likelihood
        # A new whitener may lower the likelihood a little between alternations; the better fit is kept.
        current = new if gain > 0 else current
        if gain < (1.0 if k + 1 < alternations else EXTRA_ALTERNATION_NATS):
            break
    return current.hypothesis
