"""Input voltages of about 1 V rms, each from its textbook definition and a random generator.

Every function takes the number of samples, the sampling rate [Hz] and a generator, and returns
volts rounded to 1 uV, so that a text file carries exactly what the plant was given.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

Signal = Float[np.ndarray, " N"]


def noise(N: int, fs: float, rng: np.random.Generator, cutoff: float = 5.0) -> Signal:
    """Filtered noise ``u_k = a u_{k-1} + sqrt(1 - a^2) w_k`` with ``a = exp(-2 pi fc / fs)``."""
    a = np.exp(-2 * np.pi * cutoff / fs)
    w = rng.standard_normal(N)
    u = np.empty(N)
    u[0] = w[0]
    for k in range(1, N):
        u[k] = a * u[k - 1] + np.sqrt(1 - a * a) * w[k]
    return u


def multisine(N: int, fs: float, rng: np.random.Generator, band: tuple[float, float] = (0.1, 12.0)) -> Signal:
    """Every harmonic of the record in `band` [Hz], equal amplitudes, random phases."""
    harmonics = np.arange(np.ceil(band[0] * N / fs), np.floor(band[1] * N / fs) + 1)
    spectrum = np.zeros(N // 2 + 1, dtype=complex)
    spectrum[harmonics.astype(int)] = np.exp(2j * np.pi * rng.random(harmonics.size))
    return np.fft.irfft(spectrum, N) * N / np.sqrt(2 * harmonics.size)


def prbs(N: int, fs: float, rng: np.random.Generator, hold: float = 0.05) -> Signal:
    """Two levels, +1 and -1 V, from an 11-bit shift register clocked every `hold` seconds."""
    register = int(rng.integers(1, 2**11))
    bits = []
    samples = max(1, round(hold * fs))
    for _ in range(-(-N // samples)):
        bits.append(register & 1)
        # x^11 + x^9 + 1 is primitive: the sequence has the full length of 2047.
        feedback = (register ^ (register >> 2)) & 1
        register = (register >> 1) | (feedback << 10)
    return np.repeat(2.0 * np.array(bits) - 1.0, samples)[:N]


def steps(N: int, fs: float, rng: np.random.Generator, dwell: tuple[float, float] = (0.15, 0.8)) -> Signal:
    """Random levels, uniform with unit variance, each held for a random time [s]."""
    u = np.empty(N)
    k = 0
    while k < N:
        end = k + max(1, round(rng.uniform(*dwell) * fs))
        u[k:end] = rng.uniform(-np.sqrt(3), np.sqrt(3))
        k = end
    return u


def sweep(
    N: int,
    fs: float,
    rng: np.random.Generator,
    band: tuple[float, float] = (0.1, 12.0),
    period: float = 5.0,
) -> Signal:
    """Sine of amplitude sqrt(2) V; its frequency rises and falls exponentially within `band` every `period`.

    The sweep repeats, so that the last part of a record also contains every frequency.
    """
    t = np.arange(N) / fs
    ramp = 1 - np.abs(1 - 2 * ((t / period + rng.random()) % 1))
    frequency = band[0] * (band[1] / band[0]) ** ramp
    return np.sqrt(2) * np.sin(2 * np.pi * (np.cumsum(frequency) / fs + rng.random()))


INPUTS: dict[str, Callable[[int, float, np.random.Generator], Signal]] = {
    "noise": noise,
    "multisine": multisine,
    "prbs": prbs,
    "steps": steps,
    "sweep": sweep,
}


def voltage(kind: str, N: int, fs: float, rng: np.random.Generator, rms: float = 1.0) -> Signal:
    """Input of the given kind.

    Args:
        kind: a key of `INPUTS`.
        N: number of samples.
        fs: sampling rate [Hz].
        rng: random generator.
        rms: expected root mean square [V].

    Returns:
        Voltage [V], ``(N,)``, in whole microvolts.

    Raises:
        ValueError: if the kind is unknown.
    """
    if kind not in INPUTS:
        raise ValueError(f"The arena has no input {kind!r}; it has {', '.join(INPUTS)}.")
    return np.round(rms * INPUTS[kind](N, fs, rng), 6)
