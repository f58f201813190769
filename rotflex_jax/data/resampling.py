"""Unevenly sampled signals on an even grid, on request."""

from collections.abc import Sequence
from typing import Any, NamedTuple

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
    both = [TimedSignal(t, u[:, None], True, label), TimedSignal(t, y, False, label)]
    start, Ts, (held, lines), finding = resampled_apart(both, period, where, first)
    return start, Ts, held[:, 0], lines, finding


class TimedSignal(NamedTuple):
    """A signal with times of its own.

    Attributes:
        t: Times, which may repeat but not fall [s].
        x: Values.
        held: Whether it keeps its value from one sample to the next; otherwise it follows straight lines.
        label: First words of an error.
    """

    t: Float[np.ndarray, " N"]
    x: Float[np.ndarray, "N C"]
    held: bool
    label: str


def resampled_apart(
    signals: Sequence[TimedSignal],
    period: Any,
    where: str = "row",
    first: int = 1,
) -> tuple[float, float, list[Float[np.ndarray, "M _"]], Finding]:
    """Signals with times of their own at common even times, from where all have begun to where one ends.

    Args:
        signals: Signals; those with the same array of times share a clock.
        period: Sampling period to have [s], or "auto" for the longest of the median steps.
        where: What one entry is called.
        first: Number of the first entry.

    Returns:
        First time and period [s], the signals, and what was done.

    Raises:
        InputError: As `resampled`, or signals that no time has in common.

    >>> k = np.arange(5.0)
    >>> fast = TimedSignal(0.01 * k, k[:, None], True, "u")
    >>> slow = TimedSignal(0.004 + 0.02 * k, k[:, None], False, "y")
    >>> start, Ts, (u, y), _ = resampled_apart([fast, slow], "auto")
    >>> start, Ts, u[:, 0], y[:, 0]
    (0.004, 0.02, array([0., 2.]), array([0., 1.]))
    """
    clocks: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
    for t, _, _, label in signals:
        if id(t) not in clocks:
            clocks[id(t)] = _checked(t, label, where, first)
    medians = [float(np.median(steps)) for _, steps, _ in clocks.values()]
    Ts = float(f"{max(medians):.6g}") if period == "auto" else sampling_period(period, "Argument `resample`")
    start = max(float(t[0]) for t, _, _ in clocks.values())
    end = min(float(t[-1]) for t, _, _ in clocks.values())
    if end < start:
        raise InputError(
            f"{signals[0][3]} and the times of the other signals have nothing in common: one begins at "
            f"{start:g} s, after another has ended at {end:g} s; take all signals from one run."
        )
    grid = start + Ts * np.arange(int(np.floor((end - start) / Ts + 1e-6)) + 1)
    found = []
    for times, values, held, _ in signals:
        t, _, keep = clocks[id(times)]
        x = values[keep]
        if held:
            found.append(x[np.clip(np.searchsorted(t, grid + 1e-9 * Ts, side="right") - 1, 0, len(t) - 1)])
        else:
            found.append(np.column_stack([np.interp(grid, t, column) for column in x.T]))
    kinds = zip(clocks.values(), medians, strict=True)
    lost = sum(int(np.sum(np.round(s[s > LOST * median] / median) - 1)) for (_, s, _), median in kinds)
    repeated = sum(int(np.sum(~keep)) for _, _, keep in clocks.values())
    shortest = min(steps.min() for _, steps, _ in clocks.values())
    longest = max(steps.max() for _, steps, _ in clocks.values())
    told = f"Resampled every {Ts:g} s from steps of {shortest:.4g} to {longest:.4g} s"
    if len(clocks) > 1:
        told += f" of {len(clocks)} clocks"
    if lost:
        told += f"; about {lost} rows are lost, and lines bridge them"
    if repeated:
        told += f"; {repeated} rows with a time that was there before are left out"
    finding = Finding("resampled", "time", f"{told}.", "warning" if lost else "note")
    return start, Ts, found, finding


def _checked(
    t: Float[np.ndarray, " N"], label: str, where: str, first: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times that increase, their steps, and which of the given ones they are."""
    finite(t, label, where, first)
    steps = np.diff(t)
    fallen = np.flatnonzero(steps < 0)
    if len(fallen):
        raise InputError(
            f"{label} must not fall, but does by {-steps[fallen[0]]:g} s between {where}s "
            f"{first + fallen[0]} and {first + fallen[0] + 1}; sort the rows, or load one run at a time."
        )
    keep = np.concatenate([[True], steps > 0])
    t = t[keep]
    steps = np.diff(t)
    if len(steps) < 2:
        raise InputError(f"{label} has {len(t)} different times, but resampling needs three; record longer.")
    median = float(np.median(steps))
    worst = int(np.argmax(steps))
    if steps[worst] > LONGEST_STEP * median:
        raise InputError(
            f"{label} has a gap of {steps[worst]:g} s after {t[worst]:g} s, {steps[worst] / median:.0f} "
            "times the median step, which no resampling should bridge; load the parts before and after it "
            "as recordings of their own."
        )
    return t, steps, keep
