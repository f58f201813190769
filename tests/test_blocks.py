"""A linear mechanism in blocks of samples beside one sample after the other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rotflex_jax.effects as fx
from rotflex_jax.joints import paper
from rotflex_jax.mechanism import Exponential, simulate, simulate_states
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.mechanism.linear import linearise
from rotflex_jax.mechanism.scan import BLOCK_SAMPLES, BLOCKED_FROM_SAMPLES, states
from rotflex_jax.mechanism.simulate import FreeStep
from rotflex_jax.runtime.xla import double_precision

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
