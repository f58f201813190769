"""A note says that the model is incomplete if intervals of predictions and free runs are disjoint."""

import dataclasses
import json

import pytest
from spindle import PAIRS, SPINDLE, spun

import rotflex_jax as rf
from rotflex_jax.discover import summary
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.result import conditional_note, excluding
from rotflex_jax.parameters import Estimate, Specification


def inertia(value: float, std: float, **changes: object) -> Estimate:
    found = Estimate.of("shaft.inertia.inertia", value, std, Specification("kg m^2", 0.02))
    return dataclasses.replace(found, **changes)


@pytest.mark.parametrize(("apart", "excluded"), [(0.999, False), (1.001, True)])
@pytest.mark.parametrize("way", [1, -1])
def test_intervals_exclude_each_other_where_they_have_nothing_in_common(
    apart: float, excluded: bool, way: int
) -> None:
    a = inertia(0.02, 1e-4)
    b = inertia(0.02 + way * apart * 1.96 * 4e-4, 3e-4)
    found = excluding([a], [b])
    assert bool(found) is excluded
    assert (max(a.ci95[0], b.ci95[0]) > min(a.ci95[1], b.ci95[1])) is excluded
    if excluded:
        (note,) = conditional_note(found)
        assert "the model is incomplete" in note and "[0.01980, 0.02020]" in note
        assert found[0].to_dict()["parameter"] == "shaft.inertia.inertia"


def test_what_has_no_interval_excludes_nothing() -> None:
    far = inertia(0.5, 1e-4)
    for a in (
        inertia(0.02, float("nan")),
        inertia(0.02, 1e-4, free=False),
        inertia(0.02, 1e-4, name="other"),
    ):
        assert excluding([a], [far]) == excluding([far], [a]) == ()
    assert conditional_note(()) == ()


def test_a_result_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    true = summary.estimates

    def shifted(problem: LikelihoodProblem, h: object) -> tuple[Estimate, ...]:
        """Estimates, with the inertia of free runs shifted by ten standard deviations."""
        return tuple(
            inertia(e.value + 10 * e.std, e.std) if problem.free_run and e.name.endswith("inertia") else e
            for e in true(problem, h)
        )

    parts = spun().split(0.7)
    plain = rf.discover(SPINDLE, *parts, candidates=PAIRS, rounds=0)
    assert plain.conditional == () and plain.to_dict()["conditional_intervals"] == []
    monkeypatch.setattr(summary, "estimates", shifted)
    found = rf.discover(SPINDLE, *parts, candidates=PAIRS, rounds=0)
    (entry,) = json.loads(json.dumps(found.to_dict()))["conditional_intervals"]
    assert entry["free_run"]["ci95"][0] > entry["prediction"]["ci95"][1]
    assert any("the model is incomplete" in note for note in found.notes)
