"""Small matrices times states, written out so that the compiler makes straight code of them inside a loop.

States may stand side by side: (m, ...). Then the matrices may too, one for each, which is how a run carries
its slopes along many directions (`tangents`): the directions come last, where vector units run.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.effects.kinds import Effect


def apply(A: jax.Array, x: jax.Array) -> jax.Array:
    """`A @ x` for `x` of shape (m, ...): column by column, which the compiler fuses into the loop.

    `A` is (n, m), or (n, m, ...) where each of the states side by side has a matrix of its own.
    """
    if A.ndim == 2 and x.ndim > 1:  # many states at once: written out, the compiler would compute terms anew
        return jnp.sum(beside(A, x[None]) * x[None], axis=1)
    A = beside(A, x[None])
    total = jnp.zeros((A.shape[0], *x.shape[1:]), x.dtype)
    for j in range(A.shape[1]):
        term = A[:, j] * x[j][None]
        total = total + term if j else term
    return total


def beside(m: jax.Array, x: jax.Array) -> jax.Array:
    """`m` with axes of length one for those of `x` that it lacks."""
    return m.reshape(m.shape + (1,) * (x.ndim - m.ndim))


def along(a: jax.Array, v: jax.Array) -> jax.Array:
    """The vector `a`, (n,) or (n, ...), times the scalar field `v` (...): shape (n, ...)."""
    return beside(a, v[None]) * v[None]


def combined(rows: tuple[tuple[float, ...], ...], x: jax.Array) -> jax.Array:
    """`rows @ x` for coefficients that are plain numbers: most are zero or one, and cost nothing."""
    none = jnp.zeros(x.shape[1:], x.dtype)
    found = []
    for row in rows:
        terms = [x[j] if c == 1 else c * x[j] for j, c in enumerate(row) if c]
        found.append(sum(terms[1:], terms[0]) if terms else none)
    return jnp.stack(found) if found else jnp.zeros((0, *x.shape[1:]), x.dtype)


def in_each(e: Effect, law: Callable[..., Any], *motion: jax.Array) -> jax.Array:
    """A law of an effect; of each state by itself where each has numbers of its own."""
    numbers = e.values
    if all(np.ndim(number) == 0 for number in numbers.values() if number is not None):
        return law(e, *motion)
    return jax.vmap(lambda numbers, *motion: law(e.replace(**numbers), *motion))(numbers, *motion)
