"""B10: models of a hobby servo with its firmware, beside the extended friction models of arXiv 2410.08650.

    python benchmarks/B10_servo.py
    python benchmarks/B10_servo.py --only "gain 200" --parts models fits
    python benchmarks/B10_servo.py --parts "so101 search" --joints Elbow
    python benchmarks/B10_servo.py --fresh --rollouts 100000

The recordings are of an XL-330 that lifts a pendulum, with four gains of its controller and three motions.
Every motion and every gain is left out once, models are fitted to the other recordings, and the errors of
free runs over those that were left out are compared. `--parts` chooses among

    models        M1 to M6 (equations in servo/friction_models.py), fitted by CMA-ES as their authors do, and
                  one structure of the grey box, fitted by CMA-ES too
    fits          the grey box with several laws of friction, fitted by `rf.fit`
    search        the grey box with the effects that `rf.discover` finds
    direction     whether friction while lifting can be distinguished from friction while lowering
    supply        resistance of the supply, from the motion and from its logged voltage
    released      friction of the gear, from runs with the motor switched off
    so101         the same comparison for joints of an SO-101
    so101 search  a search for its joints that `--joints` names

Needs numba, and the recordings: `rotflex data fetch bam_xl330 so101`, or a folder named by `ROTFLEX_DATA`.
Writes `results/B10.json` and the page `results/B10.md`, and the figure docs/figures/servo.png unless `--out`
names another folder. Results that the file already contains are kept unless `--fresh` is given.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

# With matrices of ten rows, several threads would mostly wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import numba

import rotflex_jax as rf
from origin import begin, git, part

rf.enable_fast_loops()
rf.enable_compilation_cache()

from servo.arm import JOINTS, arm
from servo.evolved import evolved
from servo.figure import draw
from servo.friction_models import MODELS
from servo.grey_box import (
    ABSOLUTE,
    ALIKE,
    FRICTION,
    ROBUST,
    YIELDING,
    direction,
    evolved_grey_box,
    fitted,
    released,
    searched,
    servo,
    supply,
    yielding,
)
from servo.page import page, summary
from servo.recordings import Split, splits

RESULTS = HERE / "results"
FIGURE = HERE.parent / "docs" / "figures" / "servo.png"
PARTS = ("models", "fits", "search", "direction", "supply", "released", "so101", "so101 search")

from rotflex_jax.text.files import write_file


def machine() -> dict[str, Any]:
    """Commit, machine and versions of the latest run."""
    return {
        "commit": git("rev-parse", "--short", "HEAD"),
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numba": numba.__version__,
        "date": datetime.date.today().isoformat(),
    }


def rows(split: Split, parts: list[str], rollouts: int, say: Callable[[str], None]) -> dict[str, Callable]:
    """Name of each row of a split -> function that computes it."""
    jobs: dict[str, Callable[[], dict[str, Any]]] = {}
    if "models" in parts:
        jobs |= {name: lambda name=name: evolved(name, split, rollouts, seed=1) for name in MODELS}
        jobs[f"{ALIKE}, CMA-ES"] = lambda: evolved_grey_box(split, rollouts)
    if "fits" in parts:
        jobs |= {name: lambda e=effects: fitted(servo(e), split)[1] for name, effects in FRICTION.items()}
        jobs[ROBUST] = lambda: fitted(servo(FRICTION["motor friction, delay"]), split, ABSOLUTE)[1]
        jobs[YIELDING] = lambda: fitted(yielding(), split)[1]
    if "search" in parts:
        jobs["search"] = lambda: searched(split, say)
    return jobs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", help="What is left out, for instance 'gain 200'.")
    parser.add_argument("--parts", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--rollouts", type=int, default=20_000, help="Free runs of each evolution.")
    parser.add_argument("--workers", type=int, default=1, help="Processes that share the joints of the arm.")
    parser.add_argument(
        "--joints", nargs="*", choices=JOINTS, default=["Elbow"], help="Joints that are searched."
    )
    parser.add_argument("--fresh", action="store_true", help="Run again what the results have already.")
    parser.add_argument("--out", type=Path, default=RESULTS / "B10.json")
    given = parser.parse_args()
    found: dict[str, Any] = json.loads(given.out.read_text()) if given.out.is_file() else {"splits": {}}
    made, began = begin(found, __file__, sys.argv[1:]), time.perf_counter()

    def say(text: str) -> None:
        print(f"{time.perf_counter() - began:6.1f} s  {text}", flush=True)

    def keep() -> None:
        found["machine"], found["summary"] = machine(), summary(found["splits"])
        given.out.parent.mkdir(exist_ok=True)
        write_file(given.out, json.dumps(found, indent=1) + "\n")
        write_file(given.out.with_suffix(".md"), page(found))

    known = splits(rf.data.load_dataset("bam_xl330"))
    for name in given.only or known:
        case = found["splits"].setdefault(name, {})
        for row, compute in rows(known[name], given.parts, given.rollouts, say).items():
            if row in case and not given.fresh:
                continue
            case[row] = {**compute(), "code": made["code"]}
            test = {k: round(v["mean"], 2) for k, v in case[row]["test"].items()}
            say(f"{name} left out, {row}: {test}")
            keep()
    if "direction" in given.parts and ("direction" not in found or given.fresh):
        found["direction"] = direction(known["gain 200"], say)
        part(found, "direction")
        keep()
    if "supply" in given.parts and ("supply" not in found or given.fresh):
        found["supply"] = supply(known["gain 200"])
        part(found, "supply")
        keep()
    if "released" in given.parts and ("released" not in found or given.fresh):
        found["released"] = released()
        part(found, "released")
        keep()
    if {"so101", "so101 search"} & set(given.parts):
        if given.fresh and "so101" in given.parts:
            found["so101"] = []
            part(found, "so101")
        search = given.joints if "so101 search" in given.parts else ()
        rows_of_arm = found.setdefault("so101", [])
        for row in rows_of_arm:
            if given.fresh and row["joint"] in search:
                row.pop("search", None)
        arm(say, given.rollouts // 5, rows_of_arm, keep, made["code"], search, given.workers)
    keep()
    if given.out.parent == RESULTS:
        draw(found["summary"], FIGURE)
    print(page(found))


if __name__ == "__main__":
    main()
