"""Figures of where the error lives: a map over speed and deflection, and one profile per place."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from rotflex_jax.discover.looks import half_width
from rotflex_jax.discover.result import Discovery, Where
from rotflex_jax.report.runs import shown
from rotflex_jax.report.style import BASELINE, FAINT, INK, MUTED, blank, legend_above, styled
from rotflex_jax.report.wording import readable, units

CELLS, FEWEST = 13, 8
MOST_PROFILES = 6

_AXES = {
    "speed": "speed of {turning}",
    "deflection": "{bending}",
    "reversal": "time since a reversal",
    "time": "time",
    "frequency": "frequency",
}


def worst_channel(discovery: Discovery) -> str:
    """The channel whose baseline error is the largest multiple of its noise."""
    errors, floor = discovery.baseline.held_out_rmse_windows, discovery.noise_floor
    return max(errors, key=lambda c: errors[c] / (floor.get(c) or errors[c] or 1.0))


@styled
def residual_map(discovery: Discovery) -> Figure:
    """Error over speed and deflection (a single channel: over speed and time), before and after."""
    s, by_channel = shown(discovery), units(discovery)
    channels = list(by_channel)
    channel = worst_channel(discovery)
    c, turning, bending = channels.index(channel), channels[0], channels[min(1, len(channels) - 1)]
    speed, speed_label = _speed(discovery, turning)
    if len(channels) > 1:
        scale, read = readable(1.0, by_channel[bending])
        other, other_label = scale * s.measured[:, 1], f"{bending} [{read}]"
    else:
        other, other_label = s.recording.t, "time [s]"
    scale, read = readable(1.0, by_channel[channel])
    stages = [("baseline", s.baseline)]
    if s.final is not None:
        stages.append(("final model", s.final))
    edges = [np.linspace(*np.quantile(x, (0.003, 0.997)), CELLS + 1) for x in (speed, other)]
    edges = [e if e[-1] > e[0] else np.linspace(-1, 1, CELLS + 1) + e[0] for e in edges]
    count = np.histogram2d(speed, other, edges)[0]
    maps = []
    for _, run in stages:
        energy = (scale * (s.measured[:, c] - run[:, c])) ** 2
        total = np.histogram2d(speed, other, edges, weights=energy)[0]
        rms = np.sqrt(total / np.maximum(count, 1))
        maps.append(np.ma.masked_where(count < FEWEST, rms))
    filled = np.ma.concatenate([m.ravel() for m in maps]).compressed()
    high = float(filled.max()) if len(filled) and filled.max() > 0 else 1.0
    floor = scale * discovery.noise_floor.get(channel, 0.0)
    norm = LogNorm(max(min(floor or high, high) / 1.5, high / 3e3), max(high, 1.5 * floor))
    figure = blank(10.0 if len(stages) > 1 else 6.5, 3.7)
    axes = figure.subplots(1, len(stages), squeeze=False, sharey=True)[0]
    mesh = None
    for ax, (label, _), values in zip(axes, stages, maps, strict=True):
        mesh = ax.pcolormesh(*edges, values.T, norm=norm, cmap="YlOrRd", edgecolors="face", lw=0.2)
        ax.set_facecolor("#f6f7f9")
        ax.grid(False)
        ax.set_title(f"{channel} error, {label}")
        ax.set_xlabel(speed_label)
        ax.label_outer()
    axes[0].set_ylabel(other_label)
    if mesh is not None:
        bar = figure.colorbar(mesh, ax=axes.tolist(), pad=0.015, aspect=26)
        bar.set_label(f"rms error [{read}]")
        bar.outline.set_visible(False)  # type: ignore[operator]
    return figure


def _speed(discovery: Discovery, channel: str) -> tuple[np.ndarray, str]:
    from scipy.signal import savgol_filter

    s = shown(discovery)
    unit = units(discovery)[channel]
    y = s.measured[:, list(units(discovery)).index(channel)]
    half = half_width(s.recording) or 3
    rate = unit if unit.endswith("/s") else f"{unit}/s"
    order = 0 if unit.endswith("/s") else 1
    scale, read = readable(1.0, rate)
    speed = scale * savgol_filter(y, 2 * half + 1, 2, deriv=order, delta=s.recording.Ts)
    return np.asarray(speed), f"speed of {channel} [{read}]"


@styled
def profiles(discovery: Discovery) -> Figure | None:
    """Share of the error in each bin against the share of the time, one panel per place."""
    places = [w for w in discovery.where if len(w.edges) > 1][:MOST_PROFILES]
    if not places:
        return None
    columns = min(3, len(places))
    rows = -(-len(places) // columns)
    figure = blank(10.0 if columns > 1 else 5.0, 2.6 * rows + 0.4)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, place in zip(axes, places, strict=False):
        _profile(ax, place, discovery)
    for ax in axes[len(places) :]:
        ax.remove()
    legend_above(figure, axes[: len(places)])
    return figure


def _profile(ax: Axes, place: Where, discovery: Discovery) -> None:
    channels = list(discovery.noise_floor) or [place.channel]
    names = {"turning": channels[0], "bending": channels[min(1, len(channels) - 1)]}
    scale, read = readable(1.0, place.unit)
    shares, expected = 100 * place.profile, 100 * place.expected
    if place.kind in ("speed", "deflection", "time"):
        left, right = scale * place.edges[:-1], scale * place.edges[1:]
        steps = np.append(scale * place.edges[:-1], scale * place.edges[-1])
    else:
        left, right = np.arange(len(shares)) * 1.0, np.arange(len(shares)) + 1.0
        steps = np.arange(len(shares) + 1.0)
        _name_bins(ax, place)
    width = 0.86 * (right - left)
    ax.bar(
        (left + right) / 2, shares, width, color=BASELINE, alpha=0.85, label="share of the error"
    )
    ax.stairs(expected, steps, color=INK, lw=1.4, label="if it were spread evenly")
    ax.grid(axis="x", visible=False)
    ax.set_title(f"{place.channel} error")
    ax.set_xlabel(f"{_AXES[place.kind].format(**names)} [{read}]")
    ax.set_ylabel("share [%]")
    ax.set_xlim(steps[0], steps[-1])
    ax.set_ylim(bottom=0)


def _name_bins(ax: Axes, place: Where) -> None:
    """Bins of unequal width are drawn equally wide, with their edges written below."""
    scale = 1.0
    texts = [f"{scale * e:.3g}" for e in place.edges]
    if place.kind == "frequency":  # the first band is the constant part
        texts[0], texts[1] = "const.", ""
    if len(texts) == len(place.profile) + 1 and place.kind == "reversal":
        texts[-1] = texts[-1]
    keep = 1 if len(texts) <= 9 else 2
    shown_texts = [t if k % keep == 0 or t == "const." else "" for k, t in enumerate(texts)]
    ax.set_xticks(np.arange(len(texts)), shown_texts)
    ax.xaxis.set_minor_formatter(FuncFormatter(lambda *_: ""))
    ax.tick_params(axis="x", length=2)


__all__ = ["FAINT", "MUTED", "profiles", "residual_map", "worst_channel"]
