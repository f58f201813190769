r"""Controllers and references of a laboratory: PD on one of two angles or LQR, gains from the textbook model.

A controller reads both angles, differentiates them with a first-order filter and applies
:math:`v = k_r r - k \cdot (\theta, \alpha, \dot\theta, \dot\alpha)`, limited to `LIMIT`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_continuous_are

from rotflex_jax.arena.simulator.plant import Plant
from rotflex_jax.arena.simulator.tables import Values

LIMIT = 10.0
"""Largest voltage that a controller may apply [V]."""

KINDS = ("pd_theta", "pd_tip", "lqr")

# Smallest decay rate [1/s] and smallest damping ratio of the poles that a designer accepts.
SLOWEST, DAMPING = 1.5, 0.08


@dataclass(frozen=True)
class Controller:
    """Linear feedback of the readings.

    Args:
        kind: a member of `KINDS`.
        gains: of theta, alpha, theta', alpha' [V/rad, V s/rad].
        corner: corner frequency of the filter that differentiates [Hz].
    """

    kind: str
    gains: tuple[float, float, float, float]
    corner: float


def textbook(plant: Plant) -> tuple[Values, Values]:
    """Matrices of ``x' = A x + b v`` with ``x = (theta, alpha, theta', alpha')``, without other effects."""
    g = plant.torque_per_volt
    damper = plant.B_hub + g * plant.k_m * plant.K_g
    # In theta: J_h th'' = g v - d th' + K al + B al'; in the arm: J_a (th'' + al'') = -K al - B al'.
    hub = np.array([0.0, plant.K, -damper, plant.B_joint]) / plant.J_hub
    arm = np.array([0.0, -plant.K, 0.0, -plant.B_joint]) / plant.J_arm
    A = np.zeros((4, 4))
    A[0, 2] = A[1, 3] = 1.0
    A[2], A[3] = hub, arm - hub
    b = np.array([0.0, 0.0, g, -g]) / plant.J_hub
    return A, b


def _accepted(plant: Plant, controller: Controller) -> bool:
    """Whether the closed loop of the textbook model, filters included, is fast and damped enough."""
    A, b = textbook(plant)
    k, w = np.array(controller.gains), 2 * np.pi * controller.corner
    # A filtered rate: s' = w (y' - s) = w (x_rate - s).
    loop = np.zeros((6, 6))
    loop[:4, :4] = A - np.outer(b, [k[0], k[1], 0.0, 0.0])
    loop[:4, 4:] = -np.outer(b, k[2:])
    loop[4:, 2:4], loop[4:, 4:] = w * np.eye(2), -w * np.eye(2)
    poles = np.linalg.eigvals(loop)
    return bool(np.all(poles.real < -SLOWEST) and np.all(-poles.real > DAMPING * np.abs(poles)))


def designed(kind: str, plant: Plant, rng: np.random.Generator) -> Controller:
    """A controller of this kind for the textbook model, with random gains (PD) or weights (LQR).

    Args:
        kind: a member of `KINDS`.
        plant: the textbook model.
        rng: random generator.
    """
    draw = lambda low, high: float(np.exp(rng.uniform(np.log(low), np.log(high))))  # noqa: E731
    A, b = textbook(plant)
    while True:
        corner = draw(20.0, 80.0)
        if kind == "lqr":
            Q = np.diag([draw(30, 400), draw(10, 400), draw(0.05, 2.0), draw(0.05, 2.0)])
            gains = b @ solve_continuous_are(A, b[:, None], Q, np.eye(1))
        else:
            kp = draw(4.0, 16.0) if kind == "pd_theta" else draw(2.0, 8.0)
            kd = kp * draw(0.01, 0.2)
            tip = float(kind == "pd_tip")
            gains = np.array([kp, tip * kp, kd, tip * kd])
        of_theta, of_alpha, of_hub, of_joint = map(float, gains)
        made = Controller(kind, (of_theta, of_alpha, of_hub, of_joint), corner)
        if _accepted(plant, made):
            return made


def square(N: int, Ts: float, rng: np.random.Generator) -> Values:
    """A square wave of 15 to 45 degrees and 1.6 to 4 s about zero, at a random phase [rad]."""
    size, period = np.deg2rad(rng.uniform(15, 45)), rng.uniform(1.6, 4.0)
    t = Ts * np.arange(N) + period * rng.random()
    return size * np.where((t / period) % 1 < 0.5, 1.0, -1.0)


def levels(N: int, Ts: float, rng: np.random.Generator) -> Values:
    """Steps to random levels within 50 degrees, each held for 0.6 to 2 s [rad]."""
    r, k = np.empty(N), 0
    while k < N:
        end = k + round(rng.uniform(0.6, 2.0) / Ts)
        r[k:end] = np.deg2rad(rng.uniform(-50, 50))
        k = end
    return r


REFERENCES = {"square": square, "levels": levels}
