"""Free runs over held-out recordings, of a simulator that cannot see what it is judged on."""

import dataclasses
import time
from collections.abc import Callable, Sequence

import numpy as np

from rotflex_jax import metrics
from rotflex_jax.compare.method import Simulator
from rotflex_jax.errors import InputError
from rotflex_jax.model import window_starts
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import ACCEPTABLE

# A run that leaves the range of the measurements so many times over has diverged.
BEYOND = 100.0


def blinded(recording: Recording) -> Recording:
    """The recording with its outputs held from sample `n_init` on: all that a model may look at."""
    y = recording.y.copy()
    y[recording.n_init :] = y[recording.n_init - 1]
    return dataclasses.replace(recording, y=y, accept=ACCEPTABLE)


def windows(recording: Recording, seconds: float) -> tuple[Recording, ...]:
    """The recording cut into windows; a rest too short to judge joins the last."""
    starts = window_starts(recording, seconds)[0].tolist()
    pairs = zip(starts, [*starts[1:], recording.N], strict=True)
    return tuple(recording.slice(i, j) for i, j in pairs)


def free_runs(simulator: Simulator, recordings: Sequence[Recording]) -> tuple[np.ndarray, ...]:
    """One free run (N, C) over each recording, none of which can look beyond `n_init`."""
    runs = []
    for recording in recordings:
        y_hat = np.asarray(simulator.simulate(blinded(recording)), float)
        if y_hat.shape != recording.y.shape:
            raise InputError(
                f"The free run has the shape {y_hat.shape}, but {recording.y.shape} is needed; "
                "simulate every sample and channel of the recording."
            )
        runs.append(y_hat)
    return tuple(runs)


def one_step(
    predict: Callable[[Recording], np.ndarray], recordings: Sequence[Recording]
) -> tuple[np.ndarray, ...]:
    """Predictions (N, C) one step ahead; they see every sample before the one predicted."""
    return tuple(np.asarray(predict(recording), float) for recording in recordings)


def seconds_of(simulator: Simulator, recordings: Sequence[Recording]) -> float:
    """How long the free runs take [s]; run them once before, so that no compilation is counted."""
    began = time.perf_counter()
    free_runs(simulator, recordings)
    return time.perf_counter() - began


def left_the_range(runs: Sequence[np.ndarray], recordings: Sequence[Recording], reach: np.ndarray) -> str:
    """In words when the first run diverged; "" where none did.

    Args:
        runs: Free runs (N, C).
        recordings: What they simulate.
        reach: Range of each channel in all data (C,).
    """
    limit = np.where(reach > 0, BEYOND * reach, np.inf)
    for y_hat, recording in zip(runs, recordings, strict=True):
        start = recording.y[: recording.n_init].mean(axis=0)
        # Written so that what is not a number counts as outside.
        outside = ~(np.abs(y_hat - start) <= limit).all(axis=1) | ~np.isfinite(y_hat).all(axis=1)
        if outside.any():
            seconds = float(np.argmax(outside)) * recording.Ts
            when = f"after {seconds:.3g} s"
            return f"the free run leaves the measured range {BEYOND:g} times over {when}"
    return ""


def errors(recordings: Sequence[Recording], runs: Sequence[np.ndarray]) -> dict[str, dict[str, float]]:
    """Metric -> channel -> value, over all recordings together, after the samples of `n_init`."""
    y = np.concatenate([r.y[r.n_init :] for r in recordings]).astype(float)
    y_hat = np.concatenate([run[r.n_init :] for r, run in zip(recordings, runs, strict=True)])
    formulas = {
        "rmse": metrics.rmse,
        "nrmse": metrics.nrmse,
        "fit_percent": metrics.fit_percent,
        "worst": metrics.max_error,
    }
    with np.errstate(all="ignore"):
        return {
            name: dict(zip(recordings[0].channels, formula(y, y_hat).tolist(), strict=True))
            for name, formula in formulas.items()
        }
