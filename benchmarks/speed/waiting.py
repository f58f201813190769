"""Waiting times of a user for a search: nothing compiled, compiled before, another effect, another length.

Each row is a search, with the number of programs that it compiled and loaded, the time of compilation (wall
clock, summed over threads), the wall-clock and processor times of the search, and the memory of the process
after it.
"""

from __future__ import annotations

import os
import tempfile
from statistics import median
from typing import Any

import numpy as np

from speed.processes import process

# Two hidden effects, as in the first search of the README; another one; length of the shorter recording as a
# share.
FIRST = (("coulomb", "hub"), ("cubic_spring", "joint"))
OTHER = (("quadratic_drag", "arm"),)
SHORTER = 0.6
# Number of new processes of each kind; the medians are reported.
TIMES = 3
SEARCHES = """
import json, resource, sys, time
from pathlib import Path
import rotflex_jax as rf
from rotflex_jax.runtime.persistent_jit import program_counts
rf.keep_programs(sys.argv[1])
used = lambda: sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
rows = []
for path in sys.argv[2:]:
    if path == "measured":
        joint, (train, test) = rf.joints.quanser_2010(), rf.data.load_dataset("rotflex")
    else:
        joint, (train, test) = rf.joints.paper(), rf.load(path).split(0.7)
    before, began, worked = program_counts(), time.perf_counter(), used()
    found = rf.discover(joint, train, test)
    clock, processor, after = time.perf_counter() - began, used() - worked, program_counts()
    pages = int(Path("/proc/self/statm").read_text().split()[1]) if Path("/proc/self/statm").exists() else 0
    rows.append({
        "compiled": after.compiled - before.compiled,
        "loaded": after.loaded - before.loaded,
        "compiling": after.seconds - before.seconds,
        "seconds": clock,
        "processor": processor,
        "memory": pages * resource.getpagesize() / 1e6,
        "effects": len(found.rounds),
    })
print(json.dumps({"rows": rows}))
"""
# The command `rotflex demo`, as run by a shell, with its report.
DEMO = """
import os, sys
programs, report = sys.argv[1:]
os.environ["ROTFLEX_PROGRAMS"] = programs
sys.argv[1:] = ["demo", "--report", report]
from rotflex_jax.cli import main
main()
"""
HEAD = ("compiled", "loaded", "compiling", "seconds", "processor", "memory", "effects")

Row = dict[str, Any]


def waiting(seconds: float) -> list[Row]:
    """One row per search.

    Args:
        seconds: Length of the recordings [s]. Below 20 s each search runs once, without the measured joint.
    """
    whole = seconds >= 20.0
    with tempfile.TemporaryDirectory() as folder:
        files = _files(folder, seconds)
        each_time = range(TIMES if whole else 1)
        each = [_searches(f"{folder}/{k}", files) for k in each_time]
        rows: list[Row] = [
            {"name": rows[0]["name"], **{what: median(row[what] for row in rows) for what in HEAD}}
            for rows in zip(*each, strict=True)
        ]
        took = [
            process(DEMO, f"{folder}/demo{k}", f"{folder}/report{k}", cache=f"{folder}/own{k}")
            for k in each_time
        ]
        clock, processor = (median(found[what] for found in took) for what in ("clock", "processor"))
        name = "`rotflex demo` as a whole, nothing compiled"
        rows.append({"name": name, "seconds": clock, "processor": processor})
        if whole and os.environ.get("ROTFLEX_DATA"):
            names = ("two measured runs, nothing compiled", "the same again")
            found = process(SEARCHES, f"{folder}/measured", "measured", "measured", cache=f"{folder}/other")
            rows += [{"name": name, **row} for name, row in zip(names, found["rows"], strict=True)]
        return rows


def _files(folder: str, seconds: float) -> dict[str, str]:
    from rotflex_jax.arena.simulator.records import make_record

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
    return files


def _searches(folder: str, files: dict[str, str]) -> list[Row]:
    programs, cache = f"{folder}/programs", f"{folder}/cache"
    order = ("first", "first", "other", "shorter")
    one = process(SEARCHES, programs, *(files[name] for name in order), cache=cache)["rows"]
    again = process(SEARCHES, programs, files["first"], cache=cache)["rows"]
    names = (
        "a new process, nothing compiled",
        "the same again",
        "another effect",
        "another length",
        "a second process",
    )
    return [{"name": name, **row} for name, row in zip(names, [*one, *again], strict=True)]
