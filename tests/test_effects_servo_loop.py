"""The whole loop of a servo's firmware: I gain with anti-windup, readings of the motor, torque off."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiler_options import ROUGH
from scipy.integrate import solve_ivp

import rotflex_jax as rf
from rotflex_jax import effects as fx
from rotflex_jax.effects.motor import DYNAMIXEL_GAIN_SCALE
from rotflex_jax.errors import InputError
from rotflex_jax.joints import by_name, position_servo, servo
from rotflex_jax.mechanism import free_run
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import double_precision

TS, FINE = 0.005, 100
PARTS = {"derivative": 0.012, "dead_band": 0.01, "source_resistance": 0.8}
INTEGRAL, WINDUP, TAU, SINE, LIMIT = 3.0, 30.0, 0.02, 0.48, 0.55


def goals(samples: int = 400) -> np.ndarray:
    t = np.arange(samples) * TS
    return 0.9 * np.sign(np.sin(2 * np.pi * t / 0.9)) * (t > 0.05) + 0.1 * np.sin(9 * t)


def firmware_run(
    goal: np.ndarray,
    J: float,
    kt: float,
    R: float,
    level: float,
    parts: dict[str, float],
    windup: float,
) -> np.ndarray:
    """Angle, current and duty of a servo whose firmware computes once in a millisecond, in plain Python.

    Current and duty are read through low-pass filters.
    """
    h, gain = TS / FINE, 400.0 * DYNAMIXEL_GAIN_SCALE
    every = round(1e-3 / h)
    q = v = z = duty = seen_current = seen_duty = 0.0
    before, tick, out = 0.0, 0, []
    for u in goal:
        out.append((q, seen_current, seen_duty))
        for _ in range(FINE):
            if tick % every == 0:
                error = u - q
                error = np.sign(error) * max(abs(error) - parts.get("dead_band", 0.0), 0.0)
                wanted = gain * error - parts.get("derivative", 0.0) * (q - before) / 1e-3 + z
                duty = min(max(wanted, -LIMIT), LIMIT)
                z += 1e-3 * (INTEGRAL * error - windup * (wanted - duty))
                before = q
            tick += 1
            r = parts.get("source_resistance", 0.0)
            current = (7.4 * duty - kt * v) / (R + r * duty**2)
            seen_current += h / TAU * (current - seen_current)
            seen_duty += h / TAU * (duty - seen_duty)
            drive = kt * current - SINE * np.sin(q)
            if v == 0.0 and abs(drive) <= level:
                continue
            way = np.sign(v) if v != 0.0 else np.sign(drive)
            new = v + h * (drive - way * level) / J
            new = 0.0 if v != 0.0 and new * v < 0 else new
            q, v = q + h * (v + new) / 2, new
    return np.array(out)


def pid(parts: dict[str, float], windup: float = WINDUP, integral: float = INTEGRAL) -> rf.Mechanism:
    loop = fx.PidServo(gain=400.0, limit=LIMIT, integral=integral, anti_windup=windup, enabled=1.0, **parts)
    plain = position_servo(0.007, servo=loop, weight=SINE)
    return dataclasses.replace(
        plain,
        effects=(*plain.effects, fx.CurrentMeter("hub", time=TAU), fx.DutyMeter("hub", time=TAU)),
        outputs={"theta": "hub", "current": ("hub", "current"), "duty": ("hub", "duty")},
        trusted=plain.trusted | {"hub.current_meter.time", "hub.duty_meter.time"},
    )


@pytest.mark.parametrize("parts", [{}, PARTS], ids=["PI", "PID, dead band, weak supply"])
def test_the_loop_agrees_with_firmware_at_a_kilohertz(parts):
    """The duty is at its limit for some time, so that the anti-windup acts on the integral."""
    goal = goals()
    expected = firmware_run(goal, 0.007, 0.35, 3.4, 0.0, parts, WINDUP)
    assert np.mean(np.abs(expected[:, 2]) > 0.9 * LIMIT) > 0.05
    found = rf.simulate(pid(parts), goal, TS)
    # The D gain of the firmware acts on a difference over a period, half a period late: a first-order error.
    angle, current, duty = np.max(np.abs(found - expected), axis=0)
    assert angle < 0.004 and current < 0.012 and duty < 0.007
    without = rf.simulate(pid(parts, windup=0.0), goal, TS)
    assert np.max(np.abs(without - expected)[:, 0]) > 50 * angle
    none = rf.simulate(pid(parts, integral=0.0), goal, TS)
    assert np.max(np.abs(none - expected)[:, 0]) > 50 * angle


def test_derivatives_of_loop_and_readings_equal_central_differences():
    """The states of the readings depend on the motor, and the motor depends on the state of the integral."""
    m = pid(PARTS) + fx.LoadFriction("hub", level=0.01, driving=0.1, tied=True, of="motor")
    with double_precision():
        u, x0 = jnp.asarray(goals(60)), jnp.asarray(rest_state(m.structure, np.dtype(float)))
        gates, Ts = jnp.ones(len(m.effects)), jnp.asarray(TS)
        run = lambda v: free_run(m.structure, rf.Exponential(), v, gates, x0, u, Ts)[1]  # noqa: E731
        steps = np.diag(1e-6 * np.abs(m.values))
        both = lambda v, w: (jax.jacfwd(run)(v), jax.vmap(run)(w))  # noqa: E731
        # The program runs once, so optimising it takes longer than it saves.
        slopes, ends = jax.jit(both, compiler_options=ROUGH)(
            jnp.asarray(m.values), jnp.asarray(np.vstack([m.values + steps, m.values - steps]))
        )
        slopes, (plus, minus) = np.asarray(slopes), np.split(np.asarray(ends), 2)
        for name in ("integral", "anti_windup", "torque_constant", "enabled", "time", "driving", "limit"):
            for i in (i for i, n in enumerate(m.parameter_names) if n.endswith(f".{name}")):
                expected = (plus[i] - minus[i]) / (2 * steps[i, i])
                size = np.abs(expected).max(axis=0)
                assert size.max() > 0, m.parameter_names[i]
                assert np.all(np.abs(slopes[..., i] - expected) <= 1e-4 * size + 1e-9), m.parameter_names[i]


def test_an_i_gain_takes_the_error_away_that_the_weight_makes():
    """At rest, supply * duty * torque_constant / resistance is the torque of the weight."""
    goal = np.full(2500, 0.5)
    theta, current, duty = rf.simulate(pid({}), goal, TS)[-1]
    assert theta == pytest.approx(0.5, abs=1e-6)
    assert duty == pytest.approx(SINE * np.sin(0.5) * 3.4 / (0.35 * 7.4), rel=1e-5)
    assert current == pytest.approx(SINE * np.sin(0.5) / 0.35, rel=1e-5)


TRUTH = {"J": 0.0065, "kt": 0.42, "R": 4.4, "level": 0.035}
FREE = {
    "hub.inertia.inertia": "J",
    "hub.pid_servo.torque_constant": "kt",
    "hub.pid_servo.resistance": "R",
    "hub.coulomb.level": "level",
}


def test_a_current_in_the_log_sets_the_scale_of_all_torques():
    """The fit starts 30 % off and finds inertia, motor and friction from noisy angle and current."""
    goal, rng = goals(600), np.random.default_rng(3)
    run = firmware_run(goal, *(TRUTH[k] for k in ("J", "kt", "R", "level")), {}, WINDUP)
    log = Recording(
        u=goal,
        y=run[:, :2] + rng.normal(0, [2e-3, 0.02], (600, 2)),
        channels=("theta", "current"),
        Ts=TS,
        input_name="goal",
        input_unit="rad",
        units=("rad", "A"),
    )
    # The weight is free too, so that only the current determines the scale of torques.
    start = pid({}) + fx.Coulomb("hub", level=0.02)
    start = dataclasses.replace(
        start,
        effects=tuple(e for e in start.effects if e.name != "duty_meter"),
        outputs={"theta": "hub", "current": ("hub", "current")},
        trusted=start.trusted - {"hub.duty_meter.time"},
    ).release("hub.inertia.inertia")
    away = {name: (0.7, 1.3)[k % 2] * TRUTH[key] for k, (name, key) in enumerate(FREE.items())}
    found = rf.fit(start.with_values(away), log)
    for name, key in FREE.items():
        assert found[name].value == pytest.approx(TRUTH[key], rel=0.05), key
        assert found[name].std < 0.05 * TRUTH[key]
    assert found["hub.gravity.sine"].value == pytest.approx(SINE, rel=0.05)
    # With the angle alone, a common factor of all torques is not identifiable.
    alone = dataclasses.replace(start, outputs={"theta": "hub"})
    assert not rf.identifiable(alone).structural
    assert rf.identifiable(start).structural


def test_with_the_torque_off_the_arm_falls_freely():
    """With open windings no back-EMF brakes it; a duty of zero would brake. Reference: scipy."""
    machine = servo("xl330", 0.007, weight=SINE)
    falling = Recording(
        u=np.zeros(300),
        y=np.linspace(1.0, 0.9, 300),
        Ts=TS,
        input_name="goal",
        input_unit="rad",
        accept="constant_input",  # the goal has no effect
        constants={"hub.position_servo.enabled": 0.0},
    )
    off = rf.Model(machine).at(falling).mechanism
    found = rf.simulate(off, np.zeros(300), TS, x0=[1.0, 0.0])[:, 0]
    fall = solve_ivp(
        lambda _, x: [x[1], -SINE * np.sin(x[0]) / 0.007],
        (0, 300 * TS),
        [1.0, 0.0],
        rtol=1e-9,
        atol=1e-11,
        t_eval=TS * np.arange(300),
    ).y[0]
    assert np.max(np.abs(found - fall)) < 2e-3
    shorted = servo("xl330", 0.007, weight=SINE, gain=0.0)
    assert abs(rf.simulate(shorted, np.zeros(300), TS, x0=[1.0, 0.0])[-1, 0] - fall[-1]) > 0.3


def test_presets_have_what_the_log_has():
    for kind in ("xl330", "sts3215"):
        plain, full = servo(kind), servo(kind, sensors="theta+current+duty", integral=50, derivative=2)
        assert plain.channels == ("theta",) and full.channels == ("theta", "current", "duty")
        assert full.free_names == tuple(n.replace("position_servo", "pid_servo") for n in plain.free_names)
        units = [q.unit(full.units) for q in full.quantities]
        assert units == ["rad", "A", ""]
    # Registers of a Dynamixel: P / 128, I / 65536 a period of 1 ms, D / 16, in one unit of the duty.
    loop = servo("xl330", gain=128, integral=65536, derivative=16).effect("pid_servo", "hub").values
    one = loop["gain"] * loop["gain_scale"]
    assert loop["integral"] == pytest.approx(one / 1e-3)
    assert loop["derivative"] == pytest.approx(one * 1e-3)
    assert by_name.joint("servo:kind=sts3215,gain=16,sensors=theta+current") == servo(
        "sts3215", gain=16, sensors="theta+current"
    )
    with pytest.raises(InputError, match="`kind` must be one of 'xl330', 'sts3215'"):
        servo("mx28")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match=r"`sensors` must be one of 'theta', 'theta\+current'"):
        servo(sensors="current")
    with pytest.raises(InputError, match=r"needs an effect there that shows it; put a CurrentMeter\('hub'\)"):
        dataclasses.replace(servo(), outputs={"theta": "hub", "current": ("hub", "current")})
    with pytest.raises(InputError, match="needs a port with a servo"):
        _ = rf.joints.paper() + fx.DutyMeter("hub")
    with pytest.raises(InputError, match="a motor whose current is known"):
        _ = rf.joints.two_dof_link() + fx.CurrentMeter("hub")


def test_a_meter_shows_the_current_whose_torque_saturates():
    """A motor against a stop of Coulomb friction, no back-EMF: the current is voltage over resistance."""
    motor = fx.Motor("hub", torque_constant=0.4, back_emf=0.0, gear_ratio=1.0, resistance=3.4)
    stopped = rf.Mechanism(
        ("q",),
        {"hub": (1.0,)},
        [fx.Inertia("hub", inertia=0.01), motor, fx.Coulomb("hub", level=9.0), fx.CurrentMeter("hub")],
        outputs={"q": "hub", "current": ("hub", "current")},
    )
    for machine in (stopped, stopped + fx.TorqueSaturation("hub", loss=2.0)):
        y = rf.simulate(machine, np.full(400, 6.0), 0.005)
        assert y[-1, 1] == pytest.approx(6.0 / 3.4, rel=1e-3)


def test_the_current_of_a_motor_on_a_voltage_is_shown_too():
    """Held at rest by friction: current = voltage / resistance."""
    joint = rf.joints.paper() + fx.Coulomb("hub", level=1.0) + fx.CurrentMeter("hub", time=1e-3)
    joint = dataclasses.replace(joint, outputs=dict(joint.outputs) | {"i": ("hub", "current")})
    motor = joint.effect("motor", "hub").values
    found = rf.simulate(joint, np.full(50, 0.5), 0.002)
    assert found[-1, -1] == pytest.approx(0.5 / motor["resistance"], rel=1e-9)
    assert np.abs(found[:, 0]).max() < 1e-15


def test_simulators_get_the_motion_and_the_certificate_names_the_rest():
    exported = rf.export.to_urdf(pid(PARTS), Ts=TS)
    said = str(exported.certificate)
    for text in ("current: the current at hub", "duty: the duty at hub", "integral of 3"):
        assert text in said
    assert exported.certificate.channels == ("theta",)
    # An effect of a sensor whose reading is left out is left out too.
    calibrated = pid(PARTS) + fx.SensorGain("current", 1.1)
    assert rf.export.to_urdf(calibrated, Ts=TS).content == exported.content


def test_a_search_scores_errors_of_a_current_sensor() -> None:
    """The models that it compares have the meter that the output needs."""
    servo = rf.joints.servo("sts3215", gain=16, sensors="theta+current")
    rng, parts = np.random.default_rng(0), []
    for _ in range(2):
        u = np.repeat(rng.uniform(-0.5, 0.5, 12), 50)
        y = rf.simulate(servo, u, 0.01) * [1.0, 1.2] + 1e-3 * rng.standard_normal((len(u), 2))
        parts.append(Recording(u, y, 0.01, channels=("theta", "current"), units=("rad", "A")))
    found = rf.discover(servo, *parts, candidates=[(fx.SensorGain, "current")], rounds=1)
    assert [(r.effect, r.port) for r in found.ranking] == [("sensor_gain", "current")]
