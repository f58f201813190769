"""Times of a search over the catalogue: nothing compiled, a new process with a cache, everything loaded."""

from __future__ import annotations

import statistics
import tempfile

import numpy as np

from speed.processes import process

# Hidden effects of the recordings, which have seeds of the tuning set and are sampled at 500 Hz.
HIDDEN = ((), (("cubic_spring", "joint"),), (("coulomb", "hub"),), (("lag", "input"),))
PROCESS = """
import json, resource, sys, time
import rotflex_jax as rf
rf.enable_fast_loops(); rf.enable_compilation_cache()
import numpy as np
used = lambda: sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
rounds = []
for path in sys.argv[1:]:
    record = np.load(path)
    train, test = rf.Recording(u=record["u"], y=record["y"], Ts=float(record["Ts"])).split(0.7)
    began, worked = time.perf_counter(), used()
    rf.discover(rf.joints.paper(), train, test)
    rounds.append([time.perf_counter() - began, used() - worked])
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"rounds": rounds, "peak": peak}))
"""
# Hidden effects of the recordings of a fleet, equally many of each.
KINDS = (
    (),
    (("coulomb", "hub"),),
    (("stribeck", "hub"),),
    (("cubic_spring", "joint"),),
    (("joint_play", "joint"),),
    (("quadratic_drag", "arm"),),
    (("gravity", "arm"),),
    (("cogging", "hub"),),
    (("lag", "input"),),
    (("second_mode", "arm"),),
)
COMMAND = "import sys; from rotflex_jax.cli import main; sys.argv[0] = 'rotflex'; main()"


def fleet(seconds: float, each: int) -> dict[str, float]:
    """Times of `rotflex discover FILES --each`, with nothing compiled and with everything compiled [s]."""
    from rotflex_jax.arena.simulator.records import make_record

    with tempfile.TemporaryDirectory() as folder:
        files = []
        for k in range(each * len(KINDS)):
            made = make_record(KINDS[k % len(KINDS)], kind="noise", seed=2000 + k, seconds=seconds)
            files.append(f"{folder}/{k:03d}.npz")
            t = made["Ts"] * np.arange(len(made["u"]))
            np.savez(files[-1], t=t, voltage=made["u"], theta=made["y"][:, 0], alpha=made["y"][:, 1])
        runs = [
            process(
                COMMAND, "discover", *files, "--each", "--report", f"{folder}/{name}", cache=f"{folder}/cache"
            )
            for name in ("first", "again")
        ]
    facts = {"records": float(len(files))}
    for what, run in zip(("nothing compiled", "warm cache"), runs, strict=True):
        facts[f"{what}, seconds"], facts[f"{what}, processor seconds"] = run["clock"], run["processor"]
    return facts


def searches(seconds: float) -> dict[str, float]:
    """Wall-clock and processor times of searches [s], and memory [MB]."""
    from rotflex_jax.arena.simulator.records import make_record

    with tempfile.TemporaryDirectory() as folder:
        paths = []
        for k, effects in enumerate(HIDDEN):
            made = make_record(effects, kind="noise", seed=104 + k, seconds=seconds)
            paths.append(f"{folder}/{k}.npz")
            np.savez(paths[-1], u=made["u"], y=made["y"], Ts=made["Ts"])
        one, cache = paths[1], f"{folder}/cache"
        first, again = process(PROCESS, one, cache=cache), process(PROCESS, one, cache=cache)
        # All recordings twice in one process: the second time everything is compiled and loaded.
        every = process(PROCESS, *paths, *paths, cache=cache)
    warm = every["rounds"][len(paths) :]
    return {
        "new process, nothing compiled, seconds": first["clock"],
        "new process, nothing compiled, processor seconds": first["processor"],
        "new process, warm cache, seconds": again["clock"],
        "new process, warm cache, processor seconds": again["processor"],
        "everything compiled, median, seconds": statistics.median(r[0] for r in warm),
        "everything compiled, median, processor seconds": statistics.median(r[1] for r in warm),
        "everything compiled, longest, seconds": max(r[0] for r in warm),
        "peak memory of one search in MB": again["peak"],
    }
