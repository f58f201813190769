"""The summary of a fleet as one page that needs no other file."""

import datetime
from typing import Any

from rotflex_jax.fleet import kept
from rotflex_jax.fleet.figures import errors, tally
from rotflex_jax.fleet.result import Fleet, Row
from rotflex_jax.report.page import template
from rotflex_jax.report.style import on_page
from rotflex_jax.report.wording import (
    AT_NOISE,
    effect_label,
    effect_title,
    plain_number,
    ratio,
    readable,
    together,
)

# Rows that a page can show; the table for programs has all.
LISTED = 1000


def render(fleet: Fleet) -> str:
    """The page as text."""
    return template("summary.html.j2", "rotflex_jax.fleet").render(content(fleet))


def content(fleet: Fleet) -> dict[str, Any]:
    """What the template fills in; plain text that the template escapes."""
    good = [r for r in fleet.rows if r.verdict]
    torn = any(among for _, among in fleet.effects.values())
    pictures = (
        (
            "Which effects, and how often",
            tally(fleet) if fleet.effects else None,
            "Dark: recordings that show this effect and no other in its place."
            + " Hatched: recordings that show it or another, and cannot tell which." * torn,
            "Bars: in how many recordings each effect was found.",
        ),
        (
            "Error before and after",
            errors(fleet) if good else None,
            "A dot a recording: error of short free runs over data that no fit saw, as a multiple of the "
            "noise of the sensor. On the diagonal nothing was gained; within the grey band the model "
            "explains what the sensor can show.",
            "Held-out error after the search against that before, on logarithmic scales.",
        ),
    )
    return {
        "title": f"{len(fleet.rows)} recordings, one search each",
        "summary": _summary(fleet),
        "unfinished": fleet.total - len(fleet.rows),
        "headings": [f"{c} [{readable(1.0, u)[1]}]" for c, u in fleet.units.items()],
        "rows": [_row(r, fleet) for r in good[:LISTED]],
        "unlisted": max(0, len(good) - LISTED),
        "failed": [(r.name, together(r.reason), r.source) for r in fleet.failed[:LISTED]],
        "unlisted_failed": max(0, len(fleet.failed) - LISTED),
        "windows": ", ".join(sorted({f"{r.window_seconds:g} s" for r in good if r.window_seconds})),
        "pictures": [
            {"title": title, **on_page(figure, caption, alt)}
            for title, figure, caption, alt in pictures
            if figure is not None
        ],
        "seconds": plain_number(sum(r.seconds for r in fleet.rows)),
        "date": datetime.datetime.now().astimezone().strftime("%d %B %Y, %H:%M"),
    }


def _summary(fleet: Fleet) -> str:
    """What there is to know, in words."""
    counts = fleet.verdicts
    phrases = {
        "found": "explained by what was found",
        "nothing_missing": "with nothing missing",
        "ambiguous": "explained, by effects that are not told apart",
        "unexplained": "with something left unexplained",
        "not_excited": "that could not have shown anything",
        "failed": "without an answer",
    }
    said = [f"{n} {phrases[v]}" for v, n in counts.items() if v in phrases]
    often = next(iter(fleet.effects.items()), None)
    if often is None:
        return ", ".join(said) + "."
    (effect, port), (alone, among) = often
    count = f"{alone + among} of {len(fleet.rows)}"
    return f"{', '.join(said)}. Most often: {effect_title(effect)} at {port}, in {count}."


def _row(row: Row, fleet: Fleet) -> dict[str, Any]:
    cells = []
    for c, unit in fleet.units.items():
        before, after, floor = (values.get(c) for values in (row.before, row.after, row.noise))
        times = ratio(after, floor) if after is not None else float("nan")
        cells.append(
            {
                "before": plain_number(None if before is None else readable(before, unit)[0]),
                "after": plain_number(None if after is None else readable(after, unit)[0]),
                "times": plain_number(times, 2),
                "ok": times < AT_NOISE,
            }
        )
    return {
        "name": row.name,
        "file": f"{kept.RESULTS}/{row.name}.json",
        "verdict": row.verdict.replace("_", " "),
        "mark": row.verdict,
        "effects": [
            " or ".join(effect_label(*place) for place in ((effect, port), *others))
            for effect, port, others in row.effects
        ],
        "cells": cells,
        "seconds": f"{row.seconds:.{0 if row.seconds >= 10 else 1}f}",
    }
