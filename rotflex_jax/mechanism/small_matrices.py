"""Products of small matrices with states, written out so that the compiler fuses them into the loop.

Several states may be given side by side: (m, ...). Each may then have a matrix of its own. A run uses this to
carry its sensitivities along many directions (`sensitivities`); the directions come last, for the vector
units.
"""

import functools
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Shaped

from rotflex_jax.effects.base import Effect


def matvec(A: Shaped[Array, "n m *D"], x: Shaped[Array, "m *S"]) -> Shaped[Array, "n *S"]:
    """`A @ x`; beyond its first two axes A has no further axes, or the further axes of x."""
    if A.ndim == 2 or not A.shape[1]:
        return jnp.sum(expand_axes(A, x[None]) * x[None], axis=1)
    # Each direction with a matrix of its own: column by column, which runs three times faster.
    columns = zip(jnp.unstack(A, axis=1), jnp.unstack(x), strict=True)
    return functools.reduce(operator.add, (column * entry[None] for column, entry in columns))


def expand_axes(m: Shaped[Array, "*a"], x: Shaped[Array, "*b"]) -> Shaped[Array, "*c"]:
    """`m` with trailing axes of length one, as many axes as `x` has."""
    return m.reshape(m.shape + (1,) * (x.ndim - m.ndim))


def scaled_vector(a: Shaped[Array, "n *D"], v: Shaped[Array, "*S"]) -> Shaped[Array, "n *S"]:
    """The vector `a` times the scalar `v`."""
    return expand_axes(a, v[None]) * v[None]


def sparse_matvec(rows: tuple[tuple[float, ...], ...], x: Shaped[Array, "m *S"]) -> Shaped[Array, "k *S"]:
    """`rows @ x` for constant coefficients; coefficients that are zero or one cost nothing."""
    zero, found, each = jnp.zeros(x.shape[1:], x.dtype), [], jnp.unstack(x)
    for row in rows:
        terms = [each[j] if c == 1 else c * each[j] for j, c in enumerate(row) if c]
        found.append(sum(terms[1:], terms[0]) if terms else zero)
    return jnp.stack(found) if found else jnp.zeros((0, *x.shape[1:]), x.dtype)


def with_rows(x: Shaped[Array, "n *S"], rows: Mapping[int, Shaped[Array, "*S"]]) -> Shaped[Array, "n *S"]:
    """The same states with some rows replaced.

    The rows are selected entry by entry: setting or stacking rows would put branches into the compiled loop
    over the entries, which vector units cannot execute.
    """
    place = expand_axes(jnp.arange(len(x)), x)
    for k, row in rows.items():
        x = jnp.where(place == k, row[None], x)
    return x


def computed_once(a: Shaped[Array, "*S"]) -> Shaped[Array, "*S"]:
    """The same array, stored by the compiler, which would otherwise compute a cheap array again for each use.

    A torque acts on every state, so that the torque and its tangents would be computed for each of them.
    """
    return _computed_once.bind(jnp.asarray(a))


def _divided(a: Array) -> Array:
    """`a` itself: the compiler does not repeat a division, and does not see that its denominator is one."""
    return a / jnp.where(a == a, 1, a)  # only NaN differs from itself


# A primitive, since a derivative of the division would be neither linear nor cheap.
_computed_once = Primitive("computed_once")
_computed_once.def_impl(_divided)
_computed_once.def_abstract_eval(lambda a: a)
mlir.register_lowering(_computed_once, mlir.lower_fun(_divided, multiple_results=False))
ad.deflinear(_computed_once, lambda tangent: [computed_once(tangent)])
batching.defvectorized(_computed_once)


def rows_once(rows: Sequence[Shaped[Array, "*S"]]) -> Shaped[Array, "k *S"]:
    """The rows as one array, each `computed_once`: stored as a whole they would be computed with branches."""
    return jnp.stack([computed_once(row) for row in rows])


def evaluate_effect(e: Effect, function: Callable[..., Any], *signals: Shaped[Array, "*S"]) -> Any:
    """`function(effect, *signals)`; for each state separately if each has its own parameter values."""
    values = e.values
    if all(np.ndim(value) == 0 for value in values.values() if value is not None):
        return function(e, *signals)
    return jax.vmap(lambda values, *signals: function(e.replace(**values), *signals))(values, *signals)
