"""When a coefficient will settle, said before the run."""

import dataclasses
from typing import Any

import numpy as np

from rotflex_jax.adaptive.bounds import Stability, analyse
from rotflex_jax.adaptive.learning import settling_step_size
from rotflex_jax.adaptive.moments import Moments
from rotflex_jax.reproduce.settings import Settings


@dataclasses.dataclass(frozen=True)
class Prediction:
    """Step sizes and what they promise; nothing in it comes from the run.

    Attributes:
        eigenvalue: Of the direction in which the watched coefficient learns.
        step_sizes: Degree -> step size.
        mu: Step size of each weight (P,).
        settle: Iterations after which the mean of the coefficient has come 95 % of its way.
        stability: How far the step sizes are from divergence, and what they cost in the end.
    """

    eigenvalue: float
    step_sizes: dict[int, float]
    mu: Any
    settle: float
    stability: Stability


def settling_eigenvalue(covariance: np.ndarray, degrees: np.ndarray, index: int) -> float:
    """The eigenvalue that governs how fast one quadratic weight learns.

    The constant learns fast and takes the mean of the products with it, so what counts is the products'
    covariance about their means. Of its eigenvectors the one that holds most of the weight decides; with
    white input of variance 1 that is 2 for a square and 1 for a product of two samples.

    Args:
        covariance: Second moments of the regressors (P, P).
        degrees: Degree of every regressor (P,).
        index: Which regressor.

    >>> R = np.array([[1.0, 1.0, 0.0], [1.0, 3.0, 0.0], [0.0, 0.0, 1.0]])
    >>> settling_eigenvalue(R, np.array([0, 2, 2]), 1), settling_eigenvalue(R, np.array([0, 2, 2]), 2)
    (2.0, 1.0)
    """
    pick, constant = np.flatnonzero(degrees == 2), np.flatnonzero(degrees == 0)
    centred = covariance[np.ix_(pick, pick)]
    for k in constant:
        mean = covariance[pick, k]
        centred = centred - np.outer(mean, mean) / covariance[k, k]
    values, vectors = np.linalg.eigh(centred)
    share = vectors[pick.tolist().index(index)] ** 2
    # Eigenvectors of nearly equal eigenvalues are arbitrary: their shares count together.
    alike = np.isclose(values[:, None], values[None, :], rtol=0.05)
    return float(values[np.argmax(alike @ share + 1e-9 * share)])


def predict(s: Settings, degrees: np.ndarray, moments: Moments, index: int) -> Prediction:
    """Step sizes for `settle_at`, or what given ones promise.

        mu2 = ln 20 / (settle_at eigenvalue)

    Args:
        s: Settings `mu1`, `mu2`, `settle_at`.
        degrees: Of the regressors (P,).
        moments: Of the regressors.
        index: Regressor of the watched coefficient.
    """
    eigenvalue = settling_eigenvalue(moments.R, degrees, index)
    mu2 = s.mu2 or settling_step_size(eigenvalue, s.settle_at)
    sizes = {0: s.mu1, 1: s.mu1, 2: mu2}
    mu = np.array([sizes[int(d)] for d in degrees])
    return Prediction(eigenvalue, sizes, mu, float(np.log(20) / (mu2 * eigenvalue)), analyse(moments, mu))
