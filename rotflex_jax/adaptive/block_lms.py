"""LMS over a Volterra series of many delays, a block of samples at a time, and yet exact."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rotflex_jax.adaptive.lms import LMS
from rotflex_jax.adaptive.ranges import per_weight
from rotflex_jax.adaptive.square import Square
from rotflex_jax.adaptive.sums import times

LENGTH = 32
"""Samples of a block: enough for matrix products, few enough for their own products to be cheap."""


@dataclasses.dataclass(frozen=True)
class SquareBlocks(Square):
    """LMS with one step size per degree, on blocks of samples.

        e = (I + tril(G, -1))^-1 (d - y_w),   G_ij = phi_i' diag(mu) phi_j
          = mu_0 + mu_1 g_ij + mu_2 / 2 (g_ij^2 + sum_k z_ik^2 z_jk^2),   g = Z Z',  Z the delays as rows

    Within a block the weights that a sample meets are those of the block's beginning and what the errors
    before it in the block have added, so all errors follow from one triangular system. The products of
    the delays appear only through the inner products g: no regressor is formed at all.

    Source: Benesty and Duhamel 1992, IEEE Trans. Signal Processing 40; the kernel of a Volterra series:
    Franz and Schoelkopf 2006, Neural Computation 18.
    """

    def scan(self, filter: LMS, carry: Any, x: Array, y: Array) -> tuple[Any, Array]:
        """State of the loop after the samples, and a-priori errors (N,)."""
        mu = self.parts(per_weight("mu", filter.mu, self.size, x.dtype))
        mu0, mu1, mu2 = mu[0], mu[1][0], mu[2][0, 0]
        M, N = self.memory, len(x)
        fill = -N % LENGTH
        # Newest first before the block's first sample, as rows of the same stretch of input.
        line = jnp.concatenate([carry[3][::-1], x, jnp.zeros(fill, x.dtype)])
        rows = np.arange(LENGTH)[:, None] + M - np.arange(M)[None, :]
        eye, seen = jnp.eye(LENGTH, dtype=x.dtype), jnp.arange(N + fill) < N

        def turn(carry: Any, block: tuple[Array, Array, Array]) -> tuple[Any, Array]:
            w0, w1, W = carry
            at, d, real = block
            Z = jax.lax.dynamic_slice(line, (at,), (LENGTH + M,))[rows]
            g, squares = times(Z, Z.T), Z * Z
            G = mu0 + mu1 * g + mu2 / 2 * (g * g + times(squares, squares.T))
            free = d - (w0 + jnp.sum((times(Z, W) + w1[None]) * Z, axis=1))
            e = jax.scipy.linalg.solve_triangular(jnp.tril(G, -1) + eye, free, lower=True, unit_diagonal=True)
            e = jnp.where(real, e, 0.0)
            eZ = Z * e[:, None]
            S = times(Z.T, eZ)
            W = W + mu2 / 2 * (S + jnp.diag(jnp.diag(S)))
            return (w0 + mu0 * jnp.sum(e), w1 + mu1 * jnp.sum(eZ, axis=0), W), e

        starts = jnp.arange(0, N + fill, LENGTH)
        padded = jnp.concatenate([y, jnp.zeros(fill, y.dtype)]).reshape(-1, LENGTH)
        end, e = jax.lax.scan(turn, carry[:3], (starts, padded, seen.reshape(-1, LENGTH)))
        return (*end, line[N : N + M][::-1]), e.reshape(-1)[:N]
