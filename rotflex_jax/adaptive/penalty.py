"""The mean-square bound of LMS as a smooth penalty on its step sizes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.adaptive.meansquare import MeanSquare
from rotflex_jax.adaptive.moments import Moments

TURNS = 60
"""Power iterations for the worst covariance; the error of the bound is the square of its error."""


class Margin(eqx.Module):
    """By which factor step sizes lie inside the mean-square bound, traced.

        factor = min over C of <C, A(C)> / <C, S(C)>

    At the worst C the quotient does not change to first order with C. So C may be held while the
    derivative is taken, and no eigenvalue needs a derivative of its own.

    Args:
        moments: of the regressors, few enough for S as a matrix.
        least: factor to be kept; the penalty begins below it.
    """

    R: Float[Array, "P P"]
    S: Float[Array, "D D"]
    lengths: Float[Array, " D"]
    least: Float[Array, ""]

    def __init__(self, moments: Moments, least: float = 1.0) -> None:
        if moments.pairs is not None:
            S = moments.pairs
        else:
            exact = MeanSquare(moments, np.ones(moments.size))
            S = Moments(np.diag(exact.values), pairs=exact.dense()).transformed(exact.vectors.T).pairs
        i, j = np.triu_indices(moments.size)
        self.R, self.S = jnp.asarray(moments.R), jnp.asarray(S)
        self.lengths = jnp.asarray(np.where(i == j, 1.0, np.sqrt(2.0)))
        self.least = jnp.asarray(float(least))

    def penalty(self, mu: Float[Array, "..."]) -> Float[Array, ""]:
        """Square of the missing logarithm; zero where the factor is kept."""
        sizes = jnp.broadcast_to(mu, self.R.shape[:1])
        return jax.nn.relu(jnp.log(self.least) - self.log_factor(sizes)) ** 2

    def log_factor(self, mu: Float[Array, " P"]) -> Float[Array, ""]:
        """Logarithm of the factor; below zero outside of the bound."""
        i, j = np.triu_indices(len(mu))
        root = jnp.sqrt(mu + 1e-12 * jnp.max(mu))
        scale = root[i] * root[j]
        R = self.R * root[:, None] * root[None, :]
        values, V = jnp.linalg.eigh(jax.lax.stop_gradient(R))
        values = jnp.maximum(values, 1e-12 * values[-1])

        def worse(_: int, C: Array) -> Array:
            image = self._open(scale * (self.S @ (scale * self._close(C))))
            image = V @ ((V.T @ image @ V) / (values[:, None] + values[None, :])) @ V.T
            return image / jnp.linalg.norm(image)

        C = jax.lax.stop_gradient(jax.lax.fori_loop(0, TURNS, worse, jnp.eye(len(mu), dtype=mu.dtype)))
        c = scale * self._close(C)
        return jnp.log(2 * jnp.sum(C * (R @ C))) - jnp.log(c @ self.S @ c)

    def _close(self, C: Array) -> Array:
        i, j = np.triu_indices(C.shape[0])
        return C[i, j] * self.lengths

    def _open(self, c: Array) -> Array:
        P = self.R.shape[0]
        i, j = np.triu_indices(P)
        W = jnp.zeros((P, P), c.dtype).at[i, j].set(c / self.lengths)
        return W.at[j, i].set(W[i, j])
