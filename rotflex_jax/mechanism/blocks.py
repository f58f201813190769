"""A linear mechanism goes through its samples in blocks of matrix products, not one by one.

    x[k+1] = E x[k] + B w[k],   y[k] = C x[k]
    y[k+i] = C E^i x[k] + sum_{j<i} C E^(i-1-j) B w[k+j],   0 <= i < BLOCK

The first term needs the state at the beginning of each block only, so the scan is that much shorter; the
second is one Toeplitz matrix for all blocks.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

BLOCK = 32
"""Samples of a block: with fewer the scan is longer, with more the products are larger."""
WORTH = 8 * BLOCK
"""Fewer samples than this are quicker one by one."""


def linear_outputs(
    step: Any, x0: Float[Array, " n"], inputs: Array, constants: Any, C: Float[Array, "C n"]
) -> Float[Array, "N C"]:
    """Combinations `C x` of the states at the samples; the states themselves if C is the identity.

    Not for a step that is linear along a run only, as a filter is whose samples do not all count.

    Args:
        step: Linear in state and inputs; takes many side by side, as in `propagate.states`.
        x0: First state.
        inputs: Of each sample (N,) or (N, m).
        constants: What every step sees.
        C: Combinations.
    """
    N, n = len(inputs), len(x0)
    flat = inputs.reshape(N, -1)
    m = flat.shape[1]
    eye = lambda size: jnp.eye(size, dtype=x0.dtype)  # noqa: E731
    shaped = lambda w: w[0] if inputs.ndim == 1 else w  # noqa: E731
    E = step(eye(n), shaped(jnp.zeros((m, n), x0.dtype)), constants)
    B = step(jnp.zeros((n, m), x0.dtype), shaped(eye(m)), constants)
    powers = _powers(E)  # E^0 ... E^BLOCK
    seen = jnp.einsum("cn,knj->kcj", C, powers[:BLOCK])  # C E^i
    answer = jnp.concatenate([jnp.zeros((1, len(C), m), x0.dtype), (seen @ B)[:-1]])
    late = jnp.arange(BLOCK)[:, None] - jnp.arange(BLOCK)[None]
    toeplitz = jnp.where(late[..., None, None] > 0, answer[jnp.maximum(late, 0)], 0.0)  # (i, j, C, m)
    toeplitz = jnp.moveaxis(toeplitz, 2, 1).reshape(BLOCK * len(C), BLOCK * m)
    push = jnp.moveaxis((powers[BLOCK - 1 :: -1] @ B), 0, 1).reshape(n, BLOCK * m)
    w = jnp.pad(flat, ((0, -N % BLOCK), (0, 0))).reshape(-1, BLOCK * m)
    starts = jax.lax.scan(lambda x, f: (powers[BLOCK] @ x + f, x), x0, w @ push.T)[1]
    y = w @ toeplitz.T + starts @ seen.reshape(-1, n).T
    return y.reshape(-1, len(C))[:N]


def _powers(E: Array) -> Array:
    """`E^0` to `E^BLOCK` (BLOCK + 1, n, n), twice as many with every product."""
    powers, top = jnp.eye(len(E), dtype=E.dtype)[None], E
    while len(powers) < BLOCK:
        powers = jnp.concatenate([powers, powers @ top])
        top = top @ top
    return jnp.concatenate([powers, top[None]])
