"""The picture of the explorer: three runs over time, and where over speed and deflection the error is."""

import io
from collections.abc import Mapping

import numpy as np
import scipy
from matplotlib.figure import Figure

from rotflex_jax.recording import Recording
from rotflex_jax.report.style import BASELINE, FINAL, MEASURED, blank, legend_above, styled, thinned
from rotflex_jax.report.wording import readable

CELLS, FEWEST, SMOOTHING = 15, 5, 0.03


def _cells(
    error: np.ndarray, seen: np.ndarray, over: tuple[np.ndarray, np.ndarray], edges: list[np.ndarray]
) -> np.ma.MaskedArray:
    """Root mean square of an error in cells that have been visited often enough."""
    total = np.histogram2d(*over, edges, weights=error**2)[0]
    return np.ma.masked_where(seen < FEWEST, np.sqrt(total / np.maximum(seen, 1)))


@styled
def _figure(
    recording: Recording, y: np.ndarray, given: np.ndarray, now: np.ndarray, units: Mapping[str, str]
) -> Figure:
    """Runs to the left, the error of the last one to the right."""
    count = len(units)
    figure = blank(10.0, 1.9 * count + 0.5)
    axes = figure.subplots(count, 2, width_ratios=(1.9, 1.0), squeeze=False)
    scale, read = zip(*(readable(1.0, unit) for unit in units.values()), strict=True)
    window = 2 * max(2, round(SMOOTHING / recording.Ts)) + 1
    speed = scale[0] * scipy.signal.savgol_filter(y[:, 0], window, 2, deriv=1, delta=recording.Ts)
    against = scale[-1] * y[:, -1] if count > 1 else recording.t
    names = list(units)
    over = f"{names[-1]} [{read[-1]}]" if count > 1 else "time [s]"
    for c, channel in enumerate(units):
        left, right = axes[c]
        for run, colour, style, label, width in (
            (y, MEASURED, "-", "measured", 2.5),
            (given, BASELINE, "--", "as given", 1.0),
            (now, FINAL, "-", "now", 1.0),
        ):
            left.plot(
                *thinned(recording.t, scale[c] * run[:, c]), color=colour, ls=style, lw=width, label=label
            )
        left.set_ylabel(f"{channel} [{read[c]}]")
        left.set_xlabel("time [s]")
        edges = [
            np.linspace(np.quantile(x, 0.005), np.quantile(x, 0.995), CELLS + 1) for x in (speed, against)
        ]
        seen = np.histogram2d(speed, against, edges)[0]
        now_rms, given_rms = (
            _cells(scale[c] * (y[:, c] - run[:, c]), seen, (speed, against), edges) for run in (now, given)
        )
        # The scale holds the model as given, so that a better one looks paler.
        worst = max(float(np.ma.max(m)) if m.count() else 0.0 for m in (now_rms, given_rms)) or 1.0
        mesh = right.pcolormesh(*edges, now_rms.T, cmap="YlOrRd", vmin=0.0, vmax=worst)
        right.set_facecolor("#eceff2")
        right.grid(False)
        right.set_xlabel(f"speed of {names[0]} [{read[0]}/s]")
        right.set_ylabel(over)
        figure.colorbar(mesh, ax=right, label=f"rms error of {channel} [{read[c]}]")
    legend_above(figure, axes[:, 0])
    return figure


def overlay(
    recording: Recording, y: np.ndarray, given: np.ndarray, now: np.ndarray, units: Mapping[str, str]
) -> bytes:
    """A PNG of three runs over time, and of the error over speed and deflection.

    Args:
        recording: What is drawn.
        y: Its measured channels in the order of the model (N, C).
        given: Run of the model as it was given (N, C).
        now: Run of the model as it stands (N, C).
        units: Channel -> its unit.
    """
    buffer = io.BytesIO()
    _figure(recording, y, given, now, units).savefig(buffer, format="png", dpi=90)
    return buffer.getvalue()
