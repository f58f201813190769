"""LMS with many settings at once over the same regressors, the settings innermost."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rotflex_jax.adaptive.objectives import Batch, Objective
from rotflex_jax.adaptive.sums import times

ROOM = 2640
"""Weights of all settings that are carried at a time; more than this leave the fastest memory."""
LEAST = 32
"""Settings side by side even so, for fewer do not keep a processor busy."""


def lanes(P: int) -> int:
    """Most settings that run side by side, for P weights each.

    >>> lanes(21), lanes(66), lanes(1326)
    (120, 40, 32)
    """
    return max(LEAST, ROOM // P // 8 * 8)


def sweep(
    data: Batch, objective: Objective, mu: Float[Array, "C P"], leakage: Float[Array, " C"] | None
) -> Float[Array, " C"]:
    """The objective of LMS at every one of C settings.

    As `evaluate` for each of them. There the settings would come first and the few weights of each last,
    which a processor works through one by one; here every weight is a row of C numbers. Of the errors
    only the sum of squares is kept.

    Args:
        data: recordings.
        objective: which.
        mu: step sizes.
        leakage: one for each setting; None for none.
    """
    C, P = mu.shape
    step, y = mu.T, data.y[:, data.skip :]
    first = y.shape[1] // 2 if objective == "last_half" else 0
    keep = None if leakage is None else (1 - mu * leakage[:, None]).T

    def turn(carry: tuple[Array, Array], sample: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
        w, total = carry
        phi, target = sample
        e = target - times(phi, w)
        kept = w if keep is None else w * keep
        return (kept + (step * e[None]) * phi[:, None], total + e * e), None

    def run(recording: tuple[Array, Array]) -> tuple[Array, Array]:
        phi, y = recording
        w, none = jnp.zeros((P, C), y.dtype), jnp.zeros(C, y.dtype)
        if first:  # what comes before only moves the weights
            w, _ = jax.lax.scan(turn, (w, none), (phi[:first], y[:first]))[0]
        return jax.lax.scan(turn, (w, none), (phi[first:], y[first:]))[0]

    w, total = jax.lax.map(run, (data.phi, y))
    if objective == "final":
        miss = jnp.moveaxis(w, 2, 0) - data.best[None]
        return jnp.mean(jnp.einsum("cbp,bpq,cbq->cb", miss, data.gram, miss) / data.smallest[None], axis=1)
    return jnp.mean(total, axis=0) / (y.shape[1] - first) / jnp.mean(data.smallest)
