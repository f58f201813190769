"""B8: smaller measurements that the documentation quotes.

    python benchmarks/B8_pages.py                  # all parts
    python benchmarks/B8_pages.py kernels fleet    # some

- `kernels`: share of a single effect in each Volterra kernel of the flexible joint, and agreement of kernels
  by least squares with kernels by averages.
- `measured`: kernels of the measured joint beside those of its fitted grey box.
- `torque`: errors of short free runs over simulated held-out data, without and with a learned torque.
- `fleet`: processor time of everything around the searches of many recordings.

`measured` needs the `rotflex` recordings. Writes results/B8.json after each part; results of parts that are
not run again are kept.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

import rotflex_jax as rf

rf.enable_fast_loops()
rf.enable_compilation_cache()

from origin import begin, part
from rotflex_jax import effects as fx
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.basis import Delays, Orthonormal, Volterra
from rotflex_jax.errors import InputError
from rotflex_jax.fit import least_squares
from rotflex_jax.kernels import average_kernels, effect_kernels, identified_kernels
from rotflex_jax.kernels.result import root_mean_square
from rotflex_jax.reproduce.plants import plant
from rotflex_jax.text.files import write_file

RESULT = Path(__file__).resolve().parent / "results" / "B8.json"
TS = 0.05

# Effects added to the joint of the paper; the share is that of the last one. The last case is an offset on a
# joint with friction.
SHARES: dict[str, tuple[fx.Effect, ...]] = {
    "coulomb hub": (fx.Coulomb("hub", level=0.03),),
    "coulomb joint": (fx.Coulomb("joint", level=0.003),),
    "stribeck hub": (fx.Stribeck("hub"),),
    "dead zone": (fx.DeadZone(positive=0.1, negative=0.1),),
    "saturation": (fx.Saturation(limit=1.5),),
    "cubic spring": (fx.CubicSpring("joint", stiffness=60.0),),
    "quadratic drag": (fx.QuadraticDrag("hub", coefficient=0.001),),
    "joint play": (fx.JointPlay("joint", play=0.006),),
    "sensor cubic": (fx.SensorCubic("alpha", cubic=6.0),),
    "offset": (fx.VoltageOffset(offset=0.3),),
    "quadratic spring": (fx.QuadraticSpring("joint", stiffness=1.0),),
    "rectifier": (fx.Rectifier("alpha", loss=0.15),),
    "one-sided dead zone": (fx.DeadZone(positive=0.25, negative=0.0),),
    "unequal coulomb": (fx.CoulombAsymmetric("hub", forward=0.045, backward=0.015),),
    "offset with friction": (fx.Coulomb("hub", level=0.03), fx.VoltageOffset(offset=0.3)),
}
# Name of a case -> effect of the simulator at the hub and its parameters, or nothing.
HIDDEN: dict[str, dict] = {
    "friction": {("coulomb", "hub"): {"level": 0.03}},
    "drag": {("quadratic_drag", "hub"): {"coefficient": 0.008}},
    "uneven friction": {("patchy_friction", "hub"): {"level": 0.04, "share": 0.8}},
    "nothing": {},
}


def kernels() -> dict[str, Any]:
    """Shares of single effects, and agreement of least squares with averages."""
    u = np.random.default_rng(1).normal(size=20_000)
    rows = {}
    for name, added in SHARES.items():
        model = rf.Model(rf.joints.paper(), rf.Exponential(substeps=20))
        for effect in added:
            model = model + effect
        found = effect_kernels(model, u, "alpha", 8, Ts=TS, mirrored=True).shares[-1]
        rows[name] = {"linear": found.linear, "quadratic": found.quadratic}
        print(found, flush=True)
    agreement = {}
    for name in ("S1", "S5s", "S6"):
        model = rf.Model(plant(name), rf.Exponential(substeps=20))
        y = rf.simulate(model.mechanism, u, TS, solver=model.solver)
        recording = rf.Recording(u=u, y=y, Ts=TS)
        data = identified_kernels(least_squares(Volterra(Delays(10)), recording, "alpha"), 10, recording)
        agreement[name] = list(average_kernels(model, recording, "alpha", 10).against(data).rms)
        print(name, agreement[name], flush=True)
    return {"shares": rows, "agreement": agreement}


def measured() -> dict[str, Any]:
    """Volterra series of the measured deflection and of the grey box under the same voltage."""
    k, memory = 20, 16
    records = rf.data.load_dataset("rotflex")
    fit = rf.fit(rf.joints.quanser_2010() + fx.Coulomb("hub"), records, window_seconds=2.0)
    short = [r.decimate(k) for r in records]
    model = rf.Model(fit.model.mechanism, rf.Exponential(substeps=k))
    poles = np.linalg.eigvals(rf.linearise(model.mechanism).A)
    basis = Volterra(Orthonormal.at(poles[poles.real < -0.5], short[0].Ts))
    runs = [rf.Recording(u=r.u, y=model.simulate(r), Ts=r.Ts, n_init=r.n_init) for r in short]
    series = {"model": least_squares(basis, runs, "alpha"), "measured": least_squares(basis, short, "alpha")}
    mine = identified_kernels(series["model"], memory, runs)
    data = identified_kernels(series["measured"], memory, short)
    y, y_hat = (
        np.concatenate([a[r.n_init :] for r, a in zip(short, parts, strict=True)])
        for parts in (
            [r.channel("alpha") for r in short],
            [np.ravel(series["measured"].model.simulate(r)) for r in short],
        )
    )
    agreement = mine.against(data)
    upper = np.triu_indices(memory)
    told = data.errors[1][upper] > 0  # without feedthrough, the kernel is exactly zero at the first lags
    # A Gaussian voltage of the same size and bandwidth, and a stronger one.
    rms = float(np.sqrt(np.mean(np.concatenate([r.u for r in short]) ** 2)))
    friction = {}
    for times in (1.0, 3.0):
        u = rf.data.excitation.noise(20_000, short[0].Ts, bandwidth=0.8, rms=times * rms, seed=5)
        found = effect_kernels(model, u, "alpha", memory, Ts=short[0].Ts, mirrored=True)
        friction[f"{times:g}"] = next(s.linear for s in found.shares if s.effect.name == "coulomb")
    return {
        "rms": rms,
        "kurtosis": [float(np.mean((r.u - r.u.mean()) ** 4) / np.var(r.u) ** 2 - 3) for r in short],
        "weights": len(basis.degrees),
        "variance explained": float(1 - np.var(y - y_hat) / np.var(y)),
        "quadratic z": root_mean_square(data.h2[upper][told] / data.errors[1][upper][told]),
        "quadratic": {n: f.sizes[1] / f.sizes[0] for n, f in (("model", mine), ("measured", data))},
        "apart": agreement.relative[0],
        "apart z": agreement.rms[0],
        "first lag": {"model": float(mine.h1[1]), "measured": float(data.h1[1])},
        "friction": friction,
    }


def torque() -> dict[str, Any]:
    """Errors of short free runs over held-out data, over the noise, without and with a learned torque."""
    rows = {}
    for name, hidden in HIDDEN.items():
        made = make_record(hidden, seed=101, seconds=20.0)
        recording = rf.Recording(u=made["u"], y=made["y"], Ts=made["Ts"])
        found = rf.learn_torque(rf.joints.paper(), *recording.split(0.7), at="hub", progress=print)
        rows[name] = {
            "kept": found.kept,
            "formula": str(found.formula),
            **{
                when: {c: stage.held_out_rmse_windows[c] / found.noise_floor[c] for c in found.noise_floor}
                for when, stage in (("before", found.before), ("after", found.after))
            },
        }
        print(name, rows[name], flush=True)
    return rows


def _known(model: Any, train: Any, test: Any) -> SimpleNamespace:
    """A search that returns a constant result at once."""
    errors = {"held_out_rmse": {"theta": 1.0, "alpha": 1.0}}
    errors["held_out_rmse_windows"] = {"seconds": 2.0, "theta": 1.0, "alpha": 1.0}
    floor = {"theta": 5e-4, "alpha": 5e-4}
    answer = {"schema": 1, "verdict": "nothing_missing", "rounds": [], "baseline": errors}
    return SimpleNamespace(to_dict=lambda: {**answer, "noise_floor": floor})


def fleet() -> dict[str, Any]:
    """Processor time for each recording without its search [s], in a first call and with stored results."""
    count, rng = 2000, np.random.default_rng(3)
    recordings = []
    for _ in range(count):
        u = rng.normal(size=60)
        recordings.append(rf.Recording(u=u, y=np.column_stack([np.cumsum(u), u]) * 1e-3, Ts=0.002))
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(2):
            began = time.process_time()
            rf.fleet(rf.joints.paper(), recordings, folder=folder, workers=0, search=_known)
            seconds.append((time.process_time() - began) / count)
    return {"recordings": count, "searched": seconds[0], "known": seconds[1]}


PARTS: dict[str, Callable[[], dict[str, Any]]] = {
    "kernels": kernels,
    "measured": measured,
    "torque": torque,
    "fleet": fleet,
}


def main() -> None:
    """Runs the chosen parts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("parts", nargs="*", help=f"among {', '.join(PARTS)}; all unless given")
    chosen = parser.parse_args().parts or list(PARTS)
    kept = json.loads(RESULT.read_text(encoding="utf-8")) if RESULT.exists() else {}
    begin(kept, __file__, chosen)
    for name in chosen:
        try:
            found = PARTS[name]()
        except InputError as reason:  # measured recordings are missing
            print(f"{name}: {reason}")
            continue
        kept[name] = found
        part(kept, name)
        write_file(RESULT, json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    main()
