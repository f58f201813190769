"""Each limit of a decision from both sides, as a number: one that is moved fails here."""

import dataclasses

import numpy as np
import pytest
from test_decide import ARM, BASE, BLOCKS, COULOMB, DATA, FAR, NOISE, STRIBECK, at_both, trial

from rotflex_jax.discover.result import HorizonGain
from rotflex_jax.discover.selection import (
    admissible,
    best_window_rmse,
    choose,
    describe,
    distinguished,
    helps,
    horizon_gains,
    runs_clearly_better,
    shares_of_gain,
)

# What decides about a limit is so far from it, as a share of it.
ASIDE = 2e-3
SIDES = pytest.mark.parametrize("side", [1 - ASIDE, 1 + ASIDE], ids=["below", "above"])
PLENTY = {"held_out": 2000.0, "train": 2000.0, "windows": 5.0}


def scatter_for(z: float, nats: float) -> float:
    """Deviation of the lead of a block (without its degree of freedom) with which a lead has this z."""
    return nats / z / np.sqrt(BLOCKS) * np.sqrt((BLOCKS - 1) / BLOCKS)


def admitted(base=BASE, numbers: int = 1, **changes: float) -> bool:
    return admissible(trial(COULOMB, **PLENTY | changes, numbers=numbers), base, DATA, NOISE)


@SIDES
def test_five_nats_on_validation_data(side: float) -> None:
    assert admitted(held_out=5.0 * side) is (side > 1)


@SIDES
def test_a_validation_lead_of_one_and_a_half_deviations(side: float) -> None:
    assert admitted(held_out=20.0, scatter=scatter_for(1.5 * side, 20.0)) is (side > 1)


@SIDES
@pytest.mark.parametrize("numbers", [1, 4])
def test_eight_nats_in_training_after_half_a_log_n_for_each_number(side: float, numbers: int) -> None:
    # 3000 samples of two channels.
    assert admitted(train=(8.0 + 0.5 * numbers * np.log(6000)) * side, numbers=numbers) is (side > 1)


@SIDES
def test_a_training_lead_of_two_deviations(side: float) -> None:
    assert admitted(train=50.0, scatter=scatter_for(2.0 * side, 50.0)) is (side > 1)


@SIDES
def test_far_from_the_noise_the_error_falls_by_a_hundredth(side: float) -> None:
    assert admitted(windows=10.0 * np.exp(-0.01 * side)) is (side > 1)


@SIDES
def test_near_the_noise_it_rises_by_two_hundredths_at_most(side: float) -> None:
    assert admitted(trial(None, windows=1.1), windows=1.1 * np.exp(0.02 * side)) is (side < 1)


@SIDES
def test_near_is_twice_the_noise(side: float) -> None:
    base = trial(None, windows=2.0 * side)
    assert admitted(base, windows=2.0 * side) is (side < 1)


def of_free_runs(windows: float = 5.0, z: float = 50.0, train_z: float = 50.0):
    """A candidate that predictions do not want, with free runs of this certainty."""
    runs = {"windows": windows, "held_out": 50.0, "train": 50.0}
    found = at_both({"windows": 10.0}, runs, COULOMB)
    pattern = np.random.default_rng(7).normal(size=BLOCKS)
    pattern = (pattern - pattern.mean()) / pattern.std()
    before = FAR.free_run
    blocks = before.blocks + 50.0 / BLOCKS + scatter_for(z, 50.0) * pattern
    trained = before.hypothesis.blocks + 50.0 / BLOCKS + scatter_for(train_z, 50.0) * pattern
    hypothesis = dataclasses.replace(found.free_run.hypothesis, blocks=trained)
    return dataclasses.replace(
        found, free_run=dataclasses.replace(found.free_run, blocks=blocks, hypothesis=hypothesis)
    )


@SIDES
@pytest.mark.parametrize("which", ["z", "train_z"])
def test_free_runs_alone_are_two_and_a_half_deviations_sure(side: float, which: str) -> None:
    assert admissible(of_free_runs(**{which: 2.5 * side}), FAR, DATA, NOISE) is (side > 1)


@SIDES
def test_free_runs_alone_fall_by_a_tenth(side: float) -> None:
    assert admissible(of_free_runs(windows=10.0 * np.exp(-0.1 * side)), FAR, DATA, NOISE) is (side > 1)


@SIDES
def test_two_effects_are_two_deviations_apart(side: float) -> None:
    """Both sides together are 240 blocks of the same pattern."""
    lead, n = 40.0, 2 * BLOCKS
    s = 2 * lead / (2.0 * side) / np.sqrt(n) * np.sqrt((n - 1) / n)
    a = trial(COULOMB, held_out=200.0 + lead, train=200.0 + lead, windows=5.0, scatter=s)
    b = trial(ARM, held_out=200.0, train=200.0, windows=5.0)
    assert distinguished(a, b) is (side > 1)


@SIDES
def test_or_their_free_runs_are_a_tenth_apart(side: float) -> None:
    a, b = (trial(p, 200.0, 200.0, w) for p, w in ((COULOMB, 5.0), (ARM, 5.0 * np.exp(0.1 * side))))
    assert distinguished(a, b) is (side > 1)


def richer_wins(**changes: float) -> bool:
    """Whether Stribeck friction is taken beside the Coulomb friction that it contains."""
    given = {"held_out": 100.0, "train": 100.0, "windows": 5.0, "scatter": 0.0} | changes
    plain = trial(COULOMB, held_out=2000.0, train=2000.0, windows=5.0)
    lead = {"held_out": 2000.0 + given["held_out"], "train": 2000.0 + given["train"]}
    rich = trial(STRIBECK, **lead, windows=given["windows"], scatter=given["scatter"], numbers=3)
    return choose([plain, rich], BASE, DATA, NOISE)[0] is rich


@SIDES
@pytest.mark.parametrize(("what", "limit"), [("held_out", 10.0), ("train", 20.0)])
def test_the_richer_effect_gains_so_many_nats(side: float, what: str, limit: float) -> None:
    assert richer_wins(**{what: limit * side}) is (side > 1)


@SIDES
def test_the_richer_effect_leads_by_two_and_a_half_deviations(side: float) -> None:
    assert richer_wins(held_out=100.0, scatter=scatter_for(2.5 * side, 100.0)) is (side > 1)


@SIDES
def test_the_richer_effect_has_three_thousandths_of_the_gain(side: float) -> None:
    """Of a gain of ten thousand nats thirty count, though they are more than ten."""
    plain = trial(COULOMB, held_out=10_000.0, train=10_000.0, windows=5.0)
    more = 10_000.0 * 0.003 * side / (1 - 0.003 * side)
    rich = trial(STRIBECK, held_out=10_000.0 + more, train=10_100.0, windows=5.0, numbers=3)
    assert (choose([plain, rich], BASE, DATA, NOISE)[0] is rich) is (side > 1)


@SIDES
def test_the_richer_effect_runs_as_well_within_a_hundredth(side: float) -> None:
    assert richer_wins(windows=5.0 * np.exp(0.01 * side)) is (side < 1)


@SIDES
def test_runs_are_clearly_better_by_a_hundredth(side: float) -> None:
    a, b = 5.0 * np.exp(-0.01 * side) * NOISE, 5.0 * NOISE
    assert runs_clearly_better(a, b) is (side > 1)


def not_quite_sure(z: float, **changes: float) -> dict[str, float]:
    """Predictions whose leads on validation and on training data have this z."""
    return PLENTY | {"scatter": scatter_for(z, PLENTY["held_out"])} | changes


@SIDES
def test_uncertain_free_runs_are_enough_where_predictions_run_a_tenth_better(side: float) -> None:
    predictions = not_quite_sure(3.0, windows=10.0 * np.exp(-0.1 * side))
    found = at_both(predictions, {"windows": 10.0}, COULOMB)
    assert admissible(found, FAR, DATA, NOISE) is (side > 1)


@SIDES
def test_or_where_predictions_are_three_and_a_half_deviations_sure(side: float) -> None:
    found = at_both(not_quite_sure(3.5 * side, windows=10.0 * np.exp(-0.05)), {"windows": 10.0}, COULOMB)
    assert admissible(found, FAR, DATA, NOISE) is (side > 1)


@SIDES
def test_far_from_the_noise_a_rival_with_nine_tenths_of_the_gain_is_alike(side: float) -> None:
    """On validation and on training data together, although the likelihood distinguishes the two."""
    strong = trial(ARM, held_out=1000.0, train=1000.0, windows=5.0)
    weak = trial(COULOMB, held_out=900.0 * side, train=900.0, windows=5.0)
    assert distinguished(strong, weak)
    assert (choose([strong, weak], BASE, DATA, NOISE)[1] == [weak]) is (side > 1)


@SIDES
def test_a_horizon_helps_beyond_one_and_a_half_deviations(side: float) -> None:
    assert helps(HorizonGain(10.0, 1.5 * side, 1.0)) is (side > 1)
    assert not helps(HorizonGain(-10.0, 1.5 * side, 1.0))


def both_gains():
    """A candidate and the model before it, with leads by hand at both horizons."""
    predicts = {"held_out": 40.0, "train": 60.0, "windows": 5.0, "scatter": scatter_for(4.0, 40.0)}
    runs = {"held_out": 20.0, "train": 30.0, "windows": 2.0, "scatter": scatter_for(5.0, 20.0)}
    return at_both(predicts, runs, COULOMB), at_both({"windows": 10.0}, {"windows": 8.0})


def test_gains_at_both_horizons_are_told_with_their_certainty() -> None:
    candidate, before = both_gains()
    prediction, runs = horizon_gains(candidate, before)
    assert runs is not None
    assert prediction == pytest.approx((40.0, 4.0, 0.5, 60.0))
    assert runs == pytest.approx((20.0, 5.0, 0.25, 30.0))
    said = "coulomb at the hub: 40 nats on validation data (z 4.0), 60 on training data (z 6.0), "
    said += "free-run error 0.5 times as large"
    more = "; fitted to free runs 0.25 times (z 5.0, training 7.5)"
    assert describe(candidate, before).endswith(said.partition(": ")[2] + more)
    # Where one of the two was fitted to predictions alone, they are all there is.
    for pair in (
        (dataclasses.replace(candidate, free_run=None), before),
        (candidate, dataclasses.replace(before, free_run=None)),
    ):
        assert horizon_gains(*pair) == (prediction, None)
        assert describe(*pair).endswith(said.partition(": ")[2])


def test_shares_of_the_most_add_up_over_the_horizons() -> None:
    candidate, before = both_gains()
    half = at_both({"held_out": 20.0}, {"held_out": 15.0}, ARM)
    worse = at_both({"held_out": -9.0}, {"held_out": -9.0}, ARM)
    np.testing.assert_allclose(shares_of_gain([candidate, half, worse], before), [2.0, 0.5 + 0.75, 0.0])
    # One without free runs leaves the comparison to predictions.
    alone = dataclasses.replace(half, free_run=None)
    np.testing.assert_allclose(shares_of_gain([candidate, alone], before), [1.0, 0.5])


@SIDES
def test_parameters_of_predictions_suit_free_runs_better_by_a_hundredth(side: float) -> None:
    found = at_both({"windows": 5.0 * np.exp(-0.01 * side)}, {"windows": 5.0}, COULOMB)
    best = found if side > 1 else found.free_run
    np.testing.assert_array_equal(best_window_rmse(found), best.window_rmse)
