"""B4: time on the rig until rival effects are distinguished, by sequential experiments and standard inputs.

    python benchmarks/B4_sequential.py --seeds 2000 2001 2002 2003 2004 --hopeless 2002 2003 --workers 16

A machine of the independent simulator hides one effect. An ordinary recording of 6 s with about 1 V rms
hardly distinguishes it from one or two rivals. The models with the hidden effect and with each rival are
fitted to that recording, and all are equally probable at first. `experiment_until` then chooses and plays
segments on the simulator and evaluates the data every 0.1 s, until one model has a probability of 99 %.

Standard inputs are played on the same machine, without a pause, and evaluated by the same rule: of each
kind (multisine, binary sequence, sweep, steps, noise) the setting and level with the least expected time to
a decision under the fitted models. Beyond one second they are evaluated at fewer times, and a decision is
counted at the earliest time that is possible. The sequential experiment is compared with the one kind whose
median time over all cases is least, and with the kind that was fastest in each case, which is known only in
hindsight. `--hopeless` adds cases that no input within the limits can decide, for which the right verdict
is `not distinguishable`.

Writes results/B4_sequential.json and .md after each case. Rows of the file are kept unless `--fresh` is
given, so that an interrupted run continues. Processes share compiled programs if ROTFLEX_PROGRAMS names a
folder.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import B0_discovery as B0
import rotflex_jax as rf
from claims import LONGEST_EXPERIMENT as MOST, decision_seconds
from origin import begin
from rotflex_jax.arena.marking import renamed
from rotflex_jax.arena.simulator.records import COUNT, JITTER, make_record
from rotflex_jax.data import excitation
from rotflex_jax.effects import CATALOG
from rotflex_jax.experiment import Rig, experiment_until
from rotflex_jax.experiment.rival_set import RunData
from rotflex_jax.experiment.segment_choice import LEVELS, SegmentChoice
from rotflex_jax.experiment.sequential import SHAPES_AFTER, SequentialExperiment, sequential_experiment
from rotflex_jax.experiment.standard_inputs import MULTISINE_CREST, NOISE_CREST
from rotflex_jax.text.files import write_file

TS, ORDINARY, SEGMENT, CHECK, ERROR = 0.002, 6.0, 0.5, 0.1, 0.01
LIMITS = rf.Limits(voltage=6.0, travel=np.deg2rad(90), deflection=np.deg2rad(10))
# Limits of hopeless cases: within them, nothing moves far beyond the noise.
NARROW = rf.Limits(voltage=0.3, travel=np.deg2rad(5), deflection=np.deg2rad(0.3))
# Times at which a standard input is evaluated [s]. A decision counts `CHECK` after the time before, which is
# the earliest possible time of a decision.
MOMENTS = (*(k * CHECK for k in range(1, 11)), 1.2, 1.5, 1.8, 2.2, 2.6, 3.2)
MOMENTS += (4, 5, 6, 7, 8, 10, 12, 14, 17, 20)
KINDS = ("multisine", "prbs", "sweep", "steps", "noise")

# The hidden effect, its parameters, and its rivals.
CASES = {
    "delay or lag": (("delay", "input"), {"time": 4.5e-4}, [("lag", "input")]),
    "lag or delay": (("lag", "input"), {"time": 5e-4}, [("delay", "input")]),
    "second mode or sensor gain": (
        ("second_mode", "arm"),
        {"inertia": 3e-5, "frequency": 10.0, "damping": 0.03},
        [("sensor_gain", "alpha")],
    ),
    "hardening spring or bent sensor": (
        ("cubic_spring", "joint"),
        {"coefficient": 0.15},
        [("sensor_cubic", "alpha")],
    ),
    "bent sensor or hardening spring": (
        ("sensor_cubic", "alpha"),
        {"cubic": 0.15},
        [("cubic_spring", "joint")],
    ),
    "Coulomb friction or drag": (("coulomb", "hub"), {"level": 0.001}, [("quadratic_drag", "hub")]),
    "delay, lag or play": (
        ("delay", "input"),
        {"time": 4.5e-4},
        [("lag", "input"), ("backlash", "hub")],
    ),
    "Coulomb friction, drag or Dahl friction": (
        ("coulomb", "hub"),
        {"level": 0.001},
        [("quadratic_drag", "hub"), ("dahl", "hub")],
    ),
}
HOPELESS = {
    "delay or lag": (("delay", "input"), {"time": 2e-4}, [("lag", "input")]),
    "lag or delay": (("lag", "input"), {"time": 2e-4}, [("delay", "input")]),
}
NOISE = dict.fromkeys(("theta", "alpha"), math.hypot(JITTER, COUNT / math.sqrt(12)))


class ArenaRig(Rig):
    """The independent simulator as a rig whose motion continues from segment to segment."""

    def __init__(self, truth: tuple, numbers: dict, seed: int, limits: rf.Limits) -> None:
        self.limits, self.Ts, self.continues = limits, TS, True
        self.given, self.seed, self.played = ({truth: numbers}, seed), seed, np.zeros(0)
        self.clean = np.zeros((0, 2))

    def play(self, u: np.ndarray) -> np.ndarray:
        """Simulates all voltages so far from rest, with the same noise, and returns the new samples."""
        self.played = np.concatenate([self.played, u])
        return recorded(*self.given, self.played)[1][-len(u) :]


def recorded(effects: dict, seed: int, played: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Voltage and outputs of the machine of a seed, with sensor noise from a separate random stream."""
    r = make_record(effects, seed=seed, played=played, fs=1 / TS)
    rng = np.random.default_rng([seed, 4])
    noisy = r["clean"] + JITTER * rng.standard_normal((len(played), 2))
    return r["u"], COUNT * np.round(noisy / COUNT)


def fits(truth: tuple, numbers: dict, rivals: list, seed: int) -> dict[str, rf.Fit]:
    """Fits of the true model and of each rival to an ordinary recording, by name."""
    r = make_record({truth: numbers}, kind="noise", seed=seed, seconds=ORDINARY)
    first = rf.Recording(u=r["u"], y=r["y"], Ts=r["Ts"], source="arena")
    joint = rf.fit(rf.joints.paper(), first).model
    half = {k: (v if k in ("frequency", "damping") else v / 2) for k, v in renamed(truth, numbers).items()}
    found = {"@".join(truth): rf.fit(joint + CATALOG[truth[0]](at=truth[1], **half), first)}
    for name, at in rivals:
        found[f"{name}@{at}"] = rf.fit(joint + SMALL.get(name, CATALOG[name])(at=at), first)
    return found


# Small starts of rivals whose default sizes in the catalogue are large.
SMALL = {
    "lag": lambda at: CATALOG["lag"](at=at, time=5e-4),
    "delay": lambda at: CATALOG["delay"](at=at, time=5e-4),
    "backlash": lambda at: CATALOG["backlash"](at=at, gap=1e-3),
    "sensor_cubic": lambda at: CATALOG["sensor_cubic"](at=at, cubic=0.1),
    "cubic_spring": lambda at: CATALOG["cubic_spring"](at=at, stiffness=0.1),
    "quadratic_drag": lambda at: CATALOG["quadratic_drag"](at=at, coefficient=2e-4),
    "dahl": lambda at: CATALOG["dahl"](at=at, level=5e-4),
}


def standard(N: int, seed: int) -> list[tuple[str, str, np.ndarray]]:
    """Kind, setting and voltage of standard inputs of N samples, scaled to the limit of the voltage."""
    V, out = LIMITS.voltage, []
    for corner in (2.0, 5.0, 15.0, 40.0):
        u = excitation.noise(N, TS, rms=V / NOISE_CREST, bandwidth=corner, seed=seed)
        out.append(("noise", f"{corner:g} Hz", np.clip(u, -V, V)))
    for high in (6.0, 12.0, 30.0, 80.0):
        u = excitation.multisine(N, TS, band=(0.25, high), rms=V / MULTISINE_CREST, seed=seed)
        out.append(("multisine", f"to {high:g} Hz", np.clip(u, -V, V)))
        out.append(("sweep", f"to {high:g} Hz", excitation.sweep(N, TS, band=(0.25, high), amplitude=V)))
    for hold in (0.1, 0.05, 0.02, 0.01):
        u = excitation.prbs(N, TS, amplitude=V, hold=hold, seed=seed)
        out.append(("prbs", f"held {1e3 * hold:g} ms", u))
    for hold in ((0.15, 0.8), (0.05, 0.3), (0.02, 0.1)):
        u = excitation.steps(N, TS, amplitude=V, hold=hold, seed=seed)
        out.append(("steps", f"held {1e3 * hold[0]:g} to {1e3 * hold[1]:g} ms", u))
    return [(kind, setting, u - u.mean()) for kind, setting, u in out]


def best_standard(start: SequentialExperiment, seed: int) -> list[tuple[str, str, np.ndarray]]:
    """Of each kind the setting and level with the least expected time to a decision, within the limits."""
    long = SequentialExperiment(
        start.rivals, type(start.settings)(LIMITS, segment_seconds=MOST, improve=False), start.prior
    )
    choice = SegmentChoice(long)
    made = standard(round(MOST / TS), seed)
    U, ok = choice.within_limits(np.array([u for *_, u in made]))
    offered = [
        (k, s, level, level * u)
        for level in LEVELS
        for (k, s, _), u, good in zip(made, U, ok, strict=True)
        if good
    ]
    # Like the sequential experiment, leave out inputs that move little more than the noise.
    seen = choice.loud(np.array([u for *_, u in offered]))
    offered = [o for o, good in zip(offered, seen, strict=True) if good]
    parts = tuple(t / MOST for t in MOMENTS)
    T, _ = choice.evidence(np.array([u for *_, u in offered]), parts, drawn=False)
    seconds = choice.seconds_until_decided(T.min(axis=3), parts)
    chosen: dict[str, tuple[str, str, np.ndarray]] = {}
    for i in np.argsort(seconds):
        k, s, _, u = offered[i]
        chosen.setdefault(k, (k, f"{s}, {np.max(np.abs(u)):.2g} V", u))
    return list(chosen.values())


def played_standard(start: SequentialExperiment, rig: ArenaRig, u: np.ndarray) -> dict:
    """Time until a standard input decides [s], by the rule of the sequential experiment."""
    _, y = recorded(*rig.given, u)
    before = 0.0
    e, r = start, start.rivals
    unknowns: tuple = ()
    for t in MOMENTS:
        n = round(t / TS)
        run = RunData(u[:n], y[:n])
        first = r.first_unknowns(run)
        new = []
        for h in range(r.count):
            x = unknowns[h] if unknowns else np.concatenate([r.prior_mean[h], first])
            starts = [x] + (r.other_shapes(h, x) if t <= SHAPES_AFTER * SEGMENT else [])
            new.append(r.fitted(h, starts, [run], 0, start.samples).unknowns)
        unknowns = tuple(new)
        e = SequentialExperiment(r, start.settings, start.prior, runs=(run,), unknowns=unknowns)
        p = e.probabilities
        if p.max() >= 1 - ERROR:
            return {"seconds": round(before + CHECK, 6), "decided": True, "best": r.labels[int(np.argmax(p))]}
        before = t
    return {"seconds": MOST, "decided": False, "best": r.labels[int(np.argmax(p))]}


def trial(name: str, seed: int, say, hopeless: bool = False, alone: bool = False) -> dict:
    """One case on one machine."""
    truth, numbers, rivals = (HOPELESS if hopeless else CASES)[name]
    began = time.perf_counter()
    models = fits(truth, numbers, rivals, seed)
    right, limits = "@".join(truth), NARROW if hopeless else LIMITS
    rig = ArenaRig(truth, numbers, seed, limits)
    settings = {
        "noise": NOISE,
        "error": ERROR,
        "max_seconds": MOST,
        "segment_seconds": SEGMENT,
        "check_seconds": CHECK,
    }
    result = experiment_until(models, rig, **settings, progress=say)
    row = {
        "case": name,
        "seed": seed,
        "truth": right,
        "hopeless": hopeless,
        "verdict": result.verdict,
        "best": result.best,
        "sentence": result.sentence,
        "seconds": round(result.seconds, 6),
        "probability": result.probabilities[result.best],
        "misfit": result.history[-1].misfit if result.history else None,
        "inputs": [[s.input, s.setting, s.voltage] for s in result.history],
        "peaks": np.max(np.abs(np.concatenate([r.y for r in result.runs])), axis=0).tolist(),
        "statuses": {n: m.status for n, m in models.items()},
        "loop_s": time.perf_counter() - began,
        "standard": [],
    }
    if not (hopeless or alone):
        start = sequential_experiment(models, limits, TS, **settings)
        for kind, setting, u in best_standard(start, seed):
            row["standard"].append({"input": kind, "setting": setting, **played_standard(start, rig, u)})
            say(f"{name} {seed}: {kind} {setting}: {row['standard'][-1]}")
    row["elapsed_s"] = time.perf_counter() - began
    return row


def one(job: dict) -> dict:
    """Row of a case, computed in a worker."""
    say = lambda text: print(text, flush=True)  # noqa: E731
    return trial(job["case"], job["seed"], say, job["hopeless"], job["alone"])


def fastest(row: dict) -> dict:
    """The standard input with the earliest right decision; the longest time if there is none."""
    good = [s for s in row["standard"] if s["decided"] and s["best"] == row["truth"]]
    least = {"input": "none", "setting": "", "seconds": MOST, "decided": False}
    return min(good, key=lambda s: s["seconds"]) if good else least


def ratio(row: dict) -> float:
    """Time of the fastest standard input over the time of the sequential experiment."""
    return fastest(row)["seconds"] / decision_seconds(row, row)


def of_kinds(rows: list[dict]) -> dict[str, dict[str, float]]:
    """Each kind of standard input separately; without a right decision, the longest time counts."""
    found = {}
    for kind in KINDS:
        played = [(r, s) for r in rows for s in r["standard"] if s["input"] == kind]
        if not played:
            continue
        right = [s["decided"] and s["best"] == r["truth"] for r, s in played]
        seconds = [decision_seconds(s, r) for r, s in played]
        ratios = [t / decision_seconds(r, r) for (r, _), t in zip(played, seconds, strict=True)]
        found[kind] = {
            "seconds": float(np.median(seconds)),
            "ratio": float(np.median(ratios)),
            "decided": sum(s["decided"] for _, s in played),
            "wrong": sum(s["decided"] and not good for (_, s), good in zip(played, right, strict=True)),
        }
    return found


def totals(rows: list[dict]) -> dict:
    """Counts and medians over all cases, separately for decidable and hopeless ones."""
    told, lost = ([r for r in rows if r["hopeless"] == h] for h in (False, True))
    decided = [r for r in told if r["verdict"] == "decided"]
    played = [(s, r["truth"]) for r in told for s in r["standard"]]
    sure = [s["best"] == truth for s, truth in played if s["decided"]]

    kinds = of_kinds(told)
    one_kind = min(kinds, key=lambda k: kinds[k]["seconds"], default="")

    def median(values: list[float]) -> float | None:
        return float(np.median(values)) if values else None

    return {
        "cases": len(told),
        "decided": len(decided),
        "wrong": sum(r["best"] != r["truth"] for r in decided),
        "standard": len(played),
        "standard_decided": len(sure),
        "standard_wrong": sum(not right for right in sure),
        "ratio": median([ratio(r) for r in told]),
        "seconds": median([decision_seconds(r, r) for r in told]),
        "standard_seconds": median([fastest(r)["seconds"] for r in told]),
        "kinds": kinds,
        "kind": one_kind,
        "kind_seconds": kinds[one_kind]["seconds"] if kinds else None,
        "kind_ratio": kinds[one_kind]["ratio"] if kinds else None,
        "hopeless": len(lost),
        "hopeless_said": sum(r["verdict"] == "not distinguishable" for r in lost),
        "hopeless_decided": sum(r["verdict"] == "decided" for r in lost),
        "hopeless_seconds": median([r["seconds"] for r in lost]),
    }


def page(rows: list[dict]) -> str:
    """Markdown of the tables."""
    t = totals(rows)
    lines = [
        "# Seconds on the rig until it is decided",
        "",
        f"Error probability {ERROR:g}, at most {MOST:g} s, evaluated every {CHECK:g} s; the fastest of five "
        "standard inputs that decided rightly stands beside, which is known in hindsight only; `>` where "
        "none did.",
        "",
        "| case | seed | the loop | seconds | best standard input | seconds | ratio |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in (r for r in rows if not r["hopeless"]):
        s, wrong = fastest(r), r["verdict"] == "decided" and r["best"] != r["truth"]
        more = "" if s["decided"] else "> "
        lines.append(
            f"| {r['case']} | {r['seed']} | {r['verdict']}{', WRONG' * wrong} | {r['seconds']:g} "
            f"| {s['input']} {s['setting']} | {more}{s['seconds']:g} | {more}{ratio(r):.1f} |"
        )
    if t["cases"]:
        lines += [
            "",
            f"{t['cases']} cases. The loop decided {t['decided']}, {t['wrong']} of them wrongly; of "
            f"{t['standard']} standard inputs {t['standard_decided']} decided, {t['standard_wrong']} of them "
            f"wrongly. Median of the ratios {t['ratio']:.1f}; median seconds {t['seconds']:.1f} beside "
            f"{t['standard_seconds']:.1f}.",
        ]
    if t["kinds"]:
        lines += [
            "",
            "Each kind for all cases, its setting and level chosen for each case by the models; what decided "
            f"nothing or wrongly counts as {MOST:g} s:",
            "",
            "| kind | seconds, median | over those of the loop, median | decided | wrongly |",
            "|---|---:|---:|---:|---:|",
            *(
                f"| {k} | {v['seconds']:.1f} | {v['ratio']:.1f} | {v['decided']} | {v['wrong']} |"
                for k, v in t["kinds"].items()
            ),
        ]
    if t["hopeless"]:
        lines += [
            "",
            f"Where the limits leave nothing to see ({NARROW.voltage:g} V): {t['hopeless_said']} of "
            f"{t['hopeless']} times it said so, after {t['hopeless_seconds']:g} s in the median; "
            f"{t['hopeless_decided']} times it decided.",
        ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[2000, 2001, 2002])
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument(
        "--hopeless", type=int, nargs="*", default=[], help="seeds of cases that nothing can tell"
    )
    parser.add_argument("--alone", action="store_true", help="leave the standard inputs out")
    parser.add_argument("--fresh", action="store_true", help="play again what the results have already")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    given = parser.parse_args()
    file = given.out / "B4_sequential.json"
    results: dict[str, Any] = {"schema": 1, "rows": []}
    if file.exists() and not given.fresh:
        results |= json.loads(file.read_text())
    # Before anything is written, since written results change the working tree.
    made, rows = begin(results, __file__, sys.argv[1:]), results["rows"]
    have = {(r["case"], r["seed"], r["hopeless"]) for r in rows}
    todo: list[B0.Job] = [
        {"case": name, "seed": seed, "hopeless": lost, "alone": given.alone}
        for lost, seeds, names in ((False, given.seeds, given.cases), (True, given.hopeless, HOPELESS))
        for seed in seeds
        for name in names
        if (name, seed, lost) not in have
    ]
    # Cases with three models take longest and are started first.
    todo.sort(key=lambda job: -len((HOPELESS if job["hopeless"] else CASES)[job["case"]][2]))
    print(f"{len(todo)} cases to play", flush=True)
    for job, row in B0.rows(todo, given.workers, one):
        name = f"{job['case']} {job['seed']}"
        if "error" in row:  # the next run repeats it
            print(f"{name}: {row['error']}", flush=True)
            continue
        print(f"{name}: {row['verdict']} after {row['seconds']:g} s ({row['elapsed_s']:.0f} s)", flush=True)
        rows.append({**row, "code": made["code"]})
        rows.sort(key=lambda r: (r["hopeless"], r["seed"], [*CASES].index(r["case"])))
        B0.save(file, {**results, "summary": totals(rows)})
        write_file(file.with_suffix(".md"), page(rows))
    print(page(rows))


if __name__ == "__main__":
    main()
