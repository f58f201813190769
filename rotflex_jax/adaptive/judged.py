"""The objective at given settings, and the result that a search hands back."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.adaptive.bounds import Stability, analyse
from rotflex_jax.adaptive.lms import LMS
from rotflex_jax.adaptive.moments import Moments
from rotflex_jax.adaptive.objectives import Blocks, Objective, blocks, evaluate, unit
from rotflex_jax.adaptive.settings import Build, built
from rotflex_jax.adaptive.tuned import Tuned
from rotflex_jax.basis import Basis
from rotflex_jax.precision import double_precision
from rotflex_jax.recording import Recording

LANES = 32
"""Settings that run side by side."""
CHECKED = 60
"""Most weights whose stability is looked at in passing."""
ROWS = 20_000
"""Samples that the moments for this are taken from."""


@functools.partial(jax.jit, static_argnames=("names", "build", "objective"))
def values_at(
    points: Float[Array, "K n"], data: Blocks, *, names: tuple[str, ...], build: Build, objective: Objective
) -> Float[Array, " K"]:
    """The objective at many points, some at a time; compiled once per `build`."""

    def value(point: Array) -> Array:
        return evaluate(data, objective, *built(build, dict(zip(names, point, strict=True))))

    return jax.lax.map(value, points, batch_size=min(LANES, len(points)))


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
    data: Blocks,
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

        def worth(data: Blocks) -> float:
            return float(values_at(point, data, names=names, build=build, objective=objective)[0])

        tested = worth(blocks(basis, test, channel, objective)) if test else float("nan")
        stability: Stability | None = None
        if isinstance(filter, LMS) and data.phi.shape[2] <= CHECKED:
            # Other poles are other regressors.
            known = data if changed is None else blocks(changed, recordings, channel, objective)
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
