"""The weights that a lattice of a Volterra filter stands for."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Stage(NamedTuple):
    """One stage: three regressions with the a-priori errors f and b, one of each per channel.

    Stage m knows the first m + 2 channels; what belongs to the others stays zero.

    Attributes:
        b: errors of the samples that leave, predicted from those after them.
        g: gain of the regressions on b.
        gamma: share of an error that the stages before leave after their correction.
        root_b: square root of the inverse Gram matrix of b.
        output: coefficients of b for the outputs.
        root_f: square root of the inverse Gram matrix of f.
        forward: coefficients of the previous b for f of the next stage.
        backward: coefficients of f for b of the next stage.
    """

    b: Float[Array, " n"]
    g: Float[Array, " n"]
    gamma: Float[Array, ""]
    root_b: Float[Array, "n n"]
    output: Float[Array, "n T"]
    root_f: Float[Array, "n n"]
    forward: Float[Array, "n F"]
    backward: Float[Array, "n B"]


def monomials(memory: int) -> list[tuple[int, ...]]:
    """Delays of every regressor, the smaller first: linear ones, then products by their first delay.

    >>> monomials(2)
    [(0,), (1,), (0, 0), (0, 1), (1, 1)]
    """
    delays = range(memory)
    return [(i,) for i in delays] + [(i, j) for i in delays for j in delays[i:]]


def direct_form(stages: Stage, memory: int) -> Float[Array, "P T"]:
    """Weights of the outputs on the monomials, from the coefficients of the stages.

    In a vector over all monomials, with C and A the predictors of what leaves and of what is new:
    b = old - C'x and f = new - A'x, with x the samples between, so that

        w <- w + (old - C) output
        C <- (old - C before, new - A) - (new - A) backward,    A <- A + (old - C before) forward

    where "before" is one sample earlier. That is known without having been kept, for the last update
    was `C = C before + k b'`, with k the gain of RLS, which the stages hold as well: `k <- k + (old - C) g`.

    Args:
        stages: of a lattice, along the first axis.
        memory: its memory.
    """
    names = monomials(memory)
    place = {delays: i for i, delays in enumerate(names)}
    size, channels, dtype = len(names), memory + 1, stages.b.dtype
    # Row i takes what is said of the samples up to t - 1 from the row of the same samples then.
    earlier = [place.get(tuple(d - 1 for d in delays), size) for delays in names]
    later = lambda x: jnp.concatenate([x, jnp.zeros_like(x[:1])])[np.array(earlier)]  # noqa: E731
    new = np.eye(size)[:, [place[delays] for delays in [(0,), *((0, j) for j in range(memory))]]]
    known, joining = (jnp.asarray(x) for x in known_channels(memory))

    def climb(carry: tuple[Array, ...], stage: tuple[Stage, Array, Array]) -> tuple[Any, None]:
        # B and F are error filters, the monomials less their predictors: of b and of f.
        w, k, B, F = carry
        own, knows, joins = stage
        before = later(B + k[:, None] * own.b[None])
        B_next = before + jnp.where(joins[None], F, 0) - jnp.where(knows[None], F, 0) @ own.backward
        return (w + B @ own.output, k + B @ own.g, B_next, F - before @ own.forward), None

    F = jnp.asarray(new, dtype)
    start = (
        jnp.zeros((size, stages.output.shape[2]), dtype),
        jnp.zeros(size, dtype),
        jnp.where(np.arange(channels)[None] < 2, F, 0),
        F,
    )
    return jax.lax.scan(climb, start, (stages, known, joining))[0][0]


def known_channels(memory: int) -> tuple[np.ndarray, np.ndarray]:
    """Which channels each stage knows (M, M + 1), the first m + 2, and which the next one knows besides."""
    known = np.arange(memory + 1) < np.arange(2, memory + 2)[:, None]
    return known, np.diff(known, axis=0, append=known[-1:])
