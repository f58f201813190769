"""The supplement: full tables of the arena and of the comparisons -> build/supplement.md."""

from typing import Any

from fig_arena import label
from sources import PAPER, claims

INTRODUCTION = """---
title: 'rotflex_jax: supplement'
---

Tables in full, generated from the result files of the benchmarks. Errors are those of free runs on data that
no fit has seen.
"""

ARENA = """
# The arena, record by record

Each record is 20 s of a machine of its own: constants up to 20 % off those that the model starts with, two
encoders, the input named. *Answer*: what was found, in order; in brackets what could not be told from it.
*Over oracle*: held-out error over that of the true structure, fitted from half the true sizes; the worse of
the two angles. Revision {commit}.
"""


def table(headings: list[str], rows: list[list[str]]) -> str:
    """A Markdown table; sizes of the columns follow the headings."""
    lines = ["| " + " | ".join(row) + " |" for row in (headings, ["-" * len(h) for h in headings], *rows)]
    return "\n".join(lines) + "\n"


def answer(record: dict[str, Any]) -> str:
    """What the search said."""
    said = []
    for r in record["rounds"]:
        alike = ", ".join(f"{e.replace('_', ' ')} at {p}" for e, p in r["equivalent"])
        said.append(f"{r['effect'].replace('_', ' ')} at {r['port']}" + (f" [{alike}]" if alike else ""))
    return "; ".join(said) or "nothing"


def arena() -> str:
    """One row per record."""
    rows = []
    groups = (claims.records(), claims.records(hidden=False), claims.records(outside=True))
    for record in (r for group in groups for r in group):
        ratio = record.get("over_oracle")
        rows.append(
            [
                label(record["effects"]),
                f"{record['kind']}, {record['seed']}",
                answer(record),
                record["verdict"].replace("_", " "),
                f"{max(ratio.values()):.2f}" if ratio else "",
                f"{record['wall_s']:.0f}",
            ]
        )
    heads = [
        "hidden------------",
        "input, seed",
        "answer------------------",
        "verdict----",
        "over oracle",
        "time [s]",
    ]
    text = table(heads, rows)
    # The dashes gave the columns their widths.
    first, _, rest = text.partition("\n")
    return first.replace("-", "") + "\n" + rest


def numbers() -> str:
    """True and estimated parameters of every effect that was found."""
    rows = []
    for record in claims.records():
        for name, p in record["parameters"].items():
            interval = f"{1.96 * p['std']:.2g}" if p.get("std") else ""
            cells = [f"{p['true']:.4g}", f"{p['estimate']:.4g}", interval, f"{p['error_percent']:.1f}"]
            rows.append([name.replace("_", " "), f"{record['kind']}, {record['seed']}", *cells])
    return table(["parameter", "input, seed", "true", "found", "± 95 %", "error [%]"], rows)


def main() -> None:
    """Write the supplement."""
    parts = [INTRODUCTION, ARENA.format(commit=claims.arena_commit()), arena()]
    parts += ["\n# The arena, true and found numbers [SI units]\n", numbers()]
    for title, file in (
        ("Public machines", "B3.md"),
        ("The next experiment", "B4.md"),
        *(
            (f"Every method: {f.stem.replace('_', ' ')}", f"B5/{f.name}")
            for f in sorted((claims.RESULTS / "B5").glob("*.md"))
        ),
    ):
        text = (claims.RESULTS / file).read_text(encoding="utf-8")
        pictures = [line for line in text.splitlines() if not line.lstrip().startswith("![")]
        parts.append(f"\n# {title}\n\n" + "\n".join(pictures) + "\n")
    build = PAPER / "build"
    build.mkdir(exist_ok=True)
    (build / "supplement.md").write_text("\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
