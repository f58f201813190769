"""Affine projection: every step takes the last few samples into account."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rotflex_jax.adaptive.filter import AdaptiveFilter
from rotflex_jax.adaptive.ranges import Number, count, real_data, within
from rotflex_jax.adaptive.sums import times


class Window(NamedTuple):
    """Weights, the last K samples, newest first, and the products of their regressors."""

    w: Float[Array, " P"]
    phi: Float[Array, "K P"]
    y: Float[Array, " K"]
    gram: Float[Array, "K K"]


class AffineProjection(AdaptiveFilter):
    """Affine projection over a window of K samples.

        w <- w + mu X' (eps I + X X')^-1 (y - X w),    X = the last K regressors as rows

    With K = 1 it is NLMS, and its errors vanish over the window as `mu` nears 1. It undoes some of
    the correlation of the input, at about 3 K P operations. Not for noisy records: the noise of K
    samples is projected too. Like NLMS it does not come to rest at least squares where the model is
    incomplete.

    Args:
        mu: step size, stable below 2 [-].
        eps: keeps the inverse finite [regressor^2].
        window: samples K.

    Source: Ozeki and Umeda 1984; Haykin, Adaptive Filter Theory, 4th ed. 2002, chapter 6.
    """

    mu: Number = 0.5
    eps: Number = 1e-3
    window: int = eqx.field(static=True, default=4)

    def __check_init__(self) -> None:
        within("mu", self.mu, 0, float("inf"))
        within("eps", self.eps, 0, float("inf"), open_low=True)
        count("window", self.window)

    def init(self, size: int, dtype: Any) -> Window:
        """All weights zero, after silence."""
        real_data("AffineProjection", dtype)
        K = self.window
        zeros = lambda *shape: jnp.zeros(shape, dtype)  # noqa: E731
        return Window(zeros(size), zeros(K, size), zeros(K), zeros(K, K))

    def step(self, state: Window, phi: Array, y: Array) -> tuple[Window, Array]:
        """One step."""
        X = jnp.concatenate([phi[None], state.phi[:-1]])
        target = jnp.concatenate([y[None], state.y[:-1]])
        e = target - times(X, state.w)
        # Only the products with the newest are new; the others move along, so nothing adds up.
        new = times(X, phi)
        gram = jnp.concatenate([new[:, None], jnp.concatenate([new[None, 1:], state.gram[:-1, :-1]])], axis=1)
        z = solve(gram + self.eps * jnp.eye(self.window, dtype=phi.dtype), e)
        return Window(state.w + self.mu * times(z, X), X, target, gram), e[0]


def solve(A: Float[Array, "K K"], b: Float[Array, " K"]) -> Float[Array, " K"]:
    """The solution of `A x = b` for a small positive definite A, by elimination.

    Written out, since a call of a linear algebra library inside a scan costs more than the rest of
    the loop. Positive definite matrices need no pivoting.
    """
    K = len(b)
    rows = jnp.concatenate([A, b[:, None]], axis=1)
    for i in range(K):
        pivot = rows[i] / rows[i, i]
        here = (jnp.arange(K) == i)[:, None]
        rows = jnp.where(here, pivot[None], rows - rows[:, i][:, None] * pivot[None])
    return rows[:, K]
