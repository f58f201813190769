"""B0: does the search find one hidden effect, and nothing where nothing is hidden?

Every effect of the arena at every port where it makes sense, two inputs and two seeds each, and
20 records with nothing hidden. The arena simulates them with a plant whose constants are up to
20 % off the baseline's; the search sees voltage and encoder readings. Nothing was tuned on the
report seeds.

    python benchmarks/B0_discovery.py --workers 2
    python benchmarks/B0_discovery.py --tuning --seeds 100 --inputs noise

Records that the file has already are skipped unless `--fresh` is given.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import importlib.metadata
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
for folder in (HERE, HERE.parent):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))

from rich.console import Console
from rich.table import Table

from arena.hidden import DEFAULTS
from arena.records import INPUTS

TUNING, REPORT = tuple(range(100, 120)), tuple(range(1000, 1020))
Job = dict[str, Any]


def jobs(seeds: list[int], inputs: list[str], nulls: int, seconds: float, only: str) -> list[Job]:
    """Records of a run; the ones with nothing hidden take a seed each and the inputs in turn."""
    base = seeds[0] // 100 * 100
    kinds = list(INPUTS)
    hidden = [
        {"effects": [list(place)], "kind": kind, "seed": seed}
        for place in DEFAULTS
        for kind in inputs
        for seed in seeds
    ]
    nothing = [
        {"effects": [], "kind": kinds[k % len(kinds)], "seed": base + k} for k in range(nulls)
    ]
    chosen = [j for j in hidden + nothing if not only or only in label(j)]
    return [{**j, "seconds": seconds} for j in chosen]


def label(job: Job) -> str:
    """What is hidden, in short."""
    return " + ".join(f"{e}@{p}" for e, p in job["effects"]) or "nothing"


def key(job: Job) -> str:
    """Name of a record in the results."""
    return f"{label(job)}|{job['kind']}|{job['seed']}|{job['seconds']:g}s"


def prepare() -> None:
    """Settings of a process, ahead of JAX."""
    from rotflex_jax.fastloops import enable_fast_loops

    enable_fast_loops()


def one(job: Job) -> dict[str, Any]:
    """A job in a process of its own; imports late, after the settings."""
    from arena.trial import trial

    return trial(job)


def rows(todo: list[Job], workers: int) -> Iterator[tuple[Job, dict[str, Any]]]:
    """Rows as they are ready; a process that dies takes only its own records with it."""
    if workers == 1:
        prepare()
        yield from ((job, one(job)) for job in todo)
        return
    with ProcessPoolExecutor(workers, get_context("spawn"), initializer=prepare) as pool:
        running = {pool.submit(one, job): job for job in todo}
        for done in as_completed(running):
            job = running[done]
            try:
                yield job, done.result()
            except Exception as problem:  # a dead process is a row too
                yield job, {**job, "error": f"{type(problem).__name__}: {problem}", "lines": []}


def provenance() -> dict[str, Any]:
    """What produced the numbers."""
    code = hashlib.sha256()
    for file in sorted((HERE.parent / "rotflex_jax").rglob("*.py")):
        code.update(file.read_bytes())
    git = lambda *a: subprocess.run(  # noqa: E731
        ["git", "-C", str(HERE), *a], capture_output=True, text=True, check=False
    ).stdout.strip()
    return {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "commit": git("rev-parse", "--short", "HEAD"),
        "changed": bool(git("status", "--porcelain", "--", "../rotflex_jax")),
        "code": code.hexdigest()[:12],
        "python": platform.python_version(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "versions": {n: importlib.metadata.version(n) for n in ("jax", "numpy", "scipy")},
    }


def save(path: Path, results: dict[str, Any]) -> None:
    """Write at once or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(results, indent=1) + "\n")
    part.replace(path)


def mark(ok: bool | None) -> str:
    """A tick or a cross."""
    return "-" if ok is None else "[green]yes[/]" if ok else "[red]no[/]"


def answer(row: dict[str, Any]) -> str:
    """What was found, look-alikes of each in brackets."""
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
    """Table of all records, then sums, then the misses."""
    table = Table(title="B0: one hidden effect", header_style="bold")
    columns = (
        "hidden,input,seed,answer,first,exact,in set,verdict,right,error %,vs oracle,wall s,cpu s"
    )
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
        if "error" in row or not (row["first"] and row["exact"] and row["verdict_right"]):
            got = row.get("error") or f"{answer(row)}, {row['verdict']}"
            text = f"  miss: {label(row)} ({row['kind']}, {row['seed']}) -> {got}"
            console.print(text, markup=False)


def summary(records: list[dict[str, Any]]) -> str:
    """The numbers that a release is judged by."""
    good = [r for r in records if "error" not in r]
    seen, null = [r for r in good if r["wanted"]], [r for r in good if not r["wanted"]]
    part = lambda rows, name: f"{sum(bool(r[name]) for r in rows)}/{len(rows)}"  # noqa: E731
    lines = [
        f"effects: first {part(seen, 'first')} (by name {part(seen, 'strict')}), exact set "
        f"{part(seen, 'exact')}, truth in the reported set {part(seen, 'inside')}, verdict "
        f"{part(seen, 'verdict_right')}, with false extras {part(seen, 'extra')}",
        f"nothing to find: false alarms {part(null, 'extra')}, verdict "
        f"{part(null, 'verdict_right')}",
    ]
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


def arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description="Does the search find one hidden effect?")
    parser.add_argument("--tuning", action="store_true", help="tuning seeds (report seeds if not)")
    parser.add_argument("--seeds", default="", help="as 1000,1001; the first two if omitted")
    parser.add_argument("--inputs", default="noise,multisine", help=", ".join(INPUTS))
    parser.add_argument("--only", default="", help="part of a name, as coulomb@hub or nothing")
    parser.add_argument("--nulls", type=int, default=20, help="records with nothing hidden")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a record [s]")
    parser.add_argument("--quick", action="store_true", help="one seed, one input, 10 s, 5 nulls")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--fresh", action="store_true", help="do not reuse records in the file")
    parser.add_argument("--out", type=Path, default=None, help="results file")
    return parser.parse_args()


def main() -> int:
    """Run what is missing, save after each record, print the table."""
    a = arguments()
    seeds = [int(s) for s in a.seeds.split(",") if s] or list((TUNING if a.tuning else REPORT)[:2])
    inputs = [k for k in a.inputs.split(",") if k]
    if set(inputs) - set(INPUTS):
        raise SystemExit(f"--inputs was given {a.inputs}; choose from {', '.join(INPUTS)}.")
    wrong = [s for s in seeds if s not in (TUNING if a.tuning else REPORT)]
    if wrong:
        kind = "tuning" if a.tuning else "report"
        raise SystemExit(f"--seeds was given {wrong}, which are no {kind} seeds.")
    if a.quick:
        seeds, inputs, a.seconds, a.nulls = seeds[:1], inputs[:1], 10.0, min(a.nulls, 5)
    suffix = ("_tuning" if a.tuning else "") + ("_quick" if a.quick else "")
    path = a.out or HERE / "results" / f"B0{suffix}.json"
    wanted = jobs(seeds, inputs, a.nulls, a.seconds, a.only)
    made = provenance()
    results: dict[str, Any] = {"benchmark": "B0", "runs": [], "records": {}}
    if path.exists() and not a.fresh:
        results = json.loads(path.read_text())
    results["runs"].append({**made, "arguments": sys.argv[1:]})
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 200)
    known = results["records"]
    todo = [j for j in wanted if key(j) not in known or "error" in known[key(j)]]
    console.print(f"{len(wanted)} records, {len(wanted) - len(todo)} known, {len(todo)} to run")
    began = time.perf_counter()
    for count, (job, row) in enumerate(rows(todo, a.workers), 1):
        known[key(job)] = {**row, "code": made["code"]}
        save(path, results)
        got = row.get("error") or f"{answer(row)}, {row['verdict']}, {row['wall_s']:.1f} s"
        left = (time.perf_counter() - began) / count * (len(todo) - count)
        text = f"{count}/{len(todo)} {key(job)} -> {got} ({left:.0f} s left)"
        console.print(text, markup=False, soft_wrap=True)
    shown = [known[key(j)] for j in wanted]
    show(console, shown)
    codes = {r.get("code") for r in shown}
    if len(codes) > 1:
        console.print(f"[yellow]These records come from {len(codes)} versions of the package.[/]")
    console.print(f"saved: {path}", markup=False, soft_wrap=True)
    return int(any("error" in r for r in shown))


if __name__ == "__main__":
    raise SystemExit(main())
