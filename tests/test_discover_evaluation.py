"""Report on a model of a search: errors with the data they are on, and whether effects are established."""

import dataclasses
import json

import numpy as np
import pytest
from test_report import two_rounds

from rotflex_jax.discover.evaluation import SAME_SIZE, PairedEstimates, disagreement
from rotflex_jax.discover.hypothesis import CandidateStart
from rotflex_jax.discover.result import HorizonGain, RunErrors
from rotflex_jax.discover.score_test import LEAST_SHARE, Score, promising_at_both
from rotflex_jax.discover.selection import HELD_OUT_Z, helps, replaced_by
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.parameters import Estimate, Specification

HUB = EffectLocation("coulomb", "hub")


def level(value: float, std: float) -> tuple[Estimate, ...]:
    """The friction of a hub with its standard deviation."""
    return (Estimate.of("hub.coulomb.level", value, std, Specification("N m", 0.02)),)


def compared(a: tuple[Estimate, ...], b: tuple[Estimate, ...]) -> str:
    return disagreement([PairedEstimates(a, b, "the validation data")], HUB)


def test_sizes_agree_within_their_intervals_or_nearly():
    assert "0.035 N m" in compared(level(0.020, 1e-4), level(0.035, 1e-4))
    assert compared(level(0.020, 6e-3), level(0.035, 6e-3)) == ""
    near = 0.020 / (1 - 0.9 * SAME_SIZE)
    assert compared(level(0.020, 1e-6), level(near, 1e-6)) == ""
    # A size that one part of the data does not determine does not agree.
    for other in (level(0.035, np.nan), ()):
        assert "not determine" in compared(level(0.020, 1e-4), other)


def test_what_belongs_to_a_recording_need_not_agree():
    location = EffectLocation("voltage_drift", "input")
    a, b = (
        (Estimate.of("input.voltage_drift.rate", rate, 1e-4, Specification("V/s", 0.01)),)
        for rate in (0.01, 0.05)
    )
    assert disagreement([PairedEstimates(a, b, "recording 1")], location) == ""


def test_a_gain_counts_by_its_scatter():
    assert helps(HorizonGain(10.0, HELD_OUT_Z + 0.1, 1.0))
    assert not helps(HorizonGain(1e4, HELD_OUT_Z - 0.1, 0.5)) and not helps(HorizonGain(-1.0, 5.0, 1.0))


def score(name: str, nats: float) -> Score:
    start = CandidateStart(EffectLocation(name, "hub"), np.array([1.0]), expected_gain=nats + 5)
    return Score(start, nats, True, 1.0, 1.0)


def ranked(prediction: dict[str, float], free_run: dict[str, float], most: int = 2) -> list[str]:
    listed = (
        [score(n, nats) for n, nats in sorted(d.items(), key=lambda i: -i[1])] for d in (prediction, free_run)
    )
    return [a.location.effect for a, _ in promising_at_both(*listed, most)]


def test_both_rankings_propose():
    """Candidates are ranked by the sum of their shares of the best scores at both horizons.

    The best candidate of each horizon is always refitted, a candidate with a small sum is not.
    """
    prediction = {"gravity": 100.0, "coulomb": 80.0, "cogging": 70.0, "viscous": 5.0, "dahl": -3.0}
    runs = {"gravity": 10.0, "coulomb": 900.0, "cogging": 100.0, "viscous": 20.0, "dahl": 1000.0}
    assert ranked(prediction, runs) == ["coulomb", "gravity", "dahl"]  # 1.7, 1.01, and best in free runs
    few = ranked(prediction, runs, most=5)
    assert few[0] == "coulomb" and "viscous" not in few
    assert LEAST_SHARE * 1.7 > 5 / 100 + 20 / 1000
    assert ranked({"dahl": -1.0}, {"dahl": -2.0}) == []


def replaced(before: tuple[dict, dict], after: tuple[dict, dict], tried=(), winner="dahl") -> list[str]:
    both = (
        [[score(n, x) for n, x in sorted(d.items(), key=lambda i: -i[1])] for d in s] for s in (before, after)
    )
    found = replaced_by(EffectLocation(winner, "hub"), *both, [EffectLocation(n, "hub") for n in tried])
    return [p.effect for p in found]


def test_candidates_whose_score_the_winner_took_are_refitted_too():
    before = ({"gravity": 100.0, "coulomb": 15.0}, {"coulomb": 400.0, "cogging": 500.0, "backlash": 90.0})
    # With the winner, Coulomb friction loses its score; those of gravity and cogging hardly change.
    after = ({"gravity": 90.0, "coulomb": -3.0}, {"coulomb": 2.0, "cogging": 480.0, "backlash": -4.0})
    assert replaced(before, after) == ["coulomb"]
    assert replaced(before, after, tried=("coulomb",)) == []
    assert replaced(before, ({"coulomb": 12.0}, {"coulomb": 300.0, "cogging": 480.0})) == ["gravity"]
    # One that keeps a part may be a separate effect; a law that contains the winner is tested again later.
    assert "coulomb" not in replaced(before, (after[0] | {"coulomb": 9.0}, after[1] | {"coulomb": 90.0}))
    rich = ({"lugre": 100.0}, {"lugre": 100.0})
    assert replaced(rich, ({}, {}), winner="coulomb") == []
    assert replaced(rich, ({}, {}), winner="cogging") == ["lugre"]
    # A score of a quarter of the best is enough; one of which a tenth is left is not lost.
    quarter = ({"gravity": 100.0, "coulomb": 25.0, "viscous": 24.9}, {})
    assert replaced(quarter, ({"gravity": 95.0}, {})) == ["coulomb"]
    # Shares of both horizons are added: two of 13 % are more than a quarter.
    both = ({"gravity": 100.0, "coulomb": 13.0}, {"cogging": 100.0, "coulomb": 13.0})
    assert replaced(both, ({"gravity": 95.0}, {"cogging": 95.0})) == ["coulomb"]
    assert replaced(({"gravity": 40.0}, {}), ({"gravity": 4.0}, {})) == []
    # At most two are taken, those with the largest shares over both horizons,
    gone = ({}, {})
    assert replaced(before, gone) == ["gravity", "cogging"]
    # however small their scores are.
    assert replaced(({"gravity": 1.5, "coulomb": 0.5}, {}), gone) == ["gravity", "coulomb"]


@pytest.mark.parametrize(("nats", "taken"), [(24.9, False), (25.1, True)])
def test_a_quarter_of_the_best_score_was_much(nats: float, taken: bool):
    before = ({"gravity": 100.0, "coulomb": nats}, {})
    assert ("coulomb" in replaced(before, ({"gravity": 100.0}, {}))) is taken


@pytest.mark.parametrize(("left", "taken"), [(4.9, True), (5.1, False)])
def test_a_tenth_of_a_score_is_nothing(left: float, taken: bool):
    before = ({"gravity": 100.0, "coulomb": 50.0}, {})
    assert ("coulomb" in replaced(before, ({"gravity": 100.0, "coulomb": left}, {}))) is taken


def test_errors_name_the_data_they_are_on():
    """JSON keys of validation data and of test data, with and without own offsets."""
    stage = two_rounds().final
    assert set(stage.errors()) == {"held_out_rmse", "held_out_rmse_windows"}
    errors = [
        RunErrors({"theta": k, "alpha": k}, {"theta": 10 * k, "alpha": 10 * k}) for k in (1.0, 2.0, 3.0)
    ]
    names = ("calibrated", "test", "test_calibrated")
    found = dataclasses.replace(stage, **dict(zip(names, errors, strict=True))).errors()
    assert found["held_out_rmse_calibrated"]["theta"] == 1.0
    assert found["held_out_rmse_windows_calibrated"] == {
        "seconds": stage.window_seconds,
        "theta": 10.0,
        "alpha": 10.0,
    }
    assert found["test_rmse"]["theta"] == 2.0 and found["test_rmse_windows"]["theta"] == 20.0
    assert found["test_rmse_calibrated"]["theta"] == 3.0
    assert found["test_rmse_windows_calibrated"]["theta"] == 30.0
    json.dumps(found)


def test_an_effect_with_a_rival_or_a_reason_is_provisional():
    first = two_rounds().rounds[0]
    alone = dataclasses.replace(first, equivalent=(), doubts=())
    assert alone.status == alone.to_dict()["status"] == "established" and alone.doubt == ""
    rival = dataclasses.replace(alone, equivalent=(("dahl", "hub"),))
    assert rival.status == "provisional" and "Dahl friction" in rival.doubt
    elsewhere = dataclasses.replace(alone, equivalent=(("dahl", "joint"),))
    assert elsewhere.status == "provisional" and "Dahl friction at the joint" in elsewhere.doubt
    reason = dataclasses.replace(alone, doubts=("free runs are no better with it",))
    assert reason.to_dict()["status"] == "provisional" and reason.to_dict()["doubt"] == reason.doubts[0]


@pytest.mark.parametrize("field", ["prediction", "free_run"])
def test_gains_at_both_horizons_are_in_the_evidence(field: str):
    first = two_rounds().rounds[0]
    gained = dataclasses.replace(first, **{field: HorizonGain(12.0, 3.0, 0.5, 7.0)})
    evidence = {"gain": 12.0, "z": 3.0, "error_ratio": 0.5, "training_gain": 7.0}
    assert gained.to_dict()["evidence"][field] == evidence
