"""The summary of a batch as one self-contained page, with its figures."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rotflex_jax.batch import storage
from rotflex_jax.batch.result import Fleet, RecordingRow
from rotflex_jax.discover.result import NEAR_FLOOR
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.effects.labels import effect_label
from rotflex_jax.text.colours import FAINT, FINAL, MUTED
from rotflex_jax.text.markup import fill_template
from rotflex_jax.text.numbers import multiple, plain_number, ratio, readable, together
from rotflex_jax.text.plotting import FigureRegistry, blank, by_section, legend_above, plain_ticks

# Number of effects that are drawn, the most frequent ones.
MOST_EFFECTS = 15
# Largest number of recordings whose dots are drawn one by one; more dots become a bitmap.
MOST_DOTS = 2000

FIGURES = FigureRegistry()


def _tally_caption(fleet: Fleet) -> str:
    ambiguous = any(among for _, among in fleet.effects.values())
    return (
        "Dark: recordings that show this effect and no other in its place."
        + " Hatched: recordings that show it or another, and cannot distinguish them." * ambiguous
    )


@FIGURES.figure(
    "tally",
    section="Which effects, and how often",
    caption=_tally_caption,
    description="Bars: in how many recordings each effect was found.",
)
def tally(fleet: Fleet) -> Figure | None:
    """Figure of the number of recordings in which each effect was found; None if no effect was found."""
    if not fleet.effects:
        return None
    shown = list(fleet.effects.items())[:MOST_EFFECTS][::-1]
    labels = [effect_label(*place) for place, _ in shown]
    alone, among = (np.array([counts[k] for _, counts in shown]) for k in (0, 1))
    figure = blank(6.4, 1.0 + 0.26 * len(shown))
    ax = figure.subplots()
    ax.barh(labels, alone, color=FINAL, height=0.62, label="this effect")
    if among.any():
        hatched = {"color": "white", "edgecolor": FINAL, "hatch": "////", "height": 0.62}
        ax.barh(labels, among, left=alone, label="this or another", **hatched)
    ax.set_xlabel(f"recordings, of {len(fleet.rows)}")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.grid(visible=False, axis="y")
    ax.tick_params(axis="y", length=0)
    legend_above(figure, [ax])
    return figure


@FIGURES.figure(
    "errors",
    section="Error before and after",
    caption="A dot a recording: error of short free runs over data that no fit saw, as a multiple of the "
    "noise of the sensor. On the diagonal nothing was gained; within the grey band the model "
    "explains what the sensor can show.",
    description="Held-out error after the search against that before, on logarithmic scales.",
)
def errors(fleet: Fleet) -> Figure | None:
    """Held-out errors after the search against those before, in multiples of the noise; None without any."""
    if not any(r.verdict for r in fleet.rows):
        return None
    channels = list(fleet.units)
    figure = blank(3.5 * len(channels) + 0.3, 3.7)
    axes = figure.subplots(1, len(channels), squeeze=False)[0]
    for ax, channel in zip(axes, channels, strict=True):
        ends = [1.0, NEAR_FLOOR]
        for verdict in Verdict:
            rows = [r for r in fleet.rows if r.verdict == verdict]
            pairs = [(r.before.get(channel), r.after.get(channel), r.noise.get(channel)) for r in rows]
            points = np.array([(b / n, a / n) for b, a, n in pairs if b and a and n]).reshape(-1, 2)
            if not len(points):
                continue
            ends += [float(points.min()), float(points.max())]
            ax.plot(
                *points.T,
                linestyle="none",
                marker=verdict.shown.marker,
                color=verdict.shown.colour,
                markerfacecolor=verdict.shown.colour if verdict.shown.filled else "none",
                alpha=0.85,
                markersize=6,
                label=verdict.label,
                rasterized=len(fleet.rows) > MOST_DOTS,
            )
        low, high = min(ends) / 1.3, max(ends) * 1.3
        ax.axhspan(low, NEAR_FLOOR, color=FAINT, alpha=0.6, linewidth=0, zorder=0)
        ax.plot([low, high], [low, high], color=MUTED, linewidth=1, linestyle="--", zorder=1)
        ax.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high), title=channel, aspect="equal")
        ax.set_xlabel("before [multiples of the noise]")
        ax.set_ylabel("after [multiples of the noise]")
        plain_ticks(ax.xaxis)
        plain_ticks(ax.yaxis)
    legend_above(figure, axes)
    return figure


# Largest number of rows on a page; the CSV file has all rows.
LISTED_ROWS = 1000


def render(fleet: Fleet) -> str:
    """The page as text."""
    return fill_template("rotflex_jax.batch", "summary.html.j2", content(fleet))


def content(fleet: Fleet) -> dict[str, Any]:
    """Values for the template; plain text that the template escapes."""
    good = [r for r in fleet.rows if r.verdict]
    return {
        "title": f"{len(fleet.rows)} recordings, one search each",
        "summary": _summary(fleet),
        "unfinished": fleet.total - len(fleet.rows),
        "headings": [f"{c} [{readable(1.0, u)[1]}]" for c, u in fleet.units.items()],
        "rows": [_row(r, fleet) for r in good[:LISTED_ROWS]],
        "unlisted": max(0, len(good) - LISTED_ROWS),
        "failed": [(r.name, together(r.reason), r.source) for r in fleet.failed[:LISTED_ROWS]],
        "unlisted_failed": max(0, len(fleet.failed) - LISTED_ROWS),
        "windows": ", ".join(sorted({f"{r.window_seconds:g} s" for r in good if r.window_seconds})),
        "pictures": by_section(FIGURES.pictures(fleet).values()),
        "seconds": plain_number(sum(r.seconds for r in fleet.rows)),
    }


def _summary(fleet: Fleet) -> str:
    """The summary in words."""
    counts = fleet.verdicts
    phrases = {verdict.value: verdict.shown.phrase for verdict in Verdict} | {"failed": "without an answer"}
    said = [f"{n} {phrases[v]}" for v, n in counts.items() if v in phrases]
    often = next(iter(fleet.effects.items()), None)
    if often is None:
        return ", ".join(said) + "."
    (effect, port), (alone, among) = often
    count = f"{alone + among} of {len(fleet.rows)}"
    return f"{', '.join(said)}. Most often: {effect_label(effect, port)}, in {count}."


def _row(row: RecordingRow, fleet: Fleet) -> dict[str, Any]:
    cells = []
    for c, unit in fleet.units.items():
        before, after, floor = (values.get(c) for values in (row.before, row.after, row.noise))
        times = ratio(after, floor) if after is not None else float("nan")
        cells.append(
            {
                "before": plain_number(None if before is None else readable(before, unit)[0]),
                "after": plain_number(None if after is None else readable(after, unit)[0]),
                "times": multiple(times) or "–",
                "ok": times < NEAR_FLOOR,
            }
        )
    return {
        "name": row.name,
        "file": f"{storage.RESULTS}/{row.name}.json",
        "page": f"{storage.PAGES}/{row.name}.html"
        if storage.page_of(fleet.folder, row.name).exists()
        else "",
        "verdict": Verdict(row.verdict).label,
        "effects": [
            " or ".join(effect_label(*place) for place in ((effect, port), *others))
            for effect, port, others in row.effects
        ],
        "cells": cells,
        "seconds": f"{row.seconds:.{0 if row.seconds >= 10 else 1}f}",
    }
