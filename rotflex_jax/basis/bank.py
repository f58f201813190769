"""What a basis is: a signal goes in, one named regressor per column comes out.

A bank is linear: delays, or orthonormal filters. A basis is what weights stand in front of: the
monomials of a bank's outputs, as they are or orthogonalised.
"""

import abc
from collections.abc import Mapping
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rotflex_jax.errors import InputError
from rotflex_jax.precision import working_precision


class Traced(Protocol):
    """A pytree that turns a signal into columns, inside of traced code too."""

    def respond(self, u: Float[Array, " N"]) -> Float[Array, "N P"]:
        """Columns for a signal, in its dtype; causal, nothing before the first sample."""
        ...


class Bank(eqx.Module):
    """Turns a signal into linear regressors: what a bank of one's own derives from."""

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """Number of columns."""

    @property
    @abc.abstractmethod
    def names(self) -> tuple[str, ...]:
        """Of the columns."""

    @property
    @abc.abstractmethod
    def reach(self) -> int:
        """Samples after which an impulse has left the bank, to a millionth of its size."""

    @abc.abstractmethod
    def respond(self, u: Float[Array, " N"]) -> Float[Array, "N M"]:
        """Columns for a signal, inside of traced code too; causal, nothing before the first sample."""

    def outputs(self, u: Any) -> Float[np.ndarray, "N M"]:
        """Columns for a signal, in its precision.

        Args:
            u: Signal (N,).
        """
        return evaluate(self, u)

    def impulse_responses(self, length: int) -> Float[np.ndarray, "L M"]:
        """Columns for a unit impulse, over so many samples."""
        return self.outputs(impulse(length))


class Basis(Traced, Protocol):
    """Turns a signal into the regressors of a model that is linear in its weights."""

    @property
    def size(self) -> int:
        """Number of regressors."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Of the regressors."""
        ...

    @property
    def degrees(self) -> Int[np.ndarray, " P"]:
        """Degree of each regressor in the input, 0 for a constant."""
        ...

    def regressors(self, u: Any) -> Float[np.ndarray, "N P"]:
        """Regressors for a signal."""
        ...

    def units(self, input_unit: str = "V", output_unit: str = "rad") -> tuple[str, ...]:
        """Of the weights."""
        ...

    def kernels(self, w: Any, length: int | None = None) -> Mapping[int, Any]:
        """Symmetric kernels in the domain of delays, by degree."""
        ...


_respond = jax.jit(lambda part, u: part.respond(u))


def evaluate(part: Traced, u: Any) -> np.ndarray:
    """Columns as an array, in the precision of the signal; compiled once for each shape."""
    u = signal(u)
    with working_precision(u):
        return np.asarray(_respond(part, jnp.asarray(u)))


def require_basis(basis: Any) -> None:
    """Refuses what weights cannot stand in front of.

    Raises:
        InputError: A bank was given, or anything else.
    """
    wanted = ("names", "degrees", "regressors", "units", "kernels")
    # The class is asked first: working out all names takes longer than a filter over a short record.
    if not all(hasattr(type(basis), name) or hasattr(basis, name) for name in wanted):
        raise InputError(
            f"A basis such as Volterra(Delays(5)) is needed, but {type(basis).__name__} was given; wrap a "
            "bank in a Volterra series, of order 1 for a linear model."
        )


def impulse(length: int) -> np.ndarray:
    """A one, then zeros."""
    if isinstance(length, bool) or length != int(length) or length < 1:
        raise InputError(
            f"Argument `length` must be a number of samples from 1, but is {length!r}; give for instance 100."
        )
    return np.eye(1, int(length))[0]


def signal(u: Any, name: str = "u") -> np.ndarray:
    """A signal as an array (N,), float32 where that was given, else float64.

    Raises:
        InputError: More than one column, complex, empty, or not finite.
    """
    u = np.asarray(u)
    if u.dtype.kind not in "iuf" or u.ndim != 1 or not u.size:
        raise InputError(
            f"Argument `{name}` must be real numbers of shape (N,), one per sample, but is "
            f"{u.dtype.name} of shape {u.shape}; give one signal."
        )
    if not all_finite(u):
        k = int(np.argmin(np.isfinite(u)))
        raise InputError(
            f"Argument `{name}` must be finite, but is {u[k]} at sample {k}; cut the signal there."
        )
    return u.astype(np.float32 if u.dtype in (np.float16, np.float32) else np.float64, copy=False)


def all_finite(x: np.ndarray) -> bool:
    """Whether no number is infinite or missing, mostly without an array of answers."""
    with np.errstate(all="ignore"):
        return bool(np.isfinite(np.sum(x)) or np.isfinite(x).all())


def whole(value: Any, name: str, least: int) -> int:
    """A whole number that is not too small.

    >>> whole(2.5, "memory", 1)
    Traceback (most recent call last):
        ...
    rotflex_jax.errors.InputError: Argument `memory` must be a whole number from 1, but is 2.5; \
give for instance 1.
    """
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not number or not np.isfinite(value) or value != int(value) or value < least:
        raise InputError(
            f"Argument `{name}` must be a whole number from {least}, but is {value!r}; "
            f"give for instance {least}."
        )
    return int(value)
