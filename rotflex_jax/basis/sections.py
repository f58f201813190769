"""All-pass sections in a chain: real matrices whose states are orthonormal functions.

Each section is an all-pass filter in a balanced realisation: its matrix `[A B; C D]` is orthogonal.
So is that of any chain of them, hence `A A' + B B' = I`: the states answer to an impulse with
orthonormal sequences. Complex poles come in pairs and never need complex arithmetic.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.errors import InputError

Kinds = tuple[str, ...]
"""Order of a section: "real" for one pole, "pair" for a conjugate pair."""


def sections(poles: Sequence[complex]) -> tuple[Kinds, np.ndarray]:
    """Kinds of the sections, in the order of their first pole, and their numbers.

    A real pole `a` gives one number, a pair two: its real and its positive imaginary part.

    Raises:
        InputError: No poles, one on or outside of the unit circle, or one without its conjugate.
    """
    given = np.atleast_1d(np.asarray(poles, complex))
    if given.ndim != 1 or not given.size or not np.isfinite(given).all():
        raise InputError(
            f"Argument `poles` must list finite numbers, at least one, but is {poles!r}; "
            "give for instance (0.5, 0.6 + 0.3j, 0.6 - 0.3j)."
        )
    outside = [p if p.imag else p.real for p in given.tolist() if abs(p) >= 1]
    if outside:
        raise InputError(
            f"A pole must lie inside of the unit circle, but {outside[0]:.6g} has the modulus "
            f"{abs(outside[0]):.6g}; give poles of the sampled plant, exp(s Ts), that decay."
        )
    kinds, numbers, waiting = [], [], list(given)
    while waiting:
        pole = waiting.pop(0)
        if abs(pole.imag) <= 1e-12:
            kinds.append("real")
            numbers.append(pole.real)
            continue
        partners = [k for k, other in enumerate(waiting) if abs(other - pole.conjugate()) <= 1e-9]
        if not partners:
            raise InputError(
                f"A complex pole needs its conjugate, but {pole:.6g} has none; give both, "
                "since the input and the output are real."
            )
        waiting.pop(partners[0])
        kinds.append("pair")
        numbers += [pole.real, abs(pole.imag)]
    return tuple(kinds), np.array(numbers)


def poles_of(kinds: Kinds, numbers: np.ndarray) -> tuple[complex, ...]:
    """The poles, pairs next to each other."""
    poles, k = [], 0
    for kind in kinds:
        if kind == "real":
            poles.append(complex(numbers[k]))
            k += 1
        else:
            pole = complex(numbers[k], numbers[k + 1])
            poles += [pole, pole.conjugate()]
            k += 2
    return tuple(poles)


def chain(kinds: Kinds, numbers: Float[Array, " M"]) -> tuple[Float[Array, "M M"], Float[Array, " M"]]:
    """`A`, `B` of the chain, `x+ = A x + B u`; traced in the numbers."""
    n = len(numbers)
    zero = jnp.zeros(n, numbers.dtype)
    through_x, through_u = zero, jnp.ones((), numbers.dtype)  # input of the next section
    rows, B, k = [], [], 0
    for kind in kinds:
        own = _real(numbers[k]) if kind == "real" else _pair(numbers[k], numbers[k + 1])
        a, b, c, d = own
        width = len(b)
        for i in range(width):
            rows.append((b[i] * through_x).at[k : k + width].add(a[i]))
            B.append(b[i] * through_u)
        through_x = (d * through_x).at[k : k + width].add(c)
        through_u = d * through_u
        k += width
    return jnp.stack(rows), jnp.stack(B)


def _real(a: Array) -> tuple[Array, Array, Array, Array]:
    """`(z^-1 - a) / (1 - a z^-1)`."""
    s = jnp.sqrt(1 - a**2)
    return a[None, None], s[None], s[None], -a


def _pair(re: Array, im: Array) -> tuple[Array, Array, Array, Array]:
    """`(-c + b (c - 1) z^-1 + z^-2) / (1 + b (c - 1) z^-1 - c z^-2)`, `c = -|p|^2`."""
    c = -(re**2 + im**2)
    b = 2 * re / (1 - c)
    # 1 - b^2 without the cancellation that a pole near one would suffer.
    q = jnp.sqrt((1 - c - 2 * re) * (1 - c + 2 * re)) / (1 - c)
    k = jnp.sqrt((1 - c) * (1 + c))
    A = jnp.stack([jnp.stack([-b * c, c * q]), jnp.stack([q, b])])
    return A, jnp.stack([k, jnp.zeros_like(k)]), jnp.stack([-b * k, q * k]), -c


def run_chain(kinds: Kinds, numbers: Float[Array, " M"], u: Float[Array, " N"]) -> Float[Array, "N M"]:
    """States before each sample: the chain's answers to `u`, one sample late."""
    A, B = chain(kinds, numbers)

    def step(x: Array, u: Array) -> tuple[Array, Array]:
        return A @ x + B * u, x

    return jax.lax.scan(step, jnp.zeros_like(B), u)[1]


def numbers_of(kinds: Kinds, signs: Sequence[float], z: Float[Array, " D"]) -> Float[Array, " D"]:
    """Numbers of the sections from free coordinates, always inside of the unit circle.

    A real pole is `± exp(-exp(z))`, a pair `exp(-exp(z_1) ± j exp(z_2))`: the logarithms of its
    decay and of its angle per sample.
    """
    z = jnp.clip(z, -40.0, 5.0)
    numbers, k = [], 0
    for kind, sign in zip(kinds, signs, strict=True):
        size = jnp.exp(-jnp.exp(z[k]))
        if kind == "real":
            numbers.append(sign * size)
            k += 1
        else:
            angle = jnp.exp(z[k + 1])
            # The conjugate names the same pair, so an angle beyond a half turn does no harm.
            numbers += [size * jnp.cos(angle), jnp.abs(size * jnp.sin(angle))]
            k += 2
    return jnp.stack(numbers)


def coordinates(kinds: Kinds, numbers: np.ndarray) -> tuple[np.ndarray, tuple[float, ...]]:
    """Free coordinates and signs of sections, the inverse of `numbers_of`."""
    z, signs, k = [], [], 0
    for kind in kinds:
        pole = complex(numbers[k], 0.0 if kind == "real" else numbers[k + 1])
        # A pole at zero decays at once: as fast as the coordinates go.
        z.append(np.log(-np.log(np.clip(abs(pole), 1e-12, 1 - 1e-12))))
        signs.append(-1.0 if kind == "real" and pole.real < 0 else 1.0)
        if kind == "pair":
            z.append(np.log(abs(np.angle(pole))))
        k += 1 if kind == "real" else 2
    return np.array(z), tuple(signs)
