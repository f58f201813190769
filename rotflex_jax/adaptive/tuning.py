"""Search for settings of a filter: on a grid, or by the gradient through the filter's loop."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.adaptive.filter import AdaptiveFilter, count
from rotflex_jax.adaptive.lms import LMS
from rotflex_jax.adaptive.objectives import (
    MOST_WEIGHTS_FOR_STABILITY,
    FilterBuilder,
    Objective,
    RangeTransform,
    Tuned,
    TuningData,
    TuningPath,
    build_filter,
    evaluate,
    sample_moments,
    starting_sets,
    tuning_data,
    tuning_result,
    values_at,
)
from rotflex_jax.adaptive.step_sizes import Margin
from rotflex_jax.basis import Basis
from rotflex_jax.errors import InputError
from rotflex_jax.optimise.quasi_newton import Values, descend
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision, mesh_of


def grid(
    build: FilterBuilder,
    axes: Mapping[str, Any],
    basis: Basis,
    recordings: Recording | Sequence[Recording],
    channel: str,
    *,
    objective: Objective,
    test: Recording | Sequence[Recording] = (),
    devices: Sequence[Any] | None = None,
) -> Tuned:
    """The objective of `tune` at every combination of given settings.

    For one or two settings it is an alternative to the gradient that shows the whole objective. Not for four
    or more settings: the number of combinations grows exponentially.

    Args:
        build: as in `tune`.
        axes: name of a setting -> values to try.
        basis: as in `tune`.
        recordings: as in `tune`.
        channel: as in `tune`.
        objective: as in `tune`.
        test: as in `tune`.
        devices: devices that share the combinations; by default all devices of this process. With
            `jax.distributed`, `jax.devices()` are the devices of all processes, and each process makes this
            call.

    Returns:
        The best combination, with the objective at all combinations.

    Raises:
        InputError: as in `tune`; there are no settings, or the filter diverges with all combinations.
    """
    tried = {name: np.atleast_1d(np.asarray(values, dtype=float)) for name, values in axes.items()}
    if not tried or any(v.ndim != 1 or not v.size for v in tried.values()):
        raise InputError(
            "Argument `axes` must give numbers for each setting, but one has none; "
            'give for instance {"mu": [0.01, 0.1]}.'
        )
    points = np.array(list(itertools.product(*tried.values())))
    with double_precision():
        data = tuning_data(basis, recordings, channel, objective)
        tested = tuning_data(basis, test, channel, objective, "test") if test else None
        mesh = mesh_of(devices)
        run = values_at(
            jnp.asarray(points), data, names=tuple(tried), build=build, objective=objective, mesh=mesh
        )
        values = np.asarray(run)
    if not np.isfinite(values).any():
        raise InputError("The filter diverges at every point of the grid; try smaller steps.")
    best = int(np.argmin(np.where(np.isfinite(values), values, np.inf)))
    return tuning_result(
        build,
        dict(zip(tried, points[best].tolist(), strict=True)),
        basis,
        recordings,
        channel,
        data,
        objective=objective,
        test=tested,
        value=float(values[best]),
        evaluations=len(points),
        axes=tried,
        values=values.reshape([len(v) for v in tried.values()]),
    )


def tune(
    build: FilterBuilder,
    start: Mapping[str, float] | Sequence[Mapping[str, float]],
    basis: Basis,
    recordings: Recording | Sequence[Recording],
    channel: str,
    *,
    objective: Objective,
    test: Recording | Sequence[Recording] = (),
    ranges: Mapping[str, tuple[float, float]] | None = None,
    evaluations: int = 60,
    margin: float = 0.0,
) -> Tuned:
    """Minimises an objective over settings of a filter, by its gradient through the filter's loop.

        log objective(exp(x)) -> min over x,   forward derivatives through every step of the filter

    Quasi-Newton steps of limited length are made from all starts at once. If the filter diverges, a step is
    shortened. Any leaf of the filter can be tuned, and poles of the basis as well. With more than about ten
    settings, forward derivatives become slow.

    Not for a single recording, since the settings would be fitted to its noise: give several recordings.

    Args:
        build: function of settings by name that returns the filter, such as `lambda s: LMS(s["mu"])`; JAX
            traces it. To tune poles, it returns the filter and a basis, such as
            `Volterra(bank.with_parameters(...))`. Another call with the same function needs no compilation.
        start: first settings, or several sets of first settings.
        basis: basis that gives the regressors of the input.
        recordings: recordings for tuning, of one length; the filter starts again on each.
        channel: output of the filter.
        objective: "final", "mean_error" or "last_half"; each has a different optimum.
        test: other recordings, on which the result is evaluated with the same objective; two or more for
            "final".
        ranges: name of a setting -> its range, which is 0 to infinity by default. A range with a finite upper
            end is transformed by a logistic function, any other by the logarithm above its lower end.
        evaluations: most runs of the filter per start, each with all derivatives.
        margin: least factor inside the mean-square bound of LMS, kept by a penalty; 0 for none.

    Returns:
        The best of all starts, with every path and a check of its stability.

    Raises:
        InputError: settings are out of range, the objective is unknown, recordings differ in length or
            sampling period, or the filter diverges from every start.
    """
    count("evaluations", evaluations)
    starts = starting_sets(start)
    names = tuple(starts[0])
    if strange := [name for name in ranges or {} if name not in names]:
        raise InputError(
            f"Argument `ranges` names {strange[0]!r}, but the settings are {', '.join(names)}; name one of "
            "these."
        )
    curve = RangeTransform(names, tuple((ranges or {}).get(name, (0.0, float("inf"))) for name in names))
    first = np.stack([curve.free(s) for s in starts])
    with double_precision():
        data = tuning_data(basis, recordings, channel, objective)
        tested = tuning_data(basis, test, channel, objective, "test") if test else None
        guard = _guard(margin, data, *build_filter(build, starts[0])) if margin else None

        def values(points: Float[np.ndarray, "S n"]) -> Values:
            return jax.device_get(
                loss_and_slopes(
                    jnp.asarray(points), data, guard, curve=curve, build=build, objective=objective
                )
            )

        found = descend(values, first, evaluations)
        paths = tuple(
            TuningPath(
                {
                    name: np.array([float(curve.settings(jnp.asarray(x))[name]) for x in d.points])
                    for name in names
                },
                np.exp(d.values),
                d.evaluations,
                d.status,
            )
            for d in found
        )
    reached = [p for p in paths if len(p.values)]
    if not reached:
        raise InputError(
            f"The filter diverges from every one of {len(starts)} starts, such as {starts[0]}; "
            "start from smaller steps."
        )
    best = min(reached, key=lambda p: p.values[-1])
    return tuning_result(
        build,
        {name: float(points[-1]) for name, points in best.points.items()},
        basis,
        recordings,
        channel,
        data,
        objective=objective,
        test=tested,
        # With a margin, the last value includes the penalty and is not the objective.
        value=float(best.values[-1]) if guard is None else None,
        evaluations=sum(p.evaluations for p in paths),
        paths=paths,
    )


def loss_and_slopes(
    points: Float[Array, "S n"],
    data: TuningData,
    guard: Margin | None = None,
    *,
    curve: RangeTransform,
    build: FilterBuilder,
    objective: Objective,
) -> tuple[Float[Array, " S"], Float[Array, "S n"]]:
    """Logarithm of the objective, and its derivatives with respect to the unconstrained coordinates.

    In forward mode there are as many tangents as settings, and the run is not stored. The function is
    compiled once for each `build`.
    """
    return _loss_and_slopes(curve, build, objective, points, data, guard)


@persistent_jit(static=3, only_known=True)
def _loss_and_slopes(
    curve: RangeTransform,
    build: FilterBuilder,
    objective: Objective,
    points: Float[Array, "S n"],
    data: TuningData,
    guard: Margin | None,
) -> tuple[Float[Array, " S"], Float[Array, "S n"]]:
    def loss(x: Float[Array, " n"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        filter, changed = build_filter(build, curve.settings(x))
        value = jnp.log(evaluate(data, objective, filter, changed))
        if guard is not None:
            value = value + guard.penalty(_step_sizes(filter))
        return value, value

    slopes, values = jax.vmap(jax.jacfwd(loss, has_aux=True))(points)
    return values, slopes


def _step_sizes(filter: AdaptiveFilter) -> Float[Array, "*P"]:
    assert isinstance(filter, LMS)
    return jnp.asarray(filter.mu)


def _guard(margin: float, data: TuningData, filter: AdaptiveFilter, changed: Basis | None) -> Margin:
    P = data.phi.shape[2]
    if not margin > 0 or changed is not None or P > MOST_WEIGHTS_FOR_STABILITY or not isinstance(filter, LMS):
        raise InputError(
            "A margin is a positive factor that LMS can keep on a fixed basis of up to "
            f"{MOST_WEIGHTS_FOR_STABILITY} regressors, but {margin:g} was given for "
            f"{type(filter).__name__} on {P}; leave it out, or change filter or basis."
        )
    return Margin(sample_moments(data.phi), margin)
