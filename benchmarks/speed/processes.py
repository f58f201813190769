"""Times of whole new processes, including start-up, imports and compilation."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

BEGIN = "import rotflex_jax as rf; rf.enable_fast_loops(); rf.enable_compilation_cache(); "
IMPORTS = BEGIN + "rf.fit, rf.Recording, rf.joints, rf.effects"
# Start values 20 to 40 % away from those of the joint that makes the recording.
FIT = (
    BEGIN
    + """
import sys
import numpy as np
kept = np.load(sys.argv[1])
joint = rf.joints.paper(hub_damping=0.006, joint_damping=0.003)
joint = joint + rf.effects.CubicSpring(at="joint", stiffness=3.0)
"""
)
BUILT_IN = 'joint = joint + rf.effects.Coulomb(at="hub", level=0.04)'
OWN = "from speed.machine import SmoothFriction; joint = joint + SmoothFriction(at='hub', level=0.04)"
END = "\nrf.fit(joint, rf.Recording(u=kept['u'], y=kept['y'], Ts=float(kept['Ts'])))"


def process(code: str, *arguments: str, cache: str, show: bool = False) -> dict[str, Any]:
    """Runs a new Python process: its wall-clock and processor seconds, and the JSON of its last line.

    The process may store the byte code of imports, as it does for an installed package. With `show`, its
    error stream is that of this process.
    """
    known = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    known["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    known["JAX_COMPILATION_CACHE_DIR"] = cache
    used = lambda: sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])  # noqa: E731
    began, worked = time.perf_counter(), used()
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        check=True,
        stdout=subprocess.PIPE,
        stderr=None if show else subprocess.PIPE,
        text=True,
        env=known,
    )
    last = done.stdout.splitlines()[-1:]
    said = json.loads(last[0]) if last and last[0].startswith("{") else {}
    return {**said, "clock": time.perf_counter() - began, "processor": used() - worked}


def cold(seconds: float) -> dict[str, float]:
    """Times of new processes that fit a recording or only import, the least of several.

    The first process of the fit has nothing compiled, and its time is also given separately.
    """
    import numpy as np

    from speed.fits import recording

    made = recording(seconds)
    with tempfile.TemporaryDirectory() as folder:
        file, cache = f"{folder}/recording.npz", f"{folder}/cache"
        np.savez(file, u=made.u, y=made.y, Ts=made.Ts)
        rounds = {
            what: [process(FIT + effect + END, file, cache=cache) for _ in range(6)]
            for what, effect in (("fit", BUILT_IN), ("fit with an effect of one's own", OWN))
        }
        jax = [process("import jax", cache=cache) for _ in range(4)]
        imports = [process(IMPORTS, cache=cache) for _ in range(4)]
    facts = {"fit, nothing compiled, seconds": rounds["fit"][0]["clock"]}
    rounds |= {"importing": imports, "importing jax alone": jax}
    for what, found in rounds.items():
        facts[f"{what}, seconds"] = min(f["clock"] for f in found)
        facts[f"{what}, processor seconds"] = min(f["processor"] for f in found)
    return facts
