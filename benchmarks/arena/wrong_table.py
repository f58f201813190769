"""Tables of the wrong worlds of B0 in the terminal, and their page beside the results file."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from arena.marks import good
from arena.table import answer, mark

Row = dict[str, Any]

from rotflex_jax.text.files import write_file

SEEN = tuple(range(3000, 3070))
"""Worlds of the report set whose results were read before a revision of the search.

Quoted figures are of the other worlds.
"""


def fresh(records: Iterable[Row]) -> list[Row]:
    """Worlds whose results were not read before any revision of the search."""
    return [r for r in records if r["world"] not in SEEN]


def hidden_in(row: Row) -> str:
    """Hidden effect and kind of a world."""
    if "kind" not in row:
        return f"world {row['world']}"
    return f"{'@'.join(row['hidden']) if row['hidden'] else 'nothing'} ({row['kind']})"


def besides_in(row: Row) -> str:
    """Further errors of a world, without those that every world has."""
    always = {"trusted_constants", "voltage_offset"}
    return ", ".join(b["name"] for b in row["besides"] if b["name"] not in always) or "-"


def said(row: Row) -> str:
    """Effects that were found, provisional ones in brackets."""
    each = [(answer({"rounds": [r]}), r["status"]) for r in row["rounds"]]
    return ", ".join(text if status == "established" else f"({text})" for text, status in each) or "nothing"


def degrees(row: Row, recording: str, kind: str) -> str:
    """Errors of theta and alpha on a recording, before and after the search [deg]."""
    pair = lambda e: " / ".join("-" if v is None else f"{math.degrees(v):.2f}" for v in (e or {}).values())  # noqa: E731
    stages = row["errors"][recording]
    return f"{pair(stages['baseline'][kind])} -> {pair(stages['final'][kind])}"


def show_worlds(console: Console, records: list[Row]) -> None:
    """Prints a table of all worlds, and counts."""
    table = Table(title="B0: wrong worlds", header_style="bold")
    columns = "world,hidden,besides,answer,named,first,wrong,verdict,test windows deg,wall s,cpu s"
    for name in columns.split(","):
        table.add_column(name, overflow="fold")
    for row in records:
        head = (str(row["world"]), hidden_in(row))
        if "error" in row:
            table.add_row(*head, f"[red]{row['error'][:60]}[/]")
            continue
        wrong = f"{len(row['wrong_established'])} + {len(row['wrong_provisional'])}"
        answered = said(row).replace("[", "(").replace("]", ")")
        marks = (mark(row["named"]), mark(row["first"]), wrong, row["verdict"])
        times = (f"{row['wall_s']:.0f}", f"{row['cpu_s']:.0f}")
        table.add_row(
            *head, besides_in(row), answered, *marks, degrees(row, "test", "windows_calibrated"), *times
        )
    console.print(table)
    console.print(summary(records), markup=False)


def summary(records: list[Row]) -> str:
    """Counts and medians by which versions of the search are compared."""
    lines = []
    for name, rows in groups(records).items():
        hidden = [r for r in rows if r["hidden"]]
        part = lambda key, rows=hidden: f"{sum(bool(r[key]) for r in rows)}/{len(rows)}"  # noqa: E731
        line = f"{name}: " + (
            f"named {part('named')} (established {part('named_established')}), first {part('first')}, "
            if hidden
            else ""
        )
        line += f"wrong established {count(rows, 'wrong_established')}, "
        line += (
            f"wrong provisional {count(rows, 'wrong_provisional')}; windows of the test record, after over "
        )
        lines.append(line + f"before: {ratios(rows)}")
    times = [r["wall_s"] for r in good(records)]
    if times:
        lines.append(f"time per world: median {statistics.median(times):.0f} s, longest {max(times):.0f} s")
    lines.append(f"worlds: {len(records)}, failed {len(records) - len(good(records))}")
    return "\n".join(lines)


def groups(records: list[Row]) -> dict[str, list[Row]]:
    """Worlds without an error: by kind, those with nothing hidden, and all."""
    rows = good(records)
    named = [r for r in rows if r["hidden"]]
    found = {
        "joint": [r for r in named if r["kind"] == "joint"],
        "link with gauge": [r for r in named if r["kind"] == "link"],
        "nothing hidden": [r for r in rows if not r["hidden"]],
        "all": rows,
    }
    return {name: rows for name, rows in found.items() if rows}


def count(rows: list[Row], key: str) -> str:
    """Number of wrong effects, and number of worlds with any."""
    found = [len(r[key]) for r in rows]
    return f"{sum(found)} in {sum(n > 0 for n in found)}/{len(rows)} worlds"


def ratios(rows: list[Row], recording: str = "test", kind: str = "windows_calibrated") -> str:
    """Median of the final error over the baseline error, for theta and alpha."""
    parts = []
    for channel in ("theta", "alpha"):
        pairs = [
            (
                r["errors"][recording]["final"][kind][channel],
                r["errors"][recording]["baseline"][kind][channel],
            )
            for r in rows
        ]
        known = [a / b for a, b in pairs if a is not None and b]
        parts.append(f"{statistics.median(known):.2f}" if known else "-")
    return " / ".join(parts)


def publish_worlds(records: list[Row], results: Path) -> list[Path]:
    """Writes the page beside the results file.

    Args:
        records: all rows of the results file.
        results: path of that file.

    Returns:
        Paths of the written files.
    """
    if not good(records):
        return []
    page = results.with_suffix(".md")
    write_file(page, written(records))
    return [page]


def _sums(records: list[Row]) -> list[str]:
    """Table of counts and error ratios for each kind of world."""
    lines = [
        "| worlds | count | named | of it established | named first | wrong, established | wrong, "
        "provisional | test windows, after / before | test whole |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, rows in groups(records).items():
        hidden = [r for r in rows if r["hidden"]]
        part = lambda key, rows=hidden: f"{sum(bool(r[key]) for r in rows)}/{len(rows)}"  # noqa: E731
        cells = [name, str(len(rows)), *map(part, ("named", "named_established", "first"))]
        cells += [count(rows, "wrong_established"), count(rows, "wrong_provisional")]
        cells += [ratios(rows), ratios(rows, kind="whole_calibrated")]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def written(records: list[Row]) -> str:
    """The page in Markdown."""
    lines = [
        "# B0: wrong worlds",
        "",
        "Feedback, counted angles, wrong trusted constants, an offset of each run, and things besides:",
        "torques that no candidate has, faults of sensors. Named: found, or listed as equivalent to what",
        "was found. Wrong: neither hidden",
        "nor a right name of something besides. Errors in degrees, theta / alpha, free runs of 2 s and",
        "whole runs, before -> after the search, with the voltage offset found on the first 2 s of the",
        "record that is run; the test record was used for no fit and no choice.",
    ]
    seen = [r for r in records if r["world"] in SEEN]
    for title, some in (
        ("Worlds that no revision of the search had seen when they were run.", fresh(records)),
        (f"Worlds {SEEN[0]} to {SEEN[-1]}, which were read before an earlier revision.", seen),
    ):
        if good(some):
            lines += ["", title, "", *_sums(some)]
    lines += [
        "",
        "| world | hidden | besides | answer (provisional in brackets) | named | first | "
        "validation windows | test windows | test whole | s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    word = {None: "-", True: "yes", False: "no"}
    for r in sorted(good(records), key=lambda r: r["world"]):
        cells = [str(r["world"]), hidden_in(r), besides_in(r), said(r), word[r["named"]], word[r["first"]]]
        cells += [
            degrees(r, "validation", "windows_calibrated"),
            degrees(r, "test", "windows_calibrated"),
            degrees(r, "test", "whole_calibrated"),
        ]
        lines.append("| " + " | ".join([*cells, f"{r['wall_s']:.0f}"]) + " |")
    failed = [r for r in records if "error" in r]
    lines += ["", *(f"- {hidden_in(r)}, world {r['world']}: {r['error']}" for r in failed)]
    return "\n".join(lines).rstrip() + "\n"
