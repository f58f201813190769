"""Likelihood of innovations that are correlated in time and between channels."""

import dataclasses

import numpy as np
import scipy

# White innovations by default. An autoregression fitted to the innovations of an incomplete model also
# takes away the slow error that the missing effect makes, and with it the power to name the effect.
ORDER = 0


@dataclasses.dataclass(frozen=True)
class Whitener:
    """`w = L (a * e)`: one autoregression per channel, then a common covariance.

    Attributes:
        a: Monic prediction-error filters (C, p + 1).
        L: Inverse Cholesky factor of the covariance of the filtered innovations (C, C).
    """

    a: np.ndarray
    L: np.ndarray

    @property
    def log_det(self) -> float:
        """Logarithm of the determinant of the covariance."""
        return float(-2 * np.sum(np.log(np.diag(self.L))))

    def __call__(self, e: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Whitened signals (..., R, N, C); zero where not seen and in the first p samples."""
        filtered = e
        if self.a.shape[1] > 1:
            each = [scipy.signal.lfilter(a, 1.0, e[..., c], axis=-1) for c, a in enumerate(self.a)]
            filtered = np.stack(each, axis=-1)
        mask = seen.copy()
        mask[:, : self.a.shape[1] - 1] = 0
        return (filtered @ self.L.T) * mask[..., None]

    def log_densities(self, e: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Log-likelihood of each sample (R, N) [nat]; zero where it does not count."""
        w = self(e, seen)
        mask = seen.copy()
        mask[:, : self.a.shape[1] - 1] = 0
        C = e.shape[-1]
        return -0.5 * (np.sum(w**2, axis=-1) + (C * np.log(2 * np.pi) + self.log_det) * mask)


def fit_whitener(e: np.ndarray, seen: np.ndarray, floor: np.ndarray, order: int = ORDER) -> Whitener:
    """Whitener fitted to innovations (R, N, C).

    Args:
        e: Innovations.
        seen: One where a sample counts (R, N).
        floor: Deviation below which nothing is believed, per channel; guards noise-free data.
        order: Of the autoregressions; 0 for none.
    """
    C = e.shape[-1]
    a = np.zeros((C, order + 1))
    a[:, 0] = 1.0
    for c in range(C):
        if order == 0:
            continue
        x = e[..., c] * seen
        lags = np.array([np.sum(x[:, k:] * x[:, : x.shape[1] - k]) for k in range(order + 1)])
        # A trace of white noise keeps the recursion regular for smooth model errors.
        lags[0] = lags[0] * (1 + 1e-9) + np.sum(seen) * 0.01 * floor[c] ** 2
        a[c, 1:] = -scipy.linalg.solve_toeplitz(lags[:-1], lags[1:])
    plain = Whitener(a, np.eye(C))
    w = plain(e, seen).reshape(-1, C)
    count = max(float(np.sum(seen[:, order:])), 1.0)
    covariance = w.T @ w / count + np.diag((0.05 * floor) ** 2)
    return Whitener(a, np.linalg.inv(np.linalg.cholesky(covariance)))


def log_likelihood(e: np.ndarray, seen: np.ndarray, floor: np.ndarray, order: int = ORDER) -> float:
    """Log-likelihood of innovations under their own best whitener [nat]."""
    return float(np.sum(fit_whitener(e, seen, floor, order).log_densities(e, seen)))
