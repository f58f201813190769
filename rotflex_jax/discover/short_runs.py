"""Free runs that start again every few seconds, by the compiled programs of the search.

As in `Model.simulate_windows`, positions and speeds come from the first samples of each window. States that
no sensor measures are given here, and come from a run over the whole recording there. A model of its own
would be compiled for every candidate.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.batched_predictor import BatchedPredictor, ParameterSet
from rotflex_jax.fit.dataset import Dataset
from rotflex_jax.fit.windows import Windows
from rotflex_jax.mechanism.initial_state import DIFFERENCE
from rotflex_jax.optimise.damped_least_squares import NormalEquations, Rules, minimise_together

# Of the fit of a window's first state to a few samples, which determine it well.
FIRST_STATE_RULES = Rules(enough_share=1e-9, least=1e-6)
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
        predictor: Runs them.
        dataset: The recordings.
        windows: Where runs start again.
    """

    predictor: BatchedPredictor
    dataset: Dataset
    windows: Windows

    def outputs(self, run: ParameterSet) -> list[Float[np.ndarray, "_ C"]]:
        """Outputs of each recording's runs; as measured where a sample does not count.

        Args:
            run: Parameters; of its first states (R, W, m) positions and speeds are where a fit starts, and
                the others are kept. Its gain is not used.
        """
        run = run._replace(K=np.zeros_like(run.K))
        y_hat = self.dataset.data.y - self._innovations([run._replace(x0=self._first_states(run))])[0]
        return [np.asarray(y_hat[r, : recording.N]) for r, recording in enumerate(self.dataset.recordings)]

    def _innovations(self, runs: list[ParameterSet]) -> Float[np.ndarray, "L R N C"]:
        return self.predictor.innovations(runs, self.windows.index)

    def _first_states(self, run: ParameterSet) -> Float[np.ndarray, "R W m"]:
        """First states whose positions and speeds suit the first samples of each window best."""
        size = self.windows.first_states.shape[-1]

        def started_at(points: list[_FirstState], change: int | None = None) -> ParameterSet:
            x0 = run.x0.copy()
            for p in points:
                x0[p.recording, p.window, :size] = p.state
                if change is not None:
                    x0[p.recording, p.window, change] += DIFFERENCE
            return run._replace(x0=x0)

        def head(e: np.ndarray, p: _FirstState) -> np.ndarray:
            return e[..., p.recording, p.samples, :].reshape(*e.shape[:-3], -1)

        def linearise(points: list[_FirstState]) -> list[NormalEquations]:
            changed = [started_at(points, k) for k in range(size)]
            e = self._innovations([started_at(points), *changed])
            rows = (head(e, p) for p in points)
            return [NormalEquations.of((w[1:] - w[0]).T / DIFFERENCE, w[0]) for w in rows]

        def costs(points: list[_FirstState]) -> list[float]:
            e = self._innovations([started_at(points)])[0]
            return [0.5 * float(np.sum(head(e, p) ** 2)) for p in points]

        found = minimise_together(
            linearise,
            self._rough_states(),
            FIRST_STATE_RULES,
            costs=costs,
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
