"""Tables of B0 in the terminal: all recordings, counts, and wrong answers."""

from __future__ import annotations

import statistics
from typing import Any

from rich.console import Console
from rich.table import Table


def label(job: dict[str, Any]) -> str:
    """Hidden effects of a recording, and its size and sensor if they are not the usual ones."""
    name = " + ".join(f"{e}@{p}" for e, p in job["effects"]) or "nothing"
    size, channels = job.get("size", 1.0), job.get("channels", ["theta", "alpha"])
    name += f" x{size:g}" if size != 1 else ""
    return name + (f" ({channels[0]} only)" if len(channels) == 1 else "")


def mark(ok: bool | None) -> str:
    """A coloured "yes" or "no", or "-" for None."""
    return "-" if ok is None else "[green]yes[/]" if ok else "[red]no[/]"


def answer(row: dict[str, Any]) -> str:
    """Effects that were found, each with its equivalent effects in brackets."""
    parts = []
    for r in row["rounds"]:
        others = ", ".join("@".join(p) for p in r["equivalent"])
        parts.append(f"{r['effect']}@{r['port']}" + (f" [= {others}]" if others else ""))
    return " + ".join(parts) or "nothing"


def worst(row: dict[str, Any]) -> str:
    """Largest parameter error [%]."""
    errors = [abs(p["error_percent"]) for p in row["parameters"].values()]
    return f"{max(errors):.1f}" if errors else "-"


def show(console: Console, records: list[dict[str, Any]]) -> None:
    """Prints a table of all recordings, counts, and wrong answers."""
    table = Table(title="B0: one hidden effect", header_style="bold")
    columns = "hidden,input,seed,answer,first,exact,in set,verdict,right,error %,vs oracle,wall s,cpu s"
    for name in columns.split(","):
        table.add_column(name, overflow="fold")
    for row in records:
        head = (label(row), row["kind"], str(row["seed"]))
        if "error" in row:
            table.add_row(*head, f"[red]{row['error'][:60]}[/]")
            continue
        ratio = " ".join(f"{v:.2f}" for v in row.get("over_oracle", {}).values())
        marks = (mark(row["first"]), mark(row["exact"]), mark(row["inside"]), row["verdict"])
        times = (f"{row['wall_s']:.1f}", f"{row['cpu_s']:.1f}")
        said = answer(row).replace("[", "(").replace("]", ")")
        table.add_row(*head, said, *marks, mark(row["verdict_right"]), worst(row), ratio, *times)
    console.print(table)
    console.print(summary(records))
    for row in records:
        marks = ("verdict_right",) if row.get("outside") else ("first", "exact", "verdict_right")
        if "error" in row or not all(row[m] for m in marks):
            got = row.get("error") or f"{answer(row)}, {row['verdict']}"
            text = f"  miss: {label(row)} ({row['kind']}, {row['seed']}) -> {got}"
            console.print(text, markup=False)


def summary(records: list[dict[str, Any]]) -> str:
    """Counts and medians by which versions of the search are compared."""
    good = [r for r in records if "error" not in r]
    outside = [r for r in good if r.get("outside")]
    seen = [r for r in good if r["wanted"] and not r.get("outside")]
    null = [r for r in good if not r["wanted"]]
    part = lambda rows, name: f"{sum(bool(r[name]) for r in rows)}/{len(rows)}"  # noqa: E731
    lines = [
        f"effects: first {part(seen, 'first')} (by name {part(seen, 'strict')}), exact set "
        f"{part(seen, 'exact')}, truth in the reported set {part(seen, 'inside')}, verdict "
        f"{part(seen, 'verdict_right')}, with false extras {part(seen, 'extra')}",
        f"nothing to find: false alarms {part(null, 'extra')}, verdict {part(null, 'verdict_right')}",
    ]
    if outside:
        lines.append(f"effects outside the package: said to be unexplained {part(outside, 'verdict_right')}")
    numbers = [p for r in seen for p in r["parameters"].values()]
    if numbers:
        errors = [abs(p["error_percent"]) for p in numbers]
        lines.append(
            f"parameters: median error {statistics.median(errors):.2f} %, 95 % interval holds the "
            f"truth in {sum(p['covered'] for p in numbers)}/{len(numbers)}"
        )
    ratios = [v for r in seen for v in r.get("over_oracle", {}).values()]
    if ratios:
        lines.append(
            f"held-out error over the oracle's: median {statistics.median(ratios):.3f}, "
            f"within 5 % in {sum(v < 1.05 for v in ratios)}/{len(ratios)}"
        )
    if good:
        wall, cpu = ([r[n] for r in good] for n in ("wall_s", "cpu_s"))
        lines.append(
            f"time per record: median {statistics.median(wall):.1f} s wall, "
            f"{statistics.median(cpu):.1f} s CPU; longest {max(wall):.1f} s"
        )
    lines.append(f"records: {len(records)}, failed {len(records) - len(good)}")
    return "\n".join(lines)
