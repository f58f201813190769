"""Settings of a filter by the gradient through its own loop."""

import functools
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.adaptive.descent import Values, descend
from rotflex_jax.adaptive.filter import AdaptiveFilter
from rotflex_jax.adaptive.judged import CHECKED, judged, sample_moments
from rotflex_jax.adaptive.lms import LMS
from rotflex_jax.adaptive.objectives import Batch, Objective, batch, evaluate
from rotflex_jax.adaptive.penalty import Margin
from rotflex_jax.adaptive.ranges import count
from rotflex_jax.adaptive.settings import Build, Curve, built, named
from rotflex_jax.adaptive.tuned import Path, Tuned
from rotflex_jax.basis import Basis
from rotflex_jax.errors import InputError
from rotflex_jax.precision import double_precision
from rotflex_jax.recording import Recording


def tune(
    build: Build,
    start: Mapping[str, float] | Sequence[Mapping[str, float]],
    basis: Basis,
    recordings: Sequence[Recording],
    channel: str,
    *,
    objective: Objective,
    test: Sequence[Recording] = (),
    ranges: Mapping[str, tuple[float, float]] | None = None,
    evaluations: int = 60,
    margin: float = 0.0,
) -> Tuned:
    """Minimises an objective over settings of a filter, by its gradient through the filter's loop.

        log objective(exp(x)) -> min over x,   derivatives forward through every step of the filter

    Quasi-Newton steps of limited length from every start, all of them side by side. Settings at
    which the filter diverges shorten a step and do no other harm. Any leaf of the filter can be tuned,
    and poles of the basis as well; more than some ten settings make forward derivatives slow.

    Not for a single recording, to whose noise the settings would be fitted: give several.

    Args:
        build: the filter of settings by name, such as `lambda s: LMS(s["mu"])`; JAX traces it. For poles
            it returns the filter and a basis, such as `Volterra(bank.with_numbers(...))`.
            The same function in another call compiles nothing anew.
        start: settings to begin with, or several sets of them.
        basis: turns the input into regressors.
        recordings: to tune on, of one length; the filter starts anew on each.
        channel: output to be followed.
        objective: "final", "mean_error" or "last_half"; they ask for different settings.
        test: other recordings, on which the result is judged by the same objective.
        ranges: of settings by name; a range with an end moves along a logistic curve, every other
            setting is positive and moves along its logarithm.
        evaluations: most filters to run per start, each with all derivatives.
        margin: keep at least this factor inside the mean-square bound of LMS, as a penalty; 0 for none.

    Returns:
        The best of all starts, with every path and a check of its stability.

    Raises:
        InputError: settings out of range, an unknown objective, recordings that do not go together, or
            a filter that diverges from every start.
    """
    count("evaluations", evaluations)
    starts = named(start)
    names = tuple(starts[0])
    curve = Curve(names, tuple((ranges or {}).get(name, (0.0, float("inf"))) for name in names))
    first = np.stack([curve.free(s) for s in starts])
    with double_precision():
        data = batch(basis, recordings, channel, objective)
        guard = _guard(margin, data, *built(build, starts[0])) if margin else None

        def values(points: Float[np.ndarray, "S n"]) -> Values:
            return jax.device_get(
                loss_and_slopes(
                    jnp.asarray(points), data, guard, curve=curve, build=build, objective=objective
                )
            )

        found = descend(values, first, evaluations)
        paths = tuple(
            Path(
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
    return judged(
        build,
        {name: float(points[-1]) for name, points in best.points.items()},
        basis,
        recordings,
        channel,
        data,
        objective=objective,
        test=test,
        # With a margin the last value has the penalty in it.
        value=float(best.values[-1]) if guard is None else None,
        evaluations=sum(p.evaluations for p in paths),
        paths=paths,
    )


@functools.partial(jax.jit, static_argnames=("curve", "build", "objective"))
def loss_and_slopes(
    points: Float[Array, "S n"],
    data: Batch,
    guard: Margin | None = None,
    *,
    curve: Curve,
    build: Build,
    objective: Objective,
) -> tuple[Float[Array, " S"], Float[Array, "S n"]]:
    """Log of the objective, and its derivatives by the free numbers of the settings.

    Forward mode: as many tangents as settings ride along, and nothing of the run is kept. Compiled
    once per `build`, whatever the numbers are.
    """

    def loss(x: Array) -> tuple[Array, Array]:
        filter, changed = built(build, curve.settings(x))
        value = jnp.log(evaluate(data, objective, filter, changed))
        if guard is not None:
            value = value + guard.penalty(_step_sizes(filter))
        return value, value

    slopes, values = jax.vmap(jax.jacfwd(loss, has_aux=True))(points)
    return values, slopes


def _step_sizes(filter: AdaptiveFilter) -> Array:
    assert isinstance(filter, LMS)
    return jnp.asarray(filter.mu)


def _guard(margin: float, data: Batch, filter: AdaptiveFilter, changed: Basis | None) -> Margin:
    P = data.phi.shape[2]
    if not margin > 0 or changed is not None or P > CHECKED or not isinstance(filter, LMS):
        raise InputError(
            f"A margin is a positive factor that LMS can keep on a fixed basis of up to {CHECKED} "
            f"regressors, but {margin:g} was given for {type(filter).__name__} on {P}; leave it out, or "
            "change filter or basis."
        )
    return Margin(sample_moments(data.phi), margin)
