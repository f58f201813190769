"""Calibrates the probabilities of sets of effects on tuning runs of B0, and tests the calibration.

    python benchmarks/B0_discovery.py --tuning --seeds 101 --inputs noise --seconds 10 --out plain.json
    python benchmarks/B0_discovery.py --wrong-worlds 48 --tuning --out worlds.json
    python benchmarks/set_probabilities.py plain.json worlds.json --fit --figure probabilities.png

Rows of tuning runs have the evidence of each half second for each set (`evidence`). The calibrated rule
maximises the probability of the right sets, as a mean logarithm over machines. With `--fit` it is also fitted
to each half of the machines and evaluated on the other half, so that the reliability that is printed last and
drawn is that on machines that were not used for the fit.
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

# Values that are tried for each constant of the rule, while the other constants keep their values.
TRIED: dict[str, tuple[float, ...]] = {
    "temperature": (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 50.0),
    "run_nats": (0.0, 0.1, 0.2, 0.3, 0.5, 1.0),
    "prior_nats": (0.5, 1.0, 2.0, 3.0, 4.0),
    "passed_nats": (1.0, 2.0, 3.0, 4.0),
}
LEAST = 1e-3
"""Lower limit of the probability of a right set in the loss, so that a failed fit does not dominate it."""


def again(row: Row, rule: EvidenceRule) -> Row:
    """The row with its probabilities recomputed with another rule."""
    return {**row, "probabilities": told_of(weighed(row, rule))}


def loss(rows: Sequence[Row], rule: EvidenceRule) -> float:
    """Mean negative log probability of the right set, given that it is among the fitted sets [nat]."""
    within = rule._replace(elsewhere=0.0, elsewhere_unexplained=0.0)
    right = [sum(e.probability for e in classes(again(r, within)) if e.true) for r in rows]
    return -sum(math.log(max(p, LEAST)) for p in right) / max(len(rows), 1)


def has_right(row: Row) -> bool:
    """Whether the right set was fitted."""
    return any(e.true for e in classes(row))


def calibrated(rows: Sequence[Row], start: EvidenceRule = RULE) -> EvidenceRule:
    """The rule with the least loss, by a coordinate search over `TRIED`.

    The probabilities of no fitted set being right are estimated from their frequencies.
    """
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
        for fitted, evaluated in itertools.permutations(halves):
            rule = calibrated(fitted)
            print(f"fitted to one half: {rule}")
            shown += [again(r, rule) for r in evaluated]
        print("each half by the rule of the other:")
        print(summary(shown))
    if a.figure:
        draw_probabilities(shown, a.figure)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
