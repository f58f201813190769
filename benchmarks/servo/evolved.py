"""Servos fitted by CMA-ES: the extended friction models, as their authors fit them, and the grey box.

The second corresponds to PACE, which fits the parameters of one model of a robot by CMA-ES to errors of free
runs.

Source: F. Bjelonic, F. Tischhauser, M. Hutter, Towards bridging the gap: systematic sim-to-real transfer for
diverse legged robots, 2025, arXiv 2509.06342 (PACE).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rotflex_jax as rf
from rotflex_jax.arena.evolution import minimise
from rotflex_jax.mechanism import free_run
from rotflex_jax.runtime.xla import double_precision
from servo import friction_models
from servo.friction_models import Logs
from servo.recordings import Split, errors, logs

Box = dict[str, tuple[float, float]]
"""Name -> least and largest value."""

# Number of parameter sets that are simulated at once.
_LANES = 16


def evolved(name: str, split: Split, rollouts: int, seed: int) -> dict[str, Any]:
    """Fits one of M1 to M6 by the mean absolute error of free runs, and returns its row of the results.

    Args:
        name: Name of the model.
        split: Training and test recordings.
        rollouts: Largest number of cost evaluations, each with a free run of every training recording.
        seed: Seed of the evolution.
    """
    row = _of_model(friction_models.MODELS[name], logs(split.train), rollouts, seed)
    runs = lambda of: list(friction_models.rollouts(row["parameters"], logs(of)))  # noqa: E731
    return row | {
        "train": errors(runs(split.train), split.train),
        "test": errors(runs(split.test), split.test),
    }


def evolved_models(train: Logs, rollouts: int, more: Box, other: Box) -> dict[str, dict[str, Any]]:
    """Fits M1 to M6 with unknown gain and weight.

    Args:
        train: Training recordings; their `slope` and `load` are not used.
        rollouts: Largest number of cost evaluations for each model, each with a free run of every training
            recording.
        more: Bounds of `slope` [1/rad] and `load` [N m].
        other: Bounds that replace those of an XL-330; a parameter with equal bounds is not fitted but zero.
    """
    found = {}
    for name, box in friction_models.MODELS.items():
        wanted = {n: other.get(n, b) for n, b in box.items()} | more
        found[name] = _of_model({n: b for n, b in wanted.items() if b[1] > b[0]}, train, rollouts, seed=1)
    return found


def _of_model(box: Box, train: Logs, rollouts: int, seed: int) -> dict[str, Any]:
    lower, upper = np.array(list(box.values())).T
    named = lambda x: dict(zip(box, x.tolist(), strict=True))  # noqa: E731
    friction_models.mean_error(named((lower + upper) / 2), train)  # compiled once, not counted
    began = time.perf_counter()
    cost = lambda X: np.array([friction_models.mean_error(named(x), train) for x in X])  # noqa: E731
    found = minimise(cost, lower, upper, rollouts, seed)
    return {
        "seconds": time.perf_counter() - began,
        "rollouts": found.evaluations * len(train.goal),
        "restarts": found.restarts,
        "parameters": named(found.x),
    }


def evolved_alike(
    mechanism: rf.Mechanism | rf.Model, train: Sequence[rf.Recording], box: Box, rollouts: int, seed: int
) -> tuple[rf.Model, dict[str, Any]]:
    """Fits the grey box by CMA-ES to the sum of squared free-run errors, which `rf.fit` also minimises.

    First positions and speeds are those of the measured angles.

    Args:
        mechanism: Mechanism or model whose free parameters are fitted.
        train: Training recordings.
        box: Bounds of the free parameters; a parameter without bounds keeps its value.
        rollouts: Largest number of cost evaluations, each with a free run of every training recording.
        seed: Seed of the evolution.

    Returns:
        The model, and a row with parameters, time and number of free runs.
    """
    model = rf.Model.of(mechanism)
    names = [n for n in model.mechanism.free_names if n in box]
    lower, upper = np.array([box[n] for n in names]).T
    cost = _squares(model, names, train)
    cost(np.tile((lower + upper) / 2, (_LANES, 1)))  # compiled once, not counted
    began = time.perf_counter()
    found = minimise(cost, lower, upper, rollouts, seed)
    values: Mapping[str, float] = dict(zip(names, found.x.tolist(), strict=True))
    return model.with_values(values), {
        "seconds": time.perf_counter() - began,
        "rollouts": found.evaluations * len(train),
        "restarts": found.restarts,
        "parameters": dict(values),
    }


def _squares(
    model: rf.Model, names: Sequence[str], train: Sequence[rf.Recording]
) -> Callable[[np.ndarray], np.ndarray]:
    """Cost function of many points: sum of squares over all recordings, each with its own constants."""
    mechanism = model.mechanism
    place = np.array([mechanism.parameter_names.index(n) for n in names])
    N = max(r.N for r in train)
    pad = lambda x: np.pad(x, (0, N - len(x)), mode="edge")  # noqa: E731
    u, y = (np.stack([pad(x(r)) for r in train]) for x in (lambda r: r.u, lambda r: r.y[:, 0]))
    seen = np.stack([(np.arange(N) >= r.n_init) & (np.arange(N) < r.N) for r in train]).astype(float)
    first = np.stack([model.states_at(r, np.array([0]))[0] for r in train])
    own = np.stack([model.at(r).mechanism.values.astype(float) for r in train])
    structure, solver, Ts = mechanism.structure, model.solver, float(train[0].Ts)
    gates = np.ones(len(mechanism.effects))

    def squares(x, values, x0, u, y, seen):
        run = free_run(structure, solver, values.at[place].set(x), gates, x0, u, jnp.asarray(Ts))[1][:, 0]
        return jnp.sum(seen * (y - run) ** 2)

    each = jax.vmap(squares, in_axes=(None, 0, 0, 0, 0, 0))
    many = jax.jit(jax.vmap(each, in_axes=(0, None, None, None, None, None)))

    def cost(X: np.ndarray) -> np.ndarray:
        found = []
        with double_precision():
            for a in range(0, len(X), _LANES):
                lanes = np.resize(X[a : a + _LANES], (_LANES, X.shape[1]))
                found.append(np.asarray(many(lanes, own, first, u, y, seen)).sum(axis=1)[: len(X) - a])
        return np.nan_to_num(np.concatenate(found), nan=1e6, posinf=1e6)

    return cost
