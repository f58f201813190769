"""Figure of bands: the measured outputs in their bands, and the sources of uncertainty over time."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from rotflex_jax.text.colours import BASELINE, FINAL, FURTHER, INK, MEASURED, NOISE
from rotflex_jax.text.numbers import readable
from rotflex_jax.text.plotting import blank, legend_above, styled, thinned

if TYPE_CHECKING:
    from rotflex_jax.fit.bands import Bands


@styled
def bands_figure(bands: "Bands") -> Figure:
    """Error of the free run in its band on the left, standard deviation of each source on the right."""
    figure = blank(10.0, 2.4 * len(bands.channels) + 0.5)
    grid = figure.subplots(len(bands.channels), 2, squeeze=False, sharex=True)
    t = bands.recording.t
    colours = (FINAL, BASELINE, *FURTHER, NOISE)
    for c, (left, right) in enumerate(grid):
        scale, unit = readable(1.0, bands.units[c])
        middle = bands.middle[:, c]
        low, high = bands.lower[:, c] - middle, bands.upper[:, c] - middle
        e = bands.recording.channel(bands.channels[c]).astype(float) - middle
        left.plot(*thinned(t, scale * e), color=MEASURED, lw=0.8, label="measured less free run")
        for end, label in ((low, f"band of {100 * bands.level:g} %"), (high, None)):
            left.plot(*thinned(t, scale * end), color=INK, lw=1.0, label=label)
        most = 4 * scale * float(np.median(high - low))
        left.set_ylim(*np.clip(left.get_ylim(), -most, most))
        left.set_ylabel(f"{bands.channels[c]} [{unit}]")
        for (name, part), colour in zip(bands.parts.items(), colours, strict=False):
            right.semilogy(
                *thinned(t, scale * np.maximum(part[:, c], 1e-12)), color=colour, lw=1.0, label=name
            )
        largest = scale * max(float(part[:, c].max()) for part in bands.parts.values())
        right.set_ylim(1e-3 * largest, 2 * largest)
        right.set_ylabel(f"standard deviation [{unit}]")
    for ax in grid[-1]:
        ax.set_xlabel("time [s]")
    legend_above(figure, grid.ravel(), columns=4)
    return figure
