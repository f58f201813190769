"""Figure of runs in closed loop."""

import math
from collections.abc import Sequence

from matplotlib.figure import Figure

from rotflex_jax.control.closed_loop import ClosedLoop
from rotflex_jax.text.colours import AXIS, BASELINE, FINAL, FURTHER, MEASURED, MUTED
from rotflex_jax.text.numbers import readable, unit_text
from rotflex_jax.text.plotting import blank, legend_above, styled, thinned


@styled
def loop_figure(runs: Sequence[ClosedLoop], names: Sequence[str]) -> Figure:
    """Position, error, voltage and observed load of runs over time.

    Runs for which there is no colour of their own are drawn in one colour below the others.
    """
    run = runs[0]
    figure = blank(10.0, 6.4)
    axes = figure.subplots(4, 1, sharex=True)
    controller = run.controller
    per, unit = readable(1.0, run.unit)
    t = run.t
    axes[0].plot(*thinned(t, per * run.motion.reference), color=MEASURED, lw=2.2, label="reference")
    colours = (FINAL, BASELINE, *FURTHER)
    for k, (each, name) in enumerate(zip(runs, names, strict=True)):
        own = k < len(colours)
        style = {"color": colours[k] if own else AXIS, "lw": 1.0, "zorder": 2 if own else 1.5}
        label = name if own else f"{len(runs) - len(colours)} more"
        axes[0].plot(*thinned(each.t, per * each.position), label=label, **style)
        axes[1].plot(*thinned(each.t, per * each.error), **style)
        axes[2].plot(*thinned(each.t, each.voltage), **style)
        axes[3].plot(*thinned(each.t, each.load), **style)
    for way in (-1, 1):
        if any(each.saturated for each in runs):
            axes[2].axhline(way * controller.limit, color=MUTED, lw=0.7)
    axes[0].set_ylabel(f"{controller.port} [{unit}]")
    axes[1].set_ylabel(f"error [{unit}]")
    axes[2].set_ylabel(f"{controller.input_name} [{controller.model.mechanism.units.input}]")
    effort = unit_text(controller.model.mechanism.units.effort)
    axes[3].set_ylabel(f"{controller.states[-1]} [{effort}]")
    axes[3].set_xlabel("time [s]")
    for ax in axes:
        ax.margins(x=0)
    if math.isfinite(run.rms):
        axes[1].axhline(0.0, color=MUTED, lw=0.7, zorder=1)
    legend_above(figure, axes)
    return figure
