"""What an adaptive filter is, and the one loop that runs any of them over data."""

import abc
from typing import Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact


class Weights(NamedTuple):
    """The state of a filter that remembers nothing but its weights."""

    w: Inexact[Array, " P"]


class AdaptiveFilter(eqx.Module):
    """A rule that corrects the weights of `y_hat = w phi` after every sample.

    A filter is a pytree whose settings (step sizes, forgetting factors) are leaves: they may be traced,
    batched with `vmap` and differentiated, and new values compile nothing new. What decides the shape
    of its state (a window, a memory) is static.
    """

    # Whether `phi` is the input (N,), of which the filter makes its regressors itself.
    from_input: ClassVar[bool] = False

    @abc.abstractmethod
    def init(self, size: int, dtype: Any) -> Any:
        """State before the first sample, for regressors (`size`,) of the given dtype."""

    @abc.abstractmethod
    def step(self, state: Any, phi: Array, y: Array) -> tuple[Any, Array]:
        """The state after a sample, and its a-priori error `e = y - w phi`, with the weights before it."""

    def weights(self, state: Any) -> Array:
        """Weights (P,) that a state stands for."""
        return state.w


F = TypeVar("F", bound=AdaptiveFilter)


def in_dtype(filter: F, dtype: Any) -> F:
    """The filter with its settings in the (real) precision of the data."""
    real = jnp.finfo(dtype).dtype
    return jax.tree.map(lambda leaf: jnp.asarray(leaf).astype(real), filter)


def scan(filter: AdaptiveFilter, phi: Array, y: Array, state: Any = None) -> tuple[Any, Array]:
    """The bare loop in JAX: final state and a-priori errors (N,).

    Made to be transformed: `vmap` it over filters with batched settings, differentiate it with `jvp`
    or `jacfwd`. Forward mode is the right one, as settings are few and samples many. It does not look
    for divergence; errors then grow to infinity. For one run on arrays use `run`.

    Args:
        filter: its settings may be traced.
        phi: regressors (N, P), or the input (N,) for a filter that makes its own.
        y: measured output (N,), of the dtype of `phi`.
        state: where to go on from; the filter's start if None.
    """
    phi, y = jnp.asarray(phi), jnp.asarray(y)
    filter = in_dtype(filter, phi.dtype)
    if state is None:
        state = filter.init(regressor_size(phi), phi.dtype)
    return jax.lax.scan(lambda s, sample: filter.step(s, *sample), state, (phi, y))


def regressor_size(phi: Array | np.ndarray) -> int:
    """Regressors per sample."""
    return phi.shape[1] if phi.ndim == 2 else 1
