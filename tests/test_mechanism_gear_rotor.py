"""Effects on the motor's side of a gear with play: closed forms, scipy, the gear without play."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.errors import InputError
from rotflex_jax.export import to_c
from rotflex_jax.joints import paper, single_inertia
from rotflex_jax.mechanism import Exponential, Mechanism, simulate, simulate_states
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.models.model import Model

Ts, GAP, SHARE, J, EMF, RESISTANCE = 0.002, 0.0055, 0.7, 0.0021, 0.00767 * 70, 2.6
RIGID = fx.Backlash("hub", gap=GAP, share=SHARE)
ELASTIC = fx.ElasticBacklash("hub", gap=GAP, share=SHARE, stiffness=1500.0, damping=1.0)
LEVEL = 0.05


def plain() -> Mechanism:
    return paper(hub_damping=0.004, joint_damping=0.003)


def noise(N: int, hold: int = 10, seed: int = 2) -> np.ndarray:
    return 1.5 * np.repeat(np.random.default_rng(seed).normal(size=-(-N // hold)), hold)[:N]


@pytest.mark.parametrize("gear", [RIGID, ELASTIC])
def test_a_rotor_in_flight_is_braked_alone(gear):
    """It crosses the play under motor torque and friction, neither of which moves the hub."""
    machine = single_inertia(J, motor=fx.Motor(back_emf=0.0)) + gear + fx.Coulomb("rotor", LEVEL)
    volts = 1.0
    states = simulate_states(machine, np.full(12, volts), Ts)
    a, t = (EMF / RESISTANCE * volts - LEVEL) / (SHARE * J), Ts * np.arange(12)
    flying = a * t**2 / 2 < GAP
    assert 3 < flying.sum() < 10
    np.testing.assert_allclose(states[flying, 2], (a * t**2 / 2)[flying], atol=1e-12)
    np.testing.assert_allclose(states[flying, :2], 0.0, atol=1e-15)
    # With a motor torque below the friction level the rotor rests, although the hub is free.
    held = simulate_states(machine, np.full(50, 0.9 * LEVEL / (EMF / RESISTANCE)), Ts)
    np.testing.assert_allclose(held, 0.0, atol=1e-15)


@pytest.mark.parametrize("gear", [RIGID, ELASTIC])
def test_a_loss_on_the_rotor_slows_it_by_itself(gear):
    machine = single_inertia(J, motor=fx.Motor(back_emf=0.0)) + gear + fx.Viscous("rotor", 0.02)
    start = np.array([0.0, 0.0, -GAP, 2.0])
    states = simulate_states(machine, np.zeros(3), Ts, start)
    t, rate = Ts * np.arange(3), 0.02 / (SHARE * J)
    np.testing.assert_allclose(states[:, 3], 2.0 * np.exp(-rate * t), rtol=1e-9)
    np.testing.assert_allclose(states[:, 2], -GAP + 2.0 / rate * (1 - np.exp(-rate * t)), atol=1e-12)


def test_without_play_it_is_the_hubs():
    u = noise(600)
    apart = (
        plain() + fx.Backlash("hub", gap=0.0) + fx.Coulomb("rotor", 0.03) + fx.QuadraticDrag("rotor", 0.01)
    )
    one = plain() + fx.Coulomb("hub", 0.03) + fx.QuadraticDrag("hub", 0.01)
    np.testing.assert_allclose(simulate(apart, u, Ts), simulate(one, u, Ts), rtol=0, atol=1e-12)
    both = plain() + fx.Backlash("hub", gap=0.0) + fx.Coulomb("hub", 0.01) + fx.Coulomb("rotor", 0.02)
    sum_of_both = simulate(plain() + fx.Coulomb("hub", 0.03), u, Ts)
    # Two contacts that stop in one step are coupled to first order only.
    np.testing.assert_allclose(simulate(both, u, Ts), sum_of_both, rtol=0, atol=2e-4)


def by_scipy(u: np.ndarray, hold: int, hub: float, rotor: float) -> np.ndarray:
    """Hub and deflection with elastic teeth, friction on both sides over a small width of speed."""
    J_r, J_h, J_a, K = SHARE * J, (1 - SHARE) * J, 0.0059, 1.61

    def f(_, x, v):
        r, s = x[2] - x[0], x[5] - x[3]
        side, depth = np.sign(r), abs(r) - GAP
        teeth = max(0.0, 1500.0 * depth + side * s) * side if depth > 0 else 0.0
        load = K * x[1] + 0.003 * x[4]
        on_hub = (teeth + load - 0.004 * x[3] - hub * np.tanh(x[3] / 1e-3)) / J_h
        motor = EMF * (v - EMF * x[5]) / RESISTANCE - rotor * np.tanh(x[5] / 1e-3)
        return [x[3], x[4], x[5], on_hub, -load / J_a - on_hub, (motor - teeth) / J_r]

    x, out = np.zeros(6), []
    for v in u[::hold]:
        out.append(x)
        x = solve_ivp(f, (0, hold * Ts), x, "LSODA", args=(v,), rtol=1e-8, atol=1e-10, max_step=2e-4).y[:, -1]
    return np.array(out)[:, :2]


def test_against_scipy_it_is_not_the_hubs_friction():
    u, hold = noise(300), 10
    found = {}
    for hub, rotor in ((LEVEL, 0.0), (0.0, LEVEL), (0.02, 0.03)):
        expected = found[hub, rotor] = by_scipy(u, hold, hub, rotor)
        machine = plain() + ELASTIC + fx.Coulomb("hub", hub) + fx.Coulomb("rotor", rotor)
        for n, close in ((1, 4e-3), (8, 4e-4)):
            y = simulate(machine, u, Ts, solver=Exponential(substeps=n))[::hold]
            np.testing.assert_allclose(y, expected, atol=close)
    assert np.abs(found[LEVEL, 0.0] - found[0.0, LEVEL]).max() > 5e-3


def test_only_a_machine_with_play_has_a_rotor():
    with pytest.raises(InputError, match="at 'rotor', but this mechanism has 'hub', 'joint', 'arm' for"):
        _ = plain() + fx.Coulomb("rotor")
    machine = plain() + RIGID + fx.Coulomb("rotor", LEVEL)
    with pytest.raises(InputError, match="put at 'rotor'"):
        machine.without("backlash", "hub")
    with pytest.raises(InputError, match="needs one of the ports"):
        Mechanism(machine.coordinates, machine.ports, machine.effects, {"motor": "rotor"})
    assert "rotor" not in {place for _, place in search_places(plain() + RIGID)}
    assert machine.accepts(fx.Stribeck, "rotor")


def test_a_file_and_c_code_keep_it(tmp_path):
    model = Model(plain() + ELASTIC + fx.Coulomb("rotor", LEVEL))
    u = noise(50)
    model.save(tmp_path / "model.json")
    again = rf.Model.load(tmp_path / "model.json").mechanism
    np.testing.assert_array_equal(simulate(again, u, Ts), simulate(model.mechanism, u, Ts))
    assert "at rotor" in to_c(model, Ts)
