"""Figure of Volterra kernels: linear kernel as stems, quadratic kernel as a map, of model and data."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rotflex_jax.kernels.result import Kernels
from rotflex_jax.text.colours import FINAL, INK, MEASURED, NO_DATA
from rotflex_jax.text.numbers import readable
from rotflex_jax.text.plotting import blank, legend_above, styled

# Difference [standard errors] with the full colour, so that a difference below one is pale.
FULL_COLOUR = 5.0
# A quadratic kernel below this number of its standard errors may be chance and is drawn pale.
MIN_SCALE_STANDARD_ERRORS = 4.0


@styled
def kernel_figure(
    model: Kernels, data: Kernels | None = None, names: tuple[str, str] = ("model", "data")
) -> Figure:
    """Figure of `h1` over the lag and `h2` over two lags; with data also of the standardised differences.

    Bars show two standard errors. Maps of model and data have the same scale.

    Args:
        model: Kernels of a physical model.
        data: Identified kernels of the same channel, sampling period and memory.
        names: Names of `model` and `data` in the figure.

    Raises:
        InputError: Channel, sampling period or memory of `model` and `data` differ.
    """
    if data is None:
        figure = blank(8.0, 3.3)
        stems, area = figure.subplots(1, 2, width_ratios=(1.3, 1.0))
        _stems(stems, [(model, names[0], FINAL)])
        _maps(figure, [area], [(model, f"h2 of {model.channel}, {names[0]}")])
        return figure
    pair = model.against(data)
    figure = blank(10.0, 6.0)
    rows: Any = figure.subfigures(2, 1, height_ratios=(1.0, 1.35))
    top, bottom = rows
    stems, errors = top.subplots(1, 2, width_ratios=(2.0, 1.0))
    _stems(stems, [(pair.second, names[1], MEASURED), (pair.first, names[0], FINAL)])
    _deviations(errors, pair.z1, model.lags, pair.rms[0])
    areas = bottom.subplots(1, 3, sharey=True)
    titled = [
        (k, f"h2 of {k.channel}, {name}") for k, name in zip((pair.first, pair.second), names, strict=True)
    ]
    _maps(bottom, list(areas[:2]), titled)
    _deviation_map(bottom, areas[2], pair.z2, model, pair.rms[1])
    legend_above(top, [stems])
    return figure


def _stems(ax: Axes, sets: list[tuple[Kernels, str, str]]) -> None:
    """Draws stems side by side, so that both sets stay visible where they are equal."""
    scale, unit = readable(1.0, sets[0][0].output_unit)
    for place, (kernels, name, colour) in enumerate(sets):
        shift = 0.24 * kernels.Ts * (place - (len(sets) - 1) / 2)
        t, h = kernels.lags + shift, scale * kernels.h1
        ax.vlines(t, 0.0, h, color=colour, lw=2.2, alpha=0.75)
        bars = 2 * scale * kernels.errors[0]
        ax.errorbar(t, h, bars, fmt="o", ms=4.0, color=colour, ecolor=INK, elinewidth=0.9, label=name)
    ax.axhline(0.0, color=INK, lw=0.8)
    ax.set_title(f"h1 of {sets[0][0].channel}")
    ax.set_xlabel("lag [s]")
    ax.set_ylabel(f"h1 [{unit}/{sets[0][0].input_unit}]")


def _deviations(ax: Axes, z: np.ndarray, lags: np.ndarray, rms: float) -> None:
    ax.axhspan(-2, 2, color="#e8ecf0", lw=0)
    ax.axhline(0.0, color=INK, lw=0.8)
    known = np.isfinite(z)
    ax.plot(lags[known], z[known], "o", ms=4.0, color=INK)
    limit = float(np.max(np.abs(z[known]), initial=3.0))
    ax.set_ylim(-1.15 * limit, 1.15 * limit)
    ax.set_title(f"difference, rms {rms:.2g} standard errors")
    ax.set_xlabel("lag [s]")
    ax.set_ylabel("standard errors")


def _edges(kernels: Kernels) -> np.ndarray:
    return kernels.Ts * (np.arange(kernels.memory + 1) - 0.5)


def _square(ax: Axes, title: str) -> None:
    ax.set_aspect("equal")
    ax.grid(False)
    ax.set_title(title)
    ax.set_xlabel("first lag [s]")
    ax.set_ylabel("second lag [s]")
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.yaxis.set_major_locator(MaxNLocator(5))


def _maps(figure: Any, areas: list[Axes], sets: list[tuple[Kernels, str]]) -> None:
    scale, unit = readable(1.0, sets[0][0].output_unit)
    sizes = (max(np.max(np.abs(k.h2)), MIN_SCALE_STANDARD_ERRORS * np.max(k.errors[1])) for k, _ in sets)
    limit = scale * float(max(sizes)) or 1.0
    map_style = {"vmin": -limit, "vmax": limit, "cmap": "RdBu_r"}
    for ax, (kernels, title) in zip(areas, sets, strict=True):
        mesh = ax.pcolormesh(_edges(kernels), _edges(kernels), scale * kernels.h2, **map_style)
        _square(ax, title)
        if len(areas) > 1:
            ax.label_outer()
    bar = figure.colorbar(mesh, ax=areas, shrink=0.85, pad=0.02)
    bar.set_label(f"h2 [{unit}/{sets[0][0].input_unit}²]")


def _deviation_map(figure: Any, ax: Axes, z: np.ndarray, kernels: Kernels, rms: float) -> None:
    mesh = ax.pcolormesh(
        _edges(kernels), _edges(kernels), z, vmin=-FULL_COLOUR, vmax=FULL_COLOUR, cmap="PuOr_r"
    )
    ax.set_facecolor(NO_DATA)
    _square(ax, f"difference, rms {rms:.2g}")
    ax.label_outer()
    figure.colorbar(mesh, ax=[ax], shrink=0.85, pad=0.02, extend="both").set_label("standard errors")
