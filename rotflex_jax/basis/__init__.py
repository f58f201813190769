"""Bases: a signal goes in, one named regressor per column comes out.

Delays suit a slow sampling, orthonormal filters a fast one or a long memory; Volterra series take the
products of either. `reach` tells beforehand what a bank can do, `optimise_poles` finds its poles.
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
