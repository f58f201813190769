"""Probabilities of sets of effects: given evidence, scatter, credible sets, sentences, calibration."""

import dataclasses
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import softmax
from scipy.stats import norm

from arena.probability import (
    Event,
    calibration_error,
    classes,
    credible,
    effect_events,
    misfit,
    reliability,
    scatter_of_right,
    weighed,
)
from rotflex_jax.discover.probabilities import (
    RULE as CALIBRATED,
    EvidenceRule,
    FittedSet,
    Probabilities,
    SetProbability,
    best_blocks,
    fitted_sets,
    probabilities,
    set_probabilities,
)
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.errors import InputError

BLOCKS = 12
COMMON = np.random.default_rng(0).normal(size=BLOCKS) * 40
RULE = EvidenceRule(
    temperature=2.0,
    run_nats=1.5,
    prior_nats=0.7,
    passed_nats=0.4,
    elsewhere=0.04,
    elsewhere_unexplained=0.25,
)
PLAIN = EvidenceRule(temperature=1.0, prior_nats=0.0, passed_nats=0.0)


def fitted(names: str, lead=0.0, runs=0.0, free_run=True) -> FittedSet:
    """A set whose evidence leads by `lead` and `runs` in sum, evenly over the half seconds."""
    free = 0.01 * COMMON + runs / BLOCKS if free_run else None
    return FittedSet(frozenset(names.split()), COMMON + lead / BLOCKS, free)


def test_even_leads_are_a_softmax():
    """If leads are the same in every half second, probabilities are a softmax of the sums: a closed form."""
    lead, runs, n = np.array([4.0, 0.0, 6.5, 4.5]), np.array([0.3, 0.0, 0.5, -0.2]), np.array([1, 0, 2, 1])
    sets = [
        fitted(s, x, f) for s, x, f in zip(("a@hub", "", "a@hub b@arm", "b@arm"), lead, runs, strict=True)
    ]
    passed = np.array([0.4, 0.0, 0.0, 0.0])
    expected = softmax(lead / 2.0 + 1.5 * runs - 0.7 * n + passed)
    np.testing.assert_allclose(set_probabilities(sets, rule=RULE), expected, rtol=1e-9)
    assert expected.min() > 0.02  # none is negligible
    # With a larger misfit, nats of predictions count less; with an infinite misfit, they do not count.
    expected = softmax(lead / 20.0 + 1.5 * runs - 0.7 * n + passed)
    np.testing.assert_allclose(set_probabilities(sets, misfit=10.0, rule=RULE), expected, rtol=1e-9)
    expected = softmax(1.5 * runs - 0.7 * n + passed)
    np.testing.assert_allclose(set_probabilities(sets, misfit=np.inf, rule=RULE), expected, rtol=1e-9)


def test_a_missing_horizon_says_as_much_as_the_reference():
    """A set that was not fitted at a horizon gets the evidence of the reference set there."""
    at_one, as_reference = fitted("b@arm", 5.0, free_run=False), fitted("b@arm", 5.0, 0.8)
    first = fitted("a@hub", 5.0, 0.8)
    p, q = (set_probabilities([first, other], rule=RULE) for other in (at_one, as_reference))
    np.testing.assert_allclose(p, q)
    np.testing.assert_allclose(p, softmax([0.4, 0.0]))
    # The reference is the first set that was fitted at both horizons, whatever its position.
    np.testing.assert_allclose(set_probabilities([at_one, first], rule=RULE), softmax([0.4, 0.0]))
    runs_alone = FittedSet(frozenset({"c@hub"}), None, first.free_run)
    np.testing.assert_allclose(set_probabilities([first, runs_alone], rule=RULE), softmax([0.4, 0.0]))


def test_the_reference_was_fitted_at_both_horizons():
    """If the first set was fitted to predictions alone, free runs of the others still count."""
    sets = [fitted("b@arm", 5.0, free_run=False), fitted("a@hub", 5.0, 0.8), fitted("c@hub", 5.0, 0.0)]
    np.testing.assert_allclose(set_probabilities(sets, rule=RULE), softmax([0.4, 0.0, -1.5 * 0.8]))


def test_a_lead_within_its_scatter_does_not_decide():
    """A lead of z standard deviations over the half seconds has the probability Phi(z) of a normal law."""
    many, rng = 400, np.random.default_rng(3)
    noise = rng.normal(size=many) * 30
    noise -= noise.mean()
    spread = noise.std(ddof=1) * np.sqrt(many)

    def of_lead(lead: np.ndarray) -> float:
        sets = [FittedSet(frozenset({"a@hub"}), lead), FittedSet(frozenset(), np.zeros(many))]
        return set_probabilities(sets, rule=PLAIN)[0]

    for z in (0.0, 1.0, 2.0):
        assert of_lead(noise + z * spread / many) == pytest.approx(norm.cdf(z), abs=0.025)
    # The same lead without scatter has a probability near one.
    assert of_lead(np.full(many, 2.0 * spread / many)) > 1 - 1e-9


def test_a_model_that_diverges_has_no_probability():
    lost = fitted("b@arm", -1e9 * BLOCKS)
    p = set_probabilities([fitted("a@hub", 1.0), lost], rule=RULE)
    np.testing.assert_allclose(p, [1.0, 0.0], atol=1e-12)


@pytest.fixture
def found():
    sets = [
        fitted("coulomb@hub", 6.0),
        fitted("stribeck@hub", 6.0 + 2 * (0.4 - np.log(2.0))),
        fitted("coulomb@hub sensor_bias@alpha", 6.0 + 2 * (0.4 + 0.7 - np.log(4.0))),
        fitted("coulomb@hub", 99.0),
    ]
    return probabilities(sets, misfit=1.0, rule=RULE)


def test_sets_effects_and_what_lies_elsewhere(found):
    """The evidence gives the weights 1, 1/2 and 1/4; the second fit of a set is left out."""
    p = 0.96 * np.array([4, 2, 1]) / 7
    assert [s.effects for s in found.sets] == [
        {"coulomb@hub"},
        {"stribeck@hub"},
        {"coulomb@hub", "sensor_bias@alpha"},
    ]
    np.testing.assert_allclose([s.probability for s in found.sets], p)
    assert list(found.effects) == ["coulomb@hub", "stribeck@hub", "sensor_bias@alpha"]
    np.testing.assert_allclose(list(found.effects.values()), np.array([5, 2, 1]) / 7)
    assert found.elsewhere == 0.04 and len(found.remarks) == 1
    np.testing.assert_allclose(sum(s.probability for s in found.sets) + found.elsewhere, 1.0)


def test_credible_sets_are_the_smallest(found):
    """The fitted sets have the shares 4/7, 2/7 and 1/7."""
    assert found.credible(0.5) == found.credible(4 / 7) == found.sets[:1]
    assert found.credible(0.58) == found.credible(6 / 7) == found.sets[:2]
    assert found.credible(0.9) == found.credible(1) == found.sets
    assert all(isinstance(s, SetProbability) for s in found.credible())
    for bad in (0, 1.5, float("nan"), "most"):
        with pytest.raises(InputError, match="share"):
            found.credible(bad)


def test_what_is_told(found):
    data = json.loads(json.dumps(found.to_dict()))
    assert data["sets"][2]["effects"] == [
        {"effect": "coulomb", "port": "hub"},
        {"effect": "sensor_bias", "port": "alpha"},
    ]
    assert data["effects"]["stribeck@hub"] == pytest.approx(2 / 7)
    assert "3 sets" in found.sentence and "Coulomb friction at hub (the reported set) 55 %" in found.sentence
    assert "Stribeck" in found.sentence and "; a set that was not fitted 4 %." in found.sentence
    left = probabilities([fitted("")], misfit=np.inf, rule=RULE)
    assert probabilities([fitted("")], misfit=2.0, rule=RULE).elsewhere == pytest.approx((0.04 + 0.25) / 2)
    assert left.elsewhere == 0.25 and "catalogue" in left.remarks[1]
    assert left.sentence == (
        "One set of effects was fitted: nothing more (the reported set) 75 %; a set that was not fitted 25 %."
    )


def test_the_reported_set_and_the_rest_are_named_too():
    """An offset of the machine is in every set, so that alone it is no effect."""
    offset = "voltage_offset@input"
    names = ["", "coulomb@hub", "lag@input", "delay@input", "cogging@hub"]
    sets = tuple(
        SetProbability(frozenset([offset, *n.split()]), p)
        for n, p in zip(names, (0.25, 0.21, 0.16, 0.12, 0.09), strict=True)
    )
    found = Probabilities(sets, {}, 0.17, evidence=(FittedSet(sets[3].effects),))
    assert found.sentence == (
        "Most probable of the 5 sets of effects that were fitted: nothing beside voltage offset 25 %; "
        "Coulomb friction at hub + voltage offset 21 %; input lag + voltage offset 16 %; input delay + "
        "voltage offset (the reported set) 12 %; the other fitted set 9 %; a set that was not fitted 17 %."
    )


def test_a_sentence_names_three_sets_at_most_and_none_below_a_hundredth():
    def told(*shares: float) -> str:
        names = ("coulomb@hub", "lag@input", "delay@input", "cogging@hub")
        sets = tuple(SetProbability(frozenset({n}), p) for n, p in zip(names, shares, strict=False))
        return Probabilities(sets, {}, 0.02).sentence

    assert told(0.968, 0.0101).endswith(
        "Coulomb friction at hub 97 %; input lag 1 %; a set that was not fitted 2 %."
    )
    assert told(0.970, 0.0099).endswith(
        "Coulomb friction at hub 97 %; the other fitted set < 1 %; a set that was not fitted 2 %."
    )
    assert "delay" in told(0.5, 0.2, 0.15, 0.13) and "cogging" not in told(0.5, 0.2, 0.15, 0.13)
    # If all sets are unlikely, the first one is named.
    assert "Coulomb friction at hub < 1 %; the other" in told(0.009, 0.008)


def fit_of(*names: str, train=0.0, held_out=0.0, free_run=None):
    """A fit of effects at the hub with log-likelihoods in training and on validation data."""
    locations = tuple(EffectLocation(n, "hub") for n in names)
    hypothesis = SimpleNamespace(locations=locations, log_likelihood=train)
    blocks = np.array([train, held_out])
    return SimpleNamespace(hypothesis=hypothesis, log_likelihood=held_out, blocks=blocks, free_run=free_run)


def test_of_fits_that_are_as_likely_in_training_the_better_on_validation_data_counts():
    """Fits within one nat in training are equal; a worse one is left out, however well it validates."""
    first, as_likely, missed = (
        fit_of(train=10.0),
        fit_of(train=9.1, held_out=3.0),
        fit_of(train=8.9, held_out=9.0),
    )
    assert best_blocks([first, as_likely, missed]) is as_likely.blocks
    assert best_blocks([first, missed]) is first.blocks
    assert best_blocks([]) is None


@pytest.mark.parametrize("at", ["prediction", "free_run"])
def test_a_set_has_what_its_fits_say_at_each_horizon(at):
    offset = EffectLocation("voltage_offset", "hub")
    model = SimpleNamespace(calibrations=(offset, EffectLocation("sensor_bias", "hub")))
    horizons = SimpleNamespace(
        prediction=SimpleNamespace(problem=SimpleNamespace(supermodel=model)), free_run=SimpleNamespace()
    )
    runs = fit_of("coulomb", train=5.0)
    both = fit_of("coulomb", "sensor_bias", train=1.0, free_run=runs)
    alone = fit_of("lag", train=2.0)
    # Excluded by predictions and so not fitted to free runs: its blocks must not count as free runs.
    ruled_out = fit_of("dead_zone", train=3.0)
    first, third, second = fitted_sets(horizons, [both, ruled_out], [alone], getattr(horizons, at), [offset])
    assert third.prediction is ruled_out.blocks and third.free_run is None
    assert first.effects == {"coulomb@hub", "voltage_offset@hub"}
    assert first.prediction is both.blocks and first.free_run is runs.blocks
    assert second.effects == {"lag@hub", "voltage_offset@hub"}
    assert second.prediction is (alone.blocks if at == "prediction" else None)
    assert second.free_run is (alone.blocks if at == "free_run" else None)


def test_calibration_error_by_hand():
    """Seven of ten events of 0.85 are true, one of five of 0.25; events below 0.01 are left out."""
    events = [Event(0.85, k < 7) for k in range(10)] + [Event(0.25, k < 1) for k in range(5)]
    events += [Event(0.001, False)] * 100
    assert calibration_error(events) == pytest.approx((10 * 0.15 + 5 * 0.05) / 15)
    assert [(b.cases, b.held) for b in reliability(events)] == [(5, 0.2), (10, 0.7)]
    assert calibration_error([Event(1.0, True)]) == 0.0


def row(sets, wanted=(), **more):
    found = {"sets": sets, "elsewhere": 0.1}
    return {"probabilities": found, "wanted": wanted, "verdict": "found", "misfit": 1.0, **more}


def test_sets_that_are_one_answer_count_once():
    """Asymmetric friction equals symmetric friction with an offset; faults besides the effect are neutral."""
    sets = [
        [["coulomb@hub", "voltage_offset@input"], 0.5],
        [["coulomb_asymmetric@hub"], 0.3],
        [["coulomb@hub"], 0.1],
    ]
    plain = row(sets, [["coulomb_asymmetric", "hub"]])
    assert classes(plain) == [(pytest.approx(0.8), True), (0.1, False)]
    assert credible([plain]) == (1.0, 2.0, 1)
    expected = [(pytest.approx(p / 0.9), True) for p in (0.6, 0.5, 0.3)]  # a tenth lies elsewhere
    assert effect_events(plain) == expected
    besides = [{"name": "voltage_offset", "names": [["voltage_offset", "input"]]}]
    world = row(sets, world=7, hidden=["coulomb", "hub"], besides=besides)
    assert classes(world) == [(pytest.approx(0.6), True), (0.3, False)]
    nothing = row(sets, world=7, hidden=None, besides=besides)
    assert classes(nothing) == [(pytest.approx(0.6), False), (0.3, False)]


def test_a_row_is_weighed_again_as_it_was(found):
    line = lambda blocks: " ".join(map(repr, blocks.tolist()))  # noqa: E731
    kept = [[sorted(s.effects), line(s.prediction), line(s.free_run)] for s in found.evidence]
    again = weighed(row([], evidence=kept), RULE)
    assert again.sets == found.sets and again.effects == found.effects


def test_an_older_row_has_the_misfit_of_its_errors():
    """One channel has twice the error that a verdict allows, so the misfit is 4."""
    old = {"noise_floor": {"theta": 1e-3, "alpha": 2e-3}, "windows": {"theta": 3e-3, "alpha": 1e-3}}
    assert misfit(old) == pytest.approx(4.0)
    assert misfit({**old, "windows": {"theta": 1.4e-3, "alpha": 1e-3}}) == 1.0
    assert misfit({**old, "misfit": 7.0}) == 7.0


def test_few_machines_scatter_as_much_as_their_probabilities_say():
    """The calibration error of 20 answers of 0.75 is that of the mean of 20 Bernoulli trials."""
    mean, high = scatter_of_right([[0.75]] * 20)
    drawn = np.abs(np.random.default_rng(1).binomial(20, 0.75, 20_000) / 20 - 0.75)
    assert mean == pytest.approx(drawn.mean(), rel=0.15)
    assert high == pytest.approx(np.quantile(drawn, 0.95), rel=0.3)
    # Answers exclude each other: of two of 0.5 each, exactly one is right.
    assert scatter_of_right([[0.5, 0.5]] * 20)[1] == 0.0


def test_the_rule_is_the_one_that_was_calibrated() -> None:
    """The constants are those that `benchmarks/set_probabilities.py` found on tuning seeds."""
    assert EvidenceRule(5.0, 0.2, 2.0, 3.0, 0.02, 0.17) == CALIBRATED
    sets = [FittedSet(frozenset(), np.zeros(4), np.zeros(4))]
    for misfit_of, elsewhere in ((1.0, 0.02), (math.inf, 0.17)):
        found = probabilities(sets, misfit=misfit_of)
        assert found.elsewhere == pytest.approx(elsewhere)
        assert found.sets[0].probability == pytest.approx(1 - elsewhere)
        # The evidence is neither printed nor compared.
        assert "FittedSet" not in repr(found) and found == dataclasses.replace(found, evidence=())
