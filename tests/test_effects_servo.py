"""Motors in a position loop against other integrators, an independent simulator, and measured servos."""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rotflex_jax as rf
from rotflex_jax import effects as fx
from rotflex_jax.cli.app import main
from rotflex_jax.cli.recordings import Columns
from rotflex_jax.discover.batched_predictor import ParameterSet
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.supermodel import build, scales
from rotflex_jax.effects.motor import DYNAMIXEL_GAIN_SCALE
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import prepare
from rotflex_jax.joints import by_name, position_servo, xl330_pendulum
from rotflex_jax.mechanism.assembly import Layout
from rotflex_jax.mechanism.roles import port_roles, search_places
from rotflex_jax.mechanism.step import drive_of
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import double_precision

TS = 0.005
GAIN = "hub.position_servo.gain"
COUNT = 2 * np.pi / 4096
NOISE = 4e-3


def square(samples: int, period: float = 0.75, size: float = 1.2) -> np.ndarray:
    t = np.arange(samples) * TS
    return size * np.sign(np.sin(2 * np.pi * t / period)) * (t > 0.05)


def duty(gain: float, error: float, limit: float = 1.0) -> float:
    return min(max(gain * DYNAMIXEL_GAIN_SCALE * error, -limit), limit)


def by_solve_ivp(mechanism: rf.Mechanism, goal: np.ndarray) -> np.ndarray:
    """Angles of the pendulum on the servo by scipy, with the goal held over each sample."""
    n = mechanism.named_values
    servo = dict.fromkeys(("derivative", "dead_band", "source_resistance"), 0.0)
    servo |= {name.rpartition(".")[2]: value for name, value in n.items() if "position_servo" in name}
    kt, R, J = servo["torque_constant"], servo["resistance"], n["hub.inertia.inertia"]
    x, angles = np.zeros(2), []
    for u in goal:
        angles.append(x[0])

        def slope(_, x, u=u):
            error = u - (x[0] - servo["period"] / 2 * x[1])
            error = np.sign(error) * max(abs(error) - servo["dead_band"], 0.0)
            wanted = servo["gain"] * DYNAMIXEL_GAIN_SCALE * error - servo["derivative"] * x[1]
            d = min(max(wanted, -servo["limit"]), servo["limit"])
            # Two equations for current and voltage: R i = d volts - kt speed, volts = supply - r d i.
            matrix = [[R, -d], [servo["source_resistance"] * d, 1.0]]
            current, _ = np.linalg.solve(matrix, [-kt * x[1], servo["supply"]])
            return [x[1], (kt * current - n["hub.gravity.sine"] * np.sin(x[0])) / J]

        x = solve_ivp(slope, (0, TS), x, rtol=1e-9, atol=1e-11, max_step=TS / 4).y[:, -1]
    return np.array(angles)


@pytest.mark.parametrize(
    ("gain", "solver", "error"),
    [
        (400.0, rf.Exponential(), 5e-4),
        (800.0, rf.Exponential(), 1e-3),
        (4000.0, rf.Exponential(order=4), 2e-3),
        (16000.0, rf.Exponential(substeps=4), 5e-3),
    ],
)
def test_the_closed_loop_agrees_with_another_integrator(gain, solver, error):
    """With square goals that drive the duty to its limit; a count of the encoder is 1.5 mrad."""
    mechanism, goal = xl330_pendulum(gain=gain), square(200)
    expected = by_solve_ivp(mechanism, goal)
    assert np.max(np.abs(gain * DYNAMIXEL_GAIN_SCALE * (goal - expected))) > 1.3  # at its limit
    assert np.ptp(expected) > 2.0
    found = rf.simulate(mechanism, goal, TS, solver=solver)[:, 0]
    assert np.max(np.abs(found - expected)) < error


@pytest.mark.parametrize(
    ("part", "value", "error"),
    [("derivative", 0.05, 1e-3), ("dead_band", 0.05, 1e-3), ("source_resistance", 2.0, 2e-3)],
)
def test_parts_of_other_firmware_and_a_weak_supply(part, value, error):
    """Each changes the motion by over 20 times the error of integration; at zero each is absent."""
    servo = lambda x: position_servo(0.007, servo=fx.PositionServo(**{part: x}), weight=0.48)  # noqa: E731
    goal = square(200, size=0.8)
    plain = rf.simulate(position_servo(0.007, weight=0.48), goal, TS)[:, 0]
    found = rf.simulate(servo(value), goal, TS)[:, 0]
    assert np.max(np.abs(found - by_solve_ivp(servo(value), goal))) < error
    assert np.max(np.abs(found - plain)) > 20 * error
    np.testing.assert_allclose(rf.simulate(servo(0.0), goal, TS)[:, 0], plain, atol=1e-9)
    assert f"hub.position_servo.{part}" not in servo(value).free_names


def test_below_its_limit_the_loop_is_linear_and_exact():
    mechanism, goal = position_servo(servo=fx.PositionServo(gain=800.0)), square(200, size=0.2)
    servo = mechanism.effect("position_servo", "hub")
    stiffness = servo.torque_constant * servo.supply / servo.resistance * 800.0 * DYNAMIXEL_GAIN_SCALE
    damping, J = servo.torque_constant**2 / servo.resistance - stiffness * 0.5e-3, 0.005
    # q = goal + Re(c exp(s t)) over each sample, s = -a + i w.
    a, w = damping / (2 * J), np.sqrt(stiffness / J - (damping / (2 * J)) ** 2)
    q, v, expected = 0.0, 0.0, []
    for u in goal:
        expected.append(q)
        e, b = q - u, (v + a * (q - u)) / w
        c, s, fade = np.cos(w * TS), np.sin(w * TS), np.exp(-a * TS)
        q, v = u + fade * (e * c + b * s), fade * ((b * w - a * e) * c - (e * w + a * b) * s)
    assert np.max(np.abs(goal - np.array(expected))) * 800.0 * DYNAMIXEL_GAIN_SCALE < 1.0
    np.testing.assert_allclose(rf.simulate(mechanism, goal, TS)[:, 0], expected, atol=1e-10)


def test_the_limit_of_the_duty_sets_the_stall_torque_and_the_speed():
    servo = fx.PositionServo(gain=800.0, limit=0.6, supply=5.0, torque_constant=0.4, resistance=4.0)
    stall, free = 0.4 / 4.0 * 5.0 * 0.6, 5.0 * 0.6 / 0.4
    lifting = position_servo(0.002, servo=servo, weight=0.5) + fx.Viscous("hub", coefficient=0.05)
    end = rf.simulate(lifting, np.full(2000, 1.5), TS)[-1, 0]
    assert 0.5 * np.sin(end) == pytest.approx(stall, rel=1e-6)
    run = rf.simulate(position_servo(0.002, servo=servo), np.full(600, 1e3), TS)[:, 0]
    assert (run[-1] - run[-101]) / (100 * TS) == pytest.approx(free, rel=1e-3)
    assert f"{stall:.3g} N m at rest" in servo.sentence() and f"{free:.3g} rad/s" in servo.sentence()


def test_the_torque_of_a_motor_under_a_loop_is_that_of_its_current():
    """The torque that heats the motor, in closed form with limit and back-EMF."""
    mechanism = xl330_pendulum() + fx.Heating("hub")
    gates = np.ones(len(mechanism.effects))
    for q, v, goal in ((0.1, 2.0, 0.3), (-0.4, -1.0, 1.5), (0.5, 0.0, -1.5)):
        with double_precision():
            state, u = jnp.array([q, v]), jnp.asarray(goal)
            heating = mechanism.effects[-1]
            found = float(drive_of(mechanism, heating, state, state[:1], u, jnp.asarray(gates)))
        volts = 7.4 * duty(400.0, goal - q + 0.5e-3 * v)
        assert found == pytest.approx(0.35 / 3.4 * (volts - 0.35 * v), rel=1e-9)


def test_a_saved_servo_comes_back_bit_for_bit(tmp_path):
    model = rf.Model(xl330_pendulum(gain=300.0) + fx.Coulomb("hub", level=0.03) + fx.DeadZone(positive=0.01))
    back = rf.Model.load(model.save(tmp_path / "servo.json"))
    assert back == model
    assert back.mechanism.units.input == "rad"
    assert np.array_equal(
        rf.simulate(back.mechanism, square(80), TS), rf.simulate(model.mechanism, square(80), TS)
    )


def test_what_acts_on_a_goal_is_told_in_radians():
    mechanism = xl330_pendulum() + fx.DeadZone() + fx.VoltageDrift(rate=0.002)
    units = dict(zip(mechanism.parameter_names, mechanism.parameter_specifications, strict=True))
    assert units["input.dead_zone.positive"].unit == "rad"
    assert units["input.voltage_drift.rate"].unit == "rad/s"
    assert units["hub.position_servo.supply"].unit == "V"  # the supply is in volts
    assert units["hub.position_servo.torque_constant"].unit == "N m/A"
    said = [mechanism.sentence(mechanism.effect(name, "input")) for name in ("dead_zone", "voltage_drift")]
    assert said[0] == "inputs between -0.1 rad and 0.1 rad have no effect"
    assert said[1] == "the offset of the input drifts by +2 mrad per second"
    assert "input.dead_zone.positive = 0.1 rad" in str(mechanism)
    assert rf.joints.two_dof_link().parameter_specifications[3].unit == "N m/A"


def test_presets_by_name_and_the_role_of_the_port():
    assert by_name.joint("xl330_pendulum:gain=200,mass=0.3") == xl330_pendulum(0.3, gain=200.0)
    assert by_name.joint("position_servo:inertia=0.01") == position_servo(0.01)
    feetech = by_name.joint("sts3215:gain=16,dead_band=0.0031").effect("position_servo", "hub")
    assert feetech.values["gain"] == 16.0 and feetech.values["dead_band"] == 0.0031
    # Of the order of the data sheet: 1.9 N m at rest and 45 turns a minute without load at 7.4 V.
    stall = 0.97 * 7.4 * feetech.values["torque_constant"] / feetech.values["resistance"]
    assert 1.5 < stall < 4.0 and 0.7 < 7.4 / feetech.values["torque_constant"] / (2 * np.pi * 0.75) < 2.5
    assert xl330_pendulum().effect("gravity", "hub").values["sine"] == pytest.approx(0.49 * 9.80665 * 0.1)
    shaft = rf.Mechanism(
        ("q",), {"shaft": (1,)}, [fx.Inertia("shaft"), fx.PositionServo("shaft")], outputs={"q": "shaft"}
    )
    assert port_roles(shaft, "shaft") == {"hub"}  # its loop does not count as a spring
    assert port_roles(shaft + fx.Gravity("shaft"), "shaft") == {"hub", "loaded"}
    assert (fx.GearFriction, "hub") in search_places(xl330_pendulum())
    assert fx.GearFriction not in dict(search_places(rf.joints.paper()))


# -- an independent simulator: firmware at 1 kHz on whole counts, sticking friction, steps of 0.1 ms ---------

TRUTH = {"J": 0.0065, "kt": 0.42, "R": 4.4, "level": 0.035, "cosine": 0.012}
FREE = {
    "hub.inertia.inertia": "J",
    "hub.position_servo.torque_constant": "kt",
    "hub.position_servo.resistance": "R",
    "hub.coulomb.level": "level",
    "hub.gravity.cosine": "cosine",
}


def servo_run(
    gain: float, goal: np.ndarray, fine: int = 50, lost: float = 0.0, limit: float = np.inf
) -> np.ndarray:
    """Angles of a servo without code of the toolkit; the firmware reads them in whole counts.

    Args:
        gain: Gain of the firmware.
        goal: Goals [rad].
        fine: Steps per sample.
        lost: Share of the motor's torque that the gear takes as friction.
        limit: Upper limit of the motor's torque at any current [N m].
    """
    J, kt, R, level, cosine = (TRUTH[k] for k in ("J", "kt", "R", "level", "cosine"))
    h, weight, q, v, out = TS / fine, 0.49 * 9.80665 * 0.1, 0.0, 0.0, []
    every = max(round(1e-3 / h), 1)
    volts, tick = 0.0, 0
    for u in goal:
        out.append(q)
        for _ in range(fine):
            if tick % every == 0:
                read, wanted = round(q / COUNT), round(u / COUNT)
                volts = 7.4 * min(max(gain * (wanted - read) / (256 * 885), -1.0), 1.0)
            tick += 1
            motor = kt / R * (volts - kt * v)
            motor /= 1 + abs(motor) / limit
            drive, most = motor - weight * np.sin(q) - cosine * np.cos(q), level + lost * abs(motor)
            if v == 0.0 and abs(drive) <= most:
                continue
            way = np.sign(v) if v != 0.0 else np.sign(drive)
            new = v + h * (drive - way * most) / J
            new = 0.0 if v != 0.0 and new * v < 0 else new
            q, v = q + h * (v + new) / 2, new
    return np.array(out)


def goals(samples: int = 800) -> dict[str, np.ndarray]:
    t = np.arange(samples) * TS
    return {
        "sums": np.sin(t) * np.pi / 2 + np.sin(5 * t) * 0.5 * np.sin(2 * t),
        "sweep": np.sin(1.5 * t**2),
    }


def recorded(*runs: tuple[float, str], **physics: float) -> list[Recording]:
    """Recordings of the independent simulator at given gains and goals, with noise, in whole counts."""
    made = []
    for k, (gain, kind) in enumerate(runs):
        goal = goals()[kind]
        angle = servo_run(gain, goal, **physics) + np.random.default_rng(k).normal(0, NOISE, len(goal))
        made.append(
            Recording(
                u=goal,
                y=np.round(angle / COUNT) * COUNT,
                Ts=TS,
                input_name="goal",
                input_unit="rad",
                resolution={"theta": COUNT},
                constants={GAIN: gain},
            )
        )
    return made


@pytest.fixture(scope="module")
def servo_recordings() -> list[Recording]:
    return recorded((100.0, "sums"), (200.0, "sweep"), (400.0, "sums"), (800.0, "sweep"))


def far_start() -> rf.Mechanism:
    away = dict.fromkeys(FREE, 1.35) | {"hub.inertia.inertia": 0.7, "hub.position_servo.resistance": 0.7}
    values = {name: away[name] * TRUTH[key] for name, key in FREE.items()} | {"hub.gravity.cosine": 0.0}
    return (xl330_pendulum(gain=333.0) + fx.Coulomb("hub")).with_values(values)


def test_recordings_with_different_gains_are_fitted_together(servo_recordings):
    """The fit starts 30 to 35 % off and finds the truth; the gain of each recording is known."""
    found = rf.fit(rf.Model(far_start(), rf.Exponential(substeps=4)), servo_recordings)
    assert found.status == "converged"
    for name, key in FREE.items():
        low, high = found[name].ci95
        assert low < TRUTH[key] < high, (key, found[name])
        size = 0.01 if key == "cosine" else TRUTH[key]
        assert found[name].std < 0.05 * size, (key, found[name])
    assert found.noise["theta"] == pytest.approx(NOISE, rel=0.1)
    assert found[GAIN].value == 333.0 and not found[GAIN].free  # the model's gain is unchanged
    for recording in servo_recordings:
        error = found.model.simulate(recording) - recording.y
        assert np.sqrt(np.mean(error**2)) < 1.5 * NOISE
    # Without the constants, one gain is used for all recordings.
    blind = [dataclasses.replace(r, constants={}) for r in servo_recordings]
    assert rf.fit(far_start(), blind).noise["theta"] > 20 * NOISE


def test_windows_and_measured_states_know_the_gain_too(servo_recordings):
    found = rf.fit(far_start(), servo_recordings[:2], window_seconds=1.0, first="measured")
    assert found["hub.inertia.inertia"].value == pytest.approx(TRUTH["J"], rel=0.05)
    assert found.noise["theta"] < 1.5 * NOISE


def test_a_part_of_a_recording_keeps_its_constants(servo_recordings):
    model, r = rf.Model(far_start()), servo_recordings[0]
    assert dict(r.slice(10, 200).constants) == dict(r.split(0.5)[1].constants) == {GAIN: 100.0}
    assert dict(r.decimate(2).constants) == {GAIN: 100.0}
    assert model.at(r).mechanism.effect("position_servo", "hub").values["gain"] == 100.0
    assert model.at(dataclasses.replace(r, constants={})) is model
    own = dataclasses.replace(model, mechanism=model.mechanism.with_values({GAIN: 100.0}))
    bare = dataclasses.replace(r, constants={})
    assert np.array_equal(model.simulate(r), own.simulate(bare))
    assert np.array_equal(model.simulate_windows(r, 1.0), own.simulate_windows(bare, 1.0))
    noise = ({"hub": 1e-6}, [COUNT])
    assert np.array_equal(model.predict(r, *noise), own.predict(bare, *noise))


def test_constants_that_cannot_be(servo_recordings):
    mechanism, r = far_start(), servo_recordings[0]
    with pytest.raises(InputError, match="full name of a parameter and a finite number"):
        dataclasses.replace(r, constants={GAIN: float("nan")})
    with pytest.raises(InputError, match=r"no parameter .gian.; use one of hub\.position_servo\.gain"):
        rf.Model(mechanism).simulate(dataclasses.replace(r, constants={"hub.position_servo.gian": 1.0}))
    with pytest.raises(InputError, match="is free in the model"):
        rf.fit(mechanism.release(GAIN), r)
    with pytest.raises(InputError, match=f"differ in {GAIN}"):
        rf.many_starts(mechanism, servo_recordings[:2])
    with pytest.raises(InputError, match=f"differ in {GAIN}"):
        rf.latent_torque(mechanism, servo_recordings[:2])
    # A model without such an effect ignores the constant.
    assert rf.Model(rf.joints.single_inertia()).at(r).mechanism == rf.joints.single_inertia()


def true_servo(gain: float = 333.0) -> rf.Mechanism:
    return far_start().with_values({GAIN: gain} | {name: TRUTH[key] for name, key in FREE.items()})


def test_a_search_runs_each_recording_with_its_gain(servo_recordings):
    model, recordings = rf.Model(true_servo()), servo_recordings[::2]
    dataset = prepare(model, recordings)
    scale = scales(model, recordings, dataset.torque_scale)
    s = build(model.mechanism, [(fx.QuadraticDrag, "hub")], scale)
    problem = LikelihoodProblem.of(s, model.solver, dataset, ("hub",))
    values = np.tile(s.mechanism.values, (2, 1))
    K = np.zeros((2, Layout.of(s.mechanism.structure).size, 1))
    run = ParameterSet(values, dataset.first_states[:, None], s.gates(()), K)
    e = problem.innovations_of([run])[0]
    assert np.sqrt(np.mean(e**2)) < 5 * NOISE
    assert values[0, s.mechanism.parameter_names.index(GAIN)] == 333.0  # the given values are unchanged
    alike = dataclasses.replace(problem.predictor, constants=None)
    assert np.sqrt(np.mean(alike.innovations([run], problem.windows.index)[0] ** 2)) > 20 * NOISE


@pytest.mark.parametrize("held_back", [True, False], ids=["validation", "one left out"])
def test_every_part_of_a_search_knows_the_constants_of_each_recording(servo_recordings, held_back):
    """Training, validation and test recordings have different gains, none of them that of the model."""
    a, b, c, d = servo_recordings
    model = rf.Model(true_servo(), rf.Exponential(substeps=4))
    train, validation = ([a, d], [b]) if held_back else ([a, d, b], [])
    candidates = [(fx.QuadraticDrag, "hub")]
    found = rf.discover(model, train, validation, test=c, candidates=candidates, rounds=0)
    stage = found.stages[-1]
    assert stage.model.mechanism.effect("position_servo", "hub").values["gain"] == 333.0
    errors = [stage.held_out_rmse, stage.held_out_rmse_windows, stage.test.whole, stage.test.windows]
    errors += [stage.calibrated.windows, stage.test_calibrated.windows]
    assert max(e["theta"] for e in errors) < 3 * NOISE
    fitted = {e.name: e.value for e in stage.estimates}
    for name, key in FREE.items():
        assert fitted[name] == pytest.approx(TRUTH[key], rel=0.1, abs=2e-3)


@pytest.mark.parametrize(
    ("physics", "wanted", "rounds"),
    [
        ({}, ["coulomb"], 1),
        ({"lost": 0.4}, ["gear_friction"], 2),  # the second round adds nothing
        ({"lost": 0.4, "limit": 1.25}, ["gear_friction", "torque_saturation"], 2),
    ],
    ids=str,
)
def test_a_search_tells_what_a_loaded_motor_loses(physics, wanted, rounds):
    """From wrong values of the preset it finds constant friction, gear friction, and saturation."""
    train = recorded((200.0, "sums"), (400.0, "sweep"), **physics)
    validation = recorded((200.0, "sweep"), (400.0, "sums"), **physics)
    laws = (fx.Coulomb, fx.GearFriction, fx.TorqueSaturation, fx.Viscous, fx.QuadraticDrag, fx.Heating)
    model = rf.Model(xl330_pendulum(), rf.Exponential(substeps=2))
    found = rf.discover(model, train, validation, candidates=[(law, "hub") for law in laws], rounds=rounds)
    assert sorted(r.effect for r in found.rounds) == wanted
    assert {r.status for r in found.rounds} == {"established"}
    assert found.verdict.value != "unexplained"
    estimates = {e.name.rpartition(".")[2]: e for e in found.final.estimates}
    assert estimates["level"].value == pytest.approx(TRUTH["level"], rel=0.15)
    if "lost" in physics:
        assert abs(estimates["share"].value - physics["lost"]) < 3 * estimates["share"].std < 0.1
    if "limit" in physics:
        assert abs(estimates["loss"].value - 1 / physics["limit"]) < 3 * estimates["loss"].std < 0.2


def test_a_measured_servo_at_a_gain_that_no_fit_has_seen(measured: Callable[[str], list[Recording]]):
    """The fit is valid at another gain; dry friction that ignores the load leaves errors of some degrees."""
    recordings = measured("bam_xl330")
    assert sorted({r.constants[GAIN] for r in recordings}) == [100.0, 200.0, 400.0, 800.0]
    train = [r for r in recordings if r.constants[GAIN] in (100.0, 800.0)]
    test = [r for r in recordings if r.constants[GAIN] == 200.0]
    found = rf.fit(xl330_pendulum() + fx.Coulomb("hub", level=0.03), train)
    errors = lambda model, of: [np.sqrt(np.mean((model.simulate(r) - r.y) ** 2)) for r in of]  # noqa: E731
    assert max(errors(found.model, test)) < np.deg2rad(7)
    blind = [dataclasses.replace(r, constants={}) for r in test]
    assert min(errors(found.model, blind)) > 1.5 * max(errors(found.model, test))
    # Of the order of the data sheet: 0.52 N m at 1.5 A and 5 V.
    assert 0.2 < found["hub.position_servo.torque_constant"].value < 0.7
    assert 1.5 < found["hub.position_servo.resistance"].value < 8.0


def test_the_command_line_reads_a_goal_in_radians(tmp_path, capsys, servo_recordings):
    r = servo_recordings[2]
    log = np.column_stack([r.t, r.u, r.y[:, 0]])
    np.savetxt(tmp_path / "log.csv", log, delimiter=",", header="t,goal,theta", comments="")
    columns = Columns(input="goal", mechanism=xl330_pendulum())
    read = columns.load(tmp_path / "log.csv")
    assert (read.input_name, read.input_unit, read.units) == ("goal", "rad", ("rad",))
    with pytest.raises(SystemExit) as left:
        joint, friction = "xl330_pendulum:gain=400", "coulomb@hub:level=0.035"
        main(
            [
                *("simulate", str(tmp_path / "log.csv"), "--input", "goal"),
                *("--joint", joint, "--add", friction),
            ]
        )
    assert left.value.code in (0, None)
    said = capsys.readouterr().out
    assert "theta" in said and " V" not in said
