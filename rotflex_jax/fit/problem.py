"""Model errors of recordings as a function of one flat vector of coordinates, and their normal equations.

The coordinates are the unconstrained values of all parameters, then values that belong to one recording
alone, then the first states of all recordings. A fit adjusts some of them; the rest are held.

The scan carries the state, its slopes along every direction, and the sums

    cost = sum e'e / 2,   g = sum J'e,   H = sum J'J,   e = (y_hat - y) / s,   J = de/dp

so that nothing of the length of a recording is stored. A fit that needs only these three is
several times quicker with it than with the slopes of all samples, as long as small loops are compiled
into one function (`enable_fast_loops`).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Float, Int

from rotflex_jax.fit.dataset import StackedRecordings
from rotflex_jax.mechanism import Mechanism, Solver, predictor_run
from rotflex_jax.mechanism.assembly import rest_state, whole_state
from rotflex_jax.mechanism.sensitivities import (
    RecordingSamples,
    RunParameters,
    TangentDirections,
    accumulate_outputs,
    outputs_with_sensitivities,
)
from rotflex_jax.optimise.damped_least_squares import NormalEquations
from rotflex_jax.parameters import Transform
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import spread


@dataclasses.dataclass(frozen=True)
class Coordinates:
    """What each entry of the flat vector is; hashable, so it can be static.

    Attributes:
        structure: Mechanism without numbers.
        local: Indices of parameters that each recording has for itself, known constants among them.
        recordings: How many recordings, or windows of them, each with a first state.
        windows_of: Which recording each window is of; empty where none is cut.
    """

    structure: Mechanism
    local: tuple[int, ...]
    recordings: int
    windows_of: tuple[int, ...] = ()

    @property
    def owners(self) -> tuple[int, ...]:
        """For each first state, the recording whose local parameters it goes with."""
        return self.windows_of or tuple(range(self.recordings))

    @property
    def owning(self) -> int:
        """How many recordings have local parameters."""
        return max(self.owners) + 1

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        return len(self.structure.parameter_names)

    @property
    def states(self) -> int:
        """Positions and speeds of one first state."""
        return 2 * len(self.structure.coordinates)

    @property
    def size(self) -> int:
        """Length of the flat vector."""
        return self.parameters + self.owning * len(self.local) + self.recordings * self.states

    def local_index(self, recording: int, parameter: int) -> int:
        """Index of a recording's own value of a parameter."""
        return self.parameters + recording * len(self.local) + self.local.index(parameter)

    def state_index(self, recording: int) -> Int[np.ndarray, " s"]:
        """Indices of a recording's first state."""
        start = self.parameters + self.owning * len(self.local) + recording * self.states
        return np.arange(start, start + self.states)

    @property
    def transform(self) -> Transform:
        """Unconstrained <-> physical, by the declared bounds."""
        return Transform.of(self.structure.parameter_specifications)

    def split(self, flat: Float[Array, " F"]) -> tuple[Float[Array, "R P"], Float[Array, "R s"]]:
        """Physical parameter values and first states of each recording."""
        P, L, R, each = self.parameters, len(self.local), self.recordings, self.owning
        z = jnp.broadcast_to(flat[:P], (R, P))
        own = flat[P : P + each * L].reshape(each, L)
        if L:
            z = z.at[:, np.array(self.local)].set(own[np.array(self.owners)])
        constrain = jax.vmap(self.transform.constrain)
        return constrain(z), flat[P + each * L :].reshape(R, self.states)

    def values(self, flat: Float[np.ndarray, " F"]) -> Float[np.ndarray, "R P"]:
        """Physical parameter values of each recording."""
        return np.asarray(_split(self, jnp.asarray(flat))[0])

    def flatten(
        self, values: Float[np.ndarray, " P"], x0: Float[np.ndarray, "R s"]
    ) -> Float[np.ndarray, " F"]:
        """The flat vector for physical values, the same in every recording, and first states."""
        z = self.transform.unconstrain(values)
        own = np.tile(z[list(self.local)], self.owning)
        return np.concatenate([z, own, np.asarray(x0, float).ravel()])

    def with_constants(
        self, flat: Float[np.ndarray, " F"], constants: Float[np.ndarray, "R P"]
    ) -> Float[np.ndarray, " F"]:
        """The flat vector with the values that recordings know; nan where the common one counts."""
        flat, z = flat.copy(), self.transform.unconstrain(constants)
        for r, own in enumerate(self.owners):
            for i in np.flatnonzero(~np.isnan(constants[r])).tolist():
                flat[self.local_index(own, i)] = z[r, i]
        return flat


@persistent_jit(static=1)
def _split(coordinates: Coordinates, flat: jax.Array) -> tuple[jax.Array, jax.Array]:
    return coordinates.split(flat)


def predicted(
    structure: Mechanism,
    solver: Solver,
    values: Float[Array, "R P"],
    x0: Float[Array, "R *W s"],
    gates: Float[Array, " E"],
    data: StackedRecordings,
    K: Float[Array, "R n C"],
    window: Int[Array, "R N"] | None = None,
) -> Float[Array, "R N C"]:
    """Outputs of R recordings, predicted with gain `K`; a free run where it is zero.

    Args:
        structure: Mechanism without numbers.
        solver: Integration rule.
        values: Parameter values of each recording.
        x0: First positions and speeds.
        gates: One factor per effect.
        data: The recordings.
        K: Gains.
        window: Window of each sample, where runs start again at each; `x0` is then (R, W, s).
    """
    run = functools.partial(predictor_run, structure, solver)
    rows = (values, gates, whole_state(structure, x0), data.u, data.y, data.seen, K, data.Ts)
    axes: tuple[int | None, ...] = (0, None, 0, 0, 0, 0, 0, 0)
    if window is not None:
        rows, axes = (*rows, window), (*axes, 0)
    return each_recording(run, axes)(*rows)[1]


def each_recording(run: Callable[..., Any], in_axes: tuple[int | None, ...], out_axes: int = 0) -> Callable:
    """`jax.vmap` over recordings; a single one is run as it is, which takes half the time to trace.

    Args:
        run: What one recording goes through.
        in_axes: Axis of the recordings in each argument; None where all share it. The first has one.
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


LARGEST_STEP = 1.0
"""Largest step of the unconstrained coordinate of a parameter with a bound: a factor of e."""


def normal_equations(
    structure: Mechanism,
    solver: Solver,
    numbers: RunParameters,
    ways: TangentDirections,
    samples: RecordingSamples,
    scale: Float[Array, " C"],
) -> NormalEquations:
    """Half the squared error of each channel of a run, the gradient of their sum, and `J'J`.

    Args:
        structure: Mechanism without numbers; static.
        solver: Integration rule; static.
        numbers: Where it runs; a free run where the gain is None.
        ways: The D directions.
        samples: The recording.
        scale: Size of the error of each channel.
    """

    def fold(sums: NormalEquations, y_hat: Array, J: Array, sample: Any) -> tuple[NormalEquations, None]:
        y, counts = sample
        # Not a product: beyond its last sample a run may diverge.
        e = jnp.where(counts > 0, (y_hat - y) / scale, 0.0)
        J = jnp.where(counts > 0, J / scale[:, None], 0.0)
        each = range(len(e))
        return NormalEquations(
            sums.costs + e * e / 2,
            sums.gradient + sum(J[c] * e[c] for c in each),
            sums.H + sum(J[c][:, None] * J[c][None] for c in each),
        ), None

    D, dtype = len(ways.x0), samples.u.dtype
    none = NormalEquations(jnp.zeros(len(scale), dtype), jnp.zeros(D, dtype), jnp.zeros((D, D), dtype))
    return accumulate_outputs(structure, solver, numbers, ways, samples, fold, none)[0]


def directions(
    structure: Mechanism, slopes: Float[Array, " P"], free: Int[Array, " K"], states: int
) -> TangentDirections:
    """Directions of the coordinates of some parameters, then of that many positions and speeds.

    Args:
        structure: Mechanism without numbers.
        slopes: Derivative of each value by its coordinate.
        free: Indices of the parameters.
        states: How many entries of the first state are free.
    """
    K, D = len(free), len(free) + states
    values = jnp.zeros((D, len(slopes)), slopes.dtype).at[jnp.arange(K), free].set(slopes[free])
    n = len(rest_state(structure, np.float64))
    x0 = jnp.zeros((D, n), slopes.dtype).at[K + jnp.arange(states), jnp.arange(states)].set(1.0)
    return TangentDirections(values, jnp.zeros((D, len(structure.effects)), slopes.dtype), x0)


@dataclasses.dataclass(frozen=True)
class FreeCoordinates:
    """Which of the coordinates a fit adjusts, and how they run; hashable, so it can be static.

    Attributes:
        coordinates: All of them.
        solver: Integration rule.
        parameters: Indices of the free parameters.
        first_states: Whether first states are adjusted.
        mesh: Devices that the recordings are shared out to; None for one device.
    """

    coordinates: Coordinates
    solver: Solver
    parameters: tuple[int, ...]
    first_states: bool
    mesh: Mesh | None = None

    @functools.cached_property
    def index_by_recording(self) -> Int[np.ndarray, "R D"]:
        """Indices in the flat vector of the directions of each recording."""
        c = self.coordinates
        owned = lambda r, i: c.local_index(r, i) if i in c.local else i  # noqa: E731
        rows = [
            [owned(c.owners[r], i) for i in self.parameters]
            + (c.state_index(r).tolist() if self.first_states else [])
            for r in range(c.recordings)
        ]
        return np.array(rows)

    @functools.cached_property
    def index(self) -> Int[np.ndarray, " M"]:
        """Indices in the flat vector of what is free: common parameters, local ones, states."""
        return np.unique(self.index_by_recording)

    @functools.cached_property
    def columns(self) -> Int[np.ndarray, "R D"]:
        """Columns of the directions of each recording among the free coordinates."""
        return np.searchsorted(self.index, self.index_by_recording)

    @functools.cached_property
    def step_limit(self) -> Float[np.ndarray, " M"]:
        """Largest step of each: a parameter with a bound by a factor of e, others without limit."""
        specs = self.coordinates.structure.parameter_specifications
        most = np.full(len(self.index), np.inf)
        for column, i in enumerate(self.parameters):
            if np.isfinite(specs[i].lower) or np.isfinite(specs[i].upper):
                most[self.columns[:, column]] = LARGEST_STEP
        return most

    def by_recording(
        self, flat: Float[Array, " F"], gates: Float[Array, " E"], K: Float[Array, "R n C"]
    ) -> tuple[RunParameters, TangentDirections]:
        """RunParameters and directions of each recording, along a leading axis."""
        structure, c = self.coordinates.structure, self.coordinates
        (values, x0), (slopes, _) = jax.jvp(c.split, (flat,), (jnp.ones_like(flat),))
        states = c.states if self.first_states else 0
        ways = jax.vmap(lambda s: directions(structure, s, jnp.array(self.parameters), states))(slopes)
        return RunParameters(
            values, jnp.broadcast_to(gates, (len(values), *gates.shape)), whole_state(structure, x0), K
        ), ways


class RunInputs(NamedTuple):
    """What the runs of one minimisation have in common.

    Attributes:
        gates: One factor per effect.
        data: The recordings.
        K: Gains of the predictor.
        scale: Size of the error of each channel.
    """

    gates: Float[Any, " E"]
    data: StackedRecordings
    K: Float[Any, "R n C"]
    scale: Float[Any, " C"]


@persistent_jit(static=1)
def summed_equations(free: FreeCoordinates, flat: Float[Array, " F"], inputs: RunInputs) -> NormalEquations:
    """Normal equations of all recordings, by the M free coordinates; the cost of each channel apart."""

    def one(
        numbers: RunParameters, ways: TangentDirections, samples: RecordingSamples, scale: jax.Array
    ) -> NormalEquations:
        structure = free.coordinates.structure
        return normal_equations(structure, free.solver, numbers, ways, samples, scale)

    found = _each_recording(one, free, flat, inputs)
    M, columns = len(free.index), jnp.asarray(free.columns)
    g = jnp.zeros(M, flat.dtype).at[columns].add(found.gradient)
    H = jnp.zeros((M, M), flat.dtype).at[columns[:, :, None], columns[:, None, :]].add(found.H)
    return NormalEquations(jnp.sum(found.costs, axis=0), g, H)


@persistent_jit(static=1)
def residuals_and_slopes(
    free: FreeCoordinates, flat: Float[Array, " F"], inputs: RunInputs
) -> tuple[Float[Array, "R N C"], Float[Array, "R N C D"]]:
    """Scaled errors and their slopes by the directions of each recording."""

    def one(
        numbers: RunParameters, ways: TangentDirections, samples: RecordingSamples, scale: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        y_hat, J = outputs_with_sensitivities(free.coordinates.structure, free.solver, numbers, ways, samples)
        seen = samples.seen[:, None] > 0
        e = jnp.where(seen, (samples.y - y_hat) / scale[None], 0.0)
        return e, jnp.where(seen[..., None], -J / scale[None, :, None], 0.0)

    return _each_recording(one, free, flat, inputs)


def _each_recording(
    one: Callable[..., Any], free: FreeCoordinates, flat: jax.Array, inputs: RunInputs
) -> Any:
    """`one` of the numbers, directions, samples and scale of each recording, along a leading axis."""

    def every(rows: Any, scale: jax.Array) -> Any:
        return jax.lax.map(lambda r: one(r[0], r[1], RecordingSamples(*r[2]), scale), rows)

    rows = (*free.by_recording(flat, inputs.gates, inputs.K), tuple(inputs.data))
    return spread(every, free.mesh)(rows, inputs.scale)
