"""Error against how far ahead a free run has gone: many short runs, started all over the recording."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from rotflex_jax.compare.judged import free_runs
from rotflex_jax.compare.method import Simulator
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording

POINTS = 16
RUNS = 12


@dataclasses.dataclass(frozen=True)
class Horizon:
    """Root mean square error of free runs by the time since the last sample that was seen.

    Attributes:
        seconds: End of each stretch of time (K,) [s].
        rmse: Channel -> error within the stretch (K,) [unit].
        runs: How many runs.
    """

    seconds: tuple[float, ...]
    rmse: dict[str, tuple[float, ...]]
    runs: int


def pieces(recordings: Sequence[Recording], seconds: float) -> list[Recording]:
    """Stretches of equal length from all recordings, evenly spread; they may overlap.

    Args:
        recordings: Held-out recordings.
        seconds: How far ahead the free runs go [s].
    """
    found = []
    for r in recordings:
        length = min(r.N, r.n_init + max(2, round(seconds / r.Ts)))
        most = max(1, RUNS // len(recordings))
        starts = np.unique(np.linspace(0, r.N - length, most).astype(int))
        found += [r.slice(int(i), int(i) + length) for i in starts]
    return found


def against_horizon(simulator: Simulator, recordings: Sequence[Recording], seconds: float) -> Horizon:
    """Error against the horizon, in stretches of time that grow with it.

    The voltage drives a grey box over the whole recording, as in windows (`judged.windowed_runs`).

    Args:
        simulator: What is judged.
        recordings: Held-out recordings, of one sampling period.
        seconds: How far ahead [s].
    """
    if isinstance(simulator, Model):
        pairs = [simulator.driven(r) for r in recordings]
        simulator, recordings = pairs[0][0], [r for _, r in pairs]
    parts = pieces(recordings, seconds)
    runs = free_runs(simulator, parts)
    ahead = min(r.N - r.n_init for r in parts)
    edges = np.unique(np.round(np.geomspace(1, ahead, POINTS)).astype(int))
    with np.errstate(all="ignore"):
        e = np.stack([(r.y - y_hat)[r.n_init :][:ahead] for r, y_hat in zip(parts, runs, strict=True)])
        squares = np.mean(e**2, axis=0)  # (ahead, C)
        ends = np.concatenate([[0], edges])
        rms = [np.sqrt(squares[a:b].mean(axis=0)) for a, b in itertools.pairwise(ends)]
    by_channel = np.array(rms).T
    return Horizon(
        tuple((edges * recordings[0].Ts).tolist()),
        {c: tuple(v.tolist()) for c, v in zip(recordings[0].channels, by_channel, strict=True)},
        len(parts),
    )
