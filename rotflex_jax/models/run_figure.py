"""Figure of measured against simulated outputs, with errors and the fit of each model."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rotflex_jax.metrics import fit_percent, rmse
from rotflex_jax.recording import Recording
from rotflex_jax.text.colours import FINAL, MEASURED, stage_colours
from rotflex_jax.text.numbers import plain_number, readable
from rotflex_jax.text.plotting import blank, styled, thinned
from rotflex_jax.text.zoom import Line, LinePanel, LineView

# Limits of the axes, in spans of the measured signal: a model that diverges must not hide the measurement.
MOST_SPANS, MOST_ERROR_SPANS = 2.0, 3.0


@styled
def run_figure(
    recording: Recording,
    channels: Sequence[str],
    runs: Sequence[tuple[str, Float[np.ndarray, "N C"]]],
    title: str,
) -> Figure:
    """Measured and simulated outputs over time, and the errors below each channel.

    Args:
        recording: Measured data.
        channels: Channels that are shown, in the order of the columns of a run.
        runs: Name and outputs of each model; values that are not finite are left out.
        title: Title of the figure.
    """
    figure = blank(10.0, 2.9 * len(channels) + 0.4)
    axes = figure.subplots(
        2 * len(channels), 1, sharex=True, squeeze=False, height_ratios=(1.7, 1.0) * len(channels)
    )[:, 0]
    for c, channel in enumerate(channels):
        scale, read = readable(1.0, recording.unit(channel))
        _channel(
            axes[2 * c], axes[2 * c + 1], recording, channel, [(n, y[:, c]) for n, y in runs], scale, read
        )
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, fontweight="bold")
    figure.align_ylabels(axes)
    return figure


def _channel(
    above: Axes,
    below: Axes,
    recording: Recording,
    channel: str,
    runs: Sequence[tuple[str, Float[np.ndarray, " N"]]],
    scale: float,
    read: str,
) -> None:
    t, measured = recording.t, scale * recording.channel(channel).astype(float)
    above.plot(*thinned(t, measured), color=MEASURED, lw=2.6, label="measured", solid_capstyle="round")
    for (name, values), colour in zip(runs, _colours(len(runs)), strict=True):
        run = np.where(np.isfinite(values), scale * values, np.nan)
        label = f"{name}: {_quality(recording, measured, run, read)}"
        above.plot(*thinned(t, run), color=colour, lw=1.1, label=label)
        below.plot(*thinned(t, measured - run), color=colour, lw=0.9)
    for ax, (low, high) in zip((above, below), _limits(measured), strict=True):
        bottom, top = ax.get_ylim()
        outside = bottom > high or top < low
        ax.set_ylim(*(low, high) if outside else (max(bottom, low), min(top, high)))
    above.margins(x=0)
    above.set_ylabel(f"{channel} [{read}]")
    below.set_ylabel(f"error [{read}]")
    above.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2)


def _limits(measured: Float[np.ndarray, " N"]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits that the axes of a channel and of its errors do not exceed."""
    low, high = float(measured.min()), float(measured.max())
    span = (high - low) or 1.0
    error = MOST_ERROR_SPANS * span
    return (low - MOST_SPANS * span, high + MOST_SPANS * span), (-error, error)


def run_panels(
    label: str, below: str, measured: Float[np.ndarray, " N"], runs: Sequence[Line], band: float = 0.0
) -> tuple[LinePanel, LinePanel]:
    """Panels to zoom with the measured and simulated values of one channel, and their differences below.

    Args:
        label: Label of the upper axis, with its unit.
        below: Label of the lower axis, with its unit.
        measured: Measured values.
        runs: Simulated values of the models.
        band: Half width of the band of the differences that the sensor alone causes.
    """
    errors = tuple(dataclasses.replace(r, values=measured - r.values, width=1.0) for r in runs)
    limits, error_limits = _limits(measured)
    return (
        LinePanel(label, (Line("measured", MEASURED, measured, 2.8), *runs), 190, limits=limits),
        LinePanel(below, errors, 120, band, error_limits),
    )


def run_view(
    recording: Recording, channels: Sequence[str], runs: Sequence[tuple[str, Float[np.ndarray, "N C"]]]
) -> LineView:
    """The figure of `run_figure` in a form to pan and zoom."""
    panels = list[LinePanel]()
    for c, channel in enumerate(channels):
        scale, read = readable(1.0, recording.unit(channel))
        lines = [
            Line(name, colour, scale * y[:, c])
            for (name, y), colour in zip(runs, _colours(len(runs)), strict=True)
        ]
        measured = scale * recording.channel(channel).astype(float)
        panels += run_panels(f"{channel} [{read}]", f"error [{read}]", measured, lines)
    return LineView(float(recording.t[0]), recording.Ts, tuple(panels))


def _colours(count: int) -> tuple[str, ...]:
    return stage_colours(count) if count > 1 else (FINAL,)


def _quality(recording: Recording, measured: Any, run: Any, read: str) -> str:
    if not np.all(np.isfinite(run)):
        return "diverges"
    fit = float(fit_percent(measured, run, recording.n_init))
    error = float(rmse(measured, run, recording.n_init))
    share = f"fit {fit:.1f} %, " if np.isfinite(fit) else ""
    return f"{share}error {plain_number(error)} {read} rms"
