"""The figures of the paper, drawn again: 7 and 8 the signals, 9 the coefficient, 10 and 11 the pulse."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rotflex_jax.report.figures import Picture
from rotflex_jax.report.kernels import kernel_figure
from rotflex_jax.report.style import (
    BASELINE,
    FINAL,
    INK,
    MEASURED,
    MUTED,
    blank,
    legend_above,
    plain_ticks,
    styled,
)
from rotflex_jax.reproduce import signals
from rotflex_jax.reproduce.captions import captions
from rotflex_jax.reproduce.experiment import Reproduction
from rotflex_jax.reproduce.runs import SHOWN, figure_10, figure_11, readable_unit
from rotflex_jax.reproduce.span import reach


@styled
def figure_7(result: Reproduction) -> Figure:
    """The input over time, and how its samples hang together."""
    s, first = result.settings, result.records.train[0]
    figure = blank(10.0, 2.7)
    left, right = figure.subplots(1, 2, width_ratios=(2.4, 1))
    part = first.t - first.start < SHOWN
    left.step(first.t[part], first.u[part], where="post", color=INK, lw=1.0)
    left.set(xlabel="time [s]", ylabel=f"{first.input_name} [{first.input_unit}]", title="input, first part")
    lags = np.arange(9)
    u = first.u - first.u.mean() if result.records.measured else first.u
    seen = [float(np.mean(u[: len(u) - k] * u[k:])) for k in lags if k < len(u)]
    right.bar(lags[: len(seen)], seen, width=0.55, color=MEASURED, label="this record")
    if not result.records.measured:
        right.plot(lags, signals.autocovariance(s, 9), "k_", ms=13, mew=1.8, label="filter")
    right.set(xlabel="lag [samples]", ylabel="autocovariance [V²]", title="how samples hang together")
    right.legend()
    return figure


@styled
def figure_8(result: Reproduction) -> Figure:
    """The output over time."""
    first, (scale, unit) = result.records.train[0], readable_unit(result)
    figure = blank(10.0, 2.5)
    ax = figure.subplots()
    part = first.t - first.start < SHOWN
    ax.plot(
        first.t[part], scale * first.channel(result.records.channel)[part], ".-", color=INK, lw=0.8, ms=3.5
    )
    ax.set(xlabel="time [s]", ylabel=f"{result.records.channel} [{unit}]", title="output, the same part")
    return figure


@styled
def figure_9(result: Reproduction) -> Figure:
    """The watched coefficient: runs, their mean, the prediction; beside it a symmetric machine."""
    a, unit = result.adaptation, f"10⁻³ {result.records.unit}/V²"
    twin = a.symmetric
    figure = blank(10.0, 3.6)
    widths = (1.0,) if twin is None else (1.7, 1.0)
    axes = np.atleast_1d(figure.subplots(1, len(widths), sharey=True, width_ratios=widths))
    ax = axes[0]
    one = "single runs" if len(a.paths) > 1 else "this run"
    for number, path in enumerate(a.paths):
        ax.plot(a.times, 1e3 * path, color=MEASURED, lw=0.7, label=None if number else one)
    if len(a.paths) > 1:
        ax.plot(
            a.times, 1e3 * np.mean(a.paths, axis=0), color=FINAL, lw=2.2, label=f"mean of {len(a.paths)} runs"
        )
    ax.plot(a.times, 1e3 * a.mean_path, color=BASELINE, lw=1.6, ls=(0, (5, 1.5)), label="predicted mean")
    ax.axhline(1e3 * a.target, color=INK, lw=1.0, ls=(0, (1, 1.5)), label="least squares")
    if a.prediction.settle <= a.times[-1]:
        _mark(ax, a.prediction.settle, f"predicted\n{a.prediction.settle:,.0f}".replace(",", " "), 0.06)
    if a.settle is not None and a.settle <= a.times[-1]:
        _mark(ax, a.settle, f"measured\n{a.settle:,.0f}".replace(",", " "), 0.27)
    name = "$h_2$({}, {})".format(*result.settings.coefficient)
    ax.set(xlabel="iterations", ylabel=f"{name} [{unit}]", title=_verdict(result))
    if twin is not None:
        other = axes[1]
        other.plot(a.times, 1e3 * twin, color=MEASURED, lw=0.7)
        other.axhline(0.0, color=INK, lw=1.0, ls=(0, (1, 1.5)))
        other.set(xlabel="iterations", title="symmetric friction: it is zero, this is noise")
    for each in axes:
        plain_ticks(each.xaxis)
        each.set_xlim(0, a.times[-1])
    legend_above(figure, axes)
    return figure


def _verdict(result: Reproduction) -> str:
    a = result.adaptation
    if a.status != "ok":
        return f"the filter {a.status}"
    if a.settle is None:
        return "too short a run" if a.prediction.settle > a.times[-1] else "no value to settle on"
    off = a.settle / a.prediction.settle - 1
    return f"settles {abs(off):.0%} {'later' if off > 0 else 'earlier'} than predicted"


def _mark(ax: Axes, x: float, text: str, height: float) -> None:
    ax.axvline(x, color=MUTED, lw=0.9)
    note = ax.annotate(
        text,
        (x, height),
        xycoords=("data", "axes fraction"),
        xytext=(-4, 0),
        textcoords="offset points",
        ha="right",
        va="bottom",
        fontsize=8,
        color=INK,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.85},
    )
    note.set_in_layout(False)


@styled
def figure_span(result: Reproduction) -> Figure:
    """Least error of any linear model with this memory, over the sampling interval."""
    s, joint = result.settings, result.records.joint
    intervals = np.geomspace(1e-3, 0.2, 70)
    figure = blank(10.0, 2.9)
    ax = figure.subplots()
    ax.plot(1e3 * intervals, reach(s, joint, intervals, white=True), color=FINAL, lw=2.0, label="white input")
    coloured = reach(s, joint, intervals)
    ax.plot(
        1e3 * intervals,
        coloured,
        color=BASELINE,
        lw=1.6,
        ls=(0, (5, 1.5)),
        label=f"input below {s.cutoff:g} Hz",
    )
    ax.axhline(0.01, color=MUTED, lw=0.8, ls=(0, (1, 1.5)))
    ax.annotate("1 %", (1.0, 0.01), xytext=(2, 3), textcoords="offset points", fontsize=8, color=MUTED)
    ax.axvline(1e3 * result.records.Ts, color=INK, lw=1.0)
    ax.annotate(
        f"this run: {1e3 * result.records.Ts:g} ms",
        (1e3 * result.records.Ts, 0.9),
        xytext=(-4, 0),
        textcoords="offset points",
        ha="right",
        va="top",
        fontsize=8,
        xycoords=("data", "axes fraction"),
    )
    ax.set(
        xscale="log", yscale="log", ylim=(1e-5, 2), xlabel="sampling interval [ms]", ylabel="least NMSE [-]"
    )
    ax.set_title(f"what {s.memory} samples can span of a linear joint")
    plain_ticks(ax.xaxis)
    legend_above(figure, [ax])
    return figure


@styled
def figure_trap(result: Reproduction) -> Figure | None:
    """Online, frozen and least-squares error where the memory is far too short."""
    t = result.trap
    if t is None:
        return None
    figure = blank(6.5, 2.0)
    ax = figure.subplots()
    bars = {
        "online, while it learns": t.online,
        "least squares, held out": t.least_squares,
        "LMS frozen, held out": t.frozen,
    }
    colours = (MEASURED, FINAL, BASELINE)
    drawn = ax.barh(list(bars), list(bars.values()), height=0.62, color=colours)
    ax.bar_label(drawn, [f"{value:.3g}" for value in bars.values()], padding=4, fontsize=8.5)
    ax.axvline(1.0, color=INK, lw=1.0, ls=(0, (1, 1.5)))
    ax.set(xlabel="NMSE [-]; 1 is as good as the mean", title=f"the same filter at {1e3 * t.Ts:g} ms")
    ax.set_xlim(0, 1.15 * max(1.0, *bars.values()))
    ax.invert_yaxis()
    ax.grid(axis="y", visible=False)
    return figure


def figure_kernels(result: Reproduction) -> Figure | None:
    """Kernels of the machine's equations beside those identified from its data."""
    b = result.bridge
    return None if b is None else kernel_figure(b.physics, b.data, names=("physics", "data"))


def pictures(result: Reproduction) -> dict[str, Picture]:
    """Figures by file name, each with a caption that says what is assumed."""
    drawn = {
        "figure_07": figure_7(result),
        "figure_08": figure_8(result),
        "figure_09": figure_9(result),
        "figure_10": figure_10(result),
        "figure_11": figure_11(result),
        "span": figure_span(result),
        "trap": figure_trap(result),
        "kernels": figure_kernels(result),
    }
    words = captions(result)
    return {name: Picture(figure, *words[name]) for name, figure in drawn.items() if figure is not None}
