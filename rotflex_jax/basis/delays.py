"""The plainest bank: the last samples of the signal."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rotflex_jax.basis.bank import Bank, whole


class Delays(Bank):
    """A tapped delay line; with one weight per tap, a finite impulse response.

        z_i[t] = u[t - first - i],  i = 0 ... memory - 1,  u = 0 before the first sample

    Not for sampling much faster than the plant: its answer to an impulse must be over within the
    memory. A bank of orthonormal filters needs fewer numbers there.

    Args:
        memory: Number of taps.
        first: Delay of the first tap [samples]; 1 where the output cannot answer at once.

    Raises:
        InputError: A memory below 1, or a negative delay.

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
        """Samples after which an impulse has left."""
        return self.first + self.memory

    def respond(self, u: Float[Array, " N"]) -> Float[Array, "N M"]:
        """Columns for a signal, inside of traced code too."""
        N = len(u)
        padded = jnp.concatenate([jnp.zeros(self.reach - 1, u.dtype), u])
        starts = [self.memory - 1 - i for i in range(self.memory)]
        return jnp.stack([padded[s : s + N] for s in starts], axis=1)
