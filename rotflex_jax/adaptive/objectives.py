"""Objectives by which settings of a filter are compared, at many settings at once, and the best found.

    final       mean squared error of the last weights of one recording on the other recordings
    mean_error  mean square of the a-priori errors over the whole run
    last_half   the same over its second half

`final` is a measure of a model and favours small steps. The other two are measures of the running filter:
they favour weights that follow the recording, which a frozen model does not do, and `mean_error` especially
favours fast initial convergence.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Float

from rotflex_jax.adaptive.filter import AdaptiveFilter, per_weight, scan, times
from rotflex_jax.adaptive.lms import LMS
from rotflex_jax.adaptive.moments import Moments
from rotflex_jax.adaptive.step_sizes import Stability, analyse
from rotflex_jax.basis import Basis
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import listed
from rotflex_jax.recording.samples import of_one_period
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision, spread

FilterBuilder = Callable[[dict[str, Any]], AdaptiveFilter | tuple[AdaptiveFilter, Basis]]
"""Function of settings by name that returns a filter, or a filter and a basis."""


def build_filter(build: FilterBuilder, settings: dict[str, Any]) -> tuple[AdaptiveFilter, Basis | None]:
    """The filter for some settings, and the basis if it depends on the settings too, else None."""
    made = build(settings)
    return made if isinstance(made, tuple) else (made, None)


def starting_sets(starts: Mapping[str, float] | Sequence[Mapping[str, float]]) -> list[dict[str, float]]:
    """One or several sets of settings as a list.

    Raises:
        InputError: there are no settings, or the sets have different settings.
    """
    sets = [dict(starts)] if isinstance(starts, Mapping) else [dict(s) for s in starts]
    if not sets or not sets[0] or any(set(s) != set(sets[0]) for s in sets):
        raise InputError(
            "Argument `start` must name the same settings in every set, at least one; "
            "give for instance {'mu': 0.01}."
        )
    return sets


@dataclasses.dataclass(frozen=True)
class RangeTransform:
    """Settings within their ranges as unconstrained coordinates.

        setting = low + exp(x)  without an upper end,    low + (high - low) / (1 + exp(-x))  with one

    Attributes:
        names: names of the settings.
        ranges: lower and upper end of each setting; the upper end may be infinite.

    Raises:
        InputError: the lower end of a range is not finite, or not below the upper end.
    """

    names: tuple[str, ...]
    ranges: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        for name, (low, high) in zip(self.names, self.ranges, strict=True):
            if not -np.inf < low < high:
                raise InputError(
                    f"The range of `{name}` must rise from a finite number, but is {low:g} to {high:g}; "
                    "correct it."
                )

    def settings(self, x: Float[Array, " n"]) -> dict[str, Float[Array, ""]]:
        """The settings at a point of the coordinates, which may be traced."""
        return {
            name: low + (jnp.exp(x[i]) if np.isinf(high) else (high - low) * jax.nn.sigmoid(x[i]))
            for i, (name, (low, high)) in enumerate(zip(self.names, self.ranges, strict=True))
        }

    def free(self, settings: Mapping[str, float]) -> Float[np.ndarray, " n"]:
        """The point of the coordinates for given settings.

        Raises:
            InputError: a setting is not inside its range.
        """
        x = []
        for name, (low, high) in zip(self.names, self.ranges, strict=True):
            value = float(settings[name])
            if not low < value < high:
                raise InputError(
                    f"Setting `{name}` must start between {low:g} and {high:g}, but is {value:g}; "
                    "move it, or give another range."
                )
            x.append(np.log(value - low) if np.isinf(high) else np.log((value - low) / (high - value)))
        return np.array(x)


@dataclasses.dataclass(frozen=True, eq=False)
class TuningPath:
    """One descent, from its start to its end.

    Attributes:
        points: name of a setting -> its values, the start first.
        values: objective with the penalty.
        evaluations: number of runs of the filter, each with derivatives.
        status: "minimum", "no further progress", "evaluations used up" or "no finite value".
    """

    points: dict[str, Float[np.ndarray, " K"]]
    values: Float[np.ndarray, " K"]
    evaluations: int
    status: str


@dataclasses.dataclass(frozen=True, eq=False)
class Tuned:
    """Settings of a filter, chosen by gradient or on a grid.

    Attributes:
        settings: name -> value of each setting.
        value: objective on the recordings for tuning.
        test: objective on the test recordings; NaN without test recordings.
        objective: "final", "mean_error" or "last_half".
        unit: unit of `value` and `test`, in words.
        filter: filter with these settings.
        basis: basis with these settings.
        evaluations: total number of settings that were tried.
        stability: stability of the step sizes, or None if the theory of LMS does not apply or there are too
            many weights.
        paths: one descent for each start; empty for a grid.
        axes: name -> values on a grid; empty for a descent.
        values: objective on the grid, one axis per setting; NaN or infinite where the filter diverged.
    """

    settings: dict[str, float]
    value: float
    test: float
    objective: str
    unit: str
    filter: AdaptiveFilter
    basis: Basis
    evaluations: int
    stability: Stability | None
    paths: tuple[TuningPath, ...] = ()
    axes: dict[str, Float[np.ndarray, " _"]] = dataclasses.field(default_factory=dict)
    values: Float[np.ndarray, "..."] | None = None

    def __str__(self) -> str:
        how = f"{len(self.paths)} starts" if self.paths else f"a grid of {self.evaluations}"
        lines = [f'tuned for "{self.objective}" with {self.evaluations} evaluations from {how}']
        lines += [f"  {name} = {value:.4g}" for name, value in self.settings.items()]
        lines += [f"  {self.value:.4g} {self.unit}"]
        if np.isfinite(self.test):
            lines += [f"  {self.test:.4g} on the recordings kept for the test"]
        for path in self.paths:
            start = ", ".join(
                f"{name} {points[0]:.3g}" for name, points in path.points.items() if len(points)
            )
            last = f"{path.values[-1]:.4g}" if len(path.values) else "-"
            lines += [
                f"  from {start or 'a start that diverges'}: {last}, {path.evaluations} evaluations, "
                f"{path.status}"
            ]
        lines += [f"  {self.stability.sentence}" if self.stability else "  stability: no theory applied"]
        return "\n".join(lines)


Objective = Literal["final", "mean_error", "last_half"]


class TuningData(eqx.Module):
    """Recordings of one length, and the least-squares weights to which the objectives are relative.

    The first `n_init` samples are left out, since their regressors depend on samples before the recording.

    Attributes:
        u: inputs.
        y: outputs.
        phi: regressors of the basis as given, L = N - n_init.
        skip: number of samples that are left out.
        best: least-squares weights, for all recordings except one in turn (K = R) or for all (K = 1).
        gram: mean of phi phi' over the recordings of each fit.
        smallest: mean squared error of each fit.
    """

    u: Float[Array, "R N"]
    y: Float[Array, "R N"]
    phi: Float[Array, "R L P"]
    skip: int = eqx.field(static=True)
    best: Float[Array, "K P"]
    gram: Float[Array, "K P P"]
    smallest: Float[Array, " K"]


def tuning_data(
    basis: Basis,
    recordings: Recording | Sequence[Recording],
    channel: str,
    objective: str,
    name: str = "recordings",
) -> TuningData:
    """Recordings prepared for an objective.

    Args:
        basis: basis that gives the regressors.
        recordings: recordings of one length and sampling period; at least two for "final".
        channel: output of the filter.
        objective: "final", "mean_error" or "last_half".
        name: name of the argument with the recordings.

    Raises:
        InputError: the objective is unknown, there are too few recordings, or they differ in length or
            sampling period.
    """
    if objective not in get_args(Objective):
        raise InputError(
            f"Argument `objective` must be one of {', '.join(get_args(Objective))}, but is {objective!r}; "
            "choose one."
        )
    recordings = listed(recordings, name)
    if objective == "final" and len(recordings) < 2:
        raise InputError(
            f'The objective "final" needs 2 recordings or more in `{name}`, but 1 was given; cut a long one '
            "with Recording.slice."
        )
    lengths, periods = sorted({r.N for r in recordings}), {r.Ts for r in recordings}
    if len(lengths) > 1 or not of_one_period(periods):
        raise InputError(
            f"The recordings must have one length and sampling period, but have {lengths} samples and "
            f"{sorted(periods)} s; cut them to the shortest with Recording.slice."
        )
    u = np.stack([np.asarray(r.u, dtype=float) for r in recordings])
    y = np.stack([np.asarray(r.channel(channel), dtype=float) for r in recordings])
    skip = max(r.n_init for r in recordings)
    phi = np.stack([np.asarray(basis.regressors(row), dtype=float)[skip:] for row in u])
    held = range(len(u)) if objective == "final" else [-1]
    best, gram, smallest = [], [], []
    for b in held:
        X = np.concatenate([phi[k] for k in range(len(u)) if k != b])
        Y = np.concatenate([y[k, skip:] for k in range(len(u)) if k != b])
        # Minimum norm, since equal columns, as in the full layout, are allowed. The QR triangle gives the
        # same solution as all rows, and much faster than their singular values.
        R = np.asarray(np.linalg.qr(np.concatenate([X, Y[:, None]], axis=1), mode="r"))
        w = np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=np.finfo(float).eps * max(X.shape))[0]
        best.append(w)
        gram.append(X.T @ X / len(X))
        smallest.append(np.mean((Y - X @ w) ** 2))
    parts = (np.stack(best), np.stack(gram), np.array(smallest))
    return TuningData(
        jnp.asarray(u), jnp.asarray(y), jnp.asarray(phi), skip, *(jnp.asarray(p) for p in parts)
    )


def evaluate(
    data: TuningData, objective: Objective, filter: AdaptiveFilter, basis: Any = None
) -> Float[Array, ""]:
    """The objective in traced code, differentiable by settings of the filter and poles of the basis.

    Args:
        data: recordings.
        objective: name of the objective.
        filter: filter, which starts again on every recording.
        basis: basis, if it changes during tuning. The error is then relative to the variance of the output,
            since the least-squares weights change too.

    Returns:
        For a fixed basis the excess over the smallest error ("final") or the error, both in units of the
        smallest error; for a changing basis the error in units of the output's variance.
    """
    y = data.y[:, data.skip :]
    phi = data.phi
    if basis is not None:
        phi = jax.vmap(basis.respond)(data.u)[:, data.skip :]
    states, errors = jax.vmap(lambda phi, y: scan(filter, phi, y))(phi, y)
    unit = jnp.var(y) if basis is not None else jnp.mean(data.smallest)
    if objective == "mean_error":
        return jnp.mean(errors**2) / unit
    if objective == "last_half":
        return jnp.mean(errors[:, errors.shape[1] // 2 :] ** 2) / unit
    weights = jax.vmap(filter.weights)(states)
    if basis is None:
        # (w - best)' R (w - best): the excess error without a difference of two nearly equal numbers.
        miss = weights - data.best
        return jnp.mean(jnp.einsum("bp,bpq,bq->b", miss, data.gram, miss) / data.smallest)
    e = y[None] - jnp.einsum("blp,ap->abl", phi, weights)
    others = 1 - jnp.eye(len(y), dtype=y.dtype)
    return jnp.sum(others * jnp.mean(e**2, axis=2)) / jnp.sum(others) / unit


def objective_unit(objective: Objective, changing: bool) -> str:
    """Unit of `evaluate` in words."""
    if changing:
        return "of the output's variance"
    return "of the smallest error, in excess of it" if objective == "final" else "of the smallest error"


CACHED_WEIGHTS = 2640
"""Largest total number of weights of all settings that fits into the fastest cache."""
LEAST_SETTINGS_TOGETHER = 32
"""Least number of settings that are evaluated together: fewer do not use a processor well."""


def settings_together(P: int) -> int:
    """Number of settings that are evaluated together, for P weights each.

    >>> settings_together(21), settings_together(66), settings_together(1326)
    (120, 40, 32)
    """
    return max(LEAST_SETTINGS_TOGETHER, CACHED_WEIGHTS // P // 8 * 8)


def lms_objectives(
    data: TuningData, objective: Objective, mu: Float[Array, "C P"], leakage: Float[Array, " C"] | None
) -> Float[Array, " C"]:
    """The objective of LMS at every one of C settings.

    The values agree with `evaluate`, but the settings are along the last axis, so that vector instructions
    work on C settings at once. Only the sum of squares of the errors is stored.

    Args:
        data: recordings.
        objective: name of the objective.
        mu: step sizes.
        leakage: leakage for each setting; None for none.
    """
    C, P = mu.shape
    step, y = mu.T, data.y[:, data.skip :]
    first = y.shape[1] // 2 if objective == "last_half" else 0
    decay = None if leakage is None else (1 - mu * leakage[:, None]).T

    def update(carry: tuple[Array, Array], sample: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
        w, total = carry
        phi, target = sample
        e = target - times(phi, w)
        decayed = w if decay is None else w * decay
        return (decayed + (step * e[None]) * phi[:, None], total + e * e), None

    def run(recording: tuple[Array, Array]) -> tuple[Array, Array]:
        phi, y = recording
        w, none = jnp.zeros((P, C), y.dtype), jnp.zeros(C, y.dtype)
        if first:  # earlier errors do not count
            w, _ = jax.lax.scan(update, (w, none), (phi[:first], y[:first]))[0]
        return jax.lax.scan(update, (w, none), (phi[first:], y[first:]))[0]

    w, total = jax.lax.map(run, (data.phi, y))
    if objective == "final":
        miss = jnp.moveaxis(w, 2, 0) - data.best[None]
        return jnp.mean(jnp.einsum("cbp,bpq,cbq->cb", miss, data.gram, miss) / data.smallest[None], axis=1)
    return jnp.mean(total, axis=0) / (y.shape[1] - first) / jnp.mean(data.smallest)


SETTINGS_PER_BATCH = 32
"""Settings that are evaluated together, for other filters than LMS."""
MOST_WEIGHTS_FOR_STABILITY = 60
"""Most weights for which the stability of the result is analysed."""
MOMENT_SAMPLES = 20_000
"""Most samples of which the moments for this are means."""


def values_at(
    points: Float[Array, "K n"],
    data: TuningData,
    *,
    names: tuple[str, ...],
    build: FilterBuilder,
    objective: Objective,
    mesh: Mesh | None = None,
) -> Float[Array, " K"]:
    """The objective at many points, on each device some at a time; compiled once per `build`."""
    return _values_on(names, build, objective, mesh, points, data)


@persistent_jit(static=4, only_known=True)
def _values_on(
    names: tuple[str, ...],
    build: FilterBuilder,
    objective: Objective,
    mesh: Mesh | None,
    points: Float[Array, "K n"],
    data: TuningData,
) -> Float[Array, " K"]:
    values = functools.partial(_values, names=names, build=build, objective=objective)
    return spread(values, mesh)(points, data)


def _values(
    points: Float[Array, "K n"],
    data: TuningData,
    *,
    names: tuple[str, ...],
    build: FilterBuilder,
    objective: Objective,
) -> Float[Array, " K"]:
    def made(point: Array) -> tuple[AdaptiveFilter, Basis | None]:
        return build_filter(build, dict(zip(names, point, strict=True)))

    filter, changed = made(points[0])
    if type(filter) is LMS and changed is None:
        return _lms_values(
            points, data, made, objective, not isinstance(filter.leakage, float) or filter.leakage != 0
        )
    value = lambda point: evaluate(data, objective, *made(point))  # noqa: E731
    return jax.lax.map(value, points, batch_size=min(SETTINGS_PER_BATCH, len(points)))


def _lms_values(
    points: Array, data: TuningData, made: Any, objective: Objective, leaks: bool
) -> Float[Array, " K"]:
    """`values_at` for LMS on fixed regressors, as many points at a time as fit into the cache."""
    K, P = len(points), data.phi.shape[2]

    def settings(point: Array) -> tuple[Array, Array]:
        filter = made(point)[0]
        return per_weight("mu", filter.mu, P, data.phi.dtype), jnp.asarray(filter.leakage, data.phi.dtype)

    parts = -(-K // settings_together(P))
    some = min(K, -(-K // (8 * parts)) * 8)
    padded = jnp.concatenate([points, jnp.broadcast_to(points[-1:], (-K % some, points.shape[1]))])

    def at(points: Array) -> Array:
        mu, leakage = jax.vmap(settings)(points)
        return lms_objectives(data, objective, mu, leakage if leaks else None)

    return jax.lax.map(at, padded.reshape(-1, some, points.shape[1])).reshape(-1)[:K]


def sample_moments(phi: Float[Array, "R L P"]) -> Moments:
    """Moments of the regressors of recordings, from at most `MOMENT_SAMPLES` of them."""
    rows = np.asarray(phi).reshape(-1, phi.shape[-1])
    return Moments.of_regressors(rows[:: -(-len(rows) // MOMENT_SAMPLES)])


def tuning_result(
    build: FilterBuilder,
    settings: Mapping[str, float],
    basis: Basis,
    recordings: Recording | Sequence[Recording],
    channel: str,
    data: TuningData,
    *,
    objective: Objective,
    test: TuningData | None,
    value: float | None = None,
    **rest: Any,
) -> Tuned:
    """The result for the settings found: value if None was given, test, stability, and `rest` unchanged."""
    names = tuple(settings)
    with double_precision():
        filter, changed = build_filter(build, dict(settings))
        point = jnp.asarray([list(settings.values())])

        def value_on(data: TuningData) -> float:
            return float(values_at(point, data, names=names, build=build, objective=objective)[0])

        tested = float("nan") if test is None else value_on(test)
        stability: Stability | None = None
        if isinstance(filter, LMS) and data.phi.shape[2] <= MOST_WEIGHTS_FOR_STABILITY:
            # Other poles are other regressors.
            known = data if changed is None else tuning_data(changed, recordings, channel, objective)
            stability = analyse(sample_moments(known.phi), np.asarray(filter.mu))
        return Tuned(
            settings=dict(settings),
            value=value_on(data) if value is None else value,
            test=tested,
            objective=objective,
            unit=objective_unit(objective, changed is not None),
            filter=filter,
            basis=basis if changed is None else changed,
            stability=stability,
            **rest,
        )
