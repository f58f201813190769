"""A fit from a new process: importing, loading what was compiled before, reading nothing."""

from __future__ import annotations

import resource
import subprocess
import sys
import time

IMPORTS = """
import rotflex_jax as rf; rf.enable_fast_loops(); rf.enable_compilation_cache()
from speed.fits import recording, start, smooth
rf.many_starts, rf.Recording
"""
COLD = (
    IMPORTS
    + """
rf.many_starts(smooth(p=start(0.3, 1)), recording({seconds}), starts=1, short_seconds=None)
"""
)


def cold(seconds: float) -> dict[str, float]:
    """Whole processes, from start to fitted; the first may have to fill the cache of compiled code."""
    first, *warm = [_process(COLD.format(seconds=seconds)) for _ in range(4)]
    clock, worked = (min(column) for column in zip(*warm, strict=True))
    return {
        "whole process, first, seconds": first[0],
        "whole process, warm cache, seconds": clock,
        "whole process, warm cache, processor seconds": worked,
        "importing alone, processor seconds": min(_process(IMPORTS)[1] for _ in range(2)),
    }


def _process(code: str) -> tuple[float, float]:
    """Seconds of a process by the clock and of the processor."""
    used = lambda: sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])  # noqa: E731
    begin, worked = time.perf_counter(), used()
    subprocess.run([sys.executable, "-c", code], check=True)
    return time.perf_counter() - begin, used() - worked
