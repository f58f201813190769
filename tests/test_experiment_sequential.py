"""Sequential experiments against Gaussian integrals, Wald's bound and an independent simulator."""

import dataclasses
import json
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.errors import InputError
from rotflex_jax.experiment import common_structure, rival_set
from rotflex_jax.experiment.rival_set import CALIBRATION_SPREAD, STATE_SPREAD, RunData
from rotflex_jax.experiment.segment_choice import SegmentChoice
from rotflex_jax.experiment.sequential import (
    SequentialExperiment,
    _correlation_time,
    sequential_experiment,
)
from rotflex_jax.models.model import Model

TS, NOISE = 0.01, {"theta": 2e-3}
LIMITS = rf.Limits(voltage=2.0, travel=1.5)
MOTOR = fx.Motor(at="hub")


def servo(damping: float = 0.01) -> rf.Mechanism:
    """A servo with one inertia, of which only the damping is free."""
    m = rf.Mechanism(
        coordinates=("x",),
        ports={"hub": (1.0,)},
        effects=(fx.Inertia(at="hub", inertia=0.02), MOTOR, fx.Viscous(at="hub", coefficient=damping)),
        outputs={"theta": "hub"},
    )
    return m.trust(*(n for n in m.parameter_names if "viscous" not in n))


def known(damping: float) -> rf.Mechanism:
    return servo(damping).trust("hub.viscous.coefficient")


@pytest.fixture(scope="module")
def pair() -> SequentialExperiment:
    """An experiment on two servos that differ in a known damping, with its first segment planned."""
    limits = rf.Limits(voltage=1.2)
    settings = {"noise": NOISE, "segment_seconds": 0.4, "error": 0.1, "improve": False}
    models = {"light": known(0.01), "heavy": known(0.02)}
    return sequential_experiment(models, limits, TS, **settings).with_next_segment()


def linear_runs(damping: float, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions, and derivatives by offset [V], first position and first speed, by matrix exponentials."""
    stamp = MOTOR.stamp()
    big = np.zeros((3, 3))
    big[0, 1], big[1, 1], big[1, 2] = 1.0, -(damping + stamp.damping) / 0.02, stamp.drive / 0.02
    A = expm(big * TS)

    def run(offset: float, x: float, v: float, driven: float) -> np.ndarray:
        state, out = np.array([x, v, 0.0]), []
        for volt in u:
            out.append(state[0])
            state[2] = driven * volt + offset
            state = A @ state
        return np.array(out)

    return run(0, 0, 0, 1.0), np.stack([run(1, 0, 0, 0.0), run(0, 1, 0, 0.0), run(0, 0, 1, 0.0)], axis=1)


def test_probabilities_are_those_of_gaussian_integrals(pair):
    u = pair.planned.u
    rng = np.random.default_rng(3)
    y = linear_runs(0.02, u)[0] + 2e-3 * rng.standard_normal(len(u))
    e = pair.with_recording(y[:, None])
    typical = fx.VoltageOffset.declared()["offset"].typical
    prior = np.diag(np.square([CALIBRATION_SPREAD * typical, STATE_SPREAD, STATE_SPREAD]))
    logs = []
    for damping in (0.01, 0.02):
        mean, J = linear_runs(damping, u)
        cov = e.scale * 4e-6 * np.eye(len(u)) + J @ prior @ J.T
        logs.append(multivariate_normal.logpdf(y, mean, cov))
    got = np.log(e.probabilities[1] / e.probabilities[0])
    assert abs(got) > 0.05
    assert got == pytest.approx(logs[1] - logs[0], rel=1e-3, abs=1e-3)


def test_a_wrong_answer_is_no_more_probable_than_was_asked_for(pair):
    """Wald's bound over 60 repetitions with known noise; the two linear models are true in turn."""
    rng, wrong, decided, repetitions = np.random.default_rng(11), 0, 0, 60
    for k in range(repetitions):
        true, e, u = k % 2, pair, np.zeros(0)
        while not e.verdict and e.seconds < 2.0:
            u = np.concatenate([u, pair.planned.u])
            clean = linear_runs((0.01, 0.02)[true], u)[0][-len(pair.planned.u) :]
            e = dataclasses.replace(e, planned=pair.planned)
            e = e.with_recording((clean + 2e-3 * rng.standard_normal(len(clean)))[:, None])
        decided += e.verdict == "decided"
        wrong += e.verdict == "decided" and int(np.argmax(e.probabilities)) != true
    assert decided > 0.8 * repetitions
    # 10 % of 60 are 6; three standard deviations more are 13.
    assert wrong <= 13


def test_expected_evidence_is_found_on_average(pair):
    """The log-odds after a segment have the expected mean over sensor noise."""
    choice = SegmentChoice(pair)
    T, _ = choice.evidence(pair.planned.u[None], (1.0,), drawn=False)
    clean, got = linear_runs(0.02, pair.planned.u)[0], []
    rng = np.random.default_rng(5)
    for _ in range(16):
        e = pair.with_recording((clean + 2e-3 * rng.standard_normal(len(clean)))[:, None])
        got.append(np.log(e.probabilities[1] / e.probabilities[0]) * e.scale)
    expected = T[0, 0, 1, 0, 0]
    assert expected > 0.3
    assert np.mean(got) == pytest.approx(expected, abs=4 * np.sqrt(2 * expected / 16))


def test_the_first_part_of_an_input_counts_as_a_shorter_one():
    settings = {"noise": NOISE, "error": 0.1, "improve": False}
    models = {"light": known(0.01), "heavy": known(0.02)}
    long, short = (
        SegmentChoice(sequential_experiment(models, LIMITS, TS, segment_seconds=s, **settings))
        for s in (0.8, 0.4)
    )
    u = np.sin(0.2 * np.arange(80))[None]
    T, _ = long.evidence(u, (0.5, 1.0), drawn=False)
    half, _ = short.evidence(u[:, :40], (1.0,), drawn=False)
    np.testing.assert_allclose(T[0], half[0], rtol=1e-9)
    assert np.all(T[1, 0, [0, 1], 0, [1, 0]] > half[0, 0, [0, 1], 0, [1, 0]])


def test_seconds_until_it_is_decided_by_hand(pair):
    """At 10 % and equal probabilities log 9 nats are needed."""
    choice, need = SegmentChoice(pair), np.log(9.0)
    # Evidence after 0.5, 1 and 4 segments: the first model reaches `need` after 0.75, the other after 10.
    T = np.zeros((3, 1, 2, 2))
    T[:, 0, 0, 1] = [0.5 * need, 1.5 * need, 6 * need]
    T[:, 0, 1, 0] = [-need, 0.1 * need, 0.4 * need]
    got = choice.seconds_until_decided(T, (0.5, 1.0, 4.0))
    assert got == pytest.approx([0.4 * (0.75 + 10) / 2])
    # There is no decision before the first evaluation.
    T[:] = 9 * need
    assert choice.seconds_until_decided(T, (0.5, 1.0, 4.0)) == pytest.approx([0.2])


def test_a_segment_in_pieces_ends_where_it_is_decided(tmp_path):
    settings = {"noise": NOISE, "segment_seconds": 0.6, "improve": False, "uncertainty": 0.3}
    machine = servo(0.011) + fx.Coulomb(at="hub", level=0.003)

    def ran(check: float | None, error: float, stops: bool = False) -> SequentialExperiment:
        rig = rf.SimulatedRig(machine, LIMITS, TS, NOISE, seed=4)
        e = sequential_experiment(friction_rivals(), LIMITS, TS, check_seconds=check, error=error, **settings)
        while not (e := e.with_next_segment()).verdict and e.seconds < 1.15:
            e = e.with_recording(rig.play(e.due))
            if stops:
                e = SequentialExperiment.load(e.save(tmp_path / "state.json"))
        return e

    whole, pieces = ran(None, 1e-9), ran(0.25, 1e-9, stops=True)
    # Two segments in pieces of 0.25, 0.25 and 0.1 s are recorded like whole ones; inputs may differ.
    assert [len(r.u) for r in pieces.runs] == [len(r.u) for r in whole.runs] == [120]
    assert len(pieces.history) == len(whole.history) == 2
    assert pieces.history[1].seconds == pytest.approx(1.2)
    still = dataclasses.replace(whole, runs=(RunData(np.full(60, 0.1), whole.runs[0].y[:60]),))
    assert still.result().runs == () and "after 0.6 s" in still.result().standing
    soon = ran(0.1, 0.01)
    assert soon.verdict == "decided" and soon.planned is None
    assert soon.seconds < 1.15 and soon.seconds == pytest.approx(0.1 * round(10 * soon.seconds))
    assert [s.seconds for s in soon.history] == pytest.approx([0.6, soon.seconds])


def test_a_lag_is_not_taken_for_a_delay_that_its_model_has_approximated():
    """The model of a lag fits a run of the independent simulator with a new voltage at every sample."""
    truth, h = {("lag", "input"): {"time": 5e-4}}, 0.002
    u = 6.0 * np.sign(np.sin(2 * np.pi * 60 * h * np.arange(1000) + 0.3))
    r = make_record(truth, seed=2101, played=u, fs=1 / h)
    q = r["truth"]["plant"]
    m = rf.joints.paper()
    sizes = (q[n] for n in ("J_hub", "J_arm", "K", "k_t", "k_m", "R_m", "K_g", "eta", "B_hub", "B_joint"))
    m = m.with_values(dict(zip(m.parameter_names, sizes, strict=True)))
    rivals = common_structure.rival_set(
        [m + fx.Lag(time=5e-4), m + fx.Delay(time=5e-4)], Ts=h, noise={"theta": 5e-4, "alpha": 5e-4}
    )
    run, costs = RunData(u, r["clean"]), []
    for k in range(2):
        start = np.concatenate([rivals.prior_mean[k], rivals.first_unknowns(run)])
        costs.append(rivals.fitted(k, [start], [run], 0, 1000).cost)
    assert costs[0] < 1 and costs[1] > 5
    sticks = m + fx.Coulomb(at="hub")
    for models in ([m, sticks], [sticks, sticks + fx.Lag()]):
        solver = common_structure.rival_set(models, Ts=h, noise={"theta": 5e-4, "alpha": 5e-4}).solver
        assert solver.between == "held"
    assert rivals.solver.between == "switched"


def friction_rivals() -> dict[str, rf.Mechanism]:
    m = servo()
    return {
        "none": m,
        "dry": m + fx.Coulomb(at="hub", level=0.004),
        "drag": m + fx.QuadraticDrag(at="hub", coefficient=0.01),
    }


@pytest.fixture(scope="module")
def three() -> tuple[rf.SequentialResult, list[np.ndarray]]:
    """An experiment with three rivals, of which the second is true, on a rig given as a function."""
    machine = rf.SimulatedRig(servo(0.011) + fx.Coulomb(at="hub", level=0.003), LIMITS, TS, NOISE, seed=4)
    played: list[np.ndarray] = []

    def play(u: np.ndarray) -> np.ndarray:
        played.append(u)
        return machine.play(u)

    rig = rf.CallbackRig(play, rf.Limits(voltage=2.0, slew=60.0, travel=1.5), TS)
    return rf.experiment_until(
        friction_rivals(), rig, noise=NOISE, uncertainty=0.3, segment_seconds=0.6
    ), played


def test_of_three_rivals_the_true_one_is_found(three):
    found, _ = three
    assert found.verdict == "decided" and found.best == "dry"
    assert found.probabilities["dry"] >= 0.99 and sum(found.probabilities.values()) == pytest.approx(1.0)
    assert found.sentence.startswith("It is dry rather than none or drag")
    assert found.seconds == pytest.approx(0.6 * len(found.history))
    assert json.loads(json.dumps(found.to_dict()))["best"] == "dry"
    assert "dry [%]" in found._repr_html_() and "on the rig" in str(found)


def test_limits_hold_over_all_segments(three):
    found, played = three
    u = np.concatenate(played)
    assert np.max(np.abs(u)) <= 2.0
    assert np.max(np.abs(np.diff(u, prepend=0.0, append=0.0))) <= 60.0 * TS * (1 + 1e-9)
    assert all(np.max(np.abs(run.y)) <= 1.5 for run in found.runs)


def test_figures_have_units_and_every_rival(three):
    figure = three[0].plot()
    labels = {ax.get_ylabel() for ax in figure.axes} | {figure.axes[-1].get_xlabel()}
    assert {"probability [%]", "voltage [V]", "theta [mrad]", "time on the rig [s]"} <= labels
    assert {t.get_text() for legend in figure.legends for t in legend.get_texts()} == {"none", "dry", "drag"}


def test_the_slope_of_an_inputs_worth_is_that_of_differences():
    e = sequential_experiment(
        friction_rivals(), LIMITS, TS, noise=NOISE, segment_seconds=0.6, uncertainty=0.3
    )
    choice, rng = SegmentChoice(e), np.random.default_rng(0)
    t = TS * np.arange(60)
    x = 0.5 * np.sin(2 * np.pi * 2 * t)[None] + 0.02 * rng.standard_normal((1, 60))
    # The shifted rival is simulated, but is of first order in the objective: differences must be small.
    _, g = choice._value_and_slope(x, 1.0)
    for _ in range(3):
        way = rng.standard_normal((1, 60)) + g / np.abs(g).max()
        up, down = (choice._value_and_slope(x + s * 1e-4 * way, 1.0)[0][0] for s in (1, -1))
        assert float(np.sum(g * way)) == pytest.approx((up - down) / 2e-4, rel=0.1)


@pytest.mark.parametrize("a", [0.0, 0.6, 0.9])
def test_correlated_residuals_count_as_fewer(a: float):
    """Of a first-order process with the coefficient a, (1 + a) / (1 - a) samples are worth one.

    Reference: the variance of its mean. The most correlated channel counts. With a window of five times the
    result, its standard deviation is 0.11 of it at a = 0.9.
    """
    white = np.random.default_rng(6).standard_normal((30_000, 2))
    e = np.column_stack([lfilter([1.0], [1.0, -a], white[:, 0]), white[:, 1]])
    assert _correlation_time([white, e]) == pytest.approx((1 + a) / (1 - a), rel=0.25)


@pytest.mark.parametrize(("side", "stops"), [(0.99, True), (1.01, False)])
def test_it_goes_on_while_lucky_noise_may_decide(side: float, stops: bool):
    """A log-likelihood ratio of mean T has the variance 2 T: T + 2 sqrt(2 T) must reach log 99."""
    T = ((np.sqrt(8 + 4 * np.log(99)) - np.sqrt(8)) / 2) ** 2
    evidence = side * T * np.array([[[[0.0, 1.0]], [[1.0, 0.0]]]])  # of one input and one draw
    settings = SimpleNamespace(error=0.01, segment_seconds=2.0)
    state = SimpleNamespace(settings=settings, seconds=4.0)
    rivals = SimpleNamespace(count=2, labels=("a", "b"))
    needed = np.full((2, 2), np.log(99))
    choice: Any = SimpleNamespace(p=np.array([0.5, 0.5]), e=state, r=rivals, needed=needed)
    best: Any = SimpleNamespace(kind="noise", words="5 Hz")
    reason = SegmentChoice._too_small(choice, evidence, 3.0, best)
    assert bool(reason) is stops and ("4.6 are needed" in reason) is stops


def test_a_pair_that_no_input_can_tell_is_said_to_be_one():
    m = servo()
    twin = m + fx.Coulomb(at="hub", level=1e-7)
    rig = rf.SimulatedRig(m, LIMITS, TS, NOISE, seed=1)
    found = rf.experiment_until(
        {"one": m, "other": twin.trust("hub.coulomb.level")},
        rig,
        noise=NOISE,
        segment_seconds=0.6,
        improve=False,
    )
    assert found.verdict == "not distinguishable" and found.seconds < 10
    assert "No experiment within these limits distinguishes" in found.sentence
    assert "one" in found.sentence and "other" in found.sentence and "inputs" in found.sentence
    assert max(found.probabilities.values()) < 0.9


def test_going_on_from_a_file_is_the_same_as_not_having_stopped(tmp_path):
    models = friction_rivals()
    settings = {"noise": NOISE, "segment_seconds": 0.6, "improve": False, "error": 1e-6, "max_seconds": 2.4}
    machine = servo(0.011) + fx.Coulomb(at="hub", level=0.003)

    def ran(stops: bool) -> SequentialExperiment:
        rig = rf.SimulatedRig(machine, LIMITS, TS, NOISE, seed=7)
        e = sequential_experiment(models, LIMITS, TS, continues=False, **settings)
        while not (e := e.with_next_segment()).verdict:
            if stops:
                e = SequentialExperiment.load(e.save(tmp_path / "state.json"))
            e = e.with_recording(rig.play(e.planned.u))
            if stops:
                e = SequentialExperiment.load(e.save(tmp_path / "state.json"))
        return e

    one, other = ran(False), ran(True)
    assert one.history == other.history and one.verdict == other.verdict
    assert len(one.runs) == len(one.history) > 1
    for a, b in zip(one.runs, other.runs, strict=True):
        np.testing.assert_array_equal(a.u, b.u)
    np.testing.assert_array_equal(one.probabilities, other.probabilities)


def test_other_parameters_compile_nothing(pair):
    before = [len(p) for p in (rival_set._run_with_slopes, rival_set._outputs)]
    settings = {"noise": NOISE, "segment_seconds": 0.4, "improve": False}
    e = sequential_experiment([known(0.03) + fx.Coulomb(at="hub"), known(0.03)], LIMITS, TS, **settings)
    e = e.with_next_segment()
    e = e.with_recording(np.zeros((40, 1)) + 1e-3).with_next_segment()
    first = [len(p) for p in (rival_set._run_with_slopes, rival_set._outputs)]
    e = sequential_experiment([known(0.02) + fx.Coulomb(at="hub"), known(0.02)], LIMITS, TS, **settings)
    e.with_next_segment().with_recording(np.zeros((40, 1))).with_next_segment()
    assert [len(p) for p in (rival_set._run_with_slopes, rival_set._outputs)] == first
    assert first != before


@pytest.mark.slow
def test_on_the_independent_simulator_the_true_effect_is_found_within_the_limits():
    """Rivals are a fitted delay and a fitted lag; the rig has a delay, sticking friction and 20 us steps."""
    limits = rf.Limits(voltage=6.0, travel=np.deg2rad(90), deflection=np.deg2rad(10))
    truth, h = {("delay", "input"): {"time": 0.0021}}, 0.005
    r = make_record(truth, seed=5, seconds=4.0, fs=1 / h)
    first = rf.Recording(u=r["u"], y=r["y"], Ts=h)
    fits = [rf.fit(rf.joints.paper() + e, first) for e in (fx.Delay(time=0.001), fx.Lag(time=0.001))]
    played = np.zeros(0)

    def play(u: np.ndarray) -> np.ndarray:
        nonlocal played
        played = np.concatenate([played, u])
        return make_record(truth, seed=5, played=played, fs=1 / h)["y"][-len(u) :]

    found = rf.experiment_until(fits, rf.CallbackRig(play, limits, h), max_seconds=10, segment_seconds=0.5)
    assert found.verdict == "decided" and found.best == "delay@input"
    assert np.max(np.abs(played)) <= 6.0
    assert np.max(np.abs(found.runs[0].y), axis=0) == pytest.approx(0, abs=np.deg2rad(90))
    assert np.max(np.abs(found.runs[0].y[:, 1])) <= np.deg2rad(10)


def test_a_simulated_rig_has_the_effects_and_the_noise_that_are_asked_for():
    joint, u = rf.joints.paper(), np.sin(0.3 * np.arange(100))
    gated = Model(joint + rf.effects.Coulomb("hub", level=0.05), gates=(*[1.0] * len(joint.effects), 0.0))
    expected = rf.SimulatedRig(joint, LIMITS, 0.01).play(u)
    np.testing.assert_array_equal(rf.SimulatedRig(gated, LIMITS, 0.01).play(u), expected)
    for noise, words in (({"tetha": 1e-3}, "names 'tetha'"), (1e-3, "is 0.001")):
        with pytest.raises(InputError, match=f"by the channels theta, alpha, but {words};"):
            rf.SimulatedRig(joint, LIMITS, 0.01, noise=noise)
    with pytest.raises(InputError, match=r"1, 0\.5, but only effects that are on or off"):
        rf.SimulatedRig(dataclasses.replace(gated, gates=(*gated.gates[:-1], 0.5)), LIMITS, 0.01)


def test_faults_of_what_a_rig_recorded_are_findings_in_the_result(pair):
    e, u, rng = pair, np.zeros(0), np.random.default_rng(3)
    for _ in range(4):
        e = dataclasses.replace(e, planned=pair.planned)
        u = np.concatenate([u, pair.planned.u])
        y = linear_runs(0.02, u)[0][-40:] + 2e-3 * rng.standard_normal(40)
        y[20:] += 2 * np.pi  # the angle of a sensor that jumps at a whole turn
        e = e.with_recording(y[:, None])
    (run,) = e.result().runs
    assert "wrapped" in [finding.kind for finding in run.findings]


def test_a_rig_that_records_in_degrees_or_other_channels_is_refused():
    joint, noise = rf.joints.paper(), {"theta": 1e-3, "alpha": 1e-3}
    models = {"smooth": joint, "rough": joint + rf.effects.Coulomb("hub", level=0.05)}
    e = sequential_experiment(models, LIMITS, 0.01, noise=noise, improve=False).with_next_segment()
    u = e.due
    y = rf.simulate(joint, u, 0.01)
    turned = rf.Recording(u=u, y=np.rad2deg(y), Ts=0.01, units=("deg", "deg"), accept=("units",))
    with pytest.raises(InputError, match="in deg, but the output theta of the model is in rad"):
        e.with_recording(turned)
    other = rf.Recording(u=u, y=y, Ts=0.01, channels=("theta", "beta"), accept=("units",))
    with pytest.raises(InputError, match="has the channels theta, beta; name the column of alpha"):
        e.with_recording(other)


def test_arguments_of_the_other_use_are_refused():
    joint, noise = rf.joints.paper(), {"theta": 1e-3, "alpha": 1e-3}
    with pytest.raises(InputError, match="`probabilities` is for several models"):
        rf.next_experiment(
            joint, "coulomb@hub", "delay@input", limits=LIMITS, noise=noise, probabilities=[0.5, 0.5]
        )
    models = [joint, joint + rf.effects.Coulomb("hub", level=0.05)]
    with pytest.raises(InputError, match="`reference` is for two effects of one model"):
        rf.next_experiment(models, limits=LIMITS, noise=noise, reference=np.ones(500))


def test_a_machine_in_metres_is_told_in_metres(tmp_path):
    axis, limits, noise = rf.joints.emps(), rf.Limits(voltage=2.0), {"position": 1e-5}
    rough = axis + rf.effects.Coulomb("axis", level=20.0)
    rig = rf.SimulatedRig(rough, limits, 0.01, noise=noise)
    models = {"smooth": axis, "rough": rough}
    found = rf.experiment_until(models, rig, max_seconds=1.0, noise=noise, improve=False)
    assert (found.best, found.runs[0].units, found.runs[0].input_unit) == ("rough", ("m",), "V")
    assert [ax.get_ylabel() for ax in found.plot().axes][1:] == ["voltage [V]", "position [mm]"]
    s = rf.next_experiment(models, limits=limits, seconds=2.0, Ts=0.01, noise=noise, improve=False)
    assert re.search(r"voltage to [\d.]+ V, position to [\d.]+ mm predicted", str(s))
    assert [ax.get_ylabel() for ax in s.plot().axes] == ["voltage [V]", "position [mm]"]
    e = sequential_experiment(models, limits, 0.01, noise=noise, improve=False).with_next_segment()
    assert SequentialExperiment.load(e.save(tmp_path / "state.json")).planned.units == ("m",)


def test_a_goal_is_told_in_its_unit(tmp_path):
    servo, limits, noise = rf.joints.sts3215(), rf.Limits(voltage=0.5), {"theta": 1e-3}
    models = {"smooth": servo, "rough": servo + rf.effects.Coulomb("hub", level=0.05)}
    s = rf.next_experiment(models, limits=limits, seconds=4.0, Ts=0.02, noise=noise, improve=False)
    assert re.search(r"input to [\d.]+ rad, theta to [\d.]+ deg predicted", str(s))
    head, names, *_ = s.save_csv(tmp_path / "next.csv").read_text().splitlines()
    assert head.startswith("# t in s, input in rad,") and names == "t,input [rad]"
    assert s.plot().axes[0].get_ylabel() == "input [rad]"


def test_several_models_have_one_next_experiment(tmp_path):
    s = rf.next_experiment(list(friction_rivals().values()), limits=LIMITS, seconds=2.0, Ts=TS, noise=NOISE)
    assert s.rivals == ("nothing more", "coulomb@hub", "quadratic_drag@hub")
    assert len(s.u) == 200 and np.max(np.abs(s.u)) <= 2.0 and s.peaks["theta"] <= 0.9 * 1.5
    assert s.table[0][2] >= s.table[1][2] > 0 and 0 < s.expected_error < 2 / 3 + 1e-12
    for repeats, said in ((1.0, "after 2 s of it a wrong"), (2.5, "after 5 s of it, repeated, a wrong")):
        assert said in str(dataclasses.replace(s, repeats=repeats))
    back = np.loadtxt(s.save_csv(tmp_path / "next.csv"), delimiter=",", skiprows=2)
    np.testing.assert_array_equal(back[:, 1], s.u)
    assert {"voltage [V]", "theta [mrad]"} <= {ax.get_ylabel() for ax in s.plot().axes}


def test_a_rig_of_files_waits_for_what_was_recorded(tmp_path):
    rig = rf.FileRig(tmp_path, LIMITS, TS, patience=0.1, outputs=["theta"])
    u = np.sin(0.2 * np.arange(60)) * (np.arange(60) > 0)
    with pytest.raises(InputError, match="did not appear"):
        rig.play(u)
    rows = [f"{TS * k:.17g},{v:.17g},{0.1 * v:.17g}" for k, v in enumerate(u)]
    (tmp_path / "recording_002.csv").write_text("\n".join(["t,voltage,theta", *rows]))
    got = rig.play(u)
    np.testing.assert_allclose(got.channel("theta"), 0.1 * u)
    written = np.loadtxt(tmp_path / "voltage_002.csv", delimiter=",", skiprows=2)
    np.testing.assert_array_equal(written[:, 1], u)
    with pytest.raises(InputError, match="would count as an answer"):
        rf.FileRig(tmp_path, LIMITS, TS)


@pytest.mark.parametrize(
    ("models", "changes", "match"),
    [
        (servo(), {}, "Two or more"),
        ([servo()], {}, "Two or more"),
        ([servo(), servo()], {}, "name -> model"),
        ({"a": servo(), "b": rf.joints.paper()}, {}, "differ in coordinates"),
        ({"a": servo(), "b": servo()}, {"noise": None}, "sensor noise"),
        ({"a": servo(), "b": servo()}, {"error": 0.7}, "error"),
        ({"a": servo(), "b": servo()}, {"segment_seconds": 0.1}, "segment_seconds"),
        ({"a": servo(), "b": servo()}, {"check_seconds": 0.01}, "check_seconds"),
        ({"a": servo(), "b": servo()}, {"max_seconds": 0.1}, "max_seconds"),
        ({"a": servo(), "b": servo()}, {"probabilities": {"a": 1.0}}, "probabilities"),
        ({"a": servo(), "b": servo()}, {"uncertainty": 0}, "uncertainty"),
    ],
)
def test_bad_input_is_named_in_a_sentence(models, changes, match):
    rig = rf.CallbackRig(lambda u: np.zeros((len(u), 1)), LIMITS, TS)
    with pytest.raises(InputError, match=match):
        rf.experiment_until(models, rig, **({"noise": NOISE} | changes))


def test_a_recording_that_does_not_fit_is_refused(pair):
    with pytest.raises(InputError, match="39 samples"):
        pair.with_recording(np.zeros((39, 1)))
    with pytest.raises(InputError, match="not finite"):
        pair.with_recording(np.full((40, 1), np.nan))
    with pytest.raises(InputError, match="shape"):
        pair.with_recording(np.zeros(40))
    with pytest.raises(InputError, match="Rig"):
        rf.experiment_until({"a": servo(), "b": servo()}, lambda u: u, noise=NOISE)
