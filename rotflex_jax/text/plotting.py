"""Style of figures, without the global state of pyplot, and the figures of a page with their captions."""

import dataclasses
import functools
import inspect
import io
import re
from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any, ParamSpec, TypeVar
from urllib.parse import quote

import matplotlib
import numpy as np
from jaxtyping import Real
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from rotflex_jax.text.colours import AXIS, INK, MUTED
from rotflex_jax.text.zoom import LineView, MapView, as_text

P = ParamSpec("P")
Drawn = TypeVar("Drawn", bound=Figure | None)
Caption = str | Callable[..., str]
Zoom = Callable[..., LineView | MapView | None] | None

_STYLE: Any = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.labelsize": 9.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": AXIS,
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


def styled(draw: Callable[P, Drawn]) -> Callable[P, Drawn]:
    """Decorator that applies the style of the package while a function draws, then restores matplotlib's."""

    @functools.wraps(draw)
    def inside(*args: P.args, **kwargs: P.kwargs) -> Drawn:
        with matplotlib.rc_context(_STYLE):
            return draw(*args, **kwargs)

    return inside


class Drawing(Figure):
    """A figure that a notebook displays even without a backend of pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        with matplotlib.rc_context(_STYLE):
            self.savefig(buffer, format="png", dpi=80)
        return buffer.getvalue()


def blank(width: float, height: float) -> Figure:
    """An empty figure with a width and a height [inch]; a page is 10 inches wide."""
    figure = Drawing(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def legend_above(figure: Figure, axes: Iterable[Axes], columns: int = 6) -> None:
    """Adds one legend for all axes above them, where it covers no data."""
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


def thinned(
    t: Real[np.ndarray, " N"], y: Real[np.ndarray, " N"], most: int = 1600
) -> tuple[Real[np.ndarray, " M"], Real[np.ndarray, " M"]]:
    """A line with fewer points: the smallest and the largest value of each group of neighbours."""
    groups = len(y) // max(1, most // 2)
    if groups < 4:
        return t, y
    rows = y[: len(y) // groups * groups].reshape(-1, groups)
    first = np.arange(len(rows)) * groups
    pick = np.sort(np.stack([rows.argmin(1), rows.argmax(1)], axis=1), axis=1) + first[:, None]
    pick = np.append(pick.ravel(), len(y) - 1)
    return t[pick], y[pick]


def plain_ticks(axis: Axis) -> None:
    """Formats the ticks of an axis as numbers without powers of ten."""
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:,g}".translate(_SIGNS)))
    axis.set_minor_formatter(NullFormatter())


_SIGNS = str.maketrans({",": "\u202f", "-": "−"})


def data_address(figure: Figure) -> str:
    """The figure as an SVG image in a data URL, so that a page needs no other file."""
    buffer, layout = io.StringIO(), figure.get_layout_engine()
    with matplotlib.rc_context(_STYLE):
        if layout:  # otherwise `savefig` draws everything once more, only to arrange it
            layout.execute(figure)
            figure.set_layout_engine(None)
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
        figure.set_layout_engine(layout)
    svg = _UNUSED.sub("", buffer.getvalue())
    svg = _COORDINATES.sub(lambda found: _LONG_NUMBER.sub(_rounded, found[0]), svg)
    # Percent encoding is a third smaller than base 64; pages should be small enough for e-mail.
    return "data:image/svg+xml;charset=utf-8," + quote(" ".join(svg.split()), safe=_KEPT)


# Parts that a browser does not need: the document type, and metadata.
_UNUSED = re.compile(r"<!DOCTYPE[^>]*>|<metadata>.*?</metadata>", re.DOTALL)
# Coordinates [1/72 inch] are rounded to a hundredth, which is invisible.
_COORDINATES, _LONG_NUMBER = re.compile(r' (?:d|x|y)="[^"]*"'), re.compile(r"-?\d+\.\d{3,}")
_KEPT = " =:/,;()!$*@?[]{}|^`~+"


def _rounded(number: re.Match[str]) -> str:
    return f"{float(number[0]):.2f}".rstrip("0").rstrip(".")


@dataclasses.dataclass(frozen=True)
class Picture:
    """A figure with its caption and description.

    Attributes:
        section: Section of the page that shows the figure.
        figure: The figure.
        caption: One or two sentences on what the figure shows.
        description: Description for readers who cannot see the figure.
        zoom: Data of the figure for pan and zoom, on a page with the script; None for a still picture.
    """

    section: str
    figure: Figure
    caption: str
    description: str
    zoom: LineView | MapView | None = None

    @property
    def on_page(self) -> dict[str, Any]:
        """Values for a template: address, width [% of the page], caption, description, data for zoom."""
        return {
            "address": data_address(self.figure),
            "width": round(10 * self.figure.get_figwidth()),
            "caption": self.caption,
            "description": self.description,
            "zoom": as_text(self.zoom) if self.zoom else "",
        }


class FigureRegistry:
    """The figures of one kind of page, each with a caption, which is defined where the figure is drawn."""

    def __init__(self) -> None:
        self._entries: list[tuple[str, str, Callable[..., Figure | None], Caption, str, Zoom]] = []

    def figure(
        self, name: str, *, section: str, caption: Caption, description: str, zoom: Zoom = None
    ) -> Callable[[Callable[P, Drawn]], Callable[P, Drawn]]:
        """Decorator that registers a function, which draws a figure or returns None without anything to show.

        Args:
            name: Name of the picture.
            section: Section of the page, in which figures have the order of their registration.
            caption: The caption, or a function of the subjects that returns it.
            description: Description for readers who cannot see the figure.
            zoom: Function that returns the data for pan and zoom; None for a still picture.
        """

        def enter(draw: Callable[P, Drawn]) -> Callable[P, Drawn]:
            drawing = styled(draw)
            self._entries.append((name, section, drawing, caption, description, zoom))
            return drawing

        return enter

    def pictures(self, *subjects: Any) -> dict[str, Picture]:
        """Name -> figure, without figures that have nothing to show.

        Args:
            subjects: Arguments of the functions, such as the result of a search. A function gets as many of
                them as it has parameters.
        """
        drawn = {}
        for name, section, draw, caption, description, zoom in self._entries:
            figure = _given(draw, subjects)
            if figure is not None:
                text = caption if isinstance(caption, str) else _given(caption, subjects)
                view = _given(zoom, subjects) if zoom else None
                drawn[name] = Picture(section, figure, text, description, view)
        return drawn


def _given(function: Callable[..., Any], subjects: tuple[Any, ...]) -> Any:
    return function(*subjects[: len(inspect.signature(function).parameters)])


def by_section(pictures: Iterable[Picture]) -> dict[str, list[dict[str, Any]]]:
    """Section -> template values of its pictures; an empty list for a section without pictures."""
    sections: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for picture in pictures:
        sections[picture.section].append(picture.on_page)
    return sections
