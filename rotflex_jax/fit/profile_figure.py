"""Figure of profiles: the drop of the likelihood over a quantity, with the parabola of its Wald interval."""

from collections.abc import Sequence

import numpy as np
import scipy
from matplotlib.figure import Figure

from rotflex_jax.fit.profile_result import Profile
from rotflex_jax.text.colours import BASELINE, FINAL, HIGHLIGHT, MUTED
from rotflex_jax.text.numbers import readable
from rotflex_jax.text.plotting import blank, legend_above, styled


@styled
def profile_figure(profiles: Sequence[Profile]) -> Figure:
    """One panel for each profile, at most three in a row."""
    columns = min(len(profiles), 3)
    rows = -(-len(profiles) // columns)
    figure = blank(10.0 if columns > 1 else 5.5, 2.7 * rows + 0.4)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    limit = scipy.stats.chi2.ppf(0.95, 1)
    for ax, p in zip(grid, profiles, strict=False):
        scale, unit = readable(1.0, p.unit)
        fine = np.linspace(p.values[0], p.values[-1], 300)
        for low, high in p.regions():
            ax.axvspan(
                scale * max(low, p.values[0]), scale * min(high, p.values[-1]), color=HIGHLIGHT, zorder=0
            )
        ax.plot(scale * fine, p.root_at(fine) ** 2, color=FINAL, lw=1.5, label="profile")
        ax.plot(scale * p.values, p.drop, "o", color=FINAL, ms=3)
        if np.isfinite(p.std):
            parabola = np.square((fine - p.value) / p.std)
            ax.plot(scale * fine, parabola, color=BASELINE, lw=1.0, ls=(0, (4, 2)), label="parabola (Wald)")
        ax.axhline(limit, color=MUTED, lw=0.8, label="95 %")
        ax.set_ylim(0, max(1.6 * limit, min(1.1 * float(p.drop.max()), 3 * limit)))
        ax.set_title(p.shape)
        ax.set_xlabel(f"{p.name} [{unit}]" if unit else p.name)
        ax.locator_params(axis="x", nbins=5)
    for ax in grid[::columns]:
        ax.set_ylabel("2 x loss of log-likelihood / factor [-]")
    for ax in grid[len(profiles) :]:
        ax.set_visible(False)
    legend_above(figure, grid[: len(profiles)])
    return figure
