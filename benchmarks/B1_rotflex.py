"""Discovery on a measured rotary flexible joint: two runs under two controllers, one held out at a time.

Needs the `rotflex` recordings: `rotflex data fetch rotflex`, or a folder named by `ROTFLEX_DATA`.
Prints the tables of the README and writes `results/B1.json`.
"""

import json
import pathlib
import time

import numpy as np

import rotflex_jax as rf

RESULTS = pathlib.Path(__file__).parent / "results"


def degrees(errors: dict[str, float]) -> str:
    return " / ".join(f"{np.degrees(errors[c]):.2f}" for c in ("theta", "alpha"))


def main() -> None:
    rf.enable_fast_loops()
    A, B = rf.data.load_dataset("rotflex")
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
        for r in d.rounds:
            print(f"- {r.sentence}")
        for note in d.notes:
            print(f"- {note}")
        for e in d.final.estimates:
            print(f"    {e}  {e.note}")
        out[name] = d.to_dict()
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "B1.json").write_text(json.dumps(out, indent=1) + "\n")


if __name__ == "__main__":
    main()
