"""Which form of a filter's loop is the quickest for a basis; all give the same errors to rounding."""

import itertools

import numpy as np

from rotflex_jax.adaptive.block_lms import Blocks
from rotflex_jax.adaptive.filter import AdaptiveFilter
from rotflex_jax.adaptive.lms import LMS
from rotflex_jax.adaptive.rebuilt import Rebuilt, Square
from rotflex_jax.basis import Basis, Delays, Volterra
from rotflex_jax.basis.monomials import indices

SQUARE = 5
"""Delays from which the matrix form of LMS is quicker than products one by one."""
BLOCKS = 40
"""Delays from which blocks of samples are quicker still."""


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
    if not (type(filter) is LMS and second and M >= SQUARE):
        return Rebuilt(M, degrees, basis.layout)
    leaks = bool(np.any(np.asarray(filter.leakage) != 0))
    mu = np.broadcast_to(np.asarray(filter.mu, float), basis.size)
    counts = np.cumsum([0, *(len(indices(M, d, basis.layout)) for d in degrees)])
    alike = all(np.ptp(mu[a:b]) == 0 for a, b in itertools.pairwise(counts))
    if M >= BLOCKS and alike and whole and not leaks:
        return Blocks(M, degrees, basis.layout)
    return Square(M, degrees, basis.layout, leaks)
