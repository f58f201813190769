"""What the settings of a filter may be, checked where their values are known."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from rotflex_jax.errors import InputError

# A setting of a filter: one number, or one number for each weight.
Number = float | Float[Array, ""] | Float[np.ndarray, ""]
PerWeight = float | Float[Array, " P"] | Float[np.ndarray, " P"]


def within(name: str, value: Any, low: float, high: float, *, open_low: bool = False) -> None:
    """Refuses a setting out of its range; a value that JAX only traces is let through.

    Args:
        name: of the argument.
        value: a number or an array of them.
        low: smallest value.
        high: largest value, which may be infinite.
        open_low: whether `low` itself is out.

    Raises:
        InputError: with the offending value and the range.

    >>> within("lam", 1.2, 0, 1, open_low=True)
    Traceback (most recent call last):
        ...
    rotflex_jax.errors.InputError: Argument `lam` must lie above 0 and not above 1, but is 1.2; \
choose a value in this range.
    """
    if isinstance(value, Tracer):
        return
    try:
        numbers = np.asarray(value, float)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"Argument `{name}` must be a number or an array of numbers, but is {value!r}; give numbers."
        ) from error
    good = (numbers > low if open_low else numbers >= low) & (numbers <= high) & np.isfinite(numbers)
    if not np.all(good):
        worst = np.ravel(numbers)[np.argmin(np.ravel(good))]
        lower = f"above {low:g}" if open_low else f"at or above {low:g}"
        upper = f" and not above {high:g}" if np.isfinite(high) else " and be finite"
        raise InputError(
            f"Argument `{name}` must lie {lower}{upper}, but is {worst:g}; choose a value in this range."
        )


def count(name: str, value: Any) -> None:
    """Refuses what is not a whole number from 1.

    Raises:
        InputError: with what was given.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise InputError(f"Argument `{name}` must be a whole number from 1, but is {value!r}; give one.")


def real_data(filter: str, dtype: Any) -> None:
    """Refuses complex data for a filter that is not made for them.

    Raises:
        InputError: with the name of the filter.
    """
    if np.issubdtype(dtype, np.complexfloating):
        raise InputError(
            f"{filter} works on real data, but the data are {np.dtype(dtype).name}; "
            "use LMS or NLMS, or give real and imaginary parts as regressors of their own."
        )


def per_weight(name: str, value: Any, size: int, dtype: Any) -> Float[Array, " P"]:
    """A setting as one number per weight.

    Args:
        name: of the argument.
        value: one number, or one per weight.
        size: number of weights.
        dtype: of the data.

    Raises:
        InputError: neither one number nor one per weight.
    """
    array = jnp.asarray(value).astype(dtype)
    if array.shape not in ((), (size,)):
        raise InputError(
            f"Argument `{name}` must be one number or one for each of the {size} weights, but has the "
            f"shape {array.shape}; give {size} numbers."
        )
    return jnp.broadcast_to(array, (size,))
