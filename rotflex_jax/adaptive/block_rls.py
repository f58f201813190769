"""RLS over a Volterra series, several samples at a time, and yet exact."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rotflex_jax.adaptive.rebuilt import Rebuilt, in_blocks
from rotflex_jax.adaptive.rls import RLS, Root
from rotflex_jax.adaptive.sums import times

FEW, MANY = 21, 80
"""Weights up to which four samples go together, and from which sixteen do; two between."""

Rows = list[list[Array]]
"""A small triangular matrix, number by number: row i has i + 1 of them."""


def at_once(P: int) -> int:
    """Samples of a block for P weights.

    >>> [at_once(P) for P in (21, 66, 231)]
    [4, 2, 16]
    """
    return 4 if P <= FEW else 16 if P >= MANY else 2


@dataclasses.dataclass(frozen=True)
class RootBlocks(Rebuilt):
    """RLS on blocks of B samples, with a square root S of the inverse Gram matrix as ever.

        V = X S,    D + V V' = L L',  D = diag(lam, ..., lam^B),    v = L^-1 (y - X w),    e = diag(L) v,
        K = S V' L^-T,    w <- w + K v,    S <- (S - K (L + sqrt D)^-1 V) lam^(-B/2)

    With B = 1 this is the step of `RLS`. A block goes through S three times where B steps do so 3 B
    times, and no digit is lost by it: S S' is positive whatever the rounding.

    Source: Andrews 1968, AIAA Journal 6; in Bierman, Factorization Methods for Discrete Sequential
    Estimation, 1977.
    """

    def scan(self, filter: RLS, carry: Any, x: Array, y: Array) -> tuple[Any, Array]:
        """State of the loop after the samples, and a-priori errors (N,)."""

        def turn(carry: Any, sample: tuple[Array, Array]) -> tuple[Any, Array]:
            state, lags = carry
            line, Z = self.newest(sample[0], lags)
            correct = _few if self.size < MANY else _many
            state, e = correct(state, self.regressors(Z), sample[1], jnp.asarray(filter.lam))
            return (state, line[: self.memory]), e

        return in_blocks(turn, carry, x, y, at_once(self.size))


def _many(state: Root, X: Float[Array, "B P"], y: Float[Array, " B"], lam: Array) -> tuple[Root, Array]:
    """A block of samples by matrix products, none with a transposed matrix in front: these are slow."""
    w, S = state
    D = lam ** jnp.arange(1, len(y) + 1, dtype=y.dtype)
    V = times(X, S)
    L = jnp.linalg.cholesky(times(V, V.T) + jnp.diag(D), symmetrize_input=False)
    inverse, other = (
        jax.scipy.linalg.solve_triangular(each, jnp.eye(len(y), dtype=y.dtype), lower=True)
        for each in (L, L + jnp.diag(jnp.sqrt(D)))
    )
    v = times(inverse, y - times(X, w))
    K = times(times(S, V.T), inverse.T)
    S = (S - times(times(K, other), V)) / jnp.sqrt(D[-1])
    return Root(w + times(K, v), S), jnp.diagonal(L) * v


def _few(state: Root, X: Float[Array, "B P"], y: Float[Array, " B"], lam: Array) -> tuple[Root, Array]:
    """The same, written out so that the whole loop compiles into one function: no call of a library."""
    w, S = state
    D = [lam ** (k + 1) for k in range(len(y))]
    # Beyond some 21 weights the plain sum is too large for the loop to stay in one piece.
    V = jnp.sum(X[:, :, None] * S[None], axis=1) if len(w) <= FEW else [times(x, S) for x in X]
    U = [times(S, v) for v in V]
    A = [[jnp.sum(V[i] * V[j]) for j in range(i)] + [jnp.sum(V[i] * V[i]) + d] for i, d in enumerate(D)]
    L = _factor(A)
    # Rows of L^-1 (y - X w), of K' = L^-1 U', and of (L + sqrt D)^-1 V.
    v = _solved(L, list(y - jnp.sum(X * w[None], axis=1)))
    K = _solved(L, U)
    R = _solved([[*row[:-1], row[-1] + jnp.sqrt(d)] for row, d in zip(L, D, strict=True)], list(V))
    S = S - sum(k[:, None] * r[None] for k, r in zip(K, R, strict=True))
    e = jnp.stack([row[-1] * each for row, each in zip(L, v, strict=True)])
    return Root(w + sum(k * each for k, each in zip(K, v, strict=True)), S / jnp.sqrt(D[-1])), e


def _factor(A: Rows) -> Rows:
    """Lower triangle L of A = L L'."""
    L: Rows = []
    for i, row in enumerate(A):
        L.append([])
        for j in range(i):
            L[i].append((row[j] - sum(L[i][k] * L[j][k] for k in range(j))) / L[j][j])
        L[i].append(jnp.sqrt(row[i] - sum(each * each for each in L[i])))
    return L


def _solved(L: Rows, b: list[Array]) -> list[Array]:
    """L^-1 b, where the entries of b may be rows of a matrix."""
    x: list[Array] = []
    for row, each in zip(L, b, strict=True):
        x.append((each - sum(a * known for a, known in zip(row, x, strict=False))) / row[-1])
    return x
