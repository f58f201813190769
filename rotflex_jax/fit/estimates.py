"""From the optimum of a fit to what a person reads: estimates, intervals, the weakest direction."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.fit.covariance import sandwich
from rotflex_jax.fit.residuals import Coordinates, Data
from rotflex_jax.model import Fit, Model
from rotflex_jax.parameters import Estimate


def report(
    model: Model,
    coordinates: Coordinates,
    flat: np.ndarray,
    index: np.ndarray,
    data: Data,
    scale: np.ndarray,
    e: jax.Array,
    J: jax.Array,
    status: str,
    steps: int,
    history: list[float],
) -> Fit:
    """Estimates with intervals, from the residuals and slopes at the optimum."""
    m = model.mechanism
    R, N, C = data.y.shape
    seen = data.seen.ravel() > 0
    residual = np.asarray(e).reshape(R * N, C)[seen]
    slopes = -np.asarray(J).reshape(R * N, C, len(index))[seen]
    segments = np.repeat(np.arange(R), N)[seen]
    values = np.asarray(coordinates.split(jnp.asarray(flat))[0])
    fitted = m.with_values(values.mean(axis=0))
    covariance = sandwich(slopes, residual, segments)
    estimates, free, places = [], [], []
    dp = coordinates.transform.physical(flat[: coordinates.parameters])[1]
    for i, (name, spec) in enumerate(zip(m.parameter_names, m.parameter_specifications, strict=True)):
        value = float(values[:, i].mean())
        if name in m.trusted:
            nan = float("nan")
            estimates.append(Estimate(name, value, nan, (nan, nan), spec.unit, free=False))
            continue
        own = [coordinates.local_index(r, i) for r in range(R)] if i in coordinates.local else [i]
        rows = [int(np.flatnonzero(index == k)[0]) for k in own]
        weights = np.array([dp[i] for _ in own]) / len(own)
        std = float(np.sqrt(weights @ covariance[np.ix_(rows, rows)] @ weights))
        estimates.append(Estimate.of(name, value, std, spec))
        free.append(name)
        places.append((rows[0], dp[i]))
    rows = [r for r, _ in places]
    D = np.array([d for _, d in places])
    natural = covariance[np.ix_(rows, rows)] * np.outer(D, D)
    deviation = np.sqrt(np.mean(residual**2, axis=0)) * scale
    cost = float(np.sum(len(residual) * (np.log(deviation) + 0.5 * np.log(2 * np.pi) + 0.5)))
    return Fit(
        model=dataclasses.replace(model, mechanism=fitted),
        cost=cost,
        status=status,
        parameters=tuple(estimates),
        noise=dict(zip(m.channels, deviation.tolist(), strict=True)),
        covariance=natural,
        free_names=tuple(free),
        steps=steps,
        history=tuple(history),
        weakest=_weakest(slopes[:, :, rows], free),
    )


def _weakest(slopes: np.ndarray, names: list[str]) -> dict[str, float]:
    """The combination of parameters that the data determine least, its largest entry 1."""
    if not np.isfinite(slopes).all():
        return {}
    H = np.einsum("nci,ncj->ij", slopes, slopes)
    direction = np.linalg.eigh(H)[1][:, 0]
    direction = direction / direction[np.argmax(np.abs(direction))]
    return dict(zip(names, direction.tolist(), strict=True))
