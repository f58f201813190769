"""The flexible link against beam elements, its fit, and the candidates of a search."""

import numpy as np
import pytest
import scipy.linalg

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.joints import by_name, flexible_link
from rotflex_jax.mechanism import simulate
from rotflex_jax.mechanism.linear import linearise
from rotflex_jax.mechanism.roles import search_places

MASS, LENGTH, FREQUENCY, HUB = 0.065, 0.419, 3.0, 0.0021
Ts = 0.002


def beam(elements: int = 30) -> tuple[np.ndarray, np.ndarray, float]:
    """Mass and stiffness matrices of hub angle and bending by cubic elements, and bending stiffness EI.

    Unknowns: angle of the hub, then deflection and slope at each node but the clamp, relative to the hub.
    """
    h, rho = LENGTH / elements, MASS / LENGTH
    EI = (2 * np.pi * FREQUENCY) ** 2 * rho * (LENGTH / 1.8751040687) ** 4
    m = (
        rho
        * h
        / 420
        * np.array(
            [
                [156, 22 * h, 54, -13 * h],
                [22 * h, 4 * h * h, 13 * h, -3 * h * h],
                [54, 13 * h, 156, -22 * h],
                [-13 * h, -3 * h * h, -22 * h, 4 * h * h],
            ]
        )
    )
    k = (
        EI
        / h**3
        * np.array(
            [
                [12, 6 * h, -12, 6 * h],
                [6 * h, 4 * h * h, -6 * h, 2 * h * h],
                [-12, -6 * h, 12, -6 * h],
                [6 * h, 2 * h * h, -6 * h, 4 * h * h],
            ]
        )
    )
    size = 2 * (elements + 1)
    M, K = np.zeros((size, size)), np.zeros((size, size))
    for e in range(elements):
        part = slice(2 * e, 2 * e + 4)
        M[part, part] += m
        K[part, part] += k
    # A unit rotation of the hub moves each point by x with slope one; the elements represent it exactly.
    turn = np.column_stack([np.arange(elements + 1) * h, np.ones(elements + 1)]).ravel()
    T = np.column_stack([turn, np.eye(size)[:, 2:]])
    whole = T.T @ M @ T
    whole[0, 0] += HUB
    bending = np.zeros_like(whole)
    bending[1:, 1:] = K[2:, 2:]
    return whole, bending, EI


def test_modes_are_those_of_a_beam():
    """Frequencies with a free hub, and the gauge's reading in each mode for a unit rotation of the hub."""
    M, K, EI = beam()
    values, shapes = scipy.linalg.eigh(K, M)
    # Curvature at the clamp from deflection and slope at the free end of the first element.
    h = LENGTH / 30
    curvature = (6 / h**2 * shapes[1] - 2 / h * shapes[2]) / shapes[0]
    machine = flexible_link(hub=HUB, damping_ratio=0.0, hub_damping=0.0, gauge_gain=1.0)
    machine = machine.with_values({"hub.motor.back_emf": 0.0})
    found, own = np.linalg.eig(linearise(machine).A)
    # The model leaves out the curvature of the third mode and those above.
    for mode, tolerance, bent in ((1, 2e-4, 0.01), (2, 3e-3, 0.1)):
        expected = np.sqrt(values[mode])
        i = np.argmin(np.abs(found.imag - expected))
        assert found[i].imag == pytest.approx(expected, rel=tolerance)
        x = own[:3, i] / own[0, i]
        assert (x[1] + x[2]).real == pytest.approx(curvature[mode] * LENGTH / 4, rel=bent)
    # A load at the tip acts on each mode by 4 / (beta L)^2, and each mode moves the tip by this factor.
    springs = [machine.effect("spring", at).values["stiffness"] for at in ("joint", "second")]
    soft = sum((4 / b**2) ** 2 / k for b, k in zip((1.8751, 4.6941), springs, strict=True))
    assert soft == pytest.approx(LENGTH / (3 * EI), rel=0.006)


def test_a_load_at_the_tip_reads_as_the_tips_angle():
    """A static load at the tip calibrates the gauge: F L = EI curvature, deflection F L^3 / 3 EI."""
    EI = beam()[2]
    force = 0.1
    curvature, tip = force * LENGTH / EI, force * LENGTH**3 / (3 * EI)
    modes = curvature * LENGTH / 4
    gain = flexible_link().effect("sensor_gain", "alpha").values["error"] + 1
    assert gain * modes == pytest.approx(tip / LENGTH, rel=1e-9)


def test_inertias_add_up_and_the_command_line_knows_it():
    machine = flexible_link(mass=0.1, length=0.3, hub=0.002)
    parts = [e.values["inertia"] for e in machine.effects if e.name == "inertia"]
    assert sum(parts) == pytest.approx(0.002 + 0.1 * 0.3**2 / 3, rel=1e-12)
    told = by_name.joint("flexible_link:mass=0.1,length=0.3,hub=0.002")
    np.testing.assert_array_equal(told.values, machine.values)
    assert told.trusted == machine.trusted


def test_a_fit_finds_the_gain_of_the_gauge():
    true = flexible_link(frequency=3.3, hub_damping=0.006, gauge_gain=1.1, damping_ratio=0.02)
    true = true.with_values({"hub.motor.torque_constant": 0.0085})
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-4, 4, 200), 20)
    y = simulate(true, u, Ts) + [5e-4, 5e-4] * rng.normal(size=(len(u), 2))
    fit = rf.fit(flexible_link(), rf.Recording(u=u, y=y, Ts=Ts, accept=("units",)))
    found = fit.model.mechanism.named_values
    sure = true.named_values
    for name in ("alpha.sensor_gain.error", "joint.spring.stiffness", "second.spring.stiffness"):
        assert found[name] == pytest.approx(sure[name], rel=0.02), name
    assert found["hub.motor.torque_constant"] == pytest.approx(0.0085, rel=0.02)


def test_a_search_tries_the_ports_of_a_joint():
    places = search_places(flexible_link())
    assert {place for cls, place in places if cls.acts_on == "port"} == {"hub", "joint", "arm"}
    assert (fx.CubicSpring, "joint") in places and (fx.EccentricEncoder, "theta") in places
