"""Scores predict the gains of refits; the super-model with all gates off equals the baseline."""

import dataclasses

import numpy as np
import pytest
import small_problem as sp
from scipy.optimize import nnls

import rotflex_jax.effects as fx
from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.likelihood import levenberg_marquardt
from rotflex_jax.discover.score_test import Score, _amplitudes, score_test
from rotflex_jax.discover.supermodel import EffectLocation, build
from rotflex_jax.effects.base import Scale
from rotflex_jax.joints import paper
from rotflex_jax.mechanism import simulate
from rotflex_jax.parameters import Transform

SMALL = 0.0015


@pytest.fixture(scope="module")
def weak():
    """Recordings with little friction: likelihood, fitted baseline, and its scores by location."""
    problem = sp.problem(sp.recordings(sp.records(SMALL)))
    h = sp.fitted(problem)
    return problem, h, {s.location: s for s in score_test(problem, h).listed}


def switched_on(problem, h: Hypothesis, score: Score) -> Hypothesis:
    """The baseline with a candidate, at the values that its score test estimates."""
    s = problem.supermodel
    c = s.candidates[score.location]
    specs = [s.mechanism.parameter_specifications[i] for i in c.parameters]
    z = h.z.copy()
    z[list(c.parameters)] = Transform.of(specs).unconstrain(score.start.values)
    return dataclasses.replace(
        h, locations=(*h.locations, score.location), free=(*h.free, *c.parameters), z=z
    )


def gain(problem, score: Score) -> float:
    """First-order gain [nat], without the penalty for the one parameter."""
    return score.nats + 0.5 * np.log(np.sum(problem.seen) * 2)


def test_a_score_foretells_the_gain_of_a_refit(weak):
    problem, h, found = weak
    score = found[sp.HUB]
    refitted = levenberg_marquardt(problem, [switched_on(problem, h, score)])[0]
    won = refitted.log_likelihood - h.log_likelihood
    assert won > 10
    assert gain(problem, score) == pytest.approx(won, rel=0.2)
    i = problem.supermodel.parameter_indices(sp.HUB)[0]
    level = refitted.values(problem.supermodel)[0, i]
    assert score.start.values[0] == pytest.approx(level, rel=0.2)
    assert level == pytest.approx(SMALL, rel=0.4)


def test_a_score_counts_only_a_plausible_size(weak):
    """The gain of a limited friction is that of a fit of all else with this friction held."""
    problem, h, found = weak
    s, limit = problem.supermodel, 0.4 * found[sp.HUB].start.values[0]
    (i,) = s.parameter_indices(sp.HUB)

    def is_plausible(grown: Hypothesis, location: EffectLocation) -> bool:
        return location != sp.HUB or grown.mean_values(s)[i] <= limit

    limited = {x.location: x for x in score_test(problem, h, is_plausible=is_plausible).listed}
    score = limited[sp.HUB]
    assert 0.9 * limit < score.start.values[0] <= limit
    held = dataclasses.replace(switched_on(problem, h, score), free=h.free)
    (refitted,) = levenberg_marquardt(problem, [held])
    assert gain(problem, score) == pytest.approx(refitted.log_likelihood - h.log_likelihood, rel=0.2)
    assert gain(problem, score) < 0.75 * gain(problem, found[sp.HUB])
    assert all(limited[p].start.expected_gain == found[p].start.expected_gain for p in found if p != sp.HUB)
    # A fault that is not one of size does not limit the size.
    never = {x.location: x for x in score_test(problem, h, is_plausible=lambda h, p: False).listed}
    assert all(never[p].start.expected_gain == found[p].start.expected_gain for p in found)


def test_the_true_effect_comes_first(weak):
    problem, h, found = weak
    listed = score_test(problem, h).listed
    assert [s.location for s in listed] == [s.location for s in sorted(listed, key=lambda s: -s.nats)]
    assert listed[0].location == sp.HUB and listed[0].nats > 0
    assert found[sp.HUB].excited and 0.001 < found[sp.HUB].orthogonal_fraction < 1
    # The detection limit is a share of the size of the probe, a tenth of the motor's torque.
    tried = 0.1 * problem.dataset.torque_scale
    assert found[sp.HUB].detection_limit * tried < SMALL


def test_what_the_baseline_can_move_has_no_score(weak):
    """Viscous friction at the hub has the effect of back-EMF, which is free in the baseline."""
    problem, _, found = weak
    score = found[("viscous", "hub")]
    assert score.orthogonal_fraction < 1e-3
    assert gain(problem, score) < 0.5
    assert not score.excited


def test_nothing_scores_where_nothing_is_missing():
    problem = sp.problem(sp.recordings(sp.records(0.0)))
    found = score_test(problem, sp.fitted(problem)).listed
    assert len(found) == len(sp.WANTED)
    assert all(s.nats < 0 for s in found)


def test_what_is_in_the_hypothesis_is_scored_no_more(weak):
    problem, h, found = weak
    with_it = switched_on(problem, h, found[sp.HUB])
    assert {s.location for s in score_test(problem, with_it).listed} == set(found) - {sp.HUB}


def test_switched_off_it_is_the_baseline(weak):
    """Innovations of a free run equal those of the baseline alone to 1e-11."""
    problem, _, _ = weak
    s = problem.supermodel
    off = sp.start(problem, locations=())
    e = problem.innovations([off])[0]
    plain = s.clean(off.values(s)[0], ())
    assert plain.parameter_names == sp.baseline().parameter_names
    for r in range(2):
        data = problem.dataset.data
        y_hat = simulate(plain, data.u[r], float(data.Ts[r]), x0=off.x0[r, 0], solver=sp.SOLVER)
        np.testing.assert_allclose(e[r], data.y[r] - y_hat, atol=1e-11)


@pytest.mark.parametrize("friction", [False, True])
def test_switched_on_it_is_the_clean_model(weak, friction):
    """Innovations equal those of a model with the same effects to 1e-9."""
    exact = 1e-9
    problem, h, _ = weak
    s = problem.supermodel
    numbers = {"hub.coulomb.level": 0.02, "joint.cubic_spring.stiffness": 30.0}
    z = Transform.of(s.mechanism.parameter_specifications).unconstrain(
        s.mechanism.with_values(numbers).values
    )
    locations = [EffectLocation("cubic_spring", "joint")]
    by_hand = sp.baseline() + fx.CubicSpring("joint", 30.0)
    if friction:
        locations, by_hand = [*locations, sp.HUB], by_hand + fx.Coulomb("hub", 0.02)
    still = np.zeros((2, len(h.local)))
    h = dataclasses.replace(sp.start(problem, locations=tuple(locations)), z=z, local_z=still)
    e = problem.innovations([h])[0]
    clean = s.clean(h.values(s)[0], locations)
    assert clean.structure == by_hand.structure
    np.testing.assert_allclose(clean.values, by_hand.values, rtol=1e-9)
    data = problem.dataset.data
    y_hat = simulate(by_hand, data.u[1], float(data.Ts[1]), solver=sp.SOLVER)
    plain = simulate(sp.baseline(), data.u[1], float(data.Ts[1]), solver=sp.SOLVER)
    assert np.abs(y_hat - plain).max() > 100 * exact
    np.testing.assert_allclose(e[1], data.y[1] - y_hat, atol=exact)


def test_a_super_model_holds_what_is_new_and_possible():
    whole = {p: Scale(2.0, 3.0, 0.5, 0.2) for p in ("hub", "arm", "joint", "input", "theta", "alpha")}
    wanted = [(fx.Viscous, "hub"), (fx.Coulomb, "wrist"), (fx.Motor, "hub"), (fx.Gravity, "arm")]
    s = build(paper(), [*wanted, (fx.DeadZone, "input")], whole)
    assert set(s.candidates) == {("gravity", "arm"), ("dead_zone", "input")}
    assert s.calibrations == (("voltage_offset", "input"), ("sensor_bias", "alpha"))
    assert [s.mechanism.parameter_names[i] for i in s.local] == [
        f"{at}.{n}.{p}"
        for n, at, p in (("voltage_offset", "input", "offset"), ("sensor_bias", "alpha", "bias"))
    ]
    gates = s.gates([EffectLocation("gravity", "arm")])
    on = [e.name for e, g in zip(s.mechanism.effects, gates, strict=True) if g]
    assert on == [*(e.name for e in paper().effects), "gravity"]
    c = s.candidates[("dead_zone", "input")]
    assert [s.mechanism.parameter_names[i] for i in c.parameters] == [
        "input.dead_zone.positive",
        "input.dead_zone.negative",
    ]
    assert c.one_sided and not s.candidates[("gravity", "arm")].one_sided


@pytest.mark.parametrize("one_sided", [True, False])
def test_amplitudes_that_cannot_be_negative_are_not(one_sided):
    rng = np.random.default_rng(0)
    c = dataclasses.replace(sp.supermodel().candidates[sp.HUB], one_sided=one_sided)
    signs = set()
    for _ in range(30):
        J = rng.normal(size=(50, 2)) @ np.array([[1.0, 0.9], [0.0, 0.4]])
        r = rng.normal(size=50) - J @ rng.normal(size=2)
        free = np.linalg.lstsq(J, -r, rcond=None)[0]
        signs.add(bool((free < 0).any()))
        np.testing.assert_allclose(_amplitudes(J, r, c), nnls(J, -r)[0] if one_sided else free, atol=1e-9)
    assert signs == {True, False}
