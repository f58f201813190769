"""The extended friction models, fitted by evolution as their authors do."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from rotflex_jax.arena.evolution import minimise
from servo import friction_models
from servo.recordings import Split, errors, logs


def evolved(name: str, split: Split, rollouts: int, seed: int) -> dict[str, Any]:
    """One of M1 to M6: the least mean absolute error of free runs, and its row of the results.

    Args:
        name: Of the model.
        split: What is learnt from.
        rollouts: Free runs of all training recordings together at most.
        seed: Of the evolution.
    """
    box, train = friction_models.MODELS[name], logs(split.train)
    lower, upper = np.array(list(box.values())).T
    named = lambda x: dict(zip(box, x.tolist(), strict=True))  # noqa: E731
    friction_models.mean_error(named((lower + upper) / 2), train)  # compiled once, not counted
    began = time.perf_counter()
    cost = lambda X: np.array([friction_models.mean_error(named(x), train) for x in X])  # noqa: E731
    found = minimise(cost, lower, upper, rollouts, seed)
    seconds = time.perf_counter() - began
    runs = lambda of: list(friction_models.rollouts(named(found.x), logs(of)))  # noqa: E731
    return {
        "seconds": seconds,
        "rollouts": found.evaluations * len(split.train),
        "restarts": found.restarts,
        "parameters": named(found.x),
        "train": errors(runs(split.train), split.train),
        "test": errors(runs(split.test), split.test),
    }
