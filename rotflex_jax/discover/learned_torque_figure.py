"""The figure of a learned torque: its map where the recordings have been, two profiles, and its formula."""

import numpy as np
from matplotlib.figure import Figure

from rotflex_jax.discover.learned_torque import LearnedTorqueResult
from rotflex_jax.parameters import HALF_WIDTH_95
from rotflex_jax.text.colours import BASELINE, FINAL, INK, MUTED
from rotflex_jax.text.numbers import equation, readable
from rotflex_jax.text.plotting import blank, legend_above, styled

# Number of cells of the map along each axis, and of points of a profile.
LEARNED_MAP_CELLS, PROFILE_POINTS = 36, 200


@styled
def learned_figure(result: LearnedTorqueResult) -> Figure:
    """Map over position and speed, grey where the recordings have not been, and a profile along each axis."""
    effect = result.effect
    ranges = (effect.position, effect.speed)
    edges = tuple(np.linspace(*ends, LEARNED_MAP_CELLS + 1) for ends in ranges)
    middles = [(e[1:] + e[:-1]) / 2 for e in edges]
    torque, _ = result.torque(middles[0][:, None], middles[1][None, :])
    shown = np.ma.masked_where(~result.visited(edges), torque)
    own = result.model.mechanism.units
    (a, length), (b, rate) = (readable(1.0, unit) for unit in (own.motion, f"{own.motion}/s"))
    limit = float(np.ma.max(np.abs(shown))) if shown.count() else 0.0
    figure = blank(10.0, 3.3)
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.25, 1.0, 1.0))
    right.sharey(middle)
    mesh = left.pcolormesh(
        a * edges[0], b * edges[1], shown.T, cmap="RdBu_r", vmin=-(limit or 1.0), vmax=limit or 1.0
    )
    left.set_facecolor("#dfe3e7")
    left.grid(False)
    left.set_title(f"learned torque at the {result.at}")
    left.set_xlabel(f"position of the {result.at} [{length}]")
    left.set_ylabel(f"speed of the {result.at} [{rate}]")
    figure.colorbar(mesh, ax=left, label=f"torque [{own.effort}]")
    usual = [float(np.median(x)) for x in (result.position, result.speed)]
    # The profile along the position is taken at a usual speed, but not at rest.
    moving = float(np.median(np.abs(result.speed)))
    w, q = np.linspace(*effect.speed, PROFILE_POINTS), np.linspace(*effect.position, PROFILE_POINTS)
    for ax, at, x in (
        (middle, (np.full(PROFILE_POINTS, usual[0]), w), b * w),
        (right, (q, np.full(PROFILE_POINTS, moving)), a * q),
    ):
        mean, std = result.torque(*at)
        half = HALF_WIDTH_95 * std
        ax.fill_between(x, mean - half, mean + half, color=FINAL, alpha=0.3, lw=0, label="95 % band")
        ax.plot(x, mean, color=FINAL, lw=1.6, label="learned")
        if result.formula.terms:
            ax.plot(x, result.read_torque(*at), color=BASELINE, lw=1.2, ls=(0, (4, 2)), label="formula")
        ax.axhline(0.0, color=MUTED, lw=0.7)
        ax.set_ylabel(f"torque [{own.effort}]")
    middle.set_title(f"at {a * usual[0]:.0f} {length}")
    middle.set_xlabel(f"speed of the {result.at} [{rate}]")
    right.set_title(f"at {b * moving:.0f} {rate}")
    right.set_xlabel(f"position of the {result.at} [{length}]")
    legend_above(figure, [middle])
    if result.formula.terms:
        figure.suptitle(
            equation(f"tau = {result.reading}; position q in {own.motion}, speed w in {own.motion}/s"),
            fontsize=9.5,
            color=INK,
            x=0.99,
            ha="right",
        )
    return figure
