"""Levenberg-Marquardt of a fit: runs with their normal equations are compiled, the steps between are not."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.sharding import Mesh

from rotflex_jax.devices import spread
from rotflex_jax.fit.marquardt import BOUND
from rotflex_jax.fit.normal_equations import Sums, moved_by, normal_equations
from rotflex_jax.fit.residuals import Coordinates, Data
from rotflex_jax.mechanism import Solver
from rotflex_jax.mechanism.absent import Numbers, Samples
from rotflex_jax.mechanism.assembly import whole_state
from rotflex_jax.mechanism.programs import kept
from rotflex_jax.mechanism.tangents import Ways, outputs_with_slopes

# A step that would lower the negative log-likelihood by less than this is not taken [nat]. A relative
# tolerance would stop a long recording many nats short of the optimum.
NATS = 1e-3
# Nor does it go on where that many steps lowered it by less than that: along a bend, or towards a bound.
FEW, LITTLE = 8, 0.1
# Damping from which a step is held short.
SHORT = 1e-3
# Where no step lowers the cost, however short.
STUCK = 1e10
UNSOLVED = "stopped: a step has no finite solution; the model diverges near these numbers"


@dataclasses.dataclass(frozen=True)
class Moved:
    """Which of the coordinates a fit moves, and what runs them; hashable, so it can be static.

    Attributes:
        coordinates: All of them.
        solver: Integration rule.
        free: Places of the free parameters.
        states: Whether first states are moved.
        mesh: Devices that the recordings are shared out to; None for one device.
    """

    coordinates: Coordinates
    solver: Solver
    free: tuple[int, ...]
    states: bool
    mesh: Mesh | None = None

    @functools.cached_property
    def columns(self) -> np.ndarray:
        """Places in the flat vector of the directions of each recording (R, D)."""
        c = self.coordinates
        owned = lambda r, i: c.local_index(r, i) if i in c.local else i  # noqa: E731
        rows = [
            [owned(c.owners[r], i) for i in self.free] + (c.state_index(r).tolist() if self.states else [])
            for r in range(c.recordings)
        ]
        return np.array(rows)

    @functools.cached_property
    def index(self) -> np.ndarray:
        """Places in the flat vector of what is moved (M,): common parameters, local ones, states."""
        return np.unique(self.columns)

    @functools.cached_property
    def places(self) -> np.ndarray:
        """Places of the directions of each recording among the moved (R, D)."""
        return np.searchsorted(self.index, self.columns)

    @functools.cached_property
    def bounds(self) -> np.ndarray:
        """Most that a step moves each (M,): a parameter with a bound by a factor of e, others freely."""
        specs = self.coordinates.structure.parameter_specifications
        most = np.full(len(self.index), np.inf)
        for column, i in enumerate(self.free):
            if np.isfinite(specs[i].lower) or np.isfinite(specs[i].upper):
                most[self.places[:, column]] = BOUND
        return most

    def each(self, flat: jax.Array, gates: jax.Array, K: jax.Array) -> tuple[Numbers, Ways]:
        """Numbers and directions of each recording, along a leading axis."""
        structure, c = self.coordinates.structure, self.coordinates
        (values, x0), (slopes, _) = jax.jvp(c.split, (flat,), (jnp.ones_like(flat),))
        moved = c.states if self.states else 0
        ways = jax.vmap(lambda s: moved_by(structure, s, jnp.array(self.free), moved))(slopes)
        return Numbers(
            values, jnp.broadcast_to(gates, (len(values), *gates.shape)), whole_state(structure, x0), K
        ), ways


class Given(NamedTuple):
    """What a descent holds: gates (E,), recordings, gains (R, n, C), size of each channel's error (C,)."""

    gates: Any
    data: Data
    K: Any
    scale: Any


@kept(static=1)
def sums(moved: Moved, flat: jax.Array, given: Given) -> Sums:
    """Sums over all recordings, by the M moved coordinates."""

    def one(numbers: Numbers, ways: Ways, samples: Samples, scale: jax.Array) -> Sums:
        structure = moved.coordinates.structure
        return normal_equations(structure, moved.solver, numbers, ways, samples, scale)

    found = _each_recording(one, moved, flat, given)
    M, places = len(moved.index), jnp.asarray(moved.places)
    g = jnp.zeros(M, flat.dtype).at[places].add(found.g)
    H = jnp.zeros((M, M), flat.dtype).at[places[:, :, None], places[:, None, :]].add(found.H)
    return Sums(jnp.sum(found.cost, axis=0), g, H)


@kept(static=1)
def residuals_and_slopes(moved: Moved, flat: jax.Array, given: Given) -> tuple[jax.Array, jax.Array]:
    """Scaled errors (R, N, C) and their slopes by what each recording moves (R, N, C, D)."""

    def one(numbers: Numbers, ways: Ways, samples: Samples, scale: jax.Array) -> tuple[jax.Array, jax.Array]:
        y_hat, J = outputs_with_slopes(moved.coordinates.structure, moved.solver, numbers, ways, samples)
        seen = samples.seen[:, None] > 0
        e = jnp.where(seen, (samples.y - y_hat) / scale[None], 0.0)
        return e, jnp.where(seen[..., None], -J / scale[None, :, None], 0.0)

    return _each_recording(one, moved, flat, given)


def _each_recording(one: Callable[..., Any], moved: Moved, flat: jax.Array, given: Given) -> Any:
    """`one` of the numbers, directions, samples and scale of each recording, along a leading axis."""

    def every(rows: Any, scale: jax.Array) -> Any:
        return jax.lax.map(lambda r: one(r[0], r[1], Samples(*r[2]), scale), rows)

    rows = (*moved.each(flat, given.gates, given.K), tuple(given.data))
    return spread(every, moved.mesh)(rows, given.scale)


class Reached(NamedTuple):
    """Where a descent ended: flat vector, half the squared errors (C,) at its start and here, steps, how."""

    flat: np.ndarray
    first: np.ndarray
    cost: np.ndarray
    steps: int
    status: str


def descend(
    moved: Moved,
    flat: np.ndarray,
    given: Given,
    max_steps: int,
    say: Callable[[str], None],
    enough: float = NATS,
) -> Reached:
    """The least squared error near a place, in float64, as far as steps gain `enough` [nat]."""
    run = lambda flat: jax.device_get(sums(moved, flat, given))  # noqa: E731
    cost, g, H = run(flat)
    first = cost
    if not np.isfinite(cost).all():
        return Reached(flat, first, cost, 0, "diverged: the model error at the start is not finite")
    damping, used, before = SHORT, 0, float("inf")
    while used < max_steps:
        step = _step(g, H, damping, moved.bounds)
        if step is None:
            return Reached(flat, first, cost, used, UNSOLVED)
        expected = -(g @ step + step @ H @ step / 2)
        if expected < enough and damping <= SHORT:
            return Reached(flat, first, cost, used, "converged")
        there = flat.copy()
        there[moved.index] += step
        trial = run(there)
        used += 1
        gain = float(cost.sum() - trial.cost.sum())
        if gain > 0:
            flat, (cost, g, H) = there, trial
            damping = max(damping / 10, 1e-12)
        else:  # also where it is not a number
            damping *= 8
        say(f"fit: {used} steps, cost {cost.sum():.1f}")
        slow = False
        if used % FEW == 0:
            before, slow = cost.sum(), before - cost.sum() < LITTLE
        # A step that was held short says nothing of what is left to gain.
        if slow or (0 < gain < enough and damping <= SHORT) or damping > STUCK:
            return Reached(flat, first, cost, used, "converged")
    return Reached(flat, first, cost, used, f"stopped after {max_steps} steps")


def _step(g: np.ndarray, H: np.ndarray, damping: float, bounds: np.ndarray) -> np.ndarray | None:
    """Damped Gauss-Newton step within the bounds; None where there is none.

    Where an entry meets its bound, the others are the best for that.
    """
    if not (np.isfinite(g).all() and np.isfinite(H).all()):
        return None
    size = np.sqrt(np.where(np.diag(H) > 0, np.diag(H), 1.0))
    A, b = H / np.outer(size, size) + (damping + 1e-14) * np.eye(len(H)), -g / size
    step, free = np.zeros(len(g)), np.ones(len(g), bool)
    while free.any():
        within = np.ix_(free, free)
        right = b[free] - A[free][:, ~free] @ (step * size)[~free]
        try:
            found = scipy.linalg.cho_solve(scipy.linalg.cho_factor(A[within]), right)
        except np.linalg.LinAlgError:
            found = np.linalg.pinv(A[within], rcond=1e-12, hermitian=True) @ right
        step[free] = found / size[free]
        over = free & (np.abs(step) > bounds)
        if not over.any():
            break
        step[over] = np.sign(step[over]) * bounds[over]
        free &= ~over
    return step
