"""Recursive least squares, and the Kalman filter for weights on a random walk."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rotflex_jax.adaptive.filter import (
    AdaptiveFilter,
    Number,
    PerWeight,
    one_number,
    per_weight,
    real_data,
    times,
    tree_sum,
    within,
)


def potter_update(
    S: Float[Array, "P P"], phi: Float[Array, " P"], lam: Number, gamma: Number
) -> tuple[Float[Array, "P P"], Float[Array, " P"], Float[Array, ""]]:
    """Potter's update of `P = S S'`, the inverse of `R <- lam R + gamma phi phi'`.

        v = S' phi,  a = lam / gamma + v'v,  g = S v / a,
        S <- (S - g v' / (1 + sqrt(lam / (gamma a)))) / sqrt(lam)

    P stays positive despite rounding, and S needs half as many digits as P: compared with extended precision,
    the errors of RLS are a thousand times smaller than with a recursion for P.

    Args:
        S: square root of P, of any form.
        phi: regressor.
        lam: forgetting factor.
        gamma: weight of the sample.

    Returns:
        The new root, the gain `g` of the correction `w + g e` with the a-priori error e, and `lam / a`,
        which is gamma times the a-posteriori error over e.
    """
    r = lam / gamma
    v = times(phi, S)
    a = r + tree_sum(v * v)
    g = times(S, v) / a
    share = 1 / (1 + jnp.sqrt(r / a))
    return (S - (share * g)[:, None] * v[None, :]) / jnp.sqrt(lam), g, jnp.divide(lam, a)


class SquareRootState(NamedTuple):
    """Weights, and a square root S of the inverse `P = S S'` of the Gram matrix of the regressors so far."""

    w: Float[Array, " P"]
    S: Float[Array, "P P"]


class RLS(AdaptiveFilter):
    """Recursive least squares with exponential forgetting.

        g = P phi / (lam + phi' P phi),    w <- w + g e,    P <- (P - g phi' P) / lam

    After n samples `w` minimises `sum lam^(n-k) e_k^2 + lam^n sum_i w_i^2 / delta_i`: with `lam = 1` it
    is ridge regression with ridge `1 / delta`. With forgetting, about the last `1 / (1 - lam)` samples count.

    The state holds a square root of P, so that P is symmetric and positive despite rounding: a large `delta`
    costs no accuracy, and float32 is sufficient.

    Not with `lam < 1` for an input that becomes small: directions that are not excited are forgotten, and P
    grows without bound. One step needs of the order of P^2 operations; LMS needs P.

    Args:
        lam: forgetting factor, above 0 and at most 1 [-].
        delta: the start `P = delta I`, one or one per weight (P,) [1 / regressor^2]. With a large value the
            zero weights at the start carry no information.

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

    def init(self, size: int, dtype: Any) -> SquareRootState:
        """All weights zero, as uncertain as `delta` says."""
        real_data("RLS", dtype)
        one_number("lam", self.lam)
        spread = jnp.sqrt(per_weight("delta", self.delta, size, dtype))
        return SquareRootState(jnp.zeros(size, dtype), jnp.diag(spread))

    def step(
        self, state: SquareRootState, phi: Float[Array, " P"], y: Float[Array, ""]
    ) -> tuple[SquareRootState, Float[Array, ""]]:
        """One step."""
        e = y - tree_sum(state.w * phi)
        S, g, _ = potter_update(state.S, phi, self.lam, 1.0)
        return SquareRootState(state.w + g * e, S), e


class KalmanState(NamedTuple):
    """Mean and covariance of the weights, as expected before the next sample."""

    w: Float[Array, " P"]
    P: Float[Array, "P P"]


class Kalman(AdaptiveFilter):
    """Kalman filter for weights on a random walk.

        w[k+1] = w[k] + N(0, q),    y[k] = w[k] phi[k] + N(0, r)

    With `q = 0` and `r = 1` it is RLS without forgetting, and `p0` is its `delta`. In contrast to forgetting,
    `q` increases P by a fixed amount per sample, so that a short time of small input does no harm. The state
    holds the covariance of the weights, in their units if `r` and `q` have their units.

    Not in float32 with a large `p0`: P is updated in Joseph's form, which keeps it symmetric and
    positive in float64, but a start a million times above `r` needs more digits than float32 has.

    Args:
        q: variance of the change of every weight per sample, one or one per weight (P,) [weight^2].
        r: variance of the noise of the output [output^2].
        p0: variance of the weights before the first sample, one or one per weight (P,) [weight^2].

    Source: Haykin, Adaptive Filter Theory, 4th ed. 2002, chapter 10; Bucy and Joseph 1968.
    """

    q: PerWeight = 0.0
    r: Number = 1.0
    p0: PerWeight = 1e6

    def __check_init__(self) -> None:
        within("q", self.q, 0, float("inf"))
        within("r", self.r, 0, float("inf"), open_low=True)
        within("p0", self.p0, 0, float("inf"))

    def init(self, size: int, dtype: Any) -> KalmanState:
        """All weights zero, with the variance `p0`."""
        real_data("Kalman", dtype)
        one_number("r", self.r)
        return KalmanState(jnp.zeros(size, dtype), jnp.diag(per_weight("p0", self.p0, size, dtype)))

    def step(
        self, state: KalmanState, phi: Float[Array, " P"], y: Float[Array, ""]
    ) -> tuple[KalmanState, Float[Array, ""]]:
        """Correction by the sample, then the prediction for the next one."""
        w, P = state
        e = y - jnp.sum(w * phi)
        v = times(P, phi)
        g = v / (self.r + jnp.sum(v * phi))
        # (I - g phi') P (I - g phi')' + g r g', multiplied one factor after the other.
        P = P - g[:, None] * v[None, :]
        P = P - times(P, phi)[:, None] * g[None, :] + (self.r * g)[:, None] * g[None, :]
        P = (P + P.T) / 2
        return KalmanState(w + g * e, P + jnp.diag(per_weight("q", self.q, len(w), P.dtype))), e
