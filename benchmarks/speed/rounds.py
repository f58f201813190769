"""Timing on a machine with other load: all cases in turn, in a new random order in each round."""

from __future__ import annotations

import dataclasses
import os
import random
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

from rich.progress import Progress


@dataclasses.dataclass(frozen=True)
class Case:
    """A function to time.

    Attributes:
        name: Name of the row in the table.
        call: Function that does the work once.
        per: Number by which the time is divided, such as samples times a unit; 1 gives seconds.
        once: Whether to time the first call only, for work of many seconds.
        note: Note in the table.
    """

    name: str
    call: Callable[[], Any]
    per: float = 1.0
    once: bool = False
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Timed:
    """Times of a case [s per unit of `Case.per`].

    Attributes:
        name: Name of the case.
        cpu: Processor time of all threads: the mean over the calls of a visit, and the least of these means.
            Waiting for a processor that others use is not included. The time of other threads is counted in
            ticks of some milliseconds, so the least of single calls would be too small.
        least: Least wall-clock time.
        median: Median over the rounds of the wall-clock time.
        visits: Number of visits.
        first: Wall-clock time of the first call, with compilation [s].
        note: Note of the case.
    """

    name: str
    cpu: float
    least: float
    median: float
    visits: int
    first: float
    note: str = ""


def timed(
    cases: Sequence[Case], rounds: int, progress: Progress, title: str, *, visit: float = 0.15, seed: int = 0
) -> dict[str, Timed]:
    """Visits every case once per round; a visit repeats its function and takes the least wall-clock time.

    The first call is timed separately, since it compiles. Compare only cases of one call of this function:
    other load on the machine then affects all of them alike, and the least processor time hardly at all.

    Args:
        cases: Cases with different names.
        rounds: Number of visits of each case.
        progress: Progress display.
        title: Title of the progress bar.
        visit: Time for the repetitions of a visit [s].
        seed: Seed of the order.
    """
    first: dict[str, float] = {}
    found: dict[str, list[tuple[float, float]]] = {c.name: [] for c in cases}
    bar = progress.add_task(title, total=len(cases) * (rounds + 1))
    for case in cases:
        progress.update(bar, description=f"{title}: {case.name}")
        begun = _once(case)
        first[case.name] = begun[0]
        if case.once:
            found[case.name].append(begun)
        progress.advance(bar)
    order, draw = list(cases), random.Random(seed)
    for _ in range(rounds):
        draw.shuffle(order)
        for case in order:
            progress.advance(bar)
            if case.once:
                continue
            progress.update(bar, description=f"{title}: {case.name}")
            found[case.name].append(_visit(case, visit))
    progress.update(bar, description=title)
    return {
        c.name: Timed(
            c.name,
            min(cpu for _, cpu in found[c.name]) / c.per,
            min(clock for clock, _ in found[c.name]) / c.per,
            statistics.median(clock for clock, _ in found[c.name]) / c.per,
            len(found[c.name]),
            first[c.name],
            c.note,
        )
        for c in cases
    }


def _once(case: Case) -> tuple[float, float]:
    """Wall-clock and processor seconds of one call."""
    begin, worked = time.perf_counter(), time.process_time()
    case.call()
    return time.perf_counter() - begin, time.process_time() - worked


def _visit(case: Case, length: float) -> tuple[float, float]:
    """Least wall-clock time and mean processor time of repeated calls over some time [s]."""
    worked = time.process_time()
    seen, end = [_once(case)], time.perf_counter() + length
    while len(seen) < 1000 and time.perf_counter() < end:
        seen.append(_once(case))
    return min(clock for clock, _ in seen), (time.process_time() - worked) / len(seen)


def noise(results: dict[str, Timed]) -> dict[str, float]:
    """Noise of the times: excess of the median over the least time, and the load of the machine."""
    spreads = [r.median / r.least - 1 for r in results.values() if r.visits > 1]
    return {
        "typical_spread": statistics.median(spreads) if spreads else 0.0,
        "largest_spread": max(spreads, default=0.0),
        "load": os.getloadavg()[0],
    }


def least(run: Callable[[], Any], visits: int) -> tuple[float, Any]:
    """Least wall-clock time of some runs [s], without the first run, which compiles, and the result."""
    times, found = [], run()
    for _ in range(visits):
        began = time.perf_counter()
        found = run()
        times.append(time.perf_counter() - began)
    return min(times), found
