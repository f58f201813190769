"""LMS over a second-order Volterra series as a symmetric matrix of weights, two samples at a time."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.adaptive.filter import Weights
from rotflex_jax.adaptive.lms import LMS
from rotflex_jax.adaptive.ranges import per_weight
from rotflex_jax.adaptive.rebuilt import Lags, Rebuilt, in_blocks
from rotflex_jax.basis.monomials import counts, indices, positions

Parts = tuple[Array, Array, Array]
"""Constant, linear part (M,) and symmetric matrix (M, M)."""


@dataclasses.dataclass(frozen=True)
class Square(Rebuilt):
    """LMS with the weights of the products as a symmetric matrix W.

        y_hat = w_0 + (w_1 + W z)'z,    W <- W + H e z z',    H: step sizes, those off the diagonal halved

    No product is ever formed. Of two samples the second does not wait for the weights of the first:

        e_2 = y_2 - y_hat_2(w) - g e_1,    g = phi_1' diag(mu) phi_2 = mu_0 + (mu_1 + H b)'b,   b = z_1 z_2

    This is exact: g e_1 is what the first correction adds to the second prediction. The weights are then
    read and written half as often, and a processor works on two samples side by side.

    Attributes:
        alike: whether all weights of a degree have one step size, which makes g cheaper.
        leaks: whether the weights are pulled towards zero; then the samples go one by one.

    Source: Benesty and Duhamel 1992, IEEE Trans. Signal Processing 40.
    """

    alike: bool = False
    leaks: bool = False

    def begin(self, state: Weights, lags: Lags) -> Any:
        """State of the loop, after the samples `lags`, the newest first."""
        return *self.parts(state.w / self._counted(state.w.dtype)), lags

    def scan(self, filter: LMS, carry: Any, x: Array, y: Array) -> tuple[Any, Array]:
        """State of the loop after the samples, and a-priori errors (N,)."""
        mu = per_weight("mu", filter.mu, self.size, x.dtype)
        mu0, mu1, H = sizes = self.parts(mu / self._counted(x.dtype))
        pull = self.parts(1 - mu * filter.leakage)

        def turn(carry: Any, sample: tuple[Array, Array]) -> tuple[Any, Array]:
            *w, lags = carry
            line, Z = self.newest(sample[0], lags)
            moved = w[1][None] + jnp.sum(Z[:, :, None] * w[2][None], axis=1)
            e = sample[1] - (w[0] + jnp.sum(moved * Z, axis=1))
            if len(Z) == 2:
                e = jnp.stack([e[0], e[1] - self._felt(sizes, Z[0] * Z[1]) * e[0]])
            w0, w1, W = (a * b for a, b in zip(w, pull, strict=True)) if self.leaks else w
            eZ = Z * e[:, None]
            W = W + H * jnp.sum(eZ[:, :, None] * Z[:, None, :], axis=0)
            return (w0 + mu0 * jnp.sum(e), w1 + mu1 * jnp.sum(eZ, axis=0), W, line[: self.memory]), e

        return in_blocks(turn, carry, x, y, length=1 if self.leaks else 2)

    def end(self, carry: Any) -> Weights:
        """The filter's state."""
        w0, w1, W, _ = carry
        i, j = np.triu_indices(self.memory)
        whole = {0: w0[None], 1: w1, 2: W[i, j]}
        w = jnp.concatenate([whole[d] for d in self.degrees])
        return Weights(w * self._counted(w.dtype))

    def _felt(self, sizes: Parts, b: Float[Array, " M"]) -> Float[Array, ""]:
        """What a correction by an error of one adds to the next prediction."""
        mu0, mu1, H = sizes
        if not self.alike:
            return mu0 + jnp.sum((mu1 + jnp.sum(H * b[:, None], axis=0)) * b)
        g = jnp.sum(b)
        return mu0 + mu1[0] * g + H[0, 0] / 2 * (g * g + jnp.sum(b * b))

    def parts(self, w: Array) -> Parts:
        """Numbers per weight as constant, linear part and matrix; zero where there is none."""
        M, at, own = self.memory, 0, {}
        for d in self.degrees:
            count = len(indices(M, d, "triangular"))
            own[d] = w[at : at + count]
            at += count
        constant = own[0][0] if 0 in own else jnp.zeros((), w.dtype)
        return constant, own.get(1, jnp.zeros(M, w.dtype)), own[2][positions(M, 2).astype(np.int32)]

    def _counted(self, dtype: Any) -> np.ndarray:
        """How often a weight stands in the matrix."""
        return np.concatenate([counts(self.memory, d) for d in self.degrees]).astype(dtype)
