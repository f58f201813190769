"""Least mean squares: one step down the gradient of the newest squared error."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from rotflex_jax.adaptive.filter import AdaptiveFilter, Weights
from rotflex_jax.adaptive.ranges import Number, PerWeight, per_weight, within
from rotflex_jax.adaptive.sums import tree_sum


class LMS(AdaptiveFilter):
    """Least mean squares, with one step size or one for every weight.

        e = y - w phi,    w <- (1 - mu leakage) w + mu e conj(phi)

    There is no factor 2: a step is `-mu / 2` times the gradient of `|e|^2`. For complex data the
    gradient is Wirtinger's, of `e conj(e)` with `y_hat = w phi` (no conjugate in the product), whose
    steepest descent has the conjugate of `phi`; on real data it is the same rule.

    A Volterra series wants a step size per degree (`Volterra.step_sizes`), as powers of the input
    differ in size. Not for strongly correlated regressors: their slowest direction takes longer than
    the fastest by the condition number. Use `RLS`, or orthogonalise first.

    Args:
        mu: step size, one or one per weight (P,) [1 / regressor^2].
        leakage: pull of the weights towards zero, like a ridge per sample [regressor^2].

    Source: Widrow and Hoff 1960; Haykin, Adaptive Filter Theory, 4th ed. 2002, chapter 5.

    >>> import numpy as np
    >>> from rotflex_jax.adaptive import run
    >>> run(LMS(mu=0.5), np.ones((3, 1)), np.ones(3)).errors
    array([1.  , 0.5 , 0.25])
    """

    mu: PerWeight
    leakage: Number = 0.0

    def __check_init__(self) -> None:
        within("mu", self.mu, 0, float("inf"))
        within("leakage", self.leakage, 0, float("inf"))

    def init(self, size: int, dtype: Any) -> Weights:
        """All weights zero."""
        return Weights(jnp.zeros(size, dtype))

    def step(self, state: Weights, phi: Array, y: Array) -> tuple[Weights, Array]:
        """One step."""
        mu = per_weight("mu", self.mu, len(phi), phi.dtype)
        leakage = jnp.asarray(self.leakage).astype(phi.dtype)
        e = y - tree_sum(state.w * phi)
        return Weights(state.w - (mu * leakage) * state.w + (mu * e) * jnp.conj(phi)), e
