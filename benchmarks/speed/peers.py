"""The same work by libraries that people use for it, each in the quickest way it offers."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np


@functools.cache
def _numba_lms(memory: int) -> Any:
    import numba

    P = 1 + memory + memory * (memory + 1) // 2

    @numba.njit(fastmath=True)
    def loop(u: np.ndarray, y: np.ndarray, step: np.ndarray) -> np.ndarray:
        x, phi, w, e = np.zeros(memory), np.ones(P), np.zeros(P), np.empty(len(u))
        for n in range(len(u)):
            for i in range(memory - 1, 0, -1):
                x[i] = x[i - 1]
            x[0] = u[n]
            k = 1
            for i in range(memory):
                phi[k] = x[i]
                k += 1
            for i in range(memory):
                for j in range(i, memory):
                    phi[k] = x[i] * x[j]
                    k += 1
            total = 0.0
            for i in range(P):
                total += w[i] * phi[i]
            e[n] = y[n] - total
            for i in range(P):
                w[i] += step[i] * e[n] * phi[i]
        return e

    return loop


def numba_lms(u: np.ndarray, y: np.ndarray, mu: tuple[float, float, float], memory: int) -> np.ndarray:
    """A-priori errors of second-order Volterra LMS, with fast arithmetic."""
    step = np.concatenate([[mu[0]], np.full(memory, mu[1]), np.full(memory * (memory + 1) // 2, mu[2])])
    return _numba_lms(memory)(u, y, step)


def padasip_lms(phi: np.ndarray, y: np.ndarray, mu: float) -> np.ndarray:
    """Errors of padasip's LMS on given regressors."""
    import padasip

    return padasip.filters.FilterLMS(n=phi.shape[1], mu=mu, w="zeros").run(y, phi)[1]


def padasip_rls(phi: np.ndarray, y: np.ndarray, lam: float) -> np.ndarray:
    """Errors of padasip's RLS on given regressors."""
    import padasip

    return padasip.filters.FilterRLS(n=phi.shape[1], mu=lam, eps=0.01, w="zeros").run(y, phi)[1]
