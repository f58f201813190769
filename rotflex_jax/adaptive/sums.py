"""Sums of products that a processor can do side by side."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact


def tree_sum(p: Inexact[Array, "P *lanes"]) -> Inexact[Array, "*lanes"]:
    """Sum over the first axis, by halves.

    A sum one by one has to wait for every addition before the next, which for some twenty weights takes
    longer than all the rest of a filter's step; halves need as many waits as P has binary digits. Its
    rounding error is smaller, too.

    Source: Higham 1993, SIAM J. Sci. Comput. 14, section 3 (pairwise summation).

    >>> float(tree_sum(jnp.arange(7.0)))
    21.0
    """
    while len(p) > 1:
        half = len(p) // 2
        paired = p[:half] + p[half : 2 * half]
        p = jnp.concatenate([paired, p[2 * half :]]) if len(p) % 2 else paired
    return p[0]


def times(a: Array, b: Array) -> Array:
    """Matrix product, full also where a device would round the factors first."""
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)
