"""The scan over samples, in blocks where the mechanism is linear, with a derivative rule of its own.

    x[k+1] = E x[k] + B w[k],   y[k] = C x[k]
    y[k+i] = C E^i x[k] + sum_{j<i} C E^(i-1-j) B w[k+j],   0 <= i < BLOCK

The first term needs the state at the beginning of each block only, so the scan is that much shorter; the
second is one Toeplitz matrix for all blocks.

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
from jaxtyping import Array, Float, Shaped

BLOCK_SAMPLES = 32
"""Length of a block: shorter ones make the scan longer, longer ones the products larger."""
BLOCKED_FROM_SAMPLES = 8 * BLOCK_SAMPLES
"""Runs of at least this length are evaluated in blocks; shorter runs are faster sample by sample."""


def linear_outputs(
    step: Any, x0: Float[Array, " n"], inputs: Float[Array, "N *m"], constants: Any, C: Float[Array, "C n"]
) -> Float[Array, "N C"]:
    """Outputs `C x` of a linear time-invariant step, block by block; the states if C is the identity.

    Not for a time-varying linear step, such as a predictor that skips the correction of some samples.

    Args:
        step: Step that is linear in state and inputs; takes several states side by side, as in `states`.
        x0: First state.
        inputs: Inputs of each sample, (N,) or (N, m).
        constants: Passed to every step.
        C: Output matrix.
    """
    N, n = len(inputs), len(x0)
    flat = inputs.reshape(N, -1)
    m = flat.shape[1]
    eye = lambda size: jnp.eye(size, dtype=x0.dtype)  # noqa: E731
    shaped = lambda w: w[0] if inputs.ndim == 1 else w  # noqa: E731
    E = step(eye(n), shaped(jnp.zeros((m, n), x0.dtype)), constants)
    B = step(jnp.zeros((n, m), x0.dtype), shaped(eye(m)), constants)
    powers = _powers(E)  # E^0 ... E^BLOCK
    seen = jnp.einsum("cn,knj->kcj", C, powers[:BLOCK_SAMPLES])  # C E^i
    answer = jnp.concatenate([jnp.zeros((1, len(C), m), x0.dtype), (seen @ B)[:-1]])
    late = jnp.arange(BLOCK_SAMPLES)[:, None] - jnp.arange(BLOCK_SAMPLES)[None]
    toeplitz = jnp.where(late[..., None, None] > 0, answer[jnp.maximum(late, 0)], 0.0)  # (i, j, C, m)
    toeplitz = jnp.moveaxis(toeplitz, 2, 1).reshape(BLOCK_SAMPLES * len(C), BLOCK_SAMPLES * m)
    push = jnp.moveaxis((powers[BLOCK_SAMPLES - 1 :: -1] @ B), 0, 1).reshape(n, BLOCK_SAMPLES * m)
    w = jnp.pad(flat, ((0, -N % BLOCK_SAMPLES), (0, 0))).reshape(-1, BLOCK_SAMPLES * m)
    starts = jax.lax.scan(lambda x, f: (powers[BLOCK_SAMPLES] @ x + f, x), x0, w @ push.T)[1]
    y = w @ toeplitz.T + starts @ seen.reshape(-1, n).T
    return y.reshape(-1, len(C))[:N]


def _powers(E: Float[Array, "n n"]) -> Float[Array, "K n n"]:
    """`E^0` to `E^BLOCK_SAMPLES`; each product doubles their number."""
    powers, top = jnp.eye(len(E), dtype=E.dtype)[None], E
    while len(powers) < BLOCK_SAMPLES:
        powers = jnp.concatenate([powers, powers @ top])
        top = top @ top
    return jnp.concatenate([powers, top[None]])


StepFunction = Callable[[Float[Array, "n *S"], Any, Any], Float[Array, "n *S"]]


def states(step: StepFunction, x0: Float[Array, " n"], inputs: Any, constants: Any) -> Float[Array, "N n"]:
    """States at the samples: row 0 is `x0`, row k + 1 is `step(row k, inputs[k], constants)`.

    If the attribute `linear` of the step is set and the run is long, it is evaluated in blocks.

    Args:
        step: Pure function; hashable, so that equal structures share one compilation. It takes one state
            (n,) with its inputs, or several side by side: state (n, S), inputs with S as the last axis.
        x0: First state.
        inputs: Pytree of arrays with leading length N.
        constants: Pytree that is passed to every step.
    """
    if getattr(step, "linear", False) and len(inputs) >= BLOCKED_FROM_SAMPLES:
        return linear_outputs(step, x0, inputs, constants, jnp.eye(len(x0), dtype=x0.dtype))
    return _stepped(step, x0, inputs, constants)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _stepped(step: StepFunction, x0: jax.Array, inputs: Any, constants: Any) -> jax.Array:
    """States at the samples, computed sample by sample."""

    def body(x: jax.Array, w: Any) -> tuple[jax.Array, jax.Array]:
        return step(x, w, constants), x

    return jax.lax.scan(body, x0, inputs)[1]


CHUNK_SAMPLES = 512
"""Samples that are differentiated together: enough for the vector units, few enough for the cache."""


def split_into_chunks(tree: Any) -> Any:
    """Leading time axis N -> (K, ..., CHUNK_SAMPLES), with time last for the vector units."""

    def cut(leaf: jax.Array) -> jax.Array:
        N = leaf.shape[0]
        fill = -N % min(CHUNK_SAMPLES, N)
        padded = jnp.concatenate([leaf, leaf[N - fill :]]) if fill else leaf
        pieces = padded.reshape(-1, min(CHUNK_SAMPLES, N), *leaf.shape[1:])
        return jnp.moveaxis(pieces, 1, -1)

    return jax.tree.map(cut, tree)


def join_chunks(pieces: Shaped[Array, "K *a S"], N: int) -> Shaped[Array, "N *a"]:
    """The inverse of `split_into_chunks`: (K, ..., CHUNK_SAMPLES) -> (N, ...)."""
    rows = jnp.moveaxis(pieces, -1, 1)
    return rows.reshape(rows.shape[0] * rows.shape[1], *rows.shape[2:])[:N]


def state_jacobians(
    step: StepFunction, X: Float[Array, "N n"], inputs: Any, constants: Any
) -> Float[Array, "N n n"]:
    """`df/dx` along the states: entry [k, j] is column j of `A[k]`."""
    x, w = split_into_chunks((X, inputs))
    units = jnp.eye(X.shape[1], dtype=X.dtype)

    def here(pair: Any) -> jax.Array:
        s, v = pair
        columns = jnp.broadcast_to(units[:, :, None], (len(units), *s.shape))
        return jax.vmap(lambda e: jax.jvp(lambda q: step(q, v, constants), (s,), (e,))[1])(columns)

    return join_chunks(jax.lax.map(here, (x, w)), len(X))


def forcing(
    step: StepFunction, X: Float[Array, "N n"], inputs: Any, dinputs: Any, constants: Any, dconstants: Any
) -> Float[Array, "N n"]:
    """`b[k] = df/dw dw[k] + df/dc dc` along the states; a tangent that is None is zero and costs nothing."""
    x, w, dw = split_into_chunks((X, inputs, dinputs))

    def here(triple: Any) -> jax.Array:
        s, v, dv = triple
        return directional(functools.partial(step, s), (v, constants), (dv, dconstants))

    return join_chunks(jax.lax.map(here, (x, w, dw)), len(X))


def directional(f: Callable[..., Float[Array, "*out"]], primals: Any, tangents: Any) -> Float[Array, "*out"]:
    """Derivative of `f(*primals)` along tangents, in which None stands for a leaf that does not change."""
    leaves, tree = jax.tree.flatten(primals)
    along = tree.flatten_up_to(tangents)
    moved = [i for i, t in enumerate(along) if t is not None]

    def of_moved(*given: jax.Array) -> jax.Array:
        every = list(leaves)
        for i, leaf in zip(moved, given, strict=True):
            every[i] = leaf
        return f(*tree.unflatten(every))

    return jax.jvp(of_moved, tuple(leaves[i] for i in moved), tuple(along[i] for i in moved))[1]


def tangent_recursion(
    A: Float[Array, "N n n"], b: Float[Array, "N n"], dx0: Float[Array, " n"]
) -> Float[Array, "N n"]:
    """`dx[k+1] = A[k] dx[k] + b[k]`: row 0 is `dx0`; `A` is from `state_jacobians`."""

    def body(dx: jax.Array, ab: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        a, force = ab
        return jnp.sum(a * dx[:, None], axis=0) + force, dx

    return jax.lax.scan(body, dx0, (A, b))[1]


@_stepped.defjvp
def _states_jvp(step: StepFunction, primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    x0, inputs, constants = primals
    dx0, dinputs, dconstants = tangents
    X = _stepped(step, x0, inputs, constants)
    A = state_jacobians(step, X, inputs, constants)
    b = forcing(step, X, inputs, dinputs, constants, dconstants)
    return X, tangent_recursion(A, b, dx0)
