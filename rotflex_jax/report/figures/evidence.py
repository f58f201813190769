"""Figures of the evidence: ranking of the candidates, held-out errors, parameters."""

import math
import textwrap

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator

from rotflex_jax.discover.probabilities import LEAST_NAMED, parts, set_labels
from rotflex_jax.discover.result import SearchResult
from rotflex_jax.discover.tables import Outcome, channel_units, noise_ratios, outcomes, stage_labels
from rotflex_jax.effects.labels import effect_label
from rotflex_jax.parameters import HALF_WIDTH_95, Estimate
from rotflex_jax.report.figures.registry import figure
from rotflex_jax.text.colours import FINAL, INK, MEASURED, MUTED, NOISE, stage_colours
from rotflex_jax.text.numbers import percent_probable, plain_number, readable
from rotflex_jax.text.plotting import blank, legend_above, plain_ticks

MOST_BARS = 14
# Characters of labels that stand side by side in a figure, and of the shortest line of one.
TICK_CHARACTERS, SHORTEST_LINE = 100, 14
MOST_SETS = 6


@figure(
    "probabilities",
    section="found",
    caption="Left, sets of effects that the search has fitted, each a model of its own; right, each effect "
    "with the share of that which has it. What the sets lack to 1 lies with sets that were not fitted.",
    description="Bars of the probability of each set of effects and of each effect.",
)
def probabilities(discovery: SearchResult) -> Figure | None:
    """Probabilities of the likeliest sets and effects; None if there is only one set."""
    found = discovery.probabilities
    if found is None or len(found.sets) < 2:
        return None
    listed = [s for s in found.sets if s.probability >= LEAST_NAMED][:MOST_SETS] or [found.sets[0]]
    reported = frozenset(f"{r.effect}@{r.port}" for r in discovery.rounds)
    sets = [("\n+ ".join(set_labels(s.effects)), s.probability, s.effects == reported) for s in listed]
    effects = [
        (effect_label(*parts(name)), p, name in reported)
        for name, p in list(found.effects.items())[:MOST_SETS]
        if p >= LEAST_NAMED
    ]
    lines = max(sum(label.count("\n") + 1 for label, _, _ in sets), len(effects))
    figure = blank(10.0, 0.3 * lines + 1.1)
    axes = figure.subplots(1, 2)
    for ax, bars, name in ((axes[0], sets, "set of effects [–]"), (axes[1], effects, "effect [–]")):
        for k, (_, p, is_reported) in enumerate(bars):
            ax.barh(k, p, 0.62, color=FINAL if is_reported else MEASURED, alpha=1.0 if is_reported else 0.75)
            ax.annotate(
                percent_probable(p), (p, k), (5, 0), textcoords="offset points", va="center", fontsize=8
            )
        ax.set_yticks(range(len(bars)), [label for label, _, _ in bars])
        for text, (_, _, is_reported) in zip(ax.get_yticklabels(), bars, strict=True):
            text.set_fontweight("bold" if is_reported else "normal")
        ax.set_ylim(max(len(bars), 1) - 0.4, -0.6)
        ax.set_xlim(0.0, 1.18)
        ax.set_xticks([0.0, 0.25, 0.5, 0.75, 1.0])
        ax.grid(axis="y", visible=False)
        ax.set_xlabel("probability [–]")
        ax.set_ylabel(name)
    return figure


@figure(
    "ranking",
    section="ranking",
    caption="How much likelier the training data are with each effect before any is added. An effect low "
    "in this list may be found in a later round, and a high one may only imitate another.",
    description="Bars of the score of each candidate effect.",
)
def ranking(discovery: SearchResult) -> Figure | None:
    """Score of each candidate at the baseline, coloured by its outcome in the search."""
    shown = outcomes(discovery)[:MOST_BARS]
    if not shown:
        return None
    listed = [r for r, _ in shown]
    figure = blank(10.0, 0.27 * len(listed) + 1.1)
    ax = figure.subplots()
    groups = {
        Outcome.FOUND: (FINAL, 1.0, "found"),
        Outcome.ALIKE: ("#7fb2bf", 1.0, Outcome.ALIKE.value),
        Outcome.NOT_ADDED: (MEASURED, 0.75, "not added"),
        Outcome.NOT_EXCITED: ("#dfe4e8", 1.0, "not excited by this recording"),
    }
    for k, (r, outcome) in enumerate(shown):
        colour, strength, label = groups[outcome]
        ax.barh(k, r.score, 0.72, color=colour, alpha=strength, label=label)
        ax.annotate(
            plain_number(r.score),
            (r.score, k),
            (5 if r.score >= 0 else -5, 0),
            textcoords="offset points",
            va="center",
            ha="left" if r.score >= 0 else "right",
            fontsize=8,
            color=MUTED,
        )
    ax.set_yticks(range(len(listed)), [effect_label(r.effect, r.port) for r in listed])
    for text, (r, outcome) in zip(ax.get_yticklabels(), shown, strict=True):
        text.set_color(INK if r.excited else MUTED)
        text.set_fontweight("bold" if outcome == Outcome.FOUND else "normal")
    ax.invert_yaxis()
    ax.set_ylabel("candidate effect [–]")
    ax.set_xscale("symlog", linthresh=10.0, linscale=0.6)
    ax.axvline(0.0, color=MUTED, lw=0.8)
    low, high = min(0.0, *(r.score for r in listed)), max(10.0, *(r.score for r in listed))
    ax.set_xlim(3 * low if low < -10 else low - 8 if low < 0 else 0.0, 4 * high)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("penalised score [nat], logarithmic beyond ±10")
    plain_ticks(ax.xaxis)
    handles, labels = ax.get_legend_handles_labels()
    seen = dict(zip(labels, handles, strict=True))
    present = [label for _, _, label in groups.values() if label in seen]
    figure.legend([seen[k] for k in present], present, loc="outside upper left", ncols=len(present))
    return figure


def _staircase_caption(discovery: SearchResult) -> str:
    limits = discovery.assessment.limits
    reached = [c for c, r in noise_ratios(discovery).items() if r < limits[c]]
    end = (
        f"The error of {' and '.join(reached)} ends at what the noise of the sensor causes."
        if reached
        else "What is left above the dashed line is not the sensor's noise."
    )
    return f"Each step is one effect added. {end}"


@figure(
    "staircase",
    section="errors",
    caption=_staircase_caption,
    description="Held-out error of each model on a logarithmic scale, with the noise of the sensor.",
)
def staircase(discovery: SearchResult) -> Figure | None:
    """Held-out error of every stage against the noise of the sensor; None without a round."""
    if not discovery.rounds:
        return None
    by_channel, labels = channel_units(discovery), stage_labels(discovery)
    colours = stage_colours(len(labels))
    figure = blank(10.0, 3.6)
    axes = figure.subplots(1, len(by_channel), squeeze=False)[0]
    x, width = np.arange(len(labels)), max(SHORTEST_LINE, TICK_CHARACTERS // (len(labels) * len(by_channel)))
    for ax, (channel, unit) in zip(axes, by_channel.items(), strict=True):
        scale, read = readable(1.0, unit)
        windows = [scale * s.held_out_rmse_windows[channel] for s in discovery.stages]
        whole = [scale * s.held_out_rmse[channel] for s in discovery.stages]
        seconds = discovery.baseline.window_seconds
        ax.plot(x, windows, color=MEASURED, lw=1.6, zorder=2)
        ax.plot(x + 0.08, whole, color=MEASURED, lw=1.0, ls=(0, (2, 2)), zorder=2)
        ax.scatter(x, windows, 62, c=list(colours), zorder=3)
        ax.scatter(
            x + 0.08,
            whole,
            40,
            facecolors="white",
            edgecolors=list(colours),
            linewidths=1.5,
            zorder=3,
        )
        for k, value in enumerate(windows):
            ax.annotate(
                plain_number(value),
                (k, value),
                (-7, -10),
                textcoords="offset points",
                ha="right",
                va="center",
                fontsize=8.5,
                color=INK,
                path_effects=[withStroke(linewidth=3, foreground="white")],
            )
        # Markers in the legend speak of the kind of run; their colours, of the stage.
        ax.plot([], [], "o", color=MUTED, ms=7, label=f"restarted every {seconds:g} s")
        ax.plot([], [], "o", mfc="white", color=MUTED, ms=6, mew=1.5, label="one run over all of it")
        floor = scale * discovery.noise_floor.get(channel, 0.0)
        if floor > 0:
            ax.axhline(floor, color=NOISE, lw=1.1, ls=(0, (4, 2)), label="sensor noise")
        ax.set_yscale("log")
        values = [v for v in (*windows, *whole, floor) if v > 0 and math.isfinite(v)] or [1.0]
        ax.set_ylim(min(values) / 2.2, 1.8 * max(values))
        ax.set_xlim(-0.55, len(labels) - 0.55)
        ax.set_xticks(x, [textwrap.fill(label, width, break_long_words=False) for label in labels])
        ax.tick_params(axis="x", length=0)
        for text, colour in zip(ax.get_xticklabels(), colours, strict=True):
            text.set_color(colour)
            text.set_fontweight("bold")
        wide = max(values) > 1000 * min(values)
        ax.yaxis.set_major_locator(LogLocator(subs=(1,) if wide else (1, 2, 5), numticks=20))
        plain_ticks(ax.yaxis)
        ax.grid(axis="x", visible=False)
        ax.set_title(channel)
        ax.set_xlabel("model after each round [–]")
        ax.set_ylabel(f"held-out rms error [{read}]")
    legend_above(figure, axes)
    return figure


def _comparable(discovery: SearchResult) -> dict[str, list[Estimate | None]]:
    """Name -> estimates in every stage, for free parameters that differ clearly from zero in the last one."""
    stages = [{e.name: e for e in s.estimates} for s in discovery.stages]
    last = stages[-1]
    clear = (e.name for e in last.values() if e.free and math.isfinite(e.std) and abs(e.value) > 3 * e.std)
    return {name: [s.get(name) for s in stages] for name in clear}


@figure(
    "parameters",
    section="parameters",
    caption="Missing physics biases the estimates of a model; they stop changing once it is added. "
    "Bars are 95 % intervals; parameters near zero are only in the table.",
    description="Parameters of each model relative to their final values, with intervals.",
)
def parameters(discovery: SearchResult) -> Figure | None:
    """Free parameters that differ clearly from zero, in every stage, relative to their final estimates."""
    rows = _comparable(discovery)
    if not rows:
        return None
    labels, colours = stage_labels(discovery), stage_colours(len(discovery.stages))
    figure = blank(10.0, 0.42 * len(rows) + 1.2)
    ax = figure.subplots()
    ax.axvline(0.0, color=NOISE, lw=0.9)
    spread = np.linspace(-0.22, 0.22, len(labels)) if len(labels) > 1 else [0.0]
    for k, each in enumerate(rows.values()):
        final = each[-1]
        assert final is not None  # rows are those of the final stage
        for stage, e in enumerate(each):
            if e is None or not math.isfinite(e.value):
                continue
            centre = 100 * (e.value / final.value - 1)
            half_width = 100 * HALF_WIDTH_95 * e.std / abs(final.value) if math.isfinite(e.std) else 0.0
            ax.errorbar(
                centre,
                k + spread[stage],
                xerr=half_width,
                fmt="o",
                ms=4.5,
                lw=1.6,
                capsize=2.5,
                color=colours[stage],
                label=labels[stage],
            )
    ax.set_yticks(range(len(rows)), list(rows))
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_ylabel("parameter [–]")
    ax.set_xlabel("difference from the final estimate [%]")
    ax.set_xscale("symlog", linthresh=10.0, linscale=0.8)
    if max(abs(v) for v in ax.get_xlim()) <= 12:
        ax.set_xscale("linear")
    plain_ticks(ax.xaxis)
    legend_above(figure, [ax])
    return figure
