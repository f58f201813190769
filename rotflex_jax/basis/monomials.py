"""Products of a bank's outputs: which there are, what they are called, how often each counts."""

import itertools
import math
from collections import Counter
from collections.abc import Sequence
from functools import cache

import numpy as np
from jaxtyping import Float, Int

Index = tuple[int, ...]
"""Columns that are multiplied; () is the constant."""


@cache
def indices(size: int, degree: int, layout: str) -> tuple[Index, ...]:
    """Products of one degree: each once ("triangular"), or in every order of its factors ("full").

    >>> indices(2, 2, "triangular")
    ((0, 0), (0, 1), (1, 1))
    >>> indices(2, 2, "full")
    ((0, 0), (0, 1), (1, 0), (1, 1))
    """
    if layout == "full":
        return tuple(itertools.product(range(size), repeat=degree))
    return tuple(itertools.combinations_with_replacement(range(size), degree))


def orders(index: Index) -> int:
    """In how many orders its factors can be written.

    >>> orders((0, 0, 1))
    3
    """
    return math.factorial(len(index)) // math.prod(math.factorial(n) for n in Counter(index).values())


def title(index: Index, names: Sequence[str]) -> str:
    """Such as `u[t]^2 * u[t-1]`.

    >>> title((0, 0, 1), ["u[t]", "u[t-1]"])
    'u[t]^2 * u[t-1]'
    """
    if not index:
        return "1"
    if len(index) == 1:
        return names[index[0]]
    words = []
    for k, power in Counter(index).items():
        name = f"({names[k]})" if " " in names[k] else names[k]
        words.append(f"{name}^{power}" if power > 1 else name)
    return " * ".join(words)


@cache
def positions(size: int, degree: int) -> Int[np.ndarray, "..."]:
    """Place of every entry of a tensor (size, ...) in the triangular list."""
    place = {index: k for k, index in enumerate(indices(size, degree, "triangular"))}
    flat = [place[tuple(sorted(i))] for i in indices(size, degree, "full")]
    return np.array(flat, int).reshape((size,) * degree)


@cache
def counts(size: int, degree: int) -> Int[np.ndarray, " P"]:
    """`orders` of the triangular list."""
    return np.array([orders(i) for i in indices(size, degree, "triangular")], int)


def symmetric(kernel: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Mean over all orders of the axes; the output of a Volterra series does not notice."""
    axes = list(itertools.permutations(range(kernel.ndim)))
    return sum((np.transpose(kernel, a) for a in axes[1:]), kernel) / len(axes)


def to_tensor(w: np.ndarray, size: int, degree: int, layout: str) -> np.ndarray:
    """Symmetric tensor (size, ...) of the weights of one degree."""
    if layout == "full":
        return symmetric(w.reshape((size,) * degree))
    return (w / counts(size, degree))[positions(size, degree)]


def from_tensor(tensor: np.ndarray, size: int, layout: str) -> np.ndarray:
    """Weights of one degree of a tensor (size, ...); the same output, whatever its symmetry."""
    if layout == "full":
        return symmetric(tensor).ravel()
    places = positions(size, tensor.ndim)
    return np.bincount(places.ravel(), tensor.ravel(), minlength=len(counts(size, tensor.ndim)))


def change_axes(tensor: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """The matrix (L, M) on every axis of a tensor (M, ...)."""
    for _ in range(tensor.ndim):
        # The first axis goes to the back, so after all turns the order is as before.
        tensor = np.tensordot(tensor, matrix, axes=(0, 1))
    return tensor
