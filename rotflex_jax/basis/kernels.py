"""Kernels in the domain of delays, from weights in front of a bank's products and back."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax.basis.bank import Bank, whole
from rotflex_jax.basis.monomials import change_axes, from_tensor, symmetric, to_tensor
from rotflex_jax.errors import InputError

LARGEST = 20_000_000  # numbers in one kernel; beyond that, memory runs out


def kernels_of(
    bank: Bank, parts: Mapping[int, Float[np.ndarray, " P"]], layout: str, length: int | None
) -> dict[int, Any]:
    """Degree -> symmetric kernel (length, ...), from the weights of each degree.

    Args:
        bank: Its outputs are what is multiplied.
        parts: Degree -> weights.
        layout: Of the weights.
        length: Delays from 0 to give [samples]; as far as the bank reaches if None.
    """
    length = whole(bank.reach if length is None else length, "length", 1)
    most = max(parts)
    if length**most > LARGEST:
        raise InputError(
            f"A kernel of degree {most} over {length} delays has {float(length**most):.1e} numbers, but at "
            f"most {LARGEST:.0e} are made; give a smaller `length`."
        )
    B = bank.impulse_responses(length)
    found: dict[int, Any] = {}
    for d, w in parts.items():
        found[d] = float(w[0]) if d == 0 else change_axes(to_tensor(w, bank.size, d, layout), B)
    return found


def weights_of(
    bank: Bank, kernels: Mapping[int, Any], layout: str, tolerance: float
) -> dict[int, Float[np.ndarray, " P"]]:
    """Degree -> weights, from kernels over the delays from 0 on.

    Args:
        bank: Its outputs are what is multiplied.
        kernels: Degree -> kernel (length, ...), of any symmetry.
        layout: Of the weights.
        tolerance: Part of a kernel that may lie outside of what the bank spans.
    """
    found = {}
    for d, kernel in kernels.items():
        H = np.asarray(kernel, float)
        if H.ndim != d or len(set(H.shape)) > 1:
            raise InputError(
                f"A kernel of degree {d} must have {d} axes of one length, but has the shape {H.shape}; "
                "give it over the same delays on each axis."
            )
        if d == 0:
            found[d] = H[None]
            continue
        B = bank.impulse_responses(len(H))
        H = symmetric(H)
        tensor = change_axes(H, np.linalg.pinv(B))
        left, size = np.linalg.norm(change_axes(tensor, B) - H), np.linalg.norm(H)
        if left > tolerance * size:
            raise InputError(
                f"The kernel of degree {d} lies outside of what the bank spans by {100 * left / size:.2g} % "
                "of its norm; take other poles or a longer memory, or give a larger `tolerance` for the "
                "best approximation."
            )
        found[d] = from_tensor(tensor, bank.size, layout)
    return found
