"""Figure of measured against simulated outputs, with errors and the fit of each model."""

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


@styled
def run_figure(
    recording: Recording,
    channels: Sequence[str],
    runs: Sequence[tuple[str, Float[np.ndarray, "N C"]]],
    title: str,
) -> Figure:
    """Measured and simulated outputs over time, and below each channel what is left.

    Args:
        recording: What was measured.
        channels: Which of it, in the order of the columns of a run.
        runs: Name and outputs of each model; what is not finite is left out.
        title: Over the figure.
    """
    figure = blank(10.0, 2.9 * len(channels) + 0.4)
    axes = figure.subplots(
        2 * len(channels), 1, sharex=True, squeeze=False, height_ratios=(1.7, 1.0) * len(channels)
    )[:, 0]
    for c, channel in enumerate(channels):
        unit = recording.units[recording.channels.index(channel)]
        scale, read = readable(1.0, unit)
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
    colours = stage_colours(len(runs)) if len(runs) > 1 else (FINAL,)
    for (name, values), colour in zip(runs, colours, strict=True):
        run = np.where(np.isfinite(values), scale * values, np.nan)
        label = f"{name}: {_quality(recording, measured, run, read)}"
        above.plot(*thinned(t, run), color=colour, lw=1.1, label=label)
        below.plot(*thinned(t, measured - run), color=colour, lw=0.9)
    # A model that runs away must not hide what was measured.
    low, high = float(measured.min()), float(measured.max())
    span = (high - low) or 1.0
    shown = above.get_ylim()
    above.set_ylim(max(shown[0], low - 2 * span), min(shown[1], high + 2 * span))
    limit = below.get_ylim()
    below.set_ylim(max(limit[0], -3 * span), min(limit[1], 3 * span))
    above.margins(x=0)
    above.set_ylabel(f"{channel} [{read}]")
    below.set_ylabel(f"error [{read}]")
    above.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2)


def _quality(recording: Recording, measured: Any, run: Any, read: str) -> str:
    if not np.all(np.isfinite(run)):
        return "diverges"
    fit = float(fit_percent(measured, run, recording.n_init))
    error = float(rmse(measured, run, recording.n_init))
    share = f"fit {fit:.1f} %, " if np.isfinite(fit) else ""
    return f"{share}error {plain_number(error)} {read} rms"
