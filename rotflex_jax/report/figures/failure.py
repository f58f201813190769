"""Figures that localise the error: maps over speed and deflection, and a profile for each localisation."""

import dataclasses

import numpy as np
import scipy
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rotflex_jax.discover.localise import (
    derivative_of,
    half_width,
    missing_acceleration,
    motion_channels,
)
from rotflex_jax.discover.result import SearchResult, Where
from rotflex_jax.discover.tables import channel_units
from rotflex_jax.report.figures.registry import figure
from rotflex_jax.report.figures.runs import Shown, shown
from rotflex_jax.text.colours import BASELINE, INK, NO_DATA
from rotflex_jax.text.numbers import readable
from rotflex_jax.text.plotting import blank, legend_above
from rotflex_jax.text.zoom import MapView, PlaneMap

# Number of cells of a map along each axis, and least number of samples of a cell that is drawn.
MAP_CELLS, MIN_CELL_SAMPLES = 13, 8
MOST_PROFILES = 6

_AXES = {
    "speed": "speed of {turning}",
    "deflection": "{bending}",
    "reversal": "time since a reversal",
    "time": "time",
}


def _moving(discovery: SearchResult) -> tuple[str, ...]:
    """Channels that measure a motion; all channels if none does."""
    by_channel = channel_units(discovery)
    return motion_channels(by_channel, discovery.baseline.model.mechanism) or tuple(by_channel)


def worst_channel(discovery: SearchResult) -> str:
    """Channel of a motion with the largest ratio of baseline error to sensor noise."""
    errors, floor = discovery.baseline.held_out_rmse_windows, discovery.noise_floor
    return max(_moving(discovery), key=lambda c: errors[c] / (floor.get(c) or errors[c] or 1.0))


def _grid(discovery: SearchResult, s: Shown) -> tuple[list[np.ndarray], list[str]]:
    """Coordinates of the maps: speed and deflection, or speed and time if only one channel is a motion."""
    by_channel, channels = channel_units(discovery), _moving(discovery)
    columns = [list(by_channel).index(c) for c in channels]
    unit = by_channel[channels[0]]
    is_speed = derivative_of(channels[0], unit, discovery.baseline.model.mechanism) > 0
    scale, read = readable(1.0, unit if is_speed else f"{unit}/s")
    window = 2 * (half_width(s.recording) or 3) + 1
    order = 0 if is_speed else 1
    turning = s.measured[:, columns[0]]
    rate = scipy.signal.savgol_filter(turning, window, 2, deriv=order, delta=s.recording.Ts)
    values = [scale * np.asarray(rate)]
    labels = [f"{channels[0] if is_speed else f'speed of {channels[0]}'} [{read}]"]
    if len(channels) == 1:
        return [*values, s.recording.t], [*labels, "time [s]"]
    scale, read = readable(1.0, by_channel[channels[1]])
    return [*values, scale * s.measured[:, columns[1]]], [*labels, f"{channels[1]} [{read}]"]


def _cells(over: list[np.ndarray]) -> list[np.ndarray]:
    edges = []
    for x in over:
        low, high = (float(q) for q in np.quantile(x, (0.003, 0.997)))
        edges.append(np.linspace(low, high if high > low else low + 1.0, MAP_CELLS + 1))
    return edges


@figure(
    "profiles",
    section="where",
    caption="Bars above the black line mark where the baseline makes more than its share of error; "
    "the outermost take what lies beyond.",
    description="Share of the error by bins, against the share that an even spread would have.",
)
def profiles(discovery: SearchResult) -> Figure | None:
    """Share of the error in each bin against the share of an even spread, one panel per localisation.

    Localisations in frequency are not drawn; `spectra` shows the spectra of the error.
    """
    places = [w for w in discovery.where if w.kind in _AXES and len(w.edges) > 1][:MOST_PROFILES]
    if not places:
        return None
    columns = 2 if len(places) in (2, 4) else min(3, len(places))
    rows = -(-len(places) // columns)
    figure = blank(10.0 if columns > 1 else 5.5, 2.5 * rows + 0.4)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, place in zip(axes, places, strict=False):
        _profile(ax, place, _moving(discovery))
    for ax in axes[len(places) :]:
        ax.remove()
    legend_above(figure, axes[: len(places)])
    return figure


def _profile(ax: Axes, place: Where, channels: tuple[str, ...]) -> None:
    names = {"turning": channels[0], "bending": channels[min(1, len(channels) - 1)]}
    scale, read = readable(1.0, place.unit)
    edges = scale * place.edges
    if place.kind == "reversal":  # bins of unequal width are drawn equally wide
        scale, read = 1e3, "ms"
        edges = np.arange(len(place.edges), dtype=float)
        ax.set_xticks(edges, [f"{scale * e:.3g}" if np.isfinite(e) else "later" for e in place.edges])
    bars = 0.86 * np.diff(edges)
    middle = (edges[:-1] + edges[1:]) / 2
    ax.bar(middle, 100 * place.profile, bars, color=BASELINE, alpha=0.85, label="share of the error")
    ax.stairs(100 * place.expected, edges, color=INK, lw=1.4, label="if it were spread evenly")
    ax.grid(axis="x", visible=False)
    ax.set_title(f"{place.channel} error")
    ax.set_xlabel(f"{_AXES[place.kind].format(**names)} [{read}]")
    ax.set_ylabel("share [%]")
    ax.set_xlim(edges[0], edges[-1])
    ax.set_ylim(bottom=0)


def _map_caption(discovery: SearchResult) -> str:
    return (
        f"Left: error of {worst_channel(discovery)} at each speed and position; blank where the machine "
        "hardly ever was. Right of it: the mean acceleration that the model lacks there. A pattern is "
        "the picture of a missing force, less what other parameters took over; speckles are "
        "noise" + ("; after the last round none should be left." if discovery.rounds else ".")
    )


@dataclasses.dataclass(frozen=True)
class _Maps:
    """Data of the maps of the residuals.

    Attributes:
        over: Both coordinates of each sample.
        labels: Labels of both coordinates.
        edges: Edges of the cells along both coordinates.
        error: Error of the baseline.
        lacking: Title -> acceleration that a model lacks; NaN where it is unknown.
        channel: Channel of the error.
        units: Units of the error and of the acceleration, in brackets.
        floor: Standard deviation of the error that is caused by sensor noise.
        usual: Standard deviation of the acceleration that is caused by sensor noise.
    """

    over: list[np.ndarray]
    labels: list[str]
    edges: list[np.ndarray]
    error: np.ndarray
    lacking: dict[str, np.ndarray]
    channel: str
    units: tuple[str, str]
    floor: float
    usual: float

    def mean(self, values: np.ndarray) -> np.ma.MaskedArray:
        """Means over cells; cells with fewer than `MIN_CELL_SAMPLES` samples are masked."""
        seen = np.isfinite(values)
        at = self.over[0][seen], self.over[1][seen]
        count = np.histogram2d(*at, self.edges)[0]
        total = np.histogram2d(*at, self.edges, weights=values[seen])[0]
        return np.ma.masked_where(count < MIN_CELL_SAMPLES, total / np.maximum(count, 1))

    @property
    def limits(self) -> tuple[float, float]:
        """Error and acceleration with the strongest colours; at least 4 times the noise, which looks pale."""
        errors = _largest([np.ma.sqrt(self.mean(self.error**2))])
        lacking = _largest([self.mean(v) for v in self.lacking.values()])
        return max(errors, 4 * self.floor) or 1.0, max(lacking, 4 * self.usual) or 1.0


def _maps(discovery: SearchResult) -> _Maps:
    s, by_channel = shown(discovery), channel_units(discovery)
    channel = worst_channel(discovery)
    c, unit = list(by_channel).index(channel), by_channel[channel]
    over, labels = _grid(discovery, s)
    scale, read = readable(1.0, unit)
    order = 2 - min(1, derivative_of(channel, unit, discovery.baseline.model.mechanism))
    lacking = {}
    for run, label in ((s.baseline, "baseline"), (s.final, "final model")):
        if run is not None:
            e = scale * (s.measured[:, c] - run[:, c])
            values, seen = missing_acceleration(e, s.recording, s.starts.tolist(), order)
            lacking[f"{label}: what it lacks"] = np.where(seen, values, np.nan)
    pulse = np.eye(1, s.recording.N, s.recording.N // 2)[0]
    weights = missing_acceleration(pulse, s.recording, order=order)[0]
    floor = scale * discovery.noise_floor.get(channel, 0.0)
    return _Maps(
        over=over,
        labels=labels,
        edges=_cells(over),
        error=scale * (s.measured[:, c] - s.baseline[:, c]),
        lacking=lacking,
        channel=channel,
        units=(f"[{read}]", f"[{read}/s{'²' if order == 2 else ''}]"),
        floor=floor,
        usual=floor * float(np.linalg.norm(weights)),
    )


ERROR_COLOURS, SIGNED_COLOURS = "YlOrRd", "RdBu_r"
# Steps of a colour scale in a browser.
COLOUR_STEPS = 33
ERROR_TITLE = "baseline: rms error"


def _map_view(discovery: SearchResult) -> MapView:
    """The maps with pan and zoom."""
    m = _maps(discovery)
    largest, strongest = m.limits

    def colours(name: str) -> tuple[str, ...]:
        return tuple(to_hex(colour) for colour in colormaps[name](np.linspace(0, 1, COLOUR_STEPS)))

    first = PlaneMap(ERROR_TITLE, m.error, m.units[0], colours(ERROR_COLOURS), (0.0, largest), squared=True)
    signed, limits = colours(SIGNED_COLOURS), (-strongest, strongest)
    others = [PlaneMap(title, v, m.units[1], signed, limits) for title, v in m.lacking.items()]
    x, y = ((float(e[0]), float(e[-1])) for e in m.edges)
    return MapView(
        x=m.over[0],
        y=m.over[1],
        labels=(m.labels[0], m.labels[1]),
        ranges=(x, y),
        maps=(first, *others),
        cells=MAP_CELLS,
        least=MIN_CELL_SAMPLES,
    )


@figure(
    "map",
    section="where",
    caption=_map_caption,
    description="Maps of the held-out error and of the missing acceleration over speed and position.",
    zoom=_map_view,
)
def residual_map(discovery: SearchResult) -> Figure:
    """Error of the baseline, and missing acceleration before and after, over speed and deflection."""
    m = _maps(discovery)
    largest, strongest = m.limits
    maps = [(ERROR_TITLE, np.ma.sqrt(m.mean(m.error**2)))]
    maps += [(title, m.mean(values)) for title, values in m.lacking.items()]
    figure = blank(10.0 if len(maps) > 2 else 7.5, 3.5)
    axes = figure.subplots(1, len(maps), squeeze=False, sharey=True)[0]
    sized = {"vmin": 0.0, "vmax": largest, "cmap": ERROR_COLOURS}
    signed = {"vmin": -strongest, "vmax": strongest, "cmap": SIGNED_COLOURS}
    meshes = []
    for ax, (title, values), style in zip(axes, maps, [sized] + [signed] * len(m.lacking), strict=True):
        meshes.append(ax.pcolormesh(*m.edges, values.T, **style))
        ax.set_facecolor(NO_DATA)
        ax.grid(False)
        ax.set_title(title)
        ax.set_xlabel(m.labels[0])
    axes[0].set_ylabel(m.labels[1])
    what = "acceleration" if m.units[1].endswith("²]") else "change"
    bar_style = {"orientation": "horizontal", "pad": 0.02}
    first = figure.colorbar(meshes[0], ax=[axes[0]], aspect=20, **bar_style)
    first.set_label(f"rms error of {m.channel} {m.units[0]}")
    second = figure.colorbar(meshes[1], ax=axes[1:].tolist(), aspect=20 * (len(maps) - 1), **bar_style)
    second.set_label(f"missing {what} of {m.channel} {m.units[1]}")
    for bar in (first, second):
        bar.locator = MaxNLocator(5)
        bar.update_ticks()
    return figure


def _largest(maps: list[np.ma.MaskedArray]) -> float:
    return max((float(np.ma.max(np.abs(m))) for m in maps if m.count()), default=0.0)
