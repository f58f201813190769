"""Pairs of candidates: the joint score against dense least squares, and the choice of pairs to refit."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import small_problem as sp
from scipy.optimize import lsq_linear

import rotflex_jax.effects as fx
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.discover import pairs
from rotflex_jax.discover.hypothesis import CandidateStart, Hypothesis, with_effect
from rotflex_jax.discover.likelihood import LikelihoodProblem, refit
from rotflex_jax.discover.pairs import (
    best_candidates,
    best_refitted,
    find_pair,
    is_unexplained,
    pairs_passed_by,
    promising_pairs,
    refit_pairs,
    validated_pairs,
)
from rotflex_jax.discover.score_test import (
    MAX_THRESHOLD_AMPLITUDE,
    PairScore,
    PairStart,
    Score,
    ScoreTest,
    _Column,
    _Projected,
    _score,
    score_test,
)
from rotflex_jax.discover.selection import predictions_apart
from rotflex_jax.discover.stepwise import fit_baseline
from rotflex_jax.discover.supermodel import Candidate, EffectLocation, SuperModel, build, scales
from rotflex_jax.discover.validation import Horizons, ValidatedHypothesis, as_free_run
from rotflex_jax.fit.dataset import prepare
from rotflex_jax.models.model import Model

SAMPLES = 60


def candidate(name: str, port: str, probes, one_sided=False, threshold=False) -> Candidate:
    k = len(probes[0][0])
    return Candidate(
        EffectLocation(name, port), 0, tuple(range(k)), probes, (True,) * k, (True,) * k, one_sided, threshold
    )


def made(candidates: list[Candidate], slopes: dict, r: np.ndarray) -> ScoreTest:
    """A score test with given derivatives, of which the baseline explains none."""
    columns = {key: [_Column(float(np.linalg.norm(x)), x) for x in rows] for key, rows in slopes.items()}
    projected = _Projected(r, columns, float(SAMPLES), 1.0, lambda starts: 1.0)
    listed = sorted((_score(c, projected) for c in candidates), key=lambda s: -s.nats)
    return ScoreTest(listed, {c.location: c for c in candidates}, projected)


def dense(slopes: list[np.ndarray], r: np.ndarray, lower: list[float], upper: list[float]) -> float:
    """Reduction of half the squared residual by bounded least squares of scipy."""
    J = np.vstack(slopes).T
    found = lsq_linear(J, -r, (lower, upper), tol=1e-13)
    return float(0.5 * r @ r - found.cost)


@pytest.fixture(scope="module")
def by_hand():
    """Three candidates: two amplitudes in two shapes, one non-negative amplitude, one with a threshold."""
    rng = np.random.default_rng(5)
    both = candidate("gravity", "hub", (((1.0, 0.0), (0.0, 1.0)), ((2.0, 0.0), (0.0, 2.0))))
    positive = candidate("coulomb", "hub", (((0.5,),),), one_sided=True)
    step = candidate("dead_zone", "input", (((0.2,),),), threshold=True)
    c = [both, positive, step]
    slopes = {(both.location, k): rng.normal(size=(2, SAMPLES)) for k in (0, 1)}
    shared = rng.normal(size=SAMPLES)
    slopes[(positive.location, 0)] = (shared + 0.1 * rng.normal(size=SAMPLES))[None]
    slopes[(step.location, 0)] = (shared + 0.1 * rng.normal(size=SAMPLES))[None]
    slopes[(both.location, 1)][0] *= 1e6  # columns of very different sizes
    # Both derivatives have a common part, which cancels in this difference: each alone explains little.
    r = 3 * (slopes[(step.location, 0)] - slopes[(positive.location, 0)])[0] + 0.3 * rng.normal(size=SAMPLES)
    r += 0.4 * slopes[(both.location, 0)][1]
    return c, slopes, r, made(c, slopes, r)


def test_a_shape_without_slope_does_not_hide_the_others():
    """If one of two shapes has a zero derivative, the pair has the gain of the other shape."""
    rng = np.random.default_rng(8)
    friction = candidate("coulomb", "hub", (((1.0,),), ((2.0,),)))
    step = candidate("dead_zone", "input", (((0.2,),),), threshold=True)
    rows = rng.normal(size=(2, SAMPLES))
    slopes = {
        (friction.location, 0): np.zeros((1, SAMPLES)),
        (friction.location, 1): rows[:1],
        (step.location, 0): rows[1:],
    }
    r = -3.0 * rows[0] + 0.2 * rng.normal(size=SAMPLES)
    (pair,) = made([friction, step], slopes, r).pairs([friction.location, step.location])
    assert pair.gain == pytest.approx(dense([rows[:1], rows[1:]], r, [-np.inf] * 2, [np.inf] * 2), rel=1e-6)


def test_the_joint_score_is_dense_least_squares(by_hand):
    (both, positive, step), slopes, r, test = by_hand
    pairs = {frozenset(p.locations): p for p in test.pairs([c.location for c in (both, positive, step)])}
    assert len(pairs) == 3
    inf = np.inf
    half_log = 0.5 * np.log(SAMPLES)
    g = pairs[frozenset({positive.location, step.location})]
    each = [slopes[(c.location, 0)] for c in (positive, step)]
    assert g.gain == pytest.approx(dense(each, r, [0.0, -inf], [inf, inf]), rel=1e-6)
    # The amplitude of a candidate with a threshold is limited; the other amplitude is not recomputed.
    large = -each[0][0] - 3.0 * each[1][0]
    far = ScoreTest(test.listed, test.candidates, dataclasses.replace(test.projected, r=large))
    (held,) = far.pairs([positive.location, step.location])
    np.testing.assert_allclose(held.starts[0].values, [1.0 * 0.5], rtol=1e-6)
    np.testing.assert_allclose(held.starts[1].values, [MAX_THRESHOLD_AMPLITUDE * 0.2])
    left = large + each[0][0] + MAX_THRESHOLD_AMPLITUDE * each[1][0]
    assert held.gain == pytest.approx(0.5 * large @ large - 0.5 * left @ left, rel=1e-6)
    for other, lower in ((positive, 0.0), (step, -inf)):
        options = []
        for k in (0, 1):
            gain = dense(
                [slopes[(both.location, k)], slopes[(other.location, 0)]],
                r,
                [-inf, -inf, lower],
                [inf, inf, inf],
            )
            options.append(gain)
        p = pairs[frozenset({both.location, other.location})]
        assert p.gain == pytest.approx(max(options), rel=1e-6)
        # The penalty counts three amplitudes and the choice of a shape.
        assert p.nats == pytest.approx(p.gain - half_log * (2 + 1 + 1), rel=1e-6)


def test_values_are_those_of_the_solution(by_hand):
    (both, _, step), slopes, r, test = by_hand
    (p,) = test.pairs([both.location, step.location])
    gains = []
    for k in (0, 1):
        J = np.vstack([slopes[(both.location, k)], slopes[(step.location, 0)]])
        a = np.linalg.lstsq(J.T, -r, rcond=None)[0]
        gains.append((0.5 * r @ r - 0.5 * np.sum((r + a @ J) ** 2), k, a))
    _, k, a = max(gains, key=lambda g: g[0])
    first, second = p.starts
    np.testing.assert_allclose(first.values, a[:2] @ np.array(both.probes[k]), rtol=1e-5)
    np.testing.assert_allclose(second.values, min(a[2], MAX_THRESHOLD_AMPLITUDE) * 0.2, rtol=1e-5)


def test_what_hides_behind_another_has_synergy():
    """The residual is a difference of two nearly equal derivatives: only both together explain it."""
    rng = np.random.default_rng(6)
    a, b = candidate("viscous", "hub", (((1.0,),),)), candidate("viscous", "arm", (((1.0,),),))
    c = candidate("gravity", "arm", (((1.0,),),))
    shared, own = rng.normal(size=SAMPLES), rng.normal(size=(3, SAMPLES))
    slopes = {
        (a.location, 0): (shared + 0.2 * own[0])[None],
        (b.location, 0): (shared + 0.2 * own[1])[None],
        (c.location, 0): own[2][None],
    }
    r = 40 * (slopes[(a.location, 0)] - slopes[(b.location, 0)])[0] + rng.normal(size=SAMPLES)
    r += 2.0 * own[2]
    test = made([a, b, c], slopes, r)
    ((x, y), *_) = promising_pairs(test, test)
    assert set(x.locations) == {a.location, b.location} and x.locations == y.locations
    assert x.synergy > 0.5 * x.gain and x.more > 0
    # An effect is not paired with its own special case.
    rich = candidate("stribeck", "hub", (((1.0,),),))
    simple = candidate("coulomb", "hub", (((1.0,),),))
    slopes = {(rich.location, 0): own[:1], (simple.location, 0): own[1:2]}
    assert made([rich, simple], slopes, own[0] + own[1]).pairs([rich.location, simple.location]) == []


def test_a_richer_effect_that_gains_nothing_is_not_paired():
    """Asymmetric friction is paired only if its two levels differ; otherwise Coulomb friction is paired."""
    rng = np.random.default_rng(7)
    simple, other = candidate("coulomb", "hub", (((1.0,),),)), candidate("viscous", "arm", (((1.0,),),))
    rich = candidate("coulomb_asymmetric", "hub", (((1.0, 0.0), (0.0, 1.0)),))
    shared, own = rng.normal(size=SAMPLES), rng.normal(size=(3, SAMPLES))
    first, second = shared + 0.2 * own[0], shared + 0.2 * own[1]
    forward = np.where(np.arange(SAMPLES) % 2, first, 0.0)
    slopes = {
        (simple.location, 0): first[None],
        (other.location, 0): second[None],
        (rich.location, 0): np.array([forward, first - forward]),
    }
    for uneven, paired in ((0.0, simple), (20.0, rich)):
        r = 40 * (first - second) + uneven * forward + 0.3 * rng.normal(size=SAMPLES)
        test = made([simple, other, rich], slopes, r)
        together = test.pairs([c.location for c in (simple, other, rich)])
        assert {frozenset(p.locations) for p in together} == {
            frozenset({simple.location, other.location}),
            frozenset({rich.location, other.location}),
        }
        places = [frozenset(a.locations) for a, _ in promising_pairs(test, test)]
        assert places[0] == {paired.location, other.location}
        assert uneven or len(places) == 1


def scored(location: EffectLocation, gain: float) -> Score:
    start = CandidateStart(location, np.zeros(1), expected_gain=gain)
    return Score(start, gain, True, 1.0, 1.0)


def test_the_best_candidates_of_both_horizons():
    """Gains are added as shares of the best one, so that the horizon with larger gains does not dominate."""
    places = [EffectLocation("viscous", p) for p in "abcd"]
    tests = [
        ScoreTest([scored(p, g) for p, g in zip(places, gains, strict=True)], {}, None)
        for gains in ((1000.0, 100.0, 0.0, -5.0), (1.0, 8.0, 10.0, -np.inf))
    ]
    assert best_candidates(*tests, 10) == [places[0], places[2], places[1]]
    assert best_candidates(*tests, 1) == places[:1]
    assert ScoreTest([], {}, None).pairs([]) == []


STRIBECK, DAHL = EffectLocation("stribeck", "hub"), EffectLocation("dahl", "hub")
SPRING, VISCOUS = EffectLocation("cubic_spring", "joint"), EffectLocation("viscous", "arm")


@pytest.fixture(scope="module")
def s() -> SuperModel:
    wanted = ((fx.Stribeck, "hub"), (fx.Dahl, "hub"), (fx.CubicSpring, "joint"), (fx.Viscous, "arm"))
    return build(sp.baseline(), wanted, scales(Model(sp.baseline()), sp.recordings(sp.records()), 0.1))


def usual(s: SuperModel, location: EffectLocation) -> np.ndarray:
    return np.array(s.candidates[location].probes[0][0])


def grown(s: SuperModel, h: Hypothesis, location: EffectLocation, size: float) -> Hypothesis:
    """A hypothesis with an effect of `size` times its usual size; training likelihood grows with `size`."""
    more = with_effect(s, h, CandidateStart(location, size * usual(s, location)), 1.0)
    return dataclasses.replace(more, densities=np.full((2, 1), size))


def validated(h: Hypothesis, gain: float, **more) -> ValidatedHypothesis:
    return ValidatedHypothesis(h, np.array([gain / 2, gain / 2]), h, np.ones(2), **more)


def alone(s, location, gains: tuple[float, float], sizes=(1.0, 1.0), h=None) -> ValidatedHypothesis:
    """A model (None: the baseline) with one more effect, its validation gains and sizes at both horizons."""
    fits = [grown(s, h or sp.unfitted(s), location, x) for x in sizes]
    return validated(fits[0], gains[0], location=location, free_run=validated(fits[1], gains[1]))


def placed(found) -> set[EffectLocation]:
    return set(found[0].locations)


def baseline_of(s: SuperModel) -> ValidatedHypothesis:
    h = sp.unfitted(s)
    return validated(h, 0.0, free_run=validated(h, 0.0))


def test_what_each_horizon_gained_most_by_is_refitted_together(s):
    """The effects with the largest gain at each horizon are paired, starting from their single refits."""
    known = [alone(s, VISCOUS, (20.0, 3.0)), alone(s, SPRING, (100.0, -5.0), (1.0, 2.0))]
    known += [alone(s, STRIBECK, (0.0, 29.0)), alone(s, DAHL, (-5.0, 30.0), (3.0, 4.0))]
    both = best_refitted(s, baseline_of(s), known)
    for pair, place in zip(both, (0, 1), strict=True):
        assert pair.locations == (SPRING, DAHL)
        for start, h, sizes in zip(pair.starts, pair.alone, ((1.0, 2.0), (3.0, 4.0)), strict=True):
            np.testing.assert_allclose(start.values, sizes[place] * usual(s, start.location))
            assert set(h.locations) - set(s.calibrations) == {start.location}
            np.testing.assert_allclose(h.mean_values(s)[s.parameter_indices(start.location)], start.values)
    # Viscous friction, with nearly the largest gain in predictions, is not paired.
    known = [alone(s, SPRING, (1.0, 0.3)), alone(s, VISCOUS, (0.95, 0.2)), alone(s, DAHL, (0.0, 1.0))]
    assert placed(best_refitted(s, baseline_of(s), known)) == {SPRING, DAHL}


def test_where_one_effect_leads_at_both_horizons_the_next_one_joins(s):
    """The next effect has the next largest sum of gain shares, and is no other law of the same friction."""
    known = [alone(s, DAHL, (100.0, 30.0)), alone(s, SPRING, (20.0, 20.0)), alone(s, VISCOUS, (30.0, 3.0))]
    assert placed(best_refitted(s, baseline_of(s), known)) == {DAHL, SPRING}
    known = [alone(s, STRIBECK, (90.0, 29.0)), alone(s, DAHL, (-5.0, 30.0)), alone(s, VISCOUS, (20.0, 3.0))]
    assert placed(best_refitted(s, baseline_of(s), known)) == {STRIBECK, VISCOUS}


def test_of_two_fits_of_one_effect_the_likelier_counts(s):
    """If an effect was refitted from two models, the fit with the larger training likelihood counts."""
    known = [alone(s, SPRING, (100.0, 1.0)), alone(s, VISCOUS, (0.0, 20.0)), alone(s, DAHL, (0.0, 30.0))]
    stuck = alone(s, DAHL, (0.0, -1.0), (0.5, 0.5))
    for tried in ([*known, stuck], [stuck, *known]):
        assert placed(best_refitted(s, baseline_of(s), tried)) == {SPRING, DAHL}


def test_effects_of_another_model_are_no_pair(s):
    """Left out: effects that gained nothing, are in the model, were added to another, or lack free runs."""
    spring, dahl = alone(s, SPRING, (100.0, -5.0)), alone(s, DAHL, (-5.0, 30.0))
    for few in ([], [spring], [spring, alone(s, DAHL, (-1.0, 0.0))]):
        assert best_refitted(s, baseline_of(s), few) is None
    current = dataclasses.replace(baseline_of(s), hypothesis=spring.hypothesis)
    beside = alone(s, VISCOUS, (1.0, 2.0), h=spring.hypothesis)
    assert best_refitted(s, current, [spring, dahl, beside]) is None
    here = alone(s, DAHL, (1.0, 3.0), h=spring.hypothesis)
    assert placed(best_refitted(s, current, [spring, dahl, beside, here])) == {VISCOUS, DAHL}
    predicted = dataclasses.replace(alone(s, VISCOUS, (20.0, 3.0)), free_run=None)
    assert best_refitted(s, baseline_of(s), [spring, predicted]) is None


def test_a_pair_is_refitted_from_its_likeliest_start(s, monkeypatch: pytest.MonkeyPatch):
    """Both effects are added to the current model, or one of them to a model that has the other one."""
    h = sp.unfitted(s)
    monkeypatch.setattr(pairs, "refit", lambda problem, starts: starts)
    moved = grown(s, h, DAHL, 3.0)
    moved = dataclasses.replace(moved, z=moved.z + 1e-3)
    ends = tuple(CandidateStart(p, usual(s, p)) for p in (SPRING, DAHL))
    pair = PairStart(ends, alone=(grown(s, h, SPRING, 2.0), moved))
    for wanted in (h, *pair.alone):
        near = SimpleNamespace(
            supermodel=s, likeliest=lambda hs, z=wanted.z: max(hs, key=lambda x: -np.count_nonzero(x.z - z))
        )
        (both,) = refit_pairs(near, h, [pair])
        assert {SPRING, DAHL} <= set(both.locations) and len(both.locations) == len(h.locations) + 2
        added = {SPRING, DAHL} - set(wanted.locations)
        changed = set(np.flatnonzero(both.z != wanted.z).tolist())
        assert changed <= {int(i) for p in added for i in s.parameter_indices(p)}


def test_a_pair_of_the_best_effects_is_tried_once(s, monkeypatch: pytest.MonkeyPatch):
    """It is tried after the pairs from the score tests, and also if there are none of these."""

    def score(*locations: EffectLocation) -> PairScore:
        a, b = (CandidateStart(p, usual(s, p)) for p in locations)
        return PairScore((a, b), 1.0, 1.0, 1.0, 1.0)

    known = [alone(s, SPRING, (100.0, -5.0)), alone(s, DAHL, (-5.0, 30.0))]
    other, same = score(VISCOUS, STRIBECK), score(DAHL, SPRING)
    asked: list[list] = []
    monkeypatch.setattr(pairs, "validated_pairs", lambda *given: asked.append(list(given[2])) or {})
    at = SimpleNamespace(problem=SimpleNamespace(supermodel=s, measured_values=1, noise=np.ones(2)))
    given = SimpleNamespace(prediction=at), baseline_of(s), (None, None), None, lambda line: None
    for scored in ([other], [same, other], []):
        monkeypatch.setattr(pairs, "promising_pairs", lambda *_, found=scored: [(p, p) for p in found])
        assert find_pair(*given, known) == (None, [])
        last = asked[-1][-1][0]
        assert [p.locations for p, _ in asked[-1][:-1]] == [other.locations] * bool(scored)
        assert last.locations == ((DAHL, SPRING) if len(scored) == 2 else (SPRING, DAHL))
        for start in asked[-1][-1]:  # models are in the order of the locations
            for location, h in zip(start.locations, start.alone, strict=True):
                assert set(h.locations) - set(s.calibrations) == {location}
        assert isinstance(last, PairScore) == (len(scored) == 2)  # keeps the sizes from its score
    asked.clear()
    assert find_pair(*given) == (None, []) and not asked


def test_a_pair_with_implausible_parameters_is_said_to_be_left_out(s):
    starts = tuple(CandidateStart(p, np.zeros(1)) for p in (STRIBECK, SPRING))
    lines: list[str] = []
    pairs._say_gains({}, baseline_of(s), [(PairStart(starts), PairStart(starts))], lines.append)
    assert lines == [
        "  left out: stribeck at hub with cubic_spring at joint, since its parameters are not plausible"
    ]


@pytest.fixture(scope="module")
def small():
    """Recordings with little friction: likelihood, fitted baseline, and its score test."""
    problem = sp.problem(sp.recordings(sp.records(0.0015)))
    h = sp.fitted(problem)
    return problem, h, score_test(problem, h)


def test_a_pair_of_a_model_is_dense_least_squares_too(small):
    """The same with derivatives of the super-model, less the part that the baseline can still explain."""
    problem, _, test = small
    places = [sp.HUB, EffectLocation("cubic_spring", "joint"), EffectLocation("coulomb", "joint")]
    for p in test.pairs(places):
        slopes, lower, options = [], [], []
        for location in p.locations:
            c = test.candidates[location]
            assert len(c.probes) == 1
            slopes.append(test.projected.of(location, 0))
            lower += [0.0 if c.one_sided else -np.inf] * len(c.probes[0])
        options = dense(slopes, test.projected.r, lower, [np.inf] * len(lower))
        assert p.gain == pytest.approx(options, rel=1e-5)
        alone = {s.location: s.start.expected_gain for s in test.listed}
        assert p.gain >= max(alone[x] for x in p.locations) - 1e-6
        assert p.nats <= p.gain - np.log(problem.measured_values) + 1e-6


def test_a_pair_counts_only_plausible_sizes(small):
    """A pair of which one member is limited to half of its size gains three quarters, nearly."""
    problem, h, test = small
    s, spring = problem.supermodel, EffectLocation("cubic_spring", "joint")
    (p,) = test.pairs([sp.HUB, spring])
    (i,) = s.parameter_indices(sp.HUB)
    limit = 0.5 * p.starts[0].values[0]
    less = score_test(
        problem, h, is_plausible=lambda grown, place: place != sp.HUB or grown.mean_values(s)[i] <= limit
    )
    (q,) = less.pairs([sp.HUB, spring])
    share = q.starts[0].values[0] / p.starts[0].values[0]
    assert 0.45 < share <= 0.5
    assert q.starts[1].values[0] == pytest.approx(share * p.starts[1].values[0])
    assert q.gain == pytest.approx((1 - (1 - share) ** 2) * p.gain)
    alone = {x.location: x for x in less.listed}
    assert q.more == pytest.approx(q.nats - max(0.0, *(alone[x].nats for x in q.locations)))
    assert q.synergy == pytest.approx(
        q.gain - sum(max(alone[x].start.expected_gain, 0.0) for x in q.locations)
    )


def test_a_refit_of_a_pair_reaches_what_its_score_promises(small):
    problem, h, test = small
    spring = EffectLocation("cubic_spring", "joint")
    (p,) = test.pairs([sp.HUB, spring])
    (both,) = refit_pairs(problem, h, [p])
    assert set(both.locations) == {*h.locations, sp.HUB, spring}
    assert both.log_likelihood - h.log_likelihood == pytest.approx(p.gain, rel=0.25)


PAIR_WANTED = ((fx.Coulomb, "hub"), (fx.CubicSpring, "joint"), (fx.Coulomb, "joint"))
STIFFENS, JOINT = EffectLocation("cubic_spring", "joint"), EffectLocation("coulomb", "joint")


def horizons(hidden: dict) -> Horizons:
    """Training and validation recordings of a machine with these effects, with free runs of 0.8 s."""
    made = [
        make_record(hidden, seed=seed, seconds=1.6, fs=400.0, perturb=0.0, rms=1.5)
        for seed in (31, 32, 33, 34)
    ]
    found = sp.recordings(made)
    train, held_back = found[:2], found[2:]
    model, data = Model(sp.baseline()), sp.dataset(found[:2])
    s = build(sp.baseline(), PAIR_WANTED, scales(model, train, data.torque_scale))
    problem = LikelihoodProblem.of(s, sp.SOLVER, data, ("hub", "joint"))
    other = LikelihoodProblem.of(s, sp.SOLVER, prepare(model, held_back, like=data), ("hub", "joint"))
    return Horizons.of(model, problem, other, 0.8)


@pytest.mark.slow
@pytest.mark.parametrize("spring", [60.0, 0.0])
def test_a_pair_must_be_better_than_each_of_its_members(spring: float):
    """Two hidden effects are found as a pair; if only one is hidden, no pair is found."""
    hidden = {sp.HUB: {"level": 0.02}} | ({STIFFENS: {"coefficient": spring}} if spring else {})
    at = horizons(hidden)
    problem, runs = at.prediction.problem, at.free_run.problem
    h = fit_baseline(problem)
    current = at.validated(h, refit(runs, [as_free_run(runs, h)])[0])
    assert is_unexplained(at, current)
    tests = (score_test(problem, h), score_test(runs, current.free_run.hypothesis))
    lines: list[str] = []
    found, tried = find_pair(at, current, tests, lambda h, p: True, lines.append)
    if not spring:
        assert found is None
        return
    assert found and set(found.members) == {sp.HUB, STIFFENS} and found.rivals == {sp.HUB: [], STIFFENS: []}
    assert found.found in tried and all(v in tried for v in found.members.values())
    for location, less in found.members.items():
        assert set(found.found.hypothesis.locations) - set(less.hypothesis.locations) == {location}
        assert found.found.log_likelihood > less.log_likelihood > current.log_likelihood
    s = problem.supermodel
    i = s.parameter_indices(STIFFENS)[0]
    assert found.found.hypothesis.mean_values(s)[i] == pytest.approx(spring, rel=0.2)
    assert "looking one step further" in lines[0]
    assert not is_unexplained(at, found.found)
    # Models without a member that were fitted before are not fitted again.
    again, more = find_pair(at, current, tests, lambda h, p: True, lines.append, tried)
    assert again and all(again.members[p] is less for p, less in found.members.items())
    assert len(more) == len(tried) - 2
    # If the search had ended with another pair, this one is fitted and reported. If it has ended with this
    # one, nothing is fitted.
    pairs = promising_pairs(*tests)
    wrong = tuple(t.pairs([sp.HUB, JOINT])[0] for t in tests)
    (other,) = validated_pairs(at, current, [wrong], lambda h, p: True).values()
    (only,) = (p for p in pairs if set(p[0].locations) == {sp.HUB, STIFFENS})
    given = at, current, [only]
    fits, alike = pairs_passed_by(*given, other, lambda h, p: True, lines.append)
    assert [set(p) for p in alike] == [{sp.HUB, STIFFENS}] and len(fits) == 1
    assert all(v.free_run for v in fits)
    # Predictions are clearly worse with the wrong pair. It is named in the lines of progress, but not fitted
    # to free runs, so it has no probability.
    lines.clear()
    given_wrong = at, current, [wrong], found.found, lambda h, p: True, lines.append
    assert pairs_passed_by(*given_wrong) == ([], []) and len(lines) == 2
    assert predictions_apart(found.found, other) and not predictions_apart(other, found.found)
    nothing = pairs_passed_by(*given, other, lambda h, p: True, lines.append, known=[found.found])
    assert nothing == pairs_passed_by(*given, found.found, lambda h, p: True, lines.append) == ([], [])
