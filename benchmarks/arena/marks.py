"""Statistics over the rows of B0: groups, confusion of effects, and coverage of intervals and sets."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, NamedTuple

from scipy.stats import norm

from arena.table import label
from rotflex_jax.arena.simulator.hidden import DEFAULTS, OUTSIDE

Row = dict[str, Any]

# Probabilities of the intervals that are checked; all follow from the standard deviation of an estimate.
CLAIMS = (0.5, 0.68, 0.8, 0.9, 0.95, 0.99)


class Kept(NamedTuple):
    """A stated probability, and how often the statement was true.

    Attributes:
        claim: share of cases in which the statement should be true.
        held: number of cases in which it was true.
        cases: number of all cases.
    """

    claim: float
    held: int
    cases: int

    @property
    def share(self) -> float:
        """Share of cases in which the statement was true."""
        return self.held / self.cases if self.cases else math.nan

    @property
    def scatter(self) -> float:
        """Standard deviation of the share if the stated probability is right."""
        return math.sqrt(self.claim * (1 - self.claim) / self.cases) if self.cases else math.nan


def good(records: list[Row]) -> list[Row]:
    """Rows without an error."""
    return [r for r in records if "error" not in r]


def group(row: Row) -> str:
    """Name of the group of a row: number of hidden effects, their size if not 1, and a single sensor."""
    count = ["nothing hidden", "one effect", "two effects", "three effects"][len(row["effects"])]
    if row.get("outside"):
        count = "effect without a name"
    size, channels = row.get("size", 1.0), row.get("channels", ["theta", "alpha"])
    return ", ".join(
        [count, *([f"size {size:g}"] if size != 1 else []), *([f"{channels[0]} only"] * (len(channels) == 1))]
    )


def grouped(records: list[Row]) -> dict[str, list[Row]]:
    """Rows without an error by group, in the order of their first row."""
    found: dict[str, list[Row]] = {}
    for row in good(records):
        found.setdefault(group(row), []).append(row)
    return found


def confusion(records: list[Row]) -> tuple[list[str], list[str], Counter[tuple[str, str]]]:
    """Hidden effect against the first effect found.

    Only rows with both sensors and at most one hidden effect, of the usual size, count.

    Returns:
        Names of hidden effects, names in answers, and the number of rows for each pair.
    """
    single = [r for r in good(records) if len(r["effects"]) < 2 and r.get("size", 1.0) == 1.0]
    single = [r for r in single if len(r.get("channels", ["theta", "alpha"])) == 2]
    pairs = Counter[tuple[str, str]]()
    for row in single:
        first = row["rounds"][0] if row["rounds"] else None
        pairs[label(row), f"{first['effect']}@{first['port']}" if first else "nothing"] += 1
    known = [f"{e}@{p}" for e, p in (*DEFAULTS, *OUTSIDE)] + ["nothing"]
    truths = sorted({truth for truth, _ in pairs}, key=known.index)
    said = {answer for _, answer in pairs}
    return truths, [t for t in truths if t in said] + sorted(said - set(truths)), pairs


def intervals(records: list[Row]) -> list[Kept]:
    """How often intervals of each probability contain the true value, over parameters of effects found."""
    numbers = [
        abs(p["estimate"] - p["true"]) / p["std"]
        for r in good(records)
        for p in r["parameters"].values()
        if p.get("std")
    ]
    return [Kept(c, sum(z <= norm.ppf((1 + c) / 2) for z in numbers), len(numbers)) for c in CLAIMS]


def sets(records: list[Row]) -> Kept:
    """How often all hidden effects are found or listed as equivalent, over rows with an effect found."""
    told = [r for r in good(records) if r["wanted"] and r["rounds"] and not r.get("outside")]
    return Kept(0.95, sum(bool(r["inside"]) for r in told), len(told))


def mean_set(records: list[Row]) -> float:
    """Mean over rows of the size of the largest set of equivalent effects; 1 if no effect has equivalents."""
    told = [r["set_size"] for r in good(records) if r["rounds"] and "set_size" in r]
    return sum(told) / len(told) if told else math.nan
