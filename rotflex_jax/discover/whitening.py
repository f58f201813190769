"""Whitening of innovations that are correlated in time and between channels, and their likelihood."""

import dataclasses

import numpy as np
import scipy
from jaxtyping import Float

# White innovations by default. An autoregression fitted to the innovations of an incomplete model also
# takes away the slow error that the missing effect makes, and with it the power to name the effect.
WHITENER_ORDER = 0


@dataclasses.dataclass(frozen=True)
class Whitener:
    """`w = L (a * e)`: one autoregression per channel, then a common covariance.

    Attributes:
        a: Monic prediction-error filters, q - 1 = p being their order.
        L: Inverse Cholesky factor of the covariance of the filtered innovations.
    """

    a: Float[np.ndarray, "C q"]
    L: Float[np.ndarray, "C C"]

    @classmethod
    def of_noise(cls, noise: Float[np.ndarray, " C"]) -> "Whitener":
        """White errors with these standard deviations, each channel apart."""
        return cls(np.ones((len(noise), 1)), np.diag(1 / noise))

    @property
    def log_det(self) -> float:
        """Logarithm of the determinant of the covariance."""
        return float(-2 * np.sum(np.log(np.diag(self.L))))

    def __call__(
        self, e: Float[np.ndarray, "*batch R N C"], seen: Float[np.ndarray, "R N"]
    ) -> Float[np.ndarray, "*batch R N C"]:
        """Whitened signals; zero where not seen and in the first p samples."""
        filtered = e
        if self.a.shape[1] > 1:
            channels = [scipy.signal.lfilter(a, 1.0, e[..., c], axis=-1) for c, a in enumerate(self.a)]
            filtered = np.stack(channels, axis=-1)
        # Channel by channel: a product of matrices this thin takes several times as long for many
        # signals.
        w = np.empty(filtered.shape)
        for i, row in enumerate(self.L):
            first, *others = [j for j in range(len(row)) if row[j] != 0]
            np.multiply(filtered[..., first], row[first], out=w[..., i])
            for j in others:
                w[..., i] += row[j] * filtered[..., j]
        if (left_out := self._counted(seen) == 0).any():
            w[..., left_out, :] = 0.0
        return w

    def log_densities(
        self, e: Float[np.ndarray, "R N C"], seen: Float[np.ndarray, "R N"]
    ) -> Float[np.ndarray, "R N"]:
        """Log-likelihood of each sample [nat]; zero where it does not count."""
        w, C = self(e, seen), e.shape[-1]
        constant = (C * np.log(2 * np.pi) + self.log_det) * self._counted(seen)
        return -0.5 * (np.sum(w**2, axis=-1) + constant)

    def _counted(self, seen: Float[np.ndarray, "R N"]) -> Float[np.ndarray, "R N"]:
        counted = seen.copy()
        counted[:, : self.a.shape[1] - 1] = 0
        return counted


def fit_whitener(
    e: Float[np.ndarray, "R N C"],
    seen: Float[np.ndarray, "R N"],
    floor: Float[np.ndarray, " C"],
    order: int = WHITENER_ORDER,
    channels_apart: bool = False,
) -> Whitener:
    """Whitener fitted to innovations.

    Args:
        e: Innovations.
        seen: One where a sample counts.
        floor: Standard deviation below which nothing is believed; guards noise-free data.
        order: Of the autoregressions; 0 for none.
        channels_apart: Whether the innovations of different channels count as uncorrelated.
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
    filtered = Whitener(a, np.eye(C))(e, seen).reshape(-1, C)
    count = max(float(np.sum(seen[:, order:])), 1.0)
    covariance = filtered.T @ filtered / count + np.diag((0.05 * floor) ** 2)
    covariance = np.diag(np.diag(covariance)) if channels_apart else covariance
    return Whitener(a, np.linalg.inv(np.linalg.cholesky(covariance)))


def log_likelihood(
    e: Float[np.ndarray, "R N C"],
    seen: Float[np.ndarray, "R N"],
    floor: Float[np.ndarray, " C"],
    order: int = WHITENER_ORDER,
) -> float:
    """Log-likelihood of innovations under their own best whitener [nat]."""
    return float(np.sum(fit_whitener(e, seen, floor, order).log_densities(e, seen)))
