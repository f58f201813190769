"""A filter over a Volterra series of delays whose regressors are made anew in every turn of the loop.

Regressors that are stored take P numbers per sample and longer to read than to make. A form holds the
loop's own state; `begin` makes it of the filter's, `end` turns it back, and all forms give the same
errors to rounding.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.adaptive.filter import AdaptiveFilter
from rotflex_jax.basis.monomials import indices

Lags = Float[Array, " M"]


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

    def begin(self, filter: AdaptiveFilter, state: Any, lags: Lags) -> Any:
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

    def end(self, filter: AdaptiveFilter, carry: Any) -> Any:
        """The filter's state."""
        return carry[0]


def _products(lags: Float[Array, "*B M"], factors: np.ndarray) -> Float[Array, "*B K"]:
    """Products of the lags `factors` (K, degree)."""
    product = jnp.ones((*lags.shape[:-1], len(factors)), lags.dtype)
    for k in range(factors.shape[1]):
        product = product * lags[..., factors[:, k]] if k else lags[..., factors[:, 0]]
    return product
