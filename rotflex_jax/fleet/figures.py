"""Figures of the summary: how often each effect was found, errors before and after."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rotflex_jax.fleet.result import Fleet
from rotflex_jax.report.style import (
    BASELINE,
    BETWEEN,
    FAINT,
    FINAL,
    INK,
    MUTED,
    blank,
    legend_above,
    plain_ticks,
    styled,
)
from rotflex_jax.report.wording import AT_NOISE, effect_label

# Effects that are drawn, the most frequent ones.
MOST = 15
# Dots that are drawn one by one; more are a picture.
VECTORS = 2000

# Verdict -> colour, marker and whether it is filled; told apart without colour as well.
_LOOKS = {
    "found": (FINAL, "o", True),
    "nothing_missing": (INK, "D", True),
    "ambiguous": (BETWEEN[0], "s", False),
    "unexplained": (BASELINE, "^", True),
    "not_excited": (MUTED, "x", True),
}


@styled
def tally(fleet: Fleet) -> Figure:
    """In how many recordings each effect was found."""
    shown = list(fleet.effects.items())[:MOST][::-1]
    labels = [effect_label(*place) for place, _ in shown]
    alone, among = (np.array([counts[k] for _, counts in shown]) for k in (0, 1))
    figure = blank(6.4, 1.0 + 0.26 * len(shown))
    ax = figure.subplots()
    ax.barh(labels, alone, color=FINAL, height=0.62, label="this effect")
    if among.any():
        look = {"color": "white", "edgecolor": FINAL, "hatch": "////", "height": 0.62}
        ax.barh(labels, among, left=alone, label="this or another", **look)
    ax.set_xlabel(f"recordings, of {len(fleet.rows)}")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.grid(visible=False, axis="y")
    ax.tick_params(axis="y", length=0)
    legend_above(figure, [ax])
    return figure


@styled
def errors(fleet: Fleet) -> Figure:
    """Held-out errors in multiples of the noise: after the search over before."""
    channels = list(fleet.units)
    figure = blank(3.5 * len(channels) + 0.3, 3.7)
    axes = figure.subplots(1, len(channels), squeeze=False)[0]
    for ax, channel in zip(axes, channels, strict=True):
        ends = [1.0, AT_NOISE]
        for verdict, (colour, marker, filled) in _LOOKS.items():
            rows = [r for r in fleet.rows if r.verdict == verdict]
            pairs = [(r.before.get(channel), r.after.get(channel), r.noise.get(channel)) for r in rows]
            points = np.array([(b / n, a / n) for b, a, n in pairs if b and a and n]).reshape(-1, 2)
            if not len(points):
                continue
            ends += [float(points.min()), float(points.max())]
            ax.plot(
                *points.T,
                linestyle="none",
                marker=marker,
                color=colour,
                markerfacecolor=colour if filled else "none",
                alpha=0.85,
                markersize=6,
                label=verdict.replace("_", " "),
                rasterized=len(fleet.rows) > VECTORS,
            )
        low, high = min(ends) / 1.3, max(ends) * 1.3
        ax.axhspan(low, AT_NOISE, color=FAINT, alpha=0.6, linewidth=0, zorder=0)
        ax.plot([low, high], [low, high], color=MUTED, linewidth=1, linestyle="--", zorder=1)
        ax.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high), title=channel, aspect="equal")
        ax.set_xlabel("before [multiples of the noise]")
        ax.set_ylabel("after [multiples of the noise]")
        plain_ticks(ax.xaxis)
        plain_ticks(ax.yaxis)
    legend_above(figure, axes)
    return figure
