"""Kalman filter for weights on a random walk, whose variance per sample is given."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rotflex_jax.adaptive.filter import (
    AdaptiveFilter,
    Number,
    PerWeight,
    per_weight,
    real_data,
    times,
    within,
)


class KalmanState(NamedTuple):
    """Mean and covariance of the weights, as expected before the next sample."""

    w: Float[Array, " P"]
    P: Float[Array, "P P"]


class Kalman(AdaptiveFilter):
    """Kalman filter for weights on a random walk.

        w[k+1] = w[k] + N(0, q),    y[k] = w[k] phi[k] + N(0, r)

    With `q = 0` and `r = 1` it is RLS without forgetting and `p0` is its `delta`. Unlike forgetting,
    `q` lets P grow by a fixed amount per sample, so that a quiet input does no quick harm. The state
    holds the covariance of the weights, in their units if `r` and `q` are.

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
        return KalmanState(jnp.zeros(size, dtype), jnp.diag(per_weight("p0", self.p0, size, dtype)))

    def step(
        self, state: KalmanState, phi: Float[Array, " P"], y: Float[Array, ""]
    ) -> tuple[KalmanState, Float[Array, ""]]:
        """Correction by the sample, then the prediction for the next one."""
        w, P = state
        e = y - jnp.sum(w * phi)
        v = times(P, phi)
        g = v / (self.r + jnp.sum(v * phi))
        # (I - g phi') P (I - g phi')' + g r g', one factor after the other.
        P = P - g[:, None] * v[None, :]
        P = P - times(P, phi)[:, None] * g[None, :] + (self.r * g)[:, None] * g[None, :]
        P = (P + P.T) / 2
        return KalmanState(w + g * e, P + jnp.diag(per_weight("q", self.q, len(w), P.dtype))), e
