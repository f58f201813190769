"""Hypotheses side by side: innovations and their slopes for several parameter sets in one call."""

import dataclasses
import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.discover.supermodel import Place, SuperModel
from rotflex_jax.discover.whiten import Whitener
from rotflex_jax.fit.residuals import Data, predicted
from rotflex_jax.mechanism import Mechanism, Solver
from rotflex_jax.parameters import Transform
from rotflex_jax.precision import double_precision

# Lanes per call for values alone, where lanes come nearly free. Slopes run one lane a call: their
# directions fill the vector units, so more lanes would only take longer to compile.
LANES = 4


class Lane(NamedTuple):
    """Numbers of one hypothesis for all recordings; stacked, a leading axis is added."""

    values: Any  # (R, P)
    x0: Any  # (R, m)
    gates: Any  # (E,)
    K: Any  # (R, n, C)


class Directions(NamedTuple):
    """Tangents (D, ...) in which a lane is differentiated."""

    values: Any  # (D, R, P)
    x0: Any  # (D, m), the same in every recording
    gates: Any  # (D, E)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _innovations(structure: Mechanism, solver: Solver, lanes: Lane, data: Data) -> jax.Array:
    def one(lane: Lane) -> jax.Array:
        y_hat = predicted(structure, solver, lane.values, lane.x0, lane.gates, data, lane.K)
        return (data.y - y_hat) * data.seen[:, :, None]

    return jax.vmap(one)(lanes)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _slopes(
    structure: Mechanism, solver: Solver, lane: Lane, along: Directions, data: Data
) -> tuple[jax.Array, jax.Array]:
    def run(values: jax.Array, x0: jax.Array, gates: jax.Array) -> jax.Array:
        return predicted(structure, solver, values, x0, gates, data, lane.K)

    def slope(dv: jax.Array, dx: jax.Array, dg: jax.Array) -> tuple[jax.Array, jax.Array]:
        point = (lane.values, lane.x0, lane.gates)
        return jax.jvp(run, point, (dv, jnp.broadcast_to(dx, lane.x0.shape), dg))

    y_hat, J = jax.vmap(slope, out_axes=(None, 0))(*along)
    mask = data.seen[:, :, None]
    return (data.y - y_hat) * mask, -J * mask[None]


def _stacked(parts: list[Lane]) -> Lane:
    """Leading axis over lanes; a short batch is filled up with copies of its last lane."""
    full = parts + [parts[-1]] * (LANES - len(parts))
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *full)


@dataclasses.dataclass(frozen=True)
class Bench:
    """Where hypotheses are run: one super-model, one solver, one set of recordings.

    Attributes:
        supermodel: What is compiled.
        solver: Integration rule.
        data: The recordings.
        compiled: Which programs have run once, and so may run on several threads.
    """

    supermodel: SuperModel
    solver: Solver
    data: Data
    compiled: set[str] = dataclasses.field(default_factory=set)

    def innovations(self, lanes: list[Lane]) -> np.ndarray:
        """Innovations (L, R, N, C) of any number of lanes."""
        structure = self.supermodel.mechanism.structure

        def run(part: list[Lane]) -> np.ndarray:
            with double_precision():
                e = _innovations(structure, self.solver, _stacked(part), self._on_device())
                return np.asarray(e)[: len(part)]

        parts = [lanes[i : i + LANES] for i in range(0, len(lanes), LANES)]
        return np.concatenate(self._each(run, parts, "innovations"))

    def slopes(self, lanes: list[Lane], directions: list[Directions]) -> tuple[np.ndarray, np.ndarray]:
        """Innovations (L, R, N, C) and their slopes (L, D, R, N, C)."""
        structure = self.supermodel.mechanism.structure

        def run(pair: tuple[Lane, Directions]) -> tuple[np.ndarray, np.ndarray]:
            with double_precision():
                e, J = _slopes(structure, self.solver, *pair, self._on_device())
                return np.asarray(e), np.asarray(J)

        pairs = self._each(run, list(zip(lanes, directions, strict=True)), "slopes")
        return np.stack([e for e, _ in pairs]), np.stack([J for _, J in pairs])

    def _each(self, run: Callable[[Any], Any], parts: list[Any], what: str) -> list[Any]:
        if what in self.compiled:
            return _side_by_side(run, parts)
        first = run(parts[0])
        self.compiled.add(what)
        return [first, *(_side_by_side(run, parts[1:]) if parts[1:] else [])]

    def _on_device(self) -> Data:
        return jax.tree.map(jnp.asarray, self.data)


def _side_by_side(run: Callable[[Any], Any], parts: list[Any]) -> list[Any]:
    """Results of independent calls, on as many threads as there are cores.

    A scan keeps one core busy whatever its width; compiled code runs outside of Python's lock.

    Args:
        run: What to call; compiled before, so that no two threads compile the same.
        parts: Its arguments.
    """
    with ThreadPoolExecutor(min(len(parts), os.cpu_count() or 1)) as pool:
        return list(pool.map(run, parts))


@dataclasses.dataclass(frozen=True)
class Hypothesis:
    """One model on one set of recordings, with everything a comparison needs.

    Attributes:
        places: Candidates and calibrations that are switched on, in the order they came.
        free: Parameters common to all recordings that are fitted.
        local: Parameters that each recording has for itself and that are fitted.
        z: Unconstrained values (P,).
        own: Unconstrained values of the local parameters (R, len(local)).
        x0: First positions and speeds (R, m).
        K: Gains (R, n, C).
        process_noise: Port -> intensity that gave `K`.
        whitener: Fixed while parameters move.
        densities: Log-likelihood of each training sample (R, N) [nat].
    """

    places: tuple[Place, ...]
    free: tuple[int, ...]
    local: tuple[int, ...]
    z: np.ndarray
    own: np.ndarray
    x0: np.ndarray
    K: np.ndarray
    process_noise: dict[str, float]
    whitener: Whitener
    densities: np.ndarray = dataclasses.field(default_factory=lambda: np.array(-np.inf))

    @property
    def log_likelihood(self) -> float:
        """Of the training recordings [nat]."""
        total = float(np.sum(self.densities))
        return total if np.isfinite(total) else -np.inf

    def values(self, bench: Bench) -> np.ndarray:
        """Physical values (R, P)."""
        z = np.tile(self.z, (len(self.x0), 1))
        if self.local:
            z[:, list(self.local)] = self.own
        return constrain(bench, z)[0]

    def lane(self, bench: Bench) -> Lane:
        """The numbers to run."""
        return Lane(self.values(bench), self.x0, bench.supermodel.gates(self.places), self.K)

    @property
    def moved(self) -> int:
        """Number of directions a fit moves: common, then local, then first states."""
        return len(self.free) + len(self.local) + self.x0.shape[1]

    def directions(self, bench: Bench, count: int) -> Directions:
        """Tangents of all that a fit moves, in unconstrained coordinates, filled up with zeros."""
        R, P = len(self.x0), len(self.z)
        z = np.tile(self.z, (R, 1))
        if self.local:
            z[:, list(self.local)] = self.own
        stretch = constrain(bench, z)[1]
        E, m = len(bench.supermodel.mechanism.effects), self.x0.shape[1]
        d = Directions(np.zeros((count, R, P)), np.zeros((count, m)), np.zeros((count, E)))
        for k, i in enumerate((*self.free, *self.local)):
            d.values[k, :, i] = stretch[:, i]
        start = len(self.free) + len(self.local)
        d.x0[start : start + m] = np.eye(m)
        return d


def constrain(bench: Bench, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Physical values of unconstrained ones (..., P), and their derivative."""
    return Transform.of(bench.supermodel.mechanism.parameter_specifications).physical(z)
