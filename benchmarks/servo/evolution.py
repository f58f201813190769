"""Covariance matrix adaptation (CMA-ES) in a box, with restarts at growing population sizes.

Source: N. Hansen, The CMA evolution strategy: a tutorial, 2016, arXiv 1604.00772, figure 6 and table 1 with
positive weights; restarts: A. Auger and N. Hansen, A restart CMA evolution strategy with increasing
population size, CEC 2005.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Found(NamedTuple):
    """What the evolution ended with.

    Attributes:
        x: Best point, within the box.
        cost: Its cost.
        evaluations: Costs that were computed.
        restarts: How often it began again.
    """

    x: np.ndarray
    cost: float
    evaluations: int
    restarts: int


def minimise(
    cost: Callable[[np.ndarray], float],
    lower: np.ndarray,
    upper: np.ndarray,
    evaluations: int,
    seed: int,
) -> Found:
    """The least cost within a box.

    The search runs in the unit cube; points outside of it are evaluated at the nearest point inside and
    ranked with a penalty of the squared distance. It begins again, at another place and with twice as many
    points, where the cost no longer falls.

    Args:
        cost: To be minimised.
        lower: Least values.
        upper: Largest values.
        evaluations: Costs to compute at most.
        seed: Of the random numbers.
    """
    random, n = np.random.default_rng(seed), len(lower)
    base = 4 + int(3 * np.log(n))
    best, best_cost, spent, restarts = np.full(n, 0.5), np.inf, 0, 0
    while spent < evaluations:
        size = base * 2 ** min(restarts, 5)
        x, value, used = _one(cost, lower, upper, evaluations - spent, size, random, first=not restarts)
        spent, restarts = spent + used, restarts + 1
        if value < best_cost:
            best, best_cost = x, value
    return Found(lower + best * (upper - lower), best_cost, spent, restarts - 1)


def _one(
    cost: Callable[[np.ndarray], float],
    lower: np.ndarray,
    upper: np.ndarray,
    budget: int,
    size: int,
    random: np.random.Generator,
    first: bool,
) -> tuple[np.ndarray, float, int]:
    """One run: the best point of the unit cube, its cost, and how many costs were computed."""
    n, half = len(lower), size // 2
    w = np.log(half + 0.5) - np.log(np.arange(1, half + 1))
    w = w / w.sum()
    effective = 1 / np.sum(w**2)
    c_sigma = (effective + 2) / (n + effective + 5)
    d_sigma = 1 + 2 * max(0.0, np.sqrt((effective - 1) / (n + 1)) - 1) + c_sigma
    c_path = (4 + effective / n) / (n + 4 + 2 * effective / n)
    c_one = 2 / ((n + 1.3) ** 2 + effective)
    c_rank = min(1 - c_one, 2 * (effective - 2 + 1 / effective) / ((n + 2) ** 2 + effective))
    length = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n * n))  # mean length of a normal vector
    mean = np.full(n, 0.5) if first else random.uniform(0.05, 0.95, n)
    sigma, C, path, path_sigma = 0.25, np.eye(n), np.zeros(n), np.zeros(n)
    best, best_cost, used, generation, history = mean, np.inf, 0, 0, []
    while used + size <= budget or used == 0:
        scale, B = np.linalg.eigh(C)
        scale = np.sqrt(np.maximum(scale, 1e-20))
        steps = (random.standard_normal((size, n)) * scale) @ B.T
        points = mean + sigma * steps
        inside = np.clip(points, 0.0, 1.0)
        values = np.array([cost(lower + z * (upper - lower)) for z in inside])
        values = np.where(np.isfinite(values), values, 1e6)
        used, generation = used + size, generation + 1
        k = int(np.argmin(values))
        if values[k] < best_cost:
            best, best_cost = inside[k], float(values[k])
        spread = np.ptp(np.sort(values)[: half + 1]) + 1e-12
        ranked = np.argsort(
            values + 10 * spread * np.sum((points - inside) ** 2, axis=1) / max(sigma**2, 1e-12)
        )
        chosen = steps[ranked[:half]]
        move = w @ chosen
        mean = mean + sigma * move
        path_sigma = (1 - c_sigma) * path_sigma
        path_sigma += np.sqrt(c_sigma * (2 - c_sigma) * effective) * (B @ ((B.T @ move) / scale))
        straight = np.linalg.norm(path_sigma) / np.sqrt(1 - (1 - c_sigma) ** (2 * generation))
        h = float(straight < (1.4 + 2 / (n + 1)) * length)
        path = (1 - c_path) * path + h * np.sqrt(c_path * (2 - c_path) * effective) * move
        C = (1 - c_one - c_rank) * C + c_one * (np.outer(path, path) + (1 - h) * c_path * (2 - c_path) * C)
        C = C + c_rank * (chosen.T * w) @ chosen
        C = (C + C.T) / 2
        sigma = min(sigma * np.exp(c_sigma / d_sigma * (np.linalg.norm(path_sigma) / length - 1)), 1.0)
        history.append(float(values[k]))
        window = 10 + int(30 * n / size)
        flat = len(history) > window and np.ptp(history[-window:]) < 1e-9 * max(abs(best_cost), 1e-9)
        if flat or sigma * np.max(scale) < 1e-9:
            break
    return best, best_cost, used
