"""Draws of several effects, and statistics of results: intervals, sets of effects, confusion, pages."""

import math

import numpy as np
import pytest

from arena.marks import confusion, group, grouped, intervals, mean_set, sets
from arena.pages import publish
from rotflex_jax.arena.marking import parameter_errors, scored, visible
from rotflex_jax.arena.simulator.draws import apart, drawn
from rotflex_jax.arena.simulator.hidden import ABSORBED, EQUIVALENT
from rotflex_jax.parameters import Estimate, Specification


def row(effects, rounds=(), **more):
    """A row of results in the format of the benchmark."""
    wanted = more.pop("wanted", effects)
    answers = [{"effect": e, "port": p, "equivalent": []} for e, p in rounds]
    marks = scored(wanted, list(rounds), [[] for _ in rounds], "found")
    usual = {"kind": "noise", "seed": 1, "size": 1.0, "parameters": {}, "wanted": wanted}
    return {"effects": effects, "rounds": answers, **marks, **usual, **more}


HUB, ARM, DELAY = ("coulomb", "hub"), ("coulomb", "arm"), ("delay", "input")


def test_draws_are_fixed_different_and_of_effects_that_are_apart():
    pairs, triples = drawn(40, 2), drawn(10, 3)
    assert drawn(12, 2) == pairs[:12]
    assert len(set(pairs)) == 40 and all(len(t) == 3 for t in triples)
    for group_ in (*pairs, *triples):
        assert not set(group_) & ABSORBED
        assert all(b not in EQUIVALENT.get(a, set()) for a in group_ for b in group_)
    assert not apart(HUB, ("dahl", "hub"))  # two frictions at one port cannot be distinguished
    assert not apart(HUB, ARM) and apart(HUB, DELAY)


def test_intervals_of_a_normal_error_keep_every_promise():
    rng = np.random.default_rng(0)
    std = rng.uniform(0.1, 2.0, 4000)
    errors = std * rng.normal(size=4000)
    pairs = enumerate(zip(errors, std, strict=True))
    numbers = {str(k): {"true": 1.0, "estimate": 1 + e, "std": s} for k, (e, s) in pairs}
    for kept in intervals([row([HUB], [HUB], parameters=numbers)]):
        assert kept.cases == 4000
        assert kept.share == pytest.approx(kept.claim, abs=3.5 * kept.scatter)
    narrow = {k: {**v, "std": v["std"] / 2} for k, v in numbers.items()}
    at_95 = next(k for k in intervals([row([HUB], [HUB], parameters=narrow)]) if k.claim == 0.95)
    assert at_95.share == pytest.approx(0.673, abs=0.03)  # P(|x| < 0.98)


def test_a_number_without_deviation_makes_no_promise():
    numbers = {"a": {"true": 1.0, "estimate": 2.0, "std": None}}
    assert all(
        k.cases == 0 and math.isnan(k.share) for k in intervals([row([HUB], [HUB], parameters=numbers)])
    )


def test_sets_count_only_where_something_was_said():
    right, wrong, silent = row([HUB], [HUB]), row([HUB], [ARM]), row([HUB], [])
    nothing = row([], [])
    held = sets([right, wrong, silent, nothing, {"error": "x"}])
    assert (held.held, held.cases) == (1, 2)
    listed = {**wrong, **scored([HUB], [ARM], [[HUB]], "ambiguous")}
    assert sets([listed]).held == 1 and mean_set([listed]) == 2.0


def test_groups_and_confusion():
    records = [
        row([HUB], [HUB]),
        row([HUB], [ARM]),
        row([HUB], [HUB], size=0.3),
        row([HUB], [HUB], channels=["theta"]),
        row([HUB, DELAY], [HUB, DELAY]),
        row([], []),
    ]
    assert list(grouped(records)) == [
        "one effect",
        "one effect, size 0.3",
        "one effect, theta only",
        "two effects",
        "nothing hidden",
    ]
    assert group(records[-1]) == "nothing hidden"
    truths, answers, pairs = confusion(records)
    assert truths == ["coulomb@hub", "nothing"] and set(answers) == {"coulomb@hub", "coulomb@arm", "nothing"}
    assert pairs["coulomb@hub", "coulomb@arm"] == 1 and pairs["coulomb@hub", "coulomb@hub"] == 1


def test_an_error_of_a_sensor_that_is_not_there_is_not_wanted():
    hidden = [("sensor_gain", "alpha"), HUB]
    assert visible(hidden, "noise") == hidden
    assert visible(hidden, "noise", ["theta"]) == [HUB]


def test_errors_carry_the_deviation():
    e = Estimate.of("hub.coulomb.level", 0.031, 0.001, Specification("N m", 0.02))
    table = parameter_errors({HUB: {"level": 0.03}}, {e.name: e})
    assert table[e.name]["std"] == 0.001 and table[e.name]["covered"]


def test_a_page_of_any_records(tmp_path):
    """The confusion figure is left out without effects of full size, and all files without valid results."""
    usual = {"verdict_right": True, "cpu_s": 1.0, "verdict": "found"}
    one, smaller = row([HUB], [HUB], **usual), row([HUB], [HUB], size=0.3, **usual)
    names = lambda records: [f.name for f in publish(records, tmp_path / "B0.json")]  # noqa: E731
    assert names([{"error": "x"}]) == []
    assert names([smaller]) == ["B0.md", "B0_reliability.png"]
    assert names([one, smaller]) == ["B0.md", "B0_confusion.png", "B0_reliability.png"]
    assert "| one effect, size 0.3 | 1 | 1/1 |" in (tmp_path / "B0.md").read_text()
