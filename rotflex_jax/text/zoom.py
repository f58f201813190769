"""What a figure of a page holds to be panned and zoomed: lines over time, maps over a plane.

`templates/zoom.js` draws it in a browser, with uPlot. Numbers are 32 bit in base 64, and of what would make a
page too large the least and the largest value of each group of samples are kept, so that no peak is hidden.
"""

import base64
import dataclasses
import json
from typing import Any

import numpy as np
from jaxtyping import Float

MOST_LINE_VALUES, MOST_MAP_VALUES = 200_000, 75_000
"""Numbers that the lines, and that the maps of a page may hold; each takes 5.3 bytes."""


@dataclasses.dataclass(frozen=True)
class Line:
    """One line over time.

    Attributes:
        label: What it is.
        colour: Of the line.
        values: One per sample; a gap where not finite.
        width: Of the line [px].
        dash: Lengths of dashes and gaps [px]; solid without.
    """

    label: str
    colour: str
    values: Float[np.ndarray, " N"]
    width: float = 1.2
    dash: tuple[float, ...] = ()


@dataclasses.dataclass(frozen=True)
class LinePanel:
    """Lines with one scale.

    Attributes:
        label: Of the scale, with its unit.
        lines: What is drawn.
        height: Of the panel [px].
        band: Half width of a grey band around zero; none at 0.
        limits: What the scale never goes beyond, such as a run that diverges; anything where None.
    """

    label: str
    lines: tuple[Line, ...]
    height: int
    band: float = 0.0
    limits: tuple[float, float] | None = None


@dataclasses.dataclass(frozen=True)
class Stretch:
    """A part of the time that a reader is led to.

    Attributes:
        label: What is there.
        start: Where it begins [s].
        end: Where it ends [s].
    """

    label: str
    start: float
    end: float


@dataclasses.dataclass(frozen=True)
class LineView:
    """Panels one below the other over one axis of time.

    Attributes:
        start: Time of the first sample [s].
        Ts: Sampling period [s].
        panels: From the top down.
        stretches: Parts that a reader is led to.
        marks: Times that are marked, such as new starts of a run [s].
    """

    start: float
    Ts: float
    panels: tuple[LinePanel, ...]
    stretches: tuple[Stretch, ...] = ()
    marks: tuple[float, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain values for the script of a page."""
        lines = [line for panel in self.panels for line in panel.lines]
        N = max(len(line.values) for line in lines)
        # Two values stay of each group of samples, so that a group of one or two is left as it is.
        group = -(-2 * N * len(lines) // MOST_LINE_VALUES) if N * len(lines) > MOST_LINE_VALUES else 1
        count = N if group == 1 else 2 * -(-N // group)
        note = (
            "Every sample is drawn."
            if group == 1
            else f"Of each {group} samples the least and the largest are drawn."
        )
        return {
            "kind": "lines",
            "x": {
                "label": "time [s]",
                "start": float(self.start),
                "step": float(self.Ts) * (1.0 if group == 1 else group / 2),
                "count": count,
            },
            "panels": [
                {
                    "label": panel.label,
                    "height": panel.height,
                    "band": float(panel.band),
                    "limits": panel.limits,
                    "lines": [
                        {
                            "label": line.label,
                            "colour": line.colour,
                            "width": line.width,
                            "dash": list(line.dash),
                            "values": encoded(extremes(np.asarray(line.values, float), group)),
                        }
                        for line in panel.lines
                    ],
                }
                for panel in self.panels
            ],
            "stretches": [{"label": s.label, "from": s.start, "to": s.end} for s in self.stretches],
            "marks": list(self.marks),
            "note": note,
        }


@dataclasses.dataclass(frozen=True)
class PlaneMap:
    """A mean over cells of a plane.

    Attributes:
        title: Over the map.
        values: One per sample; a sample that is not finite does not count.
        unit: Of the values, in brackets.
        colours: From the lower limit to the upper one.
        limits: Values of the first and the last colour.
        squared: Whether a cell is the root mean square instead of the mean.
    """

    title: str
    values: Float[np.ndarray, " N"]
    unit: str
    colours: tuple[str, ...]
    limits: tuple[float, float]
    squared: bool = False


@dataclasses.dataclass(frozen=True)
class MapView:
    """Maps of samples over one plane; zooming counts the samples again in smaller cells.

    Attributes:
        x: Where each sample lies to the right.
        y: Where each sample lies upwards.
        labels: Of both, with units.
        ranges: What is shown of both at first.
        maps: Side by side.
        cells: Along each side of a map.
        least: Samples without which a cell stays blank.
    """

    x: Float[np.ndarray, " N"]
    y: Float[np.ndarray, " N"]
    labels: tuple[str, str]
    ranges: tuple[tuple[float, float], tuple[float, float]]
    maps: tuple[PlaneMap, ...]
    cells: int
    least: int

    def to_dict(self) -> dict[str, Any]:
        """Plain values for the script of a page."""
        each = -(-len(self.x) * (2 + len(self.maps)) // MOST_MAP_VALUES)
        part = slice(None, None, each)
        note = "" if each == 1 else f"One of {each} samples counts."
        axes = {
            name: {"label": label, "range": list(shown), "values": encoded(values[part])}
            for name, label, shown, values in zip(
                "xy", self.labels, self.ranges, (self.x, self.y), strict=True
            )
        }
        return {
            "kind": "map",
            **axes,
            "cells": self.cells,
            "least": max(1, self.least // each),
            "panels": [
                {
                    "title": m.title,
                    "unit": m.unit,
                    "squared": m.squared,
                    "limits": list(m.limits),
                    "colours": list(m.colours),
                    "values": encoded(m.values[part]),
                }
                for m in self.maps
            ],
            "note": f"{note} Smaller cells are means of fewer samples, and noisier.".strip(),
        }


def extremes(values: Float[np.ndarray, " N"], group: int) -> Float[np.ndarray, " M"]:
    """The least and the largest value of each group of samples, in the order in which they came.

    Args:
        values: One per sample; those that are not finite count only where a group has no others.
        group: Samples of a group; 1 leaves all values as they are.

    >>> extremes(np.array([0.0, 9.0, 1.0, -5.0, 2.0, 2.0, 3.0]), 4)
    array([ 9., -5.,  2.,  3.])
    """
    if group == 1:
        return values
    padded = np.pad(values, (0, -len(values) % group), mode="edge").reshape(-1, group)
    known = np.isfinite(padded)
    low = np.where(known, padded, np.inf).argmin(axis=1)
    high = np.where(known, padded, -np.inf).argmax(axis=1)
    pick = np.sort(np.stack([low, high], axis=1), axis=1)
    return np.take_along_axis(padded, pick, axis=1).ravel()


def encoded(values: Float[np.ndarray, " N"]) -> str:
    """Numbers as 32 bit, low byte first, in base 64."""
    with np.errstate(over="ignore"):  # what diverges is a gap
        return base64.b64encode(np.asarray(values).astype("<f4").tobytes()).decode("ascii")


def as_text(view: LineView | MapView) -> str:
    """A view as JSON that may stand inside a page as it is, whatever its labels are."""
    text = json.dumps(view.to_dict(), ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
