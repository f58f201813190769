"""Results of B2 as Markdown."""

from __future__ import annotations

from typing import Any


def text(x: Any) -> str:
    """A number to four digits; an interval as its two ends, None as "never"."""
    if x is None:
        return "never"
    if isinstance(x, list):
        return f"{text(x[0])} to {text(x[1])}"
    if x == 0:
        return "0"
    return f"{x:.4g}" if 1e-3 <= abs(x) < 1e5 else f"{x:.2e}"


def cell(c: dict[str, Any]) -> str:
    """The value with the reference in brackets, and a star if they differ by more than the tolerance."""
    if not c:
        return "-"
    ours = text(c["value"])
    if "reference" not in c:
        return ours
    return f"{ours} ({text(c['reference'])}){'' if c['agrees'] else ' *'}"


def tolerance(block: dict[str, Any]) -> str:
    """Text of the tolerances of a part."""
    t = block["tolerance"]
    parts = []
    if t["relative"]:
        parts.append(f"{100 * t['relative']:g} %")
    if t["absolute"]:
        parts.append(f"{t['absolute']:g}")
    if any("spread" in c for row in block["rows"].values() for c in row.values()):
        parts.append(f"{t['spreads']:g} standard deviations of a record")
    return "the largest of " + ", ".join(parts) if len(parts) > 1 else "".join(parts) or "exact"


def block_text(block: dict[str, Any]) -> str:
    """Text of one part of a table."""
    lines = [f"### {block['title']}", "", block["about"], ""]
    lines.append("| | " + " | ".join(block["columns"]) + " |")
    lines.append("|---|" + "---|" * len(block["columns"]))
    for name, row in block["rows"].items():
        lines.append(f"| {name} | " + " | ".join(cell(row[c]) for c in block["columns"]) + " |")
    compared = [c for row in block["rows"].values() for c in row.values() if "reference" in c]
    if compared:
        inside = sum(c["agrees"] for c in compared)
        lines += ["", f"{inside} of {len(compared)} within the tolerance ({tolerance(block)})."]
    told = [f"- {name or 'All'}: {note}" for name, note in block["notes"].items() if matters(name, block)]
    return "\n".join([*lines, "", *told, ""] if told else [*lines, ""])


def matters(name: str, block: dict[str, Any]) -> bool:
    """Whether a note concerns a number that differs by more than the tolerance."""
    return any(name in ("", b, *b.split(" | ")) for b in block["beyond"])


def page(results: dict[str, Any]) -> str:
    """All tables."""
    lines = [
        "# The seed paper's numbers, worked through",
        "",
        "Each cell is what this package computes, with an independent prototype's number in brackets and a",
        "star where the two differ by more than the tolerance. Made by `python benchmarks/B2_seed_paper.py`.",
        "Friction levels, dead zones and springs of the scenarios S1 to S7 are assumptions.",
        "",
    ]
    for section, table in sorted(results["tables"].items()):
        lines += [f"## {section} {table['title']}", ""]
        lines += [block_text(block) for block in table["blocks"]]
        lines.append(f"Computed in {table['seconds']:.0f} s.\n")
    return "\n".join(lines)
