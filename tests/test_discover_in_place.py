"""Other laws in the places of effects of a poor final model, and rivals that remain possible."""

import dataclasses
import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.discover import Discovery, in_place
from rotflex_jax.discover.search_state import SearchState
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.discover.tables import status_sentence
from rotflex_jax.discover.validation import ValidatedHypothesis
from rotflex_jax.parameters import specifications

COULOMB, STRIBECK, DAHL, LUGRE = (EffectLocation(e, "hub") for e in ("coulomb", "stribeck", "dahl", "lugre"))
ARM, DEAD_ZONE = EffectLocation("coulomb", "arm"), EffectLocation("dead_zone", "input")
SHAKING = EffectLocation("periodic_disturbance", "input")
DELAY, LAG = EffectLocation("delay", "input"), EffectLocation("lag", "input")
EVERY = (COULOMB, STRIBECK, DAHL, LUGRE, ARM, DEAD_ZONE, SHAKING, DELAY, LAG)


def supermodel() -> Any:
    one = SimpleNamespace(probes=(((1.0, 0.0), (0.0, 2.0)), ((3.0, 0.0), (0.0, 4.0))))
    s = SimpleNamespace(candidates=dict.fromkeys(EVERY, one), without_calibrations=frozenset)
    s.other_laws = functools.partial(SuperModel.other_laws, s)
    return s


def test_laws_of_one_thing_at_one_port():
    s = supermodel()
    assert s.other_laws(STRIBECK) == [COULOMB, DAHL, LUGRE]
    assert s.other_laws(ARM) == []
    assert s.other_laws(LAG) == [DELAY]
    # These effects are no laws of one thing.
    assert s.other_laws(DEAD_ZONE) == s.other_laws(SHAKING) == []


def model(*locations: EffectLocation) -> ValidatedHypothesis:
    """A validated model with these effects, without parameter values."""
    h: Any = SimpleNamespace(locations=locations)
    v = ValidatedHypothesis(h, np.zeros(1), h, np.ones(1))
    return dataclasses.replace(v, free_run=v)


def test_all_laws_and_rivals_take_the_place_once(monkeypatch: pytest.MonkeyPatch):
    """Effects of the model are not tried, and models that are known are not fitted again.

    A periodic disturbance remains a rival without a fit.
    """
    final, known = model(STRIBECK, DELAY), model(DAHL, DELAY)
    begun: dict[EffectLocation, tuple] = {}
    asked: list[EffectLocation] = []

    def refit(state, less, starts, runs_starts):
        assert starts is runs_starts
        for c in starts:
            begun[c.location] = (less.hypothesis.locations, less.free_run.hypothesis.locations, c)
        return [dataclasses.replace(model(), location=c.location) for c in starts]

    def decides(found, rival, left, measured):
        assert found.location in (STRIBECK, DELAY)
        assert (found.parameter_count, left, measured) == (3, 70.0, 100.0)
        asked.append(rival.location)
        return rival.location in (COULOMB, DAHL, DEAD_ZONE)

    def less(s, h, p):
        return SimpleNamespace(locations=tuple(x for x in h.locations if x != p))

    monkeypatch.setattr(in_place, "refit_and_validate", refit)
    monkeypatch.setattr(in_place, "undecided", decides)
    monkeypatch.setattr(in_place, "without", less)
    monkeypatch.setattr(in_place, "parameter_count", lambda s, h, p: 3)
    monkeypatch.setattr(in_place, "nats_left", lambda at, found: 70.0 if at == "predictions" else 0.0)
    monkeypatch.setattr(in_place, "gains_in_words", lambda rival, found: "gains")
    lines: list[str] = []
    state: Any = SimpleNamespace(
        problem=SimpleNamespace(supermodel=supermodel(), measured_values=100.0),
        horizons=SimpleNamespace(prediction="predictions"),
        current=final,
        scores={STRIBECK: 1.0, DELAY: 2.0, ARM: 3.0},  # the last was left out again
        rivals={STRIBECK: [DEAD_ZONE, COULOMB, DELAY, SHAKING], DELAY: [], ARM: [COULOMB]},
        tried=[final, known],
        say=lines.append,
    )
    remaining = in_place.undecided_rivals(state)
    assert remaining == {STRIBECK: [SHAKING, DAHL, COULOMB, DEAD_ZONE], DELAY: []}
    assert set(begun) == {COULOMB, LUGRE, DEAD_ZONE, LAG}
    assert sorted(asked) == sorted([*begun, DAHL])
    for location, (left, runs_left, c) in begun.items():
        assert left == runs_left == ((STRIBECK,) if location == LAG else (DELAY,))
        # The largest value of each parameter in a shape, for all shapes.
        np.testing.assert_array_equal([c.values, *c.others], [[1.0, 2.0], [3.0, 4.0]])
    assert [line.startswith("  fitting ") for line in lines].count(False) == len(asked)


def test_a_law_that_data_prefer_takes_the_place(monkeypatch: pytest.MonkeyPatch):
    final, better, best = model(STRIBECK, DELAY), model(DAHL, DELAY), model(LUGRE, DELAY)
    at_bound = model(COULOMB, DELAY)
    laws = ((at_bound, COULOMB), (better, DAHL), (best, LUGRE))
    tried = [dataclasses.replace(v, location=p) for v, p in laws]
    monkeypatch.setattr(in_place, "_in_place", lambda state, p, laws: tried if p == STRIBECK else [])
    monkeypatch.setattr(in_place, "better_in_place", lambda rival, found, measured: True)
    monkeypatch.setattr(in_place, "_shape_at_bound", lambda s, v, known: v.location == COULOMB)
    monkeypatch.setattr(in_place, "shares_of_gain", lambda rivals, found: np.array([1.0, 1.5]))
    monkeypatch.setattr(in_place, "parameter_count", lambda s, h, p: 3)
    monkeypatch.setattr(in_place, "gains_in_words", lambda rival, found: "gains")
    lines: list[str] = []
    state = SearchState(Any, Any, lines.append, final)
    state.scores, state.gains = {DELAY: 2.0, STRIBECK: 1.0}, {DELAY: "a", STRIBECK: "b"}
    state.rivals = {DELAY: [LAG], STRIBECK: [LUGRE, COULOMB]}
    monkeypatch.setattr(
        SearchState, "problem", SimpleNamespace(supermodel=supermodel(), measured_values=100.0)
    )
    monkeypatch.setattr(in_place, "predictions_apart", lambda rival, found: True)
    (note,) = in_place.take_better_laws(state)
    assert lines == ["  lugre at hub instead of stribeck at hub: gains"]
    assert note.startswith("LuGre friction at hub has taken the place of Stribeck friction at hub, which its")
    assert state.current.hypothesis is best.hypothesis and state.current.location is None
    assert list(state.scores.items()) == [(DELAY, 2.0), (LUGRE, 1.0)]
    assert list(state.gains.items()) == [(DELAY, "a"), (LUGRE, "b")]
    assert state.rivals == {DELAY: [LAG], LUGRE: [STRIBECK, COULOMB]}
    # A law that the data do not prefer changes nothing.
    monkeypatch.setattr(in_place, "better_in_place", lambda rival, found, measured: False)
    assert in_place.take_better_laws(state) == () and state.current.hypothesis is best.hypothesis


@pytest.mark.parametrize("predictions", [True, False])
def test_a_shape_at_a_bound_is_that_of_another_law(predictions: bool, monkeypatch: pytest.MonkeyPatch):
    """The fit to predictions counts only if predictions prefer the law.

    A level of zero does not count as a bound, since it is no shape parameter.
    """
    monkeypatch.setattr(in_place, "predictions_apart", lambda rival, found: predictions)
    specs = specifications(fx.LuGre)
    assert list(specs) == ["level", "rise", "slow", "presliding", "damping"]
    s: Any = SimpleNamespace(
        candidates={
            LUGRE: SimpleNamespace(parameters=range(5), amplitudes=(True, False, False, False, True)),
        },
        mechanism=SimpleNamespace(parameter_specifications=list(specs.values())),
    )

    def fitted(*values: float) -> ValidatedHypothesis:
        h: Any = SimpleNamespace(mean_values=lambda s: np.array(values))
        return ValidatedHypothesis(h, np.zeros(1), h, np.ones(1), location=LUGRE)

    def at_bound(of_predictions: ValidatedHypothesis, of_free_runs: ValidatedHypothesis) -> bool:
        rival = dataclasses.replace(of_predictions, free_run=of_free_runs)
        return in_place._shape_at_bound(s, rival, inside)

    inside = fitted(0.0, 0.5, 0.3, 0.003, 0.0)
    ends = [(9.999, 0.3, 0.003), (0.5, 0.0011, 0.003), (0.5, 0.3, 1.1e-6)]
    for shape in ends:
        end = fitted(0.02, *shape, 0.01)
        assert at_bound(inside, end)
        assert at_bound(end, inside) is predictions
    assert not at_bound(inside, inside)


LAWS = [(fx.Coulomb, "hub"), (fx.Stribeck, "hub"), (fx.Dahl, "hub")]
LAW, BESIDE = ("stribeck", "hub"), ("slack_cable", "hub")


def found_beside(size: float) -> Discovery:
    """A search on a machine with Stribeck friction and a slack cable, which no candidate describes."""
    hidden = {LAW: {"level": 0.02, "excess": 0.02, "speed": 0.5}}
    record = make_record(hidden | ({BESIDE: size} if size else {}), seed=2100, seconds=7.0, fs=500.0)
    train, validation = rf.Recording(u=record["u"], y=record["y"], Ts=record["Ts"]).split(0.7)
    return rf.discover(rf.joints.paper(), train, validation, candidates=LAWS)


@pytest.mark.slow
@pytest.mark.usefixtures("without_final_fit")
def test_a_law_is_decided_where_nothing_else_is_missing_and_open_where_much_is():
    (alone,) = found_beside(0.0).rounds
    assert (alone.effect, alone.port) == LAW and not alone.equivalent and alone.status == "established"
    beside = {r.effect: r for r in found_beside(3.0).rounds}
    law = beside["stribeck"]
    assert law.equivalent == (COULOMB,) and law.status == "provisional"
    assert law.certain == law.to_dict()["certain"] == "dry friction at the hub"
    said = "dry friction at the hub is certain, but not whether it is Stribeck friction or Coulomb friction"
    assert law.doubt == said and status_sentence(law) == f"Provisional as a law: {said}."


def test_a_law_stands_where_the_one_that_it_replaced_was_added(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(SearchState, "problem", SimpleNamespace(supermodel=supermodel()))
    state = SearchState(Any, Any, lambda line: None, None)
    state.scores = dict.fromkeys([ARM, COULOMB, DEAD_ZONE, DELAY, LUGRE], 1.0)
    assert state.in_order([ARM, DEAD_ZONE, DELAY, LUGRE]) == [ARM, LUGRE, DEAD_ZONE, DELAY]
    # If the earlier law is still in the model, the later one is a separate effect.
    assert state.in_order([COULOMB, DEAD_ZONE, DELAY, LUGRE]) == [COULOMB, DEAD_ZONE, DELAY, LUGRE]
    # It has replaced neither an effect at another port nor one that is no law of the same thing.
    assert state.in_order([COULOMB, DELAY]) == [COULOMB, DELAY]
    assert state.in_order([DEAD_ZONE, LUGRE, SHAKING]) == [LUGRE, DEAD_ZONE]
