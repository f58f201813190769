"""Gaussian moments of polynomials by Gauss-Hermite quadrature, a reference for formulas by pairings."""

import itertools

import numpy as np


def gauss_hermite(R: np.ndarray, per_entry: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and probabilities that integrate polynomials up to degree 2 per_entry - 1 exactly."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(per_entry)
    weights = weights / weights.sum()
    z = np.array(list(itertools.product(nodes, repeat=len(R)))) @ np.linalg.cholesky(R).T
    return z, np.prod(list(itertools.product(weights, repeat=len(R))), axis=1)


def monomials(z: np.ndarray) -> np.ndarray:
    """Columns 1, z_i and z_i z_j for i <= j."""
    i, j = np.triu_indices(z.shape[1])
    return np.hstack([np.ones((len(z), 1)), z, z[:, i] * z[:, j]])
