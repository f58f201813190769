"""Figures of tests of models: correlations of the residuals, and the frequency response."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rotflex_jax.discover.explanation import Explanation
from rotflex_jax.discover.result import SearchResult
from rotflex_jax.models.residual_tests import FrequencyResponse, ResidualTests
from rotflex_jax.report.figures.registry import figure
from rotflex_jax.text.colours import BASELINE, BASELINE_LINE, FAINT, FINAL, MEASURED, MUTED
from rotflex_jax.text.plotting import blank, legend_above, plain_ticks

# Coherence below which an estimate of the response is drawn faint.
LEAST_COHERENCE = 0.5


def model_colours(names: Mapping[str, object]) -> dict[str, str]:
    """Name of a model -> its colour: one for the baseline, another for all other models."""
    return {name: BASELINE if name == "baseline" else FINAL for name in names}


def residual_figure(tests: Mapping[str, ResidualTests]) -> Figure:
    """Autocorrelation (left) and correlation with the input (right) of each channel's residual.

    Args:
        tests: Name of the model -> its tests.
    """
    colours, first = model_colours(tests), next(iter(tests.values()))
    figure = blank(10.0, 2.3 * len(first.channels) + 0.5)
    axes = figure.subplots(len(first.channels), 2, sharex="col", squeeze=False)
    lag, both = 1e3 * first.Ts * first.lags, 1e3 * first.Ts * first.input_lags
    for c, channel in enumerate(first.channels):
        own, cross = axes[c]
        own.axhspan(-first.white_band, first.white_band, color=FAINT, lw=0, label="99 % band")
        for name, t in tests.items():
            line = BASELINE_LINE if name == "baseline" else "-"
            style: dict[str, Any] = {"color": colours[name], "ls": line, "label": name}
            filled = "none" if name == "baseline" else "full"
            own.plot(lag, t.autocorrelation[c], marker="o", ms=3, fillstyle=filled, lw=1.1, **style)
            cross.plot(both, t.cross_correlation[c], lw=1.3, **style)
            band = t.input_band[c]
            for edge in (-band, band):
                cross.axhline(edge, color=colours[name], lw=0.9, ls=(0, (3, 2)))
        cross.axvline(0.0, color=MUTED, lw=0.8)
        own.set_title(f"{channel}: autocorrelation")
        cross.set_title(f"{channel}: correlation with the input")
        own.set_ylabel("correlation [–]")
    axes[-1, 0].set_xlabel("lag [ms]")
    axes[-1, 1].set_xlabel("residual after the input by [ms]")
    legend_above(figure, axes.ravel())
    return figure


def response_figure(
    measured: FrequencyResponse,
    simulated: Mapping[str, FrequencyResponse],
    channels: Mapping[str, str],
    input_unit: str,
) -> Figure:
    """Magnitude, phase and coherence of each channel, measured and simulated.

    Args:
        measured: Frequency response of the data.
        simulated: Name of the model -> frequency response of its run.
        channels: Channel -> unit.
        input_unit: Unit of the input.
    """
    colours, f = model_colours(simulated), measured.frequency
    figure = blank(10.0, 6.2)
    axes = figure.subplots(3, len(channels), sharex=True, squeeze=False, height_ratios=(1.6, 1.2, 0.8))
    listed = [("measured", measured, MEASURED, 2.6)]
    listed += [(name, r, colours[name], 1.2) for name, r in simulated.items()]
    for c, (channel, unit) in enumerate(channels.items()):
        magnitude, phase, coherence = axes[:, c]
        clear = measured.coherence[c] >= LEAST_COHERENCE
        turned = _unwrapped(measured.phase_deg[c], clear)
        for name, r, colour, width in listed:
            # Phases are drawn within half a turn of the measured phase.
            degrees = turned + (r.phase_deg[c] - turned + 180.0) % 360.0 - 180.0
            style: dict[str, Any] = {"color": colour, "ls": BASELINE_LINE if name == "baseline" else "-"}
            magnitude.plot(f, r.magnitude_db[c], lw=0.7, alpha=0.35, **style)
            magnitude.plot(f, np.where(clear, r.magnitude_db[c], np.nan), lw=width, label=name, **style)
            phase.plot(f, np.where(clear, degrees, np.nan), lw=width, **style)
            coherence.plot(f, r.coherence[c], lw=width, **style)
        magnitude.set_title(channel)
        magnitude.set_ylabel(f"magnitude [dB of {unit}/{input_unit}]")
        phase.set_ylabel("phase [deg]")
        coherence.set_ylabel("coherence [–]")
        coherence.set_ylim(0, 1.02)
        coherence.set_xlabel("frequency [Hz]")
        magnitude.set_xscale("log")
        magnitude.set_xlim(f[0], f[-1])
        plain_ticks(coherence.xaxis)
    legend_above(figure, axes.ravel())
    return figure


def _unwrapped(phase: np.ndarray, clear: np.ndarray) -> np.ndarray:
    """A phase [deg] unwrapped at the clear frequencies; elsewhere the value at the last clear one below."""
    at = np.flatnonzero(clear)
    if not len(at):
        return phase
    followed = np.rad2deg(np.unwrap(np.deg2rad(phase[at])))
    return followed[np.maximum(np.searchsorted(at, np.arange(len(phase)), side="right") - 1, 0)]


@figure(
    "residual_tests",
    section="residuals",
    caption="What one-step predictions leave. Where a model is right, its residual is white: all points but "
    "the one at lag zero lie in the grey band, 99 of 100. It is independent of the past input: right of zero "
    "the line stays between its dashed ones. Left of zero it shows feedback. An encoder that rounds leaves "
    "correlation of its own where the machine rests.",
    description="Autocorrelation of the residuals and their correlation with the input, with 99 % bands.",
)
def residuals(discovery: SearchResult, explanation: Explanation) -> Figure | None:
    """Whiteness of the residuals, and their correlation with the input."""
    if explanation.tests is None or not explanation.tests.residuals:
        return None
    return residual_figure(explanation.tests.residuals)


@figure(
    "frequency_response",
    section="residuals",
    caption="Response to the input, measured and of free runs under the same input, estimated in the same "
    "way. Coherence is the share of the output that follows the input linearly; where the measured one is "
    f"below {LEAST_COHERENCE:g}, lines are faint. Under feedback the measured response is biased, and so is "
    "the simulated one.",
    description="Bode diagram with coherence: magnitude and phase of the outputs over the input.",
)
def responses(discovery: SearchResult, explanation: Explanation) -> Figure | None:
    """Frequency responses of the data and of the models, with coherence."""
    tests = explanation.tests
    if tests is None:
        return None
    r = tests.recording
    mechanism = discovery.baseline.model.mechanism
    units = {c: r.unit(c) for c in mechanism.channels}
    return response_figure(tests.measured, tests.simulated, units, r.input_unit)
