"""B13: many runs of a joint at once, on the processor and on an accelerator.

    python benchmarks/B13_accelerator.py

One compiled program simulates K machines side by side (`jax.vmap` over the parameters), in double precision:
the joint of the paper with dry friction at the hub, 2 s at 500 Hz. The time is that of one call, results left
on the device, the least of several; on a processor one program uses one core. An accelerator that JAX lacks
is left out. Writes `results/B13.json`.
"""

from __future__ import annotations

import json
import platform
import sys
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

import jax
import numpy as np

import rotflex_jax as rf
from origin import begin
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.mechanism.simulate import free_run
from rotflex_jax.text.files import write_file

SAMPLES, TS = 1000, 0.002
COUNTS = (1, 16, 256, 4096, 65536)
ROUNDS = 5
# Longest that a call may take for the next larger one to be tried [s].
LONGEST = 20.0


def times(device: jax.Device, counts: tuple[int, ...]) -> list[dict[str, float]]:
    """Seconds of a call for each number of machines."""
    m, solver = rf.joints.paper() + rf.effects.Coulomb(at="hub", level=0.02), rf.Exponential()
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-4, 4, SAMPLES // 20), 20)
    gates, x0 = np.ones(len(m.effects)), rest_state(m.structure, np.float64)
    run = jax.jit(jax.vmap(lambda p: free_run(m.structure, solver, p, gates, x0, u, np.float64(TS))[1]))
    rows = list[dict[str, float]]()
    for count in counts:
        values = jax.device_put(m.values * rng.uniform(0.8, 1.2, (count, len(m.values))), device)
        began = time.perf_counter()
        jax.block_until_ready(run(values))
        first, least = time.perf_counter() - began, np.inf
        for _ in range(ROUNDS):
            began = time.perf_counter()
            jax.block_until_ready(run(values))
            least = min(least, time.perf_counter() - began)
        rows.append({"machines": count, "seconds": least, "first_call": first})
        rate = 1e9 * least / (count * SAMPLES)
        print(
            f"{device.platform}: {count} machines, {least:.4g} s, {rate:.3g} ns a sample and machine",
            flush=True,
        )
        if least > LONGEST:
            break
    return rows


def main() -> int:
    """Measure every device that JAX has, and save."""
    rf.enable_fast_loops()
    devices = {"cpu": jax.devices("cpu")[0]}
    if jax.default_backend() != "cpu":
        devices[jax.default_backend()] = jax.devices()[0]
    found: dict[str, Any] = {}
    with jax.enable_x64(True):
        for name, device in devices.items():
            with jax.default_device(device):
                found[name] = {"device": device.device_kind, "rows": times(device, COUNTS)}
    found["cpu"]["device"] = platform.processor() or platform.machine()
    result: dict[str, Any] = {"benchmark": "B13", "samples": SAMPLES, "devices": found}
    begin(result, __file__)
    path = HERE / "results" / "B13.json"
    write_file(path, json.dumps(result, indent=1) + "\n")
    print(f"saved: {path}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
