"""Controllers: gains against python-control, loops against a second simulation, C code against Python."""

import ctypes
import dataclasses
import functools
import shutil
import subprocess
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy
from numpy.typing import NDArray

import rotflex_jax as rf
from rotflex_jax import effects as fx
from rotflex_jax.cli import main
from rotflex_jax.control import close_loop, controller_to_c, credible_models
from rotflex_jax.control.assessment import ControlAssessment
from rotflex_jax.control.closed_loop import ClosedLoop, run_loop
from rotflex_jax.control.design import AT_REST, Tracking, torques_along
from rotflex_jax.errors import InputError
from rotflex_jax.fit import Fit
from rotflex_jax.joints import xl330_pendulum
from rotflex_jax.mechanism.linear import zero_order_hold
from rotflex_jax.parameters import Estimate

TS = 0.002
JOINT = rf.joints.paper(hub_damping=0.004, joint_damping=0.003)
RUBBED = JOINT + fx.Coulomb("hub", level=0.1)
EXACT = 1e-9  # a sensor step so small that rounding has no effect [rad]

compiler = shutil.which("gcc") or shutil.which("cc")


def swing(seconds: float = 2.0, still: float = 1.5) -> NDArray[np.float64]:
    """A reference that moves to 1 rad and back, and then rests [rad]."""
    t = TS * np.arange(round(seconds / TS))
    return np.append(0.5 * (1 - np.cos(2 * np.pi * t / seconds)), np.zeros(round(still / TS)))


class Linear:
    """A machine that is the linear part of the joint with a constant load, by a matrix exponential."""

    def __init__(self, load: float = 0.0, wobble: Callable[[int], float] | None = None):
        ss = rf.linearise(JOINT)
        hub = np.zeros(4)
        hub[2:] = rf.mechanism.linear.inverse_mass(JOINT) @ np.array([1.0, 0.0])
        self.A, B = zero_order_hold(ss.A, np.column_stack([ss.B, hub]), TS)
        self.B, self.push, self.C = B[:, 0], B[:, 1] * load, ss.C
        self.x, self.k, self.wobble = np.zeros(4), 0, wobble

    def read(self) -> NDArray[np.float64]:
        if self.wobble is not None:
            return np.array([self.wobble(self.k), 0.0])
        return self.C @ self.x

    def advance(self, voltage: float) -> None:
        self.x = self.A @ self.x + self.B * voltage + self.push
        self.k += 1


# -- Design ----------------------------------------------------------------------------------------------


def test_the_gains_are_those_of_python_control():
    control = pytest.importorskip("control")
    found = rf.controller(JOINT, TS, accuracy=0.05, limit=6.0)
    plant = rf.export.state_space(JOINT, TS)
    Q = np.diag([2.0, 1.0, 0.0, 0.0]) / 0.05**2  # theta counts twice: as the port, and as a coordinate
    K, _, poles = control.dlqr(plant.A, plant.B, Q, np.array([[1 / 6.0**2]]))
    np.testing.assert_allclose(found.K[:4], K[0], rtol=1e-6)
    np.testing.assert_allclose(np.sort_complex(np.exp(found.poles * TS)), np.sort_complex(poles), rtol=1e-6)


def test_placed_poles_are_where_they_were_wanted():
    wanted = [-12.0, -18.0, -9.0 + 14j, -9.0 - 14j]
    found = rf.controller(JOINT, TS, poles=wanted)
    np.testing.assert_allclose(np.sort_complex(found.poles), np.sort_complex(np.array(wanted)), rtol=1e-6)


def test_the_observer_is_stable_and_a_steady_kalman_filter():
    control = pytest.importorskip("control")
    found = rf.controller(JOINT, TS)
    inside = found.A @ (np.eye(5) - found.L @ found.C)
    assert np.max(np.abs(np.linalg.eigvals(inside))) < 1
    from rotflex_jax.control import design

    stall = 10.0 / abs(
        design._balance(rf.linearise(JOINT).A, rf.linearise(JOINT).B, found.row, _hub_torque())
    )
    Q = np.zeros((5, 5))
    for port in JOINT.port_vectors:
        one = (design.WHITE_SHARE * stall) ** 2 * TS
        Q[:4, :4] += one * _white(port)
    Q[4, 4] = (design.LOAD_PER_SECOND * stall) ** 2 * TS
    R = np.eye(2) * design.ENCODER**2 / 12
    expected, _, _ = control.dlqe(found.A, np.eye(5), found.C, Q, R)
    # The gain of python-control corrects the next state, the controller's gain the present one.
    np.testing.assert_allclose(found.A @ found.L, expected, rtol=1e-4, atol=1e-6)


def _hub_torque() -> NDArray[np.float64]:
    return np.append(np.zeros(2), rf.mechanism.linear.inverse_mass(JOINT) @ np.array([1.0, 0.0]))


def _white(port: str) -> NDArray[np.float64]:
    """Covariance of the state after one sample of a white torque, as a sum over many small steps."""
    A = rf.linearise(JOINT).A
    b = np.append(np.zeros(2), rf.mechanism.linear.inverse_mass(JOINT) @ np.array(JOINT.port_vectors[port]))
    steps = 400
    E, _ = zero_order_hold(A, b[:, None], TS / steps)
    half, _ = zero_order_hold(A, b[:, None], TS / steps / 2)
    g, total = half @ b, np.zeros((4, 4))
    for _ in range(steps):
        total += np.outer(g, g) * TS / steps
        g = E @ g
    return total


def test_a_motor_that_does_not_reach_the_port_is_refused():
    from rotflex_jax.effects import Inertia, Viscous

    apart = rf.Mechanism(
        ("a", "b"),
        {"hub": (1, 0), "arm": (0, 1)},
        [Inertia("hub", inertia=1e-3), Inertia("arm", inertia=1e-3), fx.Motor("hub"), Viscous("arm")],
        outputs={"theta": "hub", "alpha": "arm"},
    )
    with pytest.raises(InputError, match="cannot move the port 'arm'"):
        rf.controller(apart, TS, port="arm")


# -- Planned motion --------------------------------------------------------------------------------------


@pytest.mark.parametrize("port", ["hub", "arm"])
def test_a_planned_voltage_alone_moves_the_model_along_the_reference(port):
    wanted = swing()
    motion = rf.controller(JOINT, TS, port=port).plan(wanted)
    y = rf.simulate(JOINT, motion.voltage, TS)
    np.testing.assert_allclose(y, motion.outputs, atol=1e-9)
    position = y[:, 0] if port == "hub" else y.sum(axis=1)
    assert np.max(np.abs(position - wanted)) < 2e-3


def test_a_tracked_motion_is_the_best_one():
    """The reference is the dense least-squares solution of the same cost.

    Reference and disturbance end long before the horizon, so the finite horizon makes no difference.
    """
    A, B = np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([0.005, 0.1])
    c, effort, N = np.array([1.0, 0.0]), 1e-2, 300
    rng = np.random.default_rng(5)
    r, pushes = np.zeros(N), np.zeros((N, 2))
    r[20:100], pushes[10:120] = 1.0, 0.1 * rng.normal(size=(110, 2))
    X, u = Tracking(A, B, c, effort).solve(r, pushes)
    # c x_k = sum over j < k of c A^(k-1-j) B u_j, and the response to the pushes from rest.
    response, free, b, x = np.zeros(N), np.zeros(N), B, np.zeros(2)
    for k in range(N):
        free[k], x = c @ x, A @ x + pushes[k]
        response[k], b = (0.0, B) if k == 0 else (c @ b, A @ b)
    G = scipy.linalg.toeplitz(response, np.zeros(N))
    whole = np.vstack([G, np.sqrt(effort) * np.eye(N)])
    best = np.linalg.lstsq(whole, np.append(r - free, np.zeros(N)), rcond=None)[0]
    np.testing.assert_allclose(u, best, atol=1e-6)
    np.testing.assert_allclose(X @ c, free + G @ best, atol=1e-6)


def test_the_last_value_of_a_reference_is_held_after_its_end():
    """A reference that ends in a motion is tracked as if its last value went on for a long time."""
    tracking = Tracking(
        np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([0.005, 0.1]), np.array([1.0, 0.0]), 1e-2
    )
    r, later = np.linspace(0.0, 1.0, 40), 400
    short = tracking.solve(r, np.zeros((40, 2)))
    long = tracking.solve(np.append(r, np.ones(later)), np.zeros((40 + later, 2)))
    for one, whole in zip(short, long, strict=True):
        np.testing.assert_allclose(one, whole[:40], atol=1e-9)


def test_the_plan_with_friction_moves_the_model_that_has_it():
    """Without feedback, errors of the friction torque accumulate, so the plan must be right at each reversal.

    Its tracking error is below 5 % of that of a plan without friction.
    """
    wanted = swing(still=0.0)
    with_it = rf.simulate(RUBBED, rf.controller(RUBBED, TS).plan(wanted).voltage, TS)[:, 0]
    without = rf.simulate(RUBBED, rf.controller(RUBBED, TS, compensate="nothing").plan(wanted).voltage, TS)[
        :, 0
    ]
    assert np.sqrt(np.mean((with_it - wanted) ** 2)) < 0.05 * np.sqrt(np.mean((without - wanted) ** 2))


def test_torques_along_a_motion_are_those_of_the_laws():
    model = rf.Model(JOINT + fx.Coulomb("hub", level=0.1) + fx.CubicSpring("joint", stiffness=60.0))
    k = np.arange(50)
    X = np.column_stack([0.1 * k, 0.1 * np.sin(k), 3.0 * np.cos(k / 5), np.zeros(50)])
    X[20, 2] = 0.25 * AT_REST * 1e-3
    tau = torques_along(model, X, np.zeros(50), AT_REST * 1e-3, TS)
    ports = rf.mechanism.assembly.Layout.of(model.mechanism.structure).torque_ports
    friction = -0.1 * np.sign(X[:, 2])
    friction[20] *= 0.25  # below the speed of rest, friction decreases linearly
    np.testing.assert_allclose(tau[:, ports.index("hub")], friction, atol=1e-15)
    np.testing.assert_allclose(tau[:, ports.index("joint")], -60.0 * X[:, 1] ** 3, atol=1e-15)


# -- The loop --------------------------------------------------------------------------------------------


def test_a_loop_with_a_model_is_the_loop_with_a_machine_of_its_equations():
    found = rf.controller(JOINT, TS, resolution=EXACT)
    wanted = swing() + 0.2  # the machine starts 0.2 rad away, so that the feedback acts
    motion = found.plan(wanted)
    start = dataclasses.replace(motion, states=np.zeros_like(motion.states))
    model, machine = run_loop(found, JOINT, start), run_loop(found, Linear(), motion)
    np.testing.assert_allclose(model.voltage, machine.voltage, atol=1e-4)
    np.testing.assert_allclose(model.position, machine.position, atol=1e-6)
    assert model.position[0] == 0.0 and abs(model.error[-1]) < 1e-3


@pytest.mark.parametrize("compensate", ["feedforward", "observer"])
def test_the_observed_load_is_the_one_that_acts(compensate):
    load = 0.08
    found = rf.controller(JOINT, TS, compensate=compensate)
    run = close_loop(found, Linear(load), np.zeros(2500))
    assert run.load[-1] == pytest.approx(load, rel=0.02)
    if compensate == "observer":
        assert abs(run.error[-1]) < 1e-4
    else:  # the feedback balances it by an error: K x = -u, u = -load / torque per volt
        ss = rf.linearise(JOINT)
        volts = load / (ss.B[2] / _hub_torque()[2])
        assert run.error[-1] == pytest.approx(-volts / found.K[0], rel=0.02)


def test_the_observed_states_are_those_of_the_machine():
    """A load moves it away from the plan."""
    seen = []

    class Watched(Linear):
        def read(self) -> NDArray[np.float64]:
            seen.append(self.x)
            return super().read()

    run = close_loop(rf.controller(JOINT, TS, resolution=EXACT), Watched(load=0.02), swing())
    off = np.abs(run.states - np.array(seen))[500:].max(axis=0)
    from_plan = np.abs(run.motion.states - np.array(seen))[500:].max(axis=0)
    assert np.all(off[:2] < 0.1 * from_plan[:2])


def test_friction_is_compensated_along_the_motion():
    run = {
        c: close_loop(rf.controller(RUBBED, TS, compensate=c), RUBBED, swing())
        for c in ("nothing", "feedforward")
    }
    assert run["feedforward"].rms < 0.25 * run["nothing"].rms
    assert all(r.limit_cycle is None and r.saturated == 0 for r in run.values())


def test_the_voltage_keeps_its_limit_and_the_observer_does_not_wind_up():
    found = rf.controller(JOINT, TS, limit=1.0, accuracy=0.05, compensate="both")
    wanted = np.append(np.zeros(200), np.full(2300, 2.0))
    run = close_loop(found, JOINT, wanted)
    assert np.max(np.abs(run.voltage)) <= 1.0 and run.saturated > 0.05
    assert run.position.max() < 2.3 and abs(run.error[-1]) < 0.01


@pytest.mark.parametrize(
    ("decay", "drift", "found"),
    [(0.0, 0.0, True), (0.5, 0.0, False), (40.0, 0.02, False)],
    ids=["sustained", "dies out", "drifts"],
)
def test_a_limit_cycle_is_told_with_its_size_and_frequency(decay, drift, found):
    def wobble(k: int) -> float:
        return drift * TS * k + 0.05 * np.exp(-decay * TS * k) * np.sin(2 * np.pi * 3.0 * TS * k)

    run = close_loop(rf.controller(JOINT, TS), Linear(wobble=wobble), np.zeros(3000))
    assert (run.limit_cycle is not None) == found
    if run.limit_cycle is not None:
        assert run.limit_cycle.amplitude == pytest.approx(0.05, rel=0.01)
        assert run.limit_cycle.frequency == pytest.approx(3.0, rel=0.1)


def test_the_assessment_names_the_model_that_breaks_the_loop():
    """A delay of seven samples exceeds the phase margin of this loop; half a sample does not break it."""
    found = rf.controller(JOINT, TS)
    late = JOINT + fx.Delay(time=0.014)
    report = rf.assess(found, {"as designed": JOINT, "late": late}, swing(still=0.0), hold=3.0)
    assert list(report.broken) == ["late"] and report.worst == "late"
    assert "late: limit cycle" in report.sentence and "held" in str(report)
    assert report.to_dict()["runs"]["as designed"]["limit_cycle"] is None
    assert rf.assess(found, [JOINT + fx.Delay(time=0.001)], swing(still=0.0), hold=3.0).broken == {}


def test_the_worst_model_has_the_largest_mean_square_error():
    """Not the largest error, which a single moment may have. Errors are shown in degrees, shares in %."""
    run = functools.partial(SimpleNamespace, unit="rad", bounded=True, limit_cycle=None, rests=True)
    report = ControlAssessment(
        None,
        {"a": run(rms=0.02, largest=0.03, saturated=0.25), "b": run(rms=0.01, largest=0.1, saturated=0.0)},
    )
    assert report.worst == "a" and "Worst case of 2 models: 1.15 deg rms with a; no limit" in report.sentence
    assert str(report).splitlines()[2].split() == ["a", "held", "1.15", "1.72", "25.0"]


def test_errors_and_limits_count_in_both_directions():
    reference, position = np.zeros(4), np.array([0.3, -0.1, 0.0, 0.0])
    controller, motion = SimpleNamespace(Ts=TS, limit=6.0), SimpleNamespace(reference=reference)
    voltage, none = np.array([6.0, -6.0, 5.9, 0.0]), np.zeros((4, 0))
    run = ClosedLoop(controller, motion, none, position, voltage, none, reference)  # pyright: ignore[reportArgumentType]
    assert run.largest == pytest.approx(0.3) and run.rms == pytest.approx(np.sqrt(0.1 / 4))
    assert run.saturated == 0.5


@pytest.mark.parametrize(("reference", "rests"), [([0, 1, 2, 1, 0, 0], False), ([0, 1, 0, 0, 0, 0], True)])
def test_a_run_rests_after_its_last_motion(reference, rests):
    """For at least a second, not from when the reference has had its last value before."""
    controller, motion = SimpleNamespace(Ts=0.4), SimpleNamespace(reference=np.array(reference, float))
    still, none = np.zeros(6), np.zeros((6, 0))
    run = ClosedLoop(controller, motion, none, still, still, none, still)  # pyright: ignore[reportArgumentType]
    assert run.rests is rests


def test_an_amplifier_that_remembers_longer_than_the_loop_is_refused():
    with pytest.raises(InputError, match="remember more than 128 samples"):
        close_loop(rf.controller(JOINT, TS), JOINT + fx.Lag(time=1.0), swing())


def test_other_channels_are_refused():
    found = rf.controller(JOINT, TS)
    with pytest.raises(InputError, match="channels position"):
        one = dataclasses.replace(JOINT, outputs={"position": "hub"})
        close_loop(found, one, np.zeros(50))

    class One(Linear):
        def read(self) -> NDArray[np.float64]:
            return np.zeros(1)

    with pytest.raises(InputError, match="reads 1 values, but the model has the channels theta, alpha"):
        close_loop(found, One(), np.zeros(50))


class Reading:
    """A machine that counts how often it is driven, with readings that are given."""

    def __init__(self, *readings: Any) -> None:
        self.readings, self.driven = list(readings), 0

    def read(self) -> Any:
        return self.readings[min(self.driven, len(self.readings) - 1)]

    def advance(self, voltage: float) -> None:
        assert np.isfinite(voltage)
        self.driven += 1


def test_a_machine_is_not_driven_by_readings_that_are_no_numbers():
    found, fine = rf.controller(JOINT, TS), np.zeros(2)
    for wrong, phrase in (
        (
            [0.0, np.nan],
            "reads nan for alpha at sample 2, but a machine is driven by readings that are numbers",
        ),
        ("off", "reads 'off', but the model has the channels theta, alpha"),
        (np.zeros(3), "reads 3 values, but"),
    ):
        machine = Reading(fine, fine, wrong)
        with pytest.raises(InputError, match=phrase):
            close_loop(found, machine, np.zeros(50))
        assert machine.driven == 2


def test_a_machine_whose_position_is_not_shown_is_not_driven_at_all():
    machine = Reading(np.zeros(1))
    with pytest.raises(InputError, match="The readings theta do not show the position of 'arm'"):
        close_loop(rf.controller(rf.joints.paper(sensors="theta"), TS, port="arm"), machine, np.zeros(50))
    assert machine.driven == 0


# -- C code ----------------------------------------------------------------------------------------------


@pytest.mark.skipif(compiler is None, reason="no C compiler on this machine")
def test_the_c_code_gives_the_same_voltage(tmp_path):
    found = rf.controller(RUBBED, TS, limit=1.5, compensate="both")
    wanted = swing(1.0, 0.5)
    run = close_loop(found, RUBBED, wanted, noise=1e-3)
    (tmp_path / "control.h").write_text(controller_to_c(found, wanted))
    (tmp_path / "all.c").write_text(
        '#include "control.h"\n'
        "void drive(int n, const double *y, double *u) {\n"
        "    control_state s; int k; control_init(&s);\n"
        "    for (k = 0; k < n; k++) u[k] = control_step(&s, y + CONTROL_OUTPUTS * k, control_y_plan[k],"
        " control_u_plan[k]);\n"
        "}\n"
    )
    assert compiler is not None
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-shared", "-fPIC"]
    subprocess.run([compiler, *flags, "all.c", "-o", "all.so"], cwd=tmp_path, check=True)
    library, u = ctypes.CDLL(str(tmp_path / "all.so")), np.empty(len(wanted))
    y = np.ascontiguousarray(run.outputs)
    as_double = lambda a: a.ctypes.data_as(ctypes.POINTER(ctypes.c_double))  # noqa: E731
    library.drive(ctypes.c_int(len(wanted)), as_double(y), as_double(u))
    np.testing.assert_allclose(u, run.voltage, atol=1e-9)
    assert run.saturated > 0  # the limit was reached, so it is part of the comparison


@pytest.mark.parametrize(("options", "prefix"), [(["--prefix", "arm"], "arm"), ([], "control")])
def test_the_command_line_writes_it(capsys, options, prefix):
    with pytest.raises(SystemExit) as left:
        main(["export", "paper", "--to", "controller", "--Ts", "0.002", *options])
    assert left.value.code in (0, None)
    assert capsys.readouterr().out == controller_to_c(rf.controller(rf.joints.paper(), 0.002), prefix=prefix)


# -- An independent machine ------------------------------------------------------------------------------


def test_a_machine_that_was_identified_is_held_and_the_found_friction_is_compensated():
    """The controller follows from a fit to a recording of an independent simulator, without true parameters.

    With friction compensation, the tracking error on this simulator is at most half.
    """
    from rotflex_jax.arena.simulator.machine import Machine
    from rotflex_jax.arena.simulator.records import make_record

    record = make_record({("coulomb", "hub"): {"level": 0.1}}, seed=40, seconds=4.0, rms=2.0)
    fit = rf.fit(
        rf.joints.paper() + fx.Coulomb("hub", level=0.03),
        rf.Recording(u=record["u"], y=record["y"], Ts=record["Ts"]),
    )
    errors = {}
    for compensate in ("nothing", "feedforward"):
        found = rf.controller(fit, record["Ts"], compensate=compensate)
        run = close_loop(found, Machine.of(record), swing())
        errors[compensate] = run.rms
        assert run.limit_cycle is None
    assert errors["feedforward"] <= 0.5 * errors["nothing"], errors
    report = rf.assess(found, fit, swing(still=0.0), hold=2.0, count=4)
    assert report.broken == {} and len(report.runs) == 5
    assert report.runs[report.worst].rms < 2 * report.runs["fitted"].rms


def test_models_are_drawn_from_the_distribution_of_the_fit():
    names = ("hub.coulomb.level", "joint.spring.stiffness")
    covariance = np.array([[4e-4, 1e-4], [1e-4, 1e-2]])
    estimates = tuple(
        Estimate(name=n, value=v, unit="", std=float(s), ci95=(0.0, 1.0), free=True)
        for n, v, s in zip(names, (0.1, 1.6), np.sqrt(np.diag(covariance)), strict=True)
    )
    fit = Fit(rf.Model(RUBBED), 0.0, "converged", estimates, {}, covariance, names, 1)
    drawn = credible_models(fit, 400, seed=3)
    assert next(iter(drawn)) == "fitted" and len(drawn) == 401
    index = [RUBBED.parameter_names.index(n) for n in names]
    values = np.array([m.mechanism.values[index] for m in list(drawn.values())[1:]])
    np.testing.assert_allclose(np.cov(values.T), covariance, rtol=0.3, atol=1e-4)
    assert np.all(values[:, 0] >= 0)


def test_what_has_no_interval_or_is_no_parameter_of_the_machine_is_not_drawn():
    """An estimate at a bound has no covariance; an offset belongs to one recording."""
    level, stiffness = "hub.coulomb.level", "joint.spring.stiffness"
    names = ("offset of recording 1", level, stiffness)
    covariance = np.full((3, 3), np.nan)
    covariance[0, 0], covariance[2, 2], covariance[0, 2], covariance[2, 0] = 25.0, 1e-4, 0.0, 0.0
    estimates = tuple(
        Estimate(name=n, value=v, unit="", std=s, ci95=(0.0, 1.0), free=True)
        for n, v, s in zip(names, (0.1, 0.1, 1.6), (5.0, np.nan, 0.01), strict=True)
    )
    fit = Fit(rf.Model(RUBBED), 0.0, "converged", estimates, {}, covariance, names, 1)
    values = [m.mechanism.named_values for m in list(credible_models(fit, 200, seed=3).values())[1:]]
    assert {v[level] for v in values} == {0.1}
    spread = scipy.stats.chi2.ppf([0.001, 0.999], 199) / 199
    assert spread[0] < np.var([v[stiffness] for v in values], ddof=1) / 1e-4 < spread[1]


def test_a_draw_outside_of_a_bound_is_repeated():
    """Reference: the normal distribution cut at zero; far below zero no model is left."""
    name = "hub.coulomb.level"

    def fit_of(level: float) -> Fit:
        estimate = Estimate(name=name, value=level, unit="", std=0.02, ci95=(0.0, 1.0), free=True)
        return Fit(rf.Model(RUBBED), 0.0, "converged", (estimate,), {}, np.array([[4e-4]]), (name,), 1)

    drawn = list(credible_models(fit_of(0.01), 400, seed=3).values())[1:]
    levels = np.array([m.mechanism.named_values[name] for m in drawn])
    cut = scipy.stats.truncnorm(-0.5, np.inf, loc=0.01, scale=0.02)
    assert np.all(levels >= 0) and np.mean(levels) == pytest.approx(cut.mean(), abs=3 * cut.std() / 20)
    with pytest.raises(InputError, match="almost wholly outside"):
        credible_models(fit_of(-1.0), 1)


def test_names_become_no_code():
    """A name that contains the end of a C comment and a directive stays inside the comment."""
    name = "a */ #error b /*"
    motor = [fx.Motor(at="hub", gear_ratio=5.0), fx.Inertia(at="hub", inertia=0.01), fx.Viscous(at="hub")]
    machine = rf.Mechanism(coordinates=[name], ports={"hub": (1,)}, effects=motor, outputs={name: "hub"})
    text = controller_to_c(rf.controller(machine, 0.002))
    head = text[: text.index("#ifndef")]
    assert head.count("*/") == head.count("/*") == 1 and head.rstrip().endswith("*/")


def test_the_input_of_a_servo_is_no_voltage():
    servo = rf.controller(xl330_pendulum(), 0.005, limit=1.5)
    assert "input up to 1.5 rad" in str(servo)
    assert "u: input [rad], at most 1.5" in controller_to_c(servo)
    both = rf.controller(rf.joints.paper(sensors="theta+alpha+speed"), 0.002)
    assert "y: theta [rad], alpha [rad], speed [rad/s];" in controller_to_c(both)
    assert "input at its limit" in str(close_loop(servo, xl330_pendulum(), np.zeros(50)))
    with pytest.raises(InputError, match=r"limit.*\[rad\]"):
        rf.controller(xl330_pendulum(), 0.005, limit=0)


def test_a_figure_has_units_on_each_axis():
    run = close_loop(rf.controller(JOINT, TS), JOINT, swing())
    labels = [ax.get_ylabel() for ax in run.plot(run).axes]
    assert labels == ["hub [deg]", "error [deg]", "voltage [V]", "load at hub [N m]"]
    assert "Tracking error" in str(run) and "Controller of hub" in str(run.controller)


def test_a_figure_names_each_run_and_how_many_more_there_are():
    """The legend of an assessment has the names of its models, that of runs their compensation."""
    controllers = [rf.controller(JOINT, TS, compensate=c) for c in ("nothing", "feedforward", "observer")]
    first, *others = (close_loop(each, JOINT, swing(0.2, 0.1)) for each in controllers)

    def legend(figure: Any) -> list[str]:
        return [text.get_text() for text in figure.legends[0].get_texts()]

    said = [f"compensation: {each.compensate}" for each in controllers]
    assert legend(first.plot(*others)) == ["reference", *said]
    two = rf.assess(controllers[0], {"light": JOINT, "rubbed": RUBBED}, np.zeros(50), hold=0.0)
    assert legend(two.plot()) == ["reference", "light", "rubbed"]
    many = {f"model {k}": JOINT for k in range(1, 9)}
    names = legend(rf.assess(controllers[0], many, np.zeros(50), hold=0.0).plot())
    assert names == ["reference", *(f"model {k}" for k in range(1, 7)), "2 more"]


@pytest.mark.parametrize(("still", "said"), [(0.5, "limit cycle not looked for"), (1.5, "no limit cycle")])
def test_a_limit_cycle_is_denied_only_where_it_was_looked_for(still: float, said: str):
    made = rf.controller(JOINT, TS)
    assert said in str(close_loop(made, JOINT, swing(0.2, still)))
    assert said in rf.assess(made, [JOINT], swing(0.2, still), hold=0.0).sentence
