"""Figures 10 and 11: models on the pulse, or on held-out data where no pulse was recorded."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from rotflex_jax.report.style import BASELINE, FINAL, MEASURED, blank, legend_above, styled
from rotflex_jax.reproduce.experiment import Reproduction
from rotflex_jax.reproduce.models import Judged

SHOWN = 20.0
"""Seconds of a signal that are drawn."""

# Told apart by dashes and darkness too, so that a page in grey stays readable.
AMBER, VIOLET = "#d98e04", "#7a5aa6"


@dataclasses.dataclass(frozen=True)
class Line:
    """How a model is drawn."""

    colour: str
    dashes: object
    marker: str = ""
    width: float = 1.4


def _lines(result: Reproduction) -> dict[str, Line]:
    M = f"M={result.settings.memory}"
    return {
        "linearised joint": Line(BASELINE, (0, (5, 1.5))),
        f"{M} quadratic, LMS": Line(FINAL, "-", "o"),
        f"{M} linear": Line(AMBER, (0, (1, 1.2)), "s", 1.8),
        orthonormal_row(result): Line(VIOLET, (0, (4, 1.2, 1, 1.2)), "^"),
    }


def orthonormal_row(result: Reproduction) -> str:
    """Name of the linear model in orthonormal functions."""
    return next(
        row.name for row in result.rows if row.name.startswith("GOBF") and row.name.endswith(" linear")
    )


def readable_unit(result: Reproduction) -> tuple[float, str]:
    """Factor and unit in which people read the output."""
    return (180 / np.pi, "deg") if result.records.unit == "rad" else (1.0, result.records.unit)


@styled
def figure_10(result: Reproduction) -> Figure:
    """The paper's model on the pulse (or on held-out data), beside identified linear ones."""
    M = f"M={result.settings.memory}"
    return _compared(result, (f"{M} quadratic, LMS", f"{M} linear", orthonormal_row(result)))


@styled
def figure_11(result: Reproduction) -> Figure:
    """The linearised joint on the same, beside an identified linear model."""
    return _compared(result, ("linearised joint", orthonormal_row(result)))


def _compared(result: Reproduction, names: Sequence[str]) -> Figure:
    rows = [result.row(name) for name in names]
    return _on_pulses(result, rows) if result.records.pulses else _on_held_out(result, rows)


def _on_pulses(result: Reproduction, rows: Sequence[Judged]) -> Figure:
    scale, unit = readable_unit(result)
    figure = blank(10.0, 3.7)
    axes = figure.subplots(1, len(result.records.pulses), sharey=True)
    looks = _lines(result)
    for k, (ax, pulse) in enumerate(zip(np.atleast_1d(axes), result.records.pulses, strict=True)):
        ax.axvspan(0, result.settings.pulse_width, color="#f3efe2", lw=0, zorder=0)
        ax.plot(pulse.t, scale * pulse.alpha, color=MEASURED, lw=3.2, label="machine")
        t = np.arange(pulse.recording.N) * pulse.recording.Ts - result.settings.pulse_delay
        for row in rows:
            look = looks[row.name]
            x, y = (pulse.t, pulse.alpha_linearised) if row.size == 0 else (t, row.pulse_hat[k])
            marker = {"marker": look.marker, "ms": 3.5} if row.size and len(t) < 90 else {}
            ax.plot(x, scale * y, color=look.colour, ls=look.dashes, lw=look.width, label=row.name, **marker)
        errors = ", ".join(f"{row.pulses[k]:.3g}" for row in rows)
        ax.set_title(
            f"{pulse.height:+g} V for {result.settings.pulse_width:g} s: NMSE {errors}".replace("-", "−")
        )
        ax.set(xlabel="time from the start of the pulse [s]", xlim=(-0.2, pulse.t[-1]))
    np.atleast_1d(axes)[0].set_ylabel(f"{result.records.channel} [{unit}]")
    legend_above(figure, np.atleast_1d(axes))
    return figure


def _on_held_out(result: Reproduction, rows: Sequence[Judged]) -> Figure:
    scale, unit = readable_unit(result)
    figure = blank(10.0, 3.7)
    ax = figure.subplots()
    t, y = woven(result, [r.channel(result.records.channel) for r in result.records.test])
    part = t - t[0] < SHOWN
    ax.plot(t[part], scale * y[part], color=MEASURED, lw=3.0, label="measured")
    looks = _lines(result)
    for row in rows:
        look = looks[row.name]
        ax.plot(
            t[part],
            scale * woven(result, row.y_hat)[1][part],
            color=look.colour,
            ls=look.dashes,
            lw=look.width,
            label=f"{row.name} (NMSE {row.held_out:.3g})",
        )
    title = "free run on held-out data"
    ax.set(xlabel="time [s]", ylabel=f"{result.records.channel} [{unit}]", title=title)
    legend_above(figure, [ax], columns=4)
    return figure


def woven(result: Reproduction, outputs: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Time and output of the first held-out recording, its thinned-out records put together again."""
    parts = result.records.test[: result.records.phases]
    t = np.concatenate([r.t[r.n_init :] for r in parts])
    y = np.concatenate([y[r.n_init :] for r, y in zip(parts, outputs, strict=False)])
    order = np.argsort(t, kind="stable")
    return t[order], y[order]
