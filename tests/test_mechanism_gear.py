"""Play in the gear: closed forms, an event-driven solver, the arena's gear, and the score test."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rotflex_jax.effects as fx
from rotflex_jax.arena.simulator import plant as arena
from rotflex_jax.arena.simulator.laws import laws
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.discover.hypothesis import Hypothesis, Whitener
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.score_test import score_test
from rotflex_jax.discover.supermodel import EffectLocation, build, scales
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import prepare
from rotflex_jax.joints import paper, single_inertia
from rotflex_jax.mechanism import (
    Exponential,
    Mechanism,
    SmoothRK4,
    free_run,
    kalman_gains,
    simulate,
    simulate_states,
)
from rotflex_jax.mechanism.assembly import Layout
from rotflex_jax.mechanism.gear import delayed
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Transform
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import double_precision

PLACE, NOISE = EffectLocation("backlash", "hub"), np.array([5.4e-4, 5.4e-4])
Ts, GAP, SHARE = 0.002, 0.0055, 0.7
J, EMF, RESISTANCE = 0.002, 0.00767 * 70, 2.6
GAIN = EMF / RESISTANCE  # torque per volt; times EMF, the torque lost per speed


def lone(**numbers: float) -> Mechanism:
    """A hub with play and a motor without losses."""
    return single_inertia(J, motor=fx.Motor(back_emf=0.0)) + fx.Backlash("hub", **numbers)


def joint(gap: float = GAP, share: float = SHARE, **parts: float) -> Mechanism:
    return paper(hub_damping=0.004, joint_damping=0.003, **parts) + fx.Backlash("hub", gap=gap, share=share)


def test_each_way_through_a_step_is_in_the_program_once(monkeypatch):
    """Three times in all: in flight, in contact, and where that changes.

    Programs with play take long to compile.
    """
    step, ways = sys.modules[Exponential.__module__], []
    smooth = step._advance_smooth
    monkeypatch.setattr(step, "_advance_smooth", lambda *given: ways.append(1) or smooth(*given))
    m, solver = joint(), Exponential()
    gates, x = np.ones(len(m.effects)), np.zeros(6)
    constants = solver.prepare(m.structure, jnp.asarray(m.values), jnp.asarray(gates), jnp.asarray(Ts))
    jax.make_jaxpr(lambda x: solver.advance(m.structure, x, jnp.asarray(0.0), constants))(x)
    assert len(ways) == 3


def noise(N: int, hold: int = 5, seed: int = 0) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).normal(size=-(-N // hold)), hold)[:N]


def rotor(states: np.ndarray, hub: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Angle and speed of the rotor relative to the hub, the last two states of these machines."""
    assert states.shape[1] >= hub + 2
    return states[:, -2], states[:, -1]


def test_the_rotor_crosses_the_gap_alone():
    """From the middle of the play under a constant voltage: a t^2 / 2 until the rotor meets the stop."""
    states = simulate_states(lone(gap=GAP, share=SHARE), np.full(40, 0.5), Ts)
    t, a = Ts * np.arange(40), 0.5 * GAIN / (SHARE * J)
    r, s = rotor(states)
    flying = t < np.sqrt(2 * GAP / a)
    assert 5 < flying.sum() < 30
    np.testing.assert_allclose(r[flying], a * t[flying] ** 2 / 2, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(s[flying], a * t[flying], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(states[flying, :2], 0.0, atol=1e-15)
    # Then both move together, with all the momentum that the motor has given.
    assert (r[~flying] == GAP).all() and (s[~flying] == 0).all()
    np.testing.assert_allclose(states[~flying, 1], 0.5 * GAIN * t[~flying] / J, rtol=1e-6)
    # Their centre of mass moves as under the torque of the motor alone.
    np.testing.assert_allclose(
        states[~flying, 0] + SHARE * GAP, 0.5 * GAIN * t[~flying] ** 2 / (2 * J), rtol=1e-6
    )


def test_an_impact_keeps_momentum_and_takes_energy():
    """Two bodies fly towards each other, meet once without bouncing, and go on as one."""
    hub, relative = -0.4, 1.3
    states = simulate_states(
        lone(gap=GAP, share=SHARE), np.zeros(20), Ts, np.array([0.0, hub, -GAP / 2, relative])
    )
    s = rotor(states)[1]
    speed, momentum = states[:, 1], J * (states[:, 1] + SHARE * s)
    np.testing.assert_allclose(momentum, J * (hub + SHARE * relative), rtol=1e-12)
    after = Ts * np.arange(20) > 1.5 * GAP / relative
    assert (s[after] == 0).all() and 3 < after.sum() < 18
    np.testing.assert_allclose(s[~after], relative, rtol=1e-12)
    energy = J * ((1 - SHARE) * speed**2 + SHARE * (speed + s) ** 2) / 2
    lost = J * SHARE * (1 - SHARE) * relative**2 / 2
    assert energy[0] - energy[-1] == pytest.approx(lost, rel=1e-9)
    # The final angle of the hub depends on the instant of the impact within its step.
    met = 1.5 * GAP / relative
    end = hub * met + (hub + SHARE * relative) * (19 * Ts - met)
    assert states[-1, 0] == pytest.approx(end, abs=1e-12)


def test_in_contact_two_inertias_are_one():
    plain = paper(hub_damping=0.004, joint_damping=0.003)
    start = np.array([0.0, 0.0, 0.0, 0.0, GAP, 0.0])
    u = np.linspace(0.0, 4.0, 200)
    states = simulate_states(joint(), u, Ts, start)
    pushed = rotor(states, 4)[0] == GAP
    together = int(np.argmin(pushed)) if not pushed.all() else 200
    assert together > 20
    np.testing.assert_allclose(states[:together, :2], simulate(plain, u, Ts)[:together], rtol=0, atol=1e-14)


def test_no_gap_is_no_gear():
    u, plain = noise(1000), paper(hub_damping=0.004, joint_damping=0.003)
    pairs = [(joint(gap=0.0), plain), tuple(m + fx.Coulomb("hub", 0.02) for m in (joint(gap=0.0), plain))]
    for geared, bare in pairs:
        np.testing.assert_allclose(simulate(geared, u, Ts), simulate(bare, u, Ts), rtol=0, atol=1e-14)
    fine = Exponential(substeps=8)
    off = [
        np.abs(simulate(joint(gap=g), u, Ts, solver=fine) - simulate(plain, u, Ts)).max()
        for g in (1e-3, 1e-5)
    ]
    assert off[1] < off[0] / 50


def test_the_rotor_stays_between_its_stops_and_energy_falls():
    rng = np.random.default_rng(3)
    machine = joint() + fx.Coulomb("hub", 0.01)
    r, s = rotor(simulate_states(machine, 2 * noise(2000), Ts), 4)
    assert np.abs(r).max() <= GAP and r.min() == -GAP and r.max() == GAP
    assert 0.1 < np.mean(np.abs(r) == GAP) < 0.95 and (s[np.abs(r) < GAP / 2] != 0).any()
    free = joint().with_values({"hub.motor.back_emf": 0.0})
    for _ in range(5):
        start = np.concatenate([rng.normal(size=2) * 0.1, rng.normal(size=2), [0.0], 3 * rng.normal(size=1)])
        x = simulate_states(free, np.zeros(500), Ts, start, Exponential(substeps=4))
        hub, arm, motor = x[:, 2], x[:, 2] + x[:, 3], x[:, 2] + x[:, 5]
        masses = ((1 - SHARE) * 0.0021, 0.0059, SHARE * 0.0021)
        energy = 1.61 * x[:, 1] ** 2 / 2
        energy = energy + sum(m * w**2 / 2 for m, w in zip(masses, (hub, arm, motor), strict=True))
        assert np.diff(energy).max() < 1e-6 * energy[0] and energy[-1] < 0.7 * energy[0]


def by_events(u: np.ndarray, hold: int, share: float, inductance: float | None = None) -> np.ndarray:
    """Hub, deflection, rotor, their speeds and the current by scipy, with events of contact and release."""
    J_r, J_h, J_a, K = share * 0.0021, (1 - share) * 0.0021, 0.0059, 1.61

    def carried(x, v, side):
        load, current = K * x[1] + 0.003 * x[4] - 0.004 * x[3], (v - EMF * x[5]) / RESISTANCE
        current = current if inductance is None else x[6]
        motor, arm = EMF * current, -(K * x[1] + 0.003 * x[4]) / J_a
        di = 0.0 if inductance is None else (v - RESISTANCE * x[6] - EMF * x[5]) / inductance
        if side == 0:
            return load / J_h, arm, motor / J_r, di, 0.0
        common = (motor + load) / (J_h + J_r)
        return common, arm, common, di, motor - J_r * common

    def f(_, x, v, side):
        hub, arm, motor, di, _ = carried(x, v, side)
        return [x[3], x[4], x[5], hub, arm - hub, motor, di]

    x, side, out = np.zeros(7), 0, []
    for k in range(0, u.size, hold):
        out.append(x)
        t, end, v = 0.0, hold * Ts, u[k]
        while t < end:
            if side and side * carried(x, v, side)[4] < 0:
                side = 0
            if side:
                events = [lambda _, x, v, side: side * carried(x, v, side)[4]]
            else:
                events = [lambda _, x, *__, w=w: GAP - w * (x[2] - x[0]) for w in (1, -1)]
            for event in events:
                event.terminal, event.direction = True, -1
            found = solve_ivp(f, (t, end), x, "RK45", events=events, args=(v, side), rtol=1e-9, atol=1e-11)
            t, x = found.t[-1], found.y[:, -1].copy()
            if found.status == 1 and side:
                side = 0
            elif found.status == 1:
                side = 1 if found.t_events[0].size else -1
                before, x[3] = x[3], share * x[5] + (1 - share) * x[3]
                x[4] += before - x[3]
                x[2], x[5] = x[0] + side * GAP, x[3]
    return np.array(out)


def test_a_torque_that_begins_with_an_impact_acts_for_the_rest_of_the_step():
    """From rest, a unit acceleration for the time 1 - t gives the speed 1 - t and the way (1 - t)^2 / 2."""
    layout = Layout.of(joint().structure)
    positions = np.isin(np.arange(layout.linear), [*range(layout.n), layout.rotor])
    whole, rest = jnp.asarray(np.where(positions, 0.5, 1.0)), 1 - 0.25
    expected = np.where(positions, rest**2 / 2, rest)
    np.testing.assert_allclose(delayed(jnp.asarray(0.25), whole, layout), expected, rtol=1e-6)


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_against_an_event_driven_solver(share):
    u, hold = noise(400, hold=10, seed=2), 10
    exact = by_events(u, hold, share)
    plain = simulate(paper(hub_damping=0.004, joint_damping=0.003), u, Ts)[::hold]
    assert np.abs(plain - exact[:, :2]).max() > 5e-3
    errors = []
    for n in (1, 4):
        x = simulate_states(joint(share=share), u, Ts, solver=Exponential(substeps=n))[::hold]
        errors.append(
            np.abs(x[:, [0, 1, 4]] - np.column_stack([exact[:, :2], exact[:, 2] - exact[:, 0]])).max()
        )
    assert errors[0] < 1e-4
    assert errors[1] < 1e-5


def test_the_current_of_the_motor_follows_the_rotor():
    u, hold, L = noise(150, hold=10, seed=4), 10, 2e-3
    exact = by_events(u, hold, SHARE, L)
    x = simulate_states(joint(inductance=L), u, Ts, solver=Exponential(substeps=4))[::hold]
    assert x.shape[1] == 7
    np.testing.assert_allclose(x[:, :2], exact[:, :2], atol=2e-5)
    np.testing.assert_allclose(x[:, 4], exact[:, 6], atol=2e-3)
    assert np.abs(by_events(u, hold, SHARE)[:, :2] - exact[:, :2]).max() > 1e-4


@pytest.mark.parametrize(
    ("beside", "there", "exact"),
    [
        (None, {}, (5e-5, 3e-6)),
        (fx.CubicSpring("joint", 40.0), {("cubic_spring", "joint"): {"coefficient": 40.0}}, (5e-5, 5e-6)),
    ],
)
def test_the_arena_has_the_same_gear(beside, there, exact):
    u = noise(2000)
    true = arena.course(
        arena.Plant(), laws({("backlash", "hub"): {"play": 2 * GAP}, **there}), u, Ts, step=4e-6
    )
    machine = joint(share=arena.ROTOR_SHARE)
    machine = machine if beside is None else machine + beside
    for n, limit in zip((1, 4), exact, strict=True):
        x = simulate_states(machine, u, Ts, solver=Exponential(substeps=n))
        np.testing.assert_allclose(x[:, :2], true.motion[:, :2], atol=limit)
    np.testing.assert_allclose(x[:, 4], true.rotor[:, 0] - true.motion[:, 0], atol=2e-5)


def test_slopes_are_those_of_central_differences():
    machine, u = joint(), noise(300)
    structure, values = machine.structure, machine.values
    with double_precision():
        rest = [jnp.ones(len(machine.effects)), jnp.zeros(6), jnp.asarray(u), jnp.asarray(Ts)]
        run = jax.jit(lambda v: free_run(structure, Exponential(), v, *rest)[1])
        slope = jax.jit(lambda v, d: jax.jvp(run, (v,), (d,))[1])
        for i, name in enumerate(machine.parameter_names):
            way = np.zeros(len(values))
            way[i] = values[i]
            found = np.asarray(slope(jnp.asarray(values), jnp.asarray(way)))
            reach = 1e-6
            secant = np.asarray(run(values + reach * way) - run(values - reach * way)) / (2 * reach)
            assert np.abs(secant).max() > 1e-5, name
            np.testing.assert_allclose(found, secant, atol=1e-6 * np.abs(secant).max(), err_msg=name)


def test_a_predictor_knows_nothing_of_the_rotor():
    """The gain is that of the machine without play; angle and speed of the rotor in the play get none."""
    known, plain = joint(), paper(hub_damping=0.004, joint_damping=0.003)
    gains = [kalman_gains(m, [{"hub": 1e-4, "joint": 1e-5}], NOISE, Ts)[0] for m in (known, plain)]
    np.testing.assert_allclose(gains[0][:4], gains[1], rtol=1e-9)
    assert (gains[0][4:] == 0).all()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: paper() + fx.Backlash("arm"), "at 'arm', but it needs a port with a motor and an inertia"),
        (lambda: paper().without("motor", "hub") + fx.Backlash("hub"), "needs a port with a motor"),
        (lambda: paper().without("inertia", "hub") + fx.Backlash("hub"), "needs a port with a motor"),
        (lambda: fx.Backlash("hub", gap=-0.001), "between 0 and inf"),
        (lambda: fx.Backlash("hub", share=1.0), "between 0.02 and 0.98"),
        (lambda: simulate(joint(), noise(10), Ts, solver=SmoothRK4()), "use Exponential"),
    ],
)
def test_what_cannot_be(wrong, message):
    with pytest.raises(InputError, match=message):
        wrong()


def test_one_gear_is_enough():
    second = paper() + fx.Motor("joint") + fx.Inertia("joint", 1e-4) + fx.Backlash("hub")
    with pytest.raises(InputError, match="only one is possible"):
        _ = second + fx.Backlash("joint")


def test_a_search_meets_play_at_its_size():
    """Play is left out of all runs while it is off, and scored by runs with gaps in factors of two."""
    made = make_record(
        {("backlash", "hub"): {"play": 2 * GAP}}, seed=2100, seconds=3.0, fs=500.0, perturb=0.0
    )
    recording = Recording(u=made["u"], y=made["y"], Ts=made["Ts"], accept=("units",))
    model = Model(paper(hub_damping=0.004, joint_damping=0.003))
    dataset = dataclasses.replace(prepare(model, [recording]), noise=NOISE)
    wanted = [(fx.Backlash, "hub"), (fx.Lag, "input"), (fx.Coulomb, "hub")]
    s = build(model.mechanism, wanted, scales(model, [recording], dataset.torque_scale))
    gaps = [p[0][0] for p in s.candidates[PLACE].probes]
    np.testing.assert_allclose(np.diff(np.log2(sorted(gaps))), 1.0)
    assert min(gaps) < GAP / 10 and max(gaps) > 4 * GAP and min(abs(np.log2(g / GAP)) for g in gaps) > 0.1

    problem = LikelihoodProblem.of(s, Exponential(), dataset, ("hub", "joint"))
    h = Hypothesis(
        locations=(),
        free=tuple(s.baseline_free),
        local=(),
        z=Transform.of(s.mechanism.parameter_specifications).unconstrain(s.mechanism.values),
        local_z=np.zeros((1, 0)),
        x0=np.zeros((1, 1, 4)),
        K=np.zeros((1, Layout.of(s.mechanism.structure).size, 2)),
        process_noise={},
        whitener=Whitener(np.diag(1 / NOISE)),
    )
    h = problem.with_process_noise(h, {"hub": 0.0, "joint": 0.0})
    off, on = (s.active(s.gates(locations)).mechanism for locations in ((), (PLACE,)))
    gentle = s.with_family(s.gates(()), [c for c in s.candidates.values() if not c.threshold]).mechanism
    assert not any(isinstance(e, fx.Gear) for e in (*off.effects, *gentle.effects))
    assert any(isinstance(e, fx.Gear) for e in on.effects)
    assert h.initial_state_for(s, (PLACE,)).shape == (1, 1, 6)

    best, *others = score_test(problem, h).listed
    assert best.location == PLACE and best.nats > 2 * max(o.nats for o in others) and best.excited
    assert 1 / 2 < best.start.values[0] / GAP < 2
    assert {o.location for o in others} == {("lag", "input"), ("coulomb", "hub")}
