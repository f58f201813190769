"""Figures of experiments: the input, its spectrum, and the predicted or recorded outputs."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rotflex_jax.experiment.result import Experiment, Segment, SequentialResult
from rotflex_jax.mechanism.quantity import input_word
from rotflex_jax.text.colours import BASELINE, FAINT, FINAL, FURTHER, INK
from rotflex_jax.text.plotting import blank, legend_above, plain_ticks, styled, thinned

# Length of the input and of the differences that are drawn [s].
INPUT_SECONDS, DIFFERENCE_SECONDS = 4.0, 1.0


@styled
def experiment_figure(e: Experiment) -> Figure:
    """Input over time, its spectrum, and the predicted difference of the two hypotheses.

    The difference is the residual of a run after the best fit with the wrong effect. It is drawn with a band
    of two standard deviations of the sensor noise. It may be within the band at every sample, because
    evidence adds up.
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
    ax.set_ylabel(f"{input_word(e.input_unit)} [{e.input_unit}]")
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
    ax.set_ylabel(f"{channel} [m{e.units[c]}]")


def _evidence(ax: Axes, e: Experiment, c: int, channel: str) -> None:
    """Cumulative evidence of this channel, without the correlation between channels."""
    for k, colour, style in ((0, FINAL, "-"), (1, BASELINE, "--")):
        nats = np.cumsum((e.differences[k, :, c] / e.noise[channel]) ** 2) / 2
        ax.plot(*thinned(e.t, nats), color=colour, lw=1.4, ls=style)
    ax.set_title(f"evidence in {channel} so far")
    ax.set_ylabel("log-likelihood [nat]")


def _rival_colours(count: int) -> tuple[str, ...]:
    """One colour for each rival."""
    known = (FINAL, BASELINE, *FURTHER)
    return tuple(known[k % len(known)] for k in range(count))


@styled
def segment_figure(s: Segment) -> Figure:
    """The next input, and the difference of each model's prediction from the mean of all predictions."""
    figure = blank(10.0, 2.4 + 1.7 * len(s.channels))
    axes = figure.subplots(1 + len(s.channels), 1, sharex=True)
    axes[0].step(s.t, s.u, where="post", color=INK, lw=0.9)
    axes[0].set_title(f"{s.input}, {s.setting}")
    axes[0].set_ylabel(f"{input_word(s.input_unit)} [{s.input_unit}]")
    for c, (ax, channel) in enumerate(zip(axes[1:], s.channels, strict=True)):
        mean = s.outputs[:, :, c].mean(axis=0)
        for name, y, colour in zip(s.rivals, s.outputs[:, :, c], _rival_colours(len(s.rivals)), strict=True):
            ax.plot(*thinned(s.t, 1e3 * (y - mean)), color=colour, lw=1.2, label=name)
        ax.set_title(f"{channel}, less the mean of the models")
        ax.set_ylabel(f"{channel} [m{s.units[c]}]")
    axes[-1].set_xlabel("time [s]")
    legend_above(figure, axes[1:])
    return figure


@styled
def sequential_figure(r: SequentialResult) -> Figure:
    """Probability of each model over the time on the rig, the voltage, and the recorded outputs."""
    channels = r.runs[0].channels if r.runs else ()
    figure = blank(10.0, 4.2 + 1.5 * len(channels))
    axes = figure.subplots(2 + len(channels), 1, sharex=True, squeeze=False)[:, 0]
    seconds = [0.0, *(s.seconds for s in r.history)]
    for name, colour in zip(r.rivals, _rival_colours(len(r.rivals)), strict=True):
        p = [r.prior[name], *(s.probabilities[name] for s in r.history)]
        axes[0].plot(seconds, [100 * x for x in p], color=colour, marker="o", ms=3.5, lw=1.3, label=name)
    axes[0].axhline(100 * (1 - r.error), color=FAINT, lw=1.0, ls="--")
    axes[0].set_ylim(-3, 103)
    axes[0].set_ylabel("probability [%]")
    axes[0].set_title(f"{r.verdict} (dashed: where it stops)")
    began = 0.0
    for run in r.runs:
        t = began + run.t - run.t[0]
        axes[1].plot(*thinned(t, run.u.astype(float)), color=INK, lw=0.8)
        for ax, y in zip(axes[2:], run.y.T, strict=True):
            ax.plot(*thinned(t, 1e3 * y.astype(float)), color=INK, lw=0.8)
        began += run.N * run.Ts
    axes[1].set_ylabel(f"{input_word(r.input_unit)} [{r.input_unit}]")
    units = r.runs[0].units if r.runs else ()
    for ax, channel, unit in zip(axes[2:], channels, units, strict=True):
        ax.set_ylabel(f"{channel} [m{unit}]")
    axes[-1].set_xlabel("time on the rig [s]")
    legend_above(figure, axes[:1])
    return figure
