"""The likelihood of recordings under a hypothesis: gains of its predictor, whitener, log-likelihood."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.batched_predictor import BatchedPredictor
from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.supermodel import SuperModel
from rotflex_jax.discover.whitening import fit_whitener, log_likelihood
from rotflex_jax.fit.dataset import Dataset
from rotflex_jax.mechanism import Solver, kalman_gains
from rotflex_jax.mechanism.assembly import Layout

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
    """

    predictor: BatchedPredictor
    dataset: Dataset
    ports: tuple[str, ...]

    @classmethod
    def of(
        cls, supermodel: SuperModel, solver: Solver, dataset: Dataset, ports: tuple[str, ...]
    ) -> "LikelihoodProblem":
        """The problem of a super-model on a dataset."""
        return cls(BatchedPredictor(supermodel, solver, dataset.data, dataset.constants), dataset, ports)

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
        return -(-count // 4) * 4

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
        s, found = self.supermodel, {}
        mechanism = s.clean(h.values(s).mean(axis=0), ())
        rows = list(zip(np.asarray(self.dataset.data.Ts).tolist(), self.dataset.constants, strict=True))
        keys = [(Ts, known.tobytes()) for Ts, known in rows]
        for key, (Ts, known) in zip(keys, rows, strict=True):
            if key not in found:
                here = mechanism.with_values(np.where(np.isnan(known), mechanism.values, known))
                found[key] = kalman_gains(here, intensities, self.noise, Ts)
        K = np.stack([found[key] for key in keys], axis=1)
        full = np.zeros((*K.shape[:2], Layout.of(s.mechanism.structure).size, K.shape[3]))
        full[:, :, s.baseline_states] = K
        return list(full)

    def innovations(self, hypotheses: Sequence[Hypothesis]) -> Float[np.ndarray, "H R N C"]:
        """Innovations of hypotheses."""
        return self.predictor.innovations([h.parameter_set(self.supermodel) for h in hypotheses])

    def slopes(
        self, hypotheses: Sequence[Hypothesis], count: int = 0
    ) -> tuple[Float[np.ndarray, "H R N C"], Float[np.ndarray, "H D R N C"]]:
        """Innovations and their slopes along all that a fit moves, padded to `count` directions at least."""
        s, count = self.supermodel, max(count, self.direction_count, *(h.moved for h in hypotheses))
        directions = [h.directions(s, count) for h in hypotheses]
        return self.predictor.slopes([h.parameter_set(s) for h in hypotheses], directions)

    def log_likelihood(self, e: Float[np.ndarray, "R N C"]) -> float:
        """Log-likelihood of innovations under the whitener that they give [nat].

        Minus infinity where a run diverges.
        """
        return log_likelihood(e, self.seen, self.noise) if np.all(np.isfinite(e)) else -np.inf

    def log_likelihoods(self, hypotheses: Sequence[Hypothesis]) -> Float[np.ndarray, " H"]:
        """Log-likelihoods of hypotheses as they are [nat], each with the whitener that it gives."""
        return np.array([self.log_likelihood(e) for e in self.innovations(hypotheses)])

    def evaluated(self, h: Hypothesis, e: Float[np.ndarray, "R N C"]) -> Hypothesis:
        """The hypothesis with the whitener and the likelihood that its innovations give."""
        whitener = fit_whitener(e, self.seen, self.noise)
        return dataclasses.replace(h, whitener=whitener, densities=whitener.log_densities(e, self.seen))
