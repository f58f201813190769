"""A sampled linear black-box system: the common form of the identified linear models."""

import dataclasses

import numpy as np
from jaxtyping import Float, Inexact

from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import single
from rotflex_jax.recording.samples import require_period


@dataclasses.dataclass(frozen=True, eq=False)
class LinearSystem:
    """A sampled linear system in innovations form, with an offset.

        x+ = A x + B [u, 1] + K e,    y = C x + D [u, 1] + e

    Attributes:
        A: State matrix.
        B: Columns of the inputs (the input, then the signals) and of the constant.
        C: Output matrix.
        D: Columns of the inputs and of the constant.
        K: Gain of the innovation e.
        Ts: Sampling period for which the system holds [s].
        signals: Names of the signals that are inputs too.
    """

    A: Float[np.ndarray, "n n"]
    B: Float[np.ndarray, "n k"]
    C: Float[np.ndarray, "C n"]
    D: Float[np.ndarray, "C k"]
    K: Float[np.ndarray, "n C"]
    Ts: float
    signals: tuple[str, ...] = ()

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.A)

    @property
    def poles(self) -> Inexact[np.ndarray, " n"]:
        """Eigenvalues of A, in the z domain."""
        return np.linalg.eigvals(self.A)

    def simulate(self, recording: Recording) -> Float[np.ndarray, "N C"]:
        """Free run; the first state is the best fit to the first `n_init` samples.

        Raises:
            InputError: The recording has another sampling period, or lacks a signal.
        """
        recording = single(recording)
        with np.errstate(all="ignore"):  # an unstable system overflows
            return self._run(recording, self.start(recording), np.zeros_like(self.K))

    def predict(self, recording: Recording) -> Float[np.ndarray, "N C"]:
        """One-step-ahead prediction of each sample from all samples before it; raises as `simulate` does."""
        recording = single(recording)
        with np.errstate(all="ignore"):
            return self._run(recording, self.start(recording), self.K)

    def start(self, recording: Recording) -> Float[np.ndarray, " n"]:
        """First state, by least squares on the first `n_init` samples."""
        recording = single(recording)
        require_period(self.Ts, recording.Ts, "The system holds")
        m = recording.n_init
        forced = self._run(recording, np.zeros(self.order), np.zeros_like(self.K), m)
        rows, power = [], np.eye(self.order)
        for _ in range(m):
            rows.append(self.C @ power)
            power = self.A @ power
        # Channels are scaled to one size; `rcond` leaves out state directions that the outputs hardly show.
        size = np.maximum(np.std(recording.y[:m], axis=0), 1e-12 + 1e-3 * np.abs(self.C).max(axis=1))
        O = np.stack(rows) / size[:, None]  # noqa: E741
        y = (recording.y[:m].astype(float) - forced) / size
        O = O.reshape(-1, self.order)  # noqa: E741
        scale = np.maximum(np.linalg.norm(O, axis=0), 1e-300)
        return np.linalg.lstsq(O / scale, y.ravel(), rcond=1e-3)[0] / scale

    def _run(
        self, recording: Recording, x: np.ndarray, K: np.ndarray, samples: int | None = None
    ) -> np.ndarray:
        N = recording.N if samples is None else samples
        y = recording.y.astype(float)
        u = np.column_stack([recording.inputs(self.signals)[:N].astype(float), np.ones(N)])
        forcing, through = u @ self.B.T, u @ self.D.T
        out = np.empty((N, len(self.C)))
        correct = bool(K.any())
        for k in range(N):
            out[k] = self.C @ x + through[k]
            x = self.A @ x + forcing[k]
            if correct:
                x = x + K @ (y[k] - out[k])
        return out
