"""Free runs that start again every few seconds, by the compiled programs of the search.

As in `Model.simulate_windows`, positions and speeds come from the first samples of each window. States that
no sensor measures are given here, and come from a run over the whole recording there. A model of its own
would be compiled for every candidate.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.batched_predictor import BatchedPredictor, Directions, ParameterSet
from rotflex_jax.fit.dataset import Dataset
from rotflex_jax.fit.windows import Windows
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

    def outputs(self, run: ParameterSet, directions: int) -> list[Float[np.ndarray, "_ C"]]:
        """Outputs of each recording's runs; as measured where a sample does not count.

        Args:
            run: Parameters; of its first states (R, W, m) positions and speeds are where a fit starts, and
                the others are kept. Its gain is not used.
            directions: Of the compiled slopes: as many as fits of this structure have, one per coordinate of
                a first state at least.
        """
        run = run._replace(K=np.zeros_like(run.K))
        found = run._replace(x0=self._first_states(run, directions))
        y_hat = self.dataset.data.y - self.predictor.innovations([found], self.windows.index)[0]
        return [np.asarray(y_hat[r, : recording.N]) for r, recording in enumerate(self.dataset.recordings)]

    def _first_states(self, run: ParameterSet, directions: int) -> Float[np.ndarray, "R W m"]:
        """First states whose positions and speeds suit the first samples of each window best."""
        size, (R, P) = self.windows.first_states.shape[-1], run.values.shape
        x0_ways = np.eye(directions, run.x0.shape[-1])
        x0_ways[size:] = 0.0
        ways = Directions(np.zeros((directions, R, P)), x0_ways, np.zeros((directions, len(run.gates))))

        def started_at(points: list[_FirstState]) -> ParameterSet:
            x0 = run.x0.copy()
            for p in points:
                x0[p.recording, p.window, :size] = p.state
            return run._replace(x0=x0)

        def linearise(points: list[_FirstState]) -> list[NormalEquations]:
            # Windows share each run.
            e, J = self.predictor.slopes([started_at(points)], [ways], self.windows.index)
            heads = ((J[0, :size, p.recording, p.samples], e[0, p.recording, p.samples]) for p in points)
            return [NormalEquations.of(slopes.reshape(size, -1).T, w.ravel()) for slopes, w in heads]

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
