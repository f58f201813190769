"""A filter over a Volterra series of delays whose regressors are made anew in every turn of the loop.

Regressors that are stored take P numbers per sample and longer to read than to make. A form holds the
loop's own state; `begin` makes it of the filter's, `end` turns it back, and all forms give the same
errors to rounding.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.adaptive.filter import AdaptiveFilter
from rotflex_jax.basis.monomials import indices

Lags = Float[Array, " M"]
Turn = Callable[[Any, tuple[Array, Array]], tuple[Any, Array]]


@dataclasses.dataclass(frozen=True)
class Rebuilt:
    """Any filter, on products of the newest samples.

    Attributes:
        memory: delays M.
        degrees: of the products, 0 for the constant.
        layout: of the products.
    """

    memory: int
    degrees: tuple[int, ...]
    layout: str

    @property
    def size(self) -> int:
        """Number of regressors."""
        return sum(len(indices(self.memory, d, self.layout)) for d in self.degrees)

    def begin(self, state: Any, lags: Lags) -> Any:
        """State of the loop, after the samples `lags`, the newest first."""
        return state, lags

    def scan(self, filter: AdaptiveFilter, carry: Any, x: Array, y: Array) -> tuple[Any, Array]:
        """State of the loop after the samples, and a-priori errors (N,)."""

        def turn(carry: Any, sample: tuple[Array, Array]) -> tuple[Any, Array]:
            state, lags = carry
            lags = jnp.concatenate([sample[0][None], lags[:-1]])
            state, e = filter.step(state, self.regressors(lags), sample[1])
            return (state, lags), e

        return jax.lax.scan(turn, carry, (x, y))

    def regressors(self, lags: Float[Array, "*B M"]) -> Float[Array, "*B P"]:
        """Products of delays, the newest first."""
        listed = [(indices(self.memory, d, self.layout), d) for d in self.degrees]
        factors = [np.array(each, int).reshape(len(each), d) for each, d in listed]
        return jnp.concatenate([_products(lags, f) for f in factors], axis=-1)

    def newest(self, x: Float[Array, " B"], lags: Lags) -> tuple[Float[Array, " B+M"], Float[Array, "B M"]]:
        """The input up to the end of a block, and the delays of each of its samples, all newest first."""
        line = jnp.concatenate([x[::-1], lags])
        return line, jnp.stack([line[k : k + self.memory] for k in reversed(range(len(x)))])

    def end(self, carry: Any) -> Any:
        """The filter's state."""
        return carry[0]


def in_blocks(turn: Turn, carry: Any, x: Array, y: Array, length: int) -> tuple[Any, Array]:
    """A loop over blocks of samples; those that fill none are one more, shorter turn.

    Args:
        turn: from state and block (input, output) to the next state and the errors of the block.
        carry: first state.
        x: input (N,).
        y: output (N,).
        length: samples of a block.

    Returns:
        Last state, and errors (N,).
    """
    whole = len(y) // length * length
    blocks = x[:whole].reshape(-1, length), y[:whole].reshape(-1, length)
    carry, e = jax.lax.scan(turn, carry, blocks)
    if whole == len(y):
        return carry, e.reshape(-1)
    carry, last = turn(carry, (x[whole:], y[whole:]))
    return carry, jnp.concatenate([e.reshape(-1), last])


def _products(lags: Float[Array, "*B M"], factors: np.ndarray) -> Float[Array, "*B K"]:
    """Products of the lags `factors` (K, degree)."""
    product = jnp.ones((*lags.shape[:-1], len(factors)), lags.dtype)
    for k in range(factors.shape[1]):
        product = product * lags[..., factors[:, k]] if k else lags[..., factors[:, 0]]
    return product
