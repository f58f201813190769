"""Data of figures with pan and zoom: lines over time, maps over a plane.

`templates/zoom.js` draws them in a browser, with uPlot. Numbers are written with 32 bits in base 64. If a
page would become too large, only the least and the largest value of each group of samples of a line are kept,
so that peaks stay visible, and maps use a part of their samples.
"""

import base64
import dataclasses
import json
from typing import Any

import numpy as np
from jaxtyping import Float

MOST_LINE_VALUES, MOST_MAP_VALUES = 200_000, 75_000
"""Most numbers in the lines and in the maps of a page; each number takes 5.3 bytes."""


@dataclasses.dataclass(frozen=True)
class Line:
    """One line over time.

    Attributes:
        label: Label of the line.
        colour: Colour of the line.
        values: One value per sample; a value that is not finite makes a gap.
        width: Width of the line [px].
        dash: Lengths of dashes and gaps [px]; empty for a solid line.
    """

    label: str
    colour: str
    values: Float[np.ndarray, " N"]
    width: float = 1.2
    dash: tuple[float, ...] = ()


@dataclasses.dataclass(frozen=True)
class LinePanel:
    """Lines with a common vertical scale.

    Attributes:
        label: Label of the scale, with its unit.
        lines: The lines.
        height: Height of the panel [px].
        band: Half width of a grey band around zero; 0 for none.
        limits: Limits of the scale, for instance if a run diverges; None for no limits.
    """

    label: str
    lines: tuple[Line, ...]
    height: int
    band: float = 0.0
    limits: tuple[float, float] | None = None


@dataclasses.dataclass(frozen=True)
class Stretch:
    """A stretch of time to which a button on the page zooms.

    Attributes:
        label: Text of the button.
        start: Start of the stretch [s].
        end: End of the stretch [s].
    """

    label: str
    start: float
    end: float


@dataclasses.dataclass(frozen=True)
class LineView:
    """Panels one below the other with a common time axis.

    Attributes:
        start: Time of the first sample [s].
        Ts: Sampling period [s].
        panels: Panels from top to bottom.
        stretches: Stretches of time to which buttons on the page zoom.
        marks: Times with a mark, such as the starts of the windows of a run [s].
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
        # Two values of each group of samples are kept.
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
        title: Title of the map.
        values: One value per sample; values that are not finite are left out.
        unit: Unit of the values, in brackets.
        colours: Colours from the lower limit to the upper one.
        limits: Values of the first and of the last colour.
        squared: Whether a cell shows the root mean square instead of the mean.
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
        x: Horizontal coordinate of each sample.
        y: Vertical coordinate of each sample.
        labels: Labels of both axes, with units.
        ranges: Ranges of both axes at first.
        maps: The maps, side by side.
        cells: Number of cells along each side of a map.
        least: Least number of samples of a cell that is drawn.
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
    """The least and the largest value of each group of samples, in their order in time.

    Args:
        values: One value per sample; values that are not finite are kept only if a group has no others.
        group: Number of samples in a group; 1 leaves all values unchanged.

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
    """Numbers with 32 bits, low byte first, in base 64."""
    with np.errstate(over="ignore"):  # a value that is too large becomes infinite, which makes a gap
        return base64.b64encode(np.asarray(values).astype("<f4").tobytes()).decode("ascii")


def as_text(view: LineView | MapView) -> str:
    """A view as JSON that an HTML page can contain unchanged, whatever its labels are."""
    text = json.dumps(view.to_dict(), ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
