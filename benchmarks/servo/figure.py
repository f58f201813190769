"""Figure: errors of the servo models on recordings that were left out, by number of free runs of the fit."""

from __future__ import annotations

from pathlib import Path

from rotflex_jax.text.colours import BASELINE, FAINT, FINAL
from rotflex_jax.text.plotting import blank, styled
from servo.friction_models import MODELS

PARTS = {"motion mean": "Motions left out", "gain mean": "Gains left out"}
GREY = {
    "Coulomb": "Coulomb",
    "load friction, viscous, delay": "load friction",
    "weight friction": "weight friction",
    "weight friction, delay": "with delay",
    "motor friction, delay, robust": "motor friction, robust",
    "weight friction, delay, a supply that gives way": "with a supply that gives way",
}
# The last one has the same parameters as "with delay".
EVOLVED = {**{name: name for name in MODELS}, "weight friction, delay, CMA-ES": "CMA-ES"}


def apart(heights: list[float], gap: float) -> list[float]:
    """Heights of labels for points in rising order, at least a gap apart."""
    found: list[float] = []
    for height in heights:
        found.append(max(height, found[-1] + gap) if found else height)
    lift = sum(f - h for f, h in zip(found, heights, strict=True)) / max(len(found), 1)
    return [f - min(lift, found[0] - gap) for f in found]


@styled
def draw(summary: dict[str, dict[str, float]], path: Path) -> None:
    """Writes the figure.

    Args:
        summary: Errors and free runs of each model, from `page.summary`.
        path: Path of the PNG file.
    """
    figure = blank(8.2, 3.8)
    axes = figure.subplots(1, 2, sharey=True)
    for ax, (part, title) in zip(axes, PARTS.items(), strict=True):
        for labels, place, side, mark, colour in (
            (GREY, 1.3e3, "left", "o", FINAL),
            (EVOLVED, 6e4, "right", "s", BASELINE),
        ):
            known = sorted((n for n in labels if part in summary.get(n, {})), key=lambda n: summary[n][part])
            points = [(summary[n]["rollouts"], summary[n][part]) for n in known]
            for name, (x, y), at in zip(known, points, apart([y for _, y in points], 0.33), strict=True):
                ax.plot([x, place], [y, at], color=FAINT, lw=0.8, zorder=1)
                ax.plot(x, y, mark, color=colour, ms=5)
                ax.annotate(labels[name], (place, at), ha=side, va="center", fontsize=7.5)
        ax.set(xscale="log", xlim=(100, 5e5), title=title, xlabel="free runs of a recording [-]")
    axes[0].set(ylabel="mean absolute error of the angle [deg]", ylim=(0, None))
    figure.savefig(path, dpi=110)
