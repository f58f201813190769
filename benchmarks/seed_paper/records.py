"""Inputs and simulated responses of the scenarios."""

from __future__ import annotations

import functools

import numpy as np

from rotflex_jax.data.excitation import noise
from rotflex_jax.reproduce.plants import plant, response

STEP = 1e-3
"""Longest step of the simulation [s]; the NMSE of the deflection is then below 1e-8."""


def white(N: int, seed: int) -> np.ndarray:
    """Independent normal voltages of unit variance [V]."""
    return np.random.default_rng(seed).standard_normal(N)


def voltage(N: int, Ts: float, cutoff: float | None, seed: int) -> np.ndarray:
    """First-order noise of unit variance; white if `cutoff` is None [V]."""
    return noise(N, Ts, bandwidth=cutoff, seed=seed) if cutoff else white(N, seed)


@functools.lru_cache(maxsize=64)
def record(
    scenario: str, Ts: float, N: int, cutoff: float | None, seed: int, step: float = STEP
) -> tuple[np.ndarray, np.ndarray]:
    """Voltage [V] and deflection [rad] of a scenario (N,)."""
    u = voltage(N, Ts, cutoff, seed)
    y = deflection(scenario, u, Ts, step)
    u.flags.writeable = y.flags.writeable = False
    return u, y


def deflection(scenario: str, u: np.ndarray, Ts: float, step: float = STEP) -> np.ndarray:
    """Deflection of a scenario that starts at rest [rad]."""
    return np.array(response(plant(scenario), u, Ts, step=step)[:, 1])


def impulse_response(Ts: float, seconds: float = 2.0, scenario: str = "S0") -> np.ndarray:
    """Response of the deflection to 1 V for one sample [rad]; exact for the linear plant."""
    return deflection(scenario, np.eye(1, round(seconds / Ts))[0], Ts)


def nmse(y: np.ndarray, y_hat: np.ndarray) -> float:
    """Mean squared error over the variance of the measurement."""
    return float(np.sum((y - y_hat) ** 2) / np.sum((y - np.mean(y)) ** 2))
