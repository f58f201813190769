"""Arithmetic on repeated arrays: the same results, each computed once."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.mechanism.repetition import without_repetition
from rotflex_jax.runtime.xla import double_precision

D = 5


def mixed(repeated: Any, other: jax.Array) -> Any:
    """Operations of a step on repeated arrays (3, D), (3, 2, D) and (D,) and on another array (3, D)."""
    x, A, s = repeated
    rows = jnp.unstack(x)
    y = jnp.stack([rows[1], s * rows[0], jnp.where(rows[2] > 0.2, jnp.sin(rows[2]), s)])
    z = jnp.sum(A, axis=1) + jnp.concatenate([y[1:], jnp.zeros((1, D))])
    first, second = jnp.split(A, 2, axis=1)
    half = jax.lax.fori_loop(0, 3, lambda _, a: 0.5 * a + s[None], z[:2])
    along = jnp.sum(first * other[:, None], axis=1) + second[:, 0] * x.reshape(3, 1, D)[:, 0]
    return {"same": jnp.expm1(z) / (1.0 + x**2), "half": half}, along, jax.nn.relu(z) * other, x[:, 1:3]


def test_the_numbers_are_those_of_repeated_arrays() -> None:
    rng = np.random.default_rng(0)
    with double_precision():
        once = tuple(jnp.asarray(rng.normal(size=(*n, 1))) for n in ((3,), (3, 2), ()))
        other = jnp.asarray(rng.normal(size=(3, D)))
        repeated = jax.tree.map(lambda a: jnp.broadcast_to(a, (*a.shape[:-1], D)), once)
        found = jax.jit(lambda r, o: without_repetition(mixed, D, r, o))(once, other)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(mixed(repeated, other)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-15)
        assert jax.tree.structure(found) == jax.tree.structure(mixed(repeated, other))


def test_what_is_repeated_is_computed_once() -> None:
    def f(x: jax.Array, other: jax.Array) -> Any:
        return jnp.exp(jnp.stack([jnp.sin(x[0]), jnp.cos(x[1])])) + jnp.tanh(other)

    given = jnp.ones((2, 1)), jnp.ones((2, D))
    traced = jax.make_jaxpr(lambda x, o: without_repetition(f, D, x, o))(*given)
    shapes = {e.primitive.name: e.outvars[0].aval.shape for e in traced.jaxpr.eqns}
    assert [shapes[name][-1] for name in ("sin", "cos", "exp", "tanh", "add")] == [1, 1, 1, D, D]


def test_a_choice_is_made_once_and_only_one_way_is_computed() -> None:
    def f(x: jax.Array, other: jax.Array) -> jax.Array:
        everywhere = jnp.all(x > 0) & (jnp.max(x) < 2)
        return jax.lax.cond(everywhere, lambda: jnp.sin(x) * other, lambda: jnp.exp(x) + other)

    rng = np.random.default_rng(1)
    with double_precision():
        other = jnp.asarray(rng.normal(size=(2, D)))
        for first in (0.5, -0.5, 2.5):
            once = jnp.asarray([[first], [1.0]])
            found = without_repetition(f, D, once, other)
            expected = f(jnp.broadcast_to(once, (2, D)), other)
            np.testing.assert_allclose(found, expected, rtol=1e-15)
        traced = jax.make_jaxpr(lambda x, o: without_repetition(f, D, x, o))(once, other)
    (choice,) = (e for e in traced.jaxpr.eqns if e.primitive.name == "cond")
    shapes = {
        e.primitive.name: e.outvars[0].aval.shape for b in choice.params["branches"] for e in b.jaxpr.eqns
    }
    assert shapes["sin"] == shapes["exp"] == (2, 1)


def test_what_every_way_repeats_is_repeated_after_the_choice() -> None:
    def f(x: jax.Array, other: jax.Array) -> tuple[jax.Array, jax.Array]:
        both = lambda g: lambda: (g(x), g(x) * other)  # noqa: E731
        one, mixed = jax.lax.cond(jnp.all(x > 0), both(jnp.sin), both(jnp.cos))
        return jnp.exp(one), jnp.tanh(mixed)

    given = jnp.ones((2, 1)), jnp.ones((2, D))
    traced = jax.make_jaxpr(lambda x, o: without_repetition(f, D, x, o))(*given)
    shapes = {e.primitive.name: e.outvars[0].aval.shape for e in traced.jaxpr.eqns}
    assert shapes["exp"] == (2, 1) and shapes["tanh"] == (2, D)
