"""Calibrates the probabilities of sets of effects on tuning runs of B0, and shows how they hold.

    python benchmarks/B0_discovery.py --tuning --seeds 101 --inputs noise --seconds 10 --out plain.json
    python benchmarks/B0_discovery.py --wrong-worlds 48 --tuning --out worlds.json
    python benchmarks/set_probabilities.py plain.json worlds.json --fit --figure probabilities.png

Rows of tuning runs keep what each half second says for each set (`evidence`). The rule is the one under which
the right sets are most probable, mean logarithm over machines; it is fitted and evaluated by halves of the
machines in turn, so that what is printed of it is of machines it was not fitted to.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).resolve().parent
for folder in (HERE, HERE.parent):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))

from arena.probability import Row, classes, draw_probabilities, misfit, summary, told_of, usable, weighed
from rotflex_jax.discover.probabilities import RULE, EvidenceRule

# What is tried of each number; all others are held while it is.
TRIED: dict[str, tuple[float, ...]] = {
    "temperature": (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 50.0),
    "run_nats": (0.0, 0.1, 0.2, 0.3, 0.5, 1.0),
    "prior_nats": (0.5, 1.0, 2.0, 3.0, 4.0),
    "passed_nats": (1.0, 2.0, 3.0, 4.0),
}
LEAST = 1e-3
"""Probability of a right set below which a machine counts no more against a rule: its fit went wrong."""


def again(row: Row, rule: EvidenceRule) -> Row:
    """The row with the probabilities of another rule."""
    return {**row, "probabilities": told_of(weighed(row, rule))}


def loss(rows: Sequence[Row], rule: EvidenceRule) -> float:
    """Mean of minus the log probability of the right set among those fitted, where it is among them [nat]."""
    within = rule._replace(elsewhere=0.0, elsewhere_unexplained=0.0)
    right = [sum(e.probability for e in classes(again(r, within)) if e.true) for r in rows]
    return -sum(math.log(max(p, LEAST)) for p in right) / max(len(rows), 1)


def has_right(row: Row) -> bool:
    """Whether the right set was fitted."""
    return any(e.true for e in classes(row))


def calibrated(rows: Sequence[Row], start: EvidenceRule = RULE) -> EvidenceRule:
    """The rule under which right sets are most probable, one number at a time until none gets better."""
    known, best = [r for r in rows if has_right(r)], start
    least = loss(known, best)
    for _ in range(4):
        before = least
        for name, values in TRIED.items():
            for value in values:
                rule = best._replace(**{name: value})
                got = loss(known, rule)
                if got < least - 1e-6:
                    best, least = rule, got
        if before - least < 1e-3:
            break
    # Laplace's rule of succession.
    for name, explained in (("elsewhere", True), ("elsewhere_unexplained", False)):
        part = [r for r in rows if (misfit(r) == 1) == explained]
        missed = sum(not has_right(r) for r in part)
        best = best._replace(**{name: round((missed + 1) / (len(part) + 2), 3)})
    return best


def main() -> int:
    """Read rows, fit, print, draw."""
    parser = argparse.ArgumentParser(description="Do probabilities of sets of effects hold?")
    parser.add_argument("results", nargs="+", type=Path, help="results of tuning runs of B0")
    parser.add_argument("--fit", action="store_true", help="fit the rule to these rows")
    parser.add_argument("--figure", type=Path, default=None, help="reliability diagram, as PNG")
    a = parser.parse_args()
    records = [r for path in a.results for r in json.loads(path.read_text())["records"].values()]
    rows = [r for r in usable(records) if "evidence" in r]
    print(f"{len(rows)} machines; the present rule: {RULE}")
    print(summary([again(r, RULE) for r in rows]))
    shown = [again(r, RULE) for r in rows]
    if a.fit:
        print(f"fitted to all: {calibrated(rows)}")
        halves = [rows[0::2], rows[1::2]]
        shown = []
        for fitted, judged in itertools.permutations(halves):
            rule = calibrated(fitted)
            print(f"fitted to one half: {rule}")
            shown += [again(r, rule) for r in judged]
        print("each half by the rule of the other:")
        print(summary(shown))
    if a.figure:
        draw_probabilities(shown, a.figure)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
