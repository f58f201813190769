"""Recordings prepared for a fit: stacked arrays, sensor noise, torque scale, windows with first states.

A free run is a predictor with gain zero. Over a whole recording its error grows with every small error of the
parameters, so it may start again every few seconds, each time from a first state of its own. Both kinds of
runs use the same compiled programs, since the window of each sample is data.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.initial_state import rough_states
from rotflex_jax.mechanism.linear import inverse_mass, linearise
from rotflex_jax.metrics import window_starts
from rotflex_jax.models.model import Model, program_length
from rotflex_jax.recording import Recording

# Least number of windows in arrays of programs, if runs start again at all; more windows cost hardly any
# time.
_LEAST_WINDOWS = 16


class StackedRecordings(NamedTuple):
    """Recordings stacked in arrays; shorter ones are padded with samples that do not count.

    Attributes:
        u: Inputs; if the mechanism has signals, with these in further columns.
        y: Outputs, in the channels of the model.
        seen: One where a sample counts, zero where it is padding.
        Ts: Sampling periods [s].
    """

    u: Float[Any, "R N *c"]
    y: Float[Any, "R N C"]
    seen: Float[Any, "R N"]
    Ts: Float[Any, " R"]

    @property
    def voltage(self) -> Float[Any, "R N"]:
        """Inputs without other signals."""
        return self.u if self.u.ndim == 2 else self.u[..., 0]


@dataclasses.dataclass(frozen=True)
class Dataset:
    """Recordings prepared for the fit of one model.

    Attributes:
        recordings: The recordings as they were given.
        data: The recordings as arrays.
        noise: Standard deviation of the sensor noise of each channel.
        torque_scale: Torque that the motor gives at the root mean square voltage [N m].
        first_states: First positions and speeds from which a fit starts.
        constants: Constants of the recordings; nan for parameters that have the value of the model.
    """

    recordings: tuple[Recording, ...]
    data: StackedRecordings
    noise: Float[np.ndarray, " C"]
    torque_scale: float
    first_states: Float[np.ndarray, "R n"]
    constants: Float[np.ndarray, "R P"]


def prepare(
    model: Model,
    recordings: Sequence[Recording],
    *,
    length: int | None = None,
    noise_of: Sequence[Recording] = (),
    like: Dataset | None = None,
) -> Dataset:
    """Recordings prepared for a model.

    Args:
        model: The model, which gives channels, motor and coordinates.
        recordings: One or several recordings.
        length: Least number of samples of the arrays, so that other recordings share compiled code.
        noise_of: Further recordings of the same sensors, from which the noise is estimated as well.
        like: Dataset whose sensor noise and torque scale are taken over.

    Raises:
        InputError: If there is no recording, if a recording lacks a channel of the model, or if a channel
            never moves.
    """
    data = stack(recordings, model, length)
    if like is None:
        check_moving(model, recordings)
    return Dataset(
        recordings=tuple(recordings),
        data=data,
        noise=like.noise if like else sensor_noise((*recordings, *noise_of), model),
        torque_scale=like.torque_scale if like else torque_scale(model.mechanism, data),
        first_states=first_states(model, recordings),
        constants=known_values(model, recordings),
    )


def check_moving(model: Model, recordings: Sequence[Recording]) -> None:
    """Refuse recordings in which a channel of the model never moves: its noise would be zero.

    Raises:
        InputError: If a channel has the same value in all recordings.
    """
    whole = np.concatenate([model.measured(r) for r in recordings])
    still = [c for c, y in zip(model.mechanism.channels, whole.T, strict=True) if np.ptp(y) == 0]
    if still:
        raise InputError(
            f"Channel {still[0]!r} has one value throughout all recordings, from which nothing can be "
            "learned; give a recording in which it moves."
        )


def known_values(model: Model, recordings: Sequence[Recording]) -> Float[np.ndarray, "R P"]:
    """Constants of the recordings; nan for parameters that have the value of the model.

    Raises:
        InputError: If a constant belongs to a parameter that is free in the model.
    """
    names = model.mechanism.parameter_names
    known = np.full((len(recordings), len(names)), np.nan)
    for row, recording in zip(known, recordings, strict=True):
        model.at(recording)  # names are checked there
        for name, value in recording.constants.items():
            if name in model.mechanism.free_names:
                raise InputError(
                    f"Parameter {name!r} is free in the model, but the recording knows that it is {value:g}; "
                    f"hold it, mechanism.trust({name!r})."
                )
            if name in names:
                row[names.index(name)] = value
    return known


def with_common_constants(model: Model, recordings: Sequence[Recording]) -> Model:
    """The model with the constants of the recordings, which must be the same in all of them.

    Raises:
        InputError: If constants differ between recordings.
    """
    known = known_values(model, recordings)
    differ = ~np.all((known == known[:1]) | np.isnan(known) & np.isnan(known[:1]), axis=0)
    if np.any(differ):
        names = [n for n, d in zip(model.mechanism.parameter_names, differ, strict=True) if d]
        raise InputError(
            f"The recordings differ in {', '.join(names)}, but here all share one set of constants; give "
            "recordings with the same constants, or use `fit`."
        )
    return model.at(recordings[0])


def padded_length(recordings: Sequence[Recording]) -> int:
    """A length of arrays that recordings of similar lengths have in common, so that they share compiled code.

    It is the longest length, rounded up to one of eight lengths between powers of two: 1/16 more on average.
    """
    longest = max((r.N for r in recordings), default=0)
    step = 2 ** max(0, longest.bit_length() - 4)
    return -(-longest // step) * step


def padded_windows(number: int) -> int:
    """A number of windows in arrays that runs with similar numbers have in common, to share programs."""
    return program_length(number, _LEAST_WINDOWS)


def stack(recordings: Sequence[Recording], model: Model, length: int | None = None) -> StackedRecordings:
    """Recordings as float64 arrays, with the channels of the model and at least the given length."""
    if not recordings:
        raise InputError("No recording was given, but at least one is needed; pass a Recording.")
    N = max(length or 0, *(r.N for r in recordings))
    R, C = len(recordings), len(model.mechanism.channels)
    inputs = [model.inputs(r) for r in recordings]
    u = np.zeros((R, N, *inputs[0].shape[1:]))
    data = StackedRecordings(u, np.zeros((R, N, C)), np.zeros((R, N)), np.ones(R))
    for i, r in enumerate(recordings):
        data.u[i, : r.N], data.y[i, : r.N], data.seen[i, : r.N] = inputs[i], model.measured(r), 1.0
        data.Ts[i] = r.Ts
    return data


def first_states(model: Model, recordings: Sequence[Recording]) -> Float[np.ndarray, "R n"]:
    """First positions and speeds (R, 2 n) for the start of a fit, by straight lines through first samples."""
    heads = [model.measured(r)[: r.n_init].astype(float) for r in recordings]
    structure = model.mechanism.structure
    return np.concatenate(
        [rough_states(structure, y[None], r.Ts) for y, r in zip(heads, recordings, strict=True)]
    )


def sensor_noise(recordings: Sequence[Recording], model: Model) -> Float[np.ndarray, " C"]:
    """Standard deviation of the sensor noise of each channel (C,), from residuals of local polynomials.

    A cubic polynomial over 11 neighbouring samples follows the motion, and its residuals are noise. If a
    period of the motion has only a few samples, only a higher degree follows it, so the least value of
    several degrees is taken. It is never less than the error of rounding to steps of `resolution`, step /
    sqrt(12).
    """
    return np.min([_left_by(degree, recordings, model) for degree in (3, 5, 7, 9)], axis=0)


def _left_by(degree: int, recordings: Sequence[Recording], model: Model) -> np.ndarray:
    """Standard deviation of white noise that would leave these residuals of local polynomials of a degree."""
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


def process_noise_ports(m: Mechanism, intensity: float) -> dict[str, float]:
    """Process noise of the same intensity at the fewest ports whose torques drive every coordinate."""
    chosen: dict[str, float] = {}
    span = np.zeros((0, len(m.coordinates)))
    for port, vector in m.port_vectors.items():
        grown = np.vstack([span, vector])
        if np.linalg.matrix_rank(grown) > len(span):
            span, chosen[port] = grown, intensity
    return chosen


def torque_scale(m: Mechanism, data: StackedRecordings) -> float:
    """Torque [N m] that the motor gives at the root mean square voltage."""
    n = len(m.coordinates)
    push = np.linalg.solve(inverse_mass(m), linearise(m).B[n : 2 * n])
    level = float(np.sqrt(np.sum(data.voltage**2 * data.seen) / np.sum(data.seen)))
    return max(float(np.max(np.abs(push))) * level, 1e-6)


@dataclasses.dataclass(frozen=True)
class Windows:
    """The windows of some recordings, filled up to the same number W in all of them.

    Attributes:
        index: Window of each sample.
        counts: Number of windows of each recording.
        first_states: First positions and speeds of each window, from which a fit starts.
    """

    index: Int[np.ndarray, "R N"]
    counts: tuple[int, ...]
    first_states: Float[np.ndarray, "R W n"]

    @classmethod
    def whole(cls, dataset: Dataset) -> "Windows":
        """One window per recording."""
        R, N = dataset.data.seen.shape
        return cls(np.zeros((R, N), np.int32), (1,) * R, dataset.first_states[:, None])

    @classmethod
    def of_seconds(cls, model: Model, dataset: Dataset, seconds: float) -> "Windows":
        """Windows of some seconds, the same as for errors over windows.

        Args:
            model: The model, which gives the channels.
            dataset: The recordings.
            seconds: Length of a window [s].
        """
        starts = [window_starts(r, seconds)[0] for r in dataset.recordings]
        counts = tuple(map(len, starts))
        R, N = dataset.data.seen.shape
        index = np.zeros((R, N), np.int32)
        first = np.repeat(dataset.first_states[:, None], max(counts), axis=1)
        for r, (recording, begins) in enumerate(zip(dataset.recordings, starts, strict=True)):
            y = model.measured(recording).astype(float)
            index[r] = np.searchsorted(begins, np.arange(N), side="right") - 1
            heads = y[begins[:, None] + np.arange(recording.n_init)]
            first[r, : len(begins)] = rough_states(model.mechanism.structure, heads, recording.Ts)
        return cls(index, counts, first)

    def filled_up(self, number: int) -> "Windows":
        """The same windows in arrays for at least this number, to share programs with other runs."""
        more = max(number - self.number, 0)
        last = np.repeat(self.first_states[:, -1:], more, axis=1)
        return dataclasses.replace(self, first_states=np.concatenate([self.first_states, last], axis=1))

    @property
    def number(self) -> int:
        """Number W of windows in the arrays."""
        return self.first_states.shape[1]

    def of(self, recording: int) -> Iterator[tuple[int, slice]]:
        """Each window of a recording with its samples."""
        edges = np.searchsorted(self.index[recording], np.arange(self.counts[recording] + 1))
        for w in range(self.counts[recording]):
            yield w, slice(int(edges[w]), int(edges[w + 1]))
