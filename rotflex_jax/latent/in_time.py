"""Behaviour of a latent torque over time: spectral lines of a periodic disturbance, and a slow drift."""

import math
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

from rotflex_jax.parameters import HALF_WIDTH_95

# Probability of a false line, and of a false drift, in one torque.
FALSE_ALARM = 1e-3
# Least number of periods of a line in its recording; anything slower counts as drift.
LEAST_PERIODS = 8
# Share of the Nyquist frequency up to which lines are sought: above it, the level lacks neighbours on one
# side.
BELOW_NYQUIST = 0.9
# Number of neighbours on either side of a frequency from which the level of the spectrum is estimated.
NEIGHBOURS = 40
# Degree of the polynomial that follows the spectrum of a torque, in logarithms of both.
SMOOTH_DEGREE = 6
# Number of blocks of a recording whose means are tested for a drift.
DRIFT_BLOCKS = 12
# An input counts as periodic if its autocorrelation at some lag exceeds this.
REPEATS = 0.8
# Largest number of lines that are sought in one torque.
MOST_LINES = 5


class PeriodicTorque(NamedTuple):
    """A sine in a torque that is not caused by the input.

    Attributes:
        frequency: Frequency [Hz].
        amplitude: Amplitude [unit of the torque].
        interval: 95 % interval of the amplitude.
        p_value: Probability of such a line in a torque without lines.
    """

    frequency: float
    amplitude: float
    interval: tuple[float, float]
    p_value: float


class Drift(NamedTuple):
    """A torque that rises or falls over its recording.

    Attributes:
        slope: Slope [unit of the torque per second].
        interval: 95 % interval of the slope.
        change: Change over the whole recording [unit of the torque].
        p_value: Probability of such a slope without drift.
    """

    slope: float
    interval: tuple[float, float]
    change: float
    p_value: float


def periodic_torques(
    torque: Float[np.ndarray, " N"], u: Float[np.ndarray, " N"], Ts: float
) -> tuple[PeriodicTorque, ...]:
    """Lines in the spectrum of a torque at frequencies at which the input has none.

        p = 1 - (1 - (1 + P / (n B))^-n)^M

    `P` is the ordinate of the tapered periodogram with the largest ratio to the mean level `B` around it. The
    level is estimated from `n` neighbours, and `M` is the number of frequencies. This is Fisher's test for a
    hidden period, with a level that may change with the frequency, as in the spectrum of a latent torque. A
    line that is found is removed, and the test is repeated. Torques that depend on the motion are periodic if
    the input is. So lines of the input are left out, and for a periodic input all multiples of its frequency.

    Do not use it for a machine under feedback, whose input responds to a disturbance, or for a machine that
    turns at constant speed, where a torque that depends on the position has lines too.

    Args:
        torque: Torque [N m].
        u: Input.
        Ts: Sampling period [s].

    Returns:
        The lines, largest first, with amplitudes by harmonic regression.

    Source: R. A. Fisher, Proc. R. Soc. A 125, 1929; M. B. Priestley, Spectral Analysis and Time Series,
    1981, section 6.1.4.
    """
    N = len(torque)
    f = np.fft.rfftfreq(N, Ts)
    usable = _usable(np.asarray(u, float), f, Ts)
    M = int(usable.sum())
    if M < 2 * NEIGHBOURS:
        return ()
    t, found = Ts * np.arange(N), []
    left = _without_trend(np.asarray(torque, float))
    for _ in range(MOST_LINES):
        power = _periodogram(left)
        level = _level(power)
        ratio = np.where(usable, power / level, 0.0)
        k = int(np.argmax(ratio))
        # The level is an estimate too, with about as many ordinates as there are neighbours on one side.
        tail = (1 + float(ratio[k]) / NEIGHBOURS) ** -NEIGHBOURS
        p = -math.expm1(M * math.log1p(-tail)) if tail < 1 else 1.0
        if p > FALSE_ALARM:
            break
        frequency, sine = _harmonic(left, t, float(f[k]), float(f[1]))
        amplitude = float(np.hypot(*np.linalg.lstsq(_waves(t, frequency), left, rcond=None)[0]))
        std = math.sqrt(2 * float(level[k]) / N)
        interval = (max(amplitude - HALF_WIDTH_95 * std, 0.0), amplitude + HALF_WIDTH_95 * std)
        found.append(PeriodicTorque(frequency, amplitude, interval, p))
        left = left - sine
        usable &= np.abs(f - frequency) > 2.5 * f[1]  # the rest of a removed line is no further line
    return tuple(sorted(found, key=lambda line: -line.amplitude))


def drift(torque: Float[np.ndarray, " N"], Ts: float) -> Drift | None:
    """The slope of a torque over its recording, by a regression of means over blocks; None without a drift.

    Args:
        torque: Torque [N m].
        Ts: Sampling period [s].
    """
    N = len(torque) - len(torque) % DRIFT_BLOCKS
    if N < 4 * DRIFT_BLOCKS:
        return None
    means = np.asarray(torque[:N], float).reshape(DRIFT_BLOCKS, -1).mean(axis=1)
    at = Ts * N / DRIFT_BLOCKS * np.arange(DRIFT_BLOCKS)
    fit = scipy.stats.linregress(at, means)
    p, slope, std = float(fit.pvalue), float(fit.slope), float(fit.stderr)
    if not p < FALSE_ALARM:
        return None
    reach = float(scipy.stats.t.ppf(0.975, DRIFT_BLOCKS - 2)) * std
    return Drift(slope, (slope - reach, slope + reach), slope * Ts * len(torque), p)


def _usable(u: Float[np.ndarray, " N"], f: Float[np.ndarray, " F"], Ts: float) -> Bool[np.ndarray, " F"]:
    """Frequencies at which a line is not caused by the input, which has no line or harmonic there."""
    usable = (f * len(u) * Ts >= LEAST_PERIODS) & (f < BELOW_NYQUIST / (2 * Ts))
    power = _periodogram(_without_trend(u))
    lines = power > _level(power) * math.log(len(f) / FALSE_ALARM)
    # The taper spreads a line over neighbouring frequencies.
    usable &= ~(scipy.ndimage.maximum_filter1d(lines.astype(int), 5) > 0)
    if period := _period(u):
        order = f * period * Ts
        usable &= np.abs(order - np.round(order)) > 1.5 * f[1] * period * Ts
    return usable


def _period(u: Float[np.ndarray, " N"]) -> int:
    """Period of an input in samples; 0 if it is not periodic."""
    x, N = u - u.mean(), len(u)
    size = 1 << (2 * N - 1).bit_length()
    own = np.fft.irfft(np.abs(np.fft.rfft(x, size)) ** 2, size)[: N // 2]
    if own[0] <= 0:
        return 0
    share = own / own[0] * N / (N - np.arange(len(own)))
    below = np.flatnonzero(share < 0.5)  # skips the peak at lag zero
    if not len(below):
        return 0
    k = int(below[0] + np.argmax(share[below[0] :]))
    return k if share[k] > REPEATS else 0


def _without_trend(x: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """A signal without its regression line."""
    t = np.arange(len(x)) - (len(x) - 1) / 2
    centred = x - x.mean()
    return centred - t * (t @ centred) / max(t @ t, 1e-300)


def _periodogram(x: Float[np.ndarray, " N"]) -> Float[np.ndarray, " F"]:
    """Periodogram of a tapered signal; its mean for white noise is the variance."""
    w = np.sin(np.pi * np.arange(len(x)) / len(x)) ** 2
    return np.abs(np.fft.rfft(w * x)) ** 2 / np.sum(w**2)


def _level(power: Float[np.ndarray, " F"]) -> Float[np.ndarray, " F"]:
    """Mean level around each frequency, from the median of neighbours, which a line hardly changes.

    Ordinates have an exponential distribution, whose median is ln 2 times its mean. Where the level falls
    steeply, neighbours differ, so a smooth curve through the logarithms is subtracted first.
    """
    y = np.log(np.maximum(power, 1e-12 * max(float(power.max()), 1e-300)))
    x = np.log1p(np.arange(len(y)))
    smooth = np.polynomial.Polynomial.fit(x, y, SMOOTH_DEGREE)(x)
    about = scipy.ndimage.median_filter(y - smooth, 2 * NEIGHBOURS + 1, mode="nearest")
    return np.exp(smooth + about) / math.log(2)


def _waves(t: Float[np.ndarray, " N"], frequency: float) -> Float[np.ndarray, "N 2"]:
    return np.column_stack([np.cos(2 * np.pi * frequency * t), np.sin(2 * np.pi * frequency * t)])


def _harmonic(
    x: Float[np.ndarray, " N"], t: Float[np.ndarray, " N"], near: float, step: float
) -> tuple[float, Float[np.ndarray, " N"]]:
    """The sine that fits best within one step of a frequency."""

    def left(frequency: float) -> float:
        waves = _waves(t, frequency)
        return float(np.sum((x - waves @ np.linalg.lstsq(waves, x, rcond=None)[0]) ** 2))

    # Within one step the sum of squares has one minimum, near the peak of the line.
    grid = np.linspace(near - step, near + step, 9)
    best = float(grid[int(np.argmin([left(v) for v in grid]))])
    found = scipy.optimize.minimize_scalar(left, bounds=(best - step / 4, best + step / 4), method="bounded")
    frequency = float(found.x)
    waves = _waves(t, frequency)
    return frequency, waves @ np.linalg.lstsq(waves, x, rcond=None)[0]
