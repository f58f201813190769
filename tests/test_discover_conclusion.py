"""End of a search: signs that an effect stands in for another, limits of the verdict, the proposal."""

import dataclasses
import functools
import json
import math
import types
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_problem import HUB, NOISE, problem, recordings, records, start, supermodel

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.data.excitation import noise
from rotflex_jax.discover import conclusion, summary
from rotflex_jax.discover.conclusion import (
    LEAST_CHANGE,
    SCATTER,
    WindowSizes,
    end_state,
    nats_above_noise,
    proposed,
    seen_limits,
    signs,
    window_sizes,
    with_proposal,
)
from rotflex_jax.discover.discovery import Discovery
from rotflex_jax.discover.hypothesis import CandidateStart, Hypothesis, with_effect
from rotflex_jax.discover.likelihood import LikelihoodProblem, levenberg_marquardt
from rotflex_jax.discover.result import NEXT, HorizonGain, Round, Stage
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.tables import status_sentence
from rotflex_jax.discover.validation import SearchHorizon, ValidatedHypothesis, ValidationSet
from rotflex_jax.discover.verdict import Assessment, Grade, Verdict, assess, grade
from rotflex_jax.effects.labels import effect_phrase, effect_title
from rotflex_jax.effects.sensors import CrossTalk, EccentricEncoder, SensorGain
from rotflex_jax.mechanism import simulate
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import specifications
from rotflex_jax.recording import Recording


def with_friction(at: LikelihoodProblem, level: float) -> Hypothesis:
    """A fit that starts with friction of this level at the hub."""
    h = with_effect(supermodel(), start(at), CandidateStart(HUB, np.array([level])), 1.0)
    return levenberg_marquardt(at, [h])[0]


def mixed(levels: tuple[float, float]) -> LikelihoodProblem:
    """Two recordings of machines with these levels of friction."""
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
    """Friction of 0.012 and 0.028 N m is +-40 % around its mean."""
    at = mixed((0.012, 0.028))
    sizes = window_sizes(at, with_friction(at, 0.03), [HUB])[HUB]
    assert 0.25 < sizes.scatter < 0.55


def test_an_effect_that_does_little_changes_little():
    """With a hundredth of the true friction, the change by it is small against the error that is left."""
    at = mixed((0.02, 0.02))
    s, h = supermodel(), start(at)
    little = with_effect(s, h, CandidateStart(HUB, np.array([2e-4])), 1.0)
    assert window_sizes(at, little, [HUB])[HUB].change < LEAST_CHANGE / 5


def test_nats_above_the_noise_by_hand(same):
    """`N log(rms / noise)` by hand, summed over channels whose error is above the noise."""
    at, h = same
    e, counted = at.innovations([h])[0], at.seen > 0
    # Far below any error, so that each channel counts.
    tiny = dataclasses.replace(at, dataset=dataclasses.replace(at.dataset, noise=NOISE * 1e-3))
    rms = np.sqrt(np.mean(e[counted] ** 2, axis=0))
    expected = counted.sum() * (np.log(rms[0] / (1e-3 * NOISE[0])) + np.log(rms[1] / (1e-3 * NOISE[1])))
    assert nats_above_noise(tiny, h) == pytest.approx(expected, rel=1e-9)
    huge = dataclasses.replace(at, dataset=dataclasses.replace(at.dataset, noise=NOISE * 1e3))
    assert nats_above_noise(huge, h) == 0.0
    # Samples with `seen` zero do not count, however large their error.
    errors, seen = np.full((1, 8, 1), 2.0), np.arange(8)[None] < 6
    errors[:, 6:] = 1e6
    of = {"innovations": lambda hypotheses: [errors], "seen": seen.astype(float), "noise": np.ones(1)}
    part: Any = SimpleNamespace(**of)
    part.channel_errors = functools.partial(LikelihoodProblem.channel_errors, part)
    assert nats_above_noise(part, h) == pytest.approx(6 * np.log(2.0))


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
@pytest.mark.parametrize("beyond", [None, "scatter", "change", "gain", "any scatter", "no change"])
def test_the_limit_of_each_sign_from_both_sides(beyond, folds, monkeypatch: pytest.MonkeyPatch):
    """The limits are 15 % of the size, half of the error that is left, and the nats left in both sets.

    The worse of training and validation data counts for the first two.
    """
    space = types.SimpleNamespace
    validation = space(folds=folds, problem="free runs, held out", window_seconds=2.0)
    prediction = space(problem="predictions", validation=space(folds=folds, problem="predictions, held out"))
    runs = space(hypothesis=space(locations=(HUB,)), adapted=None)
    scatter = {"scatter": 0.152, "any scatter": 2e4}.get(beyond, 0.15)
    change = {"change": 0.495, "no change": 1.9e-6}.get(beyond, 0.5)
    sizes = {"free runs": WindowSizes(0.01, 9.0), "free runs, held out": WindowSizes(scatter, change)}
    if folds:  # there are no recordings but those for training
        sizes = {"free runs": sizes["free runs, held out"]}
    left = {"predictions": 30.0, "predictions, held out": 20.0}
    monkeypatch.setattr(conclusion, "window_sizes", lambda problem, h, locations: {HUB: sizes[problem]})
    monkeypatch.setattr(conclusion, "nats_above_noise", lambda problem, h: left[problem])
    rest = 60.0 if folds else 50.0
    final = space(free_run=runs, hypothesis=None, adapted=None)
    horizons = (prediction, space(problem="free runs", validation=validation))
    found = signs(horizons, final, {HUB: rest - 0.1 if beyond == "gain" else rest})[HUB]
    words = {"scatter": "windows of 2 s differ by 15%", "change": "changes free runs by 0.49 of the error"}
    words |= {"any scatter": "by more than 1000% on its size", "no change": "by less than 0.01 of the error"}
    words |= {"gain": f"{rest:.0f} are left above the sensor noise"}
    assert len(found) == (beyond is not None)
    assert beyond is None or words[beyond] in found[0]


def test_sensor_faults_of_an_impossible_size_are_not_physical():
    """A cross-talk of a fifth of the servo angle or a disc 8 degrees off centre is outside the ranges."""
    for fault, names in ((CrossTalk, ("share",)), (EccentricEncoder, ("sine", "cosine"))):
        for name in names:
            low, high = specifications(fault(at="theta"))[name].physical
            assert -0.14 < low < -0.02 < 0.02 < high < 0.14
    # A gain may be wrong by a third. A tenth of the true value, or ten times this value, is another unit.
    low, high = specifications(SensorGain(at="alpha"))["error"].physical
    assert -0.9 < low < -0.3 < 0.5 < high < 9.0


def test_a_window_that_diverges_says_nothing(same):
    """Scatter and change are computed without it; there is no result if all windows diverge."""
    at, h = same
    x0 = h.x0.copy()
    x0[0, 0] = np.nan
    sizes = window_sizes(at, dataclasses.replace(h, x0=x0), [HUB])[HUB]
    assert sizes.scatter < SCATTER / 3 and sizes.change > 2 * LEAST_CHANGE
    assert window_sizes(at, dataclasses.replace(h, x0=np.full_like(x0, np.nan)), [HUB]) == {}


def test_one_effect_in_the_place_of_several_has_the_signs_of_its_part(monkeypatch: pytest.MonkeyPatch):
    """A merged effect is in no fit at both horizons, so it gets the signs of the effect that it replaces."""
    merged = EffectLocation("coulomb_asymmetric", "hub")
    state = types.SimpleNamespace(
        gains={HUB: (HorizonGain(1.0, 2.0, 0.5, 3.0), None), merged: (HorizonGain(1.0, 2.0, 0.5, 3.0), None)},
        horizons=types.SimpleNamespace(prediction=None, free_run=None),
        current=None,
        order=[merged],
        in_place_of={merged: HUB},
    )
    asked = {}
    monkeypatch.setattr(summary, "signs", lambda *a: asked.update(gains=a[2]) or {HUB: ("it is small",)})
    assert summary.stand_ins(state)[merged] == ("it is small",)
    assert asked["gains"][HUB] == 4.0


def test_a_bias_beside_another_fault_of_its_sensor_is_provisional(monkeypatch: pytest.MonkeyPatch):
    """The other fault may look like a bias. Faults of other sensors, friction and channel delays may not."""
    rectifier, bias, other = (
        EffectLocation(*p)
        for p in (("rectifier", "alpha"), ("sensor_bias", "alpha"), ("sensor_bias", "theta"))
    )
    state = types.SimpleNamespace(
        gains={},
        horizons=types.SimpleNamespace(prediction=None, free_run=None),
        current=None,
        order=[HUB, rectifier, bias, other],
        in_place_of={},
    )
    monkeypatch.setattr(summary, "signs", lambda *a: {bias: ("it is small",)})
    small, beside = summary.stand_ins(state).pop(bias)
    assert small == "it is small"
    assert beside == (
        "alpha has another fault (rectifying sensor of alpha), a part of which may look like a bias"
    )
    assert set(summary.stand_ins(state)) == {bias}
    # A channel delay causes no error at rest.
    state.order = [EffectLocation("channel_delay", "alpha"), bias]
    assert summary.stand_ins(state) == {bias: ("it is small",)}


HELPS = HorizonGain(1.0, 2.0, 0.5)
NEAR = 1.5  # times the noise of the sensor


RANKED = [("coulomb", "hub"), ("quadratic_drag", "hub"), ("viscous", "arm"), ("dead_zone", "input")]


def told(
    *,
    before: float = 100.0,
    ratio: float = 1.0,
    noise_nats: float = 0.0,
    rounds: tuple[tuple[str, ...], ...] = (),
    excited: int = 4,
    candidates: int = 4,
    imitated: int = 0,
    by_noise: float = 0.0,
) -> tuple[Verdict, str]:
    """Verdict and sentence of a search with these errors over the noise and equivalents of each round."""
    floor = {"theta": 5e-4, "alpha": 2e-3}
    errors = {"theta": 5e-4, "alpha": 2e-3 * ratio}
    baseline: Any = SimpleNamespace(held_out_rmse_windows={c: before * e for c, e in errors.items()})
    final: Any = SimpleNamespace(
        held_out_rmse_windows=errors,
        process_noise_nats=noise_nats,
        window_seconds=2.0,
        expected={"alpha": by_noise * 2e-3} if by_noise else {},
    )
    found: Any = [
        SimpleNamespace(effect="coulomb", port="hub", equivalent=others, phrase=noun + " at the hub")
        for others in rounds
        for noun in ("dry friction" if others else "Coulomb friction",)
    ]
    ranking: Any = [
        SimpleNamespace(
            excited=k < excited, location=(name, port), orthogonal_fraction=0.001 if k < imitated else 0.5
        )
        for k, (name, port) in zip(range(candidates), RANKED * candidates, strict=False)
    ]
    return end_state(baseline, found, final, floor, ranking)


def ended(**given: Any) -> Verdict:
    """The verdict alone."""
    return told(**given)[0]


@pytest.mark.parametrize(("share", "explained"), [(0.999, True), (1.001, False)])
def test_an_error_that_noise_alone_causes_is_explained(share: float, explained: bool) -> None:
    verdict, sentence = told(ratio=3.0 * NEAR * share, by_noise=3.0, rounds=((),))
    assert verdict == (Verdict.FOUND if explained else Verdict.UNEXPLAINED)
    assert "times the sensor noise (alpha 3.00 by noise in the first samples alone)" in sentence


@pytest.mark.parametrize(("share", "explained"), [(0.999, True), (1.001, False)])
@pytest.mark.parametrize("rounds", [(), ((),)])
def test_explained_is_near_the_noise_of_every_sensor(share: float, explained: bool, rounds: Any) -> None:
    verdict = ended(ratio=NEAR * share, rounds=rounds)
    good = Verdict.FOUND if rounds else Verdict.NOTHING_MISSING
    assert verdict == (good if explained else Verdict.UNEXPLAINED)


@pytest.mark.parametrize(("share", "explained"), [(0.999, True), (1.001, False)])
def test_explained_leaves_little_to_process_noise(share: float, explained: bool) -> None:
    # 0.03 nat for each measured value of the training recordings.
    verdict = ended(noise_nats=0.03 * share)
    assert verdict == (Verdict.NOTHING_MISSING if explained else Verdict.UNEXPLAINED)


def test_an_unexplained_recording_is_told_what_is_certain_of_it() -> None:
    sentence = told(ratio=2 * NEAR, rounds=(("stribeck",),))[1]
    assert sentence.startswith("dry friction at the hub found, but something remains")
    # Where the recording is explained, the effect is named, and others listed with it.
    assert told(rounds=(("stribeck",),))[1].startswith("Coulomb friction at the hub explains")


FRICTION, OTHER_LAWS = ("coulomb", "hub"), (("stribeck", "hub"), ("lugre", "hub"))


@pytest.mark.parametrize(
    ("effect", "equivalent", "doubts", "certain"),
    [
        (FRICTION, OTHER_LAWS, (), "dry friction at the hub"),
        (FRICTION, (), (), ""),
        (FRICTION, OTHER_LAWS, ("it is small",), ""),
        (FRICTION, (*OTHER_LAWS, ("stribeck", "arm")), (), ""),
        (FRICTION, (*OTHER_LAWS, ("dead_zone", "input")), (), ""),
        (("delay", "input"), (("lag", "input"),), (), "late input"),
        # Neither effect is a law.
        (("dead_zone", "input"), (("saturation", "input"),), (), ""),
    ],
)
def test_what_is_certain_where_a_law_is_not(effect, equivalent, doubts, certain) -> None:
    """The thing is certain if all equivalents are its laws at the same port, and there is no other doubt."""
    (like,) = found().rounds
    turn = dataclasses.replace(
        like, effect=effect[0], port=effect[1], equivalent=equivalent, doubts=doubts, prediction=HELPS
    )
    assert turn.certain == turn.to_dict()["certain"] == certain
    assert turn.status == ("provisional" if equivalent or doubts else "established")
    if not certain:
        assert "certain" not in turn.doubt and turn.phrase == effect_phrase(*effect)
        assert "as a law" not in status_sentence(turn)
        return
    laws = " or ".join(effect_title(e) for e, _ in (effect, *equivalent)).replace(
        " or ", ", ", len(equivalent) - 1
    )
    assert turn.phrase == certain
    assert turn.doubt == f"{certain} is certain, but not whether it is {laws}"
    assert status_sentence(turn) == f"Provisional as a law: {turn.doubt}."


def test_one_round_that_others_equal_makes_the_end_ambiguous() -> None:
    assert ended(rounds=((), ("stribeck",))) == Verdict.AMBIGUOUS
    assert ended(rounds=((), ())) == Verdict.FOUND


def test_more_than_half_of_the_candidates_must_have_shown() -> None:
    assert ended(excited=2, candidates=4) == Verdict.NOTHING_MISSING
    assert ended(excited=1, candidates=4) == Verdict.NOT_EXCITED
    assert ended(excited=2, candidates=5) == Verdict.NOT_EXCITED
    assert ended(excited=0, candidates=0) == Verdict.NOTHING_MISSING


TS, SD = 0.01, 5e-4


def found(verdict: Verdict = Verdict.AMBIGUOUS) -> Discovery:
    """The result of a search that found a delay, with a lag as its equivalent."""
    m = rf.joints.paper(joint_damping=0.003, hub_damping=0.004)
    grown = m + fx.Delay(time=0.012)
    u = noise(400, TS, rms=0.8, seed=1)
    y = simulate(grown, u, TS) + SD * np.random.default_rng(0).standard_normal((400, 2))
    rec = rf.Recording(u=u, y=y, Ts=TS)
    errors = {"theta": SD, "alpha": SD}
    stages = [
        Stage(Model(x), (), errors, errors, (y,), (y,), 2.0, {"hub": 0.0, "joint": 0.0}, 0.0, 0.0)
        for x in (m, grown)
    ]
    turn = Round("delay", "input", (("lag", "input"),), {}, stages[1], 1.0, 1.0, "late", "v(t) = u(t - time)")
    return Discovery(verdict, "Either.", (rec,), (rec,), stages[0], (turn,), (), (), errors, 1.0)


@pytest.fixture(scope="module")
def answered():
    old, conclusion.PROPOSAL_SECONDS = conclusion.PROPOSAL_SECONDS, 3.0
    try:
        return with_proposal(found())
    finally:
        conclusion.PROPOSAL_SECONDS = old


def test_the_best_standard_input_is_proposed_within_what_the_machine_has_borne(answered):
    e, limits = answered.proposal, seen_limits(answered.train, answered.final.model)
    assert e.separates == ("delay@input", "lag@input")
    assert e.chosen.input in {"noise", "multisine", "prbs", "steps", "sweep"}
    assert np.max(np.abs(e.u)) <= limits.voltage == np.max(np.abs(answered.train[0].u))
    assert e.chosen.peaks["alpha"] <= limits.deflection
    assert e.parameters["delay@input"]["time"] == 0.012
    # The rival fit gives a lag of about the same time.
    assert e.parameters["lag@input"]["time"] == pytest.approx(0.012, rel=0.5)
    assert e.chosen.nats > 1


def test_the_json_keeps_its_contract(answered):
    told = json.loads(json.dumps(answered.to_dict()))["next_experiment"]
    assert told["separates"] == ["delay@input", "lag@input"]
    assert told["input"] == answered.proposal.chosen.input
    assert told["file"] == NEXT


@pytest.mark.parametrize("verdict", sorted(set(Verdict) - {Verdict.AMBIGUOUS}))
def test_nothing_is_proposed_where_nothing_is_open(verdict):
    plain = found(verdict)
    assert with_proposal(plain) is plain
    assert plain.to_dict()["next_experiment"] is None


def test_no_design_without_an_equal():
    alone = dataclasses.replace(found(), rounds=())
    assert proposed(alone) is None and alone.next_experiment() is None


def test_a_proposal_that_fails_is_a_note():
    """Here the equivalent effect is not in the catalogue."""
    result = found()
    turn = dataclasses.replace(result.rounds[0], equivalent=(("unknown", "input"),))
    told = with_proposal(dataclasses.replace(result, rounds=(turn,)))
    assert told.proposal is None
    assert "No next experiment" in told.notes[-1] and "unknown" in told.notes[-1]


@pytest.mark.parametrize(
    ("times", "expected"),
    [(1.499, Grade.NOISE), (1.5, Grade.NEAR), (4.99, Grade.NEAR), (5.0, Grade.FAR), (math.nan, None)],
)
def test_the_grade_of_an_error(times: float, expected: Grade | None) -> None:
    assert grade(times) is expected
    # Of several channels the worst one counts, among those with known noise.
    assert Assessment({}, {"theta": times, "alpha": 0.5, "beta": math.nan}, 0.0).grade is (
        expected or Grade.NOISE
    )


def test_a_sensor_of_unknown_noise_leaves_the_verdict_open() -> None:
    unknown = Assessment({}, {"theta": math.nan, "alpha": 1.0}, 0.0)
    assert not unknown.is_explained and "noise of theta is not known" in unknown.criterion
    worse = Assessment({}, {"theta": math.nan, "alpha": 7.0, "beta": 6.0}, 0.0)
    assert worse.criterion == (
        "errors of short free runs are theta an unknown number of, alpha 7.00, beta 6.00 times the sensor "
        "noise (limit 1.5)"
    )
    assert Assessment({}, {"theta": math.nan}, 0.0).grade is None
    assert "hardly likelier with a random torque" in Assessment({}, {"theta": 1.0}, 0.0).criterion


def test_shares_and_nats_of_nothing_are_no_numbers() -> None:
    end = assess({"theta": 0.0, "alpha": 2.0}, {"theta": 0.1, "alpha": 1.0}, {}, 0.5)
    assert math.isnan(end.explained["theta"]) and end.explained["alpha"] == 75.0
    assert end.explained_text == "alpha 75.0 % of the baseline's squared error is explained"
    written = end.to_dict()
    assert written["explained_percent"] == {"theta": None, "alpha": 75.0}
    assert written["remaining_over_noise"] == {"theta": None, "alpha": None}
    assert assess({}, {}, {}, math.nan).to_dict()["random_torque_nats_per_value"] is None


@pytest.mark.parametrize("after", [0.1, math.inf])
def test_a_baseline_that_diverges_has_no_share_that_is_explained(after) -> None:
    end = assess({"theta": math.inf, "alpha": 2.0}, {"theta": after, "alpha": 1.0}, {}, 0.5)
    assert end.explained_text == "alpha 75.0 % of the baseline's squared error is explained"
    assert end.to_dict()["explained_percent"] == {"theta": None, "alpha": 75.0}


def test_candidates_that_could_not_have_shown_are_a_step() -> None:
    said = "2 of 9 candidates could not have shown here"
    for verdict in Verdict:
        steps = verdict.next_steps([("friction", "lag"), ("play", "delay")], 2, 9)
        assert any(said in s for s in steps) is (verdict is not Verdict.NOT_EXCITED)
        assert not any("candidates could not" in s for s in verdict.next_steps([], 0, 9))
        pairs = [s for s in steps if "friction from lag" in s or "play from delay" in s]
        assert len(pairs) == (2 if verdict is Verdict.AMBIGUOUS else 0)


def test_the_machine_has_borne_the_most_of_any_recording() -> None:
    """The limits are the largest voltage, slew rate and deflection, each over all recordings."""
    k = np.arange(60)
    slow, quick = (np.sin(k / 20), 0.5 * np.sin(k))
    y = np.column_stack([np.cos(k / 9), 0.1 * np.cos(k / 9)])
    both = tuple(
        Recording(u=u, y=y * scale, Ts=Ts) for u, scale, Ts in ((slow, 2.0, 0.01), (quick, 1.0, 0.02))
    )
    joint = rf.Model(rf.joints.paper())
    limits = seen_limits(both, joint)
    assert limits.voltage == pytest.approx(np.max(np.abs(slow)))
    assert limits.slew == pytest.approx(np.max(np.abs(np.diff(quick))) / 0.02)
    assert limits.margin == 0.0
    # From its start, which is the largest value of the cosine: the way to the least one.
    assert limits.deflection == pytest.approx(0.1 * 2.0 * (1 - np.cos(k / 9).min()))
    alone = tuple(Recording(u=r.u, y=r.y[:, :1], Ts=r.Ts) for r in both)
    bare = rf.joints.paper()
    single = dataclasses.replace(bare, outputs=bare.outputs[:1])
    assert seen_limits(alone, rf.Model(single)).deflection == np.inf


def test_a_fall_of_the_voltage_is_a_change_too() -> None:
    """A sawtooth that rises over 50 samples and falls within one has the slew rate of its fall."""
    u = np.tile(np.linspace(0.0, 1.0, 51), 4)
    recording = Recording(u=u, y=np.column_stack([u, 0.1 * u]), Ts=0.01)
    assert seen_limits((recording,), rf.Model(rf.joints.paper())).slew == pytest.approx(100.0)


def test_the_deflection_is_that_of_the_model_in_any_order_of_the_columns() -> None:
    k = np.arange(60)
    theta, alpha, current = np.sin(k / 9), 0.1 * np.sin(k / 9), 5 * np.cos(k / 5)
    one, other = (
        Recording(u=np.sin(k / 20), y=np.column_stack(columns), Ts=0.01, channels=names, units=units)
        for columns, names, units in (
            ((theta, alpha, current), ("theta", "alpha", "current"), ("rad", "rad", "A")),
            ((alpha, theta), ("alpha", "theta"), ("rad", "rad")),
        )
    )
    for recording in (one, other):
        limits = seen_limits([recording], rf.Model(rf.joints.paper()))
        assert limits.deflection == pytest.approx(np.abs(alpha).max())


def test_sizes_in_windows_by_hand() -> None:
    """One Gauss-Newton step of the amplitude in each window, orthogonal to the local parameter."""
    rng = np.random.default_rng(0)
    R, N, C = 2, 60, 2
    names = ("hub.coulomb.level", "arm.inertia.inertia", "offset of a recording")
    J, e = rng.standard_normal((3, R, N, C)), rng.standard_normal((R, N, C))
    value, derivative = 0.03, 0.5
    J[0] *= 20.0
    problem: Any = SimpleNamespace(
        supermodel=SimpleNamespace(mechanism=SimpleNamespace(parameter_names=names)),
        seen=np.ones((R, N)),
        slopes=lambda hypotheses: (
            e[None],
            np.concatenate([J, J[:1]])[None],
        ),  # the last row is beyond `moved`
        windows=SimpleNamespace(of=lambda r: [(0, slice(0, 25)), (1, slice(25, N))]),
    )
    h: Any = SimpleNamespace(
        whitener=lambda x, seen: x,
        moved=3,
        free=(1, 0),
        local=(2,),
        physical=lambda s: (
            np.tile([value, 1.0, 0.2], (R, 1)),
            np.tile([derivative, 1.0, 1.0], (R, 1)),
        ),
    )
    sizes = window_sizes(problem, h, [EffectLocation("coulomb", "hub"), EffectLocation("lugre", "arm")])
    wanted = acts = rest = 0.0
    for r in range(R):
        for samples in (slice(0, 25), slice(25, N)):
            # Rows are the free parameters, then the local one; the level is the second free parameter.
            slope, other = J[1, r, samples].ravel() / derivative, J[2, r, samples].ravel()
            left = e[r, samples].ravel()
            slope, left = (x - other * (other @ x) / (other @ other) for x in (slope, left))
            step = (slope @ left) / (slope @ slope)
            wanted += np.sum((step * slope) ** 2)
            acts += np.sum((value * slope) ** 2)
            rest += left @ left
    assert list(sizes) == [EffectLocation("coulomb", "hub")]
    (found,) = sizes.values()
    assert found.scatter == pytest.approx(np.sqrt(wanted / acts))
    assert found.change == pytest.approx(np.sqrt(acts / rest))
    e *= 1e-6
    J *= 1e-6
    again = window_sizes(problem, h, [EffectLocation("coulomb", "hub")])[EffectLocation("coulomb", "hub")]
    assert again == pytest.approx(found)  # in any unit
    # There is no result for runs without an error, or for an effect that changes nothing.
    e[:] = 0.0
    assert window_sizes(problem, h, [EffectLocation("coulomb", "hub")]) == {}
    e[:], J[1] = 1.0, 0.0
    assert window_sizes(problem, h, [EffectLocation("coulomb", "hub")]) == {}


FOUND = "Coulomb friction at the hub"
REACHED = "the held-out error over 2 s is theta 1.00, alpha 1.00 times the sensor noise"
SHARE = "; theta > 99.99 %, alpha > 99.99 % of the baseline's squared error is explained"
REMAINS = "something remains that no candidate explains"
DRAG, DAMPING = "quadratic drag at the hub", "viscous damping at the arm"
LOOK = (
    "look like other values of the fitted parameters here (to 99 %): a motion with more reversals, "
    "speeds and amplitudes tells them apart"
)
TORQUE = "predictions are likelier with a random torque (0.1 nat per measured value, limit 0.03)"
WITHIN = "errors of free runs over 2 s are within 1.5 times the sensor noise"


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({}, f"Nothing is missing: {REACHED}."),
        ({"excited": 3}, f"Nothing is missing: {REACHED}; 1 of 4 candidates could not have shown."),
        ({"imitated": 1}, f"Nothing is missing: {REACHED}; but {FOUND} would {LOOK}."),
        (
            {"imitated": 4, "excited": 4},
            f"Nothing is missing: {REACHED}; but {FOUND}, {DRAG}, {DAMPING} and 1 more would {LOOK}.",
        ),
        ({"rounds": ((),)}, f"{FOUND} explains the recording: {REACHED}{SHARE}."),
        ({"rounds": ((),), "before": 1.0}, f"{FOUND} explains the recording: {REACHED}."),
        (
            {"rounds": (("lag",),)},
            f"{FOUND} explains the recording, but it cannot distinguish this from others (listed with it): "
            f"{REACHED}{SHARE}.",
        ),
        (
            {"rounds": ((), ("lag",))},
            f"{FOUND} and {FOUND} explain the recording, but it cannot distinguish some of them from others "
            f"(listed with each): {REACHED}{SHARE}.",
        ),
        ({"ratio": 3.0}, f"S{REMAINS[1:]}: {REACHED.replace('alpha 1.', 'alpha 3.')}."),
        (
            {"noise_nats": 0.1, "rounds": ((),)},
            f"{FOUND} found, but {REMAINS}: {REACHED}; {WITHIN}, but {TORQUE}{SHARE}.",
        ),
        (
            {"excited": 1},
            "Nothing was found, but 3 of 4 candidates could not have shown in this recording: move the "
            "machine more, over more speeds and voltages.",
        ),
    ],
)
def test_the_sentence_gives_the_reason(given: dict[str, Any], sentence: str) -> None:
    given = {"before": 1e4} | given
    assert told(**given)[1] == sentence


def test_the_first_effect_with_an_equal_is_asked_about(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the settings of the longest recording; the rival is fitted to its first ten seconds."""
    monkeypatch.setattr(conclusion, "next_experiment", lambda *given, **settings: (given, settings))
    k = np.arange(3000)
    y = np.column_stack([np.cos(k / 9), 0.1 * np.cos(k / 9)])
    long, short = (Recording(u=np.sin(k[:n] / 20), y=y[:n], Ts=Ts) for n, Ts in ((3000, 0.01), (100, 0.02)))
    rounds = [
        SimpleNamespace(effect=effect, port="hub", equivalent=others)
        for effect, others in (
            ("cogging", ()),
            ("coulomb", (("stribeck", "hub"), ("lag", "input"))),
            ("dahl", (("lugre", "hub"),)),
        )
    ]
    machine = rf.Model(rf.joints.paper())
    found: Any = SimpleNamespace(
        rounds=rounds,
        train=(short,),
        validation=(long,),
        noise_floor={"theta": 1e-3},
        final=SimpleNamespace(process_noise={"hub": 0.0}, model=machine),
        model="one of the final fit",
    )
    given, settings = proposed(found, Ts=0.5)  # pyright: ignore[reportGeneralTypeIssues]
    assert given == (machine, ("coulomb", "hub"), ("stribeck", "hub"))
    assert settings["Ts"] == 0.5 and settings["limits"] == seen_limits((short, long), machine)
    np.testing.assert_array_equal(settings["reference"], long.u[:1000])
    # A periodic disturbance has another phase in the next recording, so pairs with one are skipped.
    (line,) = (name for name, effect in fx.CATALOG.items() if effect.line)
    of_a_line = [SimpleNamespace(effect=line, port="input", equivalent=(("cogging", "hub"),))]
    of_a_line += [SimpleNamespace(effect="cogging", port="hub", equivalent=((line, "input"),))]
    for first in of_a_line:
        found.rounds = [first, *rounds]
        assert proposed(found)[0][1:] == (("coulomb", "hub"), ("stribeck", "hub"))  # pyright: ignore
    found.rounds = rounds[:1]
    assert proposed(found) is None
