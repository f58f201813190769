"""Choices within the training recordings: what is learnt from, what decides, and by which error."""

from collections.abc import Sequence

import numpy as np

from rotflex_jax.compare.judged import free_runs
from rotflex_jax.compare.method import Simulator
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording


def parted(train: Sequence[Recording], share: float) -> tuple[list[Recording], list[Recording]]:
    """First and last part of each recording."""
    parts = [recording.split(share) for recording in train]
    return [a for a, _ in parts], [b for _, b in parts]


def one_period(recordings: Sequence[Recording], what: str) -> None:
    """Refuses recordings that one sampled model cannot hold for.

    Raises:
        InputError: Their sampling periods differ.
    """
    if len({r.Ts for r in recordings}) > 1:
        raise InputError(
            f"The recordings have different sampling periods, but {what} has one; decimate them to the same."
        )


def free_run_cost(simulator: Simulator, recordings: Sequence[Recording]) -> float:
    """Mean over the channels of the log of the free-run error; infinite where a run diverges.

    Args:
        simulator: What is judged.
        recordings: What decides; one run over each.
    """
    with np.errstate(all="ignore"):
        runs = free_runs(simulator, recordings)
        e = np.concatenate([(r.y - y_hat)[r.n_init :] for r, y_hat in zip(recordings, runs, strict=True)])
        cost = float(np.mean(np.log(np.sqrt(np.mean(e**2, axis=0)) + 1e-300)))
    return np.inf if np.isnan(cost) else cost
