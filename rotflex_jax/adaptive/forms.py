"""Which form of a filter's loop is the quickest for a basis; all give the same errors to rounding."""

import itertools

import numpy as np

from rotflex_jax.adaptive.block_lms import SquareBlocks
from rotflex_jax.adaptive.block_rls import RootBlocks
from rotflex_jax.adaptive.filter import AdaptiveFilter
from rotflex_jax.adaptive.lms import LMS
from rotflex_jax.adaptive.rebuilt import Rebuilt
from rotflex_jax.adaptive.rls import RLS
from rotflex_jax.adaptive.square import Square
from rotflex_jax.basis import Basis, Delays, Volterra
from rotflex_jax.basis.monomials import indices

BLOCKS = 40
"""Delays from which LMS is quicker in blocks of samples than in pairs."""


def quickest(filter: AdaptiveFilter, basis: Basis, whole: bool) -> Rebuilt | None:
    """The form for a filter and a basis; None where regressors have to be made beforehand.

    Args:
        filter: with numbers, not traced ones: some forms ask for equal step sizes within a degree.
        basis: of the regressors.
        whole: whether the run is one stretch; blocks are of no use where weights are kept often.
    """
    if not (isinstance(basis, Volterra) and isinstance(basis.bank, Delays)):
        return None
    M, degrees = basis.bank.memory, basis.chosen
    second = 2 in degrees and degrees[-1] == 2 and basis.layout == "triangular"
    if type(filter) is RLS:
        return RootBlocks(M, degrees, basis.layout)
    if not (type(filter) is LMS and second):
        return Rebuilt(M, degrees, basis.layout)
    leaks = bool(np.any(np.asarray(filter.leakage) != 0))
    mu = np.broadcast_to(np.asarray(filter.mu, float), basis.size)
    counts = np.cumsum([0, *(len(indices(M, d, basis.layout)) for d in degrees)])
    alike = all(np.ptp(mu[a:b]) == 0 for a, b in itertools.pairwise(counts))
    if M >= BLOCKS and alike and whole and not leaks:
        return SquareBlocks(M, degrees, basis.layout, alike)
    return Square(M, degrees, basis.layout, alike, leaks)
