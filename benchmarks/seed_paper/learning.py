"""Learning curves of adaptive filters, for many filters and recordings at once."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.adaptive import AdaptiveFilter, scan
from rotflex_jax.basis import Basis
from rotflex_jax.runtime.xla import double_precision
from seed_paper.records import record

EVERY = 10
"""Samples between two evaluations of the weights."""

CUTOFF = 2.0
"""Cutoff of the input in comparisons of filters [Hz]."""


@functools.partial(jax.jit, static_argnums=0)
def _part(
    filter_of: Callable[[Any], AdaptiveFilter],
    settings: Any,
    states: Any,
    phi: Any,
    y: Any,
    root: Any,
    target: Any,
) -> tuple[Any, Any]:
    """States after a part of the recordings, and `|root (w - target)|^2` (runs, settings, evaluations)."""

    def one_run(state, phi, y, target):
        def one_filter(setting, state):
            filter = filter_of(setting)

            def chunk(state, samples):
                state, _ = scan(filter, *samples, state)
                return state, jnp.sum((root @ (filter.weights(state) - target)) ** 2)

            chunks = jax.tree.map(lambda x: x.reshape(-1, EVERY, *x.shape[1:]), (phi, y))
            return jax.lax.scan(chunk, state, chunks)

        return jax.vmap(one_filter)(settings, state)

    return jax.vmap(one_run)(states, phi, y, target)


def distances(
    filter_of: Callable[[Any], AdaptiveFilter],
    settings: np.ndarray,
    phi: np.ndarray,
    y: np.ndarray,
    root: np.ndarray,
    target: np.ndarray,
    *,
    below: float = 0.0,
    part: int = 5000,
) -> np.ndarray:
    """Squared distance of the weights from the target every `EVERY` samples (runs, settings, evaluations).

    Args:
        filter_of: function from a row of the settings to a filter. Use a module-level function, since a new
            function is compiled again.
        settings: one row per filter (S, k).
        phi: regressors (runs, N, P).
        y: outputs (runs, N).
        root: (K, P), so that the distance is `|root (w - target)|^2`.
        target: weights (P,), or (runs, P).
        below: stop once at least one filter has come below this distance in every run.
        part: samples in one call, a multiple of `EVERY`; an incomplete last part is left out.
    """
    runs, N = y.shape
    part = min(part, N // EVERY * EVERY)
    with double_precision():
        settings = jnp.asarray(settings, float)
        target = jnp.broadcast_to(jnp.asarray(target), (runs, np.shape(target)[-1]))
        root = jnp.asarray(root)
        start = lambda _, s: filter_of(s).init(target.shape[1], float)  # noqa: E731
        states = jax.vmap(lambda r: jax.vmap(functools.partial(start, r))(settings))(jnp.arange(runs))
        looks = []
        for k in range(0, N - part + 1, part):
            samples = jnp.asarray(phi[:, k : k + part]), jnp.asarray(y[:, k : k + part])
            states, seen = _part(filter_of, settings, states, *samples, root, target)
            looks.append(np.asarray(seen))
            least = np.nanmin(
                np.stack([np.nanmin(np.where(np.isfinite(d), d, np.inf), axis=2) for d in looks]), axis=0
            )
            if np.all(least.min(axis=1) < below):
                break
    return np.concatenate(looks, axis=2)


def first_below(distance: np.ndarray, level: float) -> np.ndarray:
    """Samples until a distance (..., evaluations) first falls below a level; infinite if it never does."""
    there = distance < level
    return np.where(there.any(axis=-1), (np.argmax(there, axis=-1) + 1) * EVERY, np.inf)


@jax.jit
def _weights(filter: AdaptiveFilter, phi: Any, y: Any) -> Any:
    def one_run(phi, y):
        def chunk(state, samples):
            state, _ = scan(filter, *samples, state)
            return state, filter.weights(state)

        chunks = jax.tree.map(lambda x: x.reshape(-1, EVERY, *x.shape[1:]), (phi, y))
        return jax.lax.scan(chunk, filter.init(phi.shape[1], phi.dtype), chunks)[1]

    return jax.vmap(one_run)(phi, y)


def paths(filter: AdaptiveFilter, phi: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Weights every `EVERY` samples (runs, evaluations, P), for regressors (runs, N, P)."""
    with double_precision():
        return np.asarray(_weights(filter, jnp.asarray(phi), jnp.asarray(y)))


@dataclasses.dataclass(frozen=True)
class Task:
    """Recordings with the regressors of one basis, and the best fixed weights.

    Attributes:
        phi: Regressors (runs, N, P).
        y: Outputs (runs, N), divided by the root mean square error of the best weights.
        target: Best weights: least squares on a long recording (P,).
        root: Factor of the Gram matrix `root' root` of this recording (P, P), so that
            `|root (w - target)|^2` is the excess squared error as a share of the least squared error.
        degrees: Degree of each regressor (P,).
        condition: Condition number of the Gram matrix.
    """

    phi: np.ndarray
    y: np.ndarray
    target: np.ndarray
    root: np.ndarray
    degrees: np.ndarray
    condition: float

    @classmethod
    def of(
        cls,
        scenario: str,
        basis: Basis,
        Ts: float,
        N: int,
        runs: int,
        cutoff: float | None = CUTOFF,
    ) -> Task:
        """The task for a simulated scenario; the first second after the start from rest is left out."""
        first = round(1.0 / Ts)
        u, y = record(scenario, Ts, 60_000, cutoff, 999)
        X, y = basis.regressors(u)[first:], y[first:]
        w = np.linalg.lstsq(X, y, rcond=None)[0]
        least = np.sqrt(np.mean((y - X @ w) ** 2))
        root = np.linalg.qr(X, mode="r") / np.sqrt(len(X))
        seen = [record(scenario, Ts, N + first, cutoff, seed) for seed in range(runs)]
        phi = np.array([basis.regressors(u)[first:] for u, _ in seen])
        condition = float(np.linalg.cond(root)) ** 2
        return cls(
            phi, np.array([y[first:] for _, y in seen]) / least, w / least, root, basis.degrees, condition
        )

    def powers(self) -> tuple[float, float]:
        """Sum of the mean squares of the regressors of degree 1 and of degree 2."""
        square = np.sum(self.root**2, axis=0)
        return float(np.sum(square[self.degrees == 1])), float(np.sum(square[self.degrees == 2]))
