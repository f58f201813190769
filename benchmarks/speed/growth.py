"""Time and memory by number of samples, each measured in a separate process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from typing import Any

MEASURE = """
import json, resource, time
import rotflex_jax as rf; rf.enable_fast_loops()
from speed.growth import WORK
work = WORK["{work}"]({N})
small = WORK["{work}"](1000)
small()
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
work()
times = []
for _ in range(3):
    begin = time.perf_counter()
    work()
    times.append(time.perf_counter() - begin)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(json.dumps({{"seconds": min(times), "memory_mb": (peak - before) / 1024}}))
"""


def _lms(N: int) -> Callable[[], Any]:
    from rotflex_jax.adaptive import LMS, run
    from rotflex_jax.basis import Delays, Volterra
    from speed.filters import record, step_sizes

    u, y = record(N)
    basis = Volterra(Delays(5))
    filter = LMS(basis.step_sizes(dict(enumerate(step_sizes(5)))))
    return lambda: run(filter, u, y, basis=basis)


def _motion(N: int) -> Callable[[], Any]:
    from rotflex_jax.mechanism import simulate
    from speed.machine import Ts, smooth, voltage

    u, joint = voltage(N), smooth(True)
    return lambda: simulate(joint, u, Ts)


def _sums(N: int) -> Callable[[], Any]:
    from rotflex_jax import many_starts
    from speed.fits import recording, smooth, start
    from speed.machine import Ts

    r, joint = recording(N * Ts), smooth(p=start(0.3, 1))
    return lambda: many_starts(joint, r, starts=1, short_seconds=None, max_steps=2)


WORK = {"LMS M=5": _lms, "simulate": _motion, "two runs of a fit": _sums}


def grown(work: str, N: int) -> dict[str, float]:
    """Least time of three runs [s] over N samples, and their memory in addition to the inputs [MB]."""
    code = MEASURE.format(N=N, work=work)
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])
