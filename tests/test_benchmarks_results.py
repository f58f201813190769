"""Results that documents quote: their commits, the code that they measure, and bounds of shares."""

import json
from pathlib import Path
from typing import Any

import pytest
import scipy.stats

from claims import most
from origin import RESULTS, Imports, begin, meaning, of_changed_tree, part, remark, runs_that_count, standing

FILES = sorted(RESULTS.rglob("*.json"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_results_come_from_committed_code(file: Path) -> None:
    runs = runs_that_count(json.loads(file.read_text(encoding="utf-8")))
    assert runs, f"{file.name} does not say what made it; see benchmarks/origin.py"
    # `stored`: results older than the record of origins, with the commit that added them.
    changed = [run.get("date") for run in runs if of_changed_tree(run) and not run.get("stored")]
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


def project(folder: Path, **modules: str) -> Imports:
    """Write a package with benchmarks; `__` in the name of a module stands for `/`."""
    for name, text in modules.items():
        file = folder / (name.replace("__", "/").replace("/init", "/__init__") + ".py")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return Imports(folder)


def test_results_measure_what_their_script_imports(tmp_path: Path) -> None:
    found = project(
        tmp_path,
        benchmarks__B1="import numpy\nimport rotflex_jax as rf\nfrom drawing import draw\nrf.fit(1)\n",
        benchmarks__drawing="import rotflex_jax.export",
        rotflex_jax__init="from .fit import fit as fit\nfrom .export import export as export\n",
        rotflex_jax__fit__init="from .greybox import fit\nfrom .series import other\n",
        rotflex_jax__fit__greybox="def fit(x):\n    from rotflex_jax.effects import base\n",
        rotflex_jax__fit__series="",
        rotflex_jax__effects__init="from .base import A\nfrom .gear import B\n",
        rotflex_jax__effects__base="if TYPE_CHECKING:\n    from ..fit import series\n",
        rotflex_jax__effects__gear="from ..text.files import write\n",
        rotflex_jax__text__init="",
        rotflex_jax__text__files="",
        rotflex_jax__export="",
    ).sources("B1")
    # Effects are registered where they are declared, so all of them count.
    effects = {f"rotflex_jax/effects/{name}.py" for name in ("__init__", "base", "gear")}
    assert set(found) == {"benchmarks/B1.py", "rotflex_jax/fit/greybox.py"} | effects


def test_the_arena_measures_the_search() -> None:
    measured = set(Imports().sources("B0_discovery"))
    parts = ["discover/selection", "discover/verdict", "effects/friction", "mechanism/step", "fit/inference"]
    parts += ["arena/simulator/plant", "optimise/damped_least_squares", "recording/quality"]
    assert {f"rotflex_jax/{name}.py" for name in parts} <= measured
    assert "benchmarks/arena/trial.py" in measured
    assert not any(path.startswith(("rotflex_jax/report", "rotflex_jax/cli")) for path in measured)
    # Tables of benchmarks only format results, but the table of `compare` computes errors.
    assert not any(path.startswith("benchmarks") and path.endswith("table.py") for path in measured)
    assert "rotflex_jax/compare/table.py" in Imports().sources("B5_compare")


MODULE = """'''A text.'''
def f(x):
    if x < 2:
        raise ValueError("small")
    return x
"""


@pytest.mark.parametrize(
    ("before", "after", "same"),
    [
        ("A text", "Another text", True),
        ("def f(x):", "# why\n\ndef f( x ):\n    'What it does.'", True),
        ("    return x", "    y = x\n    'What it is.'\n    return x", False),
        ("    return x", "    'Description of what is above.'\n    return x", True),
        ("small", "too small", True),
        ("ValueError", "TypeError", False),
        ("<", "<=", False),
        ("2", "2.5", False),
        ("return x", "return x, None", False),
        ("return x", "return 'x'", False),
    ],
)
def test_what_changes_the_meaning_of_a_module(before: str, after: str, same: bool) -> None:
    assert before in MODULE
    assert (meaning(MODULE) == meaning(MODULE.replace(before, after))) is same


def test_results_are_of_an_earlier_version_once_what_they_measure_has_changed(tmp_path: Path) -> None:
    project(tmp_path, benchmarks__B1="a = 1\n")
    run = {"commit": "abc", "clean": True, "code": "one", "sources": "s"}
    sources = {"s": {"benchmarks/B1.py": meaning("a = 1")}}
    results = {"runs": [run], "sources": sources, "rows": {"x": {"code": "one"}}}
    assert standing(results, tmp_path) == (True, (), ())
    # A run without remaining rows does not count; a missing run that rows refer to does.
    runs = [{"commit": "old", "clean": False, "code": "two"}, run]
    assert standing({**results, "runs": runs}, tmp_path).present
    assert standing({**results, "runs": runs, "parts": {"fits": "two"}}, tmp_path).of == ("old with changes",)
    assert standing({**results, "rows": {"x": {"code": "three"}}}, tmp_path).of == ("not told",)
    assert not standing({**results, "runs": [{**run, "clean": False}]}, tmp_path).present
    assert standing({"runs": [{"stored": "abc"}]}, tmp_path).of == ("stored with abc",)
    assert not standing({"rows": []}, tmp_path).present
    other = tmp_path / "other"
    project(other, benchmarks__B1="a = 2\n")
    assert standing(results, other) == (False, ("abc",), ("benchmarks/B1.py",))
    assert standing(results, tmp_path / "gone").changed == ("benchmarks/B1.py",)
    # Tables of benchmarks only format, so a changed one does not count, even if a run recorded its digest.
    shown = {"s": sources["s"] | {"benchmarks/arena/wrong_table.py": "before"}}
    assert standing({**results, "sources": shown}, tmp_path).present
    # The script of a benchmark counts, also with the name of a page.
    pages = {"s": sources["s"] | {"benchmarks/B8_pages.py": "before"}}
    assert standing({**results, "sources": pages}, tmp_path).changed == ("benchmarks/B8_pages.py",)
    # Modules of the package with names of pages and tables count too.
    named = {
        "s": sources["s"] | {f"rotflex_jax/{name}.py": "before" for name in ("report/page", "compare/table")}
    }
    assert len(standing({**results, "sources": named}, tmp_path).changed) == 2


def test_a_run_says_what_made_it(monkeypatch) -> None:
    results: dict = {"rows": {}}
    made = begin(results, "benchmarks/B12_control.py", ["coulomb"], files=["tests/conftest.py"])
    assert {"date", "commit", "clean", "python", "machine", "versions", "arguments"} <= set(made)
    (run,) = results["runs"]
    measured = results["sources"][run["sources"]]
    assert {"benchmarks/B12_control.py", "tests/conftest.py", "rotflex_jax/control/design.py"} <= set(
        measured
    )
    part(results, "coulomb")
    assert runs_that_count(results) == [run]
    assert standing(results).changed == ()
    # A run on a clean tree replaces runs of the same sources on a changed tree, not runs of other sources.
    said = {"rev-parse": "abc", "status": ""}
    monkeypatch.setattr("origin.git", lambda *command: said[command[0]])
    other = {**run, "clean": False, "sources": "others"}
    results["runs"] = [{**run, "clean": False}, other]
    begin(results, "benchmarks/B12_control.py", ["coulomb"], files=["tests/conftest.py"])
    assert results["runs"][0] is other and [r["commit"] for r in results["runs"][1:]] == ["abc"]
    assert not of_changed_tree(results["runs"][1])
    said["status"] = " M rotflex_jax/fit/inference.py"
    assert of_changed_tree(begin({}, "benchmarks/B12_control.py"))


def test_what_is_said_beside_numbers(tmp_path: Path, monkeypatch) -> None:
    """The remark lists benchmarks with results of an earlier version, grouped by commits."""
    monkeypatch.setattr("origin.RESULTS", tmp_path)
    (tmp_path / "B5").mkdir()
    for name, commit in (("B1", "abc"), ("B2", "abc"), ("B5/a", "def"), ("B5/b", "abc")):
        (tmp_path / f"{name}.json").write_text(json.dumps({"runs": [{"commit": commit, "clean": True}]}))
    head = "Measured with an earlier version of the code: "
    assert remark(["B1.json", "B2.json", "B5"]) == f"{head}B1, B2 (abc); B5 (def, abc)."
    assert remark([]) == ""


@pytest.mark.parametrize(("k", "n"), [(0, 116), (0, 1), (3, 60), (59, 60)])
def test_a_share_that_is_not_excluded(k: int, n: int) -> None:
    """At the bound, the binomial probability of k or fewer of n is 5 % by scipy."""
    assert scipy.stats.binom.cdf(k, n, most(k, n)) == pytest.approx(0.05)


def test_none_of_116_and_all_of_some() -> None:
    assert most(0, 116) == pytest.approx(1 - 0.05 ** (1 / 116))
    assert most(5, 5) == 1.0
