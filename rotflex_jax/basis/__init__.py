"""Bases: the regressors of a signal, one named regressor per column.

Delays are suitable for slow sampling, orthonormal filters for fast sampling or a long memory. Volterra series
use products of either. `minimum_nmse` gives the least error of a bank, `optimise_poles` finds its poles.
"""

from rotflex_jax.basis.bank import Bank, Basis, Delays
from rotflex_jax.basis.orthogonalise import GramSchmidt, Hermite, Orthogonalised
from rotflex_jax.basis.orthonormal import Orthonormal
from rotflex_jax.basis.pole_search import (
    PoleSearch,
    ar1,
    bank_covariance,
    best_laguerre,
    fir_nmse,
    memory_for,
    minimum_nmse,
    optimise_poles,
)
from rotflex_jax.basis.volterra import Volterra

__all__ = [
    "Bank",
    "Basis",
    "Delays",
    "GramSchmidt",
    "Hermite",
    "Orthogonalised",
    "Orthonormal",
    "PoleSearch",
    "Volterra",
    "ar1",
    "bank_covariance",
    "best_laguerre",
    "fir_nmse",
    "memory_for",
    "minimum_nmse",
    "optimise_poles",
]
