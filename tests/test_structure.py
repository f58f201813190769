"""The code has the architecture that docs/design.md describes."""

import dataclasses
import importlib
import re
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "docs"))  # for `generate`, which measures the package

from generate import reference  # noqa: E402
from generate.structure import Package, largest_circle, repeated, shapes  # noqa: E402


@pytest.fixture(scope="module")
def package() -> Package:
    return Package(ROOT)


def test_design_draws_the_layers_that_the_linter_checks() -> None:
    drawn = re.search(r"<!-- layers -->\n```\n(.*?)```", (ROOT / "docs/design.md").read_text(), re.S)
    assert drawn is not None
    names = [re.split(r"\s{2,}", line)[0] for line in drawn[1].splitlines()]
    contract = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]
    assert names == [layer for layer in contract["layers"] if layer != "__main__"]


def test_only_the_result_of_a_search_imports_upwards() -> None:
    contract = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]
    assert contract["ignore_imports"] == ["rotflex_jax.discover.discovery -> rotflex_jax.report"]


def test_import_circles_are_small_and_stay_within_a_folder(package: Package) -> None:
    """Imports inside functions and for type checking count, except the one import of a higher layer."""
    graph = package.graph(origin=True)
    up = {name for name in graph if name.startswith("rotflex_jax.report")}
    circle = largest_circle(
        {**graph, "rotflex_jax.discover.discovery": graph["rotflex_jax.discover.discovery"] - up}
    )
    assert len(circle) <= 4, circle
    assert len({name.split(".")[1] for name in circle}) <= 1, circle


def test_no_class_is_defined_twice(package: Package) -> None:
    """Except in the simulator of the arena, which may repeat a name, because it shares no code."""
    twice = repeated(package)["classes"]
    assert {k for k, v in twice.items() if sum(".arena.simulator." not in m for m in v) != 1} == set()


def test_the_arena_simulator_imports_nothing_of_the_package(package: Package) -> None:
    """Data from the model that is tested on them would prove nothing."""
    home = "rotflex_jax.arena.simulator"
    files = {name: m for name, m in package.modules.items() if name.startswith(home)}
    assert len(files) > 10
    for name, m in files.items():
        assert {s for s, _, _ in m.imports() if not s.startswith(home)} == set(), name


def test_public_functions_state_the_shapes_of_their_arrays(package: Package) -> None:
    assert shapes(package)["missing"] == []


def test_public_results_with_arrays_compare_by_identity() -> None:
    """Of two arrays, `==` is an array, which has no truth: `result in results` would raise an error.

    Settings of filters, which usually are single numbers (`float | ...`), compare by value.
    """
    seen = 0
    for name in reference.PACKAGES:
        importlib.import_module(name)
        module = sys.modules[name]  # not an attribute: `rotflex_jax.fit` is the function
        for public in (getattr(module, public) for public in reference.public_names(module)):
            if dataclasses.is_dataclass(public) and isinstance(public, type):
                types = [str(field.type) for field in dataclasses.fields(public)]
                if any("ndarray" in t and not t.startswith("float |") for t in types):
                    assert public.__eq__ is object.__eq__, public
                    seen += 1
    assert seen > 20
