"""Settings of a filter by trying all combinations of some numbers."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from rotflex_jax.adaptive.judged import judged, values_at
from rotflex_jax.adaptive.objectives import Objective, batch
from rotflex_jax.adaptive.settings import Build
from rotflex_jax.adaptive.tuned import Tuned
from rotflex_jax.basis import Basis
from rotflex_jax.devices import mesh_of
from rotflex_jax.errors import InputError
from rotflex_jax.precision import double_precision
from rotflex_jax.recording import Recording


def grid(
    build: Build,
    axes: Mapping[str, Any],
    basis: Basis,
    recordings: Sequence[Recording],
    channel: str,
    *,
    objective: Objective,
    test: Sequence[Recording] = (),
    devices: Sequence[Any] | None = None,
) -> Tuned:
    """The objective of `tune` at every combination of given settings.

    For two settings a fair alternative to the gradient, and it shows the whole landscape. Not for four
    or more: the combinations multiply.

    Args:
        build: as in `tune`.
        axes: numbers to try, by name of the setting.
        basis: as in `tune`.
        recordings: as in `tune`.
        channel: as in `tune`.
        objective: as in `tune`.
        test: as in `tune`.
        devices: to share the combinations out to; all of this process unless given. With
            `jax.distributed`, `jax.devices()` are those of all processes, of which each makes this call.

    Returns:
        The best combination, with all values.

    Raises:
        InputError: as `tune`; no settings, or a filter that diverges with all of them.
    """
    tried = {name: np.atleast_1d(np.asarray(values, dtype=float)) for name, values in axes.items()}
    if not tried or any(v.ndim != 1 or not v.size for v in tried.values()):
        raise InputError(
            "Argument `axes` must give numbers for each setting, but one has none; "
            'give for instance {"mu": [0.01, 0.1]}.'
        )
    points = np.array(list(itertools.product(*tried.values())))
    with double_precision():
        data = batch(basis, recordings, channel, objective)
        mesh = mesh_of(devices)
        run = values_at(
            jnp.asarray(points), data, names=tuple(tried), build=build, objective=objective, mesh=mesh
        )
        values = np.asarray(run)
    if not np.isfinite(values).any():
        raise InputError("The filter diverges at every point of the grid; try smaller steps.")
    best = int(np.argmin(np.where(np.isfinite(values), values, np.inf)))
    return judged(
        build,
        dict(zip(tried, points[best].tolist(), strict=True)),
        basis,
        recordings,
        channel,
        data,
        objective=objective,
        test=test,
        value=float(values[best]),
        evaluations=len(points),
        axes=tried,
        values=values.reshape([len(v) for v in tried.values()]),
    )
