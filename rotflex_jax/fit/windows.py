"""Where runs start again: once per recording for a prediction, every few seconds for free runs.

A free run is a predictor whose gain is zero. Over a whole recording its error grows with every small error of
the parameters, so it starts again every few seconds, each time in a first state of its own. Both kinds of
run go through the same compiled programs, as the window of each sample is data.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from rotflex_jax.fit.dataset import Dataset
from rotflex_jax.mechanism.initial_state import rough_state
from rotflex_jax.metrics import window_starts
from rotflex_jax.models.model import Model


@dataclasses.dataclass(frozen=True)
class Windows:
    """The windows of some recordings, their number filled up to the same W in all of them.

    Attributes:
        index: Window of each sample.
        counts: How many windows each recording has.
        first_states: First positions and speeds, where a fit starts.
    """

    index: Int[np.ndarray, "R N"]
    counts: tuple[int, ...]
    first_states: Float[np.ndarray, "R W n"]

    @classmethod
    def whole(cls, dataset: Dataset, number: int = 1) -> "Windows":
        """One window per recording; `number` is W, so that runs with more windows share compiled code."""
        R, N = dataset.data.u.shape
        first = np.repeat(dataset.first_states[:, None], number, axis=1)
        return cls(np.zeros((R, N), np.int32), (1,) * R, first)

    @classmethod
    def of_seconds(cls, model: Model, dataset: Dataset, seconds: float, number: int = 1) -> "Windows":
        """Windows of some seconds, as errors over windows have them.

        Args:
            model: Its channels count.
            dataset: What is cut.
            seconds: Length of a window [s].
            number: Least W.
        """
        starts = [window_starts(r, seconds)[0] for r in dataset.recordings]
        counts = tuple(map(len, starts))
        R, N = dataset.data.u.shape
        index = np.zeros((R, N), np.int32)
        first = np.repeat(dataset.first_states[:, None], max(number, *counts), axis=1)
        for r, (recording, begins) in enumerate(zip(dataset.recordings, starts, strict=True)):
            y = model.measured(recording).astype(float)
            index[r] = np.searchsorted(begins, np.arange(N), side="right") - 1
            for w, k in enumerate(begins):
                head = y[k : k + recording.n_init]
                first[r, w] = rough_state(model.mechanism.structure, head, recording.Ts)
        return cls(index, counts, first)

    @property
    def number(self) -> int:
        """W."""
        return self.first_states.shape[1]

    def of(self, recording: int) -> Iterator[tuple[int, slice]]:
        """Each window of a recording with its samples."""
        edges = np.searchsorted(self.index[recording], np.arange(self.counts[recording] + 1))
        for w in range(self.counts[recording]):
            yield w, slice(int(edges[w]), int(edges[w + 1]))
