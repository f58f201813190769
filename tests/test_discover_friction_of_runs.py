"""Friction of its own size in each run: found where the runs differ, and kept for other parts of a run.

The recordings come from a separate simulator, in which friction really sticks.
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import small_problem as sp

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.discover import friction_of_runs
from rotflex_jax.discover.checkpoint import kept, restored
from rotflex_jax.discover.explanation import Explanation
from rotflex_jax.discover.friction_of_runs import (
    Refits,
    own_friction_notes,
    refit_with_own_friction,
    validated_with_own_friction,
)
from rotflex_jax.discover.hypothesis import (
    CandidateStart,
    Hypothesis,
    handed_over,
    usual_start,
    with_candidate,
    with_effect,
    with_own_friction,
    without,
)
from rotflex_jax.discover.likelihood import LikelihoodProblem, refit
from rotflex_jax.discover.stepwise import calibration_notes, fit_baseline, refit_candidates
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.discover.tables import error_lists
from rotflex_jax.discover.validation import (
    Horizons,
    ValidatedHypothesis,
    adapted_to_recordings,
    as_free_run,
    carried_over,
)
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.fit.dataset import prepare
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.report.figures.runs import _over_time

COULOMB, LUGRE, STRIBECK = (EffectLocation(name, "hub") for name in ("coulomb", "lugre", "stribeck"))
WANTED = [(fx.Coulomb, "hub"), (fx.LuGre, "hub"), (fx.Stribeck, "hub")]
LEVEL = "hub.coulomb.level"
LEVELS = (0.012, 0.04)


def runs_with(
    levels: tuple[float, ...],
    seconds: float = 4.0,
    besides: Mapping[EffectLocation, dict[str, float]] = MappingProxyType({}),
) -> tuple[Recording, ...]:
    """Runs of one machine whose Coulomb friction at the hub has another level in each run.

    Args:
        levels: Level of each run [N m].
        seconds: Length of each run.
        besides: Other effects that the machine has, with their parameters.
    """
    return sp.recordings(
        tuple(
            make_record(
                {COULOMB: {"level": level}, **besides},
                seed=31 + k,
                seconds=seconds,
                fs=400.0,
                perturb=0.0,
                rms=1.5,
            )
            for k, level in enumerate(levels)
        )
    )


class Fitted(NamedTuple):
    """Models of two runs with Coulomb friction, one level for both; and after the test for own levels."""

    problem: LikelihoodProblem
    shared: Refits
    own: Refits


def fitted(found: tuple[Recording, ...]) -> Fitted:
    problem = sp.problem(found, sp.supermodel_of(WANTED, found))
    horizons = Horizons.of(Model(sp.baseline(), sp.SOLVER), problem, None, 1.0)
    prediction, free = horizons.prediction.problem, horizons.free_run.problem
    beside = fit_baseline(prediction)
    (runs,) = refit(free, [as_free_run(free, beside)])
    start = usual_start(problem.supermodel, COULOMB)
    shared = Refits(refit_candidates(prediction, beside, [start]), refit_candidates(free, runs, [start]))
    return Fitted(prediction, shared, refit_with_own_friction(horizons, shared, [start]))


@pytest.fixture(scope="module")
def differ() -> Fitted:
    return fitted(runs_with(LEVELS))


def levels_of(problem: LikelihoodProblem, h: Hypothesis) -> np.ndarray:
    s = problem.supermodel
    return h.values(s)[:, s.mechanism.parameter_names.index(LEVEL)]


def test_each_run_has_its_own_friction_where_the_runs_differ(differ: Fitted):
    (prediction,), (free_run,) = differ.own
    (shared,) = differ.shared.free_runs
    assert LEVELS[0] * 1.2 < levels_of(differ.problem, shared)[0] < LEVELS[1] / 1.2
    for h in (prediction, free_run):
        np.testing.assert_allclose(levels_of(differ.problem, h), LEVELS, rtol=0.1)


def test_runs_that_agree_have_one_friction():
    same = fitted(runs_with((LEVELS[0], LEVELS[0])))
    assert same.own.free_runs[0] is same.shared.free_runs[0]
    assert same.own.predictions[0] is same.shared.predictions[0]


def test_another_part_of_a_run_has_the_friction_of_the_run(differ: Fitted):
    """An unknown run has the mean. Calibrations are fitted to the recordings, and the friction is not."""
    (h,) = differ.own.predictions
    problem = dataclasses.replace(differ.problem, trained=(1, None))
    other = carried_over(problem, h)
    own = levels_of(problem, h)
    column = h.local.index(problem.supermodel.mechanism.parameter_names.index(LEVEL))
    np.testing.assert_allclose(levels_of(problem, other)[0], own[1], rtol=1e-12)
    np.testing.assert_allclose(levels_of(problem, other)[1], own.mean(), rtol=1e-9)
    start = dataclasses.replace(other, local_z=other.local_z + 0.1 * (np.arange(len(h.local)) != column))
    adapted = adapted_to_recordings(problem, start)
    np.testing.assert_array_equal(levels_of(problem, adapted), levels_of(problem, other))
    assert np.all(np.delete(adapted.local_z - start.local_z, column, axis=1) != 0)


def with_levels(s, *locations: EffectLocation) -> Hypothesis:
    """The baseline with effects whose levels are 0.01; those of the first are 0.03 in the second run."""
    h = sp.unfitted(s)
    for location in locations:
        start = usual_start(s, location)
        h = with_effect(s, h, dataclasses.replace(start, values=np.r_[0.01, start.values[1:]]), 1.0)
    own = with_own_friction(s, h, locations[0])
    return dataclasses.replace(own, local_z=own.local_z + np.log([[1.0], [3.0]]))


@pytest.fixture(scope="module")
def supermodel():
    return sp.supermodel_of(WANTED, sp.recordings(sp.records(0.0)))


def test_a_richer_law_takes_over_the_size_of_each_run(supermodel):
    s = supermodel
    h = with_levels(s, COULOMB)
    assert [s.mechanism.parameter_names[i] for i in h.sizes] == [LEVEL]
    richer = with_candidate(s, h, usual_start(s, LUGRE), 0.5)
    assert LUGRE in richer.locations and COULOMB not in richer.locations
    assert [s.mechanism.parameter_names[i] for i in richer.sizes] == ["hub.lugre.level"]
    own = richer.values(s)[:, s.mechanism.parameter_names.index("hub.lugre.level")]
    np.testing.assert_allclose(own, [0.01, 0.03], rtol=1e-9)
    bare = without(s, richer, LUGRE)
    assert not bare.sizes and not bare.local and bare.local_z.shape == (2, 0)


@pytest.mark.parametrize("laws", [(STRIBECK, COULOMB), (COULOMB, STRIBECK)], ids=lambda p: p[0].effect)
def test_friction_that_is_handed_over_adds_to_the_size_of_each_run(supermodel, laws):
    """The sizes of runs belong to the law that takes over the other one, or to the one that is left out."""
    s = supermodel
    h = handed_over(s, with_levels(s, *laws), COULOMB)
    assert h is not None
    own = h.values(s)[:, s.mechanism.parameter_names.index("hub.stribeck.level")]
    np.testing.assert_allclose(own, [0.02, 0.04], rtol=1e-9)
    assert COULOMB not in h.locations


def test_a_stopped_search_keeps_the_sizes_of_runs(differ: Fitted):
    (h,) = differ.own.predictions
    again = restored(differ.problem, kept(h))
    assert again.sizes == h.sizes and again.local == h.local
    np.testing.assert_array_equal(again.local_z, h.local_z)


def test_a_search_on_runs_with_different_friction():
    """Fitted to the beginnings of both runs, friction of the right size in each predicts their ends."""
    parts = [r.split(0.6) for r in runs_with(LEVELS, seconds=6.0)]
    train, validation = zip(*parts, strict=True)
    joint = rf.Model(sp.baseline(), sp.SOLVER)
    found = rf.discover(joint, train, validation, candidates=[*WANTED[:1], (fx.Gravity, "hub")], rounds=1)
    assert [r.effect for r in found.rounds] == ["coulomb"]
    note = next(e.note for e in found.final.estimates if e.name == LEVEL)
    assert note.startswith("mean of ")
    np.testing.assert_allclose([float(v) for v in note.removeprefix("mean of ").split(",")], LEVELS, rtol=0.1)
    assert any(n.startswith(f"{LEVEL} differs between runs: ") for n in found.notes)
    run = found.model_of(validation[1]).mechanism.named_values[LEVEL]
    assert run == found.to_dict()["friction_of_runs"][LEVEL][1] == pytest.approx(LEVELS[1], rel=0.1)
    with pytest.raises(rf.InputError, match=f"The runs differ in {LEVEL}"):
        found.prediction_bands(validation[0])
    errors = np.array(list(found.final.held_out_rmse_windows.values()))
    assert np.all(errors < 1.3 * sp.NOISE)


@pytest.fixture(scope="module")
def between_runs() -> tuple[rf.Discovery, Recording]:
    """A search that is trained on one run and validated on the beginning of the other, tested on its end."""
    first, second = runs_with(LEVELS, seconds=6.0)
    validation, test = second.split(0.6)
    joint = rf.Model(sp.baseline(), sp.SOLVER)
    wanted = [*WANTED[:1], (fx.Gravity, "hub")]
    return rf.discover(joint, first, validation, test=test, candidates=wanted, rounds=1), test


def test_a_validation_run_has_its_own_friction(between_runs: tuple[rf.Discovery, Recording]):
    """With the trained level, its error over 2 s would be many times the noise, and friction be refused."""
    found, test = between_runs
    assert [r.effect for r in found.rounds] == ["coulomb"]
    told = found.to_dict()
    np.testing.assert_allclose(told["friction_of_runs"][LEVEL], LEVELS[:1], rtol=0.1)
    np.testing.assert_allclose(told["friction_of_validation"][LEVEL], LEVELS[1:], rtol=0.1)
    for errors in (found.final.held_out_rmse_windows, found.final.test.windows):  # pyright: ignore[reportOptionalMemberAccess]
        assert np.all(np.array(list(errors.values())) < 1.3 * sp.NOISE)
    assert found.model_of(test).mechanism.named_values[LEVEL] == pytest.approx(LEVELS[1], rel=0.1)
    with pytest.raises(rf.InputError, match=f"The runs differ in {LEVEL}"):
        found.prediction_bands(test)
    other = dataclasses.replace(test, continues=None)
    assert found.model_of(other).mechanism.named_values[LEVEL] == pytest.approx(LEVELS[0], rel=0.1)


def test_the_friction_of_a_validation_run_is_said_to_be_fitted(between_runs: tuple[rf.Discovery, Recording]):
    found, _ = between_runs
    (note,) = [n for n in found.notes if n.startswith(f"{LEVEL} differs between runs: ")]
    assert "in the training recording, " in note and "in the validation recording; " in note
    assert note.endswith("The value in the validation data was fitted to them, and their errors are with it.")
    tables = {e.title: e.note for e in error_lists(found)}
    assert "was fitted to those of a run that was not trained" in tables["Validation data"]
    assert "was fitted" not in tables["Test data"]


def test_what_a_model_lacks_is_asked_with_the_friction_of_the_run(
    between_runs: tuple[rf.Discovery, Recording],
):
    """With the friction of one run, the model would lack a torque over the other run, and be taught one."""
    found, _ = between_runs
    latent = found.latent_torque()
    assert latent.after is not None and len(latent.after.Ts) == 1
    assert latent.sentences[0].endswith("the final model nothing that could be seen.")
    for asked in (found.learned_torque, lambda: found.explanation(learned=True)):
        with pytest.raises(rf.InputError, match=f"The runs differ in {LEVEL}, but a torque is"):
            asked()
    left = dataclasses.replace(found, verdict=Verdict.UNEXPLAINED)
    assert not left._learns(None)
    assert "in time, on a fitted recording," in _over_time(found, Explanation(latent))


def test_the_friction_of_a_search_is_not_that_of_its_final_fit(differ: Fitted):
    """The final fit has other sizes, and its mean is over all fitted runs."""
    (h,) = differ.own.predictions
    found: Any = SimpleNamespace(hypothesis=h, adapted=h)
    validation: Any = SimpleNamespace(problem=differ.problem)
    (note,) = own_friction_notes(found, validation, fitted_again=False)
    assert "; other parts of these runs get the value of their run, other runs the mean of the" in note
    (note,) = own_friction_notes(found, validation, fitted_again=True)
    assert note.endswith(" N m in the training recordings (last model of the search, before the final fit).")


def test_offsets_of_runs_that_validate_each_other_have_no_validation_data(differ: Fitted):
    (h,), s = differ.own.predictions, differ.problem.supermodel
    (offset,) = [p for p in s.calibrations if p.effect == "voltage_offset"]
    apart: Any = SimpleNamespace(hypothesis=h, adapted=h, folds=())
    (note,) = calibration_notes(s, apart, [offset], s.mechanism)
    assert " V in the training data, " in note and " V in the validation data; it was fitted" in note
    each_other: Any = SimpleNamespace(hypothesis=h, adapted=h, folds=(h, h))
    (note,) = calibration_notes(s, each_other, [offset], s.mechanism)
    assert " V in the recordings (" in note and " V where the model is fitted to the others); it was" in note
    assert "validation" not in note


@pytest.mark.parametrize("ratio", [1.0, 1.3])
@pytest.mark.parametrize("gravity", [0.0, 0.01], ids=["friction alone", "poor model"])
def test_slightly_different_friction_counts_where_nothing_else_is_missing(ratio: float, gravity: float):
    """Without gravity, the friction found explains the runs. With it, a model with friction alone is poor."""
    besides = {EffectLocation("gravity", "arm"): {"moment": gravity}} if gravity else {}
    first, second = runs_with((LEVELS[1] / ratio, LEVELS[1]), seconds=5.0, besides=besides)
    joint = rf.Model(sp.baseline(), sp.SOLVER)
    found = rf.discover(joint, first, second, candidates=WANTED[:1], rounds=1)
    assert [r.effect for r in found.rounds] == ["coulomb"]
    own = ratio > 1.0 and not gravity
    assert bool(found.final.friction_of_validation) is own
    assert any("differs between runs" in n for n in found.notes) is own


def test_friction_of_the_users_model_may_differ_between_runs_too():
    """The user has added what a search has found. Nothing else is missing, and the ends of the runs fit."""
    parts = [r.split(0.6) for r in runs_with(LEVELS, seconds=6.0)]
    train, validation = zip(*parts, strict=True)
    joint = rf.Model(sp.baseline() + fx.Coulomb("hub", level=0.02), sp.SOLVER)
    found = rf.discover(joint, train, validation, candidates=[(fx.Gravity, "hub")], rounds=1)
    assert not found.rounds
    np.testing.assert_allclose(found.baseline.friction_of_runs[LEVEL], LEVELS, rtol=0.1)
    errors = np.array(list(found.baseline.held_out_rmse_windows.values()))
    assert np.all(errors < 1.3 * sp.NOISE)


def test_friction_of_runs_needs_a_law_of_friction(supermodel):
    h = with_effect(supermodel, sp.unfitted(supermodel), CandidateStart(COULOMB, np.array([0.02])), 1.0)
    assert with_own_friction(supermodel, h, EffectLocation("voltage_offset", "input")) is h


@pytest.mark.parametrize(
    ("gains", "scatter", "asked", "better"),
    [
        ((0.2, 0.2), 0.2, (0, 1), True),
        ((0.09, 0.09), 0.02, (0, 1), False),
        ((0.2, 0.2), 0.757, (0, 1), False),
        ((0.5, 0.02), 0.2, (0, 1), False),
        ((0.5, 0.02), 0.2, (0,), True),
    ],
    ids=["clearly", "by little", "with scatter", "not in the second", "second not asked"],
)
def test_own_friction_must_be_clearly_better_in_each_run(
    gains: tuple[float, float], scatter: float, asked: tuple[int, ...], better: bool
):
    """By a tenth of a nat a block and 2.5 standard deviations in all, and 1.5 of them in each run.

    The sum of 40 blocks has the standard deviation `scatter sqrt(40)`: with 0.757 it is 1.65 standard
    deviations in each run and 2.35 in both.
    """
    varied = np.where(np.arange(40) % 2, scatter, -scatter)
    a = np.concatenate([gain + varied for gain in gains])
    assert friction_of_runs._better_in_each(a, np.zeros(80), (40, 40), asked) is better


@pytest.mark.parametrize(
    ("first", "second", "much"), [(0.0351, 0.0114, True), (0.0349, 0.0114, False), (0.0351, 0.0115, False)]
)
def test_a_large_difference_of_friction_is_one_in_each_run(first: float, second: float, much: bool):
    """Friction of a validation run is more than 1.75 times that of training, or the other way round."""
    fitted = np.array([[1.0, 0.02, 0.001], [1.0, -first, 0.001], [1.0, 0.001, second]])
    found: Any = SimpleNamespace(
        hypothesis=SimpleNamespace(sizes=(1, 2), mean_values=lambda s: np.array([1.0, 0.02, 0.001])),
        adapted=SimpleNamespace(values=lambda s: fitted),
    )
    supermodel: Any = None
    assert friction_of_runs._differs_much(supermodel, found, [1, 2]) is much


def other_run(level: float, offset: float, one_way: bool) -> Recording:
    """A run of the same machine.

    Args:
        level: Level of Coulomb friction [N m].
        offset: Offset of the voltage [V].
        one_way: Whether the hub moves in one direction only.
    """
    t = np.arange(1600) / 400.0
    played = (1.5 * one_way) + 0.7 * np.sin(2 * np.pi * 1.3 * t) + 0.5 * np.sin(2 * np.pi * 0.4 * t)
    hidden = {COULOMB: {"level": level}, EffectLocation("voltage_offset", "input"): {"offset": offset}}
    made = make_record(hidden, seed=77, fs=400.0, perturb=0.0, played=played)
    speed = made["state"][100:, 2]
    assert one_way == bool(np.all(speed > 0))
    return sp.recordings((made,))[0]


def validated_on(other: Recording) -> tuple[SuperModel, ValidatedHypothesis, ValidatedHypothesis]:
    """Coulomb friction found in one run, validated on another run, without and with friction of its own."""
    train = runs_with(LEVELS[:1])
    model, data, s = Model(sp.baseline(), sp.SOLVER), sp.dataset(train), sp.supermodel_of(WANTED, train)
    ports = ("hub", "joint")
    problem = LikelihoodProblem.of(s, sp.SOLVER, data, ports)
    held_back = LikelihoodProblem.of(s, sp.SOLVER, prepare(model, [other], like=data), ports, (None,))
    horizons = Horizons.of(model, problem, held_back, 1.0)
    prediction, free = horizons.prediction.problem, horizons.free_run.problem
    beside, start = fit_baseline(prediction), usual_start(s, COULOMB)
    (runs,) = refit(free, [as_free_run(free, beside)])
    (grown,), (run,) = refit_candidates(prediction, beside, [start]), refit_candidates(free, runs, [start])
    found = dataclasses.replace(horizons.validated(grown, run), location=COULOMB)
    return s, found, validated_with_own_friction(horizons, found)


def of_run(s: SuperModel, found: ValidatedHypothesis, name: str) -> float:
    """A parameter of the run by which a model was validated, fitted to free runs."""
    assert found.free_run
    return float(found.free_run.adapted.values(s)[0, s.mechanism.parameter_names.index(name)])


OFFSET = "input.voltage_offset.offset"


def test_a_large_offset_of_a_run_that_moves_one_way_stands_for_its_friction():
    """The run does not determine how much of the torque is friction, so its level is not exact."""
    s, found, own = validated_on(other_run(LEVELS[1], 0.0, one_way=True))
    assert of_run(s, found, LEVEL) == pytest.approx(LEVELS[0], rel=0.1)
    assert abs(of_run(s, found, OFFSET)) > 0.1
    assert of_run(s, own, LEVEL) == pytest.approx(LEVELS[1], rel=0.25)
    assert abs(of_run(s, own, OFFSET)) < 0.07


def test_a_large_offset_of_a_training_run_stands_for_its_friction_too():
    runs = *runs_with(LEVELS[:1]), other_run(LEVELS[1], 0.0, one_way=True)
    found = fitted(runs)
    column = found.problem.supermodel.mechanism.parameter_names.index(OFFSET)
    shared, own = (
        refits.free_runs[0].values(found.problem.supermodel) for refits in (found.shared, found.own)
    )
    assert abs(shared[1, column]) > 0.1 and np.all(np.abs(own[:, column]) < 0.07)
    np.testing.assert_allclose(levels_of(found.problem, found.own.free_runs[0]), LEVELS, rtol=0.25)


def test_a_large_offset_of_a_run_that_reverses_is_an_offset():
    s, found, own = validated_on(other_run(LEVELS[0], 0.2, one_way=False))
    assert own is found
    assert of_run(s, own, OFFSET) == pytest.approx(0.2, rel=0.1)
    assert of_run(s, own, LEVEL) == pytest.approx(LEVELS[0], rel=0.1)


@pytest.mark.parametrize(
    ("before", "after", "stood"),
    [(2.1, 1.0, True), (-2.1, 1.0, True), (1.9, 0.0, False), (2.1, -1.1, False)],
)
def test_an_offset_that_stands_for_friction_is_large_and_becomes_small(
    before: float, after: float, stood: bool
):
    """It is beyond two typical sizes, in any run, and less than half of it is left in every run."""
    offsets = np.array([[0.1, 0.0], [0.0, before]]), np.array([[after, 0.1], [0.0, 0.0]])
    assert friction_of_runs.offset_stood_for_friction(*offsets) is stood
    none = np.zeros((2, 0))
    assert friction_of_runs.offset_stood_for_friction(none, none) is False
