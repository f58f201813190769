"""The search on recordings of an independent simulator: a few problems like those of benchmark B0."""

import sys

import pytest

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.arena.marking import alike, parameter_errors, scored
from rotflex_jax.arena.simulator.hidden import Place
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.discover import Discovery

pytestmark = pytest.mark.slow

# The seeds below are neither the tuning seeds (100 to 119) nor the report seeds (1000 to 1019) of B0. The
# recordings have as many samples (3500) as those of other searches, so that they share compiled programs.
SECONDS, FS = 7.0, 500.0


def searched(place: Place | None, kind: str, seed: int) -> tuple[Discovery, dict]:
    record = make_record([place] if place else [], kind=kind, seed=seed, seconds=SECONDS, fs=FS)
    train, test = rf.Recording(u=record["u"], y=record["y"], Ts=record["Ts"]).split(0.7)
    return rf.discover(rf.joints.paper(), train, test), record["truth"]


@pytest.mark.parametrize(
    ("place", "kind", "seed", "tolerance"),
    [
        (("coulomb", "hub"), "noise", 2000, 5.0),
        (("cubic_spring", "joint"), "multisine", 2001, 5.0),
        (("voltage_offset", "input"), "noise", 2002, 5.0),
    ],
)
def test_finds_the_hidden_effect(place: Place, kind: str, seed: int, tolerance: float) -> None:
    result, truth = searched(place, kind, seed)
    rounds = [(r.effect, r.port) for r in result.rounds]
    assert rounds[0] == place
    # Other effects may only be documented equivalents of it.
    assert set(rounds) <= alike(place)
    assert result.verdict in ("found", "ambiguous")

    # The reported set is the most probable one, and the true effect has a probability above 0.9.
    probable = result.probabilities
    assert probable.sets[0].effects == {f"{e}@{p}" for e, p in rounds}
    assert probable.effects[f"{place[0]}@{place[1]}"] > 0.9
    assert frozenset() in {s.effects for s in probable.sets} or place == ("voltage_offset", "input")
    assert result.to_dict()["probabilities"]["sets"][0]["probability"] == probable.sets[0].probability
    assert str(result).endswith(probable.sentence)

    hidden = {(e["effect"], e["port"]): e["parameters"] for e in truth["effects"]}
    errors = parameter_errors(hidden, {e.name: e for e in result.final.estimates})
    assert errors
    assert all(abs(e["error_percent"]) < tolerance for e in errors.values())

    before, after = result.baseline.held_out_rmse_windows, result.final.held_out_rmse_windows
    assert all(after[c] < before[c] for c in before)
    # Errors are near the noise of the sensor.
    assert all(after[c] < 1.2 * result.noise_floor[c] for c in after)


def test_an_asymmetric_friction_is_one_law(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is found as one effect, not as symmetric friction beside a calibration of the voltage offset."""
    # A proposed experiment takes as long as the search; `test_discover_conclusion.py` has tests of it.
    monkeypatch.setattr(sys.modules[rf.discover.__module__], "with_proposal", lambda found: found)
    record = make_record([("coulomb_asymmetric", "hub")], seed=2004, seconds=6.0, fs=FS)
    train, test = rf.Recording(u=record["u"], y=record["y"], Ts=record["Ts"]).split(0.7)
    pairs = [(fx.Coulomb, "hub"), (fx.CoulombAsymmetric, "hub")]
    result = rf.discover(rf.joints.paper(), train, test, candidates=pairs)
    (found,) = result.rounds
    # Both sets were fitted; the set with fewer effects is more probable.
    probable = dict(result.probabilities.sets)
    one, several = frozenset({"coulomb_asymmetric@hub"}), frozenset({"coulomb@hub", "voltage_offset@input"})
    assert result.probabilities.sets[0].effects == one
    assert probable[one] > probable[several] > 0
    assert (found.effect, found.port) == ("coulomb_asymmetric", "hub")
    # Coulomb friction with a voltage offset has the same effect and as many parameters.
    assert set(found.equivalent) == {("coulomb", "hub"), ("voltage_offset", "input")}
    assert found.parameters["forward"].value == pytest.approx(0.045, rel=0.03)
    assert found.parameters["backward"].value == pytest.approx(0.015, rel=0.06)


def test_hysteresis_takes_the_place_of_the_friction_it_contains() -> None:
    """The score test ranks Dahl friction first; the result has Bouc-Wen hysteresis, which contains it."""
    record = make_record([("bouc_wen", "hub")], seed=2005, seconds=6.0, fs=FS)
    train, test = rf.Recording(u=record["u"], y=record["y"], Ts=record["Ts"]).split(0.7)
    result = rf.discover(rf.joints.paper(), train, test, candidates=[(fx.Dahl, "hub"), (fx.BoucWen, "hub")])
    assert [(r.effect, r.port) for r in result.rounds] == [("bouc_wen", "hub")]
    assert result.verdict == "found"


def test_finds_nothing_where_nothing_is_hidden() -> None:
    result, _ = searched(None, "noise", 2003)
    assert result.rounds == ()
    assert (
        result.probabilities.sets[0].effects == frozenset() and result.probabilities.sets[0].probability > 0.8
    )
    assert result.verdict == "nothing_missing"


def test_scoring_knows_look_alikes() -> None:
    hub, offset = ("coulomb", "hub"), ("voltage_offset", "input")
    lopsided = ("coulomb_asymmetric", "hub")
    mark = scored([lopsided], [hub, offset], [[], []], "found")
    assert mark["first"] and mark["exact"] and mark["verdict_right"]
    assert not mark["strict"] and not mark["extra"]
    # The symmetric part alone is not the truth.
    assert not scored([lopsided], [hub], [[]], "found")["exact"]
    # A set of equivalents that contains the true effect is right only with the verdict ambiguous.
    wrong = ("stribeck", "hub")
    assert scored([hub], [wrong], [[hub]], "ambiguous")["verdict_right"]
    assert not scored([hub], [wrong], [[hub]], "found")["verdict_right"]
    assert scored([hub], [wrong], [[]], "found")["extra"] == [list(wrong)]
    # Nothing hidden: any effect is a false alarm.
    assert not scored([], [hub], [[]], "found")["first"]
    assert scored([], [], [], "nothing_missing")["verdict_right"]
