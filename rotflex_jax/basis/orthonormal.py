"""Orthonormal filters with given poles: Laguerre, Kautz and the general case.

Each section is an all-pass filter in a balanced realisation: its matrix `[A B; C D]` is orthogonal. The
matrix of a chain of sections is orthogonal too, hence `A A' + B B' = I`: the impulse responses of the states
are orthonormal sequences. Complex poles come in pairs and need no complex arithmetic.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from rotflex_jax.basis.bank import Bank
from rotflex_jax.checks import as_array, entries, shown, whole
from rotflex_jax.errors import InputError
from rotflex_jax.recording.samples import sampling_period

SectionKinds = tuple[str, ...]
"""Order of a section: "real" for one pole, "pair" for a conjugate pair."""


def _listed(poles: Any, name: str, example: str) -> Complex[np.ndarray, " M"]:
    """Poles that a user gives, one or several in a row, as finite numbers."""
    found = np.atleast_1d(as_array(poles if (several := entries(poles)) is None else several))
    if found.dtype.kind not in "iufc" or found.ndim != 1 or not found.size or not np.isfinite(found).all():
        raise InputError(
            f"Argument `{name}` must list finite numbers, at least one, but is {shown(poles)}; "
            f"give for instance {example}."
        )
    return found.astype(complex)


def sections(poles: Sequence[complex]) -> tuple[SectionKinds, Float[np.ndarray, " M"]]:
    """Kinds of the sections, in the order of their first pole, and their parameters.

    A real pole `a` has one parameter, a pair two: its real and its positive imaginary part.

    Raises:
        InputError: There are no poles, a pole is not inside the unit circle, or its conjugate is missing.
    """
    given = _listed(poles, "poles", "(0.5, 0.6 + 0.3j, 0.6 - 0.3j)")
    outside = [p if p.imag else p.real for p in given.tolist() if abs(p) >= 1]
    if outside:
        raise InputError(
            f"A pole must lie inside the unit circle, but {outside[0]:.6g} has the modulus "
            f"{abs(outside[0]):.6g}; give poles of the sampled plant, exp(s Ts), that decay."
        )
    kinds, parameters, waiting = [], [], list(given)
    while waiting:
        pole = waiting.pop(0)
        if abs(pole.imag) <= 1e-12:
            kinds.append("real")
            parameters.append(pole.real)
            continue
        partners = [k for k, other in enumerate(waiting) if abs(other - pole.conjugate()) <= 1e-9]
        if not partners:
            raise InputError(
                f"A complex pole needs its conjugate, but {pole:.6g} has none; give both, "
                "since the input and the output are real."
            )
        waiting.pop(partners[0])
        kinds.append("pair")
        parameters += [pole.real, abs(pole.imag)]
    return tuple(kinds), np.array(parameters)


def poles_of(kinds: SectionKinds, parameters: Float[np.ndarray, " M"]) -> tuple[complex, ...]:
    """The poles, with the two poles of a pair next to each other."""
    poles, k = [], 0
    for kind in kinds:
        if kind == "real":
            poles.append(complex(parameters[k]))
            k += 1
        else:
            pole = complex(parameters[k], parameters[k + 1])
            poles += [pole, pole.conjugate()]
            k += 2
    return tuple(poles)


def chain(
    kinds: SectionKinds, parameters: Float[Array, " M"]
) -> tuple[Float[Array, "M M"], Float[Array, " M"]]:
    """`A`, `B` of the chain, `x+ = A x + B u`; the parameters may be traced."""
    n = len(parameters)
    zero = jnp.zeros(n, parameters.dtype)
    through_x, through_u = zero, jnp.ones((), parameters.dtype)  # input of the next section
    rows, B, k = [], [], 0
    for kind in kinds:
        own = _real(parameters[k]) if kind == "real" else _pair(parameters[k], parameters[k + 1])
        a, b, c, d = own
        width = len(b)
        for i in range(width):
            rows.append((b[i] * through_x).at[k : k + width].add(a[i]))
            B.append(b[i] * through_u)
        through_x = (d * through_x).at[k : k + width].add(c)
        through_u = d * through_u
        k += width
    return jnp.stack(rows), jnp.stack(B)


Section = tuple[Float[Array, "m m"], Float[Array, " m"], Float[Array, " m"], Float[Array, ""]]
"""A, B, C, D of a section with one or two states."""


def _real(a: Float[Array, ""]) -> Section:
    """`(z^-1 - a) / (1 - a z^-1)`."""
    s = jnp.sqrt(1 - a**2)
    return a[None, None], s[None], s[None], -a


def _pair(re: Float[Array, ""], im: Float[Array, ""]) -> Section:
    """`(-c + b (c - 1) z^-1 + z^-2) / (1 + b (c - 1) z^-1 - c z^-2)`, `c = -|p|^2`."""
    c = -(re**2 + im**2)
    b = 2 * re / (1 - c)
    # 1 - b^2 in a form without cancellation for a pole near one.
    q = jnp.sqrt((1 - c - 2 * re) * (1 - c + 2 * re)) / (1 - c)
    k = jnp.sqrt((1 - c) * (1 + c))
    A = jnp.stack([jnp.stack([-b * c, c * q]), jnp.stack([q, b])])
    return A, jnp.stack([k, jnp.zeros_like(k)]), jnp.stack([-b * k, q * k]), -c


def run_chain(
    kinds: SectionKinds, parameters: Float[Array, " M"], u: Float[Array, " N"]
) -> Float[Array, "N M"]:
    """States before each sample: the response of the chain to `u`, delayed by one sample."""
    A, B = chain(kinds, parameters)

    def step(x: Float[Array, " M"], u: Float[Array, ""]) -> tuple[Float[Array, " M"], Float[Array, " M"]]:
        return A @ x + B * u, x

    return jax.lax.scan(step, jnp.zeros_like(B), u)[1]


def parameters_of(kinds: SectionKinds, signs: Sequence[float], z: Float[Array, " M"]) -> Float[Array, " M"]:
    """Parameters of the sections from unconstrained coordinates, always inside the unit circle.

    A real pole is `± exp(-exp(z))`, a pair `exp(-exp(z_1) ± j exp(z_2))`: the logarithms of its
    decay and of its angle per sample.
    """
    z = jnp.clip(z, -40.0, 5.0)
    parameters, k = [], 0
    for kind, sign in zip(kinds, signs, strict=True):
        size = jnp.exp(-jnp.exp(z[k]))
        if kind == "real":
            parameters.append(sign * size)
            k += 1
        else:
            angle = jnp.exp(z[k + 1])
            # An angle beyond pi gives the same pair as its conjugate.
            parameters += [size * jnp.cos(angle), jnp.abs(size * jnp.sin(angle))]
            k += 2
    return jnp.stack(parameters)


def coordinates(
    kinds: SectionKinds, parameters: Float[np.ndarray, " M"]
) -> tuple[Float[np.ndarray, " M"], tuple[float, ...]]:
    """Unconstrained coordinates and signs of sections, the inverse of `parameters_of`."""
    z, signs, k = [], [], 0
    for kind in kinds:
        pole = complex(parameters[k], 0.0 if kind == "real" else parameters[k + 1])
        # A pole at zero is clipped to the fastest decay that the coordinates express.
        z.append(np.log(-np.log(np.clip(abs(pole), 1e-12, 1 - 1e-12))))
        signs.append(-1.0 if kind == "real" and pole.real < 0 else 1.0)
        if kind == "pair":
            z.append(np.log(abs(np.angle(pole))))
        k += 1 if kind == "real" else 2
    return np.array(z), tuple(signs)


class Orthonormal(Bank):
    """Takenaka-Malmquist functions: rational, orthonormal, with given poles.

        F_k(z) = z^-first sqrt(1 - a^2) / (1 - a z^-1) * product of the all-passes of the poles before,
        a pair  z^-first sqrt(1 - c^2) (1 - b z^-1) / D  and  z^-first sqrt((1 - c^2)(1 - b^2)) z^-1 / D,
        D = 1 + b (c - 1) z^-1 - c z^-2,  c = -|p|^2,  b = 2 Re(p) / (1 + |p|^2)

    The output of a linear plant with exactly these poles is a weighted sum of the outputs of the bank, at any
    sampling period. Poles are arguments of the compiled code, so other values need no compilation.

    Not for poles on the unit circle, such as the pole of an angle that integrates a speed: use delays, or
    fit the speed.

    Args:
        poles: Poles in the z domain, each complex pole with its conjugate; poles may be repeated.
        first: Delay of the whole bank [samples]; 1 for a plant without direct feedthrough.

    Raises:
        InputError: A pole is not inside the unit circle, or a complex pole lacks its conjugate.

    Source: Ninness and Gustafsson 1997, IEEE Trans. Autom. Control 42, equations 3 and 9.

    >>> bank = Orthonormal((0.5, 0.6 + 0.3j, 0.6 - 0.3j))
    >>> bank.names
    ('GOBF 1', 'GOBF 2', 'GOBF 3')
    >>> B = bank.impulse_responses(200)
    >>> bool(np.max(np.abs(B.T @ B - np.eye(3))) < 1e-12)
    True
    """

    parameters: Any
    kinds: SectionKinds = eqx.field(static=True)
    first: int = eqx.field(static=True)
    label: str = eqx.field(static=True)

    def __init__(self, poles: Sequence[complex], first: int = 1, label: str = "GOBF") -> None:
        self.kinds, self.parameters = sections(poles)
        self.first = whole(first, "first", 0)
        self.label = label

    @classmethod
    def laguerre(cls, pole: float, count: int, first: int = 1) -> "Orthonormal":
        """Functions that share one real pole, for a plant that is well damped.

        Args:
            pole: The pole, between -1 and 1.
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
    def kautz(cls, pole: complex, count: int, first: int = 1) -> "Orthonormal":
        """Functions that share one pair of complex poles, for one resonance.

        Args:
            pole: One pole of the pair.
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
    def at(cls, continuous_poles: Sequence[complex], Ts: float, first: int = 1) -> "Orthonormal":
        """Functions with the poles `exp(s Ts)` of a sampled plant.

        Args:
            continuous_poles: Poles s in continuous time [1/s], such as the eigenvalues of a state matrix,
                without an integrator.
            Ts: Sampling period [s].
            first: Delay of the whole bank [samples].

        >>> Orthonormal.at([-10.0], 0.1).poles
        ((0.36787944117144233+0j),)
        """
        s = _listed(continuous_poles, "continuous_poles", "(-10.0, -5 + 30j, -5 - 30j)")
        rising = [pole for pole in s.tolist() if pole.real >= 0]
        if rising:
            raise InputError(
                f"A pole must decay, but {rising[0]:.6g} 1/s does not; leave out the integrator, "
                "which a bank of decaying functions cannot hold."
            )
        return cls([complex(p) for p in np.exp(s * sampling_period(Ts))], first)

    def with_parameters(self, parameters: Float[Array, " M"]) -> "Orthonormal":
        """The bank with other parameters of its sections, which may be traced.

        Args:
            parameters: Parameters of each section: a real pole, or real and imaginary part of a pair.
        """
        return eqx.tree_at(lambda bank: bank.parameters, self, parameters)

    @property
    def poles(self) -> tuple[complex, ...]:
        """Poles in the z domain, with the two poles of a pair next to each other."""
        return poles_of(self.kinds, np.asarray(self.parameters))

    def continuous_poles(self, Ts: float) -> tuple[complex, ...]:
        """Poles in continuous time, log(pole) / Ts [1/s]."""
        return tuple(complex(s) for s in np.log(np.array(self.poles)) / sampling_period(Ts))

    @property
    def size(self) -> int:
        """Number of functions."""
        return len(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """`GOBF 1`, or `Laguerre 1`, ..."""
        return tuple(f"{self.label} {k + 1}" for k in range(self.size))

    @property
    def reach(self) -> int:
        """Samples after which the impulse response has decayed, to about a millionth of its size."""
        slowest = max(abs(p) for p in self.poles)
        # The response of repeated poles is a polynomial times the decay, which lasts longer.
        return self.first + int(np.ceil((14 + 3 * self.size) / -np.log(max(slowest, 0.05))))

    def respond(self, u: Float[Array, " N"]) -> Float[Array, "N M"]:
        """Columns for a signal, also in traced code."""
        parameters = jnp.asarray(self.parameters).astype(u.dtype)
        # The states of the chain are delayed by one sample, so a bank without delay looks one sample ahead.
        ahead = jnp.concatenate([jnp.zeros(self.first, u.dtype), u, jnp.zeros(1, u.dtype)])
        states = run_chain(self.kinds, parameters, ahead)
        return states[1 : len(u) + 1]
