"""The page of a comparison and its figures: ranking, best runs of each family, horizons, spectra."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rotflex_jax.compare.table import Comparison, Row
from rotflex_jax.recording import Recording
from rotflex_jax.text.colours import BASELINE, FAINT, FINAL, FURTHER, HIGHLIGHT, MEASURED, NOISE
from rotflex_jax.text.markup import as_json, fill_template, write_files
from rotflex_jax.text.numbers import multiple, plain_number, readable, together
from rotflex_jax.text.plotting import FigureRegistry, blank, by_section, legend_above, plain_ticks, thinned

# Longest part of a recording that is shown [s], and largest number of swings in it; errors are always for the
# whole recording.
COMPARED_SECONDS, COMPARED_CROSSINGS = 10.0, 60
# The sensor noise has a line in the ranking if the least error is less than this factor above it.
NOISE_LINE_RANGE = 100.0
# Colours by rank; dashes and markers distinguish the methods without colour.
COLOURS = (FINAL, BASELINE, *FURTHER)
DASHES = ("-", (0, (6, 1.5)), (0, (3, 1.5)), (0, (6, 1.5, 1.2, 1.5)), (0, (1.2, 1.2)), (0, (9, 3)))
MARKERS = "os^Dvx"
Style = tuple[str, object, str]

FIGURES = FigureRegistry()


def line_styles(comparison: Comparison) -> list[tuple[Row, Style]]:
    """The best method of each family with its colour, dashes and marker."""
    rows = comparison.best_of_each_family
    return [(row, (COLOURS[k % 6], DASHES[k % 6], MARKERS[k % 6])) for k, row in enumerate(rows)]


def _ranks_caption(comparison: Comparison) -> str:
    return (
        "Dots: one free run over all held-out data. Diamonds: free runs that are restarted every "
        f"{comparison.window_seconds:g} s. A dot far right of its own diamond drifts. "
        "Bold: best of its family."
    )


@FIGURES.figure(
    "ranks",
    section="How the methods rank",
    caption=_ranks_caption,
    description="Error of every method on a logarithmic scale.",
)
def ranks(comparison: Comparison) -> Figure:
    """Error of every method relative to the standard deviation of the measurement."""
    rows = [row for row in comparison.rows if row.status == "ok"]
    by_channel = comparison.units
    figure = blank(10.0, 0.9 + 0.23 * len(rows))
    axes = figure.subplots(1, len(by_channel), sharey=True, squeeze=False)[0]
    places = -np.arange(len(rows))
    best = {row.method for row in comparison.best_of_each_family}
    for ax, channel in zip(axes, by_channel, strict=True):
        std = float(np.std(np.concatenate([r.channel(channel)[r.n_init :] for r in comparison.test])))
        whole = np.array([100 * row.rmse[channel] / std for row in rows])
        short = np.array([100 * row.rmse_windows[channel] / std for row in rows])
        ax.hlines(places, np.minimum(whole, short), np.maximum(whole, short), color=FAINT, lw=2.5)
        ax.plot(whole, places, "o", color=FINAL, ms=5.5, label="one run over all of it")
        ax.plot(
            short,
            places,
            "D",
            color=BASELINE,
            ms=4.0,
            mfc="white",
            label=f"runs of {comparison.window_seconds:g} s",
        )
        floor = 100 * comparison.noise_floor.get(channel, 0.0) / std
        if floor * NOISE_LINE_RANGE > min([*whole, *short], default=0.0):
            ax.axvline(floor, color=NOISE, lw=1.1, ls=(0, (4, 2)), label="sensor noise")
        elif floor > 0:  # with a line, the errors would be squeezed into a corner of the picture
            text = f"sensor noise {floor:.1g} %, off to the left"
            ax.text(0.01, 0.01, text, transform=ax.transAxes, color=NOISE, fontsize="small")
        ax.axvline(100, color=MEASURED, lw=0.9, ls=":", label="no better than the mean")
        ax.set_xscale("log")
        plain_ticks(ax.xaxis)
        ax.set_title(channel)
        ax.set_xlabel("rms error [% of the standard deviation]")
        ax.set_ylim(-len(rows) + 0.4, 0.6)
    axes[0].set_yticks(places, [row.method for row in rows])
    for label, row in zip(axes[0].get_yticklabels(), rows, strict=True):
        label.set_fontweight("bold" if row.method in best else "normal")
    legend_above(figure, axes, columns=4)
    return figure


@FIGURES.figure(
    "overlays",
    section="Measured and simulated",
    caption="The best method of each family. The pale stripe at the start is all of the outputs that a "
    "method is given; the grey band is what the sensor alone makes. The worst line may leave the picture.",
    description="Measured and simulated outputs over time on held-out data, with their differences.",
)
def overlays(comparison: Comparison) -> Figure:
    """Measured and simulated outputs of the best method of each family, with their errors."""
    i, by_channel = comparison.longest_test, comparison.units
    r, shown = comparison.test[i], line_styles(comparison)
    part = slice(0, drawn(r))
    figure = blank(10.0, 3.3 * len(by_channel) + 0.6)
    axes = figure.subplots(
        2 * len(by_channel), 1, sharex=True, squeeze=False, height_ratios=(1.5, 1.1) * len(by_channel)
    )[:, 0]
    for c, (channel, unit) in enumerate(by_channel.items()):
        scale, read = readable(1.0, unit)
        above, below = axes[2 * c], axes[2 * c + 1]
        y = scale * r.y[part, c]
        above.plot(*thinned(r.t[part], y), color=MEASURED, lw=3.2, label="measured", solid_capstyle="round")
        largest = []
        for row, (colour, dash, _) in shown:
            run = scale * row.simulated[i][part, c]
            above.plot(
                *thinned(r.t[part], run), color=colour, ls=dash, lw=1.2, label=f"{row.method} ({row.family})"
            )
            below.plot(*thinned(r.t[part], y - run), color=colour, ls=dash, lw=1.0)
            largest.append(float(np.max(np.abs(y - run))))
        floor = scale * comparison.noise_floor.get(channel, 0.0)
        if floor:
            below.axhspan(-2 * floor, 2 * floor, color=FAINT, lw=0, label="± 2 σ of the sensor")
        if largest:
            _within(above, y, max(np.ptp(y), 1e-12))
            # The worst run may leave the picture; otherwise the better ones could not be distinguished.
            half = 1.1 * max(np.sort(largest)[: max(2, len(largest) - 1)].max(), 4 * floor)
            below.set_ylim(-half, half)
        above.set_ylabel(f"{channel} [{read}]")
        below.set_ylabel(f"error [{read}]")
        above.margins(x=0)
    axes[-1].set_xlabel("time [s]")
    axes[0].axvspan(r.t[0], r.t[min(r.n_init, r.N - 1)], color=HIGHLIGHT, lw=0, zorder=0)
    figure.align_ylabels(axes)
    legend_above(figure, axes, columns=4)
    return figure


def drawn(recording: Recording) -> int:
    """Number of samples that are drawn, so that single swings can be seen."""
    most = min(recording.N, round(COMPARED_SECONDS / recording.Ts))
    away = recording.y[:most, 0] - recording.y[:most, 0].mean()
    # Only swings count: near the mean, noise crosses it at every sample.
    swings = np.flatnonzero(np.abs(away) > 0.5 * away.std())
    turns = swings[1:][np.diff(away[swings] > 0)]
    return (
        most
        if len(turns) < COMPARED_CROSSINGS
        else max(recording.n_init + 2, int(turns[COMPARED_CROSSINGS - 1]))
    )


def _within(ax: Axes, y: np.ndarray, margin: float) -> None:
    low, high = ax.get_ylim()
    ax.set_ylim(max(low, y.min() - margin), min(high, y.max() + margin))


@FIGURES.figure(
    "horizons",
    section="How far ahead",
    caption="Many short free runs, started all over the held-out data: how the error grows with the time "
    "since the last sample that was seen. A line that stays low can be trusted for long.",
    description="Error against horizon on logarithmic scales.",
)
def horizons(comparison: Comparison) -> Figure:
    """Error of free runs against the horizon, for the best method of each family."""
    by_channel, figure = comparison.units, blank(10.0, 3.6)
    axes = figure.subplots(1, len(by_channel), squeeze=False)[0]
    for ax, (channel, unit) in zip(axes, by_channel.items(), strict=True):
        scale, read = readable(1.0, unit)
        for row, (colour, dash, marker) in line_styles(comparison):
            if row.horizon is not None:
                e = scale * np.array(row.horizon.rmse[channel])
                ax.loglog(
                    row.horizon.seconds,
                    e,
                    color=colour,
                    ls=dash,
                    lw=1.3,
                    marker=marker,
                    ms=3.5,
                    label=f"{row.method} ({row.family})",
                )
        floor = scale * comparison.noise_floor.get(channel, 0.0)
        if floor > 0:
            ax.axhline(floor, color=NOISE, lw=1.1, ls=(0, (4, 2)), label="sensor noise")
        ax.set_title(channel)
        ax.set_xlabel("time since the last sample seen [s]")
        ax.set_ylabel(f"rms error [{read}]")
        plain_ticks(ax.xaxis)
        plain_ticks(ax.yaxis)
    legend_above(figure, axes, columns=4)
    return figure


@FIGURES.figure(
    "spectra",
    section="What is left, by frequency",
    caption="Where a line lies on the dashed one, nothing is left to explain at these frequencies.",
    description="Spectral density of the held-out error, with the level of white sensor noise.",
)
def spectra(comparison: Comparison) -> Figure:
    """Amplitude spectral density of the held-out error of the best method of each family."""
    i, by_channel = comparison.longest_test, comparison.units
    r, figure = comparison.test[i], blank(10.0, 3.6)
    axes = figure.subplots(1, len(by_channel), squeeze=False)[0]
    for c, (ax, (channel, unit)) in enumerate(zip(axes, by_channel.items(), strict=True)):
        scale, read = readable(1.0, unit)
        begin, f = r.n_init, np.zeros(2)
        length = min(4096, max(16, (r.N - begin) // 5))
        for row, (colour, dash, _) in line_styles(comparison):
            e = scale * (r.y - row.simulated[i])[begin:, c]
            f, density = scipy.signal.welch(e, 1 / r.Ts, nperseg=length, detrend="constant")
            size = np.sqrt(np.maximum(density, np.finfo(float).tiny))
            ax.loglog(f[1:], size[1:], color=colour, ls=dash, lw=1.3, label=f"{row.method} ({row.family})")
        floor = scale * comparison.noise_floor.get(channel, 0.0)
        if floor > 0:
            level = floor * np.sqrt(2 * r.Ts)
            ax.axhline(level, color=NOISE, lw=1.1, ls=(0, (4, 2)), label="white sensor noise")
            ax.set_ylim(level / 8, max(ax.get_ylim()[1], 12 * level))
        ax.set_xlim(f[1], f[-1])
        ax.set_title(channel)
        ax.set_xlabel("frequency [Hz]")
        ax.set_ylabel(f"density of the error [{read}/√Hz]")
    legend_above(figure, axes, columns=4)
    return figure


# An error within this factor of the least error of its column is marked.
NEAR_BEST = 1.05


def write(comparison: Comparison, folder: Path) -> Path:
    """Write `comparison.html` and `comparison.json`; return the path of the page."""
    files = {"comparison.json": as_json(comparison.to_dict()), "comparison.html": render(comparison)}
    write_files(folder, files)
    return folder / "comparison.html"


def render(comparison: Comparison) -> str:
    """The page as text."""
    return fill_template("rotflex_jax.compare", "comparison.html.j2", content(comparison))


def content(comparison: Comparison) -> dict[str, Any]:
    """Values for the template; plain text that the template escapes."""
    units = comparison.units
    good = [row for row in comparison.rows if row.status == "ok"]
    colours = {row.method: style[0] for row, style in line_styles(comparison)}
    return {
        "summary": _summary(comparison),
        "seconds": f"{comparison.window_seconds:g}",
        "headings": [f"{c} [{readable(1.0, u)[1]}]" for c, u in units.items()],
        "rows": [_row(row, units, good, colours) for row in good],
        "noise": [plain_number(readable(comparison.noise_floor[c], u)[0]) for c, u in units.items()],
        "bad": [
            (row.method, row.title, row.status, together(row.reason))
            for row in comparison.rows
            if row.status != "ok"
        ],
        "notes": [(row.method, row.title, together(row.note)) for row in good],
        "pictures": by_section(FIGURES.pictures(comparison).values()) if good else {},
        "recordings": [
            {
                "use": use,
                "source": r.source,
                "span": f"{r.start:g} to {r.start + r.duration:g} s",
                "samples": f"{r.N}, of which a model may see the first {r.n_init}",
            }
            for use, listed in (("fitted", comparison.train), ("held out", comparison.test))
            for r in listed
        ],
        "elapsed": f"{comparison.elapsed_s:.0f}",
        "source": next((r.source for r in comparison.test if r.source), ""),
    }


def _summary(comparison: Comparison) -> str:
    best = comparison.best
    if best is None:
        return "No method gave a result: each failed, or its free run left the measured range."
    units = comparison.units
    said = []
    for c, u in units.items():
        value, read = readable(best.rmse[c], u)
        floor = comparison.noise_floor.get(c, 0.0)
        times = f", {multiple(best.rmse[c] / floor)} times the noise of the sensor" if floor > 0 else ""
        said.append(f"{c} {plain_number(value)} {read}{times}")
    others = [row.method for row in comparison.best_of_each_family[1:]]
    tail = f" Best of the other families: {', '.join(others)}." if others else ""
    return (
        f"Closest in one free run over the held-out data is {best.method}, {best.title}: "
        f"{'; '.join(said)} rms.{tail}"
    )


def _row(row: Row, units: dict[str, str], good: list[Row], colours: dict[str, str]) -> dict[str, Any]:
    def cells(name: str, marked: bool = True) -> list[dict[str, Any]]:
        made = []
        for c, u in units.items():
            value = getattr(row, name).get(c, math.nan)
            least = min(
                (e for r in good if math.isfinite(e := getattr(r, name).get(c, math.nan))), default=math.nan
            )
            made.append(
                {
                    "value": plain_number(readable(value, u)[0]) if math.isfinite(value) else "–",
                    "best": marked and math.isfinite(value) and value <= NEAR_BEST * least,
                }
            )
        return made

    return {
        "method": row.method,
        "title": row.title,
        "family": row.family,
        "colour": colours.get(row.method, ""),
        "whole": cells("rmse"),
        "windows": cells("rmse_windows"),
        "worst": cells("worst"),
        "step": cells("rmse_one_step"),
        "nrmse": [plain_number(row.nrmse[c], 2) if math.isfinite(row.nrmse[c]) else "–" for c in units],
        "fit": [f"{row.fit_percent[c]:.1f}" if math.isfinite(row.fit_percent[c]) else "–" for c in units],
        "parameters": row.parameters,
        "fit_s": plain_number(row.fit_seconds, 3),
        "run_ms": plain_number(1e3 * row.simulate_seconds, 3) if row.simulate_seconds is not None else "–",
    }
