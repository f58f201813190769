"""From the optimum of a fit to what a person reads: estimates, intervals, the weakest direction."""

import dataclasses

import jax
import numpy as np

from rotflex_jax.fit.covariance import Part, curvature, sandwich
from rotflex_jax.fit.fitted import Fit
from rotflex_jax.fit.stages import Ended, Task
from rotflex_jax.parameters import Estimate


def report(task: Task, end: Ended, e: jax.Array, J: jax.Array) -> Fit:
    """Estimates with intervals.

    Args:
        task: What was fitted to what.
        end: The optimum.
        e: Scaled errors there (R, N, C).
        J: Their slopes by what each recording moves (R, N, C, D).
    """
    model, data, coordinates, index = task.model, task.data, task.moved.coordinates, task.moved.index
    m = model.mechanism
    slopes, left, seen = np.asarray(J), np.asarray(e), data.seen > 0
    parts = [Part(slopes[r, s], left[r, s], task.moved.places[r]) for r, s in enumerate(seen)]
    residual = np.concatenate([part.e for part in parts])
    each = range(coordinates.owning)
    z = np.tile(end.flat[: coordinates.parameters], (len(each), 1))
    for i in coordinates.local:
        z[:, i] = [end.flat[coordinates.local_index(r, i)] for r in each]
    values, stretch = coordinates.transform.physical(z)
    H = curvature(parts, len(index))
    covariance = sandwich(parts, H)
    row_of = {int(k): row for row, k in enumerate(index)}
    estimates, free, places = [], [], []
    local: dict[str, tuple[Estimate, ...]] = {}
    for i, (name, spec) in enumerate(zip(m.parameter_names, m.parameter_specifications, strict=True)):
        value = float(values[:, i].mean())
        if name in m.trusted:
            nan = float("nan")
            estimates.append(Estimate(name, value, nan, (nan, nan), spec.unit, free=False))
            continue
        owned = i in coordinates.local
        rows = [row_of[coordinates.local_index(r, i)] for r in each] if owned else [row_of[i]]
        weights = stretch[: len(rows), i] / len(rows)
        std = float(np.sqrt(weights @ covariance[np.ix_(rows, rows)] @ weights))
        estimates.append(Estimate.of(name, value, std, spec))
        if owned:
            stds = np.abs(stretch[:, i]) * np.sqrt(np.diag(covariance)[rows])
            pairs = zip(values[:, i].tolist(), stds.tolist(), strict=True)
            local[name] = tuple(Estimate.of(name, own, deviation, spec) for own, deviation in pairs)
        free.append(name)
        places.append((rows, weights))
    natural = np.array([[a @ covariance[np.ix_(i, k)] @ b for k, b in places] for i, a in places])
    together = np.zeros((len(index), len(places)))
    for column, (rows, _) in enumerate(places):
        together[rows, column] = 1.0
    deviation = np.sqrt(np.mean(residual**2, axis=0)) * np.asarray(end.given.scale)
    cost = float(np.sum(len(residual) * (np.log(deviation) + 0.5 * np.log(2 * np.pi) + 0.5)))
    return Fit(
        model=dataclasses.replace(model, mechanism=m.with_values(values.mean(axis=0))),
        cost=cost,
        status=end.status,
        parameters=tuple(estimates),
        noise=dict(zip(m.channels, deviation.tolist(), strict=True)),
        covariance=natural,
        free_names=tuple(free),
        steps=end.steps,
        history=tuple(end.history),
        weakest=_weakest(together.T @ H @ together, free),
        local=local,
    )


def _weakest(H: np.ndarray, names: list[str]) -> dict[str, float]:
    """The combination of parameters that the data determine least, its largest entry 1."""
    if not np.isfinite(H).all():
        return {}
    direction = np.linalg.eigh(H)[1][:, 0]
    direction = direction / direction[np.argmax(np.abs(direction))]
    return dict(zip(names, direction.tolist(), strict=True))
