"""B12: controllers designed from a fit, in closed loop with the independent simulator.

    python benchmarks/B12_control.py            # every machine
    python benchmarks/B12_control.py coulomb    # some

The joint with one friction is fitted to a simulated recording of 10 s, and controllers are designed from
the fit alone. Each controller then drives the simulator along a reference: without compensation of the
friction, with compensation along the planned motion (feedforward), with an observed load torque, and with
both. The result is the root mean square tracking error. The controller with feedforward is also simulated
with 20 models drawn from the credible set of the fit.

Writes results/B12.json, and for the first machine docs/figures/control.png.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

import rotflex_jax as rf
from origin import KEYS, begin, part

rf.enable_fast_loops()
rf.enable_compilation_cache()

from rotflex_jax import effects as fx
from rotflex_jax.arena.simulator.machine import Machine
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.control import close_loop
from rotflex_jax.text.files import write_file

RESULT = Path(__file__).resolve().parent / "results" / "B12.json"
FIGURE = Path(__file__).resolve().parents[1] / "docs" / "figures" / "control.png"
DRAWS = 20

# Effect that is hidden in the simulator, and the effect with which the fit starts.
MACHINES: dict[str, tuple[dict, fx.Effect]] = {
    "coulomb": ({("coulomb", "hub"): {"level": 0.1}}, fx.Coulomb("hub", level=0.03)),
    "stribeck": (
        {("stribeck", "hub"): {"level": 0.08, "excess": 0.05, "speed": 0.3}},
        fx.Stribeck("hub", level=0.05),
    ),
    "asymmetric": (
        {("coulomb_asymmetric", "hub"): {"level_plus": 0.14, "level_minus": 0.06}},
        fx.CoulombAsymmetric("hub", forward=0.05, backward=0.05),
    ),
}


def reference(Ts: float) -> np.ndarray:
    """Two swings of 1 rad and back with 1 s of rest between them, and 3 s of rest at the end [rad]."""
    t = Ts * np.arange(round(2 / Ts))
    swing = 0.5 * (1 - np.cos(np.pi * t))
    return np.concatenate([swing, np.zeros(round(1 / Ts)), swing, np.zeros(round(3 / Ts))])


def measured(name: str) -> dict[str, Any]:
    """One machine: the fit, four controllers on the simulator, and models of the credible set."""
    hidden, effect = MACHINES[name]
    r = make_record(hidden, seed=40, seconds=10.0, rms=2.0)
    fit = rf.fit(rf.joints.paper() + effect, rf.Recording(u=r["u"], y=r["y"], Ts=r["Ts"]))
    wanted = reference(r["Ts"])
    row: dict[str, Any] = {"status": fit.status}
    row["found"] = {e.name: e.value for e in fit.parameters if effect.name in e.name}
    runs = {}
    for compensate in ("nothing", "feedforward", "observer", "both"):
        controller = rf.controller(fit, r["Ts"], compensate=compensate)
        run = close_loop(controller, Machine.of(r), wanted)
        row[compensate] = run.to_dict()
        if compensate == "feedforward":
            row["credible"] = rf.assess(controller, fit, wanted, count=DRAWS).to_dict()
        runs[compensate] = run
    if name == next(iter(MACHINES)):
        runs["feedforward"].plot(runs["nothing"]).savefig(FIGURE, dpi=110)
    row["degrees"] = {compensate: float(np.rad2deg(run.rms)) for compensate, run in runs.items()}
    row["ratio"] = row["feedforward"]["rms"] / row["nothing"]["rms"]
    return row


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("machines", nargs="*", default=list(MACHINES), help=", ".join(MACHINES))
    rows = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    machines = parser.parse_args().machines
    begin(rows, __file__, machines)
    for name in machines:
        rows[name] = measured(name)
        part(rows, name)
        rows = {key: rows[key] for key in (*MACHINES, *KEYS) if key in rows}
        write_file(RESULT, json.dumps(rows, indent=1) + "\n")
        each = rows[name]["degrees"]
        told = ", ".join(f"{k} {v:.3f}" for k, v in each.items())
        cycles = [k for k in each if rows[name][k]["limit_cycle"]]
        broken = rows[name]["credible"]["broken"]
        ratio = rows[name]["ratio"]
        print(f"{name}: error rms [deg] {told}; ratio {ratio:.3f}; cycles {cycles}; broken {broken}")


if __name__ == "__main__":
    main()
