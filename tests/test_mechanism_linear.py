"""The steady-state Kalman gain against SciPy's Riccati solver, its process noise against quadrature."""

import dataclasses
import itertools

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

import rotflex_jax.effects as fx
from rotflex_jax.joints import paper, single_inertia
from rotflex_jax.mechanism import kalman_gains, linearise
from rotflex_jax.mechanism.linear import process_covariance

NOISE = np.array([5e-4, 8e-4])
VECTORS = {"hub": [1.0, 0.0], "joint": [0.0, 1.0], "arm": [1.0, 1.0]}
M = np.array([[0.0021 + 0.0059, 0.0059], [0.0059, 0.0059]])


def quadrature(A: np.ndarray, g: np.ndarray, Ts: float) -> np.ndarray:
    """The integral of exp(A s) g g' exp(A' s) over a sample, by Gauss and Legendre.

    Where a pole is fast, on pieces that are shorter near zero.
    """
    nodes, weights = np.polynomial.legendre.leggauss(12)
    fast = np.abs(np.linalg.eigvals(A)).max() * Ts > 5
    edges = np.concatenate([[0.0], Ts * np.geomspace(1e-3, 1.0, 20)]) if fast else [0.0, Ts]
    total = np.zeros_like(A)
    for a, b in itertools.pairwise(edges):
        s = (a + b) / 2 + (b - a) / 2 * nodes
        x = expm(A * s[:, None, None]) @ g
        total += np.einsum("s,si,sj->ij", (b - a) / 2 * weights, x, x)
    return total


def pushed(joint, port: str) -> np.ndarray:
    """Derivative of the state that a unit torque at a port causes."""
    g = np.zeros(len(linearise(joint).A))
    g[2:4] = np.linalg.solve(M, VECTORS[port])
    return g


def expected(joint, Q: np.ndarray, noise: np.ndarray, Ts: float) -> np.ndarray:
    space = linearise(joint)
    R = np.diag(noise**2)
    Ad = expm(space.A * Ts)
    # In units of the noise, so that SciPy solves a well-scaled problem.
    s = noise[0]
    P = s**2 * solve_discrete_are(Ad.T, space.C.T, Q / s**2, R / s**2)
    return P @ space.C.T @ np.linalg.inv(space.C @ P @ space.C.T + R)


@pytest.mark.parametrize("Ts", [0.002, 0.01])
@pytest.mark.parametrize("inductance", [None, 0.18e-3])
def test_process_covariance(Ts, inductance):
    joint = paper(inductance=inductance)
    A = linearise(joint).A
    for port in VECTORS:
        g = pushed(joint, port)
        exact = quadrature(A, g, Ts)
        found = process_covariance(A, np.linalg.solve(M, VECTORS[port]), 2, Ts)
        scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
        np.testing.assert_allclose(found / scale, exact / scale, atol=1e-7)


@pytest.mark.parametrize("Ts", [0.002, 0.01])
@pytest.mark.parametrize("inductance", [None, 0.18e-3])
def test_gains_solve_the_riccati_equation(Ts, inductance):
    joint = paper(inductance=inductance, hub_damping=0.004, joint_damping=0.003)
    grid = [
        {"hub": hub, "joint": deflection} for hub in (1e-9, 1e-6, 1e-3) for deflection in (0.0, 1e-8, 1e-4)
    ]
    gains = kalman_gains(joint, grid, NOISE, Ts)
    assert gains.shape == (len(grid), 4 + (inductance is not None), 2)
    A, C = linearise(joint).A, linearise(joint).C
    Ad = expm(A * Ts)
    unit = {port: quadrature(A, pushed(joint, port), Ts) for port in ("hub", "joint")}
    for K, intensity in zip(gains, grid, strict=True):
        Q = sum(q * unit[port] for port, q in intensity.items())
        right = expected(joint, Q, NOISE, Ts)
        scale = np.abs(right).max(axis=1, keepdims=True)
        np.testing.assert_allclose(K / scale, right / scale, atol=2e-5, err_msg=str(intensity))
        assert np.abs(np.linalg.eigvals(Ad @ (np.eye(len(Ad)) - K @ C))).max() < 1


def test_alone_or_among_others():
    joint = paper()
    grid = [{"hub": 1e-9}, {"hub": 1e-3, "arm": 1e-4}]
    together = kalman_gains(joint, grid, NOISE, 0.005)
    alone = [kalman_gains(joint, [q], NOISE, 0.005)[0] for q in grid]
    np.testing.assert_allclose(together, alone, rtol=1e-7, atol=1e-12)


def test_nothing_disturbed_nothing_corrected():
    zero = kalman_gains(paper(), [{}, {"hub": 0.0, "joint": 0.0}], NOISE, 0.005)
    np.testing.assert_array_equal(zero, np.zeros((2, 4, 2)))


def test_more_disturbance_trusts_the_sensor_more():
    joint = single_inertia(0.002)
    q = np.geomspace(1e-10, 1e3, 8)
    K = kalman_gains(joint, [{"hub": v} for v in q], np.array([1e-4]), 0.01)[:, 0, 0]
    assert (np.diff(K) > 0).all() and K[0] > 0 and 0.99 < K[-1] < 1


SPINNING = (
    dataclasses.replace(single_inertia(0.002, damping=0.001), outputs={"tacho": ("hub", "speed")}),
    # No sensor shows the common angle of hub and arm.
    dataclasses.replace(
        paper(hub_damping=0.004, joint_damping=0.003),
        outputs={"motor": ("hub", "speed"), "tip": ("arm", "speed")},
    ),
)


@pytest.mark.parametrize("machine", SPINNING, ids=["inertia", "joint"])
def test_an_angle_that_no_sensor_shows_has_the_gain_that_the_filter_tends_to(machine):
    """Reference: the covariance recursion step by step; its gain converges while a variance grows."""
    Ts, intensity, noise = 0.01, {"hub": 1e-5}, np.full(len(machine.channels), 0.01)
    space, n = linearise(machine), len(machine.coordinates)
    inertia = M if n == 2 else np.array([[0.002]])
    g = np.concatenate([np.zeros(n), np.linalg.solve(inertia, np.eye(n)[0])])
    Ad, C, Q = expm(space.A * Ts), space.C, 1e-5 * quadrature(space.A, g, Ts)
    P, K, variance = Q, np.zeros((2 * n, n)), []
    for _ in range(20_000):
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + np.diag(noise**2))
        P = Ad @ (P - K @ C @ P) @ Ad.T + Q
        variance.append(P[0, 0])
    assert variance[-1] > 1.5 * variance[10_000] > 2 * variance[5_000]
    found = kalman_gains(machine, [intensity, {}], noise, Ts)
    scale = np.abs(K).max(axis=1, keepdims=True)
    np.testing.assert_allclose(found[0] / scale, K / scale, atol=1e-6)
    np.testing.assert_array_equal(found[1], 0.0)


def test_memories_are_not_corrected():
    joint = paper() + fx.Dahl("hub")
    gains = kalman_gains(joint, [{"hub": 1e-5}], NOISE, 0.005)
    assert gains.shape == (1, 5, 2)
    np.testing.assert_array_equal(gains[:, 4], 0.0)
    np.testing.assert_array_equal(gains[:, :4], kalman_gains(paper(), [{"hub": 1e-5}], NOISE, 0.005))


def test_the_filter_reaches_the_variance_that_the_equation_promises():
    """Simulated with its own noises, the innovations have the covariance C P C' + R."""
    joint, Ts, intensity = paper(hub_damping=0.004), 0.01, {"hub": 3e-6, "joint": 1e-7}
    space = linearise(joint)
    Ad, C = expm(space.A * Ts), space.C
    K = kalman_gains(joint, [intensity], NOISE, Ts)[0]
    Q = sum(q * quadrature(space.A, pushed(joint, p), Ts) for p, q in intensity.items())
    rng, N = np.random.default_rng(0), 4000
    w = rng.multivariate_normal(np.zeros(4), Q, N, tol=1e-6)
    v = rng.normal(size=(N, 2)) * NOISE
    x, hat, e = np.zeros(4), np.zeros(4), np.empty((N, 2))
    for k in range(N):
        e[k] = C @ x + v[k] - C @ hat
        hat = Ad @ (hat + K @ e[k])
        x = Ad @ x + w[k]
    e = e[200:]
    # S = (1 - C K)^-1 R for the optimal gain.
    S = np.linalg.solve(np.eye(2) - C @ K, np.diag(NOISE**2))
    scale = np.sqrt(np.outer(np.diag(S), np.diag(S)))
    np.testing.assert_allclose(e.T @ e / len(e) / scale, S / scale, atol=0.08)
    after = e[1:].T @ e[:-1] / len(e) / scale  # white: no correlation with the sample before
    np.testing.assert_allclose(after, 0.0, atol=0.08)


@pytest.mark.parametrize(("damping", "determined"), [(1e6, True), (1e16, False)])
def test_a_model_too_fast_for_double_precision_has_no_gain(damping, determined):
    """For damping / inertia * Ts = 5e6 the matrix exponential has nine correct digits, for 5e16 none."""
    gains = kalman_gains(single_inertia(0.002, damping=damping), [{"hub": 1e-5}], np.array([1e-4]), 0.01)
    assert np.isfinite(gains).all() == determined
    assert np.isnan(gains).any() == (not determined)
