"""Free runs over held-out recordings, of a simulator that cannot see what it is judged on."""

import dataclasses
import time
from collections.abc import Callable, Sequence

import numpy as np

from rotflex_jax import metrics
from rotflex_jax.compare.method import Simulator
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import ACCEPTABLE

# A run that leaves the range of the measurements so many times over has diverged.
BEYOND = 100.0


def blinded(recording: Recording, seconds: float | None = None) -> Recording:
    """The recording with its outputs held where a model may not look.

    Args:
        recording: What is simulated.
        seconds: Length of the windows, of each of which a model may look at the first `n_init` samples [s];
            at those of the recording alone if None.
    """
    k = np.arange(recording.N)
    hidden = k >= recording.n_init if seconds is None else metrics.counted(recording, seconds)
    last = np.maximum.accumulate(np.where(hidden, 0, k))
    return dataclasses.replace(recording, y=recording.y[last], accept=ACCEPTABLE)


def free_runs(simulator: Simulator, recordings: Sequence[Recording]) -> tuple[np.ndarray, ...]:
    """One free run (N, C) over each recording, none of which can look beyond `n_init`."""
    return tuple(_checked(simulator.simulate(blinded(r)), r) for r in recordings)


def _checked(run: np.ndarray, recording: Recording) -> np.ndarray:
    y_hat = np.asarray(run, float)
    if y_hat.shape != recording.y.shape:
        raise InputError(
            f"The free run has the shape {y_hat.shape}, but {recording.y.shape} is needed; "
            "simulate every sample and channel of the recording."
        )
    return y_hat


def windowed_runs(
    simulator: Simulator, recordings: Sequence[Recording], seconds: float
) -> tuple[np.ndarray, ...]:
    """Free runs (N, C) over each recording that start anew every few seconds, as a search has them.

    A simulator that has `simulate_windows`, as every grey box, does it itself: the voltage drives it over the
    whole recording, and a delay, a lag or a drift goes on from window to window. What a black box
    (difference equation, state space, series) knows of the past is in the first samples of a recording,
    from which it works out its state or the input before: it runs over each window as a recording by itself.

    Args:
        simulator: It sees the input and the first `n_init` samples of each window.
        recordings: What it simulates.
        seconds: Length of the windows [s].
    """
    whole = getattr(simulator, "simulate_windows", None)
    if whole is not None:
        return tuple(_checked(whole(blinded(r, seconds), seconds), r) for r in recordings)
    runs = []
    for r in recordings:
        starts = metrics.window_starts(r, seconds)[0].tolist()
        pieces = [r.slice(i, j) for i, j in zip(starts, [*starts[1:], r.N], strict=True)]
        pieces = [dataclasses.replace(piece, n_init=r.n_init) for piece in pieces]
        runs.append(np.concatenate(free_runs(simulator, pieces)))
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


def windowed_errors(
    simulator: Simulator, recordings: Sequence[Recording], seconds: float
) -> dict[str, float]:
    """Channel -> root mean square error of `windowed_runs`, over all recordings together."""
    runs = windowed_runs(simulator, recordings, seconds)
    with np.errstate(all="ignore"):
        rms = metrics.windowed_rmse(recordings, [r.y for r in recordings], runs, seconds)
    return dict(zip(recordings[0].channels, rms.tolist(), strict=True))
