"""The objective at given settings, and the result that a search hands back."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Float

from rotflex_jax.adaptive.bounds import Stability, analyse
from rotflex_jax.adaptive.filter import AdaptiveFilter
from rotflex_jax.adaptive.lms import LMS
from rotflex_jax.adaptive.moments import Moments
from rotflex_jax.adaptive.objectives import Batch, Objective, batch, evaluate, unit
from rotflex_jax.adaptive.ranges import per_weight
from rotflex_jax.adaptive.settings import Build, built
from rotflex_jax.adaptive.sweep import lanes, sweep
from rotflex_jax.adaptive.tuned import Tuned
from rotflex_jax.basis import Basis
from rotflex_jax.devices import spread
from rotflex_jax.precision import double_precision
from rotflex_jax.recording import Recording

LANES = 32
"""Settings that run side by side."""
CHECKED = 60
"""Most weights whose stability is looked at in passing."""
ROWS = 20_000
"""Samples that the moments for this are taken from."""


@functools.partial(jax.jit, static_argnames=("names", "build", "objective", "mesh"))
def values_at(
    points: Float[Array, "K n"],
    data: Batch,
    *,
    names: tuple[str, ...],
    build: Build,
    objective: Objective,
    mesh: Mesh | None = None,
) -> Float[Array, " K"]:
    """The objective at many points, on each device some at a time; compiled once per `build`."""
    values = functools.partial(_values, names=names, build=build, objective=objective)
    return spread(values, mesh)(points, data)


def _values(
    points: Float[Array, "K n"], data: Batch, *, names: tuple[str, ...], build: Build, objective: Objective
) -> Float[Array, " K"]:
    def made(point: Array) -> tuple[AdaptiveFilter, Basis | None]:
        return built(build, dict(zip(names, point, strict=True)))

    filter, changed = made(points[0])
    if type(filter) is LMS and changed is None:
        return _swept(
            points, data, made, objective, not isinstance(filter.leakage, float) or filter.leakage != 0
        )
    value = lambda point: evaluate(data, objective, *made(point))  # noqa: E731
    return jax.lax.map(value, points, batch_size=min(LANES, len(points)))


def _swept(points: Array, data: Batch, made: Any, objective: Objective, leaks: bool) -> Float[Array, " K"]:
    """`values_at` for LMS on fixed regressors, as many points at a time as there is room for."""
    K, P = len(points), data.phi.shape[2]

    def settings(point: Array) -> tuple[Array, Array]:
        filter = made(point)[0]
        return per_weight("mu", filter.mu, P, data.phi.dtype), jnp.asarray(filter.leakage, data.phi.dtype)

    parts = -(-K // lanes(P))
    some = min(K, -(-K // (8 * parts)) * 8)
    padded = jnp.concatenate([points, jnp.broadcast_to(points[-1:], (-K % some, points.shape[1]))])

    def at(points: Array) -> Array:
        mu, leakage = jax.vmap(settings)(points)
        return sweep(data, objective, mu, leakage if leaks else None)

    return jax.lax.map(at, padded.reshape(-1, some, points.shape[1])).reshape(-1)[:K]


def sample_moments(phi: Any) -> Moments:
    """Moments of the regressors of recordings (B, N, P), from at most `ROWS` of them."""
    rows = np.asarray(phi).reshape(-1, phi.shape[-1])
    return Moments.of_regressors(rows[:: -(-len(rows) // ROWS)])


def judged(
    build: Build,
    settings: Mapping[str, float],
    basis: Basis,
    recordings: Sequence[Recording],
    channel: str,
    data: Batch,
    *,
    objective: Objective,
    test: Sequence[Recording],
    value: float | None = None,
    **rest: Any,
) -> Tuned:
    """The result for the settings found: value if unknown, test, stability; `rest` goes to it as it is."""
    names = tuple(settings)
    with double_precision():
        filter, changed = built(build, dict(settings))
        point = jnp.asarray([list(settings.values())])

        def worth(data: Batch) -> float:
            return float(values_at(point, data, names=names, build=build, objective=objective)[0])

        tested = worth(batch(basis, test, channel, objective)) if test else float("nan")
        stability: Stability | None = None
        if isinstance(filter, LMS) and data.phi.shape[2] <= CHECKED:
            # Other poles are other regressors.
            known = data if changed is None else batch(changed, recordings, channel, objective)
            stability = analyse(sample_moments(known.phi), np.asarray(filter.mu))
        return Tuned(
            settings=dict(settings),
            value=worth(data) if value is None else value,
            test=tested,
            objective=objective,
            unit=unit(objective, changed is not None),
            filter=filter,
            basis=basis if changed is None else changed,
            stability=stability,
            **rest,
        )
