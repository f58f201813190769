"""The look of the figures: one colour per stage, units on every axis, no global state of pyplot."""

import base64
import functools
import io
from collections.abc import Callable, Iterable
from typing import Any, ParamSpec, TypeVar

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

P = ParamSpec("P")
Drawn = TypeVar("Drawn", bound=Figure | None)

INK, MUTED, FAINT = "#1f2933", "#66727f", "#d5dbe1"
MEASURED, BASELINE, FINAL, NOISE = "#9aa5b1", "#c8452f", "#0f6f86", "#5b6570"
BETWEEN = ("#d98e04", "#7a5aa6", "#5f8f3a", "#b5587f")

_LOOK: Any = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.labelsize": 9.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#aeb7c0",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "#e8ecf0",
    "grid.linewidth": 0.7,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "text.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "svg.fonttype": "path",
    "svg.hashsalt": "rotflex",
    "path.simplify": True,
    "path.simplify_threshold": 0.4,
}


def stage_colours(count: int) -> tuple[str, ...]:
    """One colour per stage: the baseline's, the final one's, and others between."""
    if count == 1:
        return (BASELINE,)
    between = (BETWEEN[k % len(BETWEEN)] for k in range(count - 2))
    return (BASELINE, *between, FINAL)


def styled(draw: Callable[P, Drawn]) -> Callable[P, Drawn]:
    """A function that draws in this look and leaves matplotlib's settings as they were."""

    @functools.wraps(draw)
    def inside(*args: P.args, **kwargs: P.kwargs) -> Drawn:
        with matplotlib.rc_context(_LOOK):
            return draw(*args, **kwargs)

    return inside


class Drawing(Figure):
    """A figure that a notebook shows by itself, whether or not a backend of pyplot is loaded there."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        with matplotlib.rc_context(_LOOK):
            self.savefig(buffer, format="png", dpi=80)
        return buffer.getvalue()


def blank(width: float, height: float) -> Figure:
    """An empty figure [inch]; 10 is the width of the page."""
    figure = Drawing(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def legend_above(figure: Figure, axes: Iterable[Axes], columns: int = 6) -> None:
    """One legend over the whole figure, where it covers no data."""
    entries: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(str(label), handle)
    figure.legend(
        list(entries.values()),
        list(entries),
        loc="outside upper left",
        ncols=columns,
        handlelength=1.8,
        columnspacing=1.6,
    )


def thinned(t: np.ndarray, y: np.ndarray, most: int = 1600) -> tuple[np.ndarray, np.ndarray]:
    """The same line with fewer points: the least and the largest of each short stretch."""
    groups = len(y) // max(1, most // 2)
    if groups < 4:
        return t, y
    rows = y[: len(y) // groups * groups].reshape(-1, groups)
    first = np.arange(len(rows)) * groups
    pick = np.sort(np.stack([rows.argmin(1), rows.argmax(1)], axis=1), axis=1) + first[:, None]
    pick = np.append(pick.ravel(), len(y) - 1)
    return t[pick], y[pick]


def plain_ticks(axis: Axis) -> None:
    """Ticks as numbers without powers of ten."""
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:,g}".translate(_SIGNS)))
    axis.set_minor_formatter(NullFormatter())


_SIGNS = str.maketrans({",": "\u202f", "-": "−"})


def data_address(figure: Figure) -> str:
    """The figure as an SVG image inside an address, so that a page needs no other file."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(_LOOK):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def on_page(figure: Figure, caption: str, alt: str) -> dict[str, Any]:
    """What a template needs to show a figure: its address, width [1/10 inch], and both texts."""
    width = round(10 * figure.get_figwidth())
    return {"address": data_address(figure), "width": width, "caption": caption, "alt": alt}
