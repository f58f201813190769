"""Recursive least squares: the exact minimiser of all past squared errors, after every sample."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rotflex_jax.adaptive.filter import AdaptiveFilter
from rotflex_jax.adaptive.ranges import Number, PerWeight, per_weight, real_data, within
from rotflex_jax.adaptive.root import correct
from rotflex_jax.adaptive.sums import tree_sum


class Root(NamedTuple):
    """Weights, and a square root S of the inverse `P = S S'` of the Gram matrix of the regressors so far."""

    w: Float[Array, " P"]
    S: Float[Array, "P P"]


class RLS(AdaptiveFilter):
    """Recursive least squares with exponential forgetting.

        g = P phi / (lam + phi' P phi),    w <- w + g e,    P <- (P - g phi' P) / lam

    After n samples `w` minimises `sum lam^(n-k) e_k^2 + lam^n sum_i w_i^2 / delta_i`: with `lam = 1` it
    is ridge regression with ridge `1 / delta`. Forgetting means the last `1 / (1 - lam)` samples or so.

    It carries a square root of P, which therefore is symmetric and positive whatever the rounding:
    a large `delta` costs no accuracy, and float32 will do.

    Not with `lam < 1` on an input that goes quiet: what is not excited is forgotten, and P grows
    without bound. One step costs of the order of P^2 operations; LMS costs P.

    Args:
        lam: forgetting factor, above 0 and at most 1 [-].
        delta: the start `P = delta I`, one or one per weight (P,) [1 / regressor^2]. Large means that
            zero weights are no information.

    Source: Haykin, Adaptive Filter Theory, 4th ed. 2002, chapter 9; square root: Potter 1963, in Bierman,
    Factorization Methods for Discrete Sequential Estimation, 1977.

    >>> import numpy as np
    >>> from rotflex_jax.adaptive import run
    >>> phi = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    >>> run(RLS(delta=1e9), phi, phi @ [3.0, -1.0]).weights.round(6)
    array([ 3., -1.])
    """

    lam: Number = 1.0
    delta: PerWeight = 1e6

    def __check_init__(self) -> None:
        within("lam", self.lam, 0, 1, open_low=True)
        within("delta", self.delta, 0, float("inf"), open_low=True)

    def init(self, size: int, dtype: Any) -> Root:
        """All weights zero, as uncertain as `delta` says."""
        real_data("RLS", dtype)
        spread = jnp.sqrt(per_weight("delta", self.delta, size, dtype))
        return Root(jnp.zeros(size, dtype), jnp.diag(spread))

    def step(self, state: Root, phi: Array, y: Array) -> tuple[Root, Array]:
        """One step."""
        e = y - tree_sum(state.w * phi)
        S, g, _ = correct(state.S, phi, self.lam, 1.0)
        return Root(state.w + g * e, S), e
