"""Least mean squares and its relatives: normalised LMS and affine projection."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact

from rotflex_jax.adaptive.filter import (
    AdaptiveFilter,
    Number,
    PerWeight,
    Weights,
    count,
    finite,
    one_number,
    per_weight,
    real_data,
    times,
    tree_sum,
    within,
)
from rotflex_jax.errors import InputError


class LMS(AdaptiveFilter):
    """Least mean squares, with one step size or one for every weight.

        e = y - w phi,    w <- (1 - mu leakage) w + mu e conj(phi)

    There is no factor 2: a step is `-mu / 2` times the gradient of `|e|^2`. For complex data the gradient is
    the Wirtinger gradient of `e conj(e)` with `y_hat = w phi` (no conjugate in the product), whose steepest
    descent has the conjugate of `phi`. For real data the rule is the same.

    A Volterra series needs a step size per degree (`Volterra.step_sizes`), since powers of the input differ
    in size. Not for strongly correlated regressors: the slowest direction takes longer than the fastest by
    the condition number. Use `RLS`, or orthogonalise the regressors first.

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
        per_weight("leakage", self.leakage, size, dtype)
        return Weights(jnp.zeros(size, dtype))

    def step(
        self, state: Weights, phi: Inexact[Array, " P"], y: Inexact[Array, ""]
    ) -> tuple[Weights, Inexact[Array, ""]]:
        """One step."""
        mu = per_weight("mu", self.mu, len(phi), phi.dtype)
        leakage = jnp.asarray(self.leakage).astype(phi.dtype)
        e = y - tree_sum(state.w * phi)
        return Weights(state.w - (mu * leakage) * state.w + (mu * e) * jnp.conj(phi)), e


class NLMS(AdaptiveFilter):
    """Normalised least mean squares.

        w <- w + mu e conj(phi) / (eps + |phi|^2)

    Stable for `0 < mu < 2` whatever the size of the input. Not for an incomplete model from which the least
    squares solution is expected: the weights `1 / (eps + |phi|^2)` of the samples move the point to which the
    filter converges, however small the step (`fixed_point`). Samples with a small input dominate this point.
    With the squares of a Volterra series among the regressors it can be far from least squares.

    Args:
        mu: step size [-].
        eps: constant that keeps the step finite at zero input [regressor^2].

    Source: Nagumo and Noda 1967; Haykin, Adaptive Filter Theory, 4th ed. 2002, chapter 6.
    """

    mu: Number = 0.5
    eps: Number = 1e-3

    def __check_init__(self) -> None:
        within("mu", self.mu, 0, float("inf"))
        within("eps", self.eps, 0, float("inf"), open_low=True)

    def init(self, size: int, dtype: Any) -> Weights:
        """All weights zero."""
        per_weight("mu", self.mu, size, dtype)
        one_number("eps", self.eps)
        return Weights(jnp.zeros(size, dtype))

    def step(
        self, state: Weights, phi: Inexact[Array, " P"], y: Inexact[Array, ""]
    ) -> tuple[Weights, Inexact[Array, ""]]:
        """One step."""
        mu, eps = (jnp.asarray(x).astype(phi.dtype) for x in (self.mu, self.eps))
        e = y - tree_sum(state.w * phi)
        power = tree_sum(phi * jnp.conj(phi))
        return Weights(state.w + (mu * e / (eps + power)) * jnp.conj(phi)), e


def fixed_point(
    phi: Float[np.ndarray, "N P"], y: Float[np.ndarray, " N"], eps: float = 1e-3
) -> Float[np.ndarray, " P"]:
    """Weights to which NLMS converges with a small step.

        sum_k e_k phi_k / (eps + |phi_k|^2) = 0

    This is least squares with the weight `1 / (eps + |phi|^2)` for every sample. It agrees with ordinary
    least squares if the model is complete (e is then independent of phi), and differs otherwise.

    Args:
        phi: regressors.
        y: measured output.
        eps: constant `eps` of the filter [regressor^2].

    Raises:
        InputError: shapes do not fit, numbers are not finite, or `eps` is not positive.

    >>> phi = np.array([[1.0], [2.0], [3.0]])
    >>> fixed_point(phi, 2 * phi[:, 0]).round(6)
    array([2.])
    """
    within("eps", eps, 0, float("inf"), open_low=True)
    phi, y = np.asarray(phi, float), np.asarray(y, float)
    if phi.ndim != 2 or y.shape != phi.shape[:1] or not phi.size:
        raise InputError(
            f"Arguments `phi` and `y` must have the shapes (N, P) and (N,), but have {phi.shape} and "
            f"{y.shape}; give one row of regressors per output sample."
        )
    phi, y = finite(phi, y)
    root = 1 / np.sqrt(eps + np.sum(phi**2, axis=1))
    return np.linalg.lstsq(phi * root[:, None], y * root, rcond=None)[0]


class WindowState(NamedTuple):
    """Weights, the last K samples, newest first, and the products of their regressors."""

    w: Float[Array, " P"]
    phi: Float[Array, "K P"]
    y: Float[Array, " K"]
    gram: Float[Array, "K K"]


class AffineProjection(AdaptiveFilter):
    """Affine projection over a window of K samples.

        w <- w + mu X' (eps I + X X')^-1 (y - X w),    X = the last K regressors as rows

    With K = 1 it is NLMS. The errors over the window vanish as `mu` approaches 1. The filter removes a part
    of the correlation of the input, with about 3 K P operations per sample. Not for noisy records: the noise
    of K samples is projected too. Like NLMS it does not converge to least squares if the model is incomplete.

    Args:
        mu: step size, stable below 2 [-].
        eps: constant that keeps the inverse finite [regressor^2].
        window: number of samples K.

    Source: Ozeki and Umeda 1984; Haykin, Adaptive Filter Theory, 4th ed. 2002, chapter 6.
    """

    mu: Number = 0.5
    eps: Number = 1e-3
    window: int = eqx.field(static=True, default=4)

    def __check_init__(self) -> None:
        within("mu", self.mu, 0, float("inf"))
        within("eps", self.eps, 0, float("inf"), open_low=True)
        count("window", self.window)

    def init(self, size: int, dtype: Any) -> WindowState:
        """All weights zero, after silence."""
        real_data("AffineProjection", dtype)
        per_weight("mu", self.mu, size, dtype)
        one_number("eps", self.eps)
        K = self.window
        zeros = lambda *shape: jnp.zeros(shape, dtype)  # noqa: E731
        return WindowState(zeros(size), zeros(K, size), zeros(K), zeros(K, K))

    def step(
        self, state: WindowState, phi: Float[Array, " P"], y: Float[Array, ""]
    ) -> tuple[WindowState, Float[Array, ""]]:
        """One step."""
        X = jnp.concatenate([phi[None], state.phi[:-1]])
        target = jnp.concatenate([y[None], state.y[:-1]])
        e = target - times(X, state.w)
        # Only products with the newest regressor are computed. The others are shifted, so that rounding
        # errors do not accumulate.
        new = times(X, phi)
        gram = jnp.concatenate([new[:, None], jnp.concatenate([new[None, 1:], state.gram[:-1, :-1]])], axis=1)
        z = solve(gram + self.eps * jnp.eye(self.window, dtype=phi.dtype), e)
        return WindowState(state.w + self.mu * times(z, X), X, target, gram), e[0]


def solve(A: Float[Array, "K K"], b: Float[Array, " K"]) -> Float[Array, " K"]:
    """The solution of `A x = b` for a small positive definite A, by elimination.

    The elimination is written out, since a call of a linear algebra library inside a scan takes longer than
    the rest of the loop. Positive definite matrices need no pivoting.
    """
    K = len(b)
    rows = jnp.concatenate([A, b[:, None]], axis=1)
    for i in range(K):
        pivot = rows[i] / rows[i, i]
        here = (jnp.arange(K) == i)[:, None]
        rows = jnp.where(here, pivot[None], rows - rows[:, i][:, None] * pivot[None])
    return rows[:, K]
