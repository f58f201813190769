"""The stages of a grey-box fit: predictions with given gains, one after the other, errors weighted anew."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.fit.descent import NATS, Given, Moved, Reached, descend
from rotflex_jax.fit.residuals import Data
from rotflex_jax.mechanism import kalman_gains
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording

if TYPE_CHECKING:
    from rotflex_jax.fit.compressed import Minimiser

Stage = Mapping[str, float] | None
"""Port -> intensity of the process torque [(N m)^2 s]; None for a free run."""

# A stage that only leads to the next one ends where steps gain less than this [nat].
NEAR = 1.0
# Descents of the last stage at most, each with the scale that the one before left; they end where it changes
# by less than this share, with measured first states after so many at least.
PASSES, SETTLED, FOLLOWED = 5, 0.02, 4
# A start is far where its run misses a channel by more than this share of the channel's deviation.
FAR = 0.7
# Of two ends that differ by less, one that converged is better [nat].
ALIKE = 0.1


@dataclasses.dataclass(frozen=True)
class Ended:
    """Where a sequence of stages ended.

    Attributes:
        flat: All coordinates.
        given: What the last runs were made with, with the scale of the last residuals.
        status: "converged", or why not.
        steps: Iterations.
        history: Half the squared error after each descent.
        missed: What the run at the start missed each channel by, as a share of its deviation (C,).
        cost: Negative log-likelihood with the last scale, constants left out; infinite if diverged.
    """

    flat: np.ndarray
    given: Given
    status: str
    steps: int
    history: list[float]
    missed: np.ndarray
    cost: float

    @property
    def rank(self) -> float:
        """Smaller for a better end."""
        return self.cost + ALIKE * (self.status != "converged")

    @property
    def doubtful(self) -> bool:
        """Whether another way may end better: the start was far away, or this way did not converge."""
        return self.status != "converged" or not np.all(self.missed <= FAR)


@dataclasses.dataclass(frozen=True)
class Task:
    """What is fitted to what, and how.

    Attributes:
        model: Mechanism and solver.
        recordings: One or several.
        moved: Which coordinates are moved.
        data: The recordings, stacked.
        noise: Deviation of the sensor noise (C,).
        measured: Whether first states are held at what the first samples tell.
        max_steps: Most iterations of a descent.
        minimiser: Solver of optimistix, or None for the toolkit's own.
        say: Called with lines of progress.
    """

    model: Model
    recordings: Sequence[Recording]
    moved: Moved
    data: Data
    noise: np.ndarray
    measured: bool
    max_steps: int
    minimiser: "Minimiser | None"
    say: Callable[[str], None]

    def run(self, flat: np.ndarray, stages: Sequence[Stage]) -> Ended:
        """One stage after the other, from a start; each but the last only until it is near its end."""
        seen = self.data.seen > 0
        spread = np.maximum(np.std(self.data.y[seen], axis=0), self.noise)
        error = lambda cost, scale: np.sqrt(2 * cost / np.sum(seen)) * scale  # noqa: E731
        scale, missed = self.noise, np.full_like(spread, np.inf)
        history, steps, status = [], 0, "converged"
        for number, stage in enumerate(stages):
            last = number == len(stages) - 1
            for turn in range(PASSES if last else 1):
                if self.measured:
                    flat = self._with_measured_states(flat)
                given = self._given(flat, stage, scale)
                found = self._descend(flat, given, NATS if last else NEAR)
                flat, status, steps = found.flat, found.status, steps + found.steps
                if not history:
                    missed = error(found.first, scale) / spread
                history.append(float(found.cost.sum()))
                new = error(found.cost, scale)
                settled = np.all(np.abs(np.log(new / scale)) < SETTLED)
                scale = np.where(np.isfinite(new), np.maximum(new, self.noise * 0.1), scale)
                # States that the first samples tell follow the numbers, fitted with the former ones.
                if status != "converged" or (settled and turn + 1 >= FOLLOWED * self.measured):
                    break
        given = given._replace(scale=jnp.asarray(scale))
        cost = float(np.sum(seen) * np.sum(np.log(scale)))
        if status.startswith("diverged") or not np.isfinite(cost):
            cost = np.inf
        return Ended(flat, given, status, steps, history, missed, cost)

    def _model(self, flat: np.ndarray) -> Model:
        values = self.moved.coordinates.values(flat).mean(axis=0)
        return dataclasses.replace(self.model, mechanism=self.model.mechanism.with_values(values))

    def _with_measured_states(self, flat: np.ndarray) -> np.ndarray:
        """The first states as the first samples tell them to the model."""
        c, there, flat = self.moved.coordinates, self._model(flat), flat.copy()
        for r, recording in enumerate(self.recordings):
            flat[c.state_index(r)] = there._start(recording)[: c.states]
        return flat

    def _given(self, flat: np.ndarray, stage: Stage, scale: np.ndarray) -> Given:
        m = self._model(flat).mechanism
        K = np.stack([kalman_gains(m, [stage or {}], self.noise, float(Ts))[0] for Ts in self.data.Ts])
        return Given(*jax.tree.map(jnp.asarray, (np.ones(len(m.effects)), self.data, K, scale)))

    def _descend(self, flat: np.ndarray, given: Given, enough: float) -> Reached:
        if self.minimiser is None:
            return descend(self.moved, flat, given, self.max_steps, self.say, enough)
        from rotflex_jax.fit.compressed import minimise  # takes long to import

        return minimise(self.minimiser, self.moved, flat, given, self.max_steps)
