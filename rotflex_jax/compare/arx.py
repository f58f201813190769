"""ARX: a linear difference equation, by least squares."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.checks import Progress
from rotflex_jax.compare.method import (
    Fitted,
    require_one_sampling_period,
    split_for_validation,
    validation_cost,
)
from rotflex_jax.errors import InputError
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import common_signals
from rotflex_jax.recording.samples import require_period


@dataclasses.dataclass(frozen=True)
class DifferenceEquation:
    """A linear difference equation for all outputs together.

        y[k] = A_1 y[k-1] + ... + A_n y[k-n] + B_1 u[k-1] + ... + B_n u[k-n]

    Attributes:
        A: Coefficients of the outputs, oldest sample first.
        B: Coefficients of the m inputs, oldest sample first: the input, then the signals.
        Ts: Sampling period for which the equation holds [s].
        signals: Names of the signals that are inputs too.
    """

    A: Float[np.ndarray, "C n C"]
    B: Float[np.ndarray, "C n m"]
    Ts: float
    signals: tuple[str, ...] = ()

    @property
    def order(self) -> int:
        """Number of past samples that the equation uses."""
        return self.B.shape[1]

    def predict(self, recording: Recording) -> Float[np.ndarray, "N C"]:
        """One-step-ahead prediction; the first `order` samples are as measured."""
        n, C, y = self.order, len(self.B), recording.y.astype(float)
        ahead = (
            _lags(y, n) @ self.A.reshape(C, -1).T
            + _lags(recording.inputs(self.signals).astype(float), n) @ self.B.reshape(C, -1).T
        )
        return np.concatenate([y[:n], ahead])

    def simulate(self, recording: Recording) -> Float[np.ndarray, "N C"]:
        """Free run: the first `n_init` samples are as measured, the others from simulated outputs.

        Raises:
            InputError: The order exceeds `n_init`, the recording has another sampling period, or it lacks a
                signal.
        """
        n, m, N = self.order, recording.n_init, recording.N
        if n > m:
            raise InputError(
                f"The equation looks back {n} samples, but may look at only {m} of the recording; "
                "give the recording a larger n_init, or choose a lower order."
            )
        require_period(self.Ts, recording.Ts, "The equation holds")
        out = np.zeros((N, len(self.B)))
        out[:m] = recording.y[:m]
        lags = _lags(recording.inputs(self.signals).astype(float), n)
        # An unstable equation overflows; the evaluation of the run reports it.
        with np.errstate(all="ignore"):
            driven = lags @ self.B.reshape(len(self.B), -1).T  # row k - n drives sample k
            A = self.A.reshape(len(self.B), -1)
            for k in range(m, N):
                out[k] = driven[k - n] + A @ out[k - n : k].ravel()
        return out


@dataclasses.dataclass(frozen=True)
class ARX:
    """A linear difference equation, fitted by least squares to the next sample.

    Signals that all recordings have are further inputs.

    The order is chosen by the best free run over the last part of the training recordings. Not for data with
    coarse sensors or noise at a high sampling rate: least squares mistakes the noise of the regressors for
    dynamics.

    Source: L. Ljung, System Identification, 2nd ed., 1999, section 4.2.

    Attributes:
        orders: Orders to choose from; those beyond `n_init` are left out.
        share: Share of each training recording to which the equations are fitted; the rest is for validation.
    """

    name: str = "arx"
    title: str = "a linear difference equation, by least squares"
    family: str = "linear"
    orders: tuple[int, ...] = (2, 4, 8, 16, 32, 64)
    share: float = 0.7

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Choose the order and fit the equation; `model` is ignored."""
        first, last = split_for_validation(train, self.share)
        longest = min(r.n_init for r in (*first, *last))
        orders = [n for n in self.orders if n <= longest]
        if not orders:
            raise InputError(
                f"The lowest order is {min(self.orders)}, but a model may use only {longest} "
                "samples of the recordings; give them a larger n_init."
            )
        require_one_sampling_period(train, "a difference equation")
        costs = []
        for n in orders:
            costs.append(validation_cost(fit_difference_equation(first, n), last))
            say(f"order {n}: log error {costs[-1]:.2f}")
        found = fit_difference_equation(train, orders[int(np.argmin(costs))])
        return Fitted(found, found.A.size + found.B.size, f"order {found.order}", found.predict)


def fit_difference_equation(recordings: Sequence[Recording], order: int) -> DifferenceEquation:
    """The equation of this order with the best prediction of the next sample.

    Args:
        recordings: Recordings with the same sampling period.
        order: Number of past samples that the equation uses.
    """
    C = recordings[0].y.shape[1]
    signals = common_signals(recordings)
    rows, targets = [], []
    for r in recordings:
        y = r.y.astype(float)
        rows.append(np.hstack([_lags(y, order), _lags(r.inputs(signals).astype(float), order)]))
        targets.append(y[order:])
    X, Y = np.vstack(rows), np.vstack(targets)
    size = np.maximum(np.sqrt(np.mean(X**2, axis=0)), 1e-300)
    W = (np.linalg.lstsq(X / size, Y, rcond=None)[0] / size[:, None]).T
    A, B = W[:, : order * C].reshape(C, order, C), W[:, order * C :].reshape(C, order, -1)
    return DifferenceEquation(A, B, recordings[0].Ts, signals)


def _lags(x: Float[np.ndarray, "N c"], n: int) -> Float[np.ndarray, "M K"]:
    """The n samples before each sample from the n-th on: oldest sample first, columns side by side."""
    windows = np.lib.stride_tricks.sliding_window_view(x, n, axis=0)[:-1]
    return np.swapaxes(windows, 1, 2).reshape(len(x) - n, -1)
