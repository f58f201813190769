"""Signals and regressors for the tests of adaptive filters, computed by NumPy alone."""

import numpy as np


def coloured(N: int, a: float, seed: int) -> np.ndarray:
    """First-order autoregressive noise of unit variance."""
    z = np.random.default_rng(seed).normal(size=N)
    u = np.empty(N)
    u[0] = z[0]
    for k in range(1, N):
        u[k] = a * u[k - 1] + np.sqrt(1 - a**2) * z[k]
    return u


def lags(u: np.ndarray, memory: int) -> np.ndarray:
    """Columns u_t ... u_(t - memory + 1), with zero input before the first sample."""
    return np.stack([np.concatenate([np.zeros(i), u])[: len(u)] for i in range(memory)], axis=1)


def volterra(u: np.ndarray, memory: int, constant: bool = True, full: bool = False) -> np.ndarray:
    """Second-order Volterra regressors: constant, linear terms, products ordered by their first delay."""
    x = lags(u, memory)
    pairs = [(i, j) for i in range(memory) for j in range(0 if full else i, memory)]
    columns = [np.ones((len(u), 1))] * constant + [x] + [(x[:, i] * x[:, j])[:, None] for i, j in pairs]
    return np.concatenate(columns, axis=1)


def noisy_record(N: int, memory: int = 3, a: float = 0.6, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Volterra regressors of a coloured input, and an output with random weights and noise of 0.1."""
    rng = np.random.default_rng(seed)
    phi = volterra(coloured(N, a, seed), memory)
    return phi, phi @ rng.normal(size=phi.shape[1]) + 0.1 * rng.normal(size=N)
