"""Figures of docs/measured_joint.md."""

import pathlib

import numpy as np
from matplotlib.figure import Figure

import rotflex_jax as rf
from measured_joint.fine_run import STRUCTURES, TAKEN, free_runs
from rotflex_jax.text.colours import BASELINE, FINAL, FURTHER, INK, MEASURED
from rotflex_jax.text.plotting import blank, legend_above, plain_ticks, styled

# Standard deviation of the rounding to sensor steps of 360 / 4096 degrees.
NOISE = 360 / 4096 / np.sqrt(12)


def draw(A: rf.Recording, B: rf.Recording, fits: dict, folder: pathlib.Path) -> None:
    """Writes the figures."""
    folder.mkdir(parents=True, exist_ok=True)
    figures = {"measured_joint_ringing": ringing(B, fits), "measured_joint_errors": errors(fits)}
    for name, figure in figures.items():
        path = folder / f"{name}.png"
        figure.savefig(path, dpi=110)
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


@styled
def ringing(B: rf.Recording, fits: dict) -> Figure:
    """Run B after a step and free runs of models fitted to run A: the hub while the arm oscillates."""
    figure = blank(9, 5.2)
    top, bottom = figure.subplots(2, 1, sharex=True)
    inside = (B.t >= 4.9) & (B.t < 5.95)
    measured = np.degrees(B.y)
    for ax, k in ((top, 0), (bottom, 1)):
        ax.plot(B.t[inside], measured[inside, k], color=MEASURED, lw=2.6, label="measured")
    for name, colour, dashes in (("Coulomb at the hub", BASELINE, "--"), (TAKEN, FINAL, "-")):
        numbers = fits[f"{name}, from A"]["numbers"]["A"] | {"offset": 0.0, "bias": 0.0}
        run = np.degrees(free_runs(numbers, name == TAKEN, B))
        kept = inside[: len(run)]
        for ax, k in ((top, 0), (bottom, 1)):
            ax.plot(
                B.t[: len(run)][kept],
                run[kept, k],
                dashes,
                color=colour,
                lw=1.3,
                label=f"{name}, learnt from A",
            )
    top.set_ylabel("hub angle [deg]")
    bottom.set_ylabel("deflection [deg]")
    bottom.set_xlabel("time [s]")
    legend_above(figure, [top], columns=3)
    return figure


@styled
def errors(fits: dict) -> Figure:
    """Errors of free runs of every structure, on the run of the fit and on the other run."""
    figure = blank(9, 4.2)
    axes = figure.subplots(1, 2, sharey=True)
    marks = {
        "unseen run, no offset": ("s", BASELINE, "none"),
        "unseen run, its offset fitted": ("o", FINAL, FINAL),
        "the same run (bound)": ("|", INK, INK),
    }
    names = list(STRUCTURES)
    for column, (ax, channel) in enumerate(zip(axes, ("hub angle", "deflection"), strict=True)):
        for row, name in enumerate(names):
            for shift, (learnt, other) in ((-0.16, ("A", "B")), (0.16, ("B", "A"))):
                seen, unseen = (fits[f"{name}, from {k}"]["evaluated"][other] for k in (other, learnt))
                values = (unseen["no_offset"], unseen["own_offset"], seen["own_offset"])
                for (label, (mark, edge, face)), value in zip(marks.items(), values, strict=True):
                    ax.plot(
                        value[column], row + shift, mark, color=edge, mfc=face, ms=8, mew=1.6,
                        label=label if row == 0 and shift < 0 else None,
                    )  # fmt: skip
                if column == 0:
                    ax.annotate(
                        f"{learnt} to {other}",
                        (1.01, row + shift),
                        xycoords=("axes fraction", "data"),
                        va="center",
                        fontsize=7.5,
                    )
        ax.axvline(NOISE, color=FURTHER[1], ls=":", lw=1.5, label="noise of the sensor")
        ax.set_xscale("log")
        ax.set_xlim(0.02, 7 if column == 0 else 0.5)
        ax.set_xticks([0.03, 0.1, 0.3, *([1, 3] if column == 0 else [])])
        plain_ticks(ax.xaxis)
        ax.set_xlabel(f"error of the {channel}, free runs of 2 s [deg]")
    axes[0].set_yticks(range(len(names)), [n.replace(", ", ",\n") for n in names])
    axes[0].invert_yaxis()
    legend_above(figure, [axes[0]], columns=4)
    return figure
