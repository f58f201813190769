"""B11: how often intervals contain the true value, and how many samples lie inside prediction bands.

    python benchmarks/B11_certainty.py --workers 16
    python benchmarks/B11_certainty.py --tuning --parts intervals --only lugre --seeds 100,101

All recordings are simulated (`rotflex_jax.arena.simulator`), so that the true values are known.

- `intervals`: short recordings with one hidden friction or play, at three sizes. The true structure is
  fitted; the result is the share of 95 % intervals by profile likelihood that contain the true value, and
  the same for Wald intervals.
- `bands`: a recording of the same machine that was not fitted. The result is the share of its samples in the
  90 % band of the true structure, and of the textbook model, which lacks the effect.
- `cost`: processor time of profiles, identifiability, bands and probabilities, for a recording of 20 s.

Writes `results/B11.json` and the page `results/B11.md`. Rows that the results already contain are kept
unless `--fresh` is given. Processes share compiled programs if ROTFLEX_PROGRAMS names a folder.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console

import B0_discovery as B0
from origin import begin
from rotflex_jax.text.files import write_file

HERE = Path(__file__).resolve().parent
FRICTION = (("lugre", "hub"), ("bouc_wen", "hub"), ("backlash", "hub"), ("stribeck", "hub"))
BANDS = (
    ("coulomb", "hub"),
    ("stribeck", "hub"),
    ("lugre", "hub"),
    ("bouc_wen", "hub"),
    ("backlash", "hub"),
    ("coulomb", "joint"),
    ("cubic_spring", "joint"),
    ("quadratic_drag", "hub"),
    ("gravity", "hub"),
    ("voltage_offset", "input"),
)
SIZES = (1.0, 0.3, 0.1)
PARTS = ("intervals", "bands", "cost")
Job = dict[str, Any]


def jobs(a: argparse.Namespace, seeds: list[int], inputs: list[str]) -> list[Job]:
    """Jobs of a run."""
    found = list[Job]()
    if "intervals" in a.parts:
        found += [
            {"part": "intervals", "effects": [list(p)], "kind": kind, "seed": seed, "size": size}
            for p in FRICTION
            for size in SIZES
            for kind in inputs
            for seed in seeds
        ]
    if "bands" in a.parts:
        found += [
            {"part": "bands", "effects": [list(p)], "kind": kind, "seed": seed, "size": 1.0}
            for p in BANDS
            for kind in inputs
            for seed in seeds
        ]
    if "cost" in a.parts:
        found += [
            {"part": "cost", "effects": [list(p)], "kind": inputs[0], "seed": seeds[0], "size": 1.0}
            for p in FRICTION
        ]
    return [{**j, "seconds": a.seconds} for j in found if not a.only or a.only in key({**j, "seconds": 0})]


def key(job: Job) -> str:
    """Key of a row in the results."""
    name = "+".join("@".join(p) for p in job["effects"]) or "nothing"
    size = "" if job["size"] == 1 else f" x{job['size']:g}"
    return f"{job['part']}|{name}{size}|{job['kind']}|{job['seed']}|{job['seconds']:g}s"


def one(job: Job) -> dict[str, Any]:
    """Row of a job, computed in a worker; imports follow the settings of the process."""
    from arena.certainty import trial

    return trial(job)


def summary(rows: list[Job]) -> dict[str, Any]:
    """Coverage of intervals by effect and size, coverage of bands by effect, and cost by effect."""
    good = [r for r in rows if "error" not in r]
    intervals, bands = dict[str, Any](), dict[str, Any]()
    name = lambda r: "@".join(r["effects"][0])  # noqa: E731
    of = [r for r in good if r["part"] == "intervals"]
    for effect in dict.fromkeys(name(r) for r in of):
        for size in (*SIZES, None):
            found = [i for r in of if name(r) == effect and size in (None, r["size"]) for i in r["intervals"]]
            if found:
                intervals[f"{effect} {'all' if size is None else size}"] = _intervals(found)
    each = [i for r in of for i in r["intervals"]]
    if each:
        intervals["all"] = _intervals(each)
    for row in (r for r in good if r["part"] == "bands"):
        for group in (name(row), "all"):
            for column in ("coverage", "with_known", "textbook", "textbook_known"):
                for channel, share in row[column].items():
                    cell = bands.setdefault(group, {}).setdefault(column, {}).setdefault(channel, [])
                    cell.append(share)
    means = {
        group: {
            column: {channel: sum(shares) / len(shares) for channel, shares in channels.items()}
            for column, channels in columns.items()
        }
        for group, columns in bands.items()
    }
    means |= {"all": means.pop("all")} if "all" in means else {}
    spent = {name(r): r["processor_s"] for r in good if r["part"] == "cost"}
    cost = {effect: {**parts, "all": sum(parts.values())} for effect, parts in spent.items()}
    return {"intervals": intervals, "bands": means, "cost": cost, "failed": len(rows) - len(good)}


def _intervals(found: list[Job]) -> dict[str, Any]:
    """Number of some intervals, shares of them, and the median time of one [s]."""
    seconds = sorted(i["s"] for i in found)
    return {
        "count": len(found),
        "profile": sum(i["held"] for i in found) / len(found),
        "wald": sum(i["wald_held"] for i in found) / len(found),
        "wald_is_poor": sum(i["wald_is_poor"] for i in found) / len(found),
        "open": sum(i["shape"].startswith("open") for i in found) / len(found),
        "seconds": seconds[len(seconds) // 2],
    }


def page(s: dict[str, Any], made: dict[str, Any]) -> str:
    """Markdown of all tables."""
    percent = lambda x: f"{100 * x:.1f}"  # noqa: E731
    lines = ["# B11: intervals and bands", ""]
    lines += ["| effect, size | intervals | profile [%] | Wald [%] | Wald poor [%] | open [%] | s each |"]
    lines += ["|---|---:|---:|---:|---:|---:|---:|"]
    for name, i in s["intervals"].items():
        numbers = [percent(i[k]) for k in ("profile", "wald", "wald_is_poor", "open")]
        lines.append(f"| {name} | {i['count']} | {' | '.join(numbers)} | {i['seconds']:.2f} |")
    lines += ["", "Share of 95 % intervals that hold the true number.", ""]
    lines += ["| hidden | true structure | with a known run | textbook | textbook with a known run |"]
    lines += ["|---|---|---|---|---|"]
    for name, columns in s["bands"].items():
        cells = [
            ", ".join(f"{channel} {percent(share)}" for channel, share in columns[k].items())
            for k in ("coverage", "with_known", "textbook", "textbook_known")
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += ["", "Share of the samples [%] of a held-out run in bands of 90 %, mean over the records.", ""]
    if s["cost"]:
        names = list(next(iter(s["cost"].values())))
        lines += [f"| hidden | {' | '.join(names)} |", f"|---|{'---:|' * len(names)}"]
        lines += [
            f"| {effect} | {' | '.join(f'{parts[n]:.1f}' for n in names)} |"
            for effect, parts in s["cost"].items()
        ]
        lines += ["", "Processor time [s] after the fit of a record of 20 s, compiling included.", ""]
    clean = "clean" if made["clean"] else "with changes"
    versions = ", ".join(f"{n} {v}" for n, v in made["versions"].items())
    lines += [f"{s['failed']} rows failed. Commit {made['commit']} ({clean}), {made['date']}, {versions}."]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Runs missing rows, saves every few seconds, and prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--tuning", action="store_true", help="tuning seeds (report seeds if not)")
    parser.add_argument("--seeds", default="", help="as 1000,1001; all if omitted")
    parser.add_argument("--inputs", default="noise,multisine", help="kinds of input")
    parser.add_argument("--parts", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--only", default="", help="part of a name, as lugre@hub")
    parser.add_argument("--seconds", type=float, default=6.0, help="length of a run [s]")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--fresh", action="store_true", help="run again what the results have already")
    a = parser.parse_args()
    known_seeds = B0.TUNING if a.tuning else B0.REPORT
    seeds = [int(s) for s in a.seeds.split(",") if s] or list(known_seeds)
    if set(seeds) - set(known_seeds):
        raise SystemExit(f"--seeds was given {seeds}; choose from {known_seeds[0]} to {known_seeds[-1]}.")
    path = HERE / "results" / f"B11{'_tuning' if a.tuning else ''}.json"
    results: dict[str, Any] = {"benchmark": "B11", "runs": [], "rows": {}}
    if path.exists() and not a.fresh:
        results = json.loads(path.read_text())
    made = begin(results, __file__, sys.argv[1:])
    wanted = jobs(a, seeds, [k for k in a.inputs.split(",") if k])
    known = results["rows"]
    todo = [j for j in wanted if key(j) not in known or "error" in known[key(j)]]
    console = Console(highlight=False, width=160)
    console.print(f"{len(wanted)} rows, {len(todo)} to run")
    began = saved = time.perf_counter()
    for count, (job, row) in enumerate(B0.rows(todo, a.workers, one), 1):
        known[key(job)] = {"code": made["code"], **row}
        now = time.perf_counter()
        if now - saved > 5:
            B0.save(path, results)
            saved = now
        left = (now - began) / count * (len(todo) - count)
        said = row.get("error") or row.get("coverage") or row.get("processor_s")
        said = said or [i["held"] for i in row["intervals"]]
        console.print(f"{count}/{len(todo)} {key(job)} -> {said} ({left:.0f} s left)", markup=False)
    results["summary"] = summary(list(known.values()))
    B0.save(path, results)
    text = page(results["summary"], made)
    write_file(path.with_suffix(".md"), text)
    console.print(text, markup=False)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
