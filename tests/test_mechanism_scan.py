"""The derivative rule of the scan, and a linear mechanism in blocks of samples, against a plain scan."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rotflex_jax.effects as fx
from rotflex_jax.joints import paper
from rotflex_jax.mechanism import Exponential, simulate, simulate_states
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.mechanism.linear import linearise
from rotflex_jax.mechanism.scan import BLOCK_SAMPLES, BLOCKED_FROM_SAMPLES, CHUNK_SAMPLES, states
from rotflex_jax.mechanism.simulate import FreeStep, PredictorStep
from rotflex_jax.runtime.xla import double_precision

# Shorter than a chunk, one chunk, a little more than one, and no multiple of it.
LENGTHS = (1, 37, CHUNK_SAMPLES, CHUNK_SAMPLES + 1, 2 * CHUNK_SAMPLES + 211)


@dataclasses.dataclass(frozen=True)
class Pendulum:
    """A driven pendulum whose inputs are a pytree; every term is nonlinear in something."""

    h: float = 0.05

    def __call__(self, x, inputs, constants):
        drive, wind = inputs
        stiffness, damping = constants
        torque = drive * jnp.cos(x[0]) - stiffness * jnp.sin(x[0]) - damping * x[1] * jnp.abs(x[1])
        torque = torque + jnp.sum(wind**2, axis=0)
        return jnp.stack([x[0] + self.h * x[1], x[1] + self.h * torque])


def plain(step, x0, inputs, constants):
    """The same states by an ordinary scan, with JAX's own derivative."""
    return jax.lax.scan(lambda x, w: (step(x, w, constants), x), x0, inputs)[1]


def pendulum(N: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    inputs = (jnp.asarray(rng.normal(size=N)), jnp.asarray(0.3 * rng.normal(size=(N, 3))))
    return jnp.asarray([0.4, -0.2]), inputs, (jnp.asarray(1.3), jnp.asarray(0.2))


def joint(N: int):
    """A joint with friction, a cubic spring, a memory and a motor current, and its predictor."""
    mechanism = paper(inductance=0.18e-3) + fx.Coulomb("hub", level=0.03)
    mechanism = mechanism + fx.CubicSpring("joint", 20.0) + fx.Dahl("arm")
    rng = np.random.default_rng(4)
    u = np.repeat(rng.normal(size=N // 5 + 1), 5)[:N]
    structure, solver = mechanism.structure, Exponential()
    values = jnp.asarray(mechanism.values)
    c = solver.prepare(structure, values, jnp.ones(len(mechanism.effects)), jnp.asarray(0.004))
    K = jnp.asarray(0.1 * rng.normal(size=(6, 2)))
    y, seen = jnp.asarray(0.01 * rng.normal(size=(N, 2))), jnp.asarray(1.0 * (rng.random(N) < 0.8))
    free = (FreeStep(structure, solver), jnp.zeros(6), jnp.asarray(u), c)
    predictor = (PredictorStep(structure, solver), jnp.zeros(6), (jnp.asarray(u), y, seen), (c, K))
    return free, predictor


def close(found, expected, rtol=1e-9) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * np.abs(b).max())


def tangent(tree, seed: int):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), tree)


@pytest.mark.parametrize("N", LENGTHS)
def test_forward_derivative(N):
    with double_precision():
        point = pendulum(N)
        step = Pendulum()
        way = tangent(point, 1)
        found = jax.jit(lambda p, d: jax.jvp(functools.partial(states, step), p, d))(point, way)
        expected = jax.jit(lambda p, d: jax.jvp(functools.partial(plain, step), p, d))(point, way)
    close(found, expected)
    assert found[1].shape == (N, 2)


@pytest.mark.parametrize("N", [37, CHUNK_SAMPLES + 1])
def test_each_argument_on_its_own(N):
    with double_precision():
        point = pendulum(N)
        step = Pendulum()
        for k in (0, 2):
            mine = jax.jit(jax.jacfwd(functools.partial(states, step), argnums=k))
            ordinary = jax.jit(jax.jacfwd(functools.partial(plain, step), argnums=k))
            close(mine(*point), ordinary(*point))


@pytest.mark.parametrize("N", [1, CHUNK_SAMPLES + 1])
def test_reverse_is_the_transpose_of_forward(N):
    with double_precision():
        point = pendulum(N)
        step = Pendulum()

        def answer(run, point, weight):
            return jax.vjp(functools.partial(run, step), *point)[1](weight)

        weight = jnp.asarray(np.random.default_rng(2).normal(size=(N, 2)))
        back = jax.jit(functools.partial(answer, states))(point, weight)
        close(back, jax.jit(functools.partial(answer, plain))(point, weight))
        way = tangent(point, 3)
        forward = jax.jit(lambda p, d: jax.jvp(functools.partial(states, step), p, d)[1])(point, way)
    pairs = zip(jax.tree.leaves(back), jax.tree.leaves(way), strict=True)
    total = sum(np.vdot(a, b) for a, b in pairs)
    np.testing.assert_allclose(total, np.vdot(weight, forward), rtol=1e-9)


def test_many_at_once():
    """vmap over points and over tangents gives what one at a time gives."""
    with double_precision():
        points = [pendulum(CHUNK_SAMPLES + 5, seed) for seed in range(3)]
        ways = [tangent(points[0], seed) for seed in range(3)]
        step = Pendulum()
        slope = lambda p, d: jax.jvp(functools.partial(states, step), p, d)  # noqa: E731
        pile = lambda trees: jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)  # noqa: E731
        one = [jax.jit(slope)(p, d) for p, d in zip(points, ways, strict=True)]
        close(jax.jit(jax.vmap(slope))(pile(points), pile(ways)), pile(one))
        shared = [jax.jit(slope)(points[0], d)[1] for d in ways]
        over = jax.jit(jax.vmap(lambda d: slope(points[0], d)[1]))(pile(ways))
    close(over, pile(shared))


@pytest.mark.parametrize("which", [0, 1], ids=["free run", "predictor"])
def test_the_step_of_a_joint(which):
    """The step applied to many samples at once equals an ordinary scan: friction, memory, current."""
    with double_precision():
        step, *point = joint(CHUNK_SAMPLES + 90)[which]
        way = tangent(tuple(point), 7)
        found = jax.jit(lambda p, d: jax.jvp(functools.partial(states, step), p, d))(tuple(point), way)
        expected = jax.jit(lambda p, d: jax.jvp(functools.partial(plain, step), p, d))(tuple(point), way)
    assert np.abs(expected[1]).max() > 0
    close(found, expected, rtol=1e-8)


Ts = 0.002
JOINT = paper(hub_damping=0.01, joint_damping=0.002, inductance=2e-4)


@pytest.mark.parametrize("N", [BLOCKED_FROM_SAMPLES, BLOCKED_FROM_SAMPLES + BLOCK_SAMPLES // 2 + 1])
def test_a_long_run_is_the_recursion_of_the_matrix_exponential(N: int) -> None:
    u, x = np.random.default_rng(0).normal(size=N), np.array([0.1, -0.02, 0.5, 0.3, 0.05])
    E, B = linearise(JOINT).discretise(Ts)
    X = np.empty((N, 5))
    for k in range(N):
        X[k], x = x, E @ x + B * u[k]
    np.testing.assert_allclose(simulate_states(JOINT, u, Ts, X[0]), X, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(simulate(JOINT, u, Ts, X[0]), X[:, :2], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("solver", [Exponential(), Exponential(substeps=2, between="smooth")])
def test_slopes_through_blocks_are_those_of_the_scan(solver: Exponential) -> None:
    structure, u = JOINT.structure, np.random.default_rng(1).normal(size=BLOCKED_FROM_SAMPLES + 3)
    step = FreeStep(structure, solver)
    assert step.linear and not FreeStep((JOINT + fx.Coulomb("hub", 0.01)).structure, solver).linear
    with double_precision():
        v, gates = solver.inputs(jnp.asarray(u)), jnp.ones(len(JOINT.effects))
        x0 = jnp.asarray(rest_state(structure, np.float64)) + 0.1

        def run(values: jax.Array, blocks: bool) -> jax.Array:
            c = solver.prepare(structure, values, gates, jnp.asarray(Ts))
            if blocks:
                return states(step, x0, v, c)
            return jax.lax.scan(lambda x, w: (step(x, w, c), x), x0, v)[1]

        values = jnp.asarray(JOINT.values)
        slopes = jax.jit(lambda p, b: jax.jvp(lambda q: run(q, b), (p,), (p,)), static_argnums=1)
        both = [slopes(values, b) for b in (True, False)]
    for got, plain in zip(*both, strict=True):
        np.testing.assert_allclose(got, plain, rtol=1e-9, atol=1e-11 * np.abs(plain).max())
