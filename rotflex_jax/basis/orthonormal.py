"""Orthonormal filters with poles of one's choice: Laguerre, Kautz and the general case."""

from collections.abc import Sequence
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.basis.bank import Bank, whole
from rotflex_jax.basis.sections import Kinds, poles_of, run_chain, sections
from rotflex_jax.errors import InputError
from rotflex_jax.recording.samples import sampling_period


class Orthonormal(Bank):
    """Takenaka-Malmquist functions: rational, orthonormal, with given poles.

        F_k(z) = z^-first sqrt(1 - a^2) / (1 - a z^-1) * product of the all-passes of the poles before,
        a pair  z^-first sqrt(1 - c^2) (1 - b z^-1) / D  and  z^-first sqrt((1 - c^2)(1 - b^2)) z^-1 / D,
        D = 1 + b (c - 1) z^-1 - c z^-2,  c = -|p|^2,  b = 2 Re(p) / (1 + |p|^2)

    A linear plant with just these poles is exactly a weighted sum of them, at any sampling period.
    Poles are numbers of the compiled code, so another value compiles nothing anew.

    Not for poles on the unit circle, such as that of an angle that integrates: take the delays, or
    fit the speed.

    Args:
        poles: In the z domain, each complex one with its conjugate; may repeat.
        first: Delay of the whole bank [samples]; 1 suits a plant whose output does not jump.

    Raises:
        InputError: A pole that does not decay, or a complex one without its conjugate.

    Source: Ninness and Gustafsson 1997, IEEE Trans. Autom. Control 42, equations 3 and 9.

    >>> bank = Orthonormal((0.5, 0.6 + 0.3j, 0.6 - 0.3j))
    >>> bank.names
    ('GOBF 1', 'GOBF 2', 'GOBF 3')
    >>> B = bank.impulse_responses(200)
    >>> bool(np.max(np.abs(B.T @ B - np.eye(3))) < 1e-12)
    True
    """

    numbers: Any
    kinds: Kinds = eqx.field(static=True)
    first: int = eqx.field(static=True)
    label: str = eqx.field(static=True)

    def __init__(self, poles: Sequence[complex], first: int = 1, label: str = "GOBF") -> None:
        self.kinds, self.numbers = sections(poles)
        self.first = whole(first, "first", 0)
        self.label = label

    @classmethod
    def laguerre(cls, pole: float, count: int, first: int = 1) -> Self:
        """Functions that share one real pole, for a plant that is well damped.

        Args:
            pole: Between -1 and 1.
            count: Number of functions.
            first: Delay of the whole bank [samples].

        >>> Orthonormal.laguerre(0.7, 2).impulse_responses(3).round(3)
        array([[ 0.   ,  0.   ],
               [ 0.714, -0.5  ],
               [ 0.5  ,  0.014]])
        """
        if np.iscomplexobj(pole):
            raise InputError(
                f"Laguerre functions have one real pole, but {pole:.6g} was given; use Orthonormal.kautz "
                "for a pair."
            )
        return cls((pole,) * whole(count, "count", 1), first, "Laguerre")

    @classmethod
    def kautz(cls, pole: complex, count: int, first: int = 1) -> Self:
        """Functions that share one pair of complex poles, for one resonance.

        Args:
            pole: One of the pair.
            count: Number of functions, even.
            first: Delay of the whole bank [samples].
        """
        if whole(count, "count", 2) % 2:
            raise InputError(
                f"Kautz functions come in pairs, but {count} were asked for; give an even number."
            )
        pole = complex(pole)
        if abs(pole.imag) <= 1e-12:
            raise InputError(
                f"Kautz functions have a complex pair of poles, but {pole.real:.6g} was given; "
                "use Orthonormal.laguerre for a real pole."
            )
        return cls((pole, pole.conjugate()) * (count // 2), first, "Kautz")

    @classmethod
    def at(cls, continuous_poles: Sequence[complex], Ts: float, first: int = 1) -> Self:
        """Functions with the poles `exp(s Ts)` of a sampled plant.

        Args:
            continuous_poles: s [1/s], such as the eigenvalues of a state matrix, without an
                integrator.
            Ts: Sampling period [s].
            first: Delay of the whole bank [samples].

        >>> Orthonormal.at([-10.0], 0.1).poles
        ((0.36787944117144233+0j),)
        """
        s = np.atleast_1d(np.asarray(continuous_poles, complex))
        rising = [pole for pole in s.tolist() if pole.real >= 0]
        if rising:
            raise InputError(
                f"A pole must decay, but {rising[0]:.6g} 1/s does not; leave out the integrator, "
                "which a bank of decaying functions cannot hold."
            )
        return cls([complex(p) for p in np.exp(s * sampling_period(Ts))], first)

    def with_numbers(self, numbers: Float[Array, " M"]) -> Self:
        """The bank with other numbers of its sections, which may be traced.

        Args:
            numbers: A real pole, or real and imaginary part of a pair, section by section.
        """
        return eqx.tree_at(lambda bank: bank.numbers, self, numbers)

    @property
    def poles(self) -> tuple[complex, ...]:
        """In the z domain, each pair next to each other."""
        return poles_of(self.kinds, np.asarray(self.numbers))

    def continuous_poles(self, Ts: float) -> tuple[complex, ...]:
        """log(pole) / Ts [1/s]."""
        return tuple(complex(s) for s in np.log(np.array(self.poles)) / sampling_period(Ts))

    @property
    def size(self) -> int:
        """Number of functions."""
        return len(self.numbers)

    @property
    def names(self) -> tuple[str, ...]:
        """`GOBF 1`, or `Laguerre 1`, ..."""
        return tuple(f"{self.label} {k + 1}" for k in range(self.size))

    @property
    def reach(self) -> int:
        """Samples after which an impulse has left, to about a millionth of its size."""
        slowest = max(abs(p) for p in self.poles)
        # Poles that repeat answer with a polynomial in front of the decay, which lasts longer.
        return self.first + int(np.ceil((14 + 3 * self.size) / -np.log(max(slowest, 0.05))))

    def respond(self, u: Float[Array, " N"]) -> Float[Array, "N M"]:
        """Columns for a signal, inside of traced code too."""
        numbers = jnp.asarray(self.numbers).astype(u.dtype)
        # The chain's states come one sample late, so a bank without delay looks one sample ahead.
        ahead = jnp.concatenate([jnp.zeros(self.first, u.dtype), u, jnp.zeros(1, u.dtype)])
        states = run_chain(self.kinds, numbers, ahead)
        return states[1 : len(u) + 1]
