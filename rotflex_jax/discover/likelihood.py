"""The likelihood of recordings under a hypothesis: gains of its predictor, whitener, log-likelihood.

Two horizons have a say in a search. The one-step prediction uses every sample, but where another part of the
model is wrong its state follows the data within a few samples, and what acts slowly is no longer seen. A free
run over a few seconds shows what acts slowly. It is a predictor with no gain, which starts again at each
window; as its errors are alike from sample to sample, its likelihood is that of independent errors in name
only, and gains of it count by their scatter between blocks of time.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from rotflex_jax.discover.batched_predictor import BatchedPredictor, ParameterSet
from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.supermodel import SuperModel
from rotflex_jax.discover.whitening import Whitener, fit_whitener
from rotflex_jax.fit.dataset import Dataset, StackedRecordings
from rotflex_jax.fit.windows import Windows
from rotflex_jax.mechanism import Solver, kalman_gains
from rotflex_jax.mechanism.assembly import Layout

# Hypotheses are compared block by block, so that the scatter shows what is chance.
BLOCK_SECONDS = 0.5
# What a block says for a model that diverges: finite, so that it can be compared.
DIVERGED = -1e9
# Errors beyond so many times the noise of a sensor are those of a run that diverges.
LARGEST_ERROR = 1e6
# Least and largest process torque, as shares of the intensity that a torque as large as the motor's, drawn
# again at each sample, would have.
MIN_PROCESS_NOISE_SHARE, MAX_PROCESS_NOISE_SHARE = 1e-9, 1e-3


@dataclasses.dataclass(frozen=True)
class LikelihoodProblem:
    """Log-likelihood of a dataset as a function of hypotheses; one for training, one for validation.

    Attributes:
        predictor: Runs hypotheses on the dataset.
        dataset: The recordings, with the noise and the torque that scale the comparison.
        ports: Ports at which process torques act.
        windows: Where runs start again.
        free_run: Whether no measurement corrects the state.
    """

    predictor: BatchedPredictor
    dataset: Dataset
    ports: tuple[str, ...]
    windows: Windows
    free_run: bool = False

    @classmethod
    def of(
        cls,
        supermodel: SuperModel,
        solver: Solver,
        dataset: Dataset,
        ports: tuple[str, ...],
    ) -> "LikelihoodProblem":
        """The one-step prediction of a dataset by a super-model."""
        predictor = BatchedPredictor(supermodel, solver, dataset.data, dataset.constants)
        return cls(predictor, dataset, ports, Windows.whole(dataset))

    def of_free_runs(self, windows: Windows) -> "LikelihoodProblem":
        """The likelihood of free runs over windows, with the same compiled programs."""
        return dataclasses.replace(self, windows=windows, free_run=True)

    def first_seconds(self, seconds: float) -> "LikelihoodProblem":
        """The same with the first seconds of each recording alone; nothing after them counts."""
        data = self.dataset.data
        return self.counting(np.arange(data.u.shape[1]) * data.Ts[:, None] < seconds)

    def of_recordings(self, chosen: Sequence[int]) -> "LikelihoodProblem":
        """The same with some recordings alone; the others stay in place, for the sake of compiled code."""
        return self.counting(np.isin(np.arange(len(self.seen)), chosen)[:, None])

    def counting(self, samples: Bool[np.ndarray, "R #N"]) -> "LikelihoodProblem":
        """The same where only some samples count."""
        data = self.dataset.data
        data = data._replace(seen=data.seen * samples)
        return dataclasses.replace(
            self,
            predictor=dataclasses.replace(self.predictor, data=data),
            dataset=dataclasses.replace(self.dataset, data=data),
        )

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
        """How many values were measured."""
        return float(np.sum(self.seen)) * self.dataset.data.y.shape[-1]

    @property
    def direction_count(self) -> int:
        """Directions per pass of slopes: enough for a few effects on top of the baseline."""
        s = self.supermodel
        count = len(s.baseline_free) + len(s.local) + 2 * len(s.baseline.coordinates) + 4
        return _multiple_of_four(count)

    def directions_of(self, h: Hypothesis) -> int:
        """Directions per pass of the slopes of a hypothesis."""
        return max(self.direction_count, _multiple_of_four(h.moved))

    @property
    def process_noise_range(self) -> tuple[float, float]:
        """Least and largest intensity of process torques that is tried [(N m)^2 s].

        The least is a free run in all but name. The largest keeps the memory of the predictor long
        against the sampling period: a predictor that forgets within a few samples follows any motion
        and no longer distinguishes one model from another, whatever its likelihood.
        """
        unit = self.dataset.torque_scale**2 * float(self.dataset.data.Ts[0])
        return MIN_PROCESS_NOISE_SHARE * unit, MAX_PROCESS_NOISE_SHARE * unit

    def with_process_noise(self, h: Hypothesis, intensity: dict[str, float]) -> Hypothesis:
        """The hypothesis with the gains of another process noise."""
        return dataclasses.replace(h, K=self.gains(h, [intensity])[0], process_noise=intensity)

    def gains(
        self, h: Hypothesis, intensities: Sequence[dict[str, float]]
    ) -> list[Float[np.ndarray, "R n C"]]:
        """Gains of the baseline's linear part in each recording, one array per intensity."""
        s, periods, found = self.supermodel, np.asarray(self.dataset.data.Ts).tolist(), {}
        if self.free_run:
            shape = (len(periods), Layout.of(s.mechanism.structure).size, len(self.noise))
            return [np.zeros(shape) for _ in intensities]
        mechanism = s.clean(h.values(s).mean(axis=0), ())
        rows = list(zip(periods, self.dataset.constants, strict=True))
        keys = [(Ts, known.tobytes()) for Ts, known in rows]
        for key, (Ts, known) in zip(keys, rows, strict=True):
            if key not in found:
                # A learned map has its parameters after those that recordings may know.
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

    def slopes(
        self, hypotheses: Sequence[Hypothesis]
    ) -> tuple[Float[np.ndarray, "H R N C"], Float[np.ndarray, "H D R N C"]]:
        """Innovations and their slopes along all that a fit moves.

        Directions are filled up to the same few numbers, whatever else is fitted beside a hypothesis: each
        number is compiled once.
        """
        s = self.supermodel
        directions = [h.directions(s, self.directions_of(h)) for h in hypotheses]
        parameter_sets = [h.parameter_set(s) for h in hypotheses]
        return self.predictor.slopes(parameter_sets, directions, self.windows.index)

    def whitener(self, e: Float[np.ndarray, "R N C"]) -> Whitener:
        """The whitener that innovations give; of free runs the scale of each channel alone."""
        return fit_whitener(e, self.seen, self.noise, channels_apart=self.free_run)

    def log_likelihood(self, e: Float[np.ndarray, "R N C"]) -> float:
        """Log-likelihood of innovations under the whitener that they give [nat].

        Minus infinity where a run diverges.
        """
        if self._diverges(e):
            return -np.inf
        return float(np.sum(self.whitener(e).log_densities(e, self.seen)))

    def log_likelihoods(self, hypotheses: Sequence[Hypothesis]) -> Float[np.ndarray, " H"]:
        """Log-likelihoods of hypotheses as they are [nat], each with the whitener that it gives."""
        return np.array([self.log_likelihood(e) for e in self.innovations(hypotheses)])

    def evaluated(self, h: Hypothesis, e: Float[np.ndarray, "R N C"]) -> Hypothesis:
        """The hypothesis with the whitener and the likelihood that its innovations give."""
        if self._diverges(e):
            scale = Whitener.of_noise(self.noise)
            blocks = np.full_like(in_blocks(self.seen, self.dataset.data), DIVERGED)
            return dataclasses.replace(h, whitener=scale, densities=np.array(-np.inf), blocks=blocks)
        whitener = self.whitener(e)
        densities = whitener.log_densities(e, self.seen)
        blocks = self._error_blocks(e) if self.free_run else in_blocks(densities, self.dataset.data)
        return dataclasses.replace(h, whitener=whitener, densities=densities, blocks=blocks)

    def _diverges(self, e: np.ndarray) -> bool:
        """Whether a run is not finite, or so far off that its covariance has no inverse any more."""
        return not np.all(np.isfinite(e)) or bool(np.any(np.abs(e) > LARGEST_ERROR * self.noise))

    def _error_blocks(self, e: np.ndarray) -> np.ndarray:
        """Minus the logarithm of the error of each block, mean over channels.

        Errors of free runs are alike from sample to sample and large where the model drifts: as densities, a
        few blocks would decide. What counts is by which factor the error falls, in every block alike.
        """
        data = self.dataset.data
        counts = in_blocks(data.seen, data)
        channels = np.moveaxis(e, -1, 0)
        squares = np.array([in_blocks(c**2 * data.seen, data) / np.maximum(counts, 1) for c in channels])
        return -0.5 * np.mean(np.log(squares + self.noise[:, None] ** 2), axis=0)


def _multiple_of_four(count: int) -> int:
    return -(-count // 4) * 4


def in_blocks(values: Float[np.ndarray, "R N"], data: StackedRecordings) -> Float[np.ndarray, " B"]:
    """Sums over blocks; the last, shorter block of each recording joins its neighbour."""
    out = []
    for row, seen, Ts in zip(values, data.seen, data.Ts, strict=True):
        N = int(seen.sum())
        width = max(round(BLOCK_SECONDS / float(Ts)), 1)
        edges = np.arange(0, max(N - width, 0) + 1, width)
        out.append(np.add.reduceat(row[:N], edges) if N else np.zeros(0))
    return np.concatenate(out)
