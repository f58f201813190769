"""Timing on a machine that others use too: every case in turn, in a new random order each round."""

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
    """One thing to time.

    Attributes:
        name: Row of the table.
        call: Does the work once.
        per: What the time is divided by, such as samples; 1 leaves seconds.
        once: Whether a single visit has to do, for what takes many seconds.
        note: For the table.
    """

    name: str
    call: Callable[[], Any]
    per: float = 1.0
    once: bool = False
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Timed:
    """What a case took [s per unit of `Case.per`].

    Attributes:
        name: Of the case.
        cpu: Processor time of all threads, the mean of a visit and the least of these: what waits for a
            processor that others use is not in it. The time of other threads comes in ticks of some
            milliseconds, so the least of single calls would be too small.
        least: Least time by the clock.
        median: Over the rounds, by the clock.
        visits: How many.
        first: Of the very first call [s], by the clock; it compiles.
        note: Of the case.
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
    """Visits every case once per round; a visit counts by its quickest repetition.

    The first call is apart, for it compiles. Cases are compared within one call of this function only:
    what else the machine does then falls on all alike, and least so on the minimum of processor time.

    Args:
        cases: With different names.
        rounds: Visits of each.
        progress: Shows how far it is.
        title: For the bar.
        visit: Repeat within a visit until this long [s].
        seed: Of the order.
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
    """Seconds by the clock, and of the processor."""
    begin, worked = time.perf_counter(), time.process_time()
    case.call()
    return time.perf_counter() - begin, time.process_time() - worked


def _visit(case: Case, length: float) -> tuple[float, float]:
    """The least by the clock and the mean of the processor's time, of repetitions over a while."""
    worked = time.process_time()
    seen, end = [_once(case)], time.perf_counter() + length
    while len(seen) < 1000 and time.perf_counter() < end:
        seen.append(_once(case))
    return min(clock for clock, _ in seen), (time.process_time() - worked) / len(seen)


def noise(results: dict[str, Timed]) -> dict[str, float]:
    """How restless the machine was: by how much the median lies above the minimum, and the load."""
    spreads = [r.median / r.least - 1 for r in results.values() if r.visits > 1]
    return {
        "typical_spread": statistics.median(spreads) if spreads else 0.0,
        "largest_spread": max(spreads, default=0.0),
        "load": os.getloadavg()[0],
    }


def least(run: Callable[[], Any], visits: int) -> tuple[float, Any]:
    """Seconds by the clock of the quickest of some runs, the first apart, for it compiles; and the result."""
    times, found = [], run()
    for _ in range(visits):
        began = time.perf_counter()
        found = run()
        times.append(time.perf_counter() - began)
    return min(times), found
