"""The coordinates of a fit, and the block structure of its least-squares problem.

The coordinates are the parameters common to all recordings, then for each recording its local parameters and
the first states of its windows. A first state affects only its window, and a local parameter only its
recording, so products and projections are formed block by block.
"""

import dataclasses
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
from jaxtyping import Float, Int, Shaped

from rotflex_jax.fit.dataset import Windows
from rotflex_jax.fit.inference import RecordingSlopes

# A direction of which no more than this share is left after a projection counts as linearly dependent.
RANK_TOLERANCE = 1e-10


class Point(Protocol):
    """Parameters that a fit moves: a dataclass with at least these fields."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def free(self) -> tuple[int, ...]: ...  # noqa: D102 - indices of common parameters
    @property
    def local(self) -> tuple[int, ...]: ...  # noqa: D102 - indices of local parameters
    @property
    def z(self) -> Float[np.ndarray, " P"]: ...  # noqa: D102 - unconstrained values of all parameters
    @property
    def local_z(self) -> Float[np.ndarray, "R L"]: ...  # noqa: D102 - unconstrained local values
    @property
    def x0(self) -> Float[np.ndarray, "R W m"]: ...  # noqa: D102 - first states of the windows


PointType = TypeVar("PointType", bound=Point)


@dataclasses.dataclass(frozen=True)
class FitCoordinates:
    """The M coordinates of a fit.

    Attributes:
        shared: Number of parameters common to all recordings; zero if these are held.
        local: Number of local parameters of each recording.
        states: Number of entries of a first state.
        windows: Windows at whose beginnings runs start again.
    """

    shared: int
    local: int
    states: int
    windows: Windows

    @classmethod
    def of(cls, h: Point, windows: Windows) -> "FitCoordinates":
        """The coordinates of a hypothesis, or of another point."""
        return cls(len(h.free), len(h.local), h.x0.shape[-1], windows)

    @property
    def directions(self) -> int:
        """Number of directions of a run, the same for all windows and recordings."""
        return self.shared + self.local + self.states

    @property
    def size(self) -> int:
        """Number M of coordinates."""
        return self._start(len(self.windows.counts))

    def _start(self, recording: int) -> int:
        """First column of the coordinates of one recording."""
        counts = self.windows.counts[:recording]
        return self.shared + len(counts) * self.local + sum(counts) * self.states

    def local_columns(self, recording: int) -> Int[np.ndarray, " L"]:
        """Columns of the local parameters of a recording."""
        return self._start(recording) + np.arange(self.local)

    def state_columns(self, recording: int, window: int) -> Int[np.ndarray, " m"]:
        """Columns of a window's first state."""
        return self._start(recording) + self.local + window * self.states + np.arange(self.states)

    def columns(self, recording: int, window: int) -> Int[np.ndarray, " D"]:
        """Columns of all directions within a window."""
        own = self.local_columns(recording), self.state_columns(recording, window)
        return np.concatenate([np.arange(self.shared), *own])

    def of_recording(self, recording: int) -> Int[np.ndarray, " O"]:
        """Columns of the local parameters and first states of one recording."""
        return np.arange(self._start(recording), self._start(recording + 1))

    def sums(
        self, w: Float[np.ndarray, "R N C"], W: Float[np.ndarray, "D R N C"]
    ) -> tuple[Float[np.ndarray, "M M"], Float[np.ndarray, " M"]]:
        """`J'J` and `J'w` of whitened innovations `w` and their slopes `W` along the directions."""
        H, g = np.zeros((self.size, self.size)), np.zeros(self.size)
        for r in range(len(w)):
            for k, samples in self.windows.of(r):
                J, columns = W[: self.directions, r, samples].reshape(self.directions, -1), self.columns(r, k)
                H[np.ix_(columns, columns)] += J @ J.T
                g[columns] += J @ w[r, samples].ravel()
        return H, g

    def parts(
        self, e: Float[np.ndarray, "R N C"], J: Float[np.ndarray, "R N C D"], seen: Shaped[np.ndarray, "R N"]
    ) -> list[RecordingSlopes]:
        """Errors and slopes of the samples that count, window by window, with their columns.

        Args:
            e: Errors.
            J: Slopes of the errors along the directions of each window.
            seen: Not zero where a sample counts.
        """
        found = []
        for r, counts in enumerate(np.asarray(seen) > 0):
            for k, samples in self.windows.of(r):
                inside = counts[samples]
                if inside.any():  # not in a recording that does not count
                    found.append(
                        RecordingSlopes(J[r, samples][inside], e[r, samples][inside], self.columns(r, k))
                    )
        return found

    def moved(
        self,
        h: PointType,
        step: Float[np.ndarray, " M"],
        starts: Float[np.ndarray, "R W m K"] | None = None,
    ) -> PointType:
        """The point after a step in these coordinates.

        Args:
            h: The point.
            step: The step.
            starts: Slopes by the parameters of first states that are no coordinates and follow these; None if
                they are held.
        """
        z, local_z, x0 = h.z.copy(), h.local_z.copy(), h.x0.copy()
        z[list(h.free[: self.shared])] += step[: self.shared]
        for r, count in enumerate(self.windows.counts):
            local_z[r] += step[self.local_columns(r)]
            for k in range(count):
                x0[r, k, : self.states] += step[self.state_columns(r, k)]
            if starts is not None:  # without coordinates of states, all windows have the same columns
                x0[r, :count, : starts.shape[2]] += starts[r, :count] @ step[self.columns(r, 0)]
        return dataclasses.replace(h, z=z, local_z=local_z, x0=x0)

    def step_limit(self, each: Float[np.ndarray, " P"]) -> Float[np.ndarray, " M"]:
        """Largest step of each coordinate; it is infinite for first states.

        Args:
            each: Largest step of each common parameter, followed by each local one.
        """
        most = np.full(self.size, np.inf)
        most[: self.shared] = each[: self.shared]
        for r in range(len(self.windows.counts)):
            most[self.local_columns(r)] = each[self.shared :]
        return most

    def orthogonal_to(self, W: Float[np.ndarray, "D R N C"]) -> "Projection":
        """The projection that removes what slopes along the directions can explain."""
        return Projection(self, W[: self.directions])


class Projection:
    """Signals without their projection on the slopes along all coordinates of a fit.

    First states are projected out within each window, then local parameters within each recording, then
    common parameters, each from what is left of the ones before. Together this is the projection on all of
    them (theorem of Frisch, Waugh and Lovell).
    """

    def __init__(self, coordinates: FitCoordinates, W: Float[np.ndarray, "D R N C"]) -> None:
        self._windows, (shared, local) = coordinates.windows, (coordinates.shared, coordinates.local)
        left = W.copy()
        self._states = [
            [_basis(left[shared + local :, r, samples]) for _, samples in self._windows.of(r)]
            for r in range(W.shape[1])
        ]
        self._remove_states(left)
        self._local = [_basis(left[shared : shared + local, r]) for r in range(W.shape[1])]
        self._remove_local(left)
        self._shared = _basis(left[:shared])

    def __call__(self, signals: Float[np.ndarray, "K R N C"]) -> Float[np.ndarray, "K M"]:
        """What is left of some signals after projection, as rows."""
        left = np.array(signals, float)
        self._remove_states(left)
        self._remove_local(left)
        rows = left.reshape(len(left), -1)
        return rows - (rows @ self._shared.T) @ self._shared

    def _remove_states(self, left: np.ndarray) -> None:
        for r, bases in enumerate(self._states):
            for basis, (_, samples) in zip(bases, self._windows.of(r), strict=True):
                _remove(left[:, r, samples], basis)

    def _remove_local(self, left: np.ndarray) -> None:
        for r, basis in enumerate(self._local):
            _remove(left[:, r], basis)


def orthogonal_to(
    rows: Float[np.ndarray, "K M"], others: Float[np.ndarray, "D M"]
) -> Float[np.ndarray, "K M"]:
    """Rows without their projection on the span of others."""
    left = np.array(rows, float)
    _remove(left, _basis(others))
    return left


def _basis(rows: np.ndarray) -> np.ndarray:
    """Orthonormal rows (B, M) that span some signals (K, ...)."""
    flat = rows.reshape(len(rows), int(np.prod(rows.shape[1:])))
    size = np.linalg.norm(flat, axis=1)
    if not len(flat) or not size.max(initial=0.0) > 0:
        return np.zeros((0, flat.shape[1]))
    Q, R = np.linalg.qr((flat[size > 0] / size[size > 0, None]).T)
    return Q[:, np.abs(np.diag(R)) > RANK_TOLERANCE].T


def _remove(signals: np.ndarray, basis: np.ndarray) -> None:
    """Remove the projection on a basis from signals (K, ...), in place."""
    flat = signals.reshape(len(signals), -1)
    signals -= ((flat @ basis.T) @ basis).reshape(signals.shape)
