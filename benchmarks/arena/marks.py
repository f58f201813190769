"""What a set of records says of the search: groups, confusion of names, promises kept."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, NamedTuple

from scipy.stats import norm

from arena.table import label
from rotflex_jax.arena.simulator.hidden import DEFAULTS, OUTSIDE

Row = dict[str, Any]

# What intervals may claim; the standard deviation of an estimate stands for all of them.
CLAIMS = (0.5, 0.68, 0.8, 0.9, 0.95, 0.99)


class Kept(NamedTuple):
    """A promise and how often it was kept.

    Attributes:
        claim: share of cases in which it should hold.
        held: cases in which it did.
        cases: all cases.
    """

    claim: float
    held: int
    cases: int

    @property
    def share(self) -> float:
        """Share of cases in which it held."""
        return self.held / self.cases if self.cases else math.nan

    @property
    def scatter(self) -> float:
        """Deviation of that share if the promise is true."""
        return math.sqrt(self.claim * (1 - self.claim) / self.cases) if self.cases else math.nan


def good(records: list[Row]) -> list[Row]:
    """Records that ran."""
    return [r for r in records if "error" not in r]


def group(row: Row) -> str:
    """Which part of the benchmark a record belongs to."""
    count = ["nothing hidden", "one effect", "two effects", "three effects"][len(row["effects"])]
    if row.get("outside"):
        count = "effect without a name"
    size, channels = row.get("size", 1.0), row.get("channels", ["theta", "alpha"])
    return ", ".join(
        [count, *([f"size {size:g}"] if size != 1 else []), *([f"{channels[0]} only"] * (len(channels) == 1))]
    )


def grouped(records: list[Row]) -> dict[str, list[Row]]:
    """Records by group, in the order they are met."""
    found: dict[str, list[Row]] = {}
    for row in good(records):
        found.setdefault(group(row), []).append(row)
    return found


def confusion(records: list[Row]) -> tuple[list[str], list[str], Counter[tuple[str, str]]]:
    """Hidden effect against the first effect found, of records with at most one of usual size.

    Returns:
        Hidden names, names answered, and how often each met the other.
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
    """How often intervals of each claim hold the truth, over all parameters of effects found."""
    numbers = [
        abs(p["estimate"] - p["true"]) / p["std"]
        for r in good(records)
        for p in r["parameters"].values()
        if p.get("std")
    ]
    return [Kept(c, sum(z <= norm.ppf((1 + c) / 2) for z in numbers), len(numbers)) for c in CLAIMS]


def sets(records: list[Row]) -> Kept:
    """How often the reported sets hold every hidden effect; of records in which something was found."""
    told = [r for r in good(records) if r["wanted"] and r["rounds"] and not r.get("outside")]
    return Kept(0.95, sum(bool(r["inside"]) for r in told), len(told))


def mean_set(records: list[Row]) -> float:
    """Mean size of the largest set of a record; 1 where every answer stands alone."""
    told = [r["set_size"] for r in good(records) if r["rounds"] and "set_size" in r]
    return sum(told) / len(told) if told else math.nan
