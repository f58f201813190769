"""Normalised least mean squares: the step is measured in the power of the regressor."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.adaptive.filter import AdaptiveFilter, Weights
from rotflex_jax.adaptive.ranges import Number, within
from rotflex_jax.adaptive.sums import tree_sum
from rotflex_jax.errors import InputError


class NLMS(AdaptiveFilter):
    """Normalised least mean squares.

        w <- w + mu e conj(phi) / (eps + |phi|^2)

    Stable for `0 < mu < 2` whatever the size of the input. Not where the model is incomplete and the
    least squares answer is wanted: weighing samples by `1 / (eps + |phi|^2)` moves the point where
    the weights come to rest, however small the step (`fixed_point`). That point belongs to quiet
    samples; with the squares of a Volterra series among the regressors it can be far off.

    Args:
        mu: step size [-].
        eps: keeps the step finite at a zero input [regressor^2].

    Source: Nagumo and Noda 1967; Haykin, Adaptive Filter Theory, 4th ed. 2002, chapter 6.
    """

    mu: Number = 0.5
    eps: Number = 1e-3

    def __check_init__(self) -> None:
        within("mu", self.mu, 0, float("inf"))
        within("eps", self.eps, 0, float("inf"), open_low=True)

    def init(self, size: int, dtype: Any) -> Weights:
        """All weights zero."""
        return Weights(jnp.zeros(size, dtype))

    def step(self, state: Weights, phi: Array, y: Array) -> tuple[Weights, Array]:
        """One step."""
        mu, eps = (jnp.asarray(x).astype(phi.dtype) for x in (self.mu, self.eps))
        e = y - tree_sum(state.w * phi)
        power = tree_sum(phi * jnp.conj(phi))
        return Weights(state.w + (mu * e / (eps + power)) * jnp.conj(phi)), e


def fixed_point(
    phi: Float[np.ndarray, "N P"], y: Float[np.ndarray, " N"], eps: float = 1e-3
) -> Float[np.ndarray, " P"]:
    """Weights around which NLMS with a small step comes to rest.

        sum_k e_k phi_k / (eps + |phi_k|^2) = 0

    This is least squares with the weight `1 / (eps + |phi|^2)` on every sample. It equals ordinary
    least squares where the model is complete (e is then unrelated to phi), and differs where it is not.

    Args:
        phi: regressors.
        y: measured output.
        eps: of the filter [regressor^2].

    Raises:
        InputError: shapes that do not fit, or `eps` not positive.

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
    root = 1 / np.sqrt(eps + np.sum(phi**2, axis=1))
    return np.linalg.lstsq(phi * root[:, None], y * root, rcond=None)[0]
