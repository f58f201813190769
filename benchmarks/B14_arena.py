"""B14: scores of the methods that come with the arena, on one small set of recordings with known effects.

    python benchmarks/B14_arena.py --seed 20261
    python benchmarks/B14_arena.py --entrants refit_bic --fresh

The search of this package and the methods it is compared with are called through the interface for methods
of users, each in a separate process. The recordings are drawn from the seed; the scores are those of
`rotflex_jax.arena.scores`. Writes `results/B14.json` and `results/B14.md` after every answer. The same
command continues with missing answers; `--fresh` repeats those of the named methods.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from pathlib import Path
from typing import Any

import B0_discovery as B0
from origin import begin
from rotflex_jax.arena.entrants import ENTRANTS
from rotflex_jax.arena.method import Apart
from rotflex_jax.arena.problems import drawn
from rotflex_jax.arena.scores import COLUMNS, Marks, MethodScore, answered, cells
from rotflex_jax.text.files import write_file

PATH = Path(__file__).resolve().parent / "results" / "B14.json"
SEED, RECORDS, SECONDS, LIMIT = 20261, 8, 8.0, 1500.0


def keep(results: dict[str, Any], name: str, rows: list[dict[str, Any]]) -> None:
    """Stores the rows of a method and their summary in the results."""
    marks = tuple(Marks.of({k: v for k, v in r.items() if k != "code"}) for r in rows)
    own = MethodScore(name, marks)
    results["methods"][name] = {"summary": own.summary(), "cells": cells(own), "rows": rows}
    results["methods"] = {n: results["methods"][n] for n in ENTRANTS if n in results["methods"]}


def page(results: dict[str, Any]) -> str:
    """Markdown of the tables."""
    own, names = results["settings"], list(results["methods"])
    head = ["method", *COLUMNS.values()]
    lines = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * len(COLUMNS)]
    lines += ["| " + " | ".join(results["methods"][n]["cells"]) + " |" for n in names]
    rows = ["| record | kind | hidden | " + " | ".join(names) + " |", "|---:|---|---|" + "---|" * len(names)]
    longest = max((results["methods"][n]["rows"] for n in names), key=len)
    for k, first in enumerate(longest):
        answers = []
        for name in names:
            if k >= len(results["methods"][name]["rows"]):
                answers.append("not run")
                continue
            r = results["methods"][name]["rows"][k]
            text = " + ".join(r["answered"]) if r["verdict"] == "found" else r["verdict"]
            answers.append(f"**{text}**" if r["right"] else text)
        hidden = " + ".join(first["hidden"]) or "nothing"
        rows.append("| " + " | ".join([str(first["record"]), first["kind"], hidden, *answers]) + " |")
    listed = [(n, r) for n in names for r in results["methods"][n]["rows"] if r["reason"]]
    notes = [f"- {n}, record {r['record']}: {r['reason']}" for n, r in listed]
    return "\n".join(
        [
            "# B14: the arena",
            "",
            f"{own['records']} records of {own['seconds']:g} s, seed {own['seed']}, at most "
            f"{own['limit']:g} s for an answer.",
            "",
            *lines,
            "",
            "## Every answer (bold: right; an effect that no recording can tell from the hidden one "
            "counts as it)",
            "",
            *rows,
            *(["", "## Failures", "", *notes] if notes else []),
            "",
        ]
    )


def main() -> int:
    """Scores missing answers and saves after each one."""
    parser = argparse.ArgumentParser(description="Score the methods that come with the arena.")
    parser.add_argument("--entrants", default=",".join(ENTRANTS), help="names, with commas between")
    parser.add_argument("--records", type=int, default=RECORDS, help="simulated records")
    parser.add_argument("--seed", type=int, default=SEED, help="what they are drawn from")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="length of a record [s]")
    parser.add_argument("--limit", type=float, default=LIMIT, help="most time for an answer [s]")
    parser.add_argument("--fresh", action="store_true", help="the named ones again, if they are in the file")
    parser.add_argument("--out", type=Path, default=PATH, help="results file")
    a = parser.parse_args()
    settings = {"seed": a.seed, "records": a.records, "seconds": a.seconds, "limit": a.limit}
    results: dict[str, Any] = {"benchmark": "B14", "runs": [], "settings": settings, "methods": {}}
    if a.out.exists():
        results = json.loads(a.out.read_text())
        if results["settings"] != settings and not a.fresh:
            raise SystemExit(f"{a.out} has {results['settings']}, not {settings}; give --fresh or the same.")
        # With other settings all answers are dropped; otherwise only those of the named methods.
        dropped = a.entrants.split(",") if results["settings"] == settings else list(results["methods"])
        if a.fresh:
            kept = {n: m for n, m in results["methods"].items() if n not in dropped}
            results |= {"settings": settings, "methods": kept}
    made = begin(results, __file__, sys.argv[1:])
    say = lambda line: print(line, flush=True)  # noqa: E731
    problems = drawn(a.records, a.seed, a.seconds, say)
    rows = {n: results["methods"].get(n, {"rows": []})["rows"] for n in a.entrants.split(",")}
    with contextlib.ExitStack() as stack:
        methods = {name: stack.enter_context(Apart(name)) for name in rows}
        for k, problem in enumerate(problems, 1):
            for name, method in methods.items():
                if len(rows[name]) >= k:
                    continue
                say(f"{name}: record {k} of {len(problems)}")
                row = answered(method, problem, k, a.limit).to_dict()
                rows[name].append({**row, "code": made["code"]})
                keep(results, name, rows[name])
                B0.save(a.out, results)
                write_file(a.out.with_suffix(".md"), page(results))
    print(page(results), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
