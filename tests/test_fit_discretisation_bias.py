"""Remark of a fit on integration steps that are too long: shift of the estimates, and what to do."""

import dataclasses
import importlib
import re

import numpy as np
import pytest

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.arena.simulator.records import COUNT, JITTER, make_record
from rotflex_jax.fit import greybox_problem
from rotflex_jax.fit.discretisation_bias import COARSE_STEP, FinerSteps, coarse_step
from rotflex_jax.fit.problem import runs
from rotflex_jax.fit.result import Fit
from rotflex_jax.mechanism.finer_step import SUBSTEP_FACTOR, with_finer_steps
from rotflex_jax.runtime.persistent_jit import release_programs

COULOMB = fx.Coulomb(at="hub", level=0.02)
FINE = rf.Exponential(substeps=SUBSTEP_FACTOR)
greybox = importlib.import_module("rotflex_jax.fit.greybox")


def recorded(effects, fs: float = 400.0, seed: int = 3, seconds: float = 8.0) -> rf.Recording:
    """A recording of the independent simulator, which integrates in steps of 20 us with exact sticking."""
    r = make_record(effects, seed=seed, seconds=seconds, fs=fs)
    return rf.Recording(u=r["u"], y=r["y"], Ts=r["Ts"])


def said(found: Fit) -> list[tuple[str, float, float]]:
    """Parameter, shift in standard deviations and decrease of the cost [nat] of each remark on the step."""
    number = r"(-?[\d.]+)"
    pattern = rf"(\S+) would move by {number} of its .* the cost would fall by {number} nats"
    sentences = [r.sentence for r in found.remarks if r.kind == COARSE_STEP]
    return [(m[1], float(m[2]), float(m[3])) for s in sentences if (m := re.match(pattern, s))]


def largest_move(a: Fit, b: Fit) -> tuple[str, float]:
    """The parameter that differs most between two fits, and by how many standard deviations of the first."""
    moved = {n: abs(b[n].value - a[n].value) / a[n].std for n in a.free_names}
    for name, estimates in a.local.items():
        pairs = zip(estimates, b.local[name], strict=True)
        moved[name] = max(abs(q.value - p.value) / p.std for p, q in pairs)
    moved = {n: size for n, size in moved.items() if np.isfinite(size)}  # without parameters at a bound
    name = max(moved, key=moved.__getitem__)
    return name, moved[name]


@pytest.fixture(scope="module")
def coarse() -> tuple[rf.Recording, Fit]:
    recording = recorded([("coulomb", "hub")])
    return recording, rf.fit(rf.joints.paper() + COULOMB, recording)


def test_a_remark_says_how_far_a_fit_in_finer_steps_moves(coarse) -> None:
    recording, found = coarse
    ((name, deviations, nats),) = said(found)
    finer = rf.fit(rf.Model(found.model.mechanism, FINE), recording)
    most, moved = largest_move(found, finer)
    assert name == most and moved > 2
    assert deviations == pytest.approx(moved, rel=0.1)
    assert nats == pytest.approx(found.cost - finer.cost, abs=2)
    assert not said(finer)  # with the advised steps


def test_what_it_advises_is_nearer_to_the_truth() -> None:
    inside = {1: 0, SUBSTEP_FACTOR: 0}
    for seed in range(6):
        recording = recorded([("coulomb", "hub")], seed=seed, fs=250.0)
        for substeps in inside:
            model = rf.Model(rf.joints.paper() + COULOMB, rf.Exponential(substeps=substeps))
            e = rf.fit(model, recording)["hub.coulomb.level"]
            inside[substeps] += e.ci95[0] <= 0.03 <= e.ci95[1]
    assert inside[1] <= 3 and inside[SUBSTEP_FACTOR] >= 5


def test_the_remark_is_shown_with_the_fit(coarse) -> None:
    remark = coarse[1].remarks[-1]
    assert remark.sentence in str(coarse[1])
    assert remark.parameter in coarse[1].free_names and remark.sentence.startswith(remark.parameter)
    assert remark.sentence.endswith(
        "give rf.Model(joint, rf.Exponential(substeps=4)) in the place of the joint, on the command line "
        "--substeps 4"
    )
    assert "Exponential(substeps=4)" in coarse[1]._repr_html_()


def test_it_changes_nothing_else_of_the_fit(coarse, monkeypatch) -> None:
    recording, found = coarse
    monkeypatch.setattr(greybox, "finer_steps", lambda *_: None)
    without = rf.fit(rf.joints.paper() + COULOMB, recording)
    assert without.remarks == () and len(found.remarks) == 1
    assert without.cost == found.cost and repr(without.parameters) == repr(found.parameters)
    assert without.model == found.model


def test_short_steps_get_no_remark() -> None:
    assert not said(rf.fit(rf.joints.paper() + COULOMB, recorded([("coulomb", "hub")], fs=2000.0)))


def test_data_that_were_simulated_in_the_steps_of_the_fit_get_no_remark() -> None:
    given = recorded([], seconds=8.0, fs=250.0)
    model = rf.Model(rf.joints.paper() + COULOMB)
    y, random = model.simulate(given, x0=[0, 0, 0, 0]), np.random.default_rng(0)
    y = COUNT * np.round((y + JITTER * random.standard_normal(y.shape)) / COUNT)
    recording = dataclasses.replace(given, y=y)
    found, finer = rf.fit(model, recording), rf.fit(rf.Model(model.mechanism, FINE), recording)
    assert not said(found)
    # Shorter steps move the estimates here as well, but the recording is less likely with them.
    assert largest_move(found, finer)[1] > 2 and finer.cost > found.cost + 10


def test_exact_steps_are_not_checked_by_a_run(monkeypatch) -> None:
    def fail(*_):
        raise AssertionError("A run in finer steps was made of a linear model.")

    monkeypatch.setattr(greybox_problem, "runs", fail)
    assert rf.fit(rf.joints.paper(), recorded([("coulomb", "hub")]), restarts=0).remarks == ()


def test_other_values_and_recordings_of_the_same_length_share_the_program(coarse) -> None:
    # If the memory were full of programs of other tests, a new program would replace an old one.
    release_programs()
    rf.fit(rf.joints.paper() + COULOMB, coarse[0])
    made = len(runs)
    other = recorded([("coulomb", "hub")], seed=2)
    assert said(rf.fit(rf.joints.paper(stiffness=1.5) + fx.Coulomb(at="hub", level=0.04), other))
    assert len(runs) == made
    rf.fit(rf.joints.paper() + COULOMB, recorded([("coulomb", "hub")], seconds=4.0))
    assert len(runs) == made + 1  # another length has its own program, so the count works


@pytest.mark.parametrize(
    "asked",
    [
        {"window_seconds": 1.0, "restarts": 0},
        {"process_noise": {"hub": 1e-9, "arm": 1e-9}},
        {"local": ["input.voltage_offset.offset"], "restarts": 0},
        {"robust": 2.0},
    ],
    ids=["windows", "prediction", "local", "robust"],
)
def test_the_shift_is_that_of_the_fit_that_was_asked_for(asked) -> None:
    # The seed determines the machine, so both recordings are of the same one.
    own = [recorded([("coulomb", "hub")], seed=4, seconds=s, fs=250.0) for s in (5.0, 4.0)]
    found = rf.fit(rf.joints.paper() + COULOMB + fx.VoltageOffset(at="input"), own, **asked)
    finer = rf.fit(rf.Model(found.model.mechanism, FINE), own, **asked)
    ((name, deviations, nats),) = said(found)
    most, moved = largest_move(found, finer)
    assert name == most
    assert deviations == pytest.approx(moved, rel=0.1)
    assert nats == pytest.approx(found.cost - finer.cost, abs=4)


def test_what_a_bound_holds_does_not_move() -> None:
    recording = recorded([("coulomb", "hub")], seed=1, fs=250.0)
    found = rf.fit(rf.joints.paper() + fx.Viscous(at="arm", coefficient=0.001) + COULOMB, recording)
    assert found["arm.viscous.coefficient"].value == 0.0
    assert [r.kind for r in found.remarks] == ["at a bound", COARSE_STEP]
    ((name, deviations, nats),) = said(found)
    finer = rf.fit(rf.Model(found.model.mechanism, FINE), recording)
    most, moved = largest_move(found, finer)
    assert name == most
    assert deviations == pytest.approx(moved, rel=0.1)
    assert nats == pytest.approx(found.cost - finer.cost, abs=2)


def test_the_advice_keeps_what_else_the_solver_has() -> None:
    given = rf.Exponential(order=4, substeps=2, between="smooth")
    solver = with_finer_steps(given, [COULOMB])
    assert solver == dataclasses.replace(given, substeps=8)
    (remark,) = coarse_step(FinerSteps(solver, np.array([0.2, -3.0]), 5.0), [("a", [0]), ("b", [1])])
    assert remark.parameter == "b" and "in 8 steps instead of 2" in remark.sentence
    assert 'rf.Exponential(order=4, substeps=8, between="smooth")' in remark.sentence
    assert "--substeps 8" in remark.sentence


@pytest.mark.parametrize(("shift", "fall"), [(0.99, 5.0), (3.0, -0.1), (np.nan, 5.0), (3.0, -np.inf)])
def test_a_small_shift_and_less_likely_data_get_no_remark(shift, fall) -> None:
    assert coarse_step(FinerSteps(FINE, np.array([shift]), fall), [("a", [0])]) == ()
    assert coarse_step(FinerSteps(FINE, np.array([1.01]), 0.0), [("a", [0])])


def test_solvers_without_use_for_finer_steps() -> None:
    assert with_finer_steps(rf.Exponential(), rf.joints.paper().effects) is None
    assert with_finer_steps(rf.Exponential(between="switched"), [fx.CubicSpring(at="joint")]) is None
    assert with_finer_steps(rf.SmoothRK4(), [COULOMB]) is None
    assert with_finer_steps(rf.Exponential(), [fx.CubicSpring(at="joint")]) == FINE
