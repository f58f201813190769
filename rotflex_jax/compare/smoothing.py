"""Speeds and accelerations by smoothed differentiation, and the input as the same smoothing would show it."""

import numpy as np
import scipy
from jaxtyping import Float

from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording

Smoothing = tuple[str, float]
"""`savgol` with a window in samples, or `spline` with the cutoff of its smoothing in samples."""


def smooth(recording: Recording, smoothing: Smoothing) -> Float[np.ndarray, "N 3C"]:
    """Outputs, speeds and accelerations after smoothing, one block of columns after the other.

    Raises:
        InputError: A kind of smoothing that does not exist.
    """
    y, (kind, width) = recording.y.astype(float), smoothing
    if kind == "savgol":
        window = _window(width, recording.N)
        parts = [
            np.asarray(
                scipy.signal.savgol_filter(y, window, min(3, window - 1), deriv=d, delta=recording.Ts, axis=0)
            )
            for d in range(3)
        ]
        return np.concatenate(parts, axis=1)
    if kind != "spline":
        raise InputError(f"A smoothing is 'savgol' or 'spline', but {kind!r} was given; name one of these.")
    splines = [_spline(c, width) for c in y.T]
    t = np.arange(recording.N, dtype=float)
    return np.concatenate(
        [
            np.stack([s.derivative(d)(t) / recording.Ts**d if d else s(t) for s in splines], axis=1)
            for d in range(3)
        ],
        axis=1,
    )


def smoothed_input(
    recording: Recording, smoothing: Smoothing, order: int, held: bool = True
) -> Float[np.ndarray, " N"]:
    """The input as it appears in smoothed derivatives of that order.

    A filter that differentiates is a smoothing of the true derivative, by its own kernel integrated as
    many times. An acceleration so smoothed answers to an input smoothed alike: against the bare input a
    regression is blurred, the more the faster the input changes.
    """
    u = recording.u.astype(float)
    # A second difference lies between the input held before it and the one held after it, a first one on
    # the input that follows.
    between = u if not held else (u + np.concatenate([u[:1], u[:-1]])) / 2
    after = u if held else (u + np.concatenate([u[1:], u[-1:]])) / 2
    kind, width = smoothing
    if kind == "spline":
        return _spline(between, width)(np.arange(len(u), dtype=float))
    window = _window(width, len(u))
    once = -np.cumsum(scipy.signal.savgol_coeffs(window, min(3, window - 1), deriv=order, use="dot"))
    # Summed by parts: of first differences once, of second ones twice and a sample later.
    kernel, x = (once, after) if order == 1 else (np.concatenate([[0.0], -np.cumsum(once)[:-1]]), between)
    return np.correlate(np.pad(x, window // 2, mode="edge"), kernel, mode="valid")


def _window(width: float, N: int) -> int:
    return min(int(width) // 2 * 2 + 1, (N - 1) // 2 * 2 + 1)


def _spline(x: np.ndarray, width: float) -> "scipy.interpolate.BSpline":
    """The smoother of a random walk of the acceleration's integral: its cutoff is the width."""
    t = np.arange(len(x), dtype=float)
    return scipy.interpolate.make_smoothing_spline(t, x, lam=(width / (2 * np.pi)) ** 4)
