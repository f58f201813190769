"""B7: time of filters, simulations, fits and searches, beside C, numba and other libraries.

    python benchmarks/B7_speed.py                       # everything
    python benchmarks/B7_speed.py --only lms motion     # some subsets; results of the others are kept
    python benchmarks/B7_speed.py --plain --only lms    # without the compiler's option for small loops

The cases of a subset that are compared with each other are timed in one process, in turn and in random
order; the first call, which compiles, is timed separately. Subsets that measure new processes or whole
searches start processes. If other programs use the machine, only the ratios of minima within one subset are
meaningful.

Writes `results/B7.json` and the page `results/B7.md`; with `--plain` only `results/B7_plain.json`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rotflex_jax
from origin import begin, part

HERE = Path(__file__).resolve().parent / "results"

from rotflex_jax.text.files import write_file


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=list(SUBSET), default=list(SUBSET), metavar="SUBSET")
    parser.add_argument("--rounds", type=int, default=5, help="visits of every case")
    parser.add_argument("--visit", type=float, default=0.1, help="seconds of a visit")
    parser.add_argument("--quick", action="store_true", help="short records: to see whether it runs")
    parser.add_argument("--plain", action="store_true", help="without the option for small loops")
    chosen = parser.parse_args()
    if not chosen.plain:
        rotflex_jax.enable_fast_loops()
    run(chosen)


def run(chosen: argparse.Namespace) -> None:
    """Measures the chosen subsets and keeps earlier results of the others."""
    from rich.progress import Progress

    from speed import table

    path = HERE / ("B7_plain.json" if chosen.plain else "B7.json")
    results = json.loads(path.read_text()) if path.exists() else {}
    begin(results, __file__, sys.argv[1:])
    with Progress() as progress:
        for name in chosen.only:
            results[name] = {**SUBSET[name](chosen, progress), "machine": machine()}
            part(results, name)
            write_file(path, json.dumps(results, indent=1) + "\n")
    if not chosen.plain:
        write_file(path.with_suffix(".md"), table.page(results))


def machine() -> dict[str, Any]:
    """Processor, versions and date of the run."""
    import jax

    model = [x for x in Path("/proc/cpuinfo").read_text().splitlines() if x.startswith("model name")]
    return {
        "processor": model[0].split(":")[1].strip() if model else platform.processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "date": time.strftime("%Y-%m-%d"),
    }


def compared(
    groups: list[list[Any]], chosen: argparse.Namespace, progress: Any, title: str
) -> dict[str, Any]:
    """Times of groups of cases, each group timed together, and the noise of these times."""
    from speed.rounds import noise, timed

    found = []
    for cases in groups:
        results = timed(cases, chosen.rounds, progress, title, visit=chosen.visit)
        rows = [dataclasses.asdict(r) for r in results.values()]
        found.append({"rows": rows, "noise": noise(results)})
    return {"groups": found}


def _lms(chosen: argparse.Namespace, progress: Any) -> dict[str, Any]:
    from speed import filters

    sizes = {5: 1_000_000, 10: 300_000, 20: 100_000, 50: 20_000}
    groups = [filters.lms_cases(M, N // 20 if chosen.quick else N) for M, N in sizes.items()]
    return compared(groups, chosen, progress, "LMS")


def _rls(chosen: argparse.Namespace, progress: Any) -> dict[str, Any]:
    from speed import filters

    sizes = {5: 40_000, 10: 8_000, 20: 800}
    groups = [filters.rls_cases(M, N // 4 if chosen.quick else N) for M, N in sizes.items()]
    return compared(groups, chosen, progress, "RLS")


def _pairs(chosen: argparse.Namespace, progress: Any) -> dict[str, Any]:
    from speed import filters

    return compared([filters.pairs_cases(5_000 if chosen.quick else 100_000)], chosen, progress, "pairs")


def _motion(chosen: argparse.Namespace, progress: Any) -> dict[str, Any]:
    from speed import motion

    found = compared([motion.cases(2_000 if chosen.quick else 20_000)], chosen, progress, "motion")
    return {**found, "facts": motion.errors()}


def _seconds(chosen: argparse.Namespace) -> float:
    return 1.0 if chosen.quick else 10.0


def _fit(chosen: argparse.Namespace, progress: Any) -> dict[str, Any]:
    from speed import fits

    found = compared([fits.one_start(_seconds(chosen))], chosen, progress, "fit")
    return {**found, "facts": fits.quality(_seconds(chosen))}


def _joint(chosen: argparse.Namespace, progress: Any) -> dict[str, Any]:
    from speed import fits

    return compared([fits.joint_fit(16, _seconds(chosen))], chosen, progress, "joint fit")


def _starts(chosen: argparse.Namespace, progress: Any) -> dict[str, Any]:
    from speed import fits

    cases, reached = fits.many(16 if chosen.quick else 64, 4.0 if chosen.quick else 10.0)
    found = compared([cases], chosen, progress, "starts")
    return {**found, "facts": reached}


def _others(chosen: argparse.Namespace, progress: Any) -> dict[str, Any]:
    from speed.others import others

    return {"facts": others(_seconds(chosen))}


def _cold(chosen: argparse.Namespace, progress: Any) -> dict[str, Any]:
    from speed.processes import cold

    return {"facts": cold(_seconds(chosen))}


def _devices(chosen: argparse.Namespace, progress: Any) -> dict[str, Any]:
    from speed.devices import devices

    return {"facts": devices(2.0, 8, 4) if chosen.quick else devices(10.0, 64, 16)}


def _search(chosen: argparse.Namespace, progress: Any) -> dict[str, Any]:
    from speed.search import searches

    return {"facts": searches(6.0 if chosen.quick else 20.0)}


def _waiting(chosen: argparse.Namespace, progress: Any) -> dict[str, Any]:
    from speed.waiting import waiting

    return {"waiting": waiting(6.0 if chosen.quick else 20.0)}


def _fleet(chosen: argparse.Namespace, progress: Any) -> dict[str, Any]:
    from speed.search import fleet

    return {"facts": fleet(6.0, 1) if chosen.quick else fleet(20.0, 10)}


def _growth(chosen: argparse.Namespace, progress: Any) -> dict[str, Any]:
    from speed.growth import WORK, grown

    longest = 5 if chosen.quick else 7
    lengths = [10**k for k in range(4, longest + 1)]
    bar = progress.add_task("growth", total=len(WORK) * len(lengths))
    found: dict[str, Any] = {}
    for work in WORK:
        # Fits are left out at the greatest length, which no recording has.
        for N in lengths if work != "two runs of a fit" else lengths[:-1]:
            found.setdefault(work, {})[str(N)] = grown(work, N)
            progress.advance(bar)
    return {"growth": found}


SUBSET: dict[str, Callable[[argparse.Namespace, Any], dict[str, Any]]] = {
    "lms": _lms,
    "rls": _rls,
    "pairs": _pairs,
    "motion": _motion,
    "fit": _fit,
    "joint": _joint,
    "starts": _starts,
    "others": _others,
    "cold": _cold,
    "devices": _devices,
    "search": _search,
    "waiting": _waiting,
    "fleet": _fleet,
    "growth": _growth,
}


if __name__ == "__main__":
    main()
