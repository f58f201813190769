"""Which candidate is chosen, not distinguished or refused; each limit is tested from both sides."""

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import small_problem as sp

from rotflex_jax.discover import selection, stepwise
from rotflex_jax.discover.hypothesis import Hypothesis, Whitener
from rotflex_jax.discover.likelihood import in_blocks, levenberg_marquardt
from rotflex_jax.discover.result import HorizonGain
from rotflex_jax.discover.selection import (
    admissible,
    best_window_rmse,
    better_in_place,
    choose,
    describe,
    distinguished,
    gains_in_words,
    helps,
    horizon_gains,
    paired_gain,
    runs_clearly_better,
    shares_of_gain,
)
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.validation import ValidatedHypothesis, ValidationSet, validate
from rotflex_jax.fit.dataset import StackedRecordings
from rotflex_jax.recording import Recording

# 60 s at 50 Hz: 120 blocks of 25 samples, in training and in validation data.
N, BLOCKS = 3000, 120
MEASURED = 2.0 * N  # values of two channels
NOISE = np.array([1e-3, 1e-3])
COMMON = np.random.default_rng(0).normal(size=BLOCKS) * 50


def trial(
    location, held_out=0.0, train=0.0, windows=2.0, scatter=0.0, seed=1, numbers=1
) -> ValidatedHypothesis:
    """A validated hypothesis whose blocks lead those of the base by given sums.

    Args:
        location: Effect that it adds.
        held_out: Lead over the base on validation data [nat].
        train: Lead over the base on training data [nat].
        windows: Error of short free runs, in units of the noise.
        scatter: Standard deviation of the lead of a block [nat], a multiple of a random pattern of mean zero.
        seed: Seed of the pattern.
        numbers: Number of parameters of the effect.
    """
    pattern = np.random.default_rng(seed).normal(size=BLOCKS)
    pattern = scatter * (pattern - pattern.mean()) / pattern.std()
    blocks = COMMON + held_out / BLOCKS + pattern
    trained = COMMON[::-1] + train / BLOCKS + pattern
    white, none = Whitener(np.eye(2)), np.zeros((1, 0))
    h = Hypothesis(
        (), (), (), np.zeros(0), none, none[None], np.zeros((1, 0, 2)), {}, white, trained[None], trained
    )
    return ValidatedHypothesis(h, blocks, h, windows * NOISE, location, numbers)


BASE = trial(None, windows=10.0)
COULOMB, STRIBECK, DRAG = (EffectLocation(e, "hub") for e in ("coulomb", "stribeck", "quadratic_drag"))
ARM, HARDENING = EffectLocation("coulomb", "arm"), EffectLocation("cubic_spring", "joint")


def test_a_lead_is_paired():
    """Scatter that is common to both does not count."""
    d = np.array([1.0, 2.0, 3.0, 2.0])
    common = 1000 * np.random.default_rng(3).normal(size=4)
    nats, z = paired_gain(common + d, common)
    assert nats == pytest.approx(8.0)
    assert z == pytest.approx(8.0 / (np.std(d, ddof=1) * 2))
    assert paired_gain(common, common + d)[1] == pytest.approx(-z)
    assert paired_gain(np.array([5.0]), np.array([1.0])) == (4.0, 0.0)  # one block has no scatter


def test_a_lead_of_z_two_is_rare_where_there_is_none():
    rng = np.random.default_rng(4)
    z = np.array([paired_gain(rng.normal(size=40), rng.normal(size=40))[1] for _ in range(2000)])
    assert np.mean(z > 2) == pytest.approx(0.026, abs=0.012)  # Student's t, 39 degrees of freedom


def test_blocks_of_half_a_second():
    """A remainder joins the last block; blocks leave out unseen samples and do not cross recordings."""
    seen = np.zeros((2, 130))
    seen[0, :130], seen[1, :99] = 1, 1
    data = StackedRecordings(seen, np.zeros((2, 130, 2)), seen, np.array([0.01, 0.02]))
    density = np.arange(260.0).reshape(2, 130)
    first, second = density
    expected = [first[:50].sum(), first[50:130].sum()]  # 50 samples are half a second
    expected += [second[:25].sum(), second[25:50].sum(), second[50:99].sum()]
    np.testing.assert_allclose(in_blocks(density, data), expected)


GOOD = {"held_out": 200.0, "train": 200.0, "windows": 5.0, "scatter": 0.5}


def at_both(prediction: dict, free_run: dict, location=None) -> ValidatedHypothesis:
    """A hypothesis with leads at both horizons; leads of free runs are logarithms of error ratios."""
    return dataclasses.replace(trial(location, **prediction), free_run=trial(location, **free_run))


NOTHING, FAR = {"windows": 10.0}, at_both({"windows": 10.0}, {"windows": 10.0})
STRONG = {"held_out": 40.0, "train": 40.0, "windows": 5.0, "scatter": 0.3}


def test_free_runs_alone_may_ask_for_an_effect():
    """A predictor that follows the data within a few samples is insensitive to slow effects."""
    assert admissible(at_both(NOTHING, STRONG, COULOMB), FAR, MEASURED, NOISE)
    assert not admissible(at_both(NOTHING, NOTHING, COULOMB), FAR, MEASURED, NOISE)
    # The gain must be certain on training and validation data, and the error must fall by a tenth.
    for spoilt in ({"scatter": 4.0}, {"train": 0.0}, {"windows": 9.5}):
        assert not admissible(at_both(NOTHING, STRONG | spoilt, COULOMB), FAR, MEASURED, NOISE), spoilt
    # Near the sensor noise predictions have more power, and free runs alone do not count.
    near = at_both({"windows": 1.1}, {"windows": 1.1})
    assert not admissible(
        at_both({"windows": 1.1}, STRONG | {"windows": 0.9}, COULOMB), near, MEASURED, NOISE
    )


@pytest.mark.parametrize(
    ("spoilt", "apart"),
    [
        ({}, True),
        ({"train": 41.0}, False),
        ({"held_out": 41.0}, False),
        ({"windows": 5.0 * 1.11}, True),
        ({"windows": 5.0 * 1.09}, False),
    ],
)
def test_free_runs_that_training_data_see_the_other_way_round_distinguish_nothing(spoilt: dict, apart: bool):
    """A rival with a larger validation error is excluded, unless blocks of either data set prefer it."""
    winner = at_both(NOTHING, STRONG, COULOMB)
    rival = at_both(NOTHING, STRONG | {"held_out": 39.0, "train": 39.0, "windows": 6.0} | spoilt, DRAG)
    assert selection.free_runs_apart(winner, rival) == apart


def test_parameters_of_predictions_need_not_suit_free_runs():
    """Free runs with the parameters of predictions may be worse, if those fitted to free runs are better."""
    worse = GOOD | {"windows": 12.0}
    assert not admissible(at_both(worse, NOTHING, COULOMB), FAR, MEASURED, NOISE)
    assert admissible(at_both(worse, STRONG, COULOMB), FAR, MEASURED, NOISE)


def test_what_both_horizons_want_wins():
    """A candidate that is near the best at both horizons wins over the best at one horizon."""
    predicts = at_both(GOOD | {"held_out": 400.0}, STRONG | {"held_out": 10.0}, ARM)
    both = at_both(GOOD | {"held_out": 300.0}, STRONG | {"held_out": 38.0}, COULOMB)
    runs = at_both(GOOD | {"held_out": 20.0}, STRONG, DRAG)
    assert choose([predicts, both, runs], FAR, MEASURED, NOISE)[0] is both


@pytest.mark.parametrize(
    "spoilt",
    [
        {"held_out": selection.HELD_OUT_NATS - 1, "scatter": 0.0},
        {"held_out": -50.0},
        {"held_out": 20.0, "scatter": 20.0 / selection.HELD_OUT_Z / np.sqrt(BLOCKS) * 1.1},
        {"train": selection.TRAIN_NATS + 0.5 * np.log(2 * N) - 1, "scatter": 0.0},
        {"train": 20.0, "held_out": 2000.0, "scatter": 20.0 / selection.TRAIN_Z / np.sqrt(BLOCKS) * 1.1},
        {"numbers": 60},
        {"windows": 10.0 * np.exp(0.05)},
        {"windows": 10.0},
    ],
    ids=[
        "too little held out",
        "worse held out",
        "held-out lead within its scatter",
        "too little in training",
        "training lead within its scatter",
        "too many numbers",
        "free runs worse",
        "free runs no better",
    ],
)
def test_one_doubt_is_enough_to_refuse(spoilt):
    assert admissible(trial(COULOMB, **GOOD), BASE, MEASURED, NOISE)
    assert not admissible(trial(COULOMB, **GOOD | spoilt), BASE, MEASURED, NOISE)


def test_near_the_noise_free_runs_need_not_get_better():
    near = trial(None, windows=1.1)
    same = {**GOOD, "windows": 1.1 * np.exp(0.5 * selection.WINDOWS_WORSE)}
    assert admissible(trial(COULOMB, **same), near, MEASURED, NOISE)
    worse = {**GOOD, "windows": 1.1 * np.exp(2 * selection.WINDOWS_WORSE)}
    assert not admissible(trial(COULOMB, **worse), near, MEASURED, NOISE)


def test_the_likeliest_on_held_out_data_wins():
    best = trial(DRAG, **GOOD | {"held_out": 400.0, "train": 300.0})
    # A larger gain on training data does not count.
    other = trial(EffectLocation("quadratic_drag", "arm"), **GOOD | {"train": 900.0}, seed=2)
    assert choose([other, best], BASE, MEASURED, NOISE)[0] is best
    assert choose([trial(ARM, held_out=-1.0)], BASE, MEASURED, NOISE) == (None, [])
    assert choose([], BASE, MEASURED, NOISE) == (None, [])


def test_what_cannot_be_told_apart_is_named_together():
    """Two candidates are reported together if their difference is within its scatter over the blocks."""
    best = trial(DRAG, **GOOD | {"held_out": 210.0, "train": 210.0}, seed=1)
    close = trial(HARDENING, **GOOD | {"held_out": 200.0, "train": 200.0, "scatter": 3.0}, seed=2)
    assert paired_gain(best.blocks, close.blocks)[0] == pytest.approx(10.0)
    far = trial(EffectLocation("gravity", "arm"), **GOOD | {"held_out": 100.0, "train": 100.0}, seed=3)
    refused = trial(EffectLocation("dead_zone", "input"), **GOOD | {"train": 0.0}, seed=4)
    winner, rivals = choose([far, close, refused, best], BASE, MEASURED, NOISE)
    assert winner is best and rivals == [close]
    # The same difference without scatter distinguishes them, if both leave little more than noise.
    near = GOOD | {"windows": 1.5}
    best = trial(DRAG, **near | {"held_out": 210.0, "train": 210.0}, seed=1)
    steady = trial(HARDENING, **near | {"held_out": 200.0, "train": 200.0}, seed=1)
    assert choose([steady, best], BASE, MEASURED, NOISE) == (best, [])


def test_of_what_cannot_be_told_apart_dry_friction_goes_first():
    """It is chosen even if it does not lead and has more parameters."""
    drag = trial(DRAG, **GOOD | {"held_out": 210.0, "train": 210.0}, seed=1)
    close = GOOD | {"held_out": 200.0, "train": 200.0, "scatter": 3.0}
    friction = trial(ARM, **close, seed=2, numbers=4)
    assert choose([drag, friction], BASE, MEASURED, NOISE) == (friction, [drag])
    # If its free runs with the parameters of predictions are a tenth worse, it may imitate another effect.
    for share, first in ((0.99, True), (1.01, False)):
        windows = 5.0 * np.exp(share * selection.WINDOWS_APART)
        slower = trial(ARM, **close | {"windows": windows}, seed=2)
        assert (choose([drag, slower], BASE, MEASURED, NOISE)[0] is slower) is first
    # Parameters fitted to free runs, whose runs are as good as those with the drag, do not help.
    near, runs = {"windows": 1.5}, STRONG | {"windows": 1.5}
    drag = at_both(GOOD | {"held_out": 210.0, "train": 210.0} | near, runs, DRAG)
    for share, first in ((0.99, True), (1.01, False)):
        windows = 1.5 * np.exp(share * selection.WINDOWS_APART)
        slower = at_both(close | {"windows": windows}, runs, ARM)
        assert (choose([drag, slower], FAR, MEASURED, NOISE)[0] is slower) is first


def dead_zone_before_friction(
    share: float = 0.8, z: float = 0.0, worse: float = 1.0
) -> list[ValidatedHypothesis]:
    """A dead zone that predictions prefer, and Coulomb friction; both stop the machine for a while.

    Args:
        share: Gain of friction in predictions as a share of the gain of the dead zone.
        z: Standard deviations by which free runs prefer the dead zone.
        worse: Errors of free runs with friction over those with the dead zone.
    """
    runs = {"held_out": 50.0, "train": 50.0, "windows": 4.0 * worse}
    ahead = {"held_out": 60.0, "train": 60.0, "windows": 4.0, "scatter": scatter_for(z, 10.0) if z else 0.0}
    gain = {"held_out": 1000.0, "train": 1000.0, "windows": 5.0}
    less = {"held_out": 1000.0 * share, "train": 1000.0 * share, "windows": 8.0}
    leading = at_both(gain, ahead if z else runs | {"windows": 4.0}, EffectLocation("dead_zone", "input"))
    return [leading, at_both(less, runs, COULOMB)]


@pytest.mark.parametrize(
    ("changes", "first"),
    [
        ({"share": 0.75 * 1.002}, "coulomb"),
        ({"share": 0.75 * 0.998}, "dead_zone"),
        ({"z": 1.99}, "coulomb"),
        ({"z": 2.01}, "dead_zone"),
        ({"z": 1.0, "worse": np.exp(0.099)}, "coulomb"),
        ({"z": 1.0, "worse": np.exp(0.101)}, "dead_zone"),
    ],
)
def test_in_a_poor_model_dry_friction_comes_before_what_free_runs_do_not_prefer(
    changes: dict[str, float], first: str
) -> None:
    both = dead_zone_before_friction(**changes)
    winner, rivals = choose(both, FAR, MEASURED, NOISE)
    assert winner.location.effect == first
    # What predictions prefer is reported beside friction.
    assert rivals == (both[:1] if first == "coulomb" else [])


def test_near_the_noise_predictions_decide_between_dry_friction_and_another_effect() -> None:
    leading, friction = (
        dataclasses.replace(
            v, window_rmse=1.5 * NOISE, free_run=dataclasses.replace(v.free_run, window_rmse=NOISE)
        )
        for v in dead_zone_before_friction()
    )
    assert choose([leading, friction], FAR, MEASURED, NOISE) == (leading, [])


def test_a_rival_need_not_pass_what_the_winner_passed():
    """A candidate that just fails is reported beside the winner if the two are not distinguished."""
    best = trial(DRAG, **GOOD | {"held_out": 30.0, "train": 30.0, "scatter": 1.0}, seed=1)
    missed = trial(ARM, **GOOD | {"held_out": 4.0, "train": 25.0, "scatter": 1.0}, seed=2)
    assert not admissible(missed, BASE, MEASURED, NOISE)
    assert choose([missed, best], BASE, MEASURED, NOISE) == (best, [missed])
    # A candidate that gains nothing is no rival, nor one whose free runs are clearly worse.
    assert choose([trial(ARM, held_out=-4.0, train=25.0, scatter=1.0), best], BASE, MEASURED, NOISE)[1] == []
    far = trial(ARM, **GOOD | {"held_out": 4.0, "train": 25.0, "scatter": 1.0, "windows": 5.0 * 1.2}, seed=2)
    assert choose([far, best], BASE, MEASURED, NOISE) == (best, [])


def test_both_sides_tell_apart():
    """Blocks of training and validation data together distinguish what validation data alone do not."""
    best = trial(DRAG, **GOOD | {"held_out": 201.0, "train": 400.0, "scatter": 1.0})
    close = trial(ARM, **GOOD | {"scatter": 1.0}, seed=2)
    assert paired_gain(best.blocks, close.blocks)[1] < selection.SEPARATE_Z
    assert distinguished(best, close)
    same = trial(DRAG, **GOOD | {"held_out": 201.0, "scatter": 1.0})
    assert not distinguished(same, close)


def test_the_simpler_effect_wins_unless_the_richer_earns_it():
    """Stribeck friction contains Coulomb friction."""
    plain = trial(COULOMB, **GOOD, seed=1)
    little = trial(STRIBECK, **GOOD | {"held_out": 206.0, "train": 206.0}, seed=1, numbers=3)
    winner, rivals = choose([little, plain], BASE, MEASURED, NOISE)
    assert winner is plain and rivals == []  # the richer effect is no rival of the simpler one
    much = trial(STRIBECK, **GOOD | {"held_out": 300.0, "train": 300.0}, seed=1, numbers=3)
    winner, rivals = choose([plain, much], BASE, MEASURED, NOISE)
    assert winner is much and rivals == []
    # At another port it is no special case: with as many parameters, the larger gain wins.
    elsewhere = trial(ARM, **GOOD, seed=1, numbers=3)
    assert choose([elsewhere, little], BASE, MEASURED, NOISE)[0] is little
    # If the simpler one is refused, the richer one wins.
    weak = trial(COULOMB, **GOOD | {"windows": 11.0}, seed=1)
    assert choose([weak, little], BASE, MEASURED, NOISE)[0] is little


# -- held-out recordings --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sides():
    """Training data, fitted baseline, and validation data of the same machine with other inputs."""
    train = sp.problem(sp.recordings(sp.records(0.0)))
    unseen = sp.recordings(sp.records(0.0, (31, 32)))
    validation = ValidationSet(sp.problem(unseen), 0.8)
    h = sp.fitted(train)
    return train, h, validation


def test_held_out_likelihood_of_the_truth(sides):
    train, h, validation = sides
    found = validate(validation, h)
    assert found.blocks.shape == (6,)  # 1.6 s each: three blocks, the rest in the last
    # The log-likelihood per sample agrees with that of the training data.
    promised = h.log_likelihood / np.sum(train.seen)
    per_sample = found.log_likelihood / np.sum(validation.problem.seen)
    assert per_sample == pytest.approx(promised, abs=0.2)
    # Physical parameters are kept, offsets and first states are fitted for each recording.
    np.testing.assert_array_equal(found.adapted.z, h.z)
    assert found.adapted.whitener is h.whitener
    bias = validation.problem.supermodel.parameter_indices(EffectLocation("voltage_offset", "input"))[0]
    offsets = found.adapted.values(validation.problem.supermodel)[:, bias]
    np.testing.assert_allclose(offsets, [0.02, -0.02], atol=0.01)
    np.testing.assert_allclose(found.window_rmse, sp.NOISE, rtol=0.6)


def test_wrong_physics_is_less_likely_on_held_out_data(sides):
    _, h, validation = sides
    i = validation.problem.supermodel.mechanism.parameter_names.index("joint.spring.stiffness")
    z = h.z.copy()
    z[i] += np.log(1.05)
    wrong = validate(validation, dataclasses.replace(h, z=z))
    right = validate(validation, h)
    nats, z_score = paired_gain(right.blocks, wrong.blocks)
    assert nats > 100 and z_score > 2
    assert (wrong.window_rmse > right.window_rmse).all()


def test_friction_that_is_there_is_admitted_and_friction_that_is_not_is_refused(sides):
    for level, expected in ((0.02, True), (0.0, False)):
        train = sp.problem(sp.recordings(sp.records(level)))
        unseen = sp.recordings(sp.records(level, (31, 32)))
        validation = ValidationSet(sp.problem(unseen), 0.8)
        h = sp.fitted(train)
        i = train.supermodel.parameter_indices(sp.HUB)[0]
        z = h.z.copy()
        z[i] = np.log(0.005)
        more = dataclasses.replace(h, locations=(*h.locations, sp.HUB), free=(*h.free, i), z=z)
        more = levenberg_marquardt(train, [more])[0]
        added = dataclasses.replace(validate(validation, more), location=sp.HUB, parameter_count=1)
        assert admissible(added, validate(validation, h), train.measured_values, sp.NOISE) is expected


def test_errors_of_windows_leave_out_what_a_model_has_seen(sides):
    _, _, validation = sides
    runs = []
    for r in validation.problem.dataset.recordings:
        run = r.y.copy()
        in_window = np.arange(r.N) % 320
        run[in_window < r.n_init] += 7.0  # used for the first state: does not count
        run[in_window >= r.n_init] += [0.03, -0.04]
        runs.append(run)
    assert all(isinstance(r, Recording) and r.N == 640 for r in validation.problem.dataset.recordings)
    np.testing.assert_allclose(validation.window_rmse(runs), [0.03, 0.04])
    runs[1][400:, 1] = np.nan
    np.testing.assert_array_equal(validation.window_rmse(runs)[1], np.inf)


def test_runs_that_diverge_are_worse_than_all_others() -> None:
    """A candidate whose free runs diverge is refused, whatever gains its blocks have."""
    gained = {"held_out": 100.0, "train": 100.0}
    diverged = dataclasses.replace(of_free_runs(windows=np.inf), parameter_count=9)
    steady = at_both({"windows": 5.0}, {"windows": 5.0}, DAHL)
    assert not admissible(diverged, FAR, MEASURED, NOISE)
    assert not better_in_place(diverged, steady, MEASURED)
    for prediction, free_run in ((np.inf, 5.0), (5.0, np.inf)):
        half = at_both(gained | {"windows": prediction}, gained | {"windows": free_run}, COULOMB)
        assert best_window_rmse(half) == pytest.approx(5.0 * NOISE)
    both = at_both(gained | {"windows": np.inf}, gained | {"windows": np.inf}, COULOMB)
    assert not admissible(both, FAR, MEASURED, NOISE)
    assert not runs_clearly_better(both.window_rmse, both.window_rmse)
    assert runs_clearly_better(steady.window_rmse, both.window_rmse)
    assert "free runs diverge; fitted to free runs: free runs diverge" in describe(both, FAR)


def test_of_two_that_nothing_distinguishes_the_one_with_fewer_parameters_leads():
    close = {"train": 200.0, "windows": 5.0, "scatter": 3.0}
    many = trial(ARM, held_out=210.0, **close, seed=2, numbers=2)
    few = trial(COULOMB, held_out=200.0, **close, numbers=1)
    assert not distinguished(many, few)
    winner, rivals = choose([many, few], BASE, MEASURED, NOISE)
    assert winner is few and rivals == [many]
    # With equal numbers the larger gain wins. If distinguished, the better one wins with any number.
    assert choose([many, dataclasses.replace(few, parameter_count=2)], BASE, MEASURED, NOISE)[0] is many
    better = trial(ARM, held_out=400.0, train=400.0, windows=5.0, scatter=3.0, seed=2, numbers=2)
    assert distinguished(better, few) and choose([better, few], BASE, MEASURED, NOISE) == (better, [])


@pytest.mark.parametrize(
    ("share", "windows", "alike"), [(0.95, 5.0, True), (0.8, 5.0, False), (0.95, 1.5, False)]
)
def test_a_model_that_leaves_much_does_not_distinguish_effects_that_gain_nearly_the_same(
    share, windows, alike
):
    """A certain lead counts only if it is a large share of the gain, or if errors are near the noise."""
    strong = trial(ARM, held_out=1000.0, train=1000.0, windows=windows)
    weak = trial(COULOMB, held_out=1000.0 * share, train=1000.0 * share, windows=windows)
    assert distinguished(strong, weak)
    assert choose([strong, weak], BASE, MEASURED, NOISE) == (strong, [weak] if alike else [])
    few = dataclasses.replace(strong, parameter_count=2), weak
    assert choose([*few], BASE, MEASURED, NOISE)[0] is few[alike]


# Distance of the tested value from its limit, as a share of the limit.
ASIDE = 2e-3
SIDES = pytest.mark.parametrize("side", [1 - ASIDE, 1 + ASIDE], ids=["below", "above"])
PLENTY = {"held_out": 2000.0, "train": 2000.0, "windows": 5.0}


def scatter_for(z: float, nats: float) -> float:
    """Standard deviation of the lead of a block (divided by N) for which a lead of `nats` has this z."""
    return nats / z / np.sqrt(BLOCKS) * np.sqrt((BLOCKS - 1) / BLOCKS)


def admitted(base=BASE, numbers: int = 1, **changes: float) -> bool:
    return admissible(trial(COULOMB, **PLENTY | changes, numbers=numbers), base, MEASURED, NOISE)


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
    """A candidate without a gain in predictions, whose free runs lead with these values of z."""
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
    assert admissible(of_free_runs(**{which: 2.5 * side}), FAR, MEASURED, NOISE) is (side > 1)


@SIDES
def test_where_validation_data_rest_training_data_decide_on_dry_friction(side: float) -> None:
    """Free runs of training data must be five deviations sure, those of validation data need only agree."""

    def passes(found: ValidatedHypothesis, still: bool = True) -> bool:
        return admissible(found, FAR, MEASURED, NOISE, still)

    unsure = of_free_runs(z=0.5, train_z=5.0 * side)
    assert passes(unsure) is (side > 1) and not passes(unsure, still=False)
    assert passes(of_free_runs(windows=10.0 * np.exp(-0.1 * side), z=0.5)) is (side > 1)
    opposed = of_free_runs(z=0.5)
    blocks = opposed.free_run.blocks - (50.0 + side - 1.0) / BLOCKS
    opposed = dataclasses.replace(opposed, free_run=dataclasses.replace(opposed.free_run, blocks=blocks))
    assert passes(opposed) is (side < 1)
    # Not every machine has another effect, and near the noise predictions decide.
    drag = dataclasses.replace(of_free_runs(z=0.5), location=DRAG)
    assert not passes(drag)
    near = at_both({"windows": 1.1}, {"windows": 1.1})
    assert not admissible(of_free_runs(windows=0.9, z=0.5), near, MEASURED, NOISE, True)


@SIDES
def test_free_runs_alone_fall_by_a_tenth(side: float) -> None:
    assert admissible(of_free_runs(windows=10.0 * np.exp(-0.1 * side)), FAR, MEASURED, NOISE) is (side > 1)


@SIDES
def test_two_effects_are_two_deviations_apart(side: float) -> None:
    """Training and validation data together are 240 blocks of the same pattern."""
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
    """Whether Stribeck friction is chosen over the Coulomb friction that it contains."""
    given = {"held_out": 100.0, "train": 100.0, "windows": 5.0, "scatter": 0.0} | changes
    plain = trial(COULOMB, held_out=2000.0, train=2000.0, windows=5.0)
    lead = {"held_out": 2000.0 + given["held_out"], "train": 2000.0 + given["train"]}
    rich = trial(STRIBECK, **lead, windows=given["windows"], scatter=given["scatter"], numbers=3)
    return choose([plain, rich], BASE, MEASURED, NOISE)[0] is rich


@SIDES
@pytest.mark.parametrize(("what", "limit"), [("held_out", 10.0), ("train", 20.0)])
def test_the_richer_effect_gains_so_many_nats(side: float, what: str, limit: float) -> None:
    assert richer_wins(**{what: limit * side}) is (side > 1)


@SIDES
def test_the_richer_effect_leads_by_two_deviations_of_all_blocks(side: float) -> None:
    """Training and validation data together are 240 blocks of the same pattern."""
    n = 2 * BLOCKS
    scatter = 200.0 / (2.0 * side) / np.sqrt(n) * np.sqrt((n - 1) / n)
    assert richer_wins(held_out=100.0, train=100.0, scatter=scatter) is (side > 1)


@SIDES
def test_the_richer_effect_has_three_thousandths_of_the_gain(side: float) -> None:
    """With a gain of 10 000 nats the limit is 30 nats, above the general limit of 10 nats."""
    plain = trial(COULOMB, held_out=10_000.0, train=10_000.0, windows=5.0)
    more = 10_000.0 * 0.003 * side / (1 - 0.003 * side)
    rich = trial(STRIBECK, held_out=10_000.0 + more, train=10_100.0, windows=5.0, numbers=3)
    assert (choose([plain, rich], BASE, MEASURED, NOISE)[0] is rich) is (side > 1)


@SIDES
def test_the_richer_effect_runs_as_well_within_a_hundredth(side: float) -> None:
    assert richer_wins(windows=5.0 * np.exp(0.01 * side)) is (side < 1)


def richer_wins_by_runs(
    validation: float = -0.5,
    training: float = 6.0,
    runs: float = 2.0,
    error: float = 0.12,
    gain: float = 300.0,
    left: float = 5.0,
    lead: float = 400.0,
) -> bool:
    """Whether Stribeck friction, which predictions of validation data do not prefer, is chosen.

    Args:
        validation: Standard deviations by which predictions of validation data prefer it to Coulomb friction.
        training: The same for predictions of training data.
        runs: The same for free runs, of training and of validation data each.
        error: Logarithm by which its free runs have smaller errors.
        gain: Gain of predictions of training data [nat].
        left: Error that Coulomb friction leaves, in units of the noise.
        lead: Sum by which the blocks of its free runs are better.
    """
    lost, scatter = gain * validation / training, scatter_for(training, gain)
    before = {"held_out": 2000.0, "train": 2000.0, "windows": left}
    predictions = {"held_out": 2000.0 + lost, "train": 2000.0 + gain, "scatter": scatter}
    free_runs = {"held_out": 2000.0 + lead, "train": 2000.0 + lead, "scatter": scatter_for(runs, lead)}
    windows = {"windows": left * np.exp(-error)}
    plain = at_both(before, before, COULOMB)
    rich = at_both(predictions | windows, free_runs | windows, STRIBECK)
    rich = dataclasses.replace(rich, parameter_count=3)
    return choose([plain, rich], FAR, MEASURED, NOISE)[0] is rich


@SIDES
@pytest.mark.parametrize("what", ["validation", "runs", "error", "gain", "left"])
def test_a_richer_effect_may_be_preferred_by_all_but_validation_predictions(side: float, what: str) -> None:
    """Two laws of friction may differ by less than the scatter in predictions of a short validation run."""
    penalty = 8.0 + 0.5 * 2 * np.log(MEASURED)
    limits = {"runs": 1.5, "error": 0.1, "gain": penalty, "left": 2.0}
    value = -1.5 / side if what == "validation" else limits[what] * side
    assert richer_wins_by_runs(**{what: value}) is (side > 1)


def test_predictions_of_all_data_must_then_prefer_the_richer_effect() -> None:
    """With the same scatter in both data, the lead is about (training + validation) / sqrt 2."""
    assert not richer_wins_by_runs(validation=-0.5, training=3.0)
    assert richer_wins_by_runs(validation=-0.5, training=3.7)


def test_the_richer_effect_need_not_lead_on_validation_data() -> None:
    """Its free runs gain less there than its predictions lose, so Coulomb friction leads."""
    lost = 0.5 / 6.0 * 300.0
    assert richer_wins_by_runs(lead=0.5 * lost)
    assert not richer_wins_by_runs(lead=0.5 * lost, error=0.08)


@pytest.mark.parametrize("able", [False, True])
def test_this_needs_a_fit_to_free_runs(able: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stribeck friction leads on validation data by less than the 10 nats that it needs without free runs."""
    if able:  # the same with a rule that asks for no free runs
        monkeypatch.setattr(selection, "_free_runs_prefer", lambda a, b, least: least < 2)
    plain = trial(COULOMB, held_out=2000.0, train=2000.0, windows=5.0)
    rich = trial(STRIBECK, held_out=2005.0, train=2300.0, windows=4.0, scatter=1.0, numbers=3)
    assert (choose([plain, rich], BASE, MEASURED, NOISE)[0] is rich) is able


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
    assert admissible(found, FAR, MEASURED, NOISE) is (side > 1)


@SIDES
def test_or_where_predictions_are_three_and_a_half_deviations_sure(side: float) -> None:
    found = at_both(not_quite_sure(3.5 * side, windows=10.0 * np.exp(-0.05)), {"windows": 10.0}, COULOMB)
    assert admissible(found, FAR, MEASURED, NOISE) is (side > 1)


@SIDES
def test_far_from_the_noise_a_rival_with_nine_tenths_of_the_gain_is_alike(side: float) -> None:
    """Gains on validation and training data are added; the likelihood distinguishes the two."""
    strong = trial(ARM, held_out=1000.0, train=1000.0, windows=5.0)
    weak = trial(COULOMB, held_out=900.0 * side, train=900.0, windows=5.0)
    assert distinguished(strong, weak)
    assert (choose([strong, weak], BASE, MEASURED, NOISE)[1] == [weak]) is (side > 1)


@SIDES
def test_a_horizon_helps_beyond_one_and_a_half_deviations(side: float) -> None:
    assert helps(HorizonGain(10.0, 1.5 * side, 1.0)) is (side > 1)
    assert not helps(HorizonGain(-10.0, 1.5 * side, 1.0))


def both_gains():
    """A candidate and the model before it, with given leads at both horizons."""
    predicts = {"held_out": 40.0, "train": 60.0, "windows": 5.0, "scatter": scatter_for(4.0, 40.0)}
    runs = {"held_out": 20.0, "train": 30.0, "windows": 2.0, "scatter": scatter_for(5.0, 20.0)}
    return at_both(predicts, runs, COULOMB), at_both({"windows": 10.0}, {"windows": 8.0})


def test_gains_at_both_horizons_are_told_with_their_certainty() -> None:
    candidate, before = both_gains()
    prediction, runs = horizon_gains(candidate, before)
    assert runs is not None
    assert prediction == pytest.approx((40.0, 4.0, 0.5, 60.0))
    assert runs == pytest.approx((20.0, 5.0, 0.25, 30.0))
    said = "log-likelihood of validation data +40 nat (z 4.0), of training data +60 nat (z 6.0), "
    said += "free-run error 0.5 times as large"
    more = "; fitted to free runs: free-run error 0.25 times as large (z 5.0, of training data 7.5)"
    assert gains_in_words(candidate, before) == said + more
    assert describe(candidate, before) == f"coulomb at hub: {said}{more}"
    # If one of the two was fitted to predictions alone, only predictions are reported.
    for pair in (
        (dataclasses.replace(candidate, free_run=None), before),
        (candidate, dataclasses.replace(before, free_run=None)),
    ):
        assert horizon_gains(*pair) == (prediction, None)
        assert gains_in_words(*pair) == said


def test_shares_of_the_most_add_up_over_the_horizons() -> None:
    candidate, before = both_gains()
    half = at_both({"held_out": 20.0}, {"held_out": 15.0}, ARM)
    worse = at_both({"held_out": -9.0}, {"held_out": -9.0}, ARM)
    np.testing.assert_allclose(shares_of_gain([candidate, half, worse], before), [2.0, 0.5 + 0.75, 0.0])
    # If a candidate has no free runs, only predictions are compared.
    alone = dataclasses.replace(half, free_run=None)
    np.testing.assert_allclose(shares_of_gain([candidate, alone], before), [1.0, 0.5])


AHEAD = {"held_out": 1.0, "train": 1.0}


@SIDES
@pytest.mark.parametrize("what", ["windows", "scatter", "held_out", "train"])
def test_a_law_takes_the_place_of_another_one_where_both_horizons_prefer_it(side: float, what: str) -> None:
    """Four limits must be exceeded.

    Errors of free runs must be smaller by a tenth. Predictions must gain by two standard deviations of all
    blocks, by 5 nats on validation data, and by 8 nats after the penalty on training data.
    """
    limits = {
        "windows": 5.0 * np.exp(-0.1 * side),
        "scatter": 200.0 / (2.0 * side) / np.sqrt(2 * BLOCKS) * np.sqrt((2 * BLOCKS - 1) / (2 * BLOCKS)),
        "held_out": 5.0 * side,
        "train": (8.0 + 0.5 * np.log(2 * N)) * side,
    }
    given = {"held_out": 100.0, "train": 100.0, "windows": 3.0, "scatter": 0.0} | {what: limits[what]}
    found = at_both({"windows": 5.0}, {"windows": 5.0}, COULOMB)
    rival = dataclasses.replace(at_both(given, {"windows": 5.0, **AHEAD}, DAHL), parameter_count=2)
    assert better_in_place(rival, found, MEASURED) is (side > 1)


@pytest.mark.parametrize("kind", ["held_out", "train"])
def test_a_law_that_free_runs_speak_against_takes_no_place(kind: str) -> None:
    """Worse free runs over training or over validation data are enough to refuse it."""
    found = at_both({"windows": 5.0}, {"windows": 5.0}, COULOMB)
    given = {"held_out": 100.0, "train": 100.0, "windows": 3.0}
    for lead, taken in ((1.0, True), (-1.0, False)):
        runs = {"windows": 5.0, **AHEAD, kind: lead}
        rival = dataclasses.replace(at_both(given, runs, DAHL), parameter_count=2)
        assert better_in_place(rival, found, MEASURED) is taken


@SIDES
@pytest.mark.parametrize("what", ["windows", "held_out", "train", "predictions"])
def test_a_law_takes_the_place_where_free_runs_insist_and_predictions_do_not_object(
    side: float, what: str
) -> None:
    """Free runs lead by 2.5 standard deviations on both data sets, with errors smaller by a tenth.

    Predictions lose less than two standard deviations.
    """
    z_is_one = np.sqrt(BLOCKS) * np.sqrt(BLOCKS / (BLOCKS - 1))
    limits = {"windows": 5.0 * np.exp(-0.1 * side), "held_out": 2.5 * side * z_is_one}
    limits["train"] = limits["held_out"]
    runs = {"held_out": 100.0, "train": 100.0, "windows": 3.0, "scatter": 1.0}
    objection = 2.0 * np.sqrt(2 * BLOCKS) * np.sqrt(2 * BLOCKS / (2 * BLOCKS - 1)) / 2
    predictions = {"windows": 5.0, "held_out": 0.0, "train": 0.0, "scatter": 1.0}
    if what == "predictions":
        predictions |= {"held_out": -objection / side, "train": -objection / side}
    else:
        runs |= {what: limits[what]}
    found = at_both({"windows": 5.0}, {"windows": 5.0}, COULOMB)
    rival = dataclasses.replace(at_both(predictions, runs, DAHL), parameter_count=9)
    assert better_in_place(rival, found, MEASURED) is (side > 1)


@SIDES
def test_parameters_of_predictions_suit_free_runs_better_by_a_hundredth(side: float) -> None:
    found = at_both({"windows": 5.0 * np.exp(-0.01 * side)}, {"windows": 5.0}, COULOMB)
    best = found if side > 1 else found.free_run
    np.testing.assert_array_equal(best_window_rmse(found), best.window_rmse)


def at_the_limit(monkeypatch, name: str, value: float, decides: Callable[[], bool]) -> list[bool]:
    """Decisions with a limit just below a value, at it, and just above."""
    found = []
    for limit in (np.nextafter(value, -np.inf), value, np.nextafter(value, np.inf)):
        monkeypatch.setattr(selection, name, float(limit))
        found.append(decides())
    return found


UNTIL, UP_TO, BEYOND = [True, False, False], [True, True, False], [False, False, True]
NOT_SURE = trial(COULOMB, **PLENTY | {"held_out": 20.0, "train": 50.0, "scatter": 0.3})
RUNS = of_free_runs(windows=8.0, z=4.0, train_z=5.0)
UNSURE_RUNS = at_both(not_quite_sure(5.0, windows=9.5), {"windows": 10.0}, COULOMB)
APART = [trial(p, 200.0, 200.0, w) for p, w in ((COULOMB, 5.0), (ARM, 6.0))]
CERTAIN = trial(COULOMB, 220.0, 230.0, 5.0, 0.3), trial(ARM, 200.0, 200.0, 5.0)


def lead(a: ValidatedHypothesis, b: ValidatedHypothesis = BASE) -> tuple[float, float]:
    return paired_gain(a.blocks, b.blocks)


@pytest.mark.parametrize(
    ("name", "value", "decides", "expected"),
    [
        ("HELD_OUT_NATS", lead(NOT_SURE)[0], lambda: admissible(NOT_SURE, BASE, MEASURED, NOISE), UNTIL),
        ("HELD_OUT_Z", lead(NOT_SURE)[1], lambda: admissible(NOT_SURE, BASE, MEASURED, NOISE), UNTIL),
        (
            "TRAIN_Z",
            paired_gain(NOT_SURE.hypothesis.blocks, BASE.hypothesis.blocks)[1],
            lambda: admissible(NOT_SURE, BASE, MEASURED, NOISE),
            UNTIL,
        ),
        ("HELD_OUT_Z", 3.25, lambda: helps(HorizonGain(10.0, 3.25, 1.0)), UNTIL),
        (
            "FREE_RUN_Z",
            lead(RUNS.free_run, FAR.free_run)[1],
            lambda: admissible(RUNS, FAR, MEASURED, NOISE),
            UNTIL,
        ),
        ("FREE_RUN_BETTER", np.log(10 / 8), lambda: admissible(RUNS, FAR, MEASURED, NOISE), None),
        (
            "PREDICTION_Z",
            min(
                lead(UNSURE_RUNS, FAR)[1],
                paired_gain(UNSURE_RUNS.hypothesis.blocks, FAR.hypothesis.blocks)[1],
            ),
            lambda: admissible(UNSURE_RUNS, FAR, MEASURED, NOISE),
            UNTIL,
        ),
        (
            "SEPARATE_Z",
            paired_gain(*(np.concatenate([t.blocks, t.hypothesis.blocks]) for t in CERTAIN))[1],
            lambda: distinguished(*CERTAIN),
            UP_TO,
        ),
        (
            "WINDOWS_APART",
            float(np.mean(np.log(APART[1].window_rmse / APART[0].window_rmse))),
            lambda: distinguished(*APART),
            UNTIL,
        ),
        (
            "WINDOWS_BETTER",
            -float(np.mean(np.log(APART[0].window_rmse / APART[1].window_rmse))),
            lambda: runs_clearly_better(APART[0].window_rmse, APART[1].window_rmse),
            UNTIL,
        ),
        (
            "WINDOWS_BETTER",
            -float(np.mean(np.log(trial(COULOMB, **GOOD).window_rmse / BASE.window_rmse))),
            lambda: admissible(trial(COULOMB, **GOOD), BASE, MEASURED, NOISE),
            UNTIL,
        ),
        (
            "WINDOWS_BETTER",
            float(np.mean(np.log(5.1 * NOISE / (5.0 * NOISE)))),
            lambda: richer_wins(windows=5.1),
            BEYOND,
        ),
        (
            "WINDOWS_WORSE",
            float(np.mean(np.log(1.125 * NOISE / (1.1 * NOISE)))),
            lambda: admitted(trial(None, windows=1.1), windows=1.125),
            BEYOND,
        ),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_what_is_exactly_at_a_limit(monkeypatch, name, value, decides, expected) -> None:
    """A value at its limit does not pass, except at `SEPARATE_Z` and `FREE_RUN_BETTER`."""
    if expected is None:  # a fall of the error by exactly the limit is enough
        value = -float(np.mean(np.log(RUNS.free_run.window_rmse / FAR.free_run.window_rmse)))
        expected = UP_TO
    assert at_the_limit(monkeypatch, name, value, decides) == expected


def test_exactly_twice_the_noise_is_near_it() -> None:
    base = trial(None, windows=2.0)
    assert admitted(base, windows=2.0)  # far from it the error would have to fall
    strong, weak = (trial(p, n, n, 2.0) for p, n in ((ARM, 1000.0), (COULOMB, 950.0)))
    assert choose([strong, weak], BASE, MEASURED, NOISE) == (strong, [])


def test_a_rival_gains_something_on_either_side() -> None:
    best = trial(DRAG, **GOOD | {"held_out": 30.0, "train": 30.0, "scatter": 1.0})
    for nothing in ({"held_out": 0.0, "train": 25.0}, {"held_out": 25.0, "train": 0.0}):
        none = trial(ARM, **GOOD | nothing | {"scatter": 0.0}, seed=2)
        assert choose([none, best], BASE, MEASURED, NOISE) == (best, [])


# -- rivals in the place of an effect of a poor model -----------------------------------------------------

LUGRE, DAHL = EffectLocation("lugre", "hub"), EffectLocation("dahl", "hub")
MORE_NEEDED = selection.TRAIN_NATS + np.log(2 * N)  # of two further parameters
LEFT = 500.0
SQRT_2 = 2.0**0.5


def in_place(location=DAHL, z=4.0, windows=10.0, numbers=3, better=False, **lead: float):
    """A model with another law in the place of Stribeck friction; free runs differ by `z` deviations."""
    predicts = {"held_out": -50.0, "train": -50.0, "windows": 20.0} | lead
    gain = 100.0 if better else -100.0
    runs = {"held_out": gain, "train": gain, "windows": windows, "scatter": scatter_for(z, 100.0)}
    return dataclasses.replace(at_both(predicts, runs, location), parameter_count=numbers)


def remains(other: ValidatedHypothesis, left: float = LEFT) -> bool:
    found = dataclasses.replace(at_both({"windows": 20.0}, {"windows": 10.0}, STRIBECK), parameter_count=3)
    return selection.undecided(found, other, left, MEASURED)


@SIDES
def test_predictions_exclude_a_law_by_more_than_they_leave(side: float) -> None:
    """The summed loss on training and validation data must exceed `left`, by two standard deviations."""
    assert remains(in_place(held_out=-200.0, train=-300.0 * side)) is (side < 1)
    assert remains(in_place(held_out=-200.0 * side, train=-300.0)) is (side < 1)
    # Two standard deviations of all blocks, of training and validation data together.
    scatter = 800.0 / (2.0 * side) * np.sqrt(2 * BLOCKS - 1) / (2 * BLOCKS)
    assert remains(in_place(held_out=-400.0, train=-400.0, scatter=scatter)) is (side < 1)


@SIDES
def test_free_runs_exclude_a_law_that_differs_by_more_than_is_left(side: float) -> None:
    """Its errors are larger by the square root of two, and both data sets agree by 2.5 deviations."""
    assert remains(in_place(windows=10.0 * np.exp(side * np.log(SQRT_2)))) is (side < 1)
    assert remains(in_place(windows=20.0, z=2.5 * side)) is (side < 1)


@SIDES
def test_a_generalisation_does_better_on_both_kinds_of_data(side: float) -> None:
    """It gains more than the penalty for its parameters, or its gain is certain, however small."""
    vague = 200.0  # scatter of a block: the lead is far below two standard deviations
    more = in_place(LUGRE, numbers=5, held_out=10.0, train=side * MORE_NEEDED, scatter=vague)
    assert remains(more) is (side > 1)
    slight = in_place(LUGRE, numbers=5, held_out=10.0 * (side - 1.0), train=100.0, scatter=vague)
    assert remains(slight) is (side > 1)
    sure = {"held_out": 3.0, "train": 3.0, "scatter": scatter_for(2.0 * side, 3.0)}
    assert remains(in_place(LUGRE, numbers=5, **sure)) is (side > 1)
    assert not remains(in_place(LUGRE, numbers=5, **sure | {"train": -3.0, "scatter": 0.0}))
    # Or free runs prefer it with certainty.
    assert remains(in_place(LUGRE, numbers=5, windows=9.0, z=2.0 * side, better=True)) is (side > 1)
    # A special case or another law need not be better.
    assert remains(in_place(COULOMB, numbers=1)) and remains(in_place(DAHL, numbers=2))


@pytest.mark.parametrize("found", [[STRIBECK], [STRIBECK, DRAG]], ids=["alone", "beside another"])
def test_a_rival_of_a_round_must_hold_beside_the_other_effects(monkeypatch, found) -> None:
    """In the place of the effect found, free runs or the likelihood exclude it; a single effect keeps all."""
    final = trial(None, 1000.0, 1000.0, 1.5)
    in_place = {
        EffectLocation("dead_zone", "input"): trial(None, 1000.0, 1000.0, 1.12 * 1.5),
        ARM: trial(None, 900.0, 900.0, 1.5),
        EffectLocation("dahl", "arm"): trial(None, 1000.0, 1000.0, 1.09 * 1.5),
    }
    candidates = dict.fromkeys(in_place, SimpleNamespace(probes=(((1.0,),),)))
    supermodel = SimpleNamespace(candidates=candidates, parameter_indices=lambda location: ())
    problem: Any = SimpleNamespace(supermodel=supermodel, likeliest=lambda starts: starts[0])
    monkeypatch.setattr(stepwise, "without", lambda s, h, location: h)
    monkeypatch.setattr(stepwise, "with_effect", lambda s, h, start, share: start.location)
    monkeypatch.setattr(stepwise, "refit", lambda problem, swapped: swapped)
    monkeypatch.setattr(stepwise, "validate", lambda validation, h: in_place.get(h, final))
    rivals = {STRIBECK: [*in_place, DRAG], DRAG: []}
    left = stepwise.remaining_rivals(problem, None, final, rivals, found).alike[STRIBECK]  # pyright: ignore[reportArgumentType]
    alone = found == [STRIBECK]
    assert left == ([*in_place, DRAG] if alone else [EffectLocation("dahl", "arm")])


@SIDES
def test_a_poor_model_leaves_twice_the_noise(side: float) -> None:
    """Of its two sets of parameters, the one with the better free runs counts."""
    assert selection.is_poor(trial(None, windows=2.0 * side), NOISE) is (side > 1)
    assert not selection.is_poor(trial(None, windows=2.0), NOISE)
    assert selection.is_poor(at_both({"windows": 9.0}, {"windows": 2.0 * side}), NOISE) is (side > 1)
    one_channel = dataclasses.replace(trial(None), window_rmse=np.array([1.0, 2.0 * side]) * NOISE)
    assert selection.is_poor(one_channel, NOISE) is (side > 1)


@pytest.mark.parametrize("folds", [True, False], ids=["validating each other", "held out"])
def test_samples_that_validate_each_other_count_once(folds: bool) -> None:
    """Counted twice, the same differences would have sqrt(2) times as many standard deviations."""
    lead = 1.6 * np.sqrt(BLOCKS) * np.sqrt(BLOCKS / (BLOCKS - 1))  # z is 1.6, or 2.26 if counted twice
    winner = trial(COULOMB, held_out=lead, train=lead, scatter=1.0)
    winner = dataclasses.replace(winner, folds=(winner.hypothesis,) if folds else ())
    rival = dataclasses.replace(trial(DRAG), folds=winner.folds)
    assert paired_gain(winner.blocks, rival.blocks)[1] == pytest.approx(1.6)
    assert distinguished(winner, rival) is not folds


@pytest.mark.parametrize(
    ("location", "held_out", "asked"),
    [(STRIBECK, 60.0, True), (STRIBECK, 40.0, False), (DRAG, 60.0, False), (ARM, 60.0, False)],
)
def test_first_states_come_from_a_generalisation_that_does_better(
    monkeypatch, location, held_out, asked
) -> None:
    simple, other, from_other = trial(COULOMB, held_out=50.0), trial(location, held_out=held_out), []

    def validate_again(validation, hypothesis, start, inner):
        from_other.append(start)
        return trial(None, held_out=55.0)

    monkeypatch.setattr(selection, "validate", validate_again)
    first, second = selection.validate_from_best_states(None, [simple, other])
    assert (from_other == [other]) == asked and second is other
    assert first.location == COULOMB and first.log_likelihood == pytest.approx(
        (trial(None, held_out=55.0) if asked else simple).log_likelihood
    )


@pytest.mark.parametrize(("rise", "needed"), [(1.09, False), (1.13, True)])
def test_an_effect_without_which_validation_runs_are_clearly_worse_is_needed(
    rise: float, needed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Validation errors rise by a tenth without it, though training data lose nothing by it."""
    blocks, runs_problem = np.zeros(12), SimpleNamespace(supermodel=None)
    without = SimpleNamespace(blocks=blocks)
    monkeypatch.setattr(stepwise, "refit_without", lambda problem, h, locations, alternations: [without])
    errors = {"with": np.array([0.02, 0.01]), "without": rise * np.array([0.02, 0.01])}

    def validated(prediction: str, free_run: Any, near: Any = None) -> Any:
        runs = SimpleNamespace(window_rmse=errors[prediction], free_run=None)
        return SimpleNamespace(window_rmse=9 * errors[prediction], free_run=runs)

    horizons: Any = SimpleNamespace(free_run=SimpleNamespace(problem=runs_problem), validated=validated)
    given: Any = SimpleNamespace(blocks=blocks)
    as_it_is = lambda: validated("with", given)  # noqa: E731
    assert stepwise._need(horizons, as_it_is, given, EffectLocation("coulomb", "hub"), "without") == needed
