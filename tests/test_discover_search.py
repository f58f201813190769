"""Input that a search refuses, rare cases, and the number of programs that a search compiles."""

import dataclasses
import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from spindle import PAIRS, SPINDLE, spun

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.discover import Discovery, forward_selection, search_state
from rotflex_jax.discover.checkpoint import AddedEffect
from rotflex_jax.discover.hypothesis import CandidateStart
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.verdict import NEAR_FLOOR, TORQUE_NATS, Assessment, in_noise
from rotflex_jax.effects.base import driven_place
from rotflex_jax.errors import InputError
from rotflex_jax.recording.recording import check_apart, shared_samples
from rotflex_jax.runtime.persistent_jit import program_counts, release_programs

NAN = float("nan")


def again(recording: rf.Recording) -> rf.Recording:
    """A copy of a recording, as if it were read again from another file."""
    return dataclasses.replace(recording, u=recording.u.copy(), y=recording.y.copy(), source="again.csv")


def test_pieces_of_one_recording_are_told_by_their_samples() -> None:
    """Any cut is recognised; standstill, equal inputs alone and a short overlap do not count."""
    whole, N = spun(), 1500
    piece = whole.slice
    alike = [
        (piece(1, N), whole, 1499),
        (piece(0, 1499), piece(1, N), 1498),
        (piece(0, 900), piece(600, N), 300),
    ]
    for a, b, samples in alike:
        assert shared_samples(a, b) == shared_samples(b, a) == samples
    noise = np.where(np.arange(1499) == 700, 1e-9, 0.0)[:, None]
    changed = dataclasses.replace(piece(1, N), y=piece(1, N).y + noise)
    late = np.arange(N) >= 1000
    still = dataclasses.replace(whole, u=whole.u * late, y=whole.y * late[:, None])
    apart = [(whole, spun(seed=2)), whole.split(0.5), (piece(0, 900), piece(800, N)), (changed, whole)]
    for a, b in (*apart, (still.slice(0, 900), still.slice(50, 950))):
        assert shared_samples(a, b) == 0


def test_parts_of_a_signal_that_repeats_itself_are_apart() -> None:
    """The same motion twice, without noise: parts of one recording are known to follow each other."""
    whole = spun()
    n = whole.N // 2
    again = dataclasses.replace(whole, u=np.tile(whole.u[:n], 2), y=np.tile(whole.y[:n], (2, 1)))
    first, second = again.split(0.5)
    check_apart([first], [second], "to fit and to validate", "they must differ")
    with pytest.raises(InputError, match="repeats itself"):
        check_apart([first], [again], "to fit and to validate", "they must differ")


def test_a_recording_cut_by_a_sample_validates_and_tests_nothing() -> None:
    a, b = spun().split(0.7)
    reason = "search decides on data that no fit has seen"
    with pytest.raises(InputError, match=rf"with the same \d+ samples were given to fit and .*{reason}"):
        rf.discover(SPINDLE, a, a.slice(1, a.N), candidates=PAIRS)
    with pytest.raises(InputError, match="were given to search and to test"):
        rf.discover(SPINDLE, a, b, test=b.slice(3, b.N), candidates=PAIRS)


@pytest.mark.parametrize("how", ["the same", "read twice", "as training alone", "one of several"])
def test_data_that_were_fitted_validate_nothing(how: str) -> None:
    a, b = spun().split(0.5)
    train, validation = {
        "the same": (a, a),
        "read twice": (a, again(a)),
        "as training alone": ([a, again(a)], None),
        "one of several": ([a, b], [spun(seed=2), again(b)]),
    }[how]
    with pytest.raises(InputError, match="The same recording was given to fit and to validate"):
        rf.discover(SPINDLE, train, validation, candidates=PAIRS)


def test_a_constant_of_what_a_search_may_add_is_refused() -> None:
    a, b = (dataclasses.replace(r, constants={"shaft.coulomb.level": 0.03}) for r in spun().split(0.7))
    with pytest.raises(InputError, match=r"'shaft\.coulomb\.level', but the model has no such effect"):
        rf.discover(SPINDLE, a, b, candidates=PAIRS)
    # A constant of another machine is ignored.
    other = [dataclasses.replace(r, constants={"belt.spring.stiffness": 3.0}) for r in (a, b)]
    assert rf.discover(SPINDLE, *other, candidates=PAIRS, rounds=0).rounds == ()


def test_without_known_noise_the_criterion_says_so() -> None:
    known = Assessment({}, {"theta": NEAR_FLOOR - 0.1, "alpha": NAN}, 0.0)
    assert not known.is_explained
    assert known.criterion == "the sensor noise of alpha is not known, to compare what is left with"
    assert "theta and alpha" in Assessment({}, {"theta": NAN, "alpha": NAN}, 0.0).criterion
    # A channel that is above its noise decides, whatever its position.
    for remaining in ({"theta": NAN, "alpha": 2.0}, {"alpha": 2.0, "theta": NAN}):
        said = Assessment({}, remaining, 0.0).criterion
        assert said.startswith("errors of short free runs are ") and "alpha 2.00" in said
    assert in_noise({"theta": 1.2, "alpha": NAN}) == "theta 1.20, alpha an unknown number of"


@pytest.mark.parametrize("torque_constant", [0.4, 1.6])
def test_the_error_of_a_coarse_integration_is_no_missing_physics(torque_constant: float) -> None:
    """Sliding that stops within a sample of 5 ms leaves no unexplained torque, from either start of the fit.

    With the step of integration of the search, process noise gains 0.1 nat per value.
    """
    made = make_record([("coulomb", "hub")], kind="noise", seed=3, seconds=12.0, fs=200.0)
    train, validation = rf.Recording(u=made["u"], y=made["y"], Ts=made["Ts"]).split(0.7)
    joint = rf.joints.paper()
    name = "hub.motor.torque_constant"
    known = dict(zip(joint.parameter_names, joint.values, strict=True))[name]
    started = joint.with_values({name: torque_constant * known})
    candidates = [(fx.Coulomb, "hub"), (fx.Gravity, "hub")]
    found = rf.discover(started, train, validation, candidates=candidates, rounds=1)
    assert [(r.effect, r.port) for r in found.rounds] == [("coulomb", "hub")]
    assert found.verdict == "found", found.sentence
    assert abs(found.assessment.torque_nats) < TORQUE_NATS / 3


def test_a_candidate_with_implausible_parameters_is_said_to_be_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    refused = {"coulomb": "it is too large"}
    monkeypatch.setattr(search_state.SearchState, "fault", lambda _, h, p: refused.get(p.effect, ""))
    said: list[str] = []
    found = rf.discover(SPINDLE, *spun().split(0.7), candidates=PAIRS, progress=said.append)
    assert "  left out: coulomb at shaft, since it is too large" in said
    assert "coulomb" not in {r.effect for r in found.rounds}


def test_a_law_that_was_refitted_without_a_score_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    law = CandidateStart(EffectLocation("lugre", "hub"), np.zeros(1))
    winner: Any = SimpleNamespace(location=law.location)
    for name, value in {
        "refit_and_validate": [winner],
        "likelier_of_each": [winner],
        "choose": (winner, []),
        "_refit_replaced": [],
        "describe": "",
        "horizon_gains": (None, None),
    }.items():
        monkeypatch.setattr(forward_selection, name, lambda *_, value=value: value)
    added: list[AddedEffect] = []
    problem = SimpleNamespace(measured_values=1.0, noise=np.ones(1))
    state: Any = SimpleNamespace(
        problem=problem, current=None, still={}, say=str, add=lambda _, more: added.extend(more)
    )
    promising: Any = forward_selection.Promising(winner, [], [law], [law])
    assert forward_selection.add_best(state, [promising])
    assert [(a.location, math.isnan(a.score)) for a in added] == [(law.location, True)]


def test_a_calibration_has_its_gain_at_either_horizon(monkeypatch: pytest.MonkeyPatch) -> None:
    """The gain of a voltage offset of 0.3 V is finite and positive also if free runs give the parameters."""
    run = spun()
    parts = dataclasses.replace(run, u=run.u - 0.3).split(0.7)
    model = SPINDLE + rf.effects.Coulomb(at="shaft")
    found = {}
    for horizon in ("prediction", "free_run"):
        monkeypatch.setattr(search_state, "runs_clearly_better", lambda *_, h=horizon: h == "free_run")
        found[horizon] = rf.discover(model, *parts, candidates=PAIRS[1:], rounds=0)
        assert found[horizon].final.horizon == horizon
    gains = {}
    for horizon, result in found.items():
        (offset,) = [r for r in result.rounds if r.effect == "voltage_offset"]
        gains[horizon] = offset.to_dict()["evidence"]["held_out_gain_nats"]
        assert offset.parameters["offset"].value == pytest.approx(0.3, abs=0.05)
    assert math.isfinite(gains["free_run"]) and gains["free_run"] > 0
    assert np.sign(gains["prediction"]) == np.sign(gains["free_run"])


CANDIDATES = [(fx.Coulomb, "hub"), (fx.CubicSpring, "joint")]
# Programs of a structure that is fitted: its run and its derivatives; of one that is scored: its run and the
# response to one more contact. Each kind of law has one program for all structures of one size. Reported
# models share four for free runs, the final model has one for runs with finer steps, the linear part has one.
FITTED, SCORED, LAWS, SHARED = 2, 2, 2, 6


def searched(seed: int, samples: int = 1500) -> Discovery:
    made = make_record([("coulomb", "hub")], seed=seed, seconds=3.0, fs=500.0)
    whole = rf.Recording(u=made["u"][:samples], y=made["y"][:samples], Ts=made["Ts"])
    train, test = whole.split(0.6)
    return rf.discover(rf.joints.paper(), train, test, candidates=CANDIDATES)


def made_by(search: Callable[[], Discovery]) -> tuple[int, Discovery]:
    """Number of programs that a search compiled or loaded, and its result."""
    before = program_counts()
    found = search()
    after = program_counts()
    return after.compiled + after.loaded - before.compiled - before.loaded, found


def test_a_search_makes_few_programs_and_each_once() -> None:
    release_programs()
    first, found = made_by(lambda: searched(2010))
    assert [(r.effect, r.port) for r in found.rounds] == [("coulomb", "hub")]
    # Two structures are fitted and scored: the baseline with and without the hidden effect.
    assert 0 < first <= 2 * (FITTED + SCORED) + LAWS + SHARED
    again, same = made_by(lambda: searched(2010))
    assert again == 0
    np.testing.assert_array_equal(same.final.model.mechanism.values, found.final.model.mechanism.values)


def test_another_length_makes_no_more() -> None:
    """A part of the same recording, with fewer samples and windows, needs no further program."""
    searched(2010)
    others, found = made_by(lambda: searched(2010, samples=1310))
    assert [(r.effect, r.port) for r in found.rounds] == [("coulomb", "hub")]
    assert others == 0


def test_other_values_make_no_more() -> None:
    """Another recording of the same length needs no further program, or those of one more fit."""
    searched(2010)
    others, found = made_by(lambda: searched(2011))
    assert [(r.effect, r.port) for r in found.rounds] == [("coulomb", "hub")]
    assert others <= FITTED


@pytest.mark.usefixtures("without_final_fit")
def test_dry_friction_is_tried_where_other_candidates_have_crowded_it_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """If the first round tries no dry friction and adds nothing, dry friction at the motor is tried."""
    ranked = forward_selection.promising_at_both

    def crowded(*given):
        return [pair for pair in ranked(*given) if pair[0].location.effect not in ("coulomb", "lugre")]

    monkeypatch.setattr(forward_selection, "promising_at_both", crowded)
    candidates = [*PAIRS, (fx.LuGre, "shaft"), (fx.SensorCubic, SPINDLE.channels[0])]
    parts = spun().split(0.7)
    said: list[str] = []
    found = rf.discover(SPINDLE, *parts, candidates=candidates, rounds=1, progress=said.append)
    tried = [line for line in said if line.startswith("refitting ")]
    assert any("coulomb at shaft" in line for line in tried[1:]), said
    assert [(r.effect, r.port) for r in found.rounds] == [("coulomb", "shaft")]
    # It is not tried if the model has a law of it already and nothing is left to explain.
    said.clear()
    rf.discover(SPINDLE + fx.Coulomb("shaft"), *parts, candidates=candidates, rounds=1, progress=said.append)
    assert not any("lugre at shaft" in line for line in said if line.startswith("refitting "))


SECOND = fx.MeasuredDisturbance(driven_place("second", "voltage of the second [V]"), gain=0.025)
TWO_SPINDLES = rf.Mechanism(
    coordinates=["phi", "psi"],
    ports={"shaft": (1, 0), "second": (0, 1)},
    effects=[*SPINDLE.effects, fx.Inertia("second", inertia=0.017), fx.Viscous("second"), SECOND],
    outputs={"tacho": ("shaft", "speed"), "other": ("second", "speed")},
)


@pytest.mark.parametrize(
    ("model", "there", "tried", "expected"),
    [
        (TWO_SPINDLES, [("coulomb", "shaft")], [("sensor_bias", "other")], ["lugre", "coulomb"]),
        (TWO_SPINDLES, [("coulomb", "shaft")], [("coulomb", "shaft")], ["lugre", "coulomb"]),
        (TWO_SPINDLES, [("coulomb", "shaft")], [("coulomb", "second")], []),
        (TWO_SPINDLES, [("coulomb", "shaft"), ("lugre", "second")], [], []),
        (TWO_SPINDLES, [("dead_zone", "input")], [], []),
        (TWO_SPINDLES + fx.Dahl("shaft"), [("sensor_bias", "other")], [], ["lugre", "coulomb"]),
        (SPINDLE, [("coulomb", "shaft")], [], []),
    ],
)
def test_once_one_motor_has_dry_friction_it_is_tried_at_the_others(
    monkeypatch: pytest.MonkeyPatch, model, there, tried, expected
) -> None:
    """In the second round. `there` are effects of the model, `tried` is tried anyway.

    The second spindle is driven by a signal.
    """
    ranked = [("lugre", "second"), ("coulomb", "shaft"), ("coulomb", "second")]
    monkeypatch.setattr(forward_selection, "best_candidates", lambda *_: [EffectLocation(*p) for p in ranked])
    monkeypatch.setattr(forward_selection, "is_unexplained", lambda *_: True)
    monkeypatch.setattr(forward_selection.Promising, "at", lambda beside, scores, places: places)
    current = SimpleNamespace(hypothesis=SimpleNamespace(locations=[EffectLocation(*p) for p in there]))
    supermodel = SimpleNamespace(baseline=model, candidates=ranked)
    state: Any = SimpleNamespace(
        problem=SimpleNamespace(supermodel=supermodel),
        scores=[[]],
        origin=current,
        current=current,
        horizons=None,
        score_tests=lambda _: [],
    )
    starts: Any = [SimpleNamespace(location=EffectLocation(*p)) for p in tried]
    promising: Any = forward_selection.Promising(cast(Any, current), [], starts, starts)
    found = [p for laws in forward_selection._dry_friction(state, [promising]) for p in cast(Any, laws)]
    assert [p.effect for p in found] == expected and {p.port for p in found} <= {"second"}
