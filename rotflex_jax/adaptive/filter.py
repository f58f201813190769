"""Base class of adaptive filters, checks of their arguments, and the loop that runs any filter."""

import abc
from typing import Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Inexact, Real, Shaped

from rotflex_jax.checks import all_finite, as_array, shown
from rotflex_jax.errors import InputError


def tree_sum(p: Inexact[Array, "P *batch"]) -> Inexact[Array, "*batch"]:
    """Pairwise sum over the first axis.

    In a sum term by term every addition waits for the previous one, which for about twenty weights takes
    longer than the rest of a filter's step. A pairwise sum has log2(P) additions in a row, and its rounding
    error is smaller.

    Source: Higham 1993, SIAM J. Sci. Comput. 14, section 3 (pairwise summation).

    >>> float(tree_sum(jnp.arange(7.0)))
    21.0
    """
    while len(p) > 1:
        half = len(p) // 2
        paired = p[:half] + p[half : 2 * half]
        p = jnp.concatenate([paired, p[2 * half :]]) if len(p) % 2 else paired
    return p[0]


def times(a: Inexact[Array, "..."], b: Inexact[Array, "..."]) -> Inexact[Array, "..."]:
    """Matrix product in full precision, also on devices that round the factors by default."""
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


# A setting of a filter: one value, or one for each weight, with further axes in a batch of filters (`vmap`).
Number = float | Float[Array, "..."] | Float[np.ndarray, "..."]
PerWeight = Number


def within(name: str, value: Any, low: float, high: float, *, open_low: bool = False) -> None:
    """Refuses a setting out of its range; a value that is traced by JAX is not checked.

    Args:
        name: name of the argument.
        value: a number or an array of numbers.
        low: smallest value.
        high: largest value, which may be infinite.
        open_low: whether `low` itself is excluded.

    Raises:
        InputError: the value is out of the range.

    >>> within("lam", 1.2, 0, 1, open_low=True)
    Traceback (most recent call last):
        ...
    rotflex_jax.errors.InputError: Argument `lam` must lie above 0 and not above 1, but is 1.2; \
choose a value in this range.
    """
    if isinstance(value, Tracer):
        return
    numbers = as_array(value)
    if numbers.dtype.kind not in "iuf":
        raise InputError(
            f"Argument `{name}` must be a number or an array of numbers, but is {shown(value)}; give numbers."
        )
    good = (numbers > low if open_low else numbers >= low) & (numbers <= high) & np.isfinite(numbers)
    if not np.all(good):
        worst = np.ravel(numbers)[np.argmin(np.ravel(good))]
        lower = f"above {low:g}" if open_low else f"at or above {low:g}"
        upper = f" and not above {high:g}" if np.isfinite(high) else " and be finite"
        raise InputError(
            f"Argument `{name}` must lie {lower}{upper}, but is {worst:g}; choose a value in this range."
        )


def count(name: str, value: Any) -> None:
    """Refuses a value that is not a whole number of at least 1.

    Raises:
        InputError: the value is not a whole number, or is below 1.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise InputError(f"Argument `{name}` must be a whole number from 1, but is {value!r}; give one.")


def real_data(filter: str, dtype: Any) -> None:
    """Refuses complex data for a filter that is defined for real data only.

    Raises:
        InputError: the data are complex.
    """
    if np.issubdtype(dtype, np.complexfloating):
        raise InputError(
            f"{filter} works on real data, but the data are {np.dtype(dtype).name}; "
            "use LMS or NLMS, or give real and imaginary parts as regressors of their own."
        )


def per_weight(name: str, value: Any, size: int, dtype: Any) -> Inexact[Array, " {size}"]:
    """A setting as one value per weight.

    Args:
        name: name of the argument.
        value: one number, or one per weight.
        size: number of weights.
        dtype: dtype of the data.

    Raises:
        InputError: the value is neither one number nor one number per weight.
    """
    array = jnp.asarray(value).astype(dtype)
    if array.shape not in ((), (size,)):
        raise InputError(
            f"Argument `{name}` must be one number or one for each of the {size} weights, but has the "
            f"shape {array.shape}; give {size} numbers."
        )
    return jnp.broadcast_to(array, (size,))


def one_number(name: str, value: Any) -> None:
    """Refuses a setting that has a value for each weight where the filter has one for all.

    Raises:
        InputError: the value is not one number.
    """
    if np.ndim(value):
        raise InputError(
            f"Argument `{name}` must be one number, but has the shape {np.shape(value)}; give one for all "
            "weights."
        )


class Weights(NamedTuple):
    """State of a filter that stores nothing but its weights."""

    w: Inexact[Array, " P"]


class AdaptiveFilter(eqx.Module):
    """A rule that corrects the weights of `y_hat = w phi` after every sample.

    A filter is a pytree whose settings (step sizes, forgetting factors) are leaves: they may be traced,
    batched with `vmap` and differentiated, and new values need no compilation. Settings that determine the
    shape of the state (a window, a memory) are static.
    """

    # Whether `phi` is the input (N,), from which the filter forms its regressors itself.
    from_input: ClassVar[bool] = False

    @abc.abstractmethod
    def init(self, size: int, dtype: Any) -> Any:
        """State before the first sample, for `size` regressors of the given dtype."""

    @abc.abstractmethod
    def step(
        self, state: Any, phi: Inexact[Array, "*P"], y: Inexact[Array, ""]
    ) -> tuple[Any, Inexact[Array, ""]]:
        """The state after a sample, and the a-priori error `e = y - w phi` with the weights before it."""

    def weights(self, state: Any) -> Inexact[Array, " P"]:
        """Weights of a state."""
        return state.w


F = TypeVar("F", bound=AdaptiveFilter)


def in_dtype(filter: F, dtype: Any) -> F:
    """The filter with its settings in the (real) precision of the data."""
    real = jnp.finfo(dtype).dtype
    return jax.tree.map(lambda leaf: jnp.asarray(leaf).astype(real), filter)


def scan(
    filter: AdaptiveFilter, phi: Inexact[Array, "N *P"], y: Inexact[Array, " N"], state: Any = None
) -> tuple[Any, Inexact[Array, " N"]]:
    """The loop over samples alone, in JAX: final state and a-priori errors.

    It is made for transformations: apply `vmap` over filters with batched settings, or differentiate it with
    `jvp` or `jacfwd`. Forward mode is preferable, since there are few settings and many samples. Divergence
    is not detected, and errors then grow to infinity. For one run on arrays use `run`.

    Args:
        filter: filter whose settings may be traced.
        phi: regressors (N, P), or the input (N,) for a filter that makes its own regressors.
        y: measured output, of the dtype of `phi`.
        state: state with which the loop starts; the filter's initial state if None.
    """
    phi, y = jnp.asarray(phi), jnp.asarray(y)
    filter = in_dtype(filter, phi.dtype)
    if state is None:
        state = filter.init(regressor_size(phi), phi.dtype)
    return jax.lax.scan(lambda s, sample: filter.step(s, *sample), state, (phi, y))


def regressor_size(phi: Inexact[Array, "N *P"] | Inexact[np.ndarray, "N *P"]) -> int:
    """Number of regressors per sample."""
    return phi.shape[1] if phi.ndim == 2 else 1


def as_samples(
    filter: AdaptiveFilter, phi: Any, y: Any
) -> tuple[Inexact[np.ndarray, "N *P"], Inexact[np.ndarray, " N"]]:
    """`phi` and `y` as finite arrays of one floating dtype, with checked shapes."""
    phi, y = np.asarray(phi), np.asarray(y)
    dimensions, wanted, advice = (
        (1, "(N,)", "the input itself") if filter.from_input else (2, "(N, P)", "a row of regressors")
    )
    if phi.ndim != dimensions or y.shape != phi.shape[:1] or not phi.size:
        raise InputError(
            f"Arguments `phi` and `y` of {type(filter).__name__} must have the shapes {wanted} and (N,), "
            f"but have {phi.shape} and {y.shape}; give {advice} for every output sample."
        )
    return finite(phi, y)


def finite(
    phi: Shaped[np.ndarray, "N *P"], y: Shaped[np.ndarray, " N"]
) -> tuple[Inexact[np.ndarray, "N *P"], Inexact[np.ndarray, " N"]]:
    """`phi` and `y` in the higher of their precisions, after a check that they are finite."""
    named = (("phi", phi), ("y", y))
    for name, x in named:
        if x.dtype.kind not in "iufc":
            raise InputError(
                f"Argument `{name}` must hold numbers, but holds {x.dtype.name}; convert it first."
            )
        if not all_finite(x):
            k = int(np.argmin(np.isfinite(x).reshape(len(x), -1).all(axis=1)))
            raise InputError(
                f"Argument `{name}` must be finite, but is not at sample {k}; cut or repair the data."
            )
    floats = [x.dtype for _, x in named if x.dtype.kind in "fc"]
    dtype = np.result_type(*floats, np.float32) if floats else np.dtype(np.float64)
    return phi.astype(dtype, copy=False), y.astype(dtype, copy=False)


def stretch(u: Real[np.ndarray, " N"], start: int, stop: int) -> Real[np.ndarray, " {stop-start}"]:
    """Part of an input, with zeros before its first sample; not copied if it lies inside the input."""
    part = u[max(0, start) : max(0, stop)]
    missing = stop - start - len(part)
    return np.concatenate([np.zeros(missing, u.dtype), part]) if missing else part
