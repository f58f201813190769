"""Runs over recordings with their slopes, and the likelihood of their errors with its quadratic model.

    e = y_hat - y,   J = de / dp
    cost = sum over channels of  n ln s + sum e^2 / (2 s^2) - n / 2,   s = max(rms e, floor)
    g = sum J'e / s^2,   H = sum J'J / s^2

The scale of each channel is the size of its errors at the same point, so that channels are weighted by how
well they can be explained, and a nat has the same meaning at every step. One compiled program computes runs
with slopes for free runs and predictions of any horizon, since gains and windows are data.

`many_starts` computes the same sums inside of the run, on the device.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int, Shaped

from rotflex_jax.fit.coordinates import FitCoordinates
from rotflex_jax.fit.dataset import StackedRecordings, Windows
from rotflex_jax.fit.inference import RecordingSlopes, curvature, flattened, nats_that_count
from rotflex_jax.mechanism import Mechanism, Solver, predictor_run
from rotflex_jax.mechanism.assembly import Layout, rest_state, whole_state
from rotflex_jax.mechanism.sensitivities import (
    RecordingSamples,
    RunParameters,
    TangentDirections,
    accumulate_outputs,
    outputs_with_sensitivities,
)
from rotflex_jax.mechanism.simulate import first_predictions
from rotflex_jax.optimise.damped_least_squares import RIDGE, NormalEquations, solution_within
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision, spread


def predicted(
    structure: Mechanism,
    solver: Solver,
    values: Float[Array, "R P"],
    x0: Float[Array, "R *W s"],
    gates: Float[Array, " E"],
    data: StackedRecordings,
    K: Float[Array, "R n C"],
    window: Int[Array, "R N"] | None = None,
    count: Int[Array, ""] | None = None,
) -> Float[Array, "R N C"]:
    """Outputs of R recordings, predicted with gain `K`; free runs if it is zero.

    Args:
        structure: Mechanism without values.
        solver: Integration rule.
        values: Parameter values for each recording.
        x0: First positions and speeds.
        gates: Gate of each effect.
        data: The recordings.
        K: Gains for each recording.
        window: Window of each sample, if runs start again at each window; `x0` is then (R, W, s).
        count: Number of samples that are run, with windows; all if None.
    """
    run = functools.partial(predictor_run if count is None else first_predictions, structure, solver)
    rows = (values, gates, whole_state(structure, x0), data.u, data.y, data.seen, K, data.Ts)
    axes: tuple[int | None, ...] = (0, None, 0, 0, 0, 0, 0, 0)
    if window is not None:
        rows, axes = (*rows, window), (*axes, 0)
    if count is not None:
        return each_recording(run, (*axes, None))(*rows, count)
    return each_recording(run, axes)(*rows)[1]


def each_recording(run: Callable[..., Any], in_axes: tuple[int | None, ...], out_axes: int = 0) -> Callable:
    """`jax.vmap` over recordings; for a single recording without `vmap`, which halves the time of tracing.

    Args:
        run: Function of one recording.
        in_axes: Axis of the recordings in each argument, None for an argument that all share; not None for
            the first argument.
        out_axes: Axis of the recordings in the results.
    """

    def mapped(*arguments: Any) -> Any:
        if jax.tree.leaves(arguments[0])[0].shape[in_axes[0]] != 1:
            return jax.vmap(run, in_axes, out_axes)(*arguments)
        one = [
            a
            if axis is None
            else jax.tree.map(lambda x, axis=axis: jax.lax.index_in_dim(x, 0, axis, False), a)
            for a, axis in zip(arguments, in_axes, strict=True)
        ]
        return jax.tree.map(lambda x: jnp.expand_dims(x, out_axes), run(*one))

    return mapped


def normal_equations(
    structure: Mechanism,
    solver: Solver,
    parameters: RunParameters,
    tangents: TangentDirections,
    samples: RecordingSamples,
    scale: Float[Array, " C"],
) -> NormalEquations:
    """Half the squared error of each channel of a run, the gradient of their sum, and `J'J`.

    Args:
        structure: Mechanism without values; static.
        solver: Integration rule; static.
        parameters: Parameters, first states and gain; a free run if the gain is None.
        tangents: The D directions.
        samples: The recording.
        scale: Size of the error of each channel.
    """

    def fold(sums: NormalEquations, y_hat: Array, J: Array, sample: Any) -> tuple[NormalEquations, None]:
        y, counts = sample
        # `where` and not a product, since a run may diverge beyond its last sample.
        e = jnp.where(counts > 0, (y_hat - y) / scale, 0.0)
        J = jnp.where(counts > 0, J / scale[:, None], 0.0)
        each = range(len(e))
        return NormalEquations(
            sums.costs + e * e / 2,
            sums.gradient + sum(J[c] * e[c] for c in each),
            sums.H + sum(J[c][:, None] * J[c][None] for c in each),
        ), None

    D, dtype = len(tangents.x0), samples.u.dtype
    none = NormalEquations(jnp.zeros(len(scale), dtype), jnp.zeros(D, dtype), jnp.zeros((D, D), dtype))
    return accumulate_outputs(structure, solver, parameters, tangents, samples, fold, none)[0]


def directions(
    structure: Mechanism, slopes: Float[Array, " P"], free: Int[Array, " K"], states: int
) -> TangentDirections:
    """Directions along the coordinates of some parameters, then along entries of the first state.

    Args:
        structure: Mechanism without values.
        slopes: Derivative of each value by its coordinate.
        free: Indices of the parameters.
        states: Number of entries of the first state that are free.
    """
    K, D = len(free), len(free) + states
    values = jnp.zeros((D, len(slopes)), slopes.dtype).at[jnp.arange(K), free].set(slopes[free])
    n = len(rest_state(structure, np.float64))
    x0 = jnp.zeros((D, n), slopes.dtype).at[K + jnp.arange(states), jnp.arange(states)].set(1.0)
    return TangentDirections(values, jnp.zeros((D, len(structure.effects)), slopes.dtype), x0)


@dataclasses.dataclass(frozen=True)
class RunLayout:
    """Static data for which runs with slopes are compiled; hashable.

    Attributes:
        structure: Mechanism without values.
        solver: Integration rule.
        states: Number of entries of each first state that are free.
        mesh: Devices among which the recordings are divided; None for one device.
    """

    structure: Mechanism
    solver: Solver
    states: int
    mesh: Mesh | None = None


@persistent_jit(static=1)
def runs_with_slopes(
    layout: RunLayout,
    values: Float[Array, "R P"],
    slopes: Float[Array, "R P"],
    free: Int[Array, " K"],
    x0: Float[Array, "R *W m"],
    data: StackedRecordings,
    K: Float[Array, "R n C"],
    window: Int[Array, "R N"] | None = None,
) -> tuple[Float[Array, "R N C"], Float[Array, "R N C D"]]:
    """Outputs, and their slopes by the coordinates of free parameters and then by first states.

    Args:
        layout: Static data of the program.
        values: Parameter values for each recording.
        slopes: Derivative of each value by its coordinate; zero for a constant of the recording.
        free: Indices of the free parameters.
        x0: First positions and speeds.
        data: The recordings.
        K: Gains of the predictor; zero for free runs.
        window: Window of each sample, if runs start again at each window; `x0` is then (R, W, m).
    """
    structure = layout.structure

    def one(row: Any) -> tuple[jax.Array, jax.Array]:
        values, slopes, x0, K, samples = row
        gates = jnp.ones(len(structure.effects), values.dtype)
        tangents = directions(structure, slopes, free, layout.states)
        parameters = RunParameters(values, gates, whole_state(structure, x0), K)
        return outputs_with_sensitivities(
            structure, layout.solver, parameters, tangents, RecordingSamples(*samples)
        )

    samples = tuple(data) if window is None else (*data, window)
    rows = (values, slopes, x0, K, samples)
    return spread(lambda rows: jax.lax.map(one, rows), layout.mesh)(rows)


@persistent_jit(static=1, optimisation_level=1)
def runs(
    layout: RunLayout,
    values: Float[Array, "R P"],
    x0: Float[Array, "R *W m"],
    data: StackedRecordings,
    K: Float[Array, "R n C"],
    window: Int[Array, "R N"] | None = None,
) -> Float[Array, "R N C"]:
    """The outputs of `runs_with_slopes`, without slopes.

    Args:
        layout: Static data of the program.
        values: Parameter values for each recording.
        x0: First positions and speeds.
        data: The recordings.
        K: Gains of the predictor; zero for free runs.
        window: Window of each sample, if runs start again at each window; `x0` is then (R, W, m).
    """
    gates = jnp.ones(len(layout.structure.effects), values.dtype)

    def several(rows: Any) -> Array:
        values, x0, K, samples, *window = rows
        return predicted(layout.structure, layout.solver, values, x0, gates, samples, K, *window)

    rows = (values, x0, K, data) if window is None else (values, x0, K, data, window)
    return spread(several, layout.mesh)(rows)


def free_run_slopes(
    layout: RunLayout,
    values: Float[np.ndarray, " P"],
    scale: Float[np.ndarray, " P"],
    free: Int[np.ndarray, " F"],
    start: Float[np.ndarray, " n"],
    u: Float[np.ndarray, "N *c"],
    Ts: float,
) -> tuple[Float[np.ndarray, "N C"], Float[np.ndarray, "N C D"]]:
    """Outputs of one free run, and their slopes by the free parameters, then by the first state.

    Args:
        layout: Mechanism and solver, and the number of entries of the first state that have slopes.
        values: Parameter values.
        scale: Change of each parameter to which its slope refers.
        free: Indices of the free parameters.
        start: First state.
        u: Input, with signals in further columns.
        Ts: Sampling period [s].
    """
    N, C = len(u), len(layout.structure.channels)
    with double_precision():
        arrays = u[None], np.zeros((1, N, C)), np.ones((1, N)), np.array([float(Ts)])
        y, J = runs_with_slopes(
            layout,
            *map(jnp.asarray, (values[None], scale[None], free, start[None])),
            StackedRecordings(*map(jnp.asarray, arrays)),
            jnp.zeros((1, Layout.of(layout.structure).size, C)),
            None,
        )
        y, J = jax.device_get((y, J))
    return y[0], J[0]


def channel_scale(
    costs: Float[np.ndarray, " C"], samples: int, floor: Float[np.ndarray, " C"]
) -> Float[np.ndarray, " C"]:
    """Root mean square error of each channel, no less than a floor.

    Args:
        costs: Half the sum of squared errors of each channel.
        samples: Number of samples.
        floor: Least scale of each channel.
    """
    return np.maximum(np.sqrt(2 * costs / samples), floor)


# A direction of a first state that changes the first samples by no more than this share of the others is not
# determined by them, and does not follow the parameters.
UNDETERMINED = 1e-6


def with_measured_starts(
    J: Float[np.ndarray, "R N C K"],
    of_states: Float[np.ndarray, "R N C m"],
    windows: Windows,
    n_init: Sequence[int],
) -> tuple[Float[np.ndarray, "R N C K"], Float[np.ndarray, "R W m K"]]:
    """Slopes of runs whose first states are those of least squares on their first samples.

        dx0/dp = -(Jx'Jx)^-1 Jx'Jp over the first samples,   J = Jp + Jx dx0/dp

    This is the derivative of the first state by the parameters but for second derivatives of the run, which
    the small errors of the first samples multiply.

    Args:
        J: Slopes `Jp` by the parameters, with first states held.
        of_states: Slopes `Jx` by the entries of the first state of the window of each sample.
        windows: The windows.
        n_init: Number of first samples of each recording.

    Returns:
        The slopes, and the slopes of the first states.
    """
    starts, total = np.zeros((len(J), windows.number, of_states.shape[-1], J.shape[-1])), J.copy()
    for r, count in enumerate(n_init):
        each = [samples for _, samples in windows.of(r)]
        head = np.array([samples.start for samples in each])[:, None] + np.arange(count)
        # A window may be shorter than the first samples.
        own = (windows.index[r, head] == np.arange(len(each))[:, None])[..., None, None]
        Jp, Jx = (
            np.where(own, slopes[r, head], 0.0).reshape(len(each), -1, slopes.shape[-1])
            for slopes in (J, of_states)
        )
        if not (np.isfinite(Jx).all() and np.isfinite(Jp).all()):
            continue  # the run diverges, and its cost refuses it
        size = np.linalg.norm(Jx, axis=1, keepdims=True)
        size = np.where(size > 0, size, 1.0)
        starts[r, : len(each)] = -(np.linalg.pinv(Jx / size, rcond=UNDETERMINED) @ Jp) / np.swapaxes(
            size, 1, 2
        )
        for k, samples in enumerate(each):
            total[r, samples] += of_states[r, samples] @ starts[r, k]
    return total, starts


@dataclasses.dataclass(frozen=True)
class LikelihoodEquations:
    """Negative log-likelihood of errors, without constants, and its quadratic model at one point.

    First states affect only the samples of their own window. They are eliminated from each step by their
    exact least-squares solution, which is hardly damped as long as the damping of the parameters is small. So
    first states do not hold back a change of a parameter that they can follow.

    Attributes:
        cost: Negative log-likelihood [nat].
        scale: Scale of each channel.
        gradient: Gradient of the cost by the M coordinates.
        H: `J'J` of the scaled errors.
        inner: Which coordinates are eliminated.
        lower: How far each coordinate may move down to a bound, zero or negative.
        upper: How far each coordinate may move up to a bound, zero or positive.
        parts: Scaled errors and slopes of each window.
        starts: Slopes of measured first states by the parameters; None if first states do not follow them.
    """

    cost: float
    scale: Float[np.ndarray, " C"]
    gradient: Float[np.ndarray, " M"]
    H: Float[np.ndarray, "M M"]
    inner: Bool[np.ndarray, " M"]
    lower: Float[np.ndarray, " M"]
    upper: Float[np.ndarray, " M"]
    parts: Sequence[RecordingSlopes]
    starts: Float[np.ndarray, "R W m K"] | None = None

    @functools.cached_property
    def nats_that_count(self) -> float:
        """Number of nats that count as one, since errors are correlated in time."""
        return nats_that_count(self.parts, self.H)

    def promised(self) -> float:
        """Decrease of the quadratic model to its minimum within the bounds [nat]."""
        step, _ = self.step(0.0, None)
        return self.predicted_decrease(step) if np.isfinite(step).all() else np.inf

    def step(self, damping: Any, limit: Any) -> tuple[Float[np.ndarray, " M"], bool]:
        """Damped step within limits and bounds, and whether a limit (not a bound) shortens it."""
        if not (np.isfinite(self.H).all() and np.isfinite(self.gradient).all()):
            return np.full(len(self.gradient), np.nan), False
        size = np.sqrt(np.maximum(np.diag(self.H), 1e-12 * max(np.diag(self.H).max(initial=0.0), 1e-300)))
        A, b = self.H / np.outer(size, size), -self.gradient / size
        i, o = np.flatnonzero(self.inner), np.flatnonzero(~self.inner)
        A = A + RIDGE * np.eye(len(b))
        own = A[np.ix_(i, i)] + damping**2 / (1 + damping) * np.eye(len(i))
        solved = (
            np.linalg.solve(own, np.column_stack([A[np.ix_(i, o)], b[i]]))
            if len(i)
            else np.zeros((0, len(o) + 1))
        )
        left = A[np.ix_(o, o)] - A[np.ix_(o, i)] @ solved[:, :-1]
        right = b[o] - A[np.ix_(o, i)] @ solved[:, -1]
        left = left + np.diag(damping * np.maximum(np.diag(left), 1e-12))
        most = np.full(len(o), np.inf) if limit is None else np.asarray(limit)[o]
        low, high = np.maximum(self.lower[o], -most), np.minimum(self.upper[o], most)
        x, short = solution_within(left, right, low * size[o], high * size[o])
        at_limit = short & (np.where(x < 0, low, high) * size[o] == x) & (np.abs(x) >= most * size[o])
        step = np.zeros(len(b))
        step[o], step[i] = x, solved[:, -1] - solved[:, :-1] @ x
        return step / size, bool(at_limit.any())

    def predicted_decrease(self, step: Float[np.ndarray, " M"]) -> float:
        """Decrease of the quadratic model along a step [nat]."""
        return float(-(self.gradient @ step + step @ self.H @ step / 2))


def negative_log_likelihood(
    e: Float[np.ndarray, "R N C"], samples: int, floor: Float[np.ndarray, " C"]
) -> tuple[float, Float[np.ndarray, " C"]]:
    """Cost of errors without constants [nat], and the scale of each channel.

        cost = sum over channels of  n ln s + sum e^2 / (2 s^2) - n / 2,   s = max(rms e, floor)

    Args:
        e: Errors, zero where a sample does not count.
        samples: Number of samples that count.
        floor: Least scale of each channel.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        costs = np.einsum("rnc,rnc->c", e, e) / 2
        scale = channel_scale(costs, samples, floor)
        return float(np.sum(samples * (np.log(scale) - 0.5) + costs / scale**2)), scale


def likelihood_equations(
    coordinates: FitCoordinates,
    e: Float[np.ndarray, "R N C"],
    J: Float[np.ndarray, "R N C D"],
    seen: Shaped[np.ndarray, "R N"],
    floor: Float[np.ndarray, " C"],
    to_bounds: tuple[Float[np.ndarray, " M"], Float[np.ndarray, " M"]],
) -> LikelihoodEquations:
    """Likelihood and its quadratic model from errors and slopes.

    Args:
        coordinates: The coordinates of the fit.
        e: Errors, zero where a sample does not count.
        J: Slopes of the errors along the directions of each window.
        seen: Not zero where a sample counts.
        floor: Least scale of each channel.
        to_bounds: How far each coordinate may move down and up.
    """
    cost, scale = negative_log_likelihood(e, int(np.count_nonzero(seen)), floor)
    with np.errstate(over="ignore", invalid="ignore"):
        parts = coordinates.parts(e / scale, J / scale[:, None], seen)
        H, g = curvature(parts, coordinates.size), np.zeros(coordinates.size)
        for part in parts:
            g[part.columns] += flattened(part.J).T @ part.e.ravel()
    inner = np.arange(coordinates.size) >= coordinates.shared
    for r in range(len(e)):
        inner[coordinates.local_columns(r)] = False
    return LikelihoodEquations(cost, scale, g, H, inner, *to_bounds, parts)
