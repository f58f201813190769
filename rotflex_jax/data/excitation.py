"""Input signals: noise, multisine, pseudo-random binary, steps, sweep, pulse.

Filtered noise is the best single choice if nothing is known about the machine. Steps show effects of the
position, a sweep or a multisine shows play, and a binary signal shows delays and further modes. A signal with
two levels never shows a dead zone or a saturation.

Every input is an array of N voltages [V] at the sampling period Ts [s]. It is the same for the same seed,
which is an integer or a NumPy generator. An argument out of range raises `InputError`.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.checks import (
    LARGEST,
    LARGEST_COUNT,
    SMALLEST,
    number,
    positive,
    real,
    seed as checked_seed,
    shown,
    whole,
)
from rotflex_jax.errors import InputError

Voltage = Float[np.ndarray, " N"]
Seed = int | np.random.Generator


def noise(N: int, Ts: float, *, rms: float = 1.0, bandwidth: float = 5.0, seed: Seed = 0) -> Voltage:
    """Gaussian noise through a first-order filter, stationary from the first sample.

    u[k] = a u[k-1] + sqrt(1 - a^2) w[k],  a = exp(-2 pi bandwidth Ts),  w ~ N(0, rms^2)

    Args:
        N: number of samples.
        Ts: sampling period [s].
        rms: root mean square of the process [V].
        bandwidth: corner frequency [Hz].
        seed: seed of the random numbers.

    >>> noise(3, 0.002, seed=1)
    array([0.34558419, 0.60687965, 0.68347299])
    """
    from scipy.signal import lfilter  # takes long to import

    N, Ts = _checked_grid(N, Ts)
    _check_positive(rms=rms, bandwidth=bandwidth)
    a = np.exp(-2 * np.pi * bandwidth * Ts)
    w = rms * np.random.default_rng(checked_seed(seed)).standard_normal(N)
    w[1:] *= np.sqrt(1 - a**2)
    return np.asarray(lfilter([1.0], [1.0, -a], w))


def multisine(
    N: int,
    Ts: float,
    *,
    band: tuple[float, float] = (0.1, 12.0),
    rms: float = 1.0,
    periods: int = 1,
    optimise_crest: bool = True,
    seed: Seed = 0,
) -> Voltage:
    """A periodic sum of sines of equal amplitude: every harmonic of the period within the band.

    u[k] = A sum_h cos(2 pi h k / P + phase_h),  P = N / periods,  A = rms sqrt(2 / harmonics)

    The phases are random at first. To lower the peak, the signal is repeatedly clipped and the phases of the
    clipped signal are taken, so that the same power fits within the range of the amplifier.

    Args:
        N: number of samples, a multiple of `periods`.
        Ts: sampling period [s].
        band: lowest and highest frequency [Hz].
        rms: root mean square over a period, exactly [V].
        periods: number of periods.
        optimise_crest: whether to lower the peak; otherwise the phases stay random.
        seed: seed of the phases.

    Source:
        van der Ouderaa, Schoukens, Renneboog 1988, time-frequency domain swapping.

    >>> u = multisine(1000, 0.01, band=(1.0, 5.0))
    >>> round(float(np.sqrt(np.mean(u**2))), 12)
    1.0
    """
    N, Ts = _checked_grid(N, Ts)
    _check_positive(rms=rms)
    _check_band(band, Ts)
    if N % whole(periods, "periods", 1):
        raise InputError(
            f"Argument `N` must be a multiple of `periods`, but is {N} for {periods} periods; change one "
            "of them."
        )
    P = int(N // periods)
    harmonics = np.arange(np.ceil(band[0] * P * Ts - 1e-9), np.floor(band[1] * P * Ts + 1e-9) + 1)
    harmonics = harmonics[(harmonics > 0) & (harmonics < P / 2)].astype(int)
    if not len(harmonics):
        raise InputError(
            f"Argument `band` must hold a multiple of {1 / (P * Ts):g} Hz, one over the period, "
            f"but is {band[0]:g} to {band[1]:g} Hz; widen it or lengthen the period."
        )
    amplitude = rms * np.sqrt(2 / len(harmonics))
    phases = np.random.default_rng(checked_seed(seed)).uniform(0, 2 * np.pi, len(harmonics))

    def signal(phases: Float[np.ndarray, " H"]) -> Float[np.ndarray, " P"]:
        spectrum = np.zeros(P // 2 + 1, dtype=complex)
        spectrum[harmonics] = 0.5 * P * amplitude * np.exp(1j * phases)
        return np.fft.irfft(spectrum, P)

    best = u = signal(phases)
    for _ in range(300 if optimise_crest else 0):
        limit = 0.85 * np.max(np.abs(u))
        u = signal(np.angle(np.fft.rfft(np.clip(u, -limit, limit))[harmonics]))
        best = min(best, u, key=lambda signal: np.max(np.abs(signal)))
    return np.tile(best, int(periods))


def prbs(N: int, Ts: float, *, amplitude: float = 1.0, hold: float = 0.05, seed: Seed = 0) -> Voltage:
    """A maximum-length pseudo-random binary sequence: two levels, each bit held for a fixed time.

    The sequence is long enough not to repeat. Not for a dead zone or a saturation: two levels do not show
    them.

    Args:
        N: number of samples.
        Ts: sampling period [s].
        amplitude: the levels are plus and minus this [V].
        hold: duration of one bit [s], rounded to whole samples.
        seed: seed of the bit at which the sequence starts.

    >>> prbs(6, 0.01, amplitude=2.0, hold=0.02)
    array([-2., -2.,  2.,  2.,  2.,  2.])
    """
    from scipy.signal import max_len_seq  # takes long to import

    N, Ts = _checked_grid(N, Ts)
    _check_positive(amplitude=amplitude, hold=hold)
    samples = max(1, round(min(hold / Ts, N)))
    order = max(6, int(np.ceil(np.log2(-(-N // samples) + 1))))
    bits, _ = max_len_seq(order)
    bits = np.roll(bits, np.random.default_rng(checked_seed(seed)).integers(len(bits)))
    return amplitude * (2.0 * np.repeat(bits, samples)[:N] - 1.0)


def steps(
    N: int,
    Ts: float,
    *,
    amplitude: float = 1.0,
    hold: tuple[float, float] = (0.15, 0.8),
    seed: Seed = 0,
) -> Voltage:
    """Random levels, each held for a random time, both uniformly distributed.

    Not for play in the gear or a sensor bias, which steps do not show.

    Args:
        N: number of samples.
        Ts: sampling period [s].
        amplitude: the levels lie within plus and minus this [V].
        hold: shortest and longest duration of a level [s].
        seed: seed of the random numbers.

    >>> np.unique(steps(50, 0.01, hold=(0.1, 0.1))).size
    5
    """
    N, Ts = _checked_grid(N, Ts)
    times = tuple(hold) if isinstance(hold, Sequence) and not isinstance(hold, str) and hold else (hold,)
    shortest, longest = sorted(positive(time, "hold", "s", "(0.15, 0.8)") for time in (times * 2)[:2])
    _check_positive(amplitude=amplitude)
    rng = np.random.default_rng(checked_seed(seed))
    most = -(-N // max(1, round(min(shortest / Ts, N))))
    times = np.maximum(1, np.round(rng.uniform(shortest, longest, most) / Ts)).astype(int)
    return np.repeat(rng.uniform(-amplitude, amplitude, most), times)[:N]


def sweep(N: int, Ts: float, *, band: tuple[float, float] = (0.1, 12.0), amplitude: float = 1.0) -> Voltage:
    """A sine whose frequency rises exponentially, with the same time for every octave.

    u(t) = A sin(2 pi f0 T (r^(t / T) - 1) / ln(r)),  r = f1 / f0,  T = N Ts

    Args:
        N: number of samples.
        Ts: sampling period [s].
        band: first and last frequency [Hz].
        amplitude: amplitude of the sine [V].

    >>> round(float(np.max(sweep(1000, 0.01, amplitude=3.0))), 2)
    3.0
    """
    N, Ts = _checked_grid(N, Ts)
    _check_positive(amplitude=amplitude)
    _check_band(band, Ts)
    _check_positive(band=band[0])
    rise = np.log(band[1] / band[0])
    cycles = band[0] * N * Ts / rise * np.expm1(rise * np.arange(N) / N)
    return amplitude * np.sin(2 * np.pi * cycles)


def pulse(N: int, Ts: float, *, amplitude: float = 1.0, width: float = 0.5, delay: float = 0.1) -> Voltage:
    """One rectangular pulse, with zero before and after it: the free motion afterwards shows friction.

    Args:
        N: number of samples.
        Ts: sampling period [s].
        amplitude: height, of either sign [V].
        width: duration of the pulse [s].
        delay: start of the pulse [s].

    >>> pulse(5, 0.1, amplitude=3.0, width=0.2, delay=0.1)
    array([0., 3., 3., 0., 0.])
    """
    N, Ts = _checked_grid(N, Ts)
    _check_positive(width=width)
    number(amplitude, "amplitude", unit="V", example="3.0")
    number(delay, "delay", least=0, unit="s", example="0.1")
    start, stop = round(delay / Ts), round((delay + width) / Ts)
    if not 0 <= start < stop <= N:
        raise InputError(
            f"The pulse must lie within the {N * Ts:g} s of the signal, but lasts from {delay:g} "
            f"to {delay + width:g} s; change `delay`, `width` or `N`."
        )
    u = np.zeros(N)
    u[start:stop] = amplitude
    return u


INPUTS: dict[str, Callable[..., Voltage]] = {
    kind.__name__: kind for kind in (noise, multisine, prbs, steps, sweep, pulse)
}
"""Name -> function of each kind of input."""


def _checked_grid(N: int, Ts: float) -> tuple[int, float]:
    """Number of samples, which may be given as a float such as 2 / 0.002, and sampling period."""
    count, period = real(N), real(Ts)
    if not (1 <= count <= LARGEST_COUNT and count == int(count) and SMALLEST <= period <= LARGEST):
        raise InputError(
            "Arguments `N` and `Ts` must be a number of samples and a sampling period in seconds, "
            f"but are {shown(N)} and {shown(Ts)}; give for instance 5000 and 0.002."
        )
    return int(count), period


def _check_positive(**values: float) -> None:
    for name, value in values.items():
        positive(value, name, "", "1.0")


def _check_band(band: tuple[float, float], Ts: float) -> None:
    ends = [real(end) for end in band] if isinstance(band, Sequence) and not isinstance(band, str) else []
    if len(ends) != 2 or not 0 <= ends[0] < ends[1] <= 0.5 / Ts:
        given = f"{shown(band[0])} to {shown(band[1])} Hz" if len(ends) == 2 else shown(band)
        raise InputError(
            f"Argument `band` must rise within 0 and {0.5 / Ts:g} Hz, half the sampling rate, but "
            f"is {given}; correct it."
        )
