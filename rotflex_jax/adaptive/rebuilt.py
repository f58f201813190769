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

from rotflex_jax.adaptive.filter import AdaptiveFilter, Weights
from rotflex_jax.adaptive.lms import LMS
from rotflex_jax.adaptive.ranges import per_weight
from rotflex_jax.adaptive.sums import tree_sum
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
        listed = [(indices(self.memory, d, self.layout), d) for d in self.degrees]
        factors = [np.array(each, int).reshape(len(each), d) for each, d in listed]

        def turn(carry: Any, sample: tuple[Array, Array]) -> tuple[Any, Array]:
            state, lags = carry[0], shifted(carry[1], sample[0])
            state, e = filter.step(state, jnp.concatenate([_products(lags, f) for f in factors]), sample[1])
            return (state, lags), e

        return jax.lax.scan(turn, carry, (x, y))

    def end(self, filter: AdaptiveFilter, carry: Any) -> Any:
        """The filter's state."""
        return carry[0]


def shifted(lags: Lags, newest: Float[Array, ""]) -> Lags:
    """One sample later."""
    return jnp.concatenate([newest[None], lags[:-1]])


def _products(lags: Lags, factors: np.ndarray) -> Float[Array, " K"]:
    """Products of the lags `factors` (K, degree)."""
    product = jnp.ones(len(factors), lags.dtype)
    for k in range(factors.shape[1]):
        product = product * lags[factors[:, k]] if k else lags[factors[:, 0]]
    return product


@dataclasses.dataclass(frozen=True)
class Square(Rebuilt):
    """LMS with the weights of the products as a symmetric matrix W.

        y_hat = w_0 + (w_1 + W z)'z,    W <- W + H e z z',    H: step sizes, those off the diagonal halved

    No product is ever formed, and the matrix is worked through row by row.

    Attributes:
        leaks: whether the weights are pulled towards zero.
    """

    leaks: bool = False

    def begin(self, filter: AdaptiveFilter, state: Weights, lags: Lags) -> Any:
        """State of the loop, after the samples `lags`, the newest first."""
        return *self.parts(state.w / self._counted(state.w.dtype)), lags

    def scan(self, filter: LMS, carry: Any, x: Array, y: Array) -> tuple[Any, Array]:
        """State of the loop after the samples, and a-priori errors (N,)."""
        mu = per_weight("mu", filter.mu, self.size, x.dtype)
        sizes = self.parts(mu / self._counted(x.dtype))
        pull = self.parts(1 - mu * filter.leakage)
        kept = lambda k, w: w * pull[k] if self.leaks else w  # noqa: E731

        def turn(carry: Any, sample: tuple[Array, Array]) -> tuple[Any, Array]:
            w0, w1, W, lags = carry
            z = shifted(lags, sample[0])
            e = sample[1] - (w0 + tree_sum((w1 + jnp.sum(W * z[:, None], axis=0)) * z))
            ez = e * z
            W = kept(2, W) + (sizes[2] * z[None, :]) * ez[:, None]
            return (kept(0, w0) + sizes[0] * e, kept(1, w1) + sizes[1] * ez, W, z), e

        return jax.lax.scan(turn, carry, (x, y))

    def end(self, filter: AdaptiveFilter, carry: Any) -> Weights:
        """The filter's state."""
        w0, w1, W, _ = carry
        i, j = np.triu_indices(self.memory)
        whole = {0: w0[None], 1: w1, 2: W[i, j]}
        w = jnp.concatenate([whole[d] for d in self.degrees])
        return Weights(w * self._counted(w.dtype))

    def parts(self, w: Array) -> tuple[Array, Array, Array]:
        """Constant, linear part (M,) and symmetric matrix (M, M) of numbers per weight; zero where none."""
        M, at, own = self.memory, 0, {}
        for d in self.degrees:
            count = len(indices(M, d, "triangular"))
            own[d] = w[at : at + count]
            at += count
        i, j = np.triu_indices(M)
        matrix = jnp.zeros((M, M), w.dtype).at[i, j].set(own[2]).at[j, i].set(own[2])
        constant = own[0][0] if 0 in own else jnp.zeros((), w.dtype)
        return constant, own.get(1, jnp.zeros(M, w.dtype)), matrix

    def _counted(self, dtype: Any) -> np.ndarray:
        """How often a weight stands in the matrix."""
        twice = [
            2 if len(set(i)) > 1 else 1 for d in self.degrees for i in indices(self.memory, d, "triangular")
        ]
        return np.array(twice, dtype)
