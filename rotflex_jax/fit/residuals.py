"""Model errors of several recordings as a function of one flat vector of coordinates.

The coordinates are the unconstrained values of all parameters, then values that belong to one recording
alone, then the first states of all recordings. A fit moves some of them; the rest are held.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Mechanism, Solver, predictor_run
from rotflex_jax.mechanism.assembly import whole_state
from rotflex_jax.mechanism.initial import rough_state
from rotflex_jax.mechanism.programs import kept
from rotflex_jax.model import Model
from rotflex_jax.parameters import Transform
from rotflex_jax.recording import Recording


class Data(NamedTuple):
    """Recordings side by side, shorter ones filled up with samples that are not `seen`."""

    u: Any  # (R, N)
    y: Any  # (R, N, C)
    seen: Any  # (R, N)
    Ts: Any  # (R,)


def roomy(recordings: Sequence[Recording]) -> int:
    """A length for `stack` that recordings of nearby lengths share, and with it what is compiled for it.

    The longest, rounded up to one of eight lengths between powers of two: 1/16 more on average.
    """
    longest = max((r.N for r in recordings), default=0)
    step = 2 ** max(0, longest.bit_length() - 4)
    return -(-longest // step) * step


def stack(recordings: Sequence[Recording], model: Model, length: int | None = None) -> Data:
    """Recordings as arrays, float64, with the channels the model has; of the given length at least."""
    if not recordings:
        raise InputError("No recording was given, but at least one is needed; pass a Recording.")
    N = max(length or 0, *(r.N for r in recordings))
    R, C = len(recordings), len(model.mechanism.channels)
    data = Data(np.zeros((R, N)), np.zeros((R, N, C)), np.zeros((R, N)), np.ones(R))
    for i, r in enumerate(recordings):
        data.u[i, : r.N], data.y[i, : r.N], data.seen[i, : r.N] = r.u, model.measured(r), 1.0
        data.Ts[i] = r.Ts
    return data


@dataclasses.dataclass(frozen=True)
class Coordinates:
    """Which number of the flat vector means what; hashable, so it can be static.

    Attributes:
        structure: Mechanism without numbers.
        local: Indices of parameters that each recording has for itself.
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
        """Place of a recording's own value of a parameter."""
        return self.parameters + recording * len(self.local) + self.local.index(parameter)

    def state_index(self, recording: int) -> np.ndarray:
        """Places of a recording's first state."""
        start = self.parameters + self.owning * len(self.local) + recording * self.states
        return np.arange(start, start + self.states)

    @property
    def transform(self) -> Transform:
        """Unconstrained <-> physical, by the declared bounds."""
        return Transform.of(self.structure.parameter_specifications)

    def split(self, flat: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Physical parameter values (R, P) and first states (R, 2 n)."""
        P, L, R, each = self.parameters, len(self.local), self.recordings, self.owning
        z = jnp.broadcast_to(flat[:P], (R, P))
        own = flat[P : P + each * L].reshape(each, L)
        if L:
            z = z.at[:, np.array(self.local)].set(own[np.array(self.owners)])
        constrain = jax.vmap(self.transform.constrain)
        return constrain(z), flat[P + each * L :].reshape(R, self.states)

    def values(self, flat: np.ndarray) -> np.ndarray:
        """Physical parameter values (R, P)."""
        return np.asarray(_split(self, jnp.asarray(flat))[0])

    def flatten(self, values: np.ndarray, x0: np.ndarray) -> np.ndarray:
        """The flat vector for physical values (P,), the same in every recording, and first states."""
        z = self.transform.unconstrain(values)
        own = np.tile(z[list(self.local)], self.owning)
        return np.concatenate([z, own, np.asarray(x0, float).ravel()])


@kept(static=1)
def _split(coordinates: Coordinates, flat: jax.Array) -> tuple[jax.Array, jax.Array]:
    return coordinates.split(flat)


def predicted(
    structure: Mechanism,
    solver: Solver,
    values: jax.Array,
    x0: jax.Array,
    gates: jax.Array,
    data: Data,
    K: jax.Array,
) -> jax.Array:
    """Outputs (R, N, C) of R recordings, predicted with gain `K`; a free run where it is zero.

    Args:
        structure: Mechanism without numbers.
        solver: Integration rule.
        values: Parameter values of each recording (R, P).
        x0: First positions and speeds (R, 2 n).
        gates: One factor per effect (E,).
        data: The recordings.
        K: Gains (R, n, C).
    """
    run = functools.partial(predictor_run, structure, solver)
    return each_recording(run, in_axes=(0, None, 0, 0, 0, 0, 0, 0))(
        values, gates, whole_state(structure, x0), data.u, data.y, data.seen, K, data.Ts
    )[1]


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


def first_states(model: Model, recordings: Sequence[Recording]) -> np.ndarray:
    """First positions and speeds (R, 2 n): straight lines through the first samples, where a fit starts."""
    heads = [model.measured(r)[: r.n_init].astype(float) for r in recordings]
    structure = model.mechanism.structure
    return np.array([rough_state(structure, y, r.Ts) for y, r in zip(heads, recordings, strict=True)])


def sensor_noise(recordings: Sequence[Recording], model: Model) -> np.ndarray:
    """Standard deviation of the sensor noise per channel (C,), from residuals of local polynomials.

    A cubic through 11 neighbouring samples follows the motion; what it leaves is noise. Where a period
    of the motion is but a few samples long, only a higher degree follows it: the least of several counts.
    Never less than the rounding to steps of `resolution` leaves, step / sqrt(12).
    """
    return np.min([_left_by(degree, recordings, model) for degree in (3, 5, 7, 9)], axis=0)


def _left_by(degree: int, recordings: Sequence[Recording], model: Model) -> np.ndarray:
    """Deviation that local polynomials of a degree leave, if all of it were white noise."""
    half = 5
    t = np.arange(-half, half + 1) / half
    V = np.vander(t, degree + 1)
    leftover = np.eye(len(t)) - V @ np.linalg.pinv(V)
    row = leftover[half]
    total, floor, count = 0.0, 0.0, 0
    for r in recordings:
        y = model.measured(r).astype(float)
        filtered = np.stack([np.convolve(c, row[::-1], "valid") for c in y.T], axis=1)
        total = total + np.sum(filtered**2, axis=0) / np.sum(row**2)
        count += len(filtered)
        steps = [r.resolution.get(c) or 0.0 for c in model.mechanism.channels]
        floor = np.maximum(floor, np.array(steps) / np.sqrt(12))
    smallest = 1e-9 * max(float(np.max(np.abs(model.measured(r)))) for r in recordings)
    return np.maximum(np.maximum(np.sqrt(total / max(count, 1)), floor), max(smallest, 1e-300))
