"""The next experiment as a figure: what to play, its spectrum, and what it will show."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rotflex_jax.experiment.result import Experiment
from rotflex_jax.text.colours import BASELINE, FAINT, FINAL, INK
from rotflex_jax.text.plotting import blank, legend_above, plain_ticks, styled, thinned

# Seconds of the input, and of the differences, that are drawn sample by sample.
INPUT_SECONDS, DIFFERENCE_SECONDS = 4.0, 1.0


@styled
def experiment_figure(e: Experiment) -> Figure:
    """Input in time, its spectrum, and the predicted difference of the two hypotheses.

    The difference is what the best fit by the wrong effect leaves of a run, beside the band of two
    standard deviations of the sensor noise. It may lie within the band at every sample: evidence adds up.
    """
    figure = blank(10.0, 2.6 + 1.7 * len(e.channels))
    axes = figure.subplots(1 + len(e.channels), 2, width_ratios=(1.7, 1.0), squeeze=False)
    _input(axes[0, 0], e)
    _spectrum(axes[0, 1], e)
    for c, channel in enumerate(e.channels):
        _difference(axes[c + 1, 0], e, c, channel)
        _evidence(axes[c + 1, 1], e, c, channel)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    legend_above(figure, axes[1:, 0])
    return figure


def _input(ax: Axes, e: Experiment) -> None:
    count = min(len(e.u), round(INPUT_SECONDS / e.Ts))
    ax.step(e.t[:count], e.u[:count], where="post", color=INK, lw=0.9)
    ax.axhline(e.limits.voltage, color=BASELINE, lw=1.0, ls="--")
    ax.axhline(-e.limits.voltage, color=BASELINE, lw=1.0, ls="--")
    whole = f", the first {count * e.Ts:g} s" if count < len(e.u) else ""
    ax.set_title(f"{e.chosen.input}, {e.chosen.setting}{whole} (dashed: limit)")
    ax.set_ylabel("voltage [V]")
    ax.set_xlabel("time [s]")


def _spectrum(ax: Axes, e: Experiment) -> None:
    power = np.abs(np.fft.rfft(e.u)) ** 2
    f = np.fft.rfftfreq(len(e.u), e.Ts)
    fraction = np.cumsum(power) / np.sum(power)
    ax.semilogx(f[1:], 100 * fraction[1:], color=INK, lw=1.4)
    ax.set_ylim(0, 100)
    ax.set_title("power below a frequency")
    plain_ticks(ax.xaxis)
    ax.set_ylabel("share of the power [%]")
    ax.set_xlabel("frequency [Hz]")


def _difference(ax: Axes, e: Experiment, c: int, channel: str) -> None:
    band = 2e3 * e.noise[channel]
    ax.axhspan(-band, band, color=FAINT, lw=0, label="± 2 σ of the sensor noise")
    one, other = e.separates
    curves = ((0, f"{one} true, less {other} at its best", FINAL, "-"),)
    curves += ((1, f"{other} true, less {one} at its best", BASELINE, "--"),)
    first = len(e.u) // 2
    here = slice(first, first + max(2, round(DIFFERENCE_SECONDS / e.Ts)))
    for k, label, colour, style in curves:
        y = 1e3 * e.differences[k, here, c]
        ax.plot(e.t[here], y, color=colour, lw=1.3, ls=style, label=label)
    ax.set_title(f"difference in {channel}, {DIFFERENCE_SECONDS:g} s of it")
    ax.set_ylabel(f"{channel} [mrad]")


def _evidence(ax: Axes, e: Experiment, c: int, channel: str) -> None:
    """Evidence of this channel as it adds up, correlation between channels left out."""
    for k, colour, style in ((0, FINAL, "-"), (1, BASELINE, "--")):
        nats = np.cumsum((e.differences[k, :, c] / e.noise[channel]) ** 2) / 2
        ax.plot(*thinned(e.t, nats), color=colour, lw=1.4, ls=style)
    ax.set_title(f"evidence in {channel} so far")
    ax.set_ylabel("log-likelihood [nat]")
