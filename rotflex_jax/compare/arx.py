"""The black box that everybody tries first: a linear difference equation, by least squares."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rotflex_jax.compare.held_in import free_run_cost, one_period, parted
from rotflex_jax.compare.method import Fitted, Progress
from rotflex_jax.errors import InputError
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording


@dataclasses.dataclass(frozen=True)
class Difference:
    """A linear difference equation of all outputs together.

        y[k] = A_1 y[k-1] + ... + A_n y[k-n] + B_1 u[k-1] + ... + B_n u[k-n]

    Attributes:
        A: Of the outputs (C, n, C), oldest sample first.
        B: Of the input (C, n), oldest sample first.
        Ts: Sampling period it holds for [s].
    """

    A: np.ndarray
    B: np.ndarray
    Ts: float

    @property
    def order(self) -> int:
        """How many samples it looks back."""
        return self.B.shape[1]

    def predict(self, recording: Recording) -> np.ndarray:
        """One step ahead (N, C); the first samples, which it needs to begin, as measured."""
        n, y = self.order, recording.y.astype(float)
        lags = lambda x: np.lib.stride_tricks.sliding_window_view(x, n, axis=0)[:-1]  # noqa: E731
        past = np.swapaxes(lags(y), 1, 2).reshape(len(y) - n, -1)
        ahead = past @ self.A.reshape(len(self.B), -1).T + lags(recording.u.astype(float)) @ self.B.T
        return np.concatenate([y[:n], ahead])

    def simulate(self, recording: Recording) -> np.ndarray:
        """Free run (N, C): the first `n_init` samples as measured, from there on its own outputs.

        Raises:
            InputError: It looks back further than `n_init`, or the sampling period is another one.
        """
        n, m, N = self.order, recording.n_init, recording.N
        if n > m:
            raise InputError(
                f"The equation looks back {n} samples, but may look at only {m} of the recording; "
                "give the recording a larger n_init, or choose a lower order."
            )
        if abs(recording.Ts / self.Ts - 1) > 1e-6:
            raise InputError(
                f"The equation holds for a sampling period of {self.Ts:g} s, but the recording has "
                f"{recording.Ts:g} s; fit it to a recording of that period."
            )
        out = np.zeros((N, len(self.B)))
        out[:m] = recording.y[:m]
        lags = np.lib.stride_tricks.sliding_window_view(recording.u.astype(float), n)
        # An unstable equation grows beyond all numbers; whoever scores the run will see it.
        with np.errstate(all="ignore"):
            driven = lags @ self.B.T  # row k - n drives sample k
            A = self.A.reshape(len(self.B), -1)
            for k in range(m, N):
                out[k] = driven[k - n] + A @ out[k - n : k].ravel()
        return out


@dataclasses.dataclass(frozen=True)
class ARX:
    """A linear difference equation, fitted by least squares to the next sample.

    Its order is the one with the best free run over the last part of the training recordings. Not
    for data with coarse sensors or noise at a high sampling rate: least squares takes the noise of
    the regressors for dynamics.

    Source: L. Ljung, System Identification, 2nd ed., 1999, section 4.2.

    Attributes:
        orders: Orders to choose from; those beyond `n_init` are left out.
        share: Share of each training recording that orders are fitted to; the rest decides.
    """

    name: str = "arx"
    title: str = "a linear difference equation, by least squares"
    family: str = "linear"
    orders: tuple[int, ...] = (2, 4, 8, 16, 32, 64)
    share: float = 0.7

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Takes no notice of the model."""
        first, last = parted(train, self.share)
        longest = min(r.n_init for r in (*first, *last))
        orders = [n for n in self.orders if n <= longest]
        if not orders:
            raise InputError(
                f"The lowest order is {min(self.orders)}, but a model may look at only {longest} "
                "samples of the recordings; give them a larger n_init."
            )
        one_period(train, "a difference equation")
        costs = []
        for n in orders:
            costs.append(free_run_cost(least_squares(first, n), last))
            say(f"order {n}: log error {costs[-1]:.2f}")
        found = least_squares(train, orders[int(np.argmin(costs))])
        return Fitted(found, found.A.size + found.B.size, f"order {found.order}", found.predict)


def least_squares(recordings: Sequence[Recording], order: int) -> Difference:
    """The equation of this order that predicts the next sample best.

    Args:
        recordings: All with the same sampling period.
        order: Samples that the equation looks back.
    """
    C = recordings[0].y.shape[1]
    rows, targets = [], []
    for r in recordings:
        y, u = r.y.astype(float), r.u.astype(float)
        lags = lambda x: np.lib.stride_tricks.sliding_window_view(x, order, axis=0)[:-1]  # noqa: E731
        # (N - n, C, n) to (N - n, n C): oldest sample first, channels side by side.
        past = np.swapaxes(lags(y), 1, 2).reshape(len(y) - order, -1)
        rows.append(np.hstack([past, lags(u)]))
        targets.append(y[order:])
    X, Y = np.vstack(rows), np.vstack(targets)
    size = np.maximum(np.sqrt(np.mean(X**2, axis=0)), 1e-300)
    W = (np.linalg.lstsq(X / size, Y, rcond=None)[0] / size[:, None]).T
    A, B = W[:, : order * C].reshape(C, order, C), W[:, order * C :]
    return Difference(A, B, recordings[0].Ts)
