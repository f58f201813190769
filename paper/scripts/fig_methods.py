"""Error of each method on a measured joint -> figures/methods.png. Reads B5/rotflex_mixed.json."""

import math

from sources import claims, save

from rotflex_jax.text.colours import BASELINE, FINAL, FURTHER, INK, NOISE
from rotflex_jax.text.plotting import blank, plain_ticks, styled

LOOKS = {
    "physics": (FINAL, "o"),
    "linear": (INK, "s"),
    "series": (FURTHER[0], "^"),
    "adaptive": (FURTHER[1], "v"),
    "sindy": (FURTHER[2], "D"),
    "other": (BASELINE, "P"),
}


@styled
def draw():
    found = claims.results("B5/rotflex_mixed.json")
    rows = [r for r in found["rows"] if r["status"] == "ok"]
    figure = blank(10.0, 0.19 * len(rows) + 1.1)
    axes = figure.subplots(1, 2, sharey=True)
    for ax, channel in zip(axes, ("theta", "alpha"), strict=True):
        for family, (colour, marker) in LOOKS.items():
            mine = [
                (math.degrees(r["held_out_rmse"][channel]), k)
                for k, r in enumerate(rows)
                if r["family"] == family
            ]
            if mine:
                ax.scatter(*zip(*mine, strict=True), 34, marker=marker, color=colour, label=family)
        ax.axvline(math.degrees(found["noise_floor"][channel]), color=NOISE, ls=":", label="sensor noise")
        ax.set_xscale("log")
        plain_ticks(ax.xaxis)
        ax.set_xlabel(f"rms error of {channel}, one free run [deg]")
        ax.set_yticks(range(len(rows)), [r["method"] for r in rows], fontsize=7.5)
        ax.set_ylim(len(rows) - 0.4, -0.6)
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper left", ncols=len(names))
    return figure


if __name__ == "__main__":
    save(draw(), "methods")
