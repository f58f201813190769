"""The matrix exponential, and its integrals that an exponential rule needs."""

import jax
import jax.numpy as jnp


def exponential_less_one(M: jax.Array) -> jax.Array:
    """`exp(M) - 1` by scaling, a Taylor polynomial of degree 8, and squaring `X -> 2 X + X X`.

    Squaring the difference from one keeps the digits of a small step that squaring `exp` would round
    away. A fixed number of halvings (2^-14, good to a norm of a few thousand) has no branch, so it
    compiles fast and differentiates plainly.
    """
    halvings, degree = 14, 8
    small = M / 2.0**halvings
    X = small / degree
    for k in range(degree - 1, 0, -1):
        X = (small + small @ X) / k
    return jax.lax.fori_loop(0, halvings, lambda _, X: 2 * X + X @ X, X)


def integrals(A: jax.Array, V: jax.Array, h: jax.Array, orders: int) -> list[jax.Array]:
    """`exp(A h)` and `h phi_k(A h) V`, k = 1..orders, from one augmented matrix exponential."""
    size, m = V.shape
    total = size + orders * m
    big = jnp.zeros((total, total), A.dtype).at[:size, :size].set(A * h)
    big = big.at[:size, size : size + m].set(V * h)
    for k in range(orders - 1):
        rows = slice(size + k * m, size + (k + 1) * m)
        columns = slice(size + (k + 1) * m, size + (k + 2) * m)
        big = big.at[rows, columns].set(jnp.eye(m, dtype=A.dtype))
    expo = exponential_less_one(big)
    return [expo[:size, :size] + jnp.eye(size, dtype=A.dtype)] + [
        expo[:size, size + k * m : size + (k + 1) * m] for k in range(orders)
    ]
