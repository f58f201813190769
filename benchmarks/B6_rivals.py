"""B6: other methods that name the hidden effect, on the recordings of B0, scored by the same rules.

    python benchmarks/B6_rivals.py --tuning --seeds 100 --workers 2
    python benchmarks/B6_rivals.py --seeds 1002 --rivals "refit + BIC" --workers 16 --minutes 5

The methods are forward selection with full refits, regressions, SINDy and a neural torque
(`rotflex_jax.arena.rivals`). Each method is given training and validation data and names effects. The grey
box then fits the structure that was named, so that the validation error is that of the named structure and
does not depend on how the method computes. It is compared with the error of the true structure.

The row of the search is taken from the results of B0, which must be run first with the same seeds and
inputs. Writes `results/B6.json` and `results/B6.md`. Rows that the results already contain are kept, and
the tables cover all rows.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
import traceback
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

import B0_discovery as B0
from origin import begin

HERE = Path(__file__).resolve().parent
NAMES = (
    "refit + BIC",
    "torque balance + BIC",
    "free-run residual + BIC",
    "SINDy",
    "SINDy ensemble",
    "SINDy weak",
    "neural torque + BIC",
)
OURS = "rotflex_jax"
COLUMNS = (
    "method",
    "right first",
    "exact set",
    "false alarms",
    "outside flagged",
    "error over oracle's",
    "within 5 %",
    "s",
    "failed",
)
Job = dict[str, Any]

from rotflex_jax.text.files import write_file


def one(job: Job) -> dict[str, Any]:
    """Row of a method on a recording; imports follow the settings of the process."""
    import rotflex_jax as rf
    from arena.trial import SPLIT, recording, windows_error
    from rotflex_jax.arena.marking import scored, visible
    from rotflex_jax.arena.rivals import RIVALS
    from rotflex_jax.effects import CATALOG
    from rotflex_jax.runtime.persistent_jit import clear_compilation_caches

    row: dict[str, Any] = dict(job)
    try:
        rec, truth = recording(job)
        wanted = visible([(e["effect"], e["port"]) for e in truth["effects"]], job["kind"])
        train, test = rec.split(SPLIT)
        wall, cpu = time.perf_counter(), time.process_time()
        answer = RIVALS[job["rival"]](train, test)
        row["wall_s"], row["cpu_s"] = time.perf_counter() - wall, time.process_time() - cpu
        verdict = "found" if answer.rounds else "nothing_missing"
        row.update(scored(wanted, answer.rounds, [[] for _ in answer.rounds], verdict))
        row.update(wanted=[list(p) for p in wanted], verdict=verdict, note=answer.note, states=True)
        row["rounds"] = [{"effect": e, "port": p, "equivalent": []} for e, p in answer.rounds]
        clear_compilation_caches()
        model = rf.joints.paper()
        for name, port in answer.rounds:
            model = model + CATALOG[name](at=port)
        row["windows"] = windows_error(rf.fit(model, train).model, test)
    except Exception as problem:  # recorded as a row with its error
        row["error"] = f"{type(problem).__name__}: {problem}"
        row["traceback"] = traceback.format_exc()
    return row


def key(job: Job) -> str:
    """Key of a row in the results."""
    return f"{job['rival']}|{B0.key(job)}"


def marks(own: dict[str, dict[str, Any]], records: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Counts and medians over the rows `own` of one method; `records` are the rows of B0, with the oracle."""
    good = {k: r for k, r in own.items() if "error" not in r}
    seen = {k: r for k, r in good.items() if r["wanted"] and not r["outside"]}
    null = [r for r in good.values() if not r["wanted"]]
    outside = [r for r in good.values() if r["outside"]]
    count = lambda rows, name: [sum(bool(r[name]) for r in rows), len(rows)]  # noqa: E731
    ratios = [
        math.exp(statistics.fmean(math.log(r["windows"][c] / v) for c, v in best["windows"].items()))
        for k, r in seen.items()
        if (best := records.get(k, {}).get("oracle")) and r.get("windows")
    ]
    return {
        "first": count(seen.values(), "first"),
        "exact": count(seen.values(), "exact"),
        "false_alarms": count(null, "extra"),
        "unexplained": count(outside, "verdict_right"),
        "over_oracle_median": statistics.median(ratios) if ratios else None,
        "near_oracle": [sum(v < 1.05 for v in ratios), len(ratios)],
        "seconds_median": statistics.median(r["wall_s"] for r in good.values()) if good else None,
        "failed": len(own) - len(good),
    }


def table(summary: dict[str, dict[str, Any]]) -> Table:
    """Table with one row for each method."""
    out = Table(title="B6: one hidden effect, every method", header_style="bold")
    for name in COLUMNS:
        out.add_column(name)
    for name, s in summary.items():
        out.add_row(*cells(name, s))
    return out


def cells(name: str, s: dict[str, Any]) -> list[str]:
    """Cells of the row of one method."""
    part = lambda pair: f"{pair[0]}/{pair[1]}"  # noqa: E731
    number = lambda x: "-" if x is None else f"{x:.2f}"  # noqa: E731
    counts = [part(s[k]) for k in ("first", "exact", "false_alarms", "unexplained")]
    near = [number(s["over_oracle_median"]), part(s["near_oracle"]), number(s["seconds_median"])]
    return [name, *counts, *near, str(s["failed"])]


def page(summary: dict[str, dict[str, Any]], earlier: list[str]) -> str:
    """Markdown of the table, with notes; `earlier` are remarks on methods that are left out."""
    head = "| " + " | ".join(COLUMNS) + " |\n|---|" + "---:|" * (len(COLUMNS) - 1)
    rows = ["| " + " | ".join(cells(name, s)) + " |" for name, s in summary.items()]
    notes = [
        "Each method gets training and validation part of the same records, as the search does, and",
        "answers with names; the structure that it names is then fitted by the same grey box, and its error",
        "on the validation part compared with that of the true structure. `failed`: it raised an error, or",
        "its answer could not be fitted. The regressions with BIC have columns for every effect that the",
        "simulator hides but play in the gear and a drift of the voltage: hysteresis, lag, modes and warmth",
        "by their states along the measured motion, errors of sensors by what the balance makes of them.",
        "The SINDy forms also lack viscous damping, a sensor's gain, cross-talk, the delay of a channel and",
        "friction that differs by direction: beside their linear terms these are linear, or sums of columns",
        "that are there. No regression can answer 'unexplained', for it has no measure of what it leaves:",
        "`outside flagged` can only be zero.",
        "`refit + BIC` fits the whole catalogue one by one, then the best of it again beside the first;",
        "where it is not in the table, it was not run. `s` is by the clock on a busy machine, compiling",
        "included.",
        *earlier,
    ]
    return "\n".join(["# B6: one hidden effect, every method", "", head, *rows, "", *notes]) + "\n"


def main() -> int:
    """Runs missing rows, saves after each one, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--tuning", action="store_true", help="tuning seeds (report seeds if not)")
    parser.add_argument("--seeds", default="", help="as 1000,1001; the first if omitted")
    parser.add_argument("--input", default="noise", help="kind of input")
    parser.add_argument("--only", default="", help="part of a name, as coulomb@hub or nothing")
    parser.add_argument("--nulls", type=int, default=10, help="records with nothing hidden")
    parser.add_argument("--rivals", default=",".join(NAMES), help="names, with commas between")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--minutes", type=float, default=math.inf, help="begin no row after so long")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a record [s]")
    a = parser.parse_args()
    known_seeds = B0.TUNING if a.tuning else B0.REPORT
    seeds = [int(s) for s in a.seeds.split(",") if s] or list(known_seeds[:1])
    if set(seeds) - set(known_seeds):
        raise SystemExit(f"--seeds was given {seeds}; choose from {known_seeds[0]} to {known_seeds[-1]}.")
    rivals = [n for n in a.rivals.split(",") if n]
    if set(rivals) - set(NAMES):
        raise SystemExit(f"--rivals was given {a.rivals}; choose from {', '.join(NAMES)}.")
    suffix = "_tuning" if a.tuning else ""
    path = HERE / "results" / f"B6{suffix}.json"
    records = json.loads((HERE / "results" / f"B0{suffix}.json").read_text())["records"]
    results: dict[str, Any] = {"benchmark": "B6", "runs": [], "rows": {}}
    if path.exists():
        results = json.loads(path.read_text())
    made = begin(results, __file__, vars(a))
    whole = argparse.Namespace(pairs=0, triples=0, size="1", channels="both", only=a.only)
    whole.nulls, whole.seconds = a.nulls, a.seconds
    base = B0.jobs(whole, seeds, [a.input])
    wanted = [{**job, "rival": name} for job in base for name in rivals]
    known = results["rows"]
    # Rows without this mark are from regressions without columns for internal states, and are computed again.
    todo = [j for j in wanted if not known.get(key(j), {}).get("states")]
    console = Console(highlight=False)
    console.print(f"{len(wanted)} rows, {len(todo)} to run")
    began = time.perf_counter()
    for count, (job, row) in enumerate(B0.rows(todo, a.workers, one, a.minutes), 1):
        known[key(job)] = {"code": made["code"], **row}
        B0.save(path, results)
        left = (time.perf_counter() - began) / count * (len(todo) - count)
        found = " + ".join(f"{r['effect']}@{r['port']}" for r in row.get("rounds", [])) or "nothing"
        line = f"{count}/{len(todo)} {key(job)} -> {row.get('error') or found} ({left:.0f} s left)"
        console.print(line, markup=False, soft_wrap=True)
    asked = {
        name: {
            k.partition("|")[2]: r
            for k, r in known.items()
            if r["rival"] == name and (r.get("states") or "error" in r)
        }
        for name in NAMES
    }
    ours = {k: records[k] for rows in asked.values() for k in rows if k in records}
    left_out = sorted({r["rival"] for r in known.values()} - {n for n, rows in asked.items() if rows})
    earlier = [f"Not run again with these columns, and left out: {', '.join(left_out)}."] if left_out else []
    summary = {OURS: marks(ours, records)}
    summary |= {name: marks(rows, records) for name, rows in asked.items() if rows}
    results["summary"] = summary
    B0.save(path, results)
    write_file(path.with_suffix(".md"), page(summary, earlier))
    console.print(table(summary))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
