"""B15: fits of measured machines from one start and with restarts.

    python benchmarks/B15_fits.py
    python benchmarks/B15_fits.py --only rigid_arm emps
    python benchmarks/B15_fits.py --only whole

Each machine of B9 that has a hub or an axis is fitted with one law of friction there and a voltage offset
for each recording, to free runs over 2 s from measured first states (`rf.fit`): once with `restarts=0` and
once with the default number of restarts. Three of the laws contain Coulomb friction as a limit, so that
their global minimum is not above that of Coulomb friction. If a fit with one of them has a larger cost than
the fit with Coulomb friction, it has ended in a local minimum. The cost is that of all training and
validation data of B9 together; test data are used for the reported test errors only.

`whole` are fits to whole runs of the rotary joint, to run A and to both runs, with seven sets of effects.

Needs the recordings, fetched or in the folder named by `ROTFLEX_DATA`. Writes `results/B15.json` after each
direction (training to test data); results of other directions in the file are kept.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

import numpy as np

import rotflex_jax as rf
from B0_discovery import save
from origin import begin, part
from rotflex_jax.arena.measured import MACHINES, MeasuredDirection
from rotflex_jax.effects import CATALOG
from rotflex_jax.metrics import windowed_rmse
from rotflex_jax.recording.recording import joined

LAWS = ("coulomb", "dahl", "stribeck", "lugre")
OFFSET, SECONDS = "input.voltage_offset.offset", 2.0


def fits(base: rf.Model, direction: MeasuredDirection, law: str) -> list[dict[str, Any]]:
    """A model with one law of friction, fitted without and with restarts."""
    m = base.mechanism + CATALOG[law](at="hub" if "hub" in base.mechanism.port_vectors else "axis")
    if OFFSET not in m.parameter_names:
        m = m + CATALOG["voltage_offset"](at="input")
    model, runs = rf.Model(m, base.solver), list(joined((*direction.train, *direction.validation)))
    how: dict[str, Any] = {"local": [OFFSET], "first": "measured", "window_seconds": SECONDS}
    rf.fit(model, runs, **how, restarts=1, max_steps=1)  # compiles the programs of both fits
    rows = []
    for options in ({"restarts": 0}, {}):
        begun = time.perf_counter()
        found = rf.fit(model, runs, **how, **options)
        seconds = time.perf_counter() - begun
        of_machine = found.model.with_values({OFFSET: 0.0})
        simulated = [of_machine.simulate_windows(r, SECONDS) for r in direction.test]
        errors = windowed_rmse(
            direction.test, [of_machine.measured(r) for r in direction.test], simulated, SECONDS
        )
        channels = of_machine.mechanism.channels
        rows.append(
            {
                "cost": found.cost,
                "status": found.status,
                "rmse": found.noise,
                "test_rmse": dict(zip(channels, np.asarray(errors).tolist(), strict=True)),
                "seconds": seconds,
            }
        )
    return rows


# Sets of effects and ports that are fitted to whole runs.
SETS = (
    (("coulomb", "hub"),),
    (("stribeck", "hub"),),
    (("dahl", "hub"),),
    (("lugre", "hub"),),
    (("coulomb", "hub"), ("coulomb", "joint")),
    (("coulomb", "hub"), ("backlash", "hub")),
    (("lugre", "hub"), ("bouc_wen", "joint")),
)


def whole_runs() -> dict[str, Any]:
    """Fits to whole runs of the rotary joint, without and with restarts."""
    A, B = rf.data.load_dataset("rotflex")
    rows: dict[str, Any] = {}
    for name, runs in (("A", [A]), ("A and B", [A, B])):
        for chosen in SETS:
            m = rf.joints.quanser_2010()
            for effect, port in chosen:
                m = m + CATALOG[effect](at=port)
            found = [rf.fit(m, runs, restarts=0), rf.fit(m, runs)]
            key = f"{name}: {', '.join(f'{effect} at {port}' for effect, port in chosen)}"
            rows[key] = [{"cost": f.cost, "status": f.status, "rmse": f.noise} for f in found]
            print(key, [(round(f.cost), f.status) for f in found], flush=True)
    return rows


def arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", default=[], metavar="PART", help="as rigid_arm, or whole")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "B15.json")
    return parser.parse_args()


def main() -> int:
    """Fits every direction and saves after each one."""
    a = arguments()
    results: dict[str, Any] = {"benchmark": "B15", "rows": {}, "whole": {}}
    if a.out.is_file():
        results = json.loads(a.out.read_text())
    begin(results, __file__, sys.argv[1:])
    if not a.only or "whole" in a.only:
        results["whole"] = whole_runs()
        part(results, "whole")
        save(a.out, results)
    for name, machine in MACHINES.items():
        if a.only and name not in a.only:
            continue
        base = machine.model()
        # Machines with signals have the same runs as others, and these models do not use the signals.
        if machine.with_signals or not {"hub", "axis"} & set(base.mechanism.port_vectors):
            continue
        for direction in machine.directions():
            found = {law: fits(base, direction, law) for law in LAWS}
            results["rows"][f"{name}: {direction.name}"] = found
            part(results, "rows")
            save(a.out, results)
            costs = {law: [round(f["cost"]) for f in each] for law, each in found.items()}
            print(f"{name}: {direction.name}: {json.dumps(costs)}", flush=True)
    print(f"saved: {a.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
