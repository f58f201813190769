"""Banks in front of a series, at all time scales that a recording can hold."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from rotflex_jax.basis import Orthonormal
from rotflex_jax.basis.averages import Averages
from rotflex_jax.basis.bank import Bank
from rotflex_jax.compare.output_error import refined
from rotflex_jax.compare.subspace import chosen_system
from rotflex_jax.recording import Recording

Kind = Literal["delays", "laguerre", "kautz", "poles"]


def banks(kind: Kind, count: int, train: Sequence[Recording]) -> list[Bank]:
    """Banks of a kind, to choose from.

    Args:
        kind: `delays` are means over stretches, `laguerre` share one real pole, `kautz` one pair, `poles`
            are those of a linear model that is identified first, repeated until there are `count`.
        count: Columns of each.
        train: Their length bounds the memory.
    """
    longest = max(r.N for r in train)
    if kind == "delays":
        widths = np.unique(np.round(np.geomspace(1, max(2, longest / 8 / count), 8)).astype(int))
        return [Averages(count, int(w)) for w in widths]
    if kind == "laguerre":
        return [Orthonormal.laguerre(float(np.exp(-1 / s)), count) for s in np.geomspace(2, longest / 30, 10)]
    if kind == "kautz":
        found = []
        for cycles in np.geomspace(4 / longest, 0.1, 7):
            for damping in (0.15, 0.5):
                s = 2 * np.pi * cycles * (-damping + 1j * np.sqrt(1 - damping**2))
                found.append(Orthonormal.kautz(complex(np.exp(s)), count))
        return found
    return [Orthonormal(_decaying(train, count), label="pole")]


def _decaying(train: Sequence[Recording], count: int) -> list[complex]:
    """Poles of the linear model that decay within the recordings, slow ones first."""
    start = chosen_system(train, (4, 6), (16, 64), 0.7, lambda _: None)[0]
    slowest = np.exp(-20 / max(r.N for r in train))
    poles = [p for p in refined(start, train).poles.tolist() if 0.5 < abs(p) < slowest]
    pairs = sorted(
        {(round(p.real, 12), round(abs(p.imag), 12)) for p in poles}, key=lambda p: -abs(complex(*p))
    )
    if not pairs:
        raise RuntimeError("the linear model has no pole that decays within the recording")
    found: list[complex] = []
    while len(found) < count:
        for re, im in pairs:
            found += [complex(re, im), complex(re, -im)] if im else [complex(re)]
    return found
