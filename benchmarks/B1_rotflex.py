"""B1: searches and fits on a measured rotary flexible joint, two runs under two controllers.

    python benchmarks/B1_rotflex.py                  # all parts
    python benchmarks/B1_rotflex.py search figures   # some

Models are fitted to one run (A or B) and evaluated on the other. Searches are also fitted to the first 7 s of
both runs and evaluated on the last 3 s, given structures also to both whole runs.

    search   searches for missing effects
    repeats  difference between two equal steps in one run, as a measure of how repeatable the machine is
    arm      the arm behind the measured hub, with one law of the joint after the other
    fits     given structures, fitted to free runs of 2 s with a separate integrator
             (measured_joint/fine_run.py), also to both runs with separate friction levels and offsets
    play     such fits of structures with play in the gear
    figures  the figures of docs/measured_joint.md, from the results of `fits`

Needs the `rotflex` recordings: `rotflex data fetch rotflex`, or a folder named by `ROTFLEX_DATA`. Prints
tables in Markdown and writes `results/B1.json`; results of parts that are not run again are kept.
"""

import json
import pathlib
import sys
import time

import numpy as np

import origin
import rotflex_jax as rf
from measured_joint import arm_alone, drawing, fine_run, with_play

HERE = pathlib.Path(__file__).parent
RESULTS = HERE / "results" / "B1.json"

from rotflex_jax.parameters import HALF_WIDTH_95
from rotflex_jax.text.files import write_file


def degrees(errors) -> str:
    return " / ".join(f"{np.degrees(errors[c]):.2f}" for c in ("theta", "alpha"))


def search(A: rf.Recording, B: rf.Recording) -> dict:
    """Searches by `rf.discover` with its default settings."""
    (A1, A2), (B1, B2) = A.split(0.7), B.split(0.7)
    cases = {
        "A to B": (A, B),
        "B to A": (B, A),
        "first 7 s of both to the last 3 s": ((A1, B1), (A2, B2)),
    }
    out = {}
    for name, (train, test) in cases.items():
        began = time.perf_counter()
        d = rf.discover(rf.joints.quanser_2010(), train, test)
        print(f"\n{name}: {d.verdict} ({time.perf_counter() - began:.0f} s)\n{d.sentence}")
        print("| model | free run, 2 s windows | free run, whole |\n|---|---|---|")
        labels = ["the joint as it is", *(f"+ {r.effect} at {r.port}" for r in d.rounds)]
        for label, stage in zip(labels, d.stages, strict=True):
            print(f"| {label} | {degrees(stage.held_out_rmse_windows)} | {degrees(stage.held_out_rmse)} |")
        for line in (*(f"- {r.sentence}" for r in d.rounds), *(f"- {note}" for note in d.notes)):
            print(line)
        for e in d.final.estimates:
            print(f"    {e}  {e.note}", flush=True)
        out[name] = d.to_dict()
    return out


def fits(A: rf.Recording, B: rf.Recording) -> dict:
    """Structures of `fine_run`, fitted to one run or to both, and evaluated on each run."""
    runs, out = {"A": A, "B": B}, {}
    print("\n| structure | from | evaluated on | no offset | its offset | whole, its offset | offset [V] |")
    print("|---|---|---|---|---|---|---|")
    for name, free in fine_run.STRUCTURES.items():
        lugre = "presliding" in free
        for learnt in ("A", "B", "AB"):
            found = fine_run.fit({k: runs[k] for k in learnt}, free)
            rows = {}
            for key, run in runs.items():
                bare = found.numbers[learnt[0]] | {"offset": 0.0, "bias": 0.0}
                own = found.numbers.get(key)
                if own is None:  # only the offset is fitted to the run of the evaluation
                    own = fine_run.fit({key: run}, (), ("offset",), bare, lugre).numbers[key]
                rows[key] = {
                    "no_offset": fine_run.rms(bare, lugre, run),
                    "own_offset": fine_run.rms(own, lugre, run),
                    "offset": own["offset"],
                    "whole": fine_run.rms(own, lugre, run, run.N),
                }
                errors = " | ".join(
                    " / ".join(f"{e:.2f}" for e in rows[key][k]) for k in ("no_offset", "own_offset", "whole")
                )
                kind = "" if key not in learnt else " (seen)"
                print(f"| {name} | {learnt} | {key}{kind} | {errors} | {own['offset']:+.4f} |", flush=True)
            out[f"{name}, from {learnt}"] = {"evaluated": rows, "numbers": found.numbers, "std": found.std}
    return out


def repeats(A: rf.Recording, B: rf.Recording) -> dict:
    """Difference between two equal steps in one run [deg]; the voltages of the feedback differ as well."""
    out = {}
    for name, run in (("A", A), ("B", B)):
        windows = np.degrees(run.y[: 5 * fine_run.WINDOW]).reshape(5, fine_run.WINDOW, 2)
        for way, first, second in (("up", 2, 4), ("down", 1, 3)):
            d = (windows[first] - windows[second])[fine_run.SEEN :]
            out[f"{name} {way}"] = np.sqrt(np.mean(d**2, axis=0)).tolist()
    print("\n| the same step twice | difference [deg] |\n|---|---|")
    for name, (theta, alpha) in out.items():
        print(f"| {name} | {theta:.2f} / {alpha:.2f} |")
    return out


def differences(A: rf.Recording, B: rf.Recording) -> dict:
    """Both runs fitted together, with separate friction levels, offsets and biases."""
    free = [k for k in fine_run.STRUCTURES[fine_run.TAKEN] if k not in ("level", "rise")]
    own = ("level", "rise", "offset", "bias")
    found = fine_run.fit({"A": A, "B": B}, free, own)
    print("\n| number | A | B |\n|---|---|---|")
    for k in own:
        cells = (f"{found.numbers[r][k]:.4g} +- {HALF_WIDTH_95 * found.std[r][k]:.2g}" for r in "AB")
        print(f"| {k} | " + " | ".join(cells) + " |")
    errors = {r: fine_run.rms(found.numbers[r], True, run) for r, run in (("A", A), ("B", B))}
    print("errors", errors)
    return {"numbers": found.numbers, "std": found.std, "errors_deg": errors}


def arm(A: rf.Recording, B: rf.Recording) -> dict:
    """Laws of the joint, each fitted to one run and evaluated on both."""
    out = arm_alone.compare({"A": A, "B": B})
    print("\n| law of the joint | from A: A / B [deg] | from B: A / B [deg] |\n|---|---|---|")
    for law in arm_alone.LAWS:
        rows = [out[f"{law}, from {k}"]["errors_deg"] for k in "AB"]
        print(f"| {law} | " + " | ".join(f"{e['A']:.3f} / {e['B']:.3f}" for e in rows) + " |")
    return out


def play(A: rf.Recording, B: rf.Recording) -> dict:
    """Structures with play in the gear."""
    print("\n| structure | learnt from, evaluated on | no offset | its offset | whole 10 s, its offset |")
    print("|---|---|---|---|---|")
    return with_play.compare(A, B)


def main(parts: list[str]) -> None:
    rf.enable_fast_loops()
    A, B = rf.data.load_dataset("rotflex")
    kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    kept = kept if set(kept) & {"search", "repeats", "arm", "fits", "play"} else {}
    origin.begin(kept, __file__, parts)
    does = {"search": search, "repeats": repeats, "arm": arm, "fits": fits, "play": play}
    for part in parts or [*does, "figures"]:
        if part == "figures":
            drawing.draw(A, B, kept["fits"], HERE.parent / "docs" / "figures")
            continue
        kept[part] = does[part](A, B)
        origin.part(kept, part)
        if part == "fits":
            kept["differences"] = differences(A, B)
            origin.part(kept, "differences")
        RESULTS.parent.mkdir(exist_ok=True)
        write_file(RESULTS, json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
