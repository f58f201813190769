"""Directions of parameters in words: which combination of them is known, and which is not."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax.parameters import HALF_WIDTH_95

# Entries below this share of the largest belong to no sentence.
LEAST_SHARE = 0.1
# Entries of a vector below this are zero, and two vectors are the same where no entry differs by more than
# this: those of random runs are known to fewer digits than exact ones.
ZERO, SAME = 1e-6, 1e-4


@dataclasses.dataclass(frozen=True)
class Direction:
    """A way in which parameters move together, and how far the outputs let them.

    Attributes:
        shares: Parameter -> how much of its own size it moves; the largest is 1.
        kind: `powers` where the shares hold at any values, so that a product of powers is known; `sum` where
            the amounts do, so that a sum is known; `mixed` otherwise.
        std: Standard deviation along it as a share of the values; infinite where nothing is known.
    """

    shares: dict[str, float]
    kind: str
    std: float = np.inf

    @property
    def parameters(self) -> tuple[str, ...]:
        """Those that it moves by a noticeable share."""
        least = 0.0 if np.isinf(self.std) else LEAST_SHARE
        return tuple(n for n, v in self.shares.items() if abs(v) >= least)

    @property
    def sentence(self) -> str:
        """What is known, in words."""
        names, v = self.parameters, self.shares
        half = f"{100 * HALF_WIDTH_95 * self.std:.2g}"
        wide = "" if np.isinf(self.std) else f" (together known to ± {half} % only)"
        if len(names) == 1:
            known = f"is known to ± {half} % only"
            return f"{names[0]} {'has no effect on what is measured' if np.isinf(self.std) else known}"
        both = f"{', '.join(names[:-1])} and {names[-1]}"
        sizes = np.array([v[n] for n in names])
        equal = np.ptp(np.abs(sizes)) < 0.2 * np.abs(sizes).max()
        if self.kind == "sum":
            return f"{both} together: only a sum of them is known{wide}"
        if equal and (sizes > 0).all():
            ratio = "ratio is" if len(names) == 2 else "ratios are"
            return f"{both} together: only their {ratio} known, one common factor is open{wide}"
        if equal and len(names) == 2:
            return f"{both} together: only their product is known{wide}"
        if self.kind == "powers":
            factors = ", ".join(f"{n} by k" + (f"^{v[n]:.3g}" if abs(v[n] - 1) > 0.01 else "") for n in names)
            return f"{both} together: nothing shows a change of {factors} for any k{wide}"
        if np.isinf(self.std):
            several = "one combination of them is" if len(names) == 2 else "combinations of them are"
            return f"{both} together: only {several} known"
        ways = ", ".join(f"{n} {'up' if v[n] > 0 else 'down'}" for n in names)
        return f"{both} together: hardly anything shows if they move at once ({ways}){wide}"

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        std = None if np.isinf(self.std) else self.std
        return {"shares": self.shares, "kind": self.kind, "std": std, "sentence": self.sentence}


def kind_of(
    log: Float[np.ndarray, " P"],
    again: Float[np.ndarray, " P"],
    values: Float[np.ndarray, " P"],
    other: Float[np.ndarray, " P"],
) -> str:
    """Whether a direction is the same in shares or in amounts at two places.

    Args:
        log: In shares of the values, at the first place.
        again: At the other.
        values: Of the parameters at the first.
        other: At the other.
    """
    if _same(log, again):
        return "powers"
    return "sum" if _same(log * values, again * other) else "mixed"


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    a, b = (v / v[np.argmax(np.abs(a))] if v[np.argmax(np.abs(a))] else v for v in (a, b))
    return bool(np.all(np.abs(a - b) < SAME * max(1.0, float(np.abs(a).max()))))


def reduced(vectors: Float[np.ndarray, "K P"]) -> Float[np.ndarray, "K P"]:
    """Another basis of the space of some vectors, each with few entries and a column of its own."""
    left = np.array(vectors, float)
    for k in range(len(left)):
        rest = np.abs(left[k:])
        row, column = np.unravel_index(np.argmax(rest), rest.shape)
        left[[k, k + row]] = left[[k + row, k]]
        left[k] /= left[k, column]
        for i in range(len(left)):
            if i != k:
                left[i] -= left[i, column] * left[k]
    return np.where(np.abs(left) < ZERO, 0.0, left)


def direction(
    names: Sequence[str], vector: Float[np.ndarray, " P"], kind: str, std: float = np.inf
) -> Direction:
    """A direction with its largest share 1."""
    scaled = vector / vector[np.argmax(np.abs(vector))]
    return Direction(
        {n: float(v) for n, v in zip(names, scaled, strict=True) if abs(v) > ZERO}, kind, float(std)
    )


def least_held(
    names: Sequence[str], vectors: Float[np.ndarray, "K P"], most: int = 400
) -> tuple[tuple[str, ...], ...]:
    """Sets of as few parameters as possible that free all others when they are held.

    Args:
        names: Of the parameters.
        vectors: What nothing determines.
        most: How many sets are looked at.
    """
    K = len(vectors)
    if not K:
        return ()
    inside = [i for i in range(len(names)) if np.abs(vectors[:, i]).max() > ZERO]
    sets = itertools.islice(itertools.combinations(inside, K), most)
    return tuple(
        tuple(names[i] for i in chosen)
        for chosen in sets
        if np.linalg.matrix_rank(vectors[:, chosen], tol=ZERO) == K
    )
