"""How long a person waits for a search: nothing compiled, compiled before, another effect, another length.

Each line is a search in a process of this machine, with the number of programs that it compiled and loaded,
the seconds that compiling took (by the clock, added over threads), the whole by the clock and of the
processor, and the memory of the process after it.
"""

from __future__ import annotations

import os
import tempfile
from typing import Any

import numpy as np

from speed.processes import process

# Two effects are hidden, as in a first search of the README; then others, then a shorter recording.
FIRST = (("coulomb", "hub"), ("cubic_spring", "joint"))
OTHER = (("quadratic_drag", "arm"),)
SHORTER = 0.6
SEARCHES = """
import json, resource, sys, time
from pathlib import Path
import rotflex_jax as rf
from rotflex_jax.runtime.persistent_jit import program_counts
rf.keep_programs(sys.argv[1])
used = lambda: sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
lines = []
for path in sys.argv[2:]:
    if path == "measured":
        joint, (train, test) = rf.joints.quanser_2010(), rf.data.load_dataset("rotflex")
    else:
        joint, (train, test) = rf.joints.paper(), rf.load(path).split(0.7)
    before, began, worked = program_counts(), time.perf_counter(), used()
    found = rf.discover(joint, train, test)
    clock, processor, after = time.perf_counter() - began, used() - worked, program_counts()
    pages = int(Path("/proc/self/statm").read_text().split()[1]) if Path("/proc/self/statm").exists() else 0
    lines.append({
        "compiled": after.compiled - before.compiled,
        "loaded": after.loaded - before.loaded,
        "compiling, seconds": after.seconds - before.seconds,
        "seconds": clock,
        "processor seconds": processor,
        "memory in MB": pages * resource.getpagesize() / 1e6,
        "effects": len(found.rounds),
    })
print(json.dumps({"lines": lines}))
"""


def waiting(seconds: float) -> dict[str, float]:
    """Facts of each search by its name.

    Args:
        seconds: Length of the recordings [s]; below 20 s the measured joint is left out.
    """
    from rotflex_jax.arena.simulator.records import make_record

    facts: dict[str, float] = {}

    def keep(name: str, line: dict[str, Any]) -> None:
        facts.update({f"{name}: {what}": float(value) for what, value in line.items()})

    with tempfile.TemporaryDirectory() as folder:
        files = {}
        for name, effects, share in (
            ("first", FIRST, 1.0),
            ("other", OTHER, 1.0),
            ("shorter", FIRST, SHORTER),
        ):
            made = make_record(effects, kind="noise", seed=104, seconds=share * seconds)
            files[name] = f"{folder}/{name}.npz"
            t = made["Ts"] * np.arange(len(made["u"]))
            np.savez(files[name], t=t, voltage=made["u"], theta=made["y"][:, 0], alpha=made["y"][:, 1])
        cache, programs = f"{folder}/cache", f"{folder}/programs"
        order = ("first", "first", "other", "shorter")
        one = process(SEARCHES, programs, *(files[name] for name in order), cache=cache)
        again = process(SEARCHES, programs, files["first"], cache=cache)
        names = ("nothing compiled", "the same again", "another effect", "another length")
        for name, line in zip(names, one["lines"], strict=True):
            keep(name, line)
        keep("second process", again["lines"][0])
        if seconds >= 20.0 and os.environ.get("ROTFLEX_DATA"):
            measured = process(SEARCHES, f"{folder}/measured", "measured", "measured", cache=cache)
            for name, line in zip(
                ("measured, nothing compiled", "measured, again"), measured["lines"], strict=True
            ):
                keep(name, line)
    return facts
