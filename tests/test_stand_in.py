"""Signs that an effect stands in for something else: sizes by window, changes of free runs, nats left."""

import dataclasses
import types

import numpy as np
import pytest
from small_problem import HUB, NOISE, problem, recordings, records, start, supermodel

from rotflex_jax.discover import conclusion, summary
from rotflex_jax.discover.conclusion import (
    LEAST_CHANGE,
    SCATTER,
    WindowSizes,
    nats_above_noise,
    signs,
    window_sizes,
)
from rotflex_jax.discover.hypothesis import CandidateStart, Hypothesis, with_effect
from rotflex_jax.discover.likelihood import LikelihoodProblem, levenberg_marquardt
from rotflex_jax.discover.result import HorizonGain
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.validation import SearchHorizon, ValidatedHypothesis, ValidationSet
from rotflex_jax.effects.sensors import CrossTalk, EccentricEncoder
from rotflex_jax.parameters import specifications


def with_friction(at: LikelihoodProblem, level: float) -> Hypothesis:
    """A fit that began with friction of that level at the hub."""
    h = with_effect(supermodel(), start(at), CandidateStart(HUB, np.array([level])), 1.0)
    return levenberg_marquardt(at, [h])[0]


def mixed(levels: tuple[float, float]) -> LikelihoodProblem:
    """Two recordings of machines whose friction is not the same."""
    made = [records(level)[k] for k, level in enumerate(levels)]
    return problem(recordings(tuple(made)))


@pytest.fixture(scope="module")
def same() -> tuple[LikelihoodProblem, Hypothesis]:
    at = mixed((0.02, 0.02))
    return at, with_friction(at, 0.03)


def test_an_effect_of_the_machine_has_one_size(same):
    at, h = same
    sizes = window_sizes(at, h, [HUB])[HUB]
    assert sizes.scatter < SCATTER / 3 and sizes.change > 2 * LEAST_CHANGE


def test_two_sizes_show_as_scatter():
    """Friction of 0.012 and 0.028 N m asks for changes of +-40 % around the mean."""
    at = mixed((0.012, 0.028))
    sizes = window_sizes(at, with_friction(at, 0.03), [HUB])[HUB]
    assert 0.25 < sizes.scatter < 0.55


def test_an_effect_that_does_little_changes_little():
    """A hundredth of the friction is less than what its absence leaves."""
    at = mixed((0.02, 0.02))
    s, h = supermodel(), start(at)
    little = with_effect(s, h, CandidateStart(HUB, np.array([2e-4])), 1.0)
    assert window_sizes(at, little, [HUB])[HUB].change < LEAST_CHANGE / 5


def test_nats_above_the_noise_by_hand(same):
    """`N log(rms / noise)` of each channel: half the noise is `log 2` more for each value above it."""
    at, h = same
    e, counted = at.innovations([h])[0], at.seen > 0
    # Far below any error, so that each channel counts.
    tiny = dataclasses.replace(at, dataset=dataclasses.replace(at.dataset, noise=NOISE * 1e-3))
    rms = np.sqrt(np.mean(e[counted] ** 2, axis=0))
    expected = counted.sum() * (np.log(rms[0] / (1e-3 * NOISE[0])) + np.log(rms[1] / (1e-3 * NOISE[1])))
    assert nats_above_noise(tiny, h) == pytest.approx(expected, rel=1e-9)
    huge = dataclasses.replace(at, dataset=dataclasses.replace(at.dataset, noise=NOISE * 1e3))
    assert nats_above_noise(huge, h) == 0.0


def validated(h: Hypothesis) -> ValidatedHypothesis:
    runs = ValidatedHypothesis(h, np.zeros(0), h, NOISE)
    return dataclasses.replace(runs, free_run=runs)


def test_each_sign_is_a_sentence(same):
    at, h = same
    horizon = SearchHorizon(at, ValidationSet(at, 2.0))
    rest = 2 * nats_above_noise(at, h)
    assert signs((horizon, horizon), validated(h), {HUB: rest + 1.0})[HUB] == ()
    (few,) = signs((horizon, horizon), validated(h), {HUB: rest - 1.0})[HUB]
    assert f"gain {rest - 1:.0f} nats" in few and f"{rest:.0f} are left above the sensor noise" in few
    other = mixed((0.012, 0.028))
    apart = SearchHorizon(other, ValidationSet(other, 2.0))
    (scattered,) = signs((apart, apart), validated(with_friction(other, 0.03)), {HUB: 1e9})[HUB]
    assert scattered.startswith("windows of 2 s differ by")


@pytest.mark.parametrize("folds", [True, False], ids=["validating each other", "held out"])
@pytest.mark.parametrize("beyond", [None, "scatter", "change", "gain"])
def test_the_limit_of_each_sign_from_both_sides(beyond, folds, monkeypatch: pytest.MonkeyPatch):
    """15 % of the size, half of the error that is left, the nats left in both sets; the worse set counts."""
    space = types.SimpleNamespace
    validation = space(folds=folds, problem="free runs, held out", window_seconds=2.0)
    prediction = space(problem="predictions", validation=space(problem="predictions, held out"))
    runs = space(hypothesis=space(locations=(HUB,)), adapted=None)
    scatter = 0.152 if beyond == "scatter" else 0.148
    change = 0.495 if beyond == "change" else 0.505
    sizes = {"free runs": WindowSizes(0.01, 9.0), "free runs, held out": WindowSizes(scatter, change)}
    if folds:  # the recordings for training are all there are
        sizes = {"free runs": sizes["free runs, held out"]}
    left = {"predictions": 30.0, "predictions, held out": 20.0}
    monkeypatch.setattr(conclusion, "window_sizes", lambda problem, h, locations: {HUB: sizes[problem]})
    monkeypatch.setattr(conclusion, "nats_above_noise", lambda problem, h: left[problem])
    rest = 60.0 if folds else 50.0
    final = space(free_run=runs, hypothesis=None, adapted=None)
    horizons = (prediction, space(problem="free runs", validation=validation))
    found = signs(horizons, final, {HUB: rest - 0.1 if beyond == "gain" else rest})[HUB]
    words = {"scatter": "windows of 2 s differ by 15%", "change": "changes free runs by 0.49 of the error"}
    words |= {"gain": f"{rest:.0f} are left above the sensor noise"}
    assert len(found) == (beyond is not None)
    assert beyond is None or words[beyond] in found[0]


def test_sensor_faults_of_an_impossible_size_are_not_physical():
    """A fifth of the servo angle in a strain gauge, or a disc 8 degrees out of centre, is something else."""
    for fault, names in ((CrossTalk, ("share",)), (EccentricEncoder, ("sine", "cosine"))):
        for name in names:
            low, high = specifications(fault(at="theta"))[name].physical
            assert -0.14 < low < -0.02 < 0.02 < high < 0.14


def test_a_window_that_diverges_says_nothing(same):
    """The others do: the numbers are those of the windows that are left."""
    at, h = same
    x0 = h.x0.copy()
    x0[0, 0] = np.nan
    sizes = window_sizes(at, dataclasses.replace(h, x0=x0), [HUB])[HUB]
    assert sizes.scatter < SCATTER / 3 and sizes.change > 2 * LEAST_CHANGE
    assert window_sizes(at, dataclasses.replace(h, x0=np.full_like(x0, np.nan)), [HUB]) == {}


def test_one_effect_in_the_place_of_several_has_the_signs_of_its_part(monkeypatch: pytest.MonkeyPatch):
    """A merged effect stands in no fit at both horizons, so it answers for the part that it took over."""
    merged = EffectLocation("coulomb_asymmetric", "hub")
    state = types.SimpleNamespace(
        gains={HUB: (HorizonGain(1.0, 2.0, 0.5, 3.0), None), merged: (HorizonGain(1.0, 2.0, 0.5, 3.0), None)},
        horizons=types.SimpleNamespace(prediction=None, free_run=None),
        current=None,
        in_place_of={merged: HUB},
    )
    asked = {}
    monkeypatch.setattr(summary, "signs", lambda *a: asked.update(gains=a[2]) or {HUB: ("it is small",)})
    assert summary.stand_ins(state)[merged] == ("it is small",)
    assert asked["gains"][HUB] == 4.0
