"""The page of B0 in Markdown and its two figures, written beside the results file."""

from __future__ import annotations

import statistics
from pathlib import Path

import numpy as np

from arena.marks import Kept, Row, confusion, good, grouped, intervals, mean_set, sets
from arena.table import answer, label
from claims import SEEN
from rotflex_jax.text.colours import BASELINE, FINAL, INK
from rotflex_jax.text.files import write_file
from rotflex_jax.text.plotting import blank, styled


def publish(records: list[Row], results: Path) -> list[Path]:
    """Writes the page and, if there are data for them, the two figures beside the results file.

    Args:
        records: all rows of the results file.
        results: path of that file.

    Returns:
        Paths of the written files.
    """
    if not good(records):
        return []
    figures = []
    for draw, wanted in ((draw_confusion, confusion(records)[0]), (draw_reliability, good(records))):
        if wanted:
            figures.append(results.with_name(f"{results.stem}_{draw.__name__.removeprefix('draw_')}.png"))
            draw(records, figures[-1])
    page = results.with_suffix(".md")
    write_file(page, written(records, figures))
    return [page, *figures]


def written(records: list[Row], figures: list[Path]) -> str:
    """The page in Markdown."""
    lines = ["# B0: hidden effects, found and missed", ""]
    lines += [
        "| hidden | records | first right | all right, no more | truth in the set | verdict right | "
        "false extras | 95 % intervals hold | error over the oracle's | CPU s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, rows in grouped(records).items():
        part = lambda mark, rows=rows: f"{sum(bool(r[mark]) for r in rows)}/{len(rows)}"  # noqa: E731
        numbers = [p["covered"] for r in rows for p in r["parameters"].values()]
        over = [v for r in rows for v in r.get("over_oracle", {}).values()]
        cells = [name, str(len(rows)), *map(part, ("first", "exact", "inside", "verdict_right", "extra"))]
        cells += [f"{sum(numbers)}/{len(numbers)}" if numbers else "-"]
        cells += [f"{statistics.median(over):.3f}" if over else "-"]
        cells += [f"{statistics.median(r['cpu_s'] for r in rows):.1f}"]
        lines.append("| " + " | ".join(cells) + " |")
    lines += ["", "## Seed by seed", "", *by_seed(records)]
    held = sets(records)
    lines += ["", "## Promises", "", "| claim | held | of |", "|---|---|---|"]
    lines += [
        f"| interval {100 * k.claim:g} % | {100 * k.share:.1f} % | {k.cases} |" for k in intervals(records)
    ]
    lines += [f"| set of effects | {100 * held.share:.1f} % | {held.cases} |", ""]
    lines += [f"Mean size of a set: {mean_set(records):.2f}.", ""]
    lines += [f"![{f.stem}]({f.name})" for f in figures]
    missed = [r for r in good(records) if not r["verdict_right"] or not (r["first"] or r.get("outside"))]
    lines += ["", "## Misses", ""]
    lines += [
        f"- {label(r)} ({r['kind']}, seed {r['seed']}): {answer(r)}, {r['verdict']}" for r in missed
    ] or ["None."]
    failed = [r for r in records if "error" in r]
    lines += [f"- {label(r)} ({r['kind']}, seed {r['seed']}): {r['error']}" for r in failed]
    return "\n".join(lines) + "\n"


def by_seed(records: list[Row]) -> list[str]:
    """Table by seed: one effect of the usual size, effects that the catalogue lacks, nothing hidden."""
    lines = [
        "| seed | one effect, first right | without a name, unexplained | nothing hidden, alarms |",
        "|---|---|---|---|",
    ]
    usual = [r for r in good(records) if r.get("size", 1.0) == 1.0 and len(r["effects"]) <= 1]
    counts: dict[tuple[str, ...], list[int]] = {}
    for seed in sorted({r["seed"] for r in usual}):
        rows = [r for r in usual if r["seed"] == seed]
        outside = [r["verdict_right"] for r in rows if r["outside"]]
        named = [r["first"] for r in rows if r["wanted"] and not r["outside"]]
        alarms = [r["extra"] for r in rows if not r["wanted"] and not r["outside"]]
        cells = tuple(f"{sum(map(bool, m))}/{len(m)}" if m else "-" for m in (named, outside, alarms))
        counts.setdefault(cells, []).append(seed)
    for cells, seeds in counts.items():
        first, last = seeds[0], seeds[-1]
        several = f"{first} to {last}, each" if last > first else str(first)
        lines.append(f"| {several} | {' | '.join(cells)} |")
    seen = " and ".join(map(str, SEEN))
    return [*lines, "", f"Records with seeds {seen} were looked at while the search was revised."]


@styled
def draw_confusion(records: list[Row], path: Path) -> None:
    """Draws a matrix of hidden effects against first effects found, shaded by the share of each row."""
    truths, answers, pairs = confusion(records)
    share = np.array([[pairs[t, a] for a in answers] for t in truths], float)
    total = share.sum(axis=1, keepdims=True)
    figure = blank(0.17 * len(answers) + 3.2, 0.17 * len(truths) + 2.4)
    ax = figure.subplots()
    ax.imshow(share / np.maximum(total, 1), cmap="Greys", vmin=0, vmax=1, aspect="equal")
    for i, j in np.argwhere(share > 0):
        right = truths[i] == answers[j]
        ax.text(
            j,
            i,
            f"{int(share[i, j])}",
            ha="center",
            va="center",
            fontsize=6,
            color="white" if share[i, j] > 0.5 * total[i, 0] else INK,
            fontweight="normal" if right else "bold",
        )
        if not right:
            ax.add_patch(_frame(j, i))
    ax.set_xticks(range(len(answers)), answers, rotation=90, fontsize=6.5)
    ax.set_yticks(range(len(truths)), truths, fontsize=6.5)
    ax.set_xlabel("first effect found")
    ax.set_ylabel("hidden effect")
    ax.set_title("What was hidden and what was answered [records]; framed: another name")
    ax.grid(False)
    figure.savefig(path, dpi=160)


def _frame(j: int, i: int):
    from matplotlib.patches import Rectangle

    return Rectangle((j - 0.5, i - 0.5), 1, 1, fill=False, edgecolor=BASELINE, linewidth=1.2)


@styled
def draw_reliability(records: list[Row], path: Path) -> None:
    """Draws the share of intervals and sets that contain the truth against their stated probability."""
    kept = [k for k in intervals(records) if k.cases]
    figure = blank(5.0, 4.6)
    ax = figure.subplots()
    ax.plot([40, 100], [40, 100], color=INK, linewidth=0.8, label="as claimed")
    _points(ax, kept, "o", FINAL, "intervals of parameters")
    _points(ax, [k for k in [sets(records)] if k.cases], "s", BASELINE, "sets of effects")
    ax.set_xlim(45, 101)
    ax.set_ylim(40, 102)
    ax.set_xlabel("claimed to hold the truth [% of cases]")
    ax.set_ylabel("held it [% of cases]")
    cases = kept[0].cases if kept else 0
    ax.set_title(f"Promises and what became of them ({cases} parameters)")
    ax.legend(loc="upper left")
    figure.savefig(path, dpi=160)


def _points(ax, kept: list[Kept], marker: str, colour: str, name: str) -> None:
    ax.errorbar(
        [100 * k.claim for k in kept],
        [100 * k.share for k in kept],
        yerr=[100 * k.scatter for k in kept],
        fmt=marker,
        color=colour,
        markersize=5,
        capsize=2.5,
        label=f"{name}; bar: one deviation of so many",
    )
