"""Unevenly sampled signals on an even grid, on request."""

from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax.errors import InputError
from rotflex_jax.recording.quality import Finding
from rotflex_jax.recording.samples import finite, sampling_period

# Longest step that is bridged, in median steps.
LONGEST_STEP = 5.0
# A step longer than this, in median steps, has lost rows.
LOST = 1.5


def resampled(
    t: Float[np.ndarray, " N"],
    u: Float[np.ndarray, " N"],
    y: Float[np.ndarray, "N C"],
    period: Any,
    label: str,
    where: str = "row",
    first: int = 1,
) -> tuple[float, float, Float[np.ndarray, " M"], Float[np.ndarray, "M C"], Finding]:
    """Signals at even times: the input as it is held, the outputs on straight lines between their samples.

    Not a cure for a clock that is wrong where a converter samples evenly: there leave the time out and give
    the sampling period.

    Args:
        t: Times, which may repeat but not fall [s].
        u: Input.
        y: Outputs.
        period: Sampling period to have [s], or "auto" for the median step.
        label: First words of an error.
        where: What one entry is called.
        first: Number of the first entry.

    Returns:
        First time and period [s], input, outputs, and what was done as a finding: a note, or a warning where
        rows are lost.

    Raises:
        InputError: Times that fall or are too few, or a gap that no line should bridge.

    >>> t = np.array([0.0, 0.01, 0.021, 0.03, 0.04])
    >>> _, Ts, u, y, said = resampled(t, np.arange(5.0), 10 * t[:, None], "auto", "run.csv")
    >>> Ts, u, said.message
    (0.01, array([0., 1., 1., 3., 4.]), 'Resampled every 0.01 s from steps of 0.009 to 0.011 s.')
    """
    finite(t, label, where, first)
    steps = np.diff(t)
    fallen = np.flatnonzero(steps < 0)
    if len(fallen):
        raise InputError(
            f"{label} must not fall, but does by {-steps[fallen[0]]:g} s between {where}s "
            f"{first + fallen[0]} and {first + fallen[0] + 1}; sort the rows, or load one run at a time."
        )
    keep = np.concatenate([[True], steps > 0])
    repeated = int(np.sum(~keep))
    t, u, y = t[keep], u[keep], y[keep]
    steps = np.diff(t)
    if len(steps) < 2:
        raise InputError(f"{label} has {len(t)} different times, but resampling needs three; record longer.")
    median = float(np.median(steps))
    Ts = float(f"{median:.6g}") if period == "auto" else sampling_period(period, "Argument `resample`")
    worst = int(np.argmax(steps))
    if steps[worst] > LONGEST_STEP * median:
        raise InputError(
            f"{label} has a gap of {steps[worst]:g} s after {t[worst]:g} s, {steps[worst] / median:.0f} "
            "times the median step, which no resampling should bridge; load the parts before and after it "
            "as recordings of their own."
        )
    start = float(t[0])
    grid = start + Ts * np.arange(int(np.floor((t[-1] - start) / Ts + 1e-6)) + 1)
    before = np.clip(np.searchsorted(t, grid + 1e-9 * Ts, side="right") - 1, 0, len(t) - 1)
    outputs = np.column_stack([np.interp(grid, t, x) for x in y.T])
    lost = int(np.sum(np.round(steps[steps > LOST * median] / median) - 1))
    told = f"Resampled every {Ts:g} s from steps of {steps.min():.4g} to {steps.max():.4g} s"
    if lost:
        told += f"; about {lost} rows are lost, and lines bridge them"
    if repeated:
        told += f"; {repeated} rows with a time that was there before are left out"
    finding = Finding("resampled", "time", f"{told}.", "warning" if lost else "note")
    return start, Ts, u[before], outputs, finding
