"""Delays for fast sampling: means of the input over stretches of equal length."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.basis.bank import Bank, whole


class Averages(Bank):
    """A tapped delay line with wide taps: an impulse response of equal steps.

        z_i[t] = mean of u[t - first - i width - j] over j = 0 ... width - 1,  i = 0 ... count - 1

    With width 1 these are the plain delays. The width is a number of the compiled code, so another one
    compiles nothing anew. Not for a plant that answers within less than a step: its response is only
    known as the mean over each.

    Args:
        count: Number of steps.
        width: Samples in each.
        first: Delay of the first [samples]; 1 where the output cannot answer at once.

    Raises:
        InputError: A count or a width below 1, or a negative delay.

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
        """Samples after which an impulse has left."""
        return self.first + self.count * int(self.width)

    def respond(self, u: Float[Array, " N"]) -> Float[Array, "N M"]:
        """Columns for a signal, inside of traced code too."""
        total = jnp.concatenate([jnp.zeros(1, u.dtype), jnp.cumsum(u)])
        width = jnp.asarray(self.width)
        edges = self.first - 1 + jnp.arange(self.count + 1, dtype=width.dtype) * width
        # Sum of all samples up to and with t - first - i width; nothing before the first sample.
        until = jnp.maximum(jnp.arange(len(u), dtype=width.dtype)[:, None] - edges[None, :], 0)
        sums = total[until]
        return (sums[:, :-1] - sums[:, 1:]) / width.astype(u.dtype)
