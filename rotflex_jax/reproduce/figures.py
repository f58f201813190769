"""The figures of the paper, drawn from the results of the reproduction."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Real
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rotflex_jax.kernels.figure import kernel_figure
from rotflex_jax.reproduce.experiment import Reproduction
from rotflex_jax.reproduce.models import EvaluatedModel, least_nmse
from rotflex_jax.reproduce.plants import SCENARIOS
from rotflex_jax.reproduce.records import autocovariance
from rotflex_jax.text.colours import BASELINE, FINAL, FURTHER, HIGHLIGHT, INK, MEASURED, MUTED
from rotflex_jax.text.numbers import readable
from rotflex_jax.text.plotting import FigureRegistry, blank, legend_above, plain_ticks

# Length of the part of a signal that is drawn [s].
SIGNAL_SECONDS = 20.0

# Lines also differ in dashes and darkness, so that a page printed in grey stays readable.
AMBER, VIOLET = FURTHER[:2]

FIGURES = FigureRegistry()


@dataclasses.dataclass(frozen=True)
class LineStyle:
    """Style of the line of a model."""

    colour: str
    dashes: object
    marker: str = ""
    width: float = 1.4


def _lines(result: Reproduction) -> dict[str, LineStyle]:
    M = f"M={result.settings.memory}"
    return {
        "linearised joint": LineStyle(BASELINE, (0, (5, 1.5))),
        f"{M} quadratic, LMS": LineStyle(FINAL, "-", "o"),
        f"{M} linear": LineStyle(AMBER, (0, (1, 1.2)), "s", 1.8),
        orthonormal_row(result): LineStyle(VIOLET, (0, (4, 1.2, 1, 1.2)), "^"),
    }


def orthonormal_row(result: Reproduction) -> str:
    """Name of the linear model in orthonormal functions."""
    return next(
        row.name for row in result.rows if row.name.startswith("GOBF") and row.name.endswith(" linear")
    )


def readable_unit(result: Reproduction) -> tuple[float, str]:
    """Factor and unit for the display of the output, such as degrees for an angle."""
    return readable(1.0, result.records.unit)


FILTER_WORDS = {
    "ar1": "first-order",
    "butterworth": "fourth-order Butterworth",
    "fir": "finite-impulse-response",
}


def _input_caption(result: Reproduction) -> str:
    s, first = result.settings, result.records.train[0]
    if result.records.measured:
        many = f", thinned out into {result.records.phases} records" if result.records.phases > 1 else ""
        return (
            f"Figure 7. The input. Recorded{many}; each value is the mean of the voltage over "
            f"{first.Ts:g} s. It was not designed for identification: its variance, its band and whether a "
            "controller made it are what they are."
        )
    return (
        f"Figure 7. The input. Gaussian noise of variance {s.variance:g} V² through a "
        f"{FILTER_WORDS[s.filter]} filter. Assumed: the filter and its corner of {s.cutoff:g} Hz, the "
        f"sampling interval of {s.Ts:g} s, {s.samples} samples."
    )


@FIGURES.figure(
    "figure_07",
    section="signals",
    caption=_input_caption,
    description="Input voltage over time and its autocovariance.",
)
def figure_7(result: Reproduction) -> Figure:
    """The input over time, and its autocovariance."""
    s, first = result.settings, result.records.train[0]
    figure = blank(10.0, 2.7)
    left, right = figure.subplots(1, 2, width_ratios=(2.4, 1))
    part = first.t - first.start < SIGNAL_SECONDS
    left.step(first.t[part], first.u[part], where="post", color=INK, lw=1.0)
    left.set(xlabel="time [s]", ylabel=f"{first.input_name} [{first.input_unit}]", title="input, first part")
    lags = np.arange(9)
    u = first.u - first.u.mean() if result.records.measured else first.u
    seen = [float(np.mean(u[: len(u) - k] * u[k:])) for k in lags if k < len(u)]
    right.bar(lags[: len(seen)], seen, width=0.55, color=MEASURED, label="this record")
    if not result.records.measured:
        right.plot(lags, autocovariance(s, 9), "k_", ms=13, mew=1.8, label="filter")
    right.set(xlabel="lag [samples]", ylabel="autocovariance [V²]", title="autocovariance of the input")
    right.legend()
    return figure


def _output_caption(result: Reproduction) -> str:
    s = result.settings
    if result.records.measured:
        names = ", ".join(dict.fromkeys(r.source for r in result.records.train if r.source))
        return (
            f"Figure 8. The output. Measured{f' ({names})' if names else ''}, every {result.records.Ts:g} s."
        )
    first = "negative" if s.sign > 0 else "positive"
    return (
        f"Figure 8. The output. Simulated, {s.scenario}: {SCENARIOS[s.scenario].about}. All of these are "
        f"assumptions, as is the sign: a positive voltage gives a {first} first deflection. "
        "The paper's figure has no axis."
    )


@FIGURES.figure(
    "figure_08",
    section="signals",
    caption=_output_caption,
    description="Output of the machine over time.",
)
def figure_8(result: Reproduction) -> Figure:
    """The output over time."""
    first, (scale, unit) = result.records.train[0], readable_unit(result)
    figure = blank(10.0, 2.5)
    ax = figure.subplots()
    part = first.t - first.start < SIGNAL_SECONDS
    ax.plot(
        first.t[part], scale * first.channel(result.records.channel)[part], ".-", color=INK, lw=0.8, ms=3.5
    )
    ax.set(xlabel="time [s]", ylabel=f"{result.records.channel} [{unit}]", title="output, the same part")
    return figure


def _span_caption(result: Reproduction) -> str:
    return (
        f"What a memory of {result.settings.memory} samples can hold. The joint remembers its input for "
        "about 0.4 s, so the sampling interval decides; no algorithm comes below these lines on a linear "
        "joint. Computed from the linear model alone, nothing is fitted."
    )


@FIGURES.figure(
    "span",
    section="signals",
    caption=_span_caption,
    description="Least error of a linear model over the sampling interval.",
)
def figure_span(result: Reproduction) -> Figure:
    """Least error of any linear model with the memory of the settings, over the sampling interval."""
    s, joint = result.settings, result.records.joint
    intervals = np.geomspace(1e-3, 0.2, 70)
    figure = blank(10.0, 2.9)
    ax = figure.subplots()
    ax.plot(
        1e3 * intervals, least_nmse(s, joint, intervals, white=True), color=FINAL, lw=2.0, label="white input"
    )
    coloured = least_nmse(s, joint, intervals)
    ax.plot(
        1e3 * intervals,
        coloured,
        color=BASELINE,
        lw=1.6,
        ls=(0, (5, 1.5)),
        label=f"input below {s.cutoff:g} Hz",
    )
    ax.axhline(0.01, color=MUTED, lw=0.8, ls=(0, (1, 1.5)))
    ax.annotate("1 %", (1.0, 0.01), xytext=(2, 3), textcoords="offset points", fontsize=8, color=MUTED)
    ax.axvline(1e3 * result.records.Ts, color=INK, lw=1.0)
    ax.annotate(
        f"this run: {1e3 * result.records.Ts:g} ms",
        (1e3 * result.records.Ts, 0.9),
        xytext=(-4, 0),
        textcoords="offset points",
        ha="right",
        va="top",
        fontsize=8,
        xycoords=("data", "axes fraction"),
    )
    ax.set(
        xscale="log", yscale="log", ylim=(1e-5, 2), xlabel="sampling interval [ms]", ylabel="least NMSE [-]"
    )
    ax.set_title(f"what {s.memory} samples can span of a linear joint")
    plain_ticks(ax.xaxis)
    legend_above(figure, [ax])
    return figure


def _coefficient_caption(result: Reproduction) -> str:
    a, s = result.adaptation, result.settings
    text = (
        f"Figure 9. The quadratic coefficient at the lags {s.coefficient[0]} and {s.coefficient[1]}. "
        f"Its step size, {a.prediction.step_sizes[2]:.3g}, was chosen before the run so that the mean comes "
        f"95 % of its way in {a.prediction.settle:.0f} iterations (ln 20 / (7000 × eigenvalue "
        f"{a.prediction.eigenvalue:.3g})); "
    )
    if s.mu2:
        text = text.replace(
            "was chosen before the run so that the mean comes", "was given; the mean should come"
        )
        text = text.replace(" (ln 20 / (7000 ×", " (ln 20 / (step size ×")
    text += (
        f"measured: {a.settle:.0f}. " if a.settle is not None else "measured: it does not settle on a value. "
    )
    if a.status != "ok":
        text += f"The filter {a.status}. "
    if a.passes > 1:
        text += f"The recordings are too short for that, so they were gone through {a.passes} times. "
    if a.symmetric is not None:
        text += (
            "Right: the same input to a machine whose friction and dead zone are symmetric. It answers a "
            "voltage turned round with its motion turned round, and a quadratic kernel cannot do that: "
            "the coefficient is zero, and what looks like convergence is the noise of the algorithm. "
        )
    machine = "" if result.records.measured else ", filter"
    return f"{text}Assumed: step sizes, sampling interval{machine}, and which coefficient the paper drew."


@FIGURES.figure(
    "figure_09",
    section="adaptation",
    caption=_coefficient_caption,
    description="A quadratic coefficient over the iterations of LMS.",
)
def figure_9(result: Reproduction) -> Figure:
    """The observed coefficient: runs, their mean and the prediction, and a run with a symmetric machine."""
    a, unit = result.adaptation, f"10⁻³ {result.records.unit}/V²"
    twin = a.symmetric
    figure = blank(10.0, 3.6)
    widths = (1.0,) if twin is None else (1.7, 1.0)
    axes = np.atleast_1d(figure.subplots(1, len(widths), sharey=True, width_ratios=widths))
    ax = axes[0]
    one = "single runs" if len(a.paths) > 1 else "this run"
    for k, path in enumerate(a.paths):
        ax.plot(a.times, 1e3 * path, color=MEASURED, lw=0.7, label=None if k else one)
    if len(a.paths) > 1:
        ax.plot(
            a.times, 1e3 * np.mean(a.paths, axis=0), color=FINAL, lw=2.2, label=f"mean of {len(a.paths)} runs"
        )
    ax.plot(a.times, 1e3 * a.mean_path, color=BASELINE, lw=1.6, ls=(0, (5, 1.5)), label="predicted mean")
    ax.axhline(1e3 * a.target, color=INK, lw=1.0, ls=(0, (1, 1.5)), label="least squares")
    if a.prediction.settle <= a.times[-1]:
        _mark(ax, a.prediction.settle, f"predicted\n{a.prediction.settle:,.0f}".replace(",", " "), 0.06)
    if a.settle is not None and a.settle <= a.times[-1]:
        _mark(ax, a.settle, f"measured\n{a.settle:,.0f}".replace(",", " "), 0.27)
    name = "$h_2$({}, {})".format(*result.settings.coefficient)
    ax.set(xlabel="iterations", ylabel=f"{name} [{unit}]", title=_verdict(result))
    if twin is not None:
        other = axes[1]
        other.plot(a.times, 1e3 * twin, color=MEASURED, lw=0.7)
        other.axhline(0.0, color=INK, lw=1.0, ls=(0, (1, 1.5)))
        other.set(xlabel="iterations", title="symmetric friction: it is zero, this is noise")
    for each in axes:
        plain_ticks(each.xaxis)
        each.set_xlim(0, a.times[-1])
    legend_above(figure, axes)
    return figure


def _verdict(result: Reproduction) -> str:
    a = result.adaptation
    if a.status != "ok":
        return f"the filter {a.status}"
    if a.settle is None:
        return "too short a run" if a.prediction.settle > a.times[-1] else "no value to settle on"
    off = a.settle / a.prediction.settle - 1
    return f"settles {abs(off):.0%} {'later' if off > 0 else 'earlier'} than predicted"


def _mark(ax: Axes, x: float, text: str, height: float) -> None:
    ax.axvline(x, color=MUTED, lw=0.9)
    note = ax.annotate(
        text,
        (x, height),
        xycoords=("data", "axes fraction"),
        xytext=(-4, 0),
        textcoords="offset points",
        ha="right",
        va="bottom",
        fontsize=8,
        color=INK,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.85},
    )
    note.set_in_layout(False)


@FIGURES.figure(
    "trap",
    section="online_error",
    caption="What the online error hides. Symmetric friction (S1), a sampling interval at which the memory "
    "is far too short, input below the same corner. The filter follows the slow part of the output "
    "with its weights, which makes its own error small and its weights worthless.",
    description="Bars of the online error, of the frozen weights and of least squares.",
)
def figure_trap(result: Reproduction) -> Figure | None:
    """Online, frozen and least-squares error with a memory that is far too short."""
    t = result.short_memory
    if t is None:
        return None
    figure = blank(6.5, 2.0)
    ax = figure.subplots()
    bars = {
        "online, while it learns": t.online,
        "least squares, held out": t.least_squares,
        "LMS frozen, held out": t.frozen,
    }
    colours = (MEASURED, FINAL, BASELINE)
    drawn = ax.barh(list(bars), list(bars.values()), height=0.62, color=colours)
    ax.bar_label(drawn, [f"{value:.3g}" for value in bars.values()], padding=4, fontsize=8.5)
    ax.axvline(1.0, color=INK, lw=1.0, ls=(0, (1, 1.5)))
    ax.set(xlabel="NMSE [-]; 1 is as good as the mean", title=f"the same filter at {1e3 * t.Ts:g} ms")
    ax.set_xlim(0, 1.15 * max(1.0, *bars.values()))
    ax.invert_yaxis()
    ax.grid(axis="y", visible=False)
    return figure


NO_PULSE = "No pulse was recorded, so the free run on data that no model has seen takes its place."


def _where(result: Reproduction) -> str:
    return "on the pulse" if result.records.pulses else "in free run on held-out data"


def _model_caption(result: Reproduction) -> str:
    return (
        f"Figure 10. The paper's model, weights frozen, {_where(result)}, beside linear models identified "
        f"from the same data. {_plateau(result) if result.records.pulses else NO_PULSE}"
    )


def _plateau(result: Reproduction) -> str:
    return (
        f"After {result.settings.memory} samples a model of this memory rests on a plateau, whatever the "
        f"machine does; {orthonormal_row(result)} forgets as slowly as the joint. The second pulse is "
        "turned round: one sign alone would not show an error that is even. Errors (NMSE) are in the "
        "titles, in the order of the legend."
    )


@FIGURES.figure(
    "figure_10",
    section="pulse",
    caption=_model_caption,
    description="Output of the quadratic model and of identified linear models.",
)
def figure_10(result: Reproduction) -> Figure:
    """The paper's model and identified linear models on the pulses, or on held-out data without pulses."""
    M = f"M={result.settings.memory}"
    return _compared(result, (f"{M} quadratic, LMS", f"{M} linear", orthonormal_row(result)))


def _linearised_caption(result: Reproduction) -> str:
    return (
        f"Figure 11. The linearised joint {_where(result)}, beside a linear model that was identified. What "
        "an identified quadratic model gains over the linearised one is mostly the gain of "
        "identification: the linear one has it too."
    )


@FIGURES.figure(
    "figure_11",
    section="pulse",
    caption=_linearised_caption,
    description="Output of the linearised joint and of an identified linear model.",
)
def figure_11(result: Reproduction) -> Figure:
    """The linearised joint and an identified linear model on the pulses, or on held-out data."""
    return _compared(result, ("linearised joint", orthonormal_row(result)))


def _compared(result: Reproduction, names: Sequence[str]) -> Figure:
    rows = [result.row(name) for name in names]
    return _on_pulses(result, rows) if result.records.pulses else _on_held_out(result, rows)


def _on_pulses(result: Reproduction, rows: Sequence[EvaluatedModel]) -> Figure:
    scale, unit = readable_unit(result)
    figure = blank(10.0, 3.7)
    axes = figure.subplots(1, len(result.records.pulses), sharey=True)
    lines = _lines(result)
    for k, (ax, pulse) in enumerate(zip(np.atleast_1d(axes), result.records.pulses, strict=True)):
        ax.axvspan(0, result.settings.pulse_width, color=HIGHLIGHT, lw=0, zorder=0)
        ax.plot(pulse.t, scale * pulse.alpha, color=MEASURED, lw=3.2, label="machine")
        t = np.arange(pulse.recording.N) * pulse.recording.Ts - result.settings.pulse_delay
        for row in rows:
            line = lines[row.name]
            x, y = (pulse.t, pulse.alpha_linearised) if row.size == 0 else (t, row.pulse_hat[k])
            marker = {"marker": line.marker, "ms": 3.5} if row.size and len(t) < 90 else {}
            ax.plot(x, scale * y, color=line.colour, ls=line.dashes, lw=line.width, label=row.name, **marker)
        errors = ", ".join(f"{row.pulses[k]:.3g}" for row in rows)
        ax.set_title(
            f"{pulse.height:+g} V for {result.settings.pulse_width:g} s: NMSE {errors}".replace("-", "−")
        )
        ax.set(xlabel="time from the start of the pulse [s]", xlim=(-0.2, pulse.t[-1]))
    np.atleast_1d(axes)[0].set_ylabel(f"{result.records.channel} [{unit}]")
    legend_above(figure, np.atleast_1d(axes))
    return figure


def _on_held_out(result: Reproduction, rows: Sequence[EvaluatedModel]) -> Figure:
    scale, unit = readable_unit(result)
    figure = blank(10.0, 3.7)
    ax = figure.subplots()
    t, y = interleaved(result, [r.channel(result.records.channel) for r in result.records.test])
    part = t - t[0] < SIGNAL_SECONDS
    ax.plot(t[part], scale * y[part], color=MEASURED, lw=3.0, label="measured")
    lines = _lines(result)
    for row in rows:
        line = lines[row.name]
        ax.plot(
            t[part],
            scale * interleaved(result, row.y_hat)[1][part],
            color=line.colour,
            ls=line.dashes,
            lw=line.width,
            label=f"{row.name} (NMSE {row.held_out:.3g})",
        )
    title = "free run on held-out data"
    ax.set(xlabel="time [s]", ylabel=f"{result.records.channel} [{unit}]", title=title)
    legend_above(figure, [ax], columns=4)
    return figure


def interleaved(
    result: Reproduction, outputs: Sequence[Real[np.ndarray, "_"]]
) -> tuple[Real[np.ndarray, " N"], Real[np.ndarray, " N"]]:
    """Time and output of the first held-out recording, put together from its decimated recordings."""
    parts = result.records.test[: result.records.phases]
    t = np.concatenate([r.t[r.n_init :] for r in parts])
    y = np.concatenate([y[r.n_init :] for r, y in zip(parts, outputs, strict=False)])
    order = np.argsort(t, kind="stable")
    return t[order], y[order]


@FIGURES.figure(
    "kernels",
    section="kernels",
    caption="The kernels of the quadratic model, once by differentiating the equations of the simulated "
    "machine and averaging over its input, once by least squares from the data. Where they agree, "
    "a kernel can be read: the table below says which effect makes which part of it.",
    description="First and second kernel of the equations and of the data, and their difference.",
)
def figure_kernels(result: Reproduction) -> Figure | None:
    """Kernels of the machine's equations, and kernels identified from its data."""
    b = result.kernels
    return None if b is None else kernel_figure(b.physics, b.data, names=("physics", "data"))
