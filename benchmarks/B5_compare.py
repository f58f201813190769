"""B5: errors of all methods of `rf.compare` on the same recordings, measured and simulated.

    python benchmarks/B5_compare.py                            missing rows of all data sets
    python benchmarks/B5_compare.py emps rotary_arm            missing rows of these data sets
    python benchmarks/B5_compare.py emps --methods sindy arx   these methods again
    python benchmarks/B5_compare.py --draw                     only tables and figures of finished rows

Data sets are the measured rotary joint (three splits), a simulated joint with friction, the rotary arm,
EMPS and the Silverbox. Every method is fitted to the same training data and evaluated by free runs over the
same held-out data.

Needs the recordings of `rotflex data fetch`, or a folder named by `ROTFLEX_DATA`; a data set whose
recordings are missing is left out, and the reason is printed. Writes `results/B5/NAME.json`, `NAME.md` and
two figures for each data set, and `summary.md` for all. Every row is stored in `results/B5/kept` as soon as
it is finished, so that an interrupted run continues. Methods without a long search are run first.
"""

import argparse
import dataclasses
import json
import math
import pathlib
import pickle
from collections.abc import Callable
from typing import Any

import rotflex_jax as rf
from origin import begin
from rotflex_jax.compare import METHODS, QUICK, Comparison
from rotflex_jax.compare.page import overlays, ranks
from rotflex_jax.text.files import write_file
from rotflex_jax.text.markup import write_files

HERE = pathlib.Path(__file__).parent
RESULTS = HERE / "results" / "B5"
KEPT = RESULTS / "kept"
# Longest training recording [samples]: more samples do not improve regressions, and fits would take minutes.
LONGEST = 16_000


def measured(which: str) -> tuple:
    """The rotary flexible joint: one run for fits and the other for evaluation, or the two parts of both."""
    A, B = rf.data.load_dataset("rotflex")
    joint = rf.joints.quanser_2010()
    if which == "mixed":
        parts = [r.split(0.7) for r in (A, B)]
        return joint, [a for a, _ in parts], [b for _, b in parts]
    return (joint, [A], [B]) if which == "AB" else (joint, [B], [A])


def public(name: str) -> tuple:
    """A public benchmark with its official test recordings."""
    benchmark = rf.data.benchmark(name)
    train, machine = benchmark.train, getattr(rf.joints, name)()
    if name == "silverbox":  # its input was measured behind a filter and is smooth between samples
        machine = rf.Model(machine, rf.Exponential(order=4, substeps=2, between="smooth"))
    return machine, [train.slice(0, min(train.N, LONGEST))], list(benchmark.tests.values())


def arm() -> tuple:
    """A measured geared motor with a rigid arm: one run for fits, two with other gains for evaluation."""
    _, slow, fast, other = rf.data.load_dataset("rotary_arm")
    return rf.joints.rotary_arm(), [slow], [fast, other]


def arena() -> tuple:
    """A simulated joint with dry friction at the hub, from the independent simulator, tuning seed 101."""
    from rotflex_jax.arena.simulator.records import make_record

    made = make_record([("coulomb", "hub")], seconds=20.0, seed=101)
    train, test = rf.Recording(u=made["u"], y=made["y"], Ts=made["Ts"], source="arena 101").split(0.7)
    return rf.joints.paper(), [train], [test]


SETS: dict[str, Callable[[], tuple]] = {
    "rotflex_AB": lambda: measured("AB"),
    "rotflex_BA": lambda: measured("BA"),
    "rotflex_mixed": lambda: measured("mixed"),
    "arena": arena,
    "rotary_arm": arm,
    "emps": lambda: public("emps"),
    "silverbox": lambda: public("silverbox"),
}

# Unit in which the errors of a data set are shown, and factor from the unit of its channels.
UNITS = dict.fromkeys(SETS, ("deg", math.degrees(1.0))) | {"emps": ("mm", 1e3), "silverbox": ("mV", 1e3)}


def learn(name: str, method: str) -> None:
    """Computes and stores one row, without the fitted model."""
    machine, train, test = SETS[name]()
    say = lambda text: print(f"  {name}: {text}", flush=True)  # noqa: E731
    found = rf.compare(train, [method], mechanism=machine, test=test, progress=say)
    rows = (dataclasses.replace(found.rows[0], simulator=None),)
    file = KEPT / name / f"{method}.pickle"
    file.parent.mkdir(parents=True, exist_ok=True)
    (KEPT / ".gitignore").write_text("*\n")
    file.write_bytes(pickle.dumps(dataclasses.replace(found, rows=rows)))
    of: dict[str, Any] = {}
    begin(of, __file__, [name, method])
    write_file(file.with_suffix(".json"), json.dumps(of) + "\n")
    row = found.rows[0]
    print(f"{name} {method}: {row.status} {row.reason} {found.elapsed_s:.0f} s", flush=True)


def draw(name: str) -> None:
    """Writes table, figures and page of the finished rows of a data set."""
    kept = [KEPT / name / f"{m}.pickle" for m in METHODS]
    parts: list[Comparison] = [pickle.loads(file.read_bytes()) for file in kept if file.exists()]
    if not parts:
        return
    result = dataclasses.replace(
        parts[0],
        rows=tuple(sorted((part.rows[0] for part in parts), key=lambda row: row.score)),
        elapsed_s=sum(part.elapsed_s for part in parts),
    )
    text = json.dumps(result.to_dict() | made_by(kept), indent=1) + "\n"
    write_files(RESULTS, {f"{name}.json": text, f"{name}.md": result.to_markdown()})
    for label, figure in (("ranks", ranks(result)), ("overlays", overlays(result))):
        figure.savefig(RESULTS / f"{name}_{label}.png", dpi=80)
    result.report(KEPT / name)
    print(f"\n{name}\n{result}\n", flush=True)


def made_by(kept: list[pathlib.Path]) -> dict[str, Any]:
    """Runs of this script that computed rows, and the source files that these rows measure."""
    found: dict[str, Any] = {"runs": [], "sources": {}}
    for file in (k.with_suffix(".json") for k in kept if k.exists()):
        # A row without such a record counts as measured with uncommitted changes.
        of = json.loads(file.read_text()) if file.exists() else {"runs": [{}], "sources": {}}
        found["runs"] += of["runs"]
        found["sources"] |= of["sources"]
    return found


def summary() -> str:
    """Table of errors of whole free runs over held-out data, of every method on every finished data set."""
    files = {name: RESULTS / f"{name}.json" for name in SETS}
    done = {name: json.loads(file.read_text()) for name, file in files.items() if file.exists()}
    rows = {name: {row["method"]: row for row in found["rows"]} for name, found in done.items()}
    lines = ["| method | " + " | ".join(f"{n} [{UNITS[n][0]}]" for n in done) + " |"]
    lines.append("|---|" + "---:|" * len(done))
    for method in METHODS:
        cells = []
        for name in done:
            row = rows[name].get(method)
            if row is None or row["status"] != "ok":
                cells.append("" if row is None else row["status"])
                continue
            values = [UNITS[name][1] * e for e in row["held_out_rmse"].values()]
            text = " / ".join(f"{v:.3g}" if v < 1000 else f"{v:.0f}" for v in values)
            cells.append(f"**{text}**" if done[name]["best"] == method else text)
        if any(cells):
            lines.append(f"| `{method}` | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sets", nargs="*", metavar="SET", help=f"{', '.join(SETS)}; all if none is named")
    parser.add_argument("--methods", nargs="+", choices=tuple(METHODS), help="Run these again.")
    parser.add_argument("--draw", action="store_true", help="Learn nothing.")
    given = parser.parse_args()
    if unknown := set(given.sets) - set(SETS):
        parser.error(f"there is no data set called {unknown.pop()}; choose from {', '.join(SETS)}")
    rf.enable_fast_loops()
    rf.enable_compilation_cache()
    sets = given.sets or list(SETS)
    jobs = [(s, m) for s in sets for m in given.methods or QUICK]
    if not given.methods:
        jobs += [(s, m) for m in METHODS if m not in QUICK for s in sets]
        jobs = [(s, m) for s, m in jobs if not (KEPT / s / f"{m}.pickle").exists()]
    left_out = {}
    for name, method in [] if given.draw else jobs:
        if name in left_out:
            continue
        try:
            learn(name, method)
        except (rf.InputError, OSError) as error:
            left_out[name] = str(error)
            print(f"{name}: left out, {error}", flush=True)
    for name in sets:
        draw(name)
    write_files(RESULTS, {"summary.md": summary()})


if __name__ == "__main__":
    main()
