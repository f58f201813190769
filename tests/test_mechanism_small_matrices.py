"""Small products and stored arrays inside of compiled loops."""

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.mechanism.small_matrices import computed_once, rows_once
from rotflex_jax.runtime.xla import double_precision


def test_a_stored_array_is_the_same_array() -> None:
    with double_precision():
        a = np.array([0.0, -0.0, 1e-300, -1.7e308, 3.0, np.inf, -np.inf, np.nan])
        for function in (computed_once, jax.jit(computed_once), jax.vmap(computed_once)):
            found = np.asarray(function(jnp.asarray(a)))
            np.testing.assert_array_equal(found, a)
            np.testing.assert_array_equal(np.signbit(found[:-1]), np.signbit(a[:-1]))
        rows = np.stack([a, a[::-1]])
        np.testing.assert_array_equal(rows_once(list(jnp.asarray(rows))), rows)


def test_derivatives_pass_through_a_stored_array() -> None:
    """The derivative of a cube, forward, in reverse, and twice."""

    def cube(x: jax.Array) -> jax.Array:
        return computed_once(x**3)

    with double_precision():
        x = jnp.asarray([0.5, -2.0])
        np.testing.assert_allclose(jax.jvp(cube, (x,), (jnp.ones(2),))[1], [0.75, 12.0], rtol=1e-15)
        np.testing.assert_allclose(jax.vmap(jax.grad(cube))(x), [0.75, 12.0], rtol=1e-15)
        np.testing.assert_allclose(jax.vmap(jax.jacfwd(jax.jacfwd(cube)))(x), [3.0, -12.0], rtol=1e-15)
