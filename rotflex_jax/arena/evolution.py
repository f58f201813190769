"""Covariance matrix adaptation (CMA-ES) in a box, with restarts, and the catalogue of effects fitted by it.

Source: N. Hansen, The CMA evolution strategy: a tutorial, 2016, arXiv 1604.00772, figure 6 and table 1 with
positive weights; restarts: A. Auger and N. Hansen, A restart CMA evolution strategy with increasing
population size, CEC 2005.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rotflex_jax.mechanism import Mechanism, Solver, free_run
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import double_precision

Cost = Callable[[Float[np.ndarray, "points n"]], Float[np.ndarray, " points"]]
"""Costs of several points at once."""


class Evolved(NamedTuple):
    """Result of the evolution.

    Attributes:
        x: Best point, within the box.
        cost: Cost of this point.
        evaluations: Number of costs that were computed.
        restarts: Number of restarts.
    """

    x: Float[np.ndarray, " n"]
    cost: float
    evaluations: int
    restarts: int


def minimise(
    cost: Cost,
    lower: Float[np.ndarray, " n"],
    upper: Float[np.ndarray, " n"],
    evaluations: int,
    seed: int,
    start: Float[np.ndarray, " n"] | None = None,
) -> Evolved:
    """The least cost within a box.

    The search runs in the unit cube. Points outside of it are evaluated at the nearest point inside and
    ranked with a penalty on the squared distance. When the cost no longer falls, the search restarts at
    another point with twice as many points per generation.

    Args:
        cost: Function to minimise, evaluated at many points at once.
        lower: Least values.
        upper: Largest values.
        evaluations: Largest number of costs to compute.
        seed: Seed of the random numbers.
        start: Point at which the first run begins; the middle of the box if None.
    """
    random, n = np.random.default_rng(seed), len(lower)
    base = 4 + int(3 * np.log(n))
    begin = np.full(n, 0.5) if start is None else (start - lower) / (upper - lower)
    best, best_cost, spent, restarts = begin, np.inf, 0, 0
    while spent < evaluations:
        size = base * 2 ** min(restarts, 5)
        first = begin if not restarts else random.uniform(0.05, 0.95, n)
        x, value, used = _one(cost, lower, upper, evaluations - spent, size, random, first)
        spent, restarts = spent + used, restarts + 1
        if value < best_cost:
            best, best_cost = x, value
    return Evolved(lower + best * (upper - lower), best_cost, spent, restarts - 1)


def _one(
    cost: Cost,
    lower: np.ndarray,
    upper: np.ndarray,
    budget: int,
    size: int,
    random: np.random.Generator,
    first: np.ndarray,
) -> tuple[np.ndarray, float, int]:
    """One run: the best point in the unit cube, its cost, and the number of costs that were computed."""
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
    mean = first.copy()
    sigma, C, path, path_sigma = 0.25, np.eye(n), np.zeros(n), np.zeros(n)
    best, best_cost, used, generation, history = mean, np.inf, 0, 0, []
    while used + size <= budget or used == 0:
        scale, B = np.linalg.eigh(C)
        scale = np.sqrt(np.maximum(scale, 1e-20))
        steps = (random.standard_normal((size, n)) * scale) @ B.T
        points = mean + sigma * steps
        inside = np.clip(points, 0.0, 1.0)
        values = cost(lower + inside * (upper - lower))
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


# Effects that are left out of the evolution: those that contain another effect or nearly equal one, and those
# whose shape cannot be found within a fixed box (play with two masses, oscillators).
_LEFT_OUT = frozenset(
    {
        "backlash",
        "channel_delay",
        "coulomb_asymmetric",
        "cross_talk",
        "dahl",
        "eccentric_encoder",
        "lugre",
        "second_mode",
        "voltage_drift",
        "periodic_disturbance",
    }
)
# Number of points in one call of the compiled program, which serves any number of points.
_LANES = 16
WINDOW = 2.0
"""Length of the free runs that are fitted [s]."""

# Evaluations in the first evolution, and in each later one; largest number of named effects.
FIRST, AGAIN, MOST = 3200, 800, 4
# An effect is kept if, without it, the sum of log mean squares over validation data rises by this.
NEEDED = 0.04
# Bounds: factors of the start values for free parameters of the model; for effects, factors of typical sizes.
_FREE, _AMPLITUDE, _SHAPE = (0.5, 2.0), 3.0, (0.4, 2.5)
_DAMPER = 0.02


def _with_catalogue(model: Model) -> Model:
    """The model with many effects of the catalogue added."""
    found = model
    for kind, port in search_places(model.mechanism):
        known = [(e.name, e.at) for e in model.mechanism.effects]
        if (
            kind.name not in _LEFT_OUT
            and (kind.name, port) not in known
            and model.mechanism.accepts(kind, port)
        ):
            found = found + kind(at=port)
    return found


def _box(model: Model, whole: Model) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest value of every free parameter."""
    mechanism = whole.mechanism
    values = mechanism.named_values
    limits = dict(zip(mechanism.parameter_names, mechanism.parameter_specifications, strict=True))
    amplitudes = {e.full_name(a) for e in mechanism.effects for a in e.amplitudes}
    own, box = set(model.mechanism.free_names), []
    for name in mechanism.free_names:
        s, value = limits[name], values[name]
        if name in own:
            low, high = (_FREE[0] * value, _FREE[1] * value) if value else (0.0, _DAMPER)
        elif name in amplitudes:
            high = _AMPLITUDE * s.typical
            low = -high if s.lower < 0 else 0.0
        else:
            low, high = _SHAPE[0] * s.typical, _SHAPE[1] * s.typical
        box.append((max(low, s.lower), min(high, s.upper)))
    lower, upper = np.array(box).T
    return lower, upper


class _Runs(NamedTuple):
    """Windows of recordings: voltages (W, L), outputs (W, L, C), first states (W, n), unscored samples."""

    u: np.ndarray
    y: np.ndarray
    first: np.ndarray
    Ts: float
    unseen: int

    @classmethod
    def of(cls, recordings: Sequence[Recording], fitted: Model, whole: Model, count: int = 0) -> _Runs:
        """The windows of recordings, repeated up to the number for which a program was compiled."""
        rest = rest_state(whole.mechanism.structure, np.float64)
        u, y, first = [], [], []
        for r in recordings:
            length = min(r.N, round(WINDOW / r.Ts))
            starts = np.arange(0, r.N - length + 1, length)
            moving = fitted.states_at(r, starts)[:, : 2 * len(whole.mechanism.coordinates)]
            first += [np.concatenate([x, rest[len(x) :]]) for x in moving]
            measured = fitted.measured(r).astype(float)
            u += [r.u[a : a + length].astype(float) for a in starts]
            y += [measured[a : a + length] for a in starts]
        length = min(map(len, u))
        count = max(count, len(u))
        cut = lambda rows: np.stack([rows[k % len(rows)][:length] for k in range(count)])  # noqa: E731
        return cls(
            cut(u),
            cut(y),
            np.stack([first[k % len(first)] for k in range(count)]),
            float(recordings[0].Ts),
            recordings[0].n_init,
        )


@functools.cache
def _squares_of_many(structure: Mechanism, solver: Solver) -> Callable[..., Any]:
    """Function for the sums of squares of many points in all windows; compiled once for a machine."""

    def squares(values, gates, x0, u, y, Ts, seen):  # noqa: ANN001, ANN202 - traced
        e = (y - free_run(structure, solver, values, gates, x0, u, Ts)[1]) * seen[:, None]
        return jnp.sum(e**2, axis=0)

    windows = jax.vmap(squares, in_axes=(None, None, 0, 0, 0, None, None))
    return jax.jit(jax.vmap(windows, in_axes=(0, 0, None, None, None, None, None)))


def evolved(train: Sequence[Recording], validation: Sequence[Recording], model: Model) -> dict[str, Any]:
    """Fits all effects at once in one model, by CMA-ES on short free runs, and removes effects not needed.

    Each effect in turn is left out; the error on validation data then shows whether it is needed. Effects
    that are not needed are switched off. This is done three times, and after the first two the evolution
    continues with the other effects.

    Args:
        train: Recordings to fit.
        validation: Recordings for decisions.
        model: The textbook model.

    Returns:
        `effects` and `model`, as in an answer of a method of the arena.
    """
    whole = _with_catalogue(model)
    mechanism, base = whole.mechanism, len(model.mechanism.effects)
    runs = {"train": _Runs.of(train, model, whole)}
    runs["validation"] = _Runs.of(validation, model, whole, len(runs["train"].u))
    names, free = list(mechanism.parameter_names), list(mechanism.free_names)
    place = np.array([names.index(n) for n in free])
    owner = {e.name_prefix: i for i, e in enumerate(mechanism.effects)}
    of_effect = np.array([next(i for head, i in owner.items() if n.startswith(head)) for n in free])
    lower, upper = _box(model, whole)
    first = mechanism.values.astype(float)
    with double_precision():
        many = _squares_of_many(mechanism.structure, whole.solver)

        def costs(kind: str, values: np.ndarray, gates: np.ndarray) -> np.ndarray:
            r = runs[kind]
            seen = (np.arange(r.u.shape[1]) >= r.unseen).astype(float)
            parts = []
            for a in range(0, len(values), _LANES):
                filled = [np.resize(x[a : a + _LANES], (_LANES, *x.shape[1:])) for x in (values, gates)]
                total = np.asarray(many(*map(jnp.asarray, filled), r.first, r.u, r.y, r.Ts, seen)).sum(axis=1)
                parts.append(np.log(total / (seen.sum() * len(r.u)))[: len(values) - a])
            return np.nan_to_num(np.concatenate(parts).sum(axis=1), nan=1e6, posinf=1e6)

        on = np.ones(len(mechanism.effects))
        point = (lower + upper) / 2
        # Every effect begins small, so that the first runs are nearly those of the textbook model.
        small = of_effect >= base
        point[small] = np.clip(0.0, lower, upper)[small] + 0.02 * (upper - lower)[small]
        point[~small] = np.clip(first[place], lower, upper)[~small]
        for turn in range(3):
            moved = on[of_effect] > 0

            def values_of(X: np.ndarray, moved: np.ndarray = moved, point: np.ndarray = point) -> np.ndarray:
                full = np.tile(point, (len(X), 1))
                full[:, moved] = X
                found = np.tile(first, (len(X), 1))
                found[:, place] = full
                return found

            def cost(X: np.ndarray, on: np.ndarray = on, values_of: Callable = values_of) -> np.ndarray:
                return costs("train", values_of(X), np.tile(on, (len(X), 1)))

            budget = AGAIN if turn else FIRST
            found = minimise(cost, lower[moved], upper[moved], budget, turn, start=point[moved])
            point[moved] = found.x
            values = values_of(found.x[None])[0]
            listed = [i for i in range(base, len(on)) if on[i]]
            if not listed:
                break
            gates = np.stack([on, *(np.where(np.arange(len(on)) == i, 0.0, on) for i in listed)])
            error = costs("validation", np.tile(values, (len(gates), 1)), gates)
            rise = dict(zip(listed, error[1:] - error[0], strict=True))
            needed = sorted((i for i in listed if rise[i] > NEEDED), key=lambda i: -rise[i])
            kept = needed[: 2 * MOST if turn == 0 else MOST]
            on = np.array([1.0 if i < base or i in kept else 0.0 for i in range(len(on))])
    known = dict(zip(names, values.tolist(), strict=True))
    result = model
    chosen = sorted((i for i in range(base, len(on)) if on[i]), key=lambda i: -rise[i])
    for i in chosen:
        result = result + mechanism.effects[i]
    fitted = result.mechanism.with_values({n: known[n] for n in result.mechanism.parameter_names})
    return {
        "effects": [(mechanism.effects[i].name, mechanism.effects[i].at) for i in chosen],
        "model": Model(fitted, model.solver),
    }
