"""B13: time of many runs, fit steps and adaptive filters at once, on the processor and on an accelerator.

    python benchmarks/B13_accelerator.py

One compiled program evaluates K sets of parameters over 1000 samples in double precision: on an accelerator
all sets at the same time, on a processor `TOGETHER` sets at a time.

- `runs`: free runs of the joint of the paper with dry friction at the hub, 2 s at 500 Hz;
- `fit_steps`: the normal equations of a fit of all its parameters to such a run, with sensitivities and
  error;
- `filters`: LMS filters of a Volterra series of second order with 5 delays (21 weights), one for each pair
  of step sizes; on a processor by the function of the package for sweeps.

The time is that of one call with data and results on the device, the least of `ROUNDS` calls. On a
processor, one program uses one core. Numbers of sets whose call would take longer than `LONGEST` are left
out, and so is an accelerator if JAX finds none. Writes `results/B13.json`.
"""

from __future__ import annotations

import functools
import json
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

import jax
import jax.numpy as jnp
import numpy as np

import rotflex_jax as rf
from origin import begin
from rotflex_jax.adaptive import LMS
from rotflex_jax.adaptive.objectives import evaluate, tuning_data, values_at
from rotflex_jax.basis import Delays, Volterra
from rotflex_jax.fit.problem import directions, normal_equations
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.mechanism.sensitivities import RecordingSamples, RunParameters
from rotflex_jax.mechanism.simulate import free_run
from rotflex_jax.text.files import write_file

SAMPLES, TS = 1000, 0.002
COUNTS = (1, 16, 256, 4096, 65536)
ROUNDS = 5
# Number of sets of parameters that a processor evaluates side by side.
TOGETHER = 16
# Longest time that a call may take, extrapolated from the number of sets before [s].
LONGEST = 20.0

Work = tuple[Callable[[jax.Array], Any], Callable[[int], np.ndarray]]
"""Function of many sets of parameters, and a function that draws a given number of sets."""


def side_by_side(one: Callable[[jax.Array], Any], device: jax.Device) -> Callable[[jax.Array], Any]:
    """The function `one` of a set of parameters, applied to many sets on a device."""
    together = TOGETHER if device.platform == "cpu" else max(COUNTS)
    return lambda values: jax.lax.map(one, values, batch_size=min(together, len(values)))


def voltage() -> np.ndarray:
    """Random steps of 40 ms [V]."""
    return np.repeat(np.random.default_rng(0).uniform(-4, 4, SAMPLES // 20), 20)


def spread_about(values: np.ndarray, count: int) -> np.ndarray:
    """Sets of parameters that differ from given values by up to a fifth."""
    return values * np.random.default_rng(1).uniform(0.8, 1.2, (count, len(values)))


def joint() -> tuple[rf.Mechanism, rf.Exponential]:
    """The joint of the paper with dry friction."""
    return rf.joints.paper() + rf.effects.Coulomb(at="hub", level=0.02), rf.Exponential()


def runs(device: jax.Device) -> Work:
    """Free runs of the joint."""
    m, solver = joint()
    gates, x0, u = np.ones(len(m.effects)), rest_state(m.structure, np.float64), voltage()
    run = lambda p: free_run(m.structure, solver, p, gates, x0, u, np.float64(TS))[1]  # noqa: E731
    return side_by_side(run, device), functools.partial(spread_about, m.values)


def fit_steps(device: jax.Device) -> Work:
    """Normal equations of free runs of the joint in all its parameters."""
    m, solver = joint()
    run, sets = runs(device)
    given = voltage(), run(jnp.asarray(m.values[None]))[0], np.ones(SAMPLES), np.float64(TS)
    samples = RecordingSamples(*map(jnp.asarray, given))
    gates, x0 = jnp.ones(len(m.effects)), jnp.asarray(rest_state(m.structure, np.float64))
    free, scale = jnp.arange(len(m.values)), jnp.full(samples.y.shape[1], 1e-3)

    def step(p: jax.Array) -> Any:
        ways = directions(m.structure, p, free, 0)  # derivatives by the logarithm of each parameter
        return normal_equations(m.structure, solver, RunParameters(p, gates, x0, None), ways, samples, scale)

    return side_by_side(step, device), sets


def filters(device: jax.Device) -> Work:
    """Mean squared error of LMS filters, in units of the smallest."""
    basis, rng = Volterra(Delays(5)), np.random.default_rng(3)
    u = rng.standard_normal(SAMPLES)
    y = u + 0.2 * u**2 + 0.1 * rng.standard_normal(SAMPLES)
    data = tuning_data(basis, [rf.Recording(u=u, y=y, Ts=TS, channels="alpha")], "alpha", "mean_error")
    sets = functools.partial(spread_about, np.array([2e-3, 2e-4]))
    names = ("linear", "quadratic")

    def build(sizes: dict[str, Any]) -> LMS:
        return LMS(basis.step_sizes({0: sizes["linear"], 1: sizes["linear"], 2: sizes["quadratic"]}))

    if device.platform == "cpu":
        return functools.partial(values_at, data=data, names=names, build=build, objective="mean_error"), sets
    one = lambda sizes: evaluate(data, "mean_error", build(dict(zip(names, sizes, strict=True))))  # noqa: E731
    return side_by_side(one, device), sets


def times(device: jax.Device, work: Callable[[jax.Device], Work]) -> list[dict[str, float]]:
    """Time of a call for each number of sets of parameters [s]."""
    many, sets = work(device)
    run = jax.jit(many)
    rows = list[dict[str, float]]()
    for count in COUNTS:
        if rows and rows[-1]["seconds"] * count / rows[-1]["count"] > LONGEST:
            break
        values = jax.device_put(sets(count), device)
        began = time.perf_counter()
        jax.block_until_ready(run(values))
        first, least = time.perf_counter() - began, np.inf
        for _ in range(ROUNDS):
            began = time.perf_counter()
            jax.block_until_ready(run(values))
            least = min(least, time.perf_counter() - began)
        rows.append({"count": count, "seconds": least, "first_call": first})
        rate = 1e9 * least / (count * SAMPLES)
        print(
            f"{device.platform}: {work.__name__}, {count}: {least:.4g} s, {rate:.3g} ns a sample and set",
            flush=True,
        )
    return rows


def main() -> int:
    """Measures every device that JAX finds, and saves the results."""
    rf.enable_fast_loops()
    devices = {"cpu": jax.devices("cpu")[0]}
    if jax.default_backend() != "cpu":
        devices[jax.default_backend()] = jax.devices()[0]
    found: dict[str, Any] = {}
    with jax.enable_x64(True):
        for name, device in devices.items():
            with jax.default_device(device):
                rows = {work.__name__: times(device, work) for work in (runs, fit_steps, filters)}
                found[name] = {"device": device.device_kind, **rows}
    found["cpu"]["device"] = platform.processor() or platform.machine()
    result: dict[str, Any] = {"benchmark": "B13", "samples": SAMPLES, "devices": found}
    begin(result, __file__)
    path = HERE / "results" / "B13.json"
    write_file(path, json.dumps(result, indent=1) + "\n")
    print(f"saved: {path}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
