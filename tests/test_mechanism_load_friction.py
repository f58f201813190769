"""Friction that grows with the load of a gear: closed forms, scipy, sticking, sensitivities, a fit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.errors import InputError
from rotflex_jax.joints import paper, single_inertia, xl330_pendulum
from rotflex_jax.mechanism import Exponential, SmoothRK4, free_run, simulate, simulate_states
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.mechanism.step import load_rows, transmitted_torques
from rotflex_jax.runtime.xla import double_precision

Ts, J, EMF, RESISTANCE = 0.002, 0.0021, 0.00767 * 70, 2.6
GAIN, LOSS = EMF / RESISTANCE, EMF**2 / RESISTANCE
FC, DRIVING, DRIVEN = 0.02, 0.3, 0.8
FRICTION = fx.LoadFriction("hub", level=FC, driving=DRIVING, driven=DRIVEN)


def steps(N: int = 500, hold: int = 10, size: float = 3.0) -> np.ndarray:
    return np.repeat(np.random.default_rng(0).uniform(-size, size, -(-N // hold)), hold)[:N]


@pytest.mark.parametrize("volts", [0.05, 0.113, 0.116, 0.2, 2.0, -2.0])
def test_a_motor_alone_loses_its_share(volts):
    """The load is the inertia alone, so half of the torque passes the gear; motion in closed form."""
    u, t = np.full(200, volts), Ts * np.arange(200)
    found = simulate(single_inertia(J) + FRICTION, u, Ts)[:, 0]
    push = (1 - DRIVING / 2) * GAIN * abs(volts) - FC
    if push <= 0:
        assert (np.abs(found) < 1e-15).all()
        return
    rate = (1 - DRIVING / 2) * LOSS / J
    moved = push / (rate * J) * (t - (1 - np.exp(-rate * t)) / rate)
    np.testing.assert_allclose(found, np.sign(volts) * moved, atol=1e-5)


def test_a_coasting_motor_is_driven():
    """Without voltage the back-EMF brakes, and gear friction adds its share of that torque."""
    states = simulate_states(single_inertia(J) + FRICTION, np.zeros(100), Ts, np.array([0.0, 5.0]))
    t, rate = Ts * np.arange(100), (1 + DRIVEN / 2) * LOSS / J
    speed = (5.0 + FC / (rate * J)) * np.exp(-rate * t) - FC / (rate * J)
    np.testing.assert_allclose(states[:, 1], np.maximum(speed, 0), atol=2e-3 * 5)
    assert (states[-20:, 1] == 0).all()


def test_a_load_turns_a_gear_only_where_friction_lets_it():
    """A deflected joint pulls at a hub without voltage; it rests if `level + driven pull / 2 >= pull`."""
    pull, K = 0.3, 1.61
    start = np.array([0.0, pull / K, 0.0, 0.0])
    for driven, holds in ((1.6, False), (1.7, True)):
        assert (0.05 + driven * pull / 2 >= pull) == holds
        machine = paper() + fx.LoadFriction("hub", level=0.05, driving=0.0, driven=driven)
        hub = simulate_states(machine, np.zeros(3), Ts, start)[:, 0]
        assert (np.abs(hub).max() < 1e-15) == holds
    # From `driven` = 2 on the hub is held at any deflection, and the arm swings alone.
    machine = paper() + fx.LoadFriction("hub", level=0.01, driving=0.0, driven=2.1)
    states = simulate_states(machine, np.zeros(400), Ts, start)
    assert np.abs(states[:, 0]).max() < 1e-14
    swing = pull / K * np.cos(np.sqrt(K / 0.0059) * Ts * np.arange(400))
    np.testing.assert_allclose(states[:, 1], swing, atol=1e-5)


def by_scipy(u: np.ndarray, hold: int, width: float = 2e-3) -> np.ndarray:
    """Hub and deflection every `hold` samples, the law written out, friction over a small width of speed."""
    J_a, K, d = 0.0059, 1.61, 0.003

    def f(_, x, v):
        motor, joint = GAIN * v - LOSS * x[2], K * x[1] + d * x[3]
        load = (motor - joint) / 2
        way = np.tanh(x[2] / width)
        share = DRIVING if load * way > 0 else DRIVEN
        hub = (motor + joint - (FC + share * abs(load)) * way) / J
        return [x[2], x[3], hub, -joint / J_a - hub]

    x, out = np.zeros(4), []
    for v in u[::hold]:
        out.append(x)
        x = solve_ivp(f, (0, hold * Ts), x, "LSODA", args=(v,), rtol=1e-8, atol=1e-10).y[:, -1]
    return np.array(out)


def test_against_scipy_in_a_joint():
    u, hold = steps(), 10
    expected = by_scipy(u, hold)[:, :2]
    machine = paper(joint_damping=0.003) + FRICTION
    coulomb = paper(joint_damping=0.003) + fx.Coulomb("hub", FC)
    assert np.abs(simulate(coulomb, u, Ts)[::hold] - expected).max() > 0.05
    for n in (1, 8):
        found = simulate(machine, u, Ts, solver=Exponential(substeps=n))[::hold]
        np.testing.assert_allclose(found, expected, atol=1e-3)
    smooth = simulate(machine, u, Ts, solver=SmoothRK4(width=2e-3, substeps=400))[::hold]
    np.testing.assert_allclose(smooth, expected, atol=2e-5)


def servo_by_scipy(goal: np.ndarray, period: float, width: float = 2e-3) -> tuple[np.ndarray, float, float]:
    """Angle of a pendulum on a servo, the law written out; largest duty before the limit; largest weight."""
    kt, R, supply, weight, inertia = 0.35, 3.4, 7.4, 0.49 * 9.80665 * 0.1, 0.49 * 0.1**2 + 0.002
    slope = 400 * 4096 / (2 * np.pi) / (256 * 885)

    def f(_, x, u):
        duty = slope * (u - x[0] + 0.5e-3 * x[1])
        motor = kt / R * (supply * np.clip(duty, -1, 1) - kt * x[1])
        pull = -weight * np.sin(x[0])
        load, way = (motor - pull) / 2, np.tanh(x[1] / width)
        share = DRIVING if load * way > 0 else DRIVEN
        return [x[1], (motor + pull - (FC + share * abs(load)) * way) / inertia]

    x, out = np.zeros(2), []
    for u in goal:
        out.append(x)
        x = solve_ivp(f, (0, period), x, "LSODA", args=(u,), rtol=1e-8, atol=1e-10).y[:, -1]
    angle = np.array(out)[:, 0]
    return angle, np.abs(slope * (goal - angle)).max(), np.abs(weight * np.sin(angle)).max()


def test_weight_and_the_limit_of_a_servo_are_part_of_the_load():
    period, goal = 0.005, np.repeat([0.4, 2.2, -1.2, 1.0, -2.4, 0.1], 60)
    expected, duty, weight = servo_by_scipy(goal, period)
    assert duty > 2 and weight > 0.4  # far beyond the limit, and a weight of half the motor's largest torque
    machine = xl330_pendulum() + FRICTION
    for solver, error in ((Exponential(substeps=8), 5e-4), (Exponential(), 4e-3)):
        found = simulate(machine, goal, period, solver=solver)[:, 0]
        np.testing.assert_allclose(found, expected, atol=error)
    smooth = simulate(machine, goal, period, solver=SmoothRK4(width=2e-3, substeps=400))[:, 0]
    np.testing.assert_allclose(smooth, expected, atol=1e-4)


def test_the_load_is_that_of_both_sides_at_any_state():
    """Reference: the closed form, with goal, limit, weight and the loss of a hot motor."""
    machine = xl330_pendulum() + fx.Heating("hub") + FRICTION
    heat = machine.effect("heating", "hub")
    gates = np.ones(len(machine.effects))
    with double_precision():
        rows = load_rows(machine, jnp.asarray(gates))
        for q, w, goal, z in ((0.1, 2.0, 0.3, 0.2), (-0.4, -1.0, 1.5, 0.5), (0.9, 0.0, -2.5, 0.0)):
            duty = 400 * 4096 / (2 * np.pi) / (256 * 885) * (goal - q + 0.5e-3 * w)
            motor = 0.35 / 3.4 * (7.4 * np.clip(duty, -1, 1) - 0.35 * w)
            motor += float(heat.force(z, q, w, motor))
            pull = -0.49 * 9.80665 * 0.1 * np.sin(q)
            given = map(jnp.asarray, ([q, w], [z], goal, gates))
            found = transmitted_torques(machine, rows, *given)
            np.testing.assert_allclose(found, [(motor - pull) / 2], rtol=1e-9)


def test_the_current_and_the_gear_take_part():
    """A small inductance changes little; separated teeth transmit nothing, so friction is its level alone."""
    u = steps()
    plain = simulate(paper() + FRICTION, u, Ts)
    np.testing.assert_allclose(simulate(paper(inductance=1e-5) + FRICTION, u, Ts), plain, atol=2e-4)
    start = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    apart = [
        simulate_states(paper(stiffness=0.0) + fx.Backlash("hub", gap=1.0) + e, np.full(4, 0.01), Ts, start)
        for e in (FRICTION, fx.Coulomb("hub", FC))
    ]
    np.testing.assert_allclose(apart[0], apart[1], rtol=0, atol=1e-15)


def test_slopes_are_those_of_central_differences():
    machine, u = paper(joint_damping=0.003) + FRICTION, steps(200)
    structure, values = machine.structure, machine.values
    with double_precision():
        rest = [jnp.ones(len(machine.effects)), jnp.zeros(4), jnp.asarray(u), jnp.asarray(Ts)]
        run = jax.jit(lambda v: free_run(structure, Exponential(), v, *rest)[1])
        slope = jax.jit(lambda v, d: jax.jvp(run, (v,), (d,))[1])
        for name in ("level", "driving", "driven"):
            way = np.zeros(len(values))
            i = machine.parameter_names.index(f"hub.load_friction.{name}")
            way[i] = values[i]
            found = np.asarray(slope(jnp.asarray(values), jnp.asarray(way)))
            secant = np.asarray(run(values + 1e-6 * way) - run(values - 1e-6 * way)) / 2e-6
            assert np.abs(secant).max() > 1e-4
            np.testing.assert_allclose(found, secant, atol=1e-5 * np.abs(secant).max(), err_msg=name)


def test_a_fit_finds_both_shares():
    true = paper(joint_damping=0.003) + FRICTION
    start = paper(joint_damping=0.005) + fx.LoadFriction("hub", level=0.01, driving=0.1, driven=0.1)
    held = ("hub.motor.torque_constant", "hub.inertia.inertia", "hub.viscous.coefficient")
    u = steps(3000, 25, 4.0)
    y = simulate(true, u, Ts) + 5e-4 * np.random.default_rng(1).normal(size=(3000, 2))
    fit = rf.fit(start.trust(*held), rf.Recording(u=u, y=y, Ts=Ts, accept=("units",)))
    found = fit.model.mechanism.effect("load_friction", "hub").values
    assert found["driving"] == pytest.approx(DRIVING, abs=0.02)
    assert found["driven"] == pytest.approx(DRIVEN, abs=0.03)
    assert found["level"] == pytest.approx(FC, abs=0.002)


def test_tied_shares_are_one_in_a_fit_and_in_a_file(tmp_path):
    """A fit moves `driving` alone and `driven` follows; runs are those of the effect with equal shares."""
    tied = paper(joint_damping=0.003) + fx.LoadFriction(
        "hub", level=FC, driving=DRIVING, driven=9.0, tied=True
    )
    both = paper(joint_damping=0.003) + fx.LoadFriction("hub", level=FC, driving=DRIVING, driven=DRIVING)
    u = steps(1500, 25, 4.0)
    assert np.array_equal(simulate(tied, u, Ts), simulate(both, u, Ts))
    name = "hub.load_friction.driven"
    assert name in both.free_names and name not in tied.free_names
    moved = tied.with_values({"hub.load_friction.driving": 0.5})
    assert moved.effect("load_friction", "hub").values["driven"] == 0.5
    back = rf.Model.load(rf.Model(moved).save(tmp_path / "tied.json"))
    assert back == rf.Model(moved)
    with pytest.raises(InputError, match="tied=1, but it needs True or False"):
        fx.LoadFriction("hub", tied=1)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("push", [0.3, 0.375, 0.385, 0.5, 0.62, 0.64, 0.7])
def test_friction_in_proportion_to_the_motors_torque_holds_a_weight(push):
    """It rises if `push (1 - share) - level > weight`, and sinks if `push (1 + share) + level < weight`."""
    weight, level, share = 0.48, 0.02, 0.2
    lifts, sinks = push * (1 - share) - level > weight, push * (1 + share) + level < weight
    m = single_inertia(J) + fx.Gravity("hub", sine=0.0, cosine=weight)
    m = m + fx.GearFriction("hub", level=level, share=share)
    moved = simulate(m, np.full(5, push / GAIN), Ts)[-1, 0]
    assert (moved > 1e-6) == lifts and (moved < -1e-6) == sinks
    assert lifts or sinks or abs(moved) < 1e-15


def test_it_is_the_load_friction_of_the_motor_with_one_share():
    given, u = paper(joint_damping=0.003), steps(1500, 25, 4.0)
    one = simulate(given + fx.GearFriction("hub", level=FC, share=DRIVING), u, Ts)
    tied = fx.LoadFriction("hub", level=FC, driving=DRIVING, tied=True, of="motor")
    np.testing.assert_allclose(one, simulate(given + tied, u, Ts), atol=1e-12)


def test_two_frictions_of_different_torques_at_one_port_are_refused():
    with pytest.raises(InputError, match="depend on different torques through the gear"):
        _ = paper() + FRICTION + fx.GearFriction("hub")
    servo = xl330_pendulum()
    assert (fx.GearFriction, "hub") in search_places(servo)
    assert fx.GearFriction not in dict(search_places(servo + FRICTION))


def test_it_needs_a_motor_and_an_inertia():
    with pytest.raises(InputError, match="at 'arm', but it needs a port with a motor and an inertia"):
        _ = paper() + fx.LoadFriction("arm")
