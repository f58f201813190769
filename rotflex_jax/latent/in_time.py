"""A latent torque read in time: lines of a periodic disturbance, and a slow drift."""

import math
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

from rotflex_jax.parameters import HALF_WIDTH_95

# Chance of a false line, and of a false drift, in one torque.
FALSE_ALARM = 1e-3
# A line has at least so many periods in its recording; what is slower is drift.
LEAST_PERIODS = 8
# Share of the Nyquist frequency above which the level is not known from both sides.
BELOW_NYQUIST = 0.9
# Neighbours on either side from which the level of the spectrum about a frequency is taken.
NEIGHBOURS = 40
# Degree of the curve that follows the spectrum of a torque, in logarithms of both.
SMOOTH_DEGREE = 6
# Blocks of a recording whose means tell a drift.
DRIFT_BLOCKS = 12
# An input that correlates as much as this with itself a while later repeats itself.
REPEATS = 0.8
# Most lines that are looked for in one torque.
MOST_LINES = 5


class PeriodicTorque(NamedTuple):
    """A sine in a torque that is none of the input.

    Attributes:
        frequency: [Hz].
        amplitude: [unit of the torque].
        interval: 95 % interval of the amplitude.
        p_value: Chance of such a line in a torque without any.
    """

    frequency: float
    amplitude: float
    interval: tuple[float, float]
    p_value: float


class Drift(NamedTuple):
    """A torque that rises or falls over its recording.

    Attributes:
        slope: [unit of the torque per second].
        interval: 95 % interval of the slope.
        change: Over the whole recording [unit of the torque].
        p_value: Chance of such a slope without drift.
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

    with the largest ordinate P of the tapered periodogram over the mean level B about it, taken from n
    neighbours, and M frequencies: Fisher's test for a hidden period, with a level that may change with the
    frequency, as that of a latent torque does. A line that is found is taken away and the test repeated.
    Torques of the motion repeat with the input: multiples of its frequency, where it repeats itself, and its
    own lines are left out.

    Not for a machine under feedback, whose input answers to a disturbance, nor for one that turns evenly,
    where a torque of the position has lines too.

    Args:
        torque: [N m].
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
        # The level is itself an estimate, by about as many ordinates as there are neighbours on one side.
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
        usable &= np.abs(f - frequency) > 2.5 * f[1]  # what is left of a line is none
    return tuple(sorted(found, key=lambda line: -line.amplitude))


def drift(torque: Float[np.ndarray, " N"], Ts: float) -> Drift | None:
    """The slope of a torque over its recording, by a regression of means over blocks; None if there is none.

    Args:
        torque: [N m].
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
    """Frequencies at which a line is none of the input: where it has no line, nor multiples of its period."""
    usable = (f * len(u) * Ts >= LEAST_PERIODS) & (f < BELOW_NYQUIST / (2 * Ts))
    power = _periodogram(_without_trend(u))
    lines = power > _level(power) * math.log(len(f) / FALSE_ALARM)
    # The taper widens a line to its neighbours.
    usable &= ~(scipy.ndimage.maximum_filter1d(lines.astype(int), 5) > 0)
    if period := _period(u):
        order = f * period * Ts
        usable &= np.abs(order - np.round(order)) > 1.5 * f[1] * period * Ts
    return usable


def _period(u: Float[np.ndarray, " N"]) -> int:
    """Samples after which an input repeats itself; 0 where it does not."""
    x, N = u - u.mean(), len(u)
    size = 1 << (2 * N - 1).bit_length()
    own = np.fft.irfft(np.abs(np.fft.rfft(x, size)) ** 2, size)[: N // 2]
    if own[0] <= 0:
        return 0
    share = own / own[0] * N / (N - np.arange(len(own)))
    below = np.flatnonzero(share < 0.5)  # the first peak is that at no lag
    if not len(below):
        return 0
    k = int(below[0] + np.argmax(share[below[0] :]))
    return k if share[k] > REPEATS else 0


def _without_trend(x: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """A signal less its regression line."""
    t = np.arange(len(x)) - (len(x) - 1) / 2
    centred = x - x.mean()
    return centred - t * (t @ centred) / max(t @ t, 1e-300)


def _periodogram(x: Float[np.ndarray, " N"]) -> Float[np.ndarray, " F"]:
    """Of a tapered signal; of white noise the variance, in the mean."""
    w = np.sin(np.pi * np.arange(len(x)) / len(x)) ** 2
    return np.abs(np.fft.rfft(w * x)) ** 2 / np.sum(w**2)


def _level(power: Float[np.ndarray, " F"]) -> Float[np.ndarray, " F"]:
    """Mean level about each frequency, from the median, which a line does not move.

    The median of neighbouring ordinates is that of an exponential distribution, ln 2 of its mean. Where the
    level falls steeply, neighbours differ: a smooth curve through the logarithms is taken off before.
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

    # Within a step the sum of squares has one minimum, about the crest of the line.
    grid = np.linspace(near - step, near + step, 9)
    best = float(grid[int(np.argmin([left(v) for v in grid]))])
    found = scipy.optimize.minimize_scalar(left, bounds=(best - step / 4, best + step / 4), method="bounded")
    frequency = float(found.x)
    waves = _waves(t, frequency)
    return frequency, waves @ np.linalg.lstsq(waves, x, rcond=None)[0]
