"""Play with elastic teeth: closed forms, scipy's solver, the rigid limit, added friction, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiler_options import ROUGH
from scipy.integrate import solve_ivp

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.errors import InputError
from rotflex_jax.export import to_c
from rotflex_jax.joints import paper, single_inertia
from rotflex_jax.mechanism import Exponential, Mechanism, SmoothRK4, free_run, simulate, simulate_states
from rotflex_jax.mechanism.elastic_teeth import contact, swing
from rotflex_jax.mechanism.gear import Cubic
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.models.model import Model
from rotflex_jax.runtime.xla import double_precision

Ts, GAP, SHARE, STIFFNESS, DAMPING = 0.002, 0.0055, 0.7, 1500.0, 0.3
J, EMF, RESISTANCE = 0.0021, 0.00767 * 70, 2.6
REDUCED = SHARE * (1 - SHARE) * J  # reduced inertia of rotor and hub


def elastic(**numbers: float) -> fx.ElasticBacklash:
    return fx.ElasticBacklash(
        "hub", **({"gap": GAP, "share": SHARE, "stiffness": STIFFNESS, "damping": DAMPING} | numbers)
    )


def plain(**parts: float) -> Mechanism:
    return paper(hub_damping=0.004, joint_damping=0.003, **parts)


def noise(N: int, hold: int = 10, seed: int = 2) -> np.ndarray:
    return 1.5 * np.repeat(np.random.default_rng(seed).normal(size=-(-N // hold)), hold)[:N]


def by_scipy(u, hold, Ts=Ts, gap=GAP, share=SHARE, stiffness=STIFFNESS, damping=DAMPING, **more):
    """Hub, deflection and rotor relative to the hub, by scipy in steps so short that no contact is missed."""
    J_r, J_h, J_a, K = share * J, (1 - share) * J, 0.0059, 1.61
    level, L = more.get("level", 0.0), more.get("inductance")

    def f(_, x, v):
        r, s = x[2] - x[0], x[5] - x[3]
        side, depth = np.sign(r), abs(r) - gap
        teeth = max(0.0, stiffness * depth + damping * side * s) * side if depth > 0 else 0.0
        load = K * x[1] + 0.003 * x[4]
        hub = (teeth + load - 0.004 * x[3] - level * np.tanh(x[3] / 1e-3)) / J_h
        current = (v - EMF * x[5]) / RESISTANCE if L is None else x[6]
        di = 0.0 if L is None else (v - RESISTANCE * x[6] - EMF * x[5]) / L
        return [x[3], x[4], x[5], hub, -load / J_a - hub, (EMF * current - teeth) / J_r, di]

    x, out = np.zeros(7), []
    for v in u[::hold]:
        out.append(x)
        found = solve_ivp(f, (0, hold * Ts), x, "RK45", args=(v,), rtol=1e-9, atol=1e-11, max_step=1e-4)
        x = found.y[:, -1]
    out = np.array(out)
    return np.column_stack([out[:, :2], out[:, 2] - out[:, 0]])


def seen(machine: Mechanism, u, hold, Ts=Ts, substeps: int = 1) -> np.ndarray:
    states = simulate_states(machine, u, Ts, solver=Exponential(substeps=substeps))
    return states[::hold, [0, 1, states.shape[1] - 2]]


# -- one contact --------------------------------------------------------------------------------


@pytest.mark.parametrize("loss", [0.0, 0.3, 2.0, 1.9999999, 40.0, 3000.0])
def test_a_free_oscillator_against_the_matrix_exponential(loss):
    t = np.array([0.0, 1e-4, 0.3, 1.0, 5.0])
    with double_precision():
        s = swing(*(jnp.asarray(a) for a in (np.ones(5), np.full(5, loss), t)))
    for i, time in enumerate(t):
        values, vectors = np.linalg.eig(np.array([[0.0, 1.0], [-1.0, -loss]]) + 1e-13 * np.eye(2))
        if abs(values[0] - values[1]) > 1e-3:
            E = (vectors * np.exp(values * time)) @ np.linalg.inv(vectors)
        else:
            E = np.exp(-time) * np.array([[1 + time, time], [-time, 1 - time]])
        np.testing.assert_allclose(s.sine[i], E[0, 1].real, atol=3e-8)
        np.testing.assert_allclose(s.cosine[i], E[0, 0].real - loss / 2 * E[0, 1].real, atol=3e-8)


@pytest.mark.parametrize("start", [0.0, 0.37])
@pytest.mark.parametrize(("stiff", "loss"), [(0.8, 0.1), (30.0, 2.0), (400.0, 1.0), (5.0, 30.0)])
def test_moments_of_a_contact_against_quadrature(stiff, loss, start):
    """The free motion passes the stop outwards at time `start`, or begins in contact."""
    depth = 0.2 if start == 0 else 0.0
    slope = np.array([0.8, -1.1, 0.5])
    a = depth - sum(c * start ** (i + 1) for i, c in enumerate(slope))
    cubic, mass = (a, *slope), 0.7

    def acceleration(t):
        return 2 * slope[1] + 6 * slope[2] * t

    def f(t, x):
        return [x[1], acceleration(t) - stiff * x[0] - loss * x[1]]

    event = lambda t, x: stiff * x[0] + loss * x[1]  # noqa: E731
    event.terminal, event.direction = True, -1
    rate = slope[0] + 2 * slope[1] * start + 3 * slope[2] * start**2
    found = solve_ivp(f, (start, 1), [depth, rate], rtol=1e-11, atol=1e-13, events=[event], dense_output=True)
    t = np.linspace(start, found.t[-1], 20001)
    torque = mass * (stiff * found.sol(t)[0] + loss * found.sol(t)[1])
    expected = [np.trapezoid(torque * t**m, t) for m in range(3)]
    with double_precision():
        given = [jnp.asarray(c) for c in (start, stiff, loss, mass)]
        own = contact(Cubic(*map(jnp.asarray, cubic)), jnp.asarray(True), *given)
    np.testing.assert_allclose(own.moments, expected, rtol=2e-6, atol=1e-9)
    assert bool(own.lasts) == (found.status == 0)


def test_an_undamped_impact_returns_all_energy():
    """Two bodies meet, stay together for half a period of the teeth, and part with the opposite speed."""
    relative, share = 1.3, 0.5
    m = single_inertia(J, motor=fx.Motor(back_emf=0.0)) + elastic(share=share, damping=0.0)
    period = 2 * np.pi * np.sqrt(share * (1 - share) * J / STIFFNESS)
    states = simulate_states(m, np.zeros(12), Ts, np.array([0.0, -share * relative, 0.0, relative]))
    t = Ts * np.arange(12)
    parts = GAP / relative + period / 2
    assert 3 * Ts < parts < 10 * Ts
    after = (t > parts) & (t < parts + 1.9 * GAP / relative)
    np.testing.assert_allclose(states[after, 3], -relative, rtol=1e-9)
    np.testing.assert_allclose(states[after, 1], share * relative, rtol=1e-9)
    np.testing.assert_allclose(states[after, 2], GAP - relative * (t[after] - parts), atol=1e-12)
    # Their centre of mass does not move.
    np.testing.assert_allclose(states[:, 0] + share * states[:, 2], 0.0, atol=1e-12)


def test_teeth_under_load_bend_and_never_pull():
    """Under a constant torque the teeth transmit the hub's share of it, and they never pull."""
    volts, machine = 0.8, single_inertia(J, motor=fx.Motor(back_emf=0.0)) + elastic(damping=2.0)
    states = simulate_states(machine, np.full(300, volts), Ts)
    torque = EMF / RESISTANCE * volts
    np.testing.assert_allclose(states[100:, 2], GAP + (1 - SHARE) * torque / STIFFNESS, rtol=1e-7)
    np.testing.assert_allclose(np.diff(states[100:, 1]) / Ts, torque / J, rtol=1e-9)
    # When the torque ends, the teeth push rotor and hub apart, and the hub is never slowed down.
    speeds = simulate_states(machine, np.r_[np.full(100, volts), np.zeros(20)], Ts)[100:, 1]
    assert np.diff(speeds).min() > -1e-12


# -- against scipy ------------------------------------------------------------------------------


@pytest.mark.parametrize("period", [0.001, 0.002])
@pytest.mark.parametrize(
    ("stiffness", "damping", "share", "close"),
    [(1500.0, 0.3, 0.7, 3e-5), (1500.0, 2.0, 0.3, 1e-4), (300.0, 0.1, 0.7, 3e-5), (6000.0, 1.0, 0.7, 2e-4)],
)
def test_against_scipy(period, stiffness, damping, share, close):
    numbers = {"stiffness": stiffness, "damping": damping, "share": share}
    hold = round(0.02 / period)
    u = noise(60 * hold, hold)
    expected = by_scipy(u, hold, period, **numbers)
    rigid = seen(plain() + fx.Backlash("hub", gap=GAP, share=share), u, hold, period)
    assert np.abs(rigid - expected).max() > 2e-4
    errors = [np.abs(seen(plain() + elastic(**numbers), u, hold, period, n) - expected).max() for n in (1, 8)]
    assert errors[0] < close
    assert errors[1] < close / 20


@pytest.mark.parametrize("beside", [{"level": 0.03}, {"inductance": 2e-3}])
def test_friction_and_current_beside_it(beside):
    u, hold = noise(400), 10
    machine = plain(**{k: v for k, v in beside.items() if k == "inductance"}) + elastic()
    if "level" in beside:
        machine = machine + fx.Coulomb("hub", beside["level"])
    expected = by_scipy(u, hold, **beside)
    assert np.abs(by_scipy(u, hold) - expected).max() > 1e-3
    for n, close in ((1, 2e-3), (8, 1e-4)):
        found = seen(machine, u, hold, substeps=n)
        np.testing.assert_allclose(found, expected, atol=close)


# -- limits -------------------------------------------------------------------------------------


def test_rigid_teeth_are_the_limit():
    u, fine = noise(500), Exponential(substeps=8)
    rigid = simulate(plain() + fx.Backlash("hub", gap=GAP, share=SHARE), u, Ts, solver=fine)
    away = []
    for stiffness in (3e3, 1e5, 3e6):
        # With damping that prevents a rebound, as with rigid teeth.
        teeth = elastic(stiffness=stiffness, damping=40 * np.sqrt(stiffness * REDUCED))
        away.append(np.abs(simulate(plain() + teeth, u, Ts, solver=fine) - rigid).max())
    assert away[1] < away[0] / 4 and away[2] < away[1] / 2 and away[2] < 2e-5


@pytest.mark.parametrize("damping", [0.0, 0.3, 30.0])
def test_any_stiffness_is_stable(damping):
    """Runs stay bounded with friction that holds the hub, a motor that reverses, and one step of 2 ms."""
    u = 2 * noise(2000)
    for stiffness in (1.0, 1500.0, 1e5, 1e8):
        machine = plain() + fx.Coulomb("hub", 0.03) + elastic(stiffness=stiffness, damping=damping)
        x = simulate_states(machine, u, Ts)
        assert np.isfinite(x).all() and np.abs(x[:, 2:4]).max() < 30
        assert np.abs(x[:, 4]).max() < GAP + 3.0 / stiffness + 3e-3


def test_energy_falls():
    rng, free = np.random.default_rng(3), plain() + elastic()
    free = free.with_values({"hub.motor.back_emf": 0.0})
    for _ in range(5):
        start = np.concatenate([rng.normal(size=2) * 0.1, rng.normal(size=2), [0.0], 3 * rng.normal(size=1)])
        x = simulate_states(free, np.zeros(500), Ts, start)
        hub, arm, motor = x[:, 2], x[:, 2] + x[:, 3], x[:, 2] + x[:, 5]
        depth = np.maximum(np.abs(x[:, 4]) - GAP, 0.0)
        energy = (1.61 * x[:, 1] ** 2 + STIFFNESS * depth**2) / 2
        masses = ((1 - SHARE) * J, 0.0059, SHARE * J)
        energy = energy + sum(m * w**2 / 2 for m, w in zip(masses, (hub, arm, motor), strict=True))
        assert np.diff(energy).max() < 2e-3 * energy[0] and energy[-1] < 0.8 * energy[0]


def test_switched_off_it_is_no_gear():
    u = noise(300)
    on = Model(plain() + fx.Coulomb("hub", 0.02) + elastic())
    off = Model(on.mechanism, gates=(*[1.0] * 7, 0.0))
    recording = rf.Recording(u=u, y=np.zeros((300, 2)), Ts=Ts, accept=("units", "constant"), n_init=1)
    bare = simulate(plain() + fx.Coulomb("hub", 0.02), u, Ts, solver=Exponential(substeps=4))
    np.testing.assert_allclose(off.simulate(recording), bare, rtol=0, atol=1e-9)
    assert np.abs(on.simulate(recording) - bare).max() > 1e-3


def test_slopes_are_those_of_central_differences():
    machine, u = plain() + elastic(damping=1.0), noise(200)
    structure, values = machine.structure, machine.values
    with double_precision():
        rest = [jnp.ones(len(machine.effects)), jnp.zeros(6), jnp.asarray(u), jnp.asarray(Ts)]
        of_values = lambda v: free_run(structure, Exponential(), v, *rest)[1]  # noqa: E731
        run = jax.jit(of_values, compiler_options=ROUGH)
        slope = jax.jit(lambda v, d: jax.jvp(of_values, (v,), (d,))[1], compiler_options=ROUGH)
        for i, name in enumerate(machine.parameter_names):
            way = np.zeros(len(values))
            way[i] = values[i]
            found = np.asarray(slope(jnp.asarray(values), jnp.asarray(way)))
            secant = np.asarray(run(values + 1e-6 * way) - run(values - 1e-6 * way)) / 2e-6
            assert np.abs(secant).max() > 1e-6, name
            np.testing.assert_allclose(found, secant, atol=1e-4 * np.abs(secant).max(), err_msg=name)


def test_c_code_can_be_written():
    text = to_c(Model(plain() + elastic()), Ts)
    assert "backlash with elastic teeth" in text and "NAN" not in text


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: paper() + fx.ElasticBacklash("arm"), "it needs a port with a motor and an inertia"),
        (lambda: plain() + elastic() + fx.Backlash("hub"), "only one is possible"),
        (lambda: elastic(stiffness=0.0), "between 1 and inf"),
        (lambda: simulate(plain() + elastic(), noise(10), Ts, solver=SmoothRK4()), "use Exponential"),
    ],
)
def test_what_cannot_be(wrong, message):
    with pytest.raises(InputError, match=message):
        wrong()


def test_a_search_tries_it_on_request_only():
    assert "elastic_backlash" not in {cls.name for cls, _ in search_places(paper())}
    assert fx.ElasticBacklash.contains == ("backlash",)
