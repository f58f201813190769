"""Interfaces of banks and bases, and the simplest banks: delays, and means over intervals.

A bank is linear: delays, or orthonormal filters. A basis gives the regressors of a model: monomials of the
outputs of a bank, or orthogonal combinations of them.
"""

import abc
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rotflex_jax.checks import signal, whole
from rotflex_jax.errors import InputError
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import working_precision


@runtime_checkable
class Traced(Protocol):
    """A pytree that turns a signal into columns, also in traced code."""

    def respond(self, u: Float[Array, " N"]) -> Float[Array, "N P"]:
        """Columns for a signal, in its dtype; causal, nothing before the first sample."""
        ...


class Bank(eqx.Module):
    """Turns a signal into linear regressors; base class of all banks."""

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """Number of columns."""

    @property
    @abc.abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""

    @property
    @abc.abstractmethod
    def reach(self) -> int:
        """Number of samples after which the impulse response has decayed to a millionth of its size."""

    @abc.abstractmethod
    def respond(self, u: Float[Array, " N"]) -> Float[Array, "N M"]:
        """Columns for a signal, also in traced code; causal, nothing before the first sample."""

    def outputs(self, u: Any) -> Float[np.ndarray, "N M"]:
        """Columns for a signal, in its precision.

        Args:
            u: Signal (N,).
        """
        return evaluate(self, u)

    def impulse_responses(self, length: int) -> Float[np.ndarray, "L M"]:
        """Columns for a unit impulse, over `length` samples."""
        return self.outputs(impulse(length))


@runtime_checkable
class Basis(Traced, Protocol):
    """Turns a signal into the regressors of a model that is linear in its weights."""

    @property
    def size(self) -> int:
        """Number of regressors."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the regressors."""
        ...

    @property
    def degrees(self) -> Int[np.ndarray, " P"]:
        """Degree of each regressor in the input, 0 for a constant."""
        ...

    def regressors(self, u: Any) -> Float[np.ndarray, "N P"]:
        """Regressors for a signal."""
        ...

    def units(self, input_unit: str = "V", output_unit: str = "rad") -> tuple[str, ...]:
        """Units of the weights."""
        ...

    def kernels(self, w: Any, length: int | None = None) -> Mapping[int, Any]:
        """Symmetric kernels in the domain of delays, by degree."""
        ...


@persistent_jit(static=0)
def _respond(part: Traced, u: Float[Array, " N"]) -> Float[Array, "N P"]:
    return part.respond(u)


def evaluate(part: Traced, u: Any) -> Float[np.ndarray, "N P"]:
    """Columns for a signal as an array in the precision of the signal; compiled once for each shape."""
    u = signal(u)
    with working_precision(u):
        return np.asarray(_respond(part, jnp.asarray(u)))


def require_basis(basis: Any) -> None:
    """Refuses an argument that is no basis.

    Raises:
        InputError: A bank was given, or anything else that is no basis.
    """
    wanted = ("names", "degrees", "regressors", "units", "kernels")
    # The class is checked first, since to make all names takes longer than a filter over a short record.
    if not all(hasattr(type(basis), name) or hasattr(basis, name) for name in wanted):
        raise InputError(
            f"A basis such as Volterra(Delays(5)) is needed, but {type(basis).__name__} was given; wrap a "
            "bank in a Volterra series, of order 1 for a linear model."
        )


def impulse(length: int) -> Float[np.ndarray, " L"]:
    """Unit impulse: a one, then zeros."""
    if isinstance(length, bool) or length != int(length) or length < 1:
        raise InputError(
            f"Argument `length` must be a number of samples from 1, but is {length!r}; give for instance 100."
        )
    return np.eye(1, int(length))[0]


class Delays(Bank):
    """A tapped delay line; with one weight per tap, a finite impulse response.

        z_i[t] = u[t - first - i],  i = 0 ... memory - 1,  u = 0 before the first sample

    Not for sampling much faster than the plant: the impulse response of the plant must decay within the
    memory. A bank of orthonormal filters then needs fewer weights.

    Args:
        memory: Number of taps.
        first: Delay of the first tap [samples]; 1 if the output has no direct feedthrough.

    Raises:
        InputError: The memory is below 1, or the delay is negative.

    >>> bank = Delays(3, first=1)
    >>> bank.names
    ('u[t-1]', 'u[t-2]', 'u[t-3]')
    >>> bank.outputs([1.0, 2.0, 3.0])
    array([[0., 0., 0.],
           [1., 0., 0.],
           [2., 1., 0.]])
    """

    memory: int = eqx.field(static=True)
    first: int = eqx.field(static=True)

    def __init__(self, memory: int, first: int = 0) -> None:
        self.memory = whole(memory, "memory", 1)
        self.first = whole(first, "first", 0)

    @property
    def size(self) -> int:
        """Number of taps."""
        return self.memory

    @property
    def names(self) -> tuple[str, ...]:
        """`u[t]`, `u[t-1]`, ..."""
        lags = range(self.first, self.reach)
        return tuple(f"u[t-{lag}]" if lag else "u[t]" for lag in lags)

    @property
    def reach(self) -> int:
        """Samples after which the impulse response is zero."""
        return self.first + self.memory

    def respond(self, u: Float[Array, " N"]) -> Float[Array, "N M"]:
        """Columns for a signal, also in traced code."""
        N = len(u)
        padded = jnp.concatenate([jnp.zeros(self.reach - 1, u.dtype), u])
        starts = [self.memory - 1 - i for i in range(self.memory)]
        return jnp.stack([padded[s : s + N] for s in starts], axis=1)


class Averages(Bank):
    """A tapped delay line with wide taps: a piecewise constant impulse response.

        z_i[t] = mean of u[t - first - i width - j] over j = 0 ... width - 1,  i = 0 ... count - 1

    With width 1 these are plain delays. The width is an argument of the compiled code, so another width needs
    no compilation. Not for a plant whose response changes within a step: only the mean of the response over
    each step is represented.

    Args:
        count: Number of steps.
        width: Number of samples in each step.
        first: Delay of the first step [samples]; 1 if the output has no direct feedthrough.

    Raises:
        InputError: The count or the width is below 1, or the delay is negative.

    >>> Averages(2, 2, first=0).outputs([2.0, 4.0, 6.0, 8.0])
    array([[1., 0.],
           [3., 0.],
           [5., 1.],
           [7., 3.]])
    """

    width: Any
    count: int = eqx.field(static=True)
    first: int = eqx.field(static=True)

    def __init__(self, count: int, width: int, first: int = 1) -> None:
        self.count = whole(count, "count", 1)
        self.width = np.asarray(whole(width, "width", 1))
        self.first = whole(first, "first", 0)

    @property
    def size(self) -> int:
        """Number of steps."""
        return self.count

    @property
    def names(self) -> tuple[str, ...]:
        """`mean u[t-1..t-10]`, ..."""
        starts = [self.first + i * int(self.width) for i in range(self.count)]
        return tuple(f"mean u[t-{s}..t-{s + int(self.width) - 1}]" for s in starts)

    @property
    def reach(self) -> int:
        """Samples after which the impulse response is zero."""
        return self.first + self.count * int(self.width)

    def respond(self, u: Float[Array, " N"]) -> Float[Array, "N M"]:
        """Columns for a signal, also in traced code."""
        total = jnp.concatenate([jnp.zeros(1, u.dtype), jnp.cumsum(u)])
        width = jnp.asarray(self.width)
        edges = self.first - 1 + jnp.arange(self.count + 1, dtype=width.dtype) * width
        # Sum of all samples up to and with t - first - i width; nothing before the first sample.
        until = jnp.maximum(jnp.arange(len(u), dtype=width.dtype)[:, None] - edges[None, :], 0)
        sums = total[until]
        return (sums[:, :-1] - sums[:, 1:]) / width.astype(u.dtype)
