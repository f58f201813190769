"""Shortcuts through a step give the result of the general computation, and only one of both is computed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiler_options import ROUGH

from rotflex_jax import effects as fx
from rotflex_jax.joints import paper
from rotflex_jax.mechanism import Exponential, Mechanism
from rotflex_jax.mechanism.initial_state import rest_state
from rotflex_jax.mechanism.shortcut import shortcut, without_shortcuts
from rotflex_jax.mechanism.simulate import FreeStep, prepared_run
from rotflex_jax.runtime.xla import double_precision

Ts, N = 0.002, 1500
JOINT = paper(stiffness=1.5)
CASES = {
    "one contact": JOINT + fx.Coulomb("hub", level=0.02),
    "two contacts": JOINT + fx.Coulomb("hub", level=0.02) + fx.Stribeck("joint", level=0.01),
    "three contacts": JOINT + fx.Coulomb("hub") + fx.Coulomb("joint", level=0.01) + fx.Coulomb("arm"),
    "play": JOINT + fx.Backlash("hub", gap=0.02),
    "play and friction": JOINT + fx.Backlash("hub", gap=0.02) + fx.Stribeck("joint", level=0.01),
}


def motion(joint: Mechanism, u: np.ndarray, shortcuts: bool) -> np.ndarray:
    """States (B, N, n) for several voltages, by `jax.vmap`."""
    structure, solver = joint.structure, Exponential()
    step = FreeStep(structure, solver)

    def one(u: jax.Array) -> jax.Array:
        values, gates = jnp.asarray(joint.values), jnp.ones(len(joint.effects))
        _, v, c = prepared_run(structure, solver, values, gates, u, jnp.asarray(Ts))
        x0 = jnp.asarray(rest_state(structure, np.float64))

        def advance(x: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
            if shortcuts:
                return step(x, v, c), x
            with without_shortcuts():
                return step(x, v, c), x

        return jax.lax.scan(advance, x0, v)[1]

    with double_precision():
        traced = jax.jit(jax.vmap(one), compiler_options=ROUGH).trace(jnp.asarray(u))
        assert (" cond[" in str(traced.jaxpr)) == shortcuts  # a branch; a selection would compute both
        return np.asarray(traced.lower().compile()(jnp.asarray(u)))


@pytest.mark.parametrize("case", CASES)
def test_the_motion_is_that_of_the_general_way(case: str) -> None:
    rng = np.random.default_rng(0)
    u = np.array([[0.5], [1.5], [4.0]]) * np.repeat(rng.normal(size=(3, N // 30)), 30, axis=1)
    u[:, N // 2 : N // 2 + 300] = 0.0  # the machine comes to rest
    X = motion(CASES[case], u, shortcuts=True)
    expected = motion(CASES[case], u, shortcuts=False)
    scale = np.abs(expected).max(axis=(0, 1))
    np.testing.assert_allclose(X / scale, expected / scale, rtol=0, atol=1e-9)
    assert scale[0] > 0.1


def test_one_that_needs_the_general_way_takes_all_along() -> None:
    """The general computation is used for a whole batch if one of its members needs it."""

    def f(x: jax.Array) -> jax.Array:
        return shortcut(lambda: (x > 0, lambda: x[None]), lambda: 10 * x[None])

    assert jax.vmap(f)(jnp.array([1.0, 2.0])).ravel().tolist() == [1.0, 2.0]
    assert jax.vmap(f)(jnp.array([1.0, -2.0])).ravel().tolist() == [10.0, -20.0]
    with without_shortcuts():
        assert jax.vmap(f)(jnp.array([1.0, 2.0])).ravel().tolist() == [10.0, 20.0]


def test_derivatives_are_those_of_the_way_taken() -> None:
    """In forward and in reverse mode; the reference is the closed form."""

    def f(x: jax.Array) -> jax.Array:
        return shortcut(lambda: (x > 0, lambda: jnp.sin(x)[None]), lambda: jnp.cos(x)[None])[0]

    for x in (0.3, -0.3):
        exact = np.cos(x) if x > 0 else -np.sin(x)
        np.testing.assert_allclose(jax.grad(f)(x), exact, rtol=1e-6)
        np.testing.assert_allclose(jax.jvp(f, (x,), (1.0,))[1], exact, rtol=1e-6)
