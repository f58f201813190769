"""The input of the experiment: white Gaussian noise through a linear filter, of exact variance."""

import numpy as np

from rotflex_jax.data.excitation import noise
from rotflex_jax.reproduce.settings import Settings

ORDER = 4
"""Of the Butterworth filter."""


def filtered_noise(s: Settings, N: int, seed: int | np.random.Generator) -> np.ndarray:
    """The voltage (N,) [V], stationary from its first sample.

        u = sigma F(q) w / norm2(F),   w ~ N(0, 1)

    The variance is that of the process, by the L2 norm of the filter's impulse response. Scaling by the
    sample's own deviation would make the input depend on its future.

    Args:
        s: Settings `filter`, `cutoff`, `variance`, `Ts`.
        N: Samples.
        seed: Of the random numbers.

    >>> u = filtered_noise(Settings(filter="fir"), 40000, 0)
    >>> round(float(np.var(u)), 1)
    1.0
    """
    rms = float(np.sqrt(s.variance))
    if s.filter == "ar1":
        return noise(N, s.Ts, rms=rms, bandwidth=s.cutoff, seed=seed)
    h = impulse_response(s)
    w = np.random.default_rng(seed).standard_normal(N + len(h) - 1)
    return rms * np.convolve(w, h / np.linalg.norm(h), mode="valid")


def impulse_response(s: Settings) -> np.ndarray:
    """Of the filter, until it has died out."""
    from scipy import signal  # takes long to import

    if s.filter == "ar1":
        a = np.exp(-2 * np.pi * s.cutoff * s.Ts)
        return np.sqrt(1 - a**2) * a ** np.arange(_length(a))
    if s.filter == "butterworth":
        sections = np.asarray(signal.butter(ORDER, s.cutoff, fs=1 / s.Ts, output="sos"))
        radius = max(float(np.max(np.abs(np.roots(section[3:])))) for section in sections)
        return np.asarray(signal.sosfilt(sections, np.eye(1, _length(radius))[0]))
    # Long enough that the window, and not the cut, shapes the band.
    taps = 2 * max(1, round(1.0 / (s.cutoff * s.Ts))) + 1
    return np.asarray(signal.firwin(taps, min(s.cutoff, 0.499 / s.Ts), fs=1 / s.Ts))


def autocovariance(s: Settings, lags: int) -> np.ndarray:
    """Of the input at the lags 0, 1, ... [V²], from the filter alone.

    >>> autocovariance(Settings(), 2).round(4)
    array([1.    , 0.0432])
    """
    h = impulse_response(s)
    h = np.pad(h / np.linalg.norm(h), (0, lags))
    return s.variance * np.array([h[: len(h) - k] @ h[k:] for k in range(lags)])


def pulse(s: Settings, height: float) -> np.ndarray:
    """The rectangular pulse with the rest before and after it [V]."""
    before, width, after = (round(t / s.Ts) for t in (s.pulse_delay, s.pulse_width, s.pulse_after))
    return np.concatenate([np.zeros(before), np.full(width, height), np.zeros(after)])


def _length(radius: float) -> int:
    """Samples after which a pole has fallen to 1e-12."""
    return int(np.ceil(np.log(1e-12) / np.log(max(radius, 1e-9)))) + 2
