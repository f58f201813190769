"""A separate integrator for the measured joint, which uses no code of the toolkit.

It takes semi-implicit Euler steps of 0.2 ms. Coulomb friction is an impulse that at most stops the motion;
the state of LuGre friction follows its exponential solution within a step. Fits use finite differences and
take seconds. Their results check those of the toolkit for the same laws.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numba
import numpy as np
from scipy.optimize import least_squares

import rotflex_jax as rf

ARM_INERTIA = 0.003894  # trusted [kg m^2]
# Parameter -> start, scale. Friction levels in N m, angles in rad; `drive` in N m/V, `offset` in V.
NUMBERS: dict[str, tuple[float, float]] = {
    "drive": (0.165, 0.165),
    "hub_damping": (0.097, 0.1),
    "hub_inertia": (0.0025, 0.0025),
    "stiffness": (1.95, 2.0),
    "joint_damping": (0.002, 0.003),
    "level": (0.018, 0.02),
    "rise": (0.5, 0.5),
    "slow": (0.25, 0.2),
    "presliding": (0.003, 0.005),
    "joint_level": (0.009, 0.02),
    "joint_width": (0.06, 0.05),
    "joint_beta": (0.15, 0.5),
    "offset": (0.0, 0.05),
    "bias": (0.0, 0.005),
}
NONNEGATIVE = {
    "hub_inertia",
    "level",
    "rise",
    "slow",
    "presliding",
    "joint_level",
    "joint_width",
    "joint_beta",
}
LINEAR = ("drive", "hub_damping", "hub_inertia", "stiffness", "joint_damping")
# Bristle damping is left out, because these runs do not determine it.
LUGRE = ("level", "rise", "slow", "presliding")
BOUC_WEN = ("joint_level", "joint_width", "joint_beta")
STRUCTURES: dict[str, tuple[str, ...]] = {
    "Coulomb at the hub": (*LINEAR, "level"),
    "LuGre at the hub": (*LINEAR, *LUGRE),
    "LuGre at the hub, Bouc-Wen at the joint": (*LINEAR, *LUGRE, *BOUC_WEN),
}
TAKEN = "LuGre at the hub, Bouc-Wen at the joint"
OWN = ("offset", "bias")
STEPS = 10  # per sample of 2 ms
WINDOW, SEEN = 1000, 100  # samples of a window, and samples at its start that do not count
# Scales of the errors of hub angle and deflection in the cost: about the errors that remain [deg].
WEIGHTS = np.array([0.5, 0.15])


@dataclasses.dataclass(frozen=True)
class Found:
    """Estimates: all parameters and their standard deviations, by name of the run and of the parameter."""

    numbers: dict[str, dict[str, float]]
    std: dict[str, dict[str, float]]


@numba.njit(cache=True)
def _shrink(v, level):
    return np.sign(v) * max(abs(v) - level, 0.0)


@numba.njit(cache=True)
def _window(p, lugre, u, theta, alpha, Ts):
    c, d_hub, J, k, d, level, rise, slow, presliding, joint, width, beta, offset, bias = p
    h = Ts / STEPS
    phi, v, w, z, s = theta + alpha - bias, 0.0, 0.0, 0.0, 0.0
    out = np.empty((len(u), 2))
    for i in range(len(u)):
        out[i, 0], out[i, 1] = theta, phi - theta + bias
        for _ in range(STEPS):
            a, da = phi - theta, w - v
            pull = k * a + d * da + joint * z
            free = c * (u[i] + offset) - d_hub * v + pull
            if lugre:
                g = 1.0 + rise * np.exp(-((v / slow) ** 2))
                rate = abs(v) / (g * presliding)
                if rate * h > 1e-9:
                    end = np.sign(v) * g + (s - np.sign(v) * g) * np.exp(-rate * h)
                else:
                    end = s + h * v / presliding
                friction = level * 0.5 * (s + end)
                s = end
                v_new = v + h * (free - friction) / J
            else:
                v_new = _shrink(v + h * free / J, h * level / J)
            w = w - h * pull / ARM_INERTIA
            z = z + h * (da - beta * abs(da) * z - (1 - beta) * da * abs(z)) / width
            z = min(max(z, -1.5), 1.5)
            v = v_new
            theta, phi = theta + h * v, phi + h * w
    return out


class Law(NamedTuple):
    """Equations of motion: names of the parameters in their order, and a function that runs one window."""

    names: Sequence[str]
    window: Callable[..., np.ndarray]


RIGID = Law(tuple(NUMBERS), _window)


def free_runs(
    numbers: dict[str, float], lugre: bool, run: rf.Recording, width: int = WINDOW, law: Law = RIGID
) -> np.ndarray:
    """Angles (N, 2) over windows, each from rest at the mean of its first 50 samples [rad]."""
    p = np.array([numbers[k] for k in law.names])
    parts = []
    for i in range(0, run.N - width + 1, width):
        u, y = run.u[i : i + width].astype(float), run.y[i : i + width]
        first = y[:50].mean(axis=0)
        parts.append(law.window(p, lugre, u, first[0], first[1], run.Ts))
    return np.concatenate(parts)


def residual(
    numbers: dict[str, float], lugre: bool, run: rf.Recording, width: int = WINDOW, law: Law = RIGID
) -> np.ndarray:
    """Errors (W, N, 2) of free runs over windows, without the first `SEEN` samples of each [deg]."""
    y_hat = free_runs(numbers, lugre, run, width, law)
    e = np.degrees(y_hat - run.y[: len(y_hat)]).reshape(-1, width, 2)[:, SEEN:]
    return np.clip(np.nan_to_num(e, nan=100.0), -100.0, 100.0)


def rms(
    numbers: dict[str, float], lugre: bool, run: rf.Recording, width: int = WINDOW, law: Law = RIGID
) -> tuple[float, float]:
    """Root mean square errors of hub angle and deflection over windows of `width` samples [deg]."""
    theta, alpha = np.sqrt(np.mean(residual(numbers, lugre, run, width, law) ** 2, axis=(0, 1)))
    return float(theta), float(alpha)


def fit(
    runs: dict[str, rf.Recording],
    free: Sequence[str],
    own: Sequence[str] = OWN,
    start: dict[str, float] | None = None,
    lugre: bool | None = None,
) -> Found:
    """Least-squares fit to free runs over windows.

    Args:
        runs: Recordings by name.
        free: Parameters to fit, common to all runs.
        own: Parameters to fit separately for each run.
        start: Initial values, which are kept for parameters that are not fitted.
        lugre: Whether the hub has LuGre friction; if None, whether its parameters are in `free`.
    """
    lugre = "presliding" in free if lugre is None else lugre
    held = {k: v for k, (v, _) in NUMBERS.items()} | ({} if "joint_level" in free else {"joint_level": 0.0})
    held |= start or {}
    names = [*free, *(k for _ in runs for k in own)]
    scale = np.array([NUMBERS[k][1] for k in names])
    lower = np.array([0.0 if k in NONNEGATIVE else -np.inf for k in names])
    upper = np.array([1.0 / NUMBERS[k][1] if k == "joint_beta" else np.inf for k in names])

    def each(x: np.ndarray) -> dict[str, dict[str, float]]:
        common = dict(zip(free, (x * scale).tolist()[: len(free)], strict=True))
        rest = (x * scale)[len(free) :].reshape(len(runs), len(own)).tolist()
        return {
            r: held | common | dict(zip(own, row, strict=True)) for r, row in zip(runs, rest, strict=True)
        }

    def cost(x: np.ndarray) -> np.ndarray:
        return np.concatenate([(residual(n, lugre, runs[r]) / WEIGHTS).ravel() for r, n in each(x).items()])

    begin = np.clip(np.array([held[k] for k in names]) / scale, lower + 1e-6, upper - 1e-6)
    found = least_squares(cost, begin, bounds=(lower, upper), diff_step=1e-3, max_nfev=60)
    std = _windows_std(found.jac, found.fun, len(found.fun) // (2 * (WINDOW - SEEN))) * scale
    rest = std[len(free) :].reshape(len(runs), len(own)).tolist()
    deviations = dict(zip(free, std.tolist(), strict=False))
    return Found(
        each(found.x),
        {r: deviations | dict(zip(own, row, strict=True)) for r, row in zip(runs, rest, strict=True)},
    )


def _windows_std(J: np.ndarray, e: np.ndarray, windows: int) -> np.ndarray:
    """Standard deviations from the scatter between windows, since errors within a window are correlated."""
    H = J.T @ J
    scores = np.einsum("wnp,wn->wp", J.reshape(windows, -1, J.shape[1]), e.reshape(windows, -1))
    inverse = np.linalg.pinv(H, rcond=1e-12)
    return np.sqrt(
        np.maximum(np.diag(inverse @ (scores.T @ scores) @ inverse), 0.0) * windows / (windows - 1)
    )
