"""Held-out errors of the measured joint as effects are added -> figures/staircase.png. Reads B1.json."""

import math

from sources import ROOT, claims, save

from rotflex_jax.text.colours import BASELINE, FINAL, NOISE
from rotflex_jax.text.plotting import blank, legend_above, plain_ticks, styled

TITLES = {
    "ab": "learnt from run A, evaluated on B",
    "ba": "learnt from run B, evaluated on A",
    "mixed": "first 7 s, last 3 s",
}


@styled
def draw():
    figure = blank(10.0, 3.6)
    axes = figure.subplots(1, 3, sharey=True)
    for ax, (way, title) in zip(axes, TITLES.items(), strict=True):
        found = claims.results("B1.json")["search"][claims.WAYS[way]]
        stages = [found["baseline"], *found["rounds"]]
        names = [
            "as it is",
            *(
                f"+ {e}".replace(" at the ", "\nat the ")
                .replace(" of ", "\nof ")
                .replace(" friction", "\nfriction")
                .replace(" hyst", "\nhyst")
                for e in claims.joint_effects(way)
            ),
        ]
        for channel, colour, marker, style in (("theta", FINAL, "o", "-"), ("alpha", BASELINE, "s", "--")):
            errors = [math.degrees(s["held_out_rmse_windows"][channel]) for s in stages]
            ax.semilogy(range(len(errors)), errors, marker=marker, ls=style, color=colour, label=channel)
            for k, error in enumerate(errors):
                ax.annotate(f"{error:.2f}", (k, error), (6, 4), textcoords="offset points", fontsize=8)
        ax.axhline(
            math.degrees(found["noise_floor"]["theta"]), color=NOISE, ls=":", label="noise of the sensor"
        )
        ax.set_xticks(range(len(names)), names, fontsize=7)
        ax.set_xlim(-0.3, len(names) - 0.5)
        ax.set_title(title)
        plain_ticks(ax.yaxis)
    axes[0].set_ylabel("rms error, free runs of 2 s [deg]")
    legend_above(figure, axes)
    return figure


if __name__ == "__main__":
    save(draw(), "staircase")
    # The README shows it too.
    save(draw(), "staircase", ROOT / "docs" / "figures", dpi=110)
