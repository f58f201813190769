"""Results that documents quote: from code that was committed; bounds of their shares."""

import json
from pathlib import Path
from typing import Any

import pytest
import scipy.stats

from claims import most

RESULTS = Path(__file__).resolve().parents[1] / "benchmarks" / "results"
# Files with runs of a tree that was changed, from before this was refused. A new run leaves the list.
OF_CHANGED_TREES = {"B0.json", "B2.json", "B6.json"}


def runs_of(found: Any) -> list[dict[str, Any]]:
    """The runs of a file that says what made it, as `provenance` of the benchmarks writes them."""
    return found.get("runs", []) if isinstance(found, dict) else []


def of_changed_tree(run: dict[str, Any]) -> bool:
    """Whether code that was not committed made the results; a run that does not say so might be of one."""
    return not run.get("commit") or run.get("clean", not run.get("changed", True)) is not True


@pytest.mark.parametrize("file", sorted(RESULTS.glob("*.json")), ids=lambda file: file.name)
def test_results_come_from_committed_code(file: Path) -> None:
    runs = runs_of(json.loads(file.read_text(encoding="utf-8")))
    if not runs:
        pytest.skip("the file does not say what made it")
    changed = [run.get("date") for run in runs if of_changed_tree(run)]
    if file.name in OF_CHANGED_TREES:
        assert changed, f"{file.name} is clean now: take it off the list"
    else:
        assert not changed, f"{file.name}: run it again from a committed tree"


@pytest.mark.parametrize(
    ("run", "refused"),
    [
        ({"commit": "abc", "clean": True}, False),
        ({"commit": "abc", "changed": False}, False),
        ({"commit": "abc", "clean": False}, True),
        ({"commit": "abc", "changed": True}, True),
        ({"commit": "abc", "changed": False, "clean": False}, True),
        ({"commit": "", "clean": True}, True),
        ({"clean": True}, True),
        ({"commit": "abc"}, True),
    ],
)
def test_what_counts_as_committed(run: dict[str, Any], refused: bool) -> None:
    assert of_changed_tree(run) is refused


@pytest.mark.parametrize(("k", "n"), [(0, 116), (0, 1), (3, 60), (59, 60)])
def test_a_share_that_is_not_excluded(k: int, n: int) -> None:
    """With it, k or fewer of n are seen in one case of twenty."""
    assert scipy.stats.binom.cdf(k, n, most(k, n)) == pytest.approx(0.05)


def test_none_of_116_and_all_of_some() -> None:
    assert most(0, 116) == pytest.approx(1 - 0.05 ** (1 / 116))
    assert most(5, 5) == 1.0
