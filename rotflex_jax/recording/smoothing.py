"""Smoothed signals and their derivatives by local polynomials, without an import of `scipy.signal`.

That import takes longer than a fit, and a search needs nothing else from `scipy.signal`.
"""

import math

import numpy as np
from jaxtyping import Float


def local_polynomial(
    width: int, degree: int, derivative: int = 0, Ts: float = 1.0
) -> Float[np.ndarray, "width width"]:
    """Row k: weights of `width` samples that give a derivative of their polynomial at the k-th sample.

    The polynomial is fitted by least squares. The middle row is the filter of Savitzky and Golay; the other
    rows are for the ends of a signal.

    Args:
        width: Odd number of samples, more than the degree.
        degree: Degree of the polynomial.
        derivative: Order of the derivative; 0 smooths.
        Ts: Sampling period [s].

    Source: A. Savitzky and M. J. E. Golay, Anal. Chem. 36, 1964.

    >>> local_polynomial(5, 2)[2].round(3).tolist()
    [-0.086, 0.343, 0.486, 0.343, -0.086]
    """
    t = np.arange(width) - width // 2
    powers = t[:, None] ** np.arange(degree + 1.0)
    factors = np.array([math.perm(k, derivative) for k in range(degree + 1)], float)
    slopes = np.zeros_like(powers)
    slopes[:, derivative:] = powers[:, : degree + 1 - derivative] * factors[derivative:]
    return slopes @ np.linalg.pinv(powers) / Ts**derivative


def smoothed(
    y: Float[np.ndarray, " N"], width: int, degree: int, derivative: int = 0, Ts: float = 1.0
) -> Float[np.ndarray, " N"]:
    """A derivative of the local polynomial around each sample; near the ends, of the end polynomials.

    Args:
        y: At least `width` samples.
        width: Odd number of samples of each polynomial, more than the degree.
        degree: Degree of the polynomial.
        derivative: Order of the derivative; 0 smooths.
        Ts: Sampling period [s].
    """
    weights, half = local_polynomial(width, degree, derivative, Ts), width // 2
    inside = np.correlate(y, weights[half], "valid")
    return np.concatenate([weights[:half] @ y[:width], inside, weights[half + 1 :] @ y[-width:]])
