"""B4: whether a designed experiment distinguishes two effects as well as predicted, and better than others.

    python benchmarks/B4_next_experiment.py --seeds 1000 1001 1002

Each simulated machine hides the first effect of a pair. Its ordinary recording has 20 s of noise with about
1 V rms, to which a model with the true effect is fitted. From this fit, `next_experiment` ranks standard
inputs and designs an input within the same limits. The design and the best inputs of the ranking are then
played on the simulator with new sensor noise, and the models with the true effect and with its rival are
fitted to each new recording. The margin is the difference of their evidence: Gaussian log-likelihood with
re-estimated standard deviations, less half of the penalty of BIC. It is compared with the prediction.

Writes results/B4.json and results/B4.md.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import rotflex_jax as rf
from origin import begin
from rotflex_jax.arena.marking import renamed
from rotflex_jax.arena.simulator.records import make_record

rf.enable_fast_loops()
rf.enable_compilation_cache()

from rotflex_jax.effects import CATALOG
from rotflex_jax.experiment import Experiment, Limits, next_experiment
from rotflex_jax.experiment.discrimination import starts_with_other_shapes
from rotflex_jax.experiment.rival_fit import RivalModel, best_rival_fit, rival_model
from rotflex_jax.experiment.standard_inputs import standard_inputs
from rotflex_jax.text.files import write_file

TS, SECONDS = 0.002, 20.0
LIMITS = Limits(voltage=6.0, travel=np.deg2rad(90), deflection=np.deg2rad(10))

# Pair: the effect that the machine has, its parameters, and its rival. Effects of the first two pairs are so
# small that the ordinary recording hardly distinguishes them from the rival.
PAIRS = {
    "delay or lag": (("delay", "input"), {"time": 0.0012}, ("lag", "input")),
    "second mode or sensor gain": (
        ("second_mode", "arm"),
        {"inertia": 5e-5, "frequency": 10.0, "damping": 0.03},
        ("sensor_gain", "alpha"),
    ),
    "lag or backlash": (("lag", "input"), {"time": 3e-4}, ("backlash", "hub")),
    "hardening spring or bent sensor": (
        ("cubic_spring", "joint"),
        {"coefficient": 6.0},
        ("sensor_cubic", "alpha"),
    ),
}
# Number of standard inputs that are played, the best of the ranking.
PLAYED = 6


def recorded(truth: tuple, numbers: dict, seed: int, played: np.ndarray | None = None) -> rf.Recording:
    """Recording of the machine of a seed under ordinary noise, or under a given voltage."""
    r = make_record({truth: numbers}, kind="noise", seed=seed, seconds=SECONDS, played=played)
    return rf.Recording(u=r["u"], y=r["y"], Ts=r["Ts"], source="arena")


def evidence(rival: RivalModel, rec: rf.Recording, noise: np.ndarray) -> tuple[float, bool]:
    """Log-likelihood of a recording less half of BIC's penalty [nat], and whether the fit converged.

    The likelihood is Gaussian, with re-estimated standard deviations and without constants. First state,
    offset, bias and every parameter of the machine are fitted to this recording, from several shapes of the
    effect.
    """
    found = best_rival_fit(rival, rec.u, rec.y, TS, [rival.start, *starts_with_other_shapes(rival)])
    errors = np.mean(np.square(found.residuals * noise), axis=0)
    fit = -0.5 * rec.N * float(np.sum(np.log(errors)))
    return fit - 0.5 * len(found.unknowns) * float(np.log(rec.y.size)), found.converged


def margin(e: Experiment, model: rf.Model, truth: tuple, rival: tuple, rec: rf.Recording) -> dict:
    """Evidence for the truth less that for its rival [nat]."""
    noise = np.array(list(e.noise.values()))
    found = []
    for me, other in ((truth, rival), (rival, truth)):
        effect = CATALOG[me[0]](at=me[1], **e.parameters["@".join(me)])
        found.append(evidence(rival_model(model, effect, other, {}, noise, TS), rec, noise))
    (mine, one), (its, two) = found
    return {"margin": mine - its, "converged": one and two}


def trial(name: str, seed: int, starts: int, say) -> dict:
    """One pair on one machine."""
    truth, numbers, rival = PAIRS[name]
    began = time.perf_counter()
    first = recorded(truth, numbers, seed)
    half = {k: (v if k in ("frequency", "damping") else v / 2) for k, v in numbers.items()}
    joint = rf.fit(rf.joints.paper(), first).model
    fit = rf.fit(joint + CATALOG[truth[0]](at=truth[1], **renamed(truth, half)), first)
    e = next_experiment(
        fit,
        truth,
        rival,
        limits=LIMITS,
        seconds=SECONDS,
        Ts=TS,
        reference=first.u,
        starts=starts,
        progress=say,
    )
    made = {(s.kind, s.setting): s.u for s in standard_inputs(round(SECONDS / TS), TS, LIMITS)}
    row = {"pair": name, "seed": seed, "status": fit.status, "numbers": e.parameters, "inputs": []}
    row["original"] = margin(e, fit.model, truth, rival, first)
    ranked = sorted((r for r in e.table if (r.input, r.setting) in made), key=lambda r: -r.nats)
    row["ranked"] = [[r.input, r.setting, r.voltage, *r.each, r.nats] for r in ranked]
    for rated in (e.chosen, *ranked[:PLAYED]):
        if rated.input == "design":
            u = e.u
        else:
            u = made[rated.input, rated.setting]
            u = u * rated.voltage / np.max(np.abs(u))
        rec = recorded(truth, numbers, seed, played=u)
        got = margin(e, fit.model, truth, rival, rec)
        row["inputs"].append(
            {
                "input": rated.input,
                "setting": rated.setting,
                "voltage": rated.voltage,
                "predicted": rated.each[0],
                "nats": rated.nats,
                **got,
                "peaks": np.max(np.abs(rec.y), axis=0).tolist(),
            }
        )
        promised, measured = rated.each[0], got["margin"]
        say(f"{name}, seed {seed}: {rated.input} {rated.setting}: {promised:.1f} {measured:.1f}")
    row["seconds"] = time.perf_counter() - began
    return row


def summary(rows: list[dict]) -> str:
    """Markdown: for each pair and seed, the design and the standard input with the largest margin."""
    V, travel, deflection = LIMITS.voltage, np.rad2deg(LIMITS.travel), np.rad2deg(LIMITS.deflection)
    lines = [
        "# The next experiment, played on the independent simulator",
        "",
        f"Limits: {V:g} V, travel {travel:.0f} deg, deflection {deflection:.0f} deg; {SECONDS:g} s at "
        f"{1 / TS:g} Hz. The margin is the evidence for the truth less that for its rival [nat], the first "
        "effect of a pair being true; of "
        f"{len(standard_inputs(2000, TS, LIMITS))} standard inputs the {PLAYED} "
        "that rank best are played too, and the one with the largest measured margin is the best. "
        "A star: one of the two fits had not converged, so the margin may be larger or smaller.",
        "",
        "| pair | seed | ordinary recording | best standard | its margin | design: promised "
        "| design: measured | per second | ratio | peak V | peak deflection [deg] |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        design = [i for i in r["inputs"] if i["input"] == "design"]
        standard = max((i for i in r["inputs"] if i["input"] != "design"), key=lambda i: i["margin"])
        d = design[0] if design else standard
        told = lambda m: f"{m['margin']:.1f}" + "*" * (not m["converged"])  # noqa: E731
        lines.append(
            f"| {r['pair']} | {r['seed']} | {told(r['original'])} | {standard['input']}, "
            f"{standard['setting']} | {told(standard)} | {d['predicted']:.0f} | {told(d)} "
            f"| {d['margin'] / SECONDS:.1f} | {d['margin'] / standard['margin']:.2f} | {d['voltage']:.2f} "
            f"| {np.rad2deg(d['peaks'][1]):.1f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[1000, 1001, 1002])
    parser.add_argument("--pairs", nargs="+", choices=PAIRS, default=list(PAIRS))
    parser.add_argument("--starts", type=int, default=2, help="standard inputs to improve")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    given = parser.parse_args()
    found: dict[str, Any] = {"schema": 1, "rows": []}
    begin(found, __file__, sys.argv[1:])
    rows = found["rows"]
    for name in given.pairs:
        for seed in given.seeds:
            rows.append(trial(name, seed, given.starts, lambda s: print(s, flush=True)))
            given.out.mkdir(exist_ok=True, parents=True)
            write_file(given.out / "B4.json", json.dumps(found, indent=1) + "\n")
            write_file(given.out / "B4.md", summary(rows))
    print(summary(rows))


if __name__ == "__main__":
    main()
