"""The least error that a bank can reach with any weights, from the impulse response of the plant.

Exact for a linear plant and an input whose autocovariance is known, without any recording.
"""

from typing import Any

import numpy as np
import scipy
from jaxtyping import Float

from rotflex_jax.basis.bank import Bank
from rotflex_jax.basis.orthonormal import Orthonormal
from rotflex_jax.checks import signal, whole
from rotflex_jax.errors import InputError


def ar1(a: float, length: int) -> Float[np.ndarray, " L"]:
    """Autocovariance of first-order noise of unit variance, `r[k] = a^k`.

    Args:
        a: exp(-2 pi bandwidth Ts); 0 for white noise.
        length: Lags from 0 to give.

    >>> ar1(0.5, 3)
    array([1.  , 0.5 , 0.25])
    """
    if not abs(a) < 1:
        raise InputError(
            f"Argument `a` must lie between -1 and 1, but is {a:g}; give exp(-2 pi bandwidth Ts)."
        )
    return np.power(float(a), np.arange(whole(length, "length", 1)))


def bank_covariance(bank: Bank, autocovariance: Any = (1.0,)) -> Float[np.ndarray, "M M"]:
    """Covariance R1 of the outputs of a bank under a stationary input.

        R1 = B' R B,  B = impulse responses,  R = Toeplitz matrix of the autocovariance

    Args:
        bank: The filters.
        autocovariance: Of the input, lags from 0; zero beyond those given. White unless given.

    >>> from rotflex_jax.basis import Delays
    >>> bank_covariance(Delays(2), ar1(0.5, 2))
    array([[1. , 0.5],
           [0.5, 1. ]])
    """
    B = bank.impulse_responses(bank.reach)
    return B.T @ scipy.linalg.matmul_toeplitz(_lags(autocovariance, len(B)), B)


def minimum_nmse(bank: Bank, impulse_response: Any, autocovariance: Any = (1.0,)) -> float:
    """Least squared error, over the variance of the output, that any weights on the bank reach.

        min over c of (h - B c)' R (h - B c) / (h' R h)

    Args:
        bank: The filters.
        impulse_response: h of the plant (L,), until it has decayed.
        autocovariance: Of the input, lags from 0; zero beyond those given. White unless given.

    Raises:
        InputError: Too few lags, or an impulse response of zero.

    Source: Wiener 1949; Haykin 2014, Adaptive Filter Theory, section 2.4.

    >>> from rotflex_jax.basis import Delays
    >>> round(minimum_nmse(Delays(1), 0.5 ** np.arange(40)), 12)
    0.25
    """
    h = signal(impulse_response, "impulse_response").astype(float)
    length = max(len(h), bank.reach)
    h = np.concatenate([h, np.zeros(length - len(h))])
    r = _lags(autocovariance, length)
    B = bank.impulse_responses(length)
    RB = scipy.linalg.matmul_toeplitz(r, B)
    left = h - B @ np.linalg.solve(B.T @ RB, RB.T @ h)
    power = _power(h, r)
    return float(left @ scipy.linalg.matmul_toeplitz(r, left)) / power


def fir_nmse(impulse_response: Any, autocovariance: Any = (1.0,), first: int = 0) -> Float[np.ndarray, " L"]:
    """`minimum_nmse` of `Delays(1, first)`, `Delays(2, first)`, ..., all from one factorisation.

    Args:
        impulse_response: h of the plant (L,), until it has decayed.
        autocovariance: Of the input, lags from 0; zero beyond those given. White unless given.
        first: Delay of the first tap [samples].

    Returns:
        Entry M - 1 belongs to a memory of M; precise to about 1e-13.
    """
    h = signal(impulse_response, "impulse_response").astype(float)
    first = whole(first, "first", 0)
    r = _lags(autocovariance, len(h))
    power = _power(h, r)
    p = scipy.linalg.matmul_toeplitz(r, h)[first:]
    root = scipy.linalg.cholesky(scipy.linalg.toeplitz(r[: len(p)]), lower=True)
    # The first M entries of the solution are the solution of the first M taps.
    gains = scipy.linalg.solve_triangular(root, p, lower=True) ** 2
    return np.maximum(1 - np.cumsum(gains) / power, 0.0)


def memory_for(nmse: float, impulse_response: Any, autocovariance: Any = (1.0,), first: int = 0) -> int:
    """Fewest delays that reach an error.

    Args:
        nmse: Squared error over the variance of the output, for instance 0.01.
        impulse_response: h of the plant (L,), until it has decayed.
        autocovariance: Of the input, lags from 0; zero beyond those given. White unless given.
        first: Delay of the first tap [samples].

    >>> memory_for(0.07, 0.5 ** np.arange(40))
    2
    """
    if not 0 < nmse < 1:
        raise InputError(
            f"Argument `nmse` must lie between 0 and 1, but is {nmse:g}; give for instance 0.01."
        )
    return 1 + int(np.argmax(fir_nmse(impulse_response, autocovariance, first) <= nmse))


def best_laguerre(
    impulse_response: Any, count: int, first: int = 1, grid: int = 60
) -> tuple[Orthonormal, float]:
    """The Laguerre bank of given size that is closest to an impulse response, and its error.

    The error as a function of the pole has several minima, about one per function, so a grid over
    all decays comes first, from the whole response down to one sample.

    Args:
        impulse_response: h of the plant (L,), until it has decayed.
        count: Number of functions.
        first: Delay of the bank [samples].
        grid: Poles to try before the best one is improved.

    Returns:
        The bank, and |h - B c|^2 / |h|^2.

    Source: Clowes 1965, IEEE Trans. Autom. Control 10 (where the minima lie).

    >>> bank, nmse = best_laguerre(0.9 ** np.arange(200), 1, first=0)
    >>> round(bank.poles[0].real, 6), nmse < 1e-12
    (0.9, True)
    """
    h = signal(impulse_response, "impulse_response").astype(float)
    power = _power(h, _lags((1.0,), len(h)))

    def error(z: float) -> float:
        B = Orthonormal.laguerre(float(np.exp(-np.exp(z))), count, first).impulse_responses(len(h))
        return float(np.sum((h - B @ (B.T @ h)) ** 2)) / power

    decays = np.linspace(np.log(3.0 / len(h)), np.log(3.0), whole(grid, "grid", 3))
    errors = [error(z) for z in decays]
    k = int(np.clip(np.argmin(errors), 1, len(decays) - 2))
    found = scipy.optimize.minimize_scalar(
        error, bounds=(decays[k - 1], decays[k + 1]), method="bounded", options={"xatol": 1e-10}
    )
    return Orthonormal.laguerre(float(np.exp(-np.exp(found.x))), count, first), error(found.x)


def _lags(autocovariance: Any, length: int) -> Float[np.ndarray, " {length}"]:
    """Autocovariance at the lags 0 ... length - 1."""
    r = signal(autocovariance, "autocovariance").astype(float)
    if r[0] <= 0:
        raise InputError(
            f"Argument `autocovariance` begins with the variance, but that is {r[0]:g}; correct it."
        )
    if 1 < len(r) < length and abs(r[-1]) > 1e-3 * r[0]:
        raise InputError(
            f"Argument `autocovariance` ends at lag {len(r) - 1} with {r[-1] / r[0]:.2g} of the variance, "
            f"but {length} lags are needed; give more of them."
        )
    return np.concatenate([r, np.zeros(max(length - len(r), 0))])[:length]


def _power(h: Float[np.ndarray, " L"], r: Float[np.ndarray, " L"]) -> float:
    power = float(h @ scipy.linalg.matmul_toeplitz(r, h))
    if not power > 0:
        raise InputError(
            "Argument `impulse_response` is zero throughout; give the answer of a plant that moves."
        )
    return power
