"""Figures of held-out runs, of spectra of the remaining error, and of missing torques."""

import dataclasses
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rotflex_jax.discover.explanation import Explanation
from rotflex_jax.discover.learned_torque_figure import learned_figure
from rotflex_jax.discover.result import SearchResult, Stage
from rotflex_jax.discover.tables import channel_units
from rotflex_jax.latent.figure import latent_maps, latent_time
from rotflex_jax.metrics import window_starts
from rotflex_jax.models.run_figure import run_panels
from rotflex_jax.recording import Recording
from rotflex_jax.report.figures.registry import figure
from rotflex_jax.text.colours import (
    BASELINE,
    BASELINE_DASH,
    BASELINE_LINE,
    FAINT,
    FINAL,
    HIGHLIGHT,
    MEASURED,
    NOISE,
)
from rotflex_jax.text.numbers import readable
from rotflex_jax.text.plotting import blank, legend_above, thinned
from rotflex_jax.text.zoom import Line, LinePanel, LineView, Stretch

# Longest part of a recording that the still picture shows [s].
OVERLAY_SECONDS = 30.0


@dataclasses.dataclass(frozen=True)
class Shown:
    """The held-out recording that is drawn, with free runs of baseline and final model.

    Attributes:
        recording: The longest held-out recording.
        measured: Measured channels in the model's order.
        baseline: Free run of the baseline in windows.
        final: Free run of the final model in windows; None if no effect was added.
        starts: First sample of each window.
    """

    recording: Recording
    measured: Float[np.ndarray, "N C"]
    baseline: Float[np.ndarray, "N C"]
    final: Float[np.ndarray, "N C"] | None
    starts: Int[np.ndarray, " W"]


def shown(discovery: SearchResult) -> Shown:
    """Data of the figures of runs."""
    i = discovery.longest_validation
    recording, base = discovery.validation[i], discovery.baseline

    def run(stage: Stage) -> np.ndarray:
        return np.asarray(stage.windowed[i], float)

    return Shown(
        recording,
        np.asarray(base.model.measured(recording), float),
        run(base),
        run(discovery.final) if discovery.rounds else None,
        window_starts(recording, base.window_seconds)[0],
    )


def worst_window(discovery: SearchResult) -> tuple[int, int]:
    """First sample and end of the window with the largest baseline error relative to the noise."""
    s = shown(discovery)
    floor = np.array([discovery.noise_floor.get(c) or 1.0 for c in channel_units(discovery)])
    loss = np.sum(((s.measured - s.baseline) / floor) ** 2, axis=1)
    ends = [*s.starts[1:].tolist(), s.recording.N]
    sums = np.add.reduceat(loss, s.starts) / np.diff([*s.starts.tolist(), s.recording.N])
    worst = int(sums.argmax())
    return int(s.starts[worst]), int(ends[worst])


def _overlay_caption(discovery: SearchResult) -> str:
    long = shown(discovery).recording.duration > OVERLAY_SECONDS
    part = f" In the still picture {OVERLAY_SECONDS:g} s of it are shown." if long else ""
    return (
        "Top rows: where a thin line covers the broad grey one, the model is right. Bottom rows: "
        f"measured minus simulated; the grey band is what the sensor alone makes.{part}"
    )


def _overlay_view(discovery: SearchResult) -> LineView:
    """The whole held-out recording with pan and zoom."""
    s = shown(discovery)
    runs: list[tuple[np.ndarray, str, str, tuple[float, ...]]] = [
        (s.baseline, BASELINE, "baseline", BASELINE_DASH)
    ]
    if s.final is not None:
        runs.append((s.final, FINAL, "final model", ()))
    panels = list[LinePanel]()
    for c, (channel, unit) in enumerate(channel_units(discovery).items()):
        scale, read = readable(1.0, unit)
        panels += run_panels(
            f"{channel} [{read}]",
            f"error [{read}]",
            scale * s.measured[:, c],
            [Line(label, colour, scale * run[:, c], dash=dash) for run, colour, label, dash in runs],
            2 * scale * discovery.noise_floor.get(channel, 0.0),
        )
    t = s.recording.t
    first, last = worst_window(discovery)
    return LineView(
        start=float(t[0]),
        Ts=s.recording.Ts,
        panels=tuple(panels),
        stretches=(Stretch("Where the baseline is worst", float(t[first]), float(t[last - 1])),),
        marks=tuple(t[s.starts[1:]].tolist()),
    )


@figure(
    "overlay",
    section="runs",
    caption=_overlay_caption,
    description="Measured and simulated outputs over time on held-out data, with their differences.",
    zoom=_overlay_view,
)
def overlay(discovery: SearchResult) -> Figure:
    """Measured and simulated outputs on held-out data, with errors; the worst window enlarged."""
    s, by_channel = shown(discovery), channel_units(discovery)
    first, last = worst_window(discovery)
    t = s.recording.t
    # Of a long recording, only the part around the worst window is drawn.
    most = round(OVERLAY_SECONDS / s.recording.Ts)
    begin = max(0, min(first - most // 2, len(t) - most))
    whole, zoom = slice(begin, min(len(t), begin + most)), slice(first, last)
    figure = blank(10.0, 3.1 * len(by_channel) + 0.5)
    grid = figure.subplots(
        2 * len(by_channel),
        2,
        sharex="col",
        squeeze=False,
        width_ratios=(1.7, 1.0),
        height_ratios=(1.5, 1.0) * len(by_channel),
    )
    for c, (channel, unit) in enumerate(by_channel.items()):
        scale, read = readable(1.0, unit)
        for column, part in enumerate((whole, zoom)):
            above, below = grid[2 * c, column], grid[2 * c + 1, column]
            _lines(above, below, s, c, part, scale)
            floor = scale * discovery.noise_floor.get(channel, 0.0)
            if floor:
                below.axhspan(-2 * floor, 2 * floor, color=FAINT, lw=0, label="± 2 σ of the sensor")
            above.set_ylabel(f"{channel} [{read}]")
            below.set_ylabel(f"error [{read}]")
        for row in (2 * c, 2 * c + 1):
            grid[row, 0].axvspan(t[first], t[last - 1], color=HIGHLIGHT, lw=0, zorder=0)
    for ax in grid[-1]:
        ax.set_xlabel("time [s]")
    grid[0, 0].set_title(f"held-out recording, restarted every {discovery.baseline.window_seconds:g} s")
    grid[0, 1].set_title("where the baseline is worst")
    figure.align_ylabels(grid[:, 0])
    figure.align_ylabels(grid[:, 1])
    legend_above(figure, grid.ravel())
    return figure


def _lines(above: Axes, below: Axes, s: Shown, c: int, part: slice, scale: float) -> None:
    t = s.recording.t[part]
    measured = scale * s.measured[part, c]
    above.plot(*thinned(t, measured), color=MEASURED, lw=2.6, label="measured", solid_capstyle="round")
    runs = [(s.baseline, BASELINE, "baseline", 1.0)]
    if s.final is not None:
        runs.append((s.final, FINAL, "final model", 1.1))
    for values, colour, label, width in runs:
        run = scale * values[part, c]
        line: Any = BASELINE_LINE if label == "baseline" else "-"
        above.plot(*thinned(t, run), color=colour, ls=line, lw=width, label=label)
        below.plot(*thinned(t, measured - run), color=colour, ls=line, lw=0.9)
    above.margins(x=0)


@figure(
    "spectra",
    section="runs",
    caption="Where a line lies on the dashed one, nothing is left to explain at these frequencies.",
    description="Spectral density of the held-out error, with the level of white sensor noise.",
)
def spectra(discovery: SearchResult) -> Figure:
    """Amplitude spectral density of the held-out error, before and after, with the sensor noise."""
    s, by_channel = shown(discovery), channel_units(discovery)
    Ts, N = s.recording.Ts, s.recording.N
    figure = blank(10.0, 3.3)
    axes = figure.subplots(1, len(by_channel), squeeze=False)[0]
    for c, (ax, (channel, unit)) in enumerate(zip(axes, by_channel.items(), strict=True)):
        scale, read = readable(1.0, unit)
        runs = [(s.baseline, BASELINE, "baseline")]
        if s.final is not None:
            runs.append((s.final, FINAL, "final model"))
        f = np.zeros(0)
        for run, colour, label in runs:
            error = scale * (s.measured[:, c] - run[:, c])
            # Welch's method averages nine or more segments that overlap by half.
            length = min(4096, max(16, N // 5))
            f, density = scipy.signal.welch(error, 1 / Ts, nperseg=length, detrend="constant")
            size = np.sqrt(np.maximum(density, np.finfo(float).tiny))
            line: Any = BASELINE_LINE if label == "baseline" else "-"
            ax.loglog(f[1:], size[1:], color=colour, ls=line, lw=1.3, label=label)
        floor = discovery.noise_floor.get(channel, 0.0)
        if floor > 0:
            level = scale * floor * np.sqrt(2 * Ts)
            ax.axhline(level, color=NOISE, lw=1.1, ls=(0, (4, 2)), label="white sensor noise")
            ax.set_ylim(level / 8, max(ax.get_ylim()[1], 12 * level))
        ax.set_xlim(f[1], f[-1])
        ax.set_title(channel)
        ax.set_xlabel("frequency [Hz]")
        ax.set_ylabel(f"density of the error [{read}/√Hz]")
    legend_above(figure, axes)
    return figure


def _over_motion(discovery: SearchResult, explanation: Explanation) -> str:
    better = explanation.latent is not None and explanation.latent.after is not None
    return (
        "The torque that would have to be added at each port for the model to follow what was "
        "measured (Kalman smoother). Shaded: 95 % band of the mean; grey: spread of single samples. "
        "Damper and spring of a fitted model take over the slope of what is missing; the panels "
        "marked + add this part again: "
        + (
            "what they have more than in the final model, whose own torque (dashed) should be flat."
            if better
            else "the whole torque of the damper."
        )
    )


@figure(
    "latent",
    section="torque",
    caption=_over_motion,
    description="Mean of the unknown torque at each port over its speed and position, with bands.",
)
def latent_over_motion(discovery: SearchResult, explanation: Explanation) -> Figure | None:
    """The missing torque at each port over speed and position; None if it was not computed."""
    latent = explanation.latent
    return latent_maps(latent.before, latent.after) if latent else None


def _over_time(discovery: SearchResult, explanation: Explanation) -> str:
    # The last of several recordings is drawn, which is a validation recording.
    several = explanation.latent is not None and len(explanation.latent.before.Ts) > 1
    return (
        f"The same torques in time, on {'held-out data' if several else 'a fitted recording'}, and by "
        "frequency. Fast changes are below the noise of the sensor, so a jump looks rounded."
    )


@figure(
    "latent_time",
    section="torque",
    caption=_over_time,
    description="The unknown torque at each port over time with its band, and its spectrum.",
)
def latent_over_time(discovery: SearchResult, explanation: Explanation) -> Figure | None:
    """The missing torque at each port over time and frequency; None if it was not computed."""
    latent = explanation.latent
    return latent_time(latent.before, latent.after) if latent else None


@figure(
    "learned",
    section="learned_torque",
    caption="Left: the learned torque at each position and speed, grey where the recordings have hardly "
    "been. Right of it: a cut along each axis with its 95 % band. What damper, spring or an "
    "offset of the model could give is left out of map and formula alike.",
    description="Map of the learned torque over position and speed, with cuts and the formula.",
)
def learned_torque(discovery: SearchResult, explanation: Explanation) -> Figure | None:
    """The learned torque; None if there is none, or if it was not kept."""
    learned = explanation.learned
    return learned_figure(learned) if learned and learned.kept else None
