"""The scan over samples, with a derivative rule that is as cheap as linear algebra allows.

Differentiating `x[k+1] = f(x[k], w[k], c)` gives a linear time-varying recursion

    dx[k+1] = A[k] dx[k] + b[k],   A[k] = df/dx,   b[k] = df/dw dw[k] + df/dc dc.

All A[k] and b[k] follow from the states alone, so they are formed for all samples at once (vectorised),
and only the small recursion is a scan. One pass serves any number of directions: under `jax.vmap` over
tangents A[k] is shared. Reverse mode works too, since the rule is linear in the tangents.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rotflex_jax.mechanism.blocks import WORTH, linear_outputs

StepFunction = Callable[[jax.Array, Any, Any], jax.Array]


def states(step: StepFunction, x0: jax.Array, inputs: Any, constants: Any) -> jax.Array:
    """States (N, n) at the samples: row 0 is `x0`, row k + 1 is `step(row k, inputs[k], constants)`.

    A step that says it is `linear` goes through long runs in blocks.

    Args:
        step: Pure function; hashable, so that equal structures share one compilation. It takes one state
            (n,) with its inputs, or many side by side: state (n, N), inputs with N as the last axis.
        x0: First state.
        inputs: Pytree of arrays with leading length N.
        constants: Pytree that every step sees.
    """
    if getattr(step, "linear", False) and len(inputs) >= WORTH:
        return linear_outputs(step, x0, inputs, constants, jnp.eye(len(x0), dtype=x0.dtype))
    return _stepped(step, x0, inputs, constants)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _stepped(step: StepFunction, x0: jax.Array, inputs: Any, constants: Any) -> jax.Array:
    """One by one."""

    def body(x: jax.Array, w: Any) -> tuple[jax.Array, jax.Array]:
        return step(x, w, constants), x

    return jax.lax.scan(body, x0, inputs)[1]


# Samples that are differentiated side by side. Long enough for the vector units, short enough that the
# intermediate results of all directions stay in the processor's cache.
CHUNK = 512


def chunks(tree: Any) -> Any:
    """Leading time axis N -> (chunks, ..., CHUNK): time last, along which vector units run."""

    def cut(leaf: jax.Array) -> jax.Array:
        N = leaf.shape[0]
        fill = -N % min(CHUNK, N)
        padded = jnp.concatenate([leaf, leaf[N - fill :]]) if fill else leaf
        pieces = padded.reshape(-1, min(CHUNK, N), *leaf.shape[1:])
        return jnp.moveaxis(pieces, 1, -1)

    return jax.tree.map(cut, tree)


def joined(chunks: jax.Array, N: int) -> jax.Array:
    """(chunks, ..., CHUNK) -> (N, ...)."""
    pieces = jnp.moveaxis(chunks, -1, 1)
    return pieces.reshape(-1, *pieces.shape[2:])[:N]


def slopes(step: StepFunction, X: jax.Array, inputs: Any, constants: Any) -> jax.Array:
    """`df/dx` along the states X (N, n): entry [k, j] is the column of `A[k]` for state j (N, n, n)."""
    x, w = chunks((X, inputs))
    ways = jnp.eye(X.shape[1], dtype=X.dtype)

    def here(pair: Any) -> jax.Array:
        s, v = pair
        wide = jnp.broadcast_to(ways[:, :, None], (len(ways), *s.shape))
        return jax.vmap(lambda way: jax.jvp(lambda q: step(q, v, constants), (s,), (way,))[1])(wide)

    return joined(jax.lax.map(here, (x, w)), len(X))


def forcing(
    step: StepFunction, X: jax.Array, inputs: Any, dinputs: Any, constants: Any, dconstants: Any
) -> jax.Array:
    """`b[k] = df/dw dw[k] + df/dc dc` (N, n) along the states X (N, n)."""
    x, w, dw = chunks((X, inputs, dinputs))

    def here(triple: Any) -> jax.Array:
        s, v, dv = triple
        return jax.jvp(functools.partial(step, s), (v, constants), (dv, dconstants))[1]

    return joined(jax.lax.map(here, (x, w, dw)), len(X))


def recursion(A: jax.Array, b: jax.Array, dx0: jax.Array) -> jax.Array:
    """`dx[k+1] = A[k] dx[k] + b[k]`: dx (N, n), row 0 is `dx0`; A as `slopes` gives it."""

    def body(dx: jax.Array, ab: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        a, force = ab
        return jnp.sum(a * dx[:, None], axis=0) + force, dx

    return jax.lax.scan(body, dx0, (A, b))[1]


@_stepped.defjvp
def _states_jvp(step: StepFunction, primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    x0, inputs, constants = primals
    dx0, dinputs, dconstants = tangents
    X = _stepped(step, x0, inputs, constants)
    A = slopes(step, X, inputs, constants)
    b = forcing(step, X, inputs, dinputs, constants, dconstants)
    return X, recursion(A, b, dx0)
