"""B9: searches on every measured machine, evaluated on test data that were used for no fit and no choice.

    python benchmarks/B9_measured.py
    python benchmarks/B9_measured.py --only rotflex two_dof_link_1
    python benchmarks/B9_measured.py --only "rotflex: A to B" --fresh
    python benchmarks/B9_measured.py --workers 16
    python benchmarks/B9_measured.py --again --minutes 60 --workers 2 --methods
    python benchmarks/B9_measured.py --list

A direction is a split of the recordings of a machine into training, validation and test data. The search is
fitted to training data and decides on validation data. Errors are those of free runs over the whole test
recordings and over windows of 2 s, with and without a voltage offset that is fitted to the first 2 s of
each test recording. Other methods (`rotflex_jax.compare`) are fitted to the same training and validation
data, and the best one is shown beside the search.

The search runs in a new process without compiled programs, and again in another new process that uses the
compiled programs of the first. With several workers, each direction has one core, all share compiled
programs, and no times are reported.

Needs the recordings, fetched or in the folder named by `ROTFLEX_DATA`. Writes `results/B9.json` and the page
`results/B9.md` after each direction. Directions that the file already contains are kept unless `--fresh` is
given, or `--again`: it repeats those that were searched with another version of the code, one by one, so that
it can be interrupted and continued.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import queue
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

import rotflex_jax as rf
from B0_discovery import finished, save
from measured_machines.page import page
from origin import begin
from rotflex_jax.arena.measured import MACHINES
from rotflex_jax.compare import QUICK
from rotflex_jax.text.files import write_file
from speed.processes import process

CHILD = "from measured_machines.child import main; main()"


def directions(only: list[str]) -> tuple[list[tuple[str, str]], dict[str, str]]:
    """Chosen pairs of machine and direction, and machines that are left out with the reason."""
    wanted, left_out = list[tuple[str, str]](), dict[str, str]()
    for name, machine in MACHINES.items():
        chosen = [o for o in only if o == name or o.startswith(f"{name}: ")]
        if only and not chosen:
            continue
        try:
            names = [direction.name for direction in machine.directions()]
        except (rf.InputError, OSError) as problem:
            left_out[name] = str(problem)
            continue
        wanted += [(name, d) for d in names if not only or name in chosen or f"{name}: {d}" in chosen]
    return wanted, left_out


def side_by_side(
    todo: list[tuple[str, str]], methods: list[str], workers: int, until: float
) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yields finished directions; each runs in a process on a separate core, and times are left out.

    None is started after the time `until` of the monotonic clock.
    """
    free = queue.SimpleQueue[int]()
    for core in sorted(os.sched_getaffinity(0))[:workers]:
        free.put(core)

    def one(machine: str, direction: str, cache: str) -> dict[str, Any]:
        core = free.get()
        child = f"import os; os.sched_setaffinity(0, {{{core}}}); {CHILD}"
        try:
            row = process(child, machine, direction, "cold", *methods, cache=cache, show=True)
        except subprocess.CalledProcessError as problem:
            return {"error": f"the process ended with {problem.returncode}"}
        finally:
            free.put(core)
        for name in ("clock", "processor", "clock_s", "processor_s"):
            row.pop(name, None)
        return row

    with tempfile.TemporaryDirectory() as cache, ThreadPoolExecutor(workers) as pool:
        running = {pool.submit(one, *pair, cache): pair for pair in todo}
        for done in finished(running, until):
            yield *running[done], done.result()


def measured(machine: str, direction: str, methods: list[str], warm: bool) -> dict[str, Any]:
    """Row of a direction: all in a new process, the search again in another; or the error of a process."""
    with tempfile.TemporaryDirectory() as cache:
        try:
            first = process(CHILD, machine, direction, "cold", *methods, cache=cache, show=True)
            again = process(CHILD, machine, direction, "warm", cache=cache, show=True) if warm else None
        except subprocess.CalledProcessError as problem:
            return {"error": f"the process ended with {problem.returncode}"}
    times = lambda found: {k: found.pop(k) for k in ("clock_s", "processor_s")}  # noqa: E731
    for found in (first, again or {}):  # times of the whole process
        found.pop("clock", None)
        found.pop("processor", None)
    row = {"machine": machine, "direction": direction, "cold": times(first), **first}
    if again is not None:
        row["warm"] = times(again)
        answers = [[(r["effect"], r["port"], r["status"]) for r in f["rounds"]] for f in (first, again)]
        row["same_again"] = answers[0] == answers[1]
    return row


def with_comparison(row: dict[str, Any], before: dict[str, Any]) -> dict[str, Any]:
    """A row that lacks other methods, with those of an earlier row and the commit of that row."""
    others = before.get("others")
    if "error" in row or row["others"] or not others:
        return row
    return row | {"others": {"commit": before["commit"], **others}}


def arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="NAME", help='as rotflex or "rotflex: A to B"'
    )
    parser.add_argument("--list", action="store_true", help="Name all directions and end.")
    parser.add_argument(
        "--methods",
        nargs="*",
        default=None,
        help="of the comparison; the quick ones if omitted; those of the earlier row if none is named",
    )
    parser.add_argument("--workers", type=int, default=1, help="directions at the same time")
    parser.add_argument("--cold-only", action="store_true", help="No second search of each direction.")
    parser.add_argument("--fresh", action="store_true", help="Run again what the results have already.")
    parser.add_argument("--again", action="store_true", help="known directions of other code, once more")
    parser.add_argument("--minutes", type=float, default=math.inf, help="begin no direction after so long")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "B9.json")
    return parser.parse_args()


def main() -> int:
    """Runs missing directions and saves after each one."""
    a = arguments()
    wanted, left_out = directions(a.only)
    if a.only and not wanted and not left_out:
        raise SystemExit(f"--only was given {', '.join(a.only)}; --list names what there is.")
    for name, reason in left_out.items():
        print(f"{name}: left out, {reason}", flush=True)
    if a.list:
        print("\n".join(f"{machine}: {direction}" for machine, direction in wanted))
        return 0
    methods = list(QUICK) if a.methods is None else a.methods
    results: dict[str, Any] = {"benchmark": "B9", "runs": [], "rows": {}}
    if a.out.is_file():
        results = json.loads(a.out.read_text())
    made = begin(results, __file__, sys.argv[1:], scripts=("measured_machines.child",))
    results["left_out"] = {**results.get("left_out", {}), **left_out}
    rows = results["rows"]
    if a.again:
        wanted = [pair for pair in wanted if ": ".join(pair) in rows]
    current = lambda row: "error" not in row and (not a.again or row.get("code") == made["code"])  # noqa: E731
    known = {key for key, row in rows.items() if current(row) and not a.fresh}
    todo = [pair for pair in wanted if ": ".join(pair) not in known]
    print(f"{len(wanted)} directions, {len(wanted) - len(todo)} known, {len(todo)} to run", flush=True)
    until = time.monotonic() + 60 * a.minutes
    if a.workers > 1:
        done = side_by_side(todo, methods, a.workers, until)
    else:
        done = (
            (*pair, measured(*pair, methods, not a.cold_only)) for pair in todo if time.monotonic() < until
        )
    for count, (machine, direction, row) in enumerate(done, 1):
        key = f"{machine}: {direction}"
        head = {"machine": machine, "direction": direction}
        rows[key] = (
            head | with_comparison(row, rows.get(key, {})) | {k: made[k] for k in ("commit", "clean", "code")}
        )
        results["left_out"].pop(machine, None)
        save(a.out, results)
        write_file(a.out.with_suffix(".md"), page(results))
        print(f"{count}/{len(todo)} {key}: {row.get('error') or row['sentence']}", flush=True)
    save(a.out, results)
    write_file(a.out.with_suffix(".md"), page(results))
    print(page(results))
    print(f"saved: {a.out}")
    return int(any("error" in r for r in rows.values()))


if __name__ == "__main__":
    raise SystemExit(main())
