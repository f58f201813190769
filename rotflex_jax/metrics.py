"""Errors of a model for each channel, without the first samples, which the model may use.

Every metric takes either a recording and the output of a model, and returns one number for each channel name;
or two arrays, with time as the first axis, and returns one number for each column.

>>> import numpy as np
>>> y = np.array([[0.0, 0.0], [1.0, 2.0], [2.0, 4.0]])
>>> rmse(y, y + [0.5, 0.0])
array([0.5, 0. ])
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Int, Real

from rotflex_jax.checks import positive, shown, whole
from rotflex_jax.errors import InputError


@runtime_checkable
class Measured(Protocol):
    """The part of a recording that a metric needs."""

    @property
    def y(self) -> Real[np.ndarray, "N C"]: ...  # noqa: D102
    @property
    def channels(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def n_init(self) -> int: ...  # noqa: D102


@runtime_checkable
class Sampled(Protocol):
    """The part of a recording on which the layout of windows depends."""

    @property
    def N(self) -> int: ...  # noqa: D102
    @property
    def Ts(self) -> float: ...  # noqa: D102
    @property
    def n_init(self) -> int: ...  # noqa: D102


Outputs = Real[Any, "N *C"] | Sequence[Any]
"""An array of NumPy or JAX with time as the first axis, or a list."""


def _score(
    formula: Callable[[np.ndarray, np.ndarray], Any],
    y: Measured | Outputs,
    y_hat: Outputs,
    n_init: int | None,
) -> Any:
    """Applies `formula(y, e)`, with `e = y - y_hat`, to the samples from `n_init` on."""
    channels = getattr(y, "channels", None)
    measured = np.asarray(y if channels is None else getattr(y, "y"))  # noqa: B009
    modelled = np.asarray(y_hat)
    start = getattr(y, "n_init", 0) if n_init is None else whole(n_init, "n_init", 0)
    if not (measured.ndim and all(a.dtype.kind in "iufc" for a in (measured, modelled))):
        raise InputError(
            "The measured and the modelled output must be arrays of numbers, time first, but are "
            f"{shown(y)} and {shown(y_hat)}; give what was recorded and simulated."
        )
    if np.ma.is_masked(y) or np.ma.is_masked(y_hat):
        raise InputError(
            "The measured or the modelled output has masked samples, but all are scored; cut them from both."
        )
    if measured.shape != modelled.shape:
        raise InputError(
            f"The measured and the modelled output must have the same shape, but have "
            f"{measured.shape} and {modelled.shape}; simulate the recording they are compared on."
        )
    if not 0 <= start < len(measured):
        raise InputError(
            f"Argument `n_init` must leave samples to score, but is {start} of {len(measured)} "
            "samples; give a smaller one."
        )
    # Differences and squares of counts or of half precision may overflow in their own type.
    least = lambda a: float if a.dtype.kind in "iu" else np.float32  # noqa: E731
    measured, modelled = (a[start:].astype(np.result_type(a, least(a))) for a in (measured, modelled))
    values = formula(measured, measured - modelled)
    if channels is None:
        return values
    return {name: float(value) for name, value in zip(channels, values, strict=True)}


def _ratio(part: Any, whole: Any) -> Any:
    """The quotient; NaN if the denominator is zero: a channel at rest has no fit."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(whole > 0, part / whole, np.nan)[()]


def _rms(y: np.ndarray, e: np.ndarray) -> Any:
    return np.sqrt(np.mean(np.abs(e) ** 2, axis=0))


def _relative(y: np.ndarray, e: np.ndarray) -> Any:
    return _ratio(_rms(y, e), np.std(y, axis=0))


def rmse(y: Measured | Outputs, y_hat: Outputs, n_init: int | None = None) -> Any:
    """Root mean square error.

    rmse = sqrt(mean(e^2)),  e = y - y_hat

    Args:
        y: Recording, or measured output (N,) or (N, C) [unit of the channel].
        y_hat: modelled output, same shape.
        n_init: number of samples at the start that are not scored; by default `n_init` of the recording, or 0
            for arrays.

    Returns:
        Channel name -> value for a recording, else one value for each column [unit of the channel].

    Raises:
        InputError: the shapes differ, or no sample is left to score.

    >>> float(rmse([1.0, 2.0, 3.0], [1.0, 2.0, 5.0], n_init=1))
    1.4142135623730951
    """
    return _score(_rms, y, y_hat, n_init)


def nrmse(y: Measured | Outputs, y_hat: Outputs, n_init: int | None = None) -> Any:
    """Root mean square error relative to the standard deviation of the measurement [-].

    nrmse = norm(e) / norm(y - mean(y))

    0 is perfect, 1 is as good as the mean. Not for a channel at rest, where it is NaN.
    Args, Returns, Raises as `rmse`.

    >>> float(nrmse([0.0, 1.0, 2.0], [1.0, 1.0, 1.0]))
    1.0
    """
    return _score(_relative, y, y_hat, n_init)


def fit_percent(y: Measured | Outputs, y_hat: Outputs, n_init: int | None = None) -> Any:
    """Share of the measurement that the model explains [%].

    fit = 100 (1 - norm(e) / norm(y - mean(y)))

    Negative for a model worse than the mean. Not for a channel at rest, where it is NaN.
    Args, Returns, Raises as `rmse`.

    >>> float(fit_percent([0.0, 1.0, 2.0], [0.0, 1.0, 2.0]))
    100.0
    """
    return _score(lambda y, e: 100.0 * (1.0 - _relative(y, e)), y, y_hat, n_init)


def vaf(y: Measured | Outputs, y_hat: Outputs, n_init: int | None = None) -> Any:
    """Variance accounted for [%].

    vaf = 100 (1 - var(e) / var(y))

    Not for cases in which an offset matters: it ignores an offset, `fit_percent` does not.
    Args, Returns, Raises as `rmse`.

    >>> float(vaf([0.0, 1.0, 2.0], [5.0, 6.0, 7.0]))
    100.0
    """

    def formula(y: Outputs, e: Outputs) -> Any:
        return 100.0 * (1.0 - _ratio(np.var(e, axis=0), np.var(y, axis=0)))

    return _score(formula, y, y_hat, n_init)


def mae(y: Measured | Outputs, y_hat: Outputs, n_init: int | None = None) -> Any:
    """Mean absolute error [unit of the channel].

    mae = mean(abs(e))

    Args, Returns, Raises as `rmse`.

    >>> float(mae([0.0, 0.0], [1.0, -3.0]))
    2.0
    """
    return _score(lambda y, e: np.mean(np.abs(e), axis=0), y, y_hat, n_init)


def max_error(y: Measured | Outputs, y_hat: Outputs, n_init: int | None = None) -> Any:
    """Largest absolute error [unit of the channel].

    max_error = max(abs(e))

    Args, Returns, Raises as `rmse`.

    >>> float(max_error([0.0, 0.0], [1.0, -3.0]))
    3.0
    """
    return _score(lambda y, e: np.max(np.abs(e), axis=0), y, y_hat, n_init)


def window_starts(recording: Sampled, seconds: float) -> tuple[Int[np.ndarray, " W"], int]:
    """First samples of the windows of a recording, and the length of the longest window [samples].

    Args:
        recording: Recording that is divided.
        seconds: Length of a window [s], at least twice `n_init`; a remainder of up to twice `n_init` belongs
            to the last window.
    """
    N, m, seconds = recording.N, recording.n_init, positive(seconds, "seconds")
    width = min(N, max(round(min(seconds / recording.Ts, N)), 2 * m))
    starts = np.arange(0, max(N - 2 * m, 1), width)
    return starts, max(width, N - int(starts[-1]))


def counted(recording: Sampled, seconds: float) -> Bool[np.ndarray, " N"]:
    """Which samples count in an error over windows: all but the first `n_init` of each window."""
    starts, _ = window_starts(recording, seconds)
    counts = np.ones(recording.N, bool)
    counts[(starts[:, None] + np.arange(recording.n_init)).ravel()] = False
    return counts


def windowed_rmse(
    recordings: Sequence[Sampled],
    measured: Sequence[Real[np.ndarray, "_ C"]],
    simulated: Sequence[Real[np.ndarray, "_ C"]],
    seconds: float,
) -> Real[np.ndarray, " C"]:
    """Root mean square error of free runs over windows, over all recordings together.

    The runs are those of `simulate_windows` of a model: each window starts at its own positions and speeds,
    but with the voltage before it.

    Args:
        recordings: Recordings, which determine the windows.
        measured: Outputs of the recordings, in the order of the model [unit of the channel].
        simulated: Simulated outputs, of the same shapes.
        seconds: Length of the windows [s].

    Returns:
        One value for each column [unit of the channel].
    """
    total, count = 0.0, 0
    for recording, y, y_hat in zip(recordings, measured, simulated, strict=True):
        e = (np.asarray(y, float) - np.asarray(y_hat, float))[counted(recording, seconds)]
        total, count = total + np.sum(e**2, axis=0), count + len(e)
    return np.sqrt(total / max(count, 1))
