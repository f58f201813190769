"""B2: errors, step sizes and learning times for the seed paper, beside those of independent prototypes.

    python benchmarks/B2_seed_paper.py
    python benchmarks/B2_seed_paper.py --only 2.4 3 --quick

The seed paper adapts a Volterra model of a flexible joint by LMS (docs/seed_paper.md). Each table of
`seed_paper` computes values about such models with this package and compares them with values that
prototypes without this package computed (`seed_paper/reference.json`), within a stated tolerance.

Tables that the results file already contains are kept, unless `--only` names them or `--fresh` is given.
Writes the values to `results/B2.json` and a page to `results/B2.md`. The exit status is 1 if a difference
beyond the tolerance has no explanation.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
for folder in (HERE, HERE.parent):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))

TABLES = {
    "0": "facts",
    "2.2": "memory",
    "2.3": "orthonormal",
    "2.4": "degree",
    "2.6": "steps",
    "2.7": "orthogonal",
    "2.8": "algorithms",
    "3": "pulses",
    "4": "tuning",
}
"""Number of a table -> module of `seed_paper` that computes it."""

from rotflex_jax.text.files import write_file


def table(section: str, quick: bool) -> dict[str, Any]:
    """Computes one table and compares it with its references."""
    began = time.perf_counter()
    module = importlib.import_module(f"seed_paper.{TABLES[section]}")

    def say(text: str) -> None:
        print(f"  {section} {time.perf_counter() - began:6.1f} s  {text}", flush=True)

    blocks = [block.beside(section) for block in module.blocks(quick, say)]
    seconds = time.perf_counter() - began
    return {"title": module.TITLE, "quick": quick, "seconds": round(seconds, 1), "blocks": blocks}


def summary(found: dict[str, Any]) -> str:
    """How many values are within tolerance, and which differ without an explanation."""
    cells = [
        c for b in found["blocks"] for row in b["rows"].values() for c in row.values() if "reference" in c
    ]
    agree = sum(c["agrees"] for c in cells)
    unexplained = [f"{b['title']}: {name}" for b in found["blocks"] for name in b["unexplained"]]
    lines = [
        f"{agree} of {len(cells)} within tolerance, {len(cells) - agree - len(unexplained)} others explained"
    ]
    return "\n".join([*lines, *(f"    unexplained: {name}" for name in unexplained)])


def arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(
        description="The seed paper's numbers, by this package and by prototypes."
    )
    parser.add_argument("--only", nargs="+", choices=TABLES, metavar="SECTION", help=", ".join(TABLES))
    parser.add_argument(
        "--quick", action="store_true", help="short records: whether all runs, not what comes out"
    )
    parser.add_argument("--fresh", action="store_true", help="compute again what the results file has")
    parser.add_argument("--json", type=Path, help="results file (results/B2.json)")
    parser.add_argument("--markdown", type=Path, help="page (beside the results file)")
    return parser.parse_args()


def main() -> int:
    """Computes missing tables, saves after each one, and prints which values agree."""
    a = arguments()
    from rotflex_jax.runtime.xla import enable_fast_loops

    enable_fast_loops()
    from B0_discovery import save
    from origin import begin
    from seed_paper.page import page

    path = a.json or HERE / "results" / f"B2{'_quick' if a.quick else ''}.json"
    results: dict[str, Any] = {"benchmark": "B2", "runs": [], "tables": {}}
    if path.exists() and not a.fresh:
        results = json.loads(path.read_text())
    modules = [f"seed_paper.{module}" for module in TABLES.values()]
    known, made = results["tables"], begin(results, __file__, sys.argv[1:], scripts=modules)
    wanted = a.only or list(TABLES)
    todo = [s for s in wanted if a.only or a.fresh or s not in known]
    print(f"{len(wanted)} tables, {len(wanted) - len(todo)} known, {len(todo)} to compute")
    for section in todo:
        known[section] = {**table(section, a.quick), "code": made["code"]}
        results["tables"] = {s: known[s] for s in TABLES if s in known}
        known = results["tables"]
        save(path, results)
        print(
            f"{section} {known[section]['title']}, {known[section]['seconds']:.0f} s: "
            f"{summary(known[section])}"
        )
    markdown = a.markdown or path.with_suffix(".md")
    write_file(markdown, page(results))
    codes = {known[s]["code"] for s in wanted}
    if len(codes) > 1:
        print(f"These tables come from {len(codes)} versions of the package.")
    print(f"saved: {path}, {markdown}")
    return int(not a.quick and any(b["unexplained"] for s in wanted for b in known[s]["blocks"]))


if __name__ == "__main__":
    raise SystemExit(main())
