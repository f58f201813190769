"""Results of B7 as markdown."""

from __future__ import annotations

from typing import Any

TITLES = {
    "lms": "Volterra LMS [ns per sample]",
    "rls": "RLS [ns per sample]",
    "pairs": "Step sizes [ns per sample; of 100 pairs, per pair]",
    "motion": "Simulation [ns per sample]",
    "fit": "A fit of eight parameters [ms]",
    "joint": "Joint fits [ms]",
    "starts": "Many starts [s]",
    "others": "Packages that do it in another way, 10 s at 1 kHz",
    "cold": "From a new process",
    "devices": "Two devices of one processor [s]",
    "search": "A search over the whole catalogue, 20 s at 500 Hz",
    "waiting": "Waiting for a search that finds two effects, 20 s at 500 Hz",
    "fleet": "`rotflex discover FILES --each`, ten kinds of machine, 20 s at 500 Hz each",
    "growth": "Growth",
}


def page(results: dict[str, Any]) -> str:
    """The page with all results."""
    lines = [
        "# Speed",
        "",
        "`python benchmarks/B7_speed.py`. Every row in turn and in random order, one process, compiling "
        "apart; the ratio is to the first row of C or scipy in its table, of least processor times. Others "
        "used the machine, so times by the clock are too long. Tables were measured on different machines, "
        "and only what stands in one table may be compared.",
    ]
    for name, title in TITLES.items():
        if name in results:
            part = results[name]
            lines += ["", f"## {title}", "", _measured_on(part["machine"]), ""]
            for group in part.get("groups", []):
                lines += [*_rows(group), ""]
            lines += [f"- {what}: {value:.3g}" for what, value in part.get("facts", {}).items()]
            if "growth" in part:
                lines += _growth(part["growth"])
            if "waiting" in part:
                lines += waiting(part["waiting"])
    text = "\n".join(lines)
    while "\n\n\n" in text:
        text = text.replace("\n\n\n", "\n\n")
    return text.rstrip() + "\n"


def _measured_on(machine: dict[str, Any]) -> str:
    """Processor, versions and date of a part of the results."""
    processor, cores, python, version, date = (
        machine[k] for k in ("processor", "cores", "python", "jax", "date")
    )
    return f"{processor}, {cores} cores, Python {python}, jax {version}, {date}."


def _rows(group: dict[str, Any]) -> list[str]:
    rows = group["rows"]
    base = next((r for r in rows if "C -O3" in r["name"] or "scipy" in r["name"]), rows[0])
    lines = [
        "| | processor | ratio | clock, least | clock, median | first call [s] | |",
        "|---|---:|---:|---:|---:|---:|---|",
    ]
    for r in rows:
        lines.append(
            f"| {r['name']} | {r['cpu']:.4g} | {r['cpu'] / base['cpu']:.3g} | {r['least']:.4g} "
            f"| {r['median']:.4g} | {r['first']:.2f} | {r['note']} |"
        )
    noise = group["noise"]
    return [
        *lines,
        "",
        f"Noise: by the clock, medians lie {100 * noise['typical_spread']:.0f} % above minima (at most "
        f"{100 * noise['largest_spread']:.0f} %), load {noise['load']:.1f}.",
    ]


def _growth(found: dict[str, Any]) -> list[str]:
    lines = ["| | samples | s | ns per sample | memory [MB] |", "|---|---:|---:|---:|---:|"]
    for work, by_length in found.items():
        for N, r in by_length.items():
            lines.append(
                f"| {work} | {int(N):,} | {r['seconds']:.4g} | {r['seconds'] / int(N) * 1e9:.1f} "
                f"| {r['memory_mb']:.0f} |"
            )
    return lines


def waiting(rows: list[dict[str, Any]]) -> list[str]:
    """Table of searches: compiled and loaded programs, times and memory."""
    shown = {"compiled": ".0f", "loaded": ".0f", "compiling": ".1f", "seconds": ".1f"}
    shown |= {"processor": ".1f", "memory": ".0f"}
    lines = [
        "| | compiled | loaded | compiling, sum over threads [s] | whole [s] | processor [s] | memory [MB] |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        each = (format(row[what], form) if what in row else "" for what, form in shown.items())
        lines.append(f"| {row['name']} | {' | '.join(each)} |")
    return lines
