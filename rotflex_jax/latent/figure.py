"""Figures of the latent torque: over speed, position and deflection, in time and by frequency."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rotflex_jax.latent.result import Abscissa, LatentTorque
from rotflex_jax.parameters import HALF_WIDTH_95
from rotflex_jax.text.colours import BASELINE, FAINT, FINAL, MUTED
from rotflex_jax.text.numbers import readable
from rotflex_jax.text.plotting import blank, legend_above, styled, thinned

# The axis of a torque spans at least this share of the motor's torque, so that noise is drawn small.
MIN_SCALE_OF_MOTOR = 0.01


@styled
def latent_maps(before: LatentTorque, after: LatentTorque | None = None) -> Figure:
    """Mean torque at each port over speed and position, without and with shares of damper and spring."""
    figure = blank(10.0, 2.5 * len(before.ports) + 0.4)
    grid = figure.subplots(len(before.ports), 4, squeeze=False)
    floor = MIN_SCALE_OF_MOTOR * before.scale
    for row, port in zip(grid, before.ports, strict=True):
        terms = [n for n in before.linear if n.startswith(f"{port}.")]
        damper, spring = ([n for n in terms if n.endswith(what)] for what in (".viscous", ".spring"))
        for torque, style in _styles(before, after):
            _curve(row[0], torque, port, "speed", style)
            _curve(row[1], _with_terms(torque, damper, before, after), port, "speed", style)
            _curve(row[2], torque, port, "position", style)
            if spring and after is not None:
                _curve(row[3], _with_terms(torque, spring, before, after), port, "position", style)
            else:
                _curve(row[3], torque, port, "voltage", style)
        row[0].set_title("what the model lacks")
        row[1].set_title("+ share of the damper" if damper else "no damper here")
        row[2].set_title("what the model lacks")
        row[3].set_title("+ share of the spring" if spring and after is not None else "what the model lacks")
        for ax in row:
            ax.axhline(0.0, color=MUTED, lw=0.7, zorder=1)
            ax.locator_params(nbins=5)
            low, high = ax.get_ylim()
            ax.set_ylim(min(low, -floor), max(high, floor))
        row[0].set_ylabel(f"torque at the {port} [{before.effort}]")
    legend_above(figure, grid.ravel())
    return figure


def _with_terms(
    torque: LatentTorque, terms: list[str], before: LatentTorque, after: LatentTorque | None
) -> LatentTorque:
    """The baseline's torque plus the share of its damper or spring that compensates for the missing effect.

    The share is the difference from the same terms of the better model `after`; without such a model, the
    whole torques of the terms are added. The torque of the better model itself is returned unchanged.
    """
    if not terms or (after is not None and torque is not before):
        return torque
    return torque.given_back(*terms, beyond=after)


@styled
def latent_time(before: LatentTorque, after: LatentTorque | None = None) -> Figure:
    """The torque at each port over time, with its band, and over frequency."""
    figure = blank(10.0, 2.1 * len(before.ports) + 0.5)
    grid = figure.subplots(len(before.ports), 2, squeeze=False, width_ratios=(1.7, 1.0), sharex="col")
    last = before.recording == before.recording[-1]
    for (left, right), port in zip(grid, before.ports, strict=True):
        i, floor = before.ports.index(port), MIN_SCALE_OF_MOTOR * before.scale
        for torque, style in _styles(before, after):
            t, d, half = torque.time[last], torque.torque[last, i], HALF_WIDTH_95 * torque.std[last, i]
            left.fill_between(t, d - half, d + half, color=style["color"], alpha=0.22, lw=0)
            left.plot(*thinned(t, d), lw=0.9, **style)
            f, size = torque.spectrum(port)
            right.loglog(f, size, lw=1.3, **style)
        for line in (after or before).periodic(port):
            right.axvline(line.frequency, color=MUTED, lw=0.9, ls=":", zorder=1)
            right.annotate(
                f"{line.frequency:.3g} Hz",
                (line.frequency, 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(2, -9),
                textcoords="offset points",
                fontsize="small",
            )
        low, high = left.get_ylim()
        left.set_ylim(min(low, -floor), max(high, floor))
        left.margins(x=0)
        least = 1e-3 * floor
        right.set_ylim(least, max(right.get_ylim()[1], 10 * least))
        left.set_ylabel(f"torque at the {port} [{before.effort}]")
        right.set_ylabel(f"density [{before.effort}/√Hz]")
    grid[-1, 0].set_xlabel("time [s]")
    grid[-1, 1].set_xlabel("frequency [Hz]")
    grid[0, 0].set_title("what the model lacks, in time")
    grid[0, 1].set_title("by frequency")
    legend_above(figure, grid.ravel())
    return figure


def _styles(before: LatentTorque, after: LatentTorque | None) -> list[tuple[LatentTorque, dict[str, Any]]]:
    styles: list[tuple[LatentTorque, dict[str, Any]]] = [
        (before, {"color": BASELINE, "label": "baseline", "ls": "-"})
    ]
    if after is not None:
        styles.append((after, {"color": FINAL, "label": "final model", "ls": (0, (4, 1.5))}))
    return styles


def _curve(ax: Axes, torque: LatentTorque, port: str, against: Abscissa, style: dict[str, Any]) -> None:
    """Draw a binned mean with its band and, for the baseline, with the spread of single samples."""
    c = torque.curve(port, against)
    scale, read = readable(1.0, c.unit)
    # No line where bins were left out: nothing is known of the torque there. A single one is passed over.
    gaps = np.flatnonzero(np.diff(c.index) > 2) + 1
    at, mean, low, high, spread = (
        np.insert(x, gaps, np.nan) for x in (scale * c.at, c.mean, c.low, c.high, c.spread)
    )
    if style["color"] == BASELINE:
        ax.fill_between(at, mean - spread, mean + spread, color=FAINT, lw=0, label="± spread")
    ax.fill_between(at, low, high, color=style["color"], alpha=0.3, lw=0)
    ax.plot(at, mean, lw=1.5, **style)
    edges = np.isnan(np.r_[np.nan, mean, np.nan])
    alone = edges[:-2] & ~edges[1:-1] & edges[2:]
    ax.vlines(at[alone], low[alone], high[alone], color=style["color"], alpha=0.3, lw=3)
    ax.plot(at[alone], mean[alone], ".", ms=4, color=style["color"])
    ax.set_xlabel(f"{c.against} [{read}]")
    ax.margins(x=0.02)
