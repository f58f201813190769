"""Where the error of a model lies: in time, frequency, speed and deflection, and after reversals."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Real

from rotflex_jax.checks import names, positive, real, shown
from rotflex_jax.discover.result import Where
from rotflex_jax.errors import InputError
from rotflex_jax.fit.inference import correlation_length
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.metrics import window_starts
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import single
from rotflex_jax.recording.smoothing import local_polynomial, smoothed
from rotflex_jax.text.numbers import as_read, percent_of_whole

# Half width of the window over which signals are smoothed before they are differentiated [s].
SMOOTHING_SECONDS = 0.03
# Times after a reversal that are tried as conditions [s].
REVERSAL_SECONDS = (0.02, 0.04, 0.08, 0.12, 0.2, 0.3, 0.5)
# A condition is tried if the share of samples for which it holds lies between these two.
MIN_TIME_SHARE, MAX_TIME_SHARE = 0.03, 0.6
PROFILE_BINS = 8


@dataclasses.dataclass(frozen=True)
class ConditionSet:
    """Conditions on one quantity, each of which holds for some samples of a recording.

    Attributes:
        kind: speed, deflection or reversal.
        masks: Samples for which each of the K conditions holds.
        phrases: Each condition in words, such as "while the hub turns slower than 20 deg/s".
        bins: Bin of each sample for the profile.
        edges: Edges of the bins [unit].
        unit: SI unit of the edges.
    """

    kind: str
    masks: Bool[np.ndarray, "K N"]
    phrases: tuple[str, ...]
    bins: Int[np.ndarray, " N"]
    edges: Float[np.ndarray, " G"]
    unit: str


def half_width(recording: Recording) -> int:
    """Half the smoothing window [samples]; 0 where the recording is too short for one."""
    half = max(3, round(SMOOTHING_SECONDS / recording.Ts))
    return half if 4 * half < recording.N else 0


def missing_acceleration(
    error: Float[np.ndarray, " N"], recording: Recording, starts: Sequence[int] = (), order: int = 2
) -> tuple[Float[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """Smoothed acceleration of an error, which shows where the error arises and not where it persists.

    Args:
        error: Error of one channel that measures a motion [unit].
        recording: Recording with this channel; gives the sampling period.
        starts: Samples at which the free run started again; a jump there is not caused by the physics.
        order: Order of the derivative: 2 for a channel that measures a position, 1 for a speed.

    Returns:
        Acceleration [unit/s^2, or unit/s for a speed], and the samples where it is known; none in a very
        short recording.
    """
    half, seen = half_width(recording), np.ones(len(error), bool)
    if not half:
        return np.zeros(len(error)), ~seen
    window = 2 * half + 1
    smooth = smoothed(error, window, 2, order, recording.Ts)
    for k in (0, *starts, len(error)):
        seen[max(0, k - half) : k + half + 1] = False
    return smooth, seen


def derivative_of(channel: str, unit: str, mechanism: Mechanism | None = None) -> int:
    """Derivative that a channel measures: 0 for a position, 1 for a speed, 2 for a reading of the motor.

    Args:
        channel: Name of the channel.
        unit: Unit of the channel, which decides if the mechanism does not have the channel.
        mechanism: Defines what the channel measures.

    >>> derivative_of("theta", "rad"), derivative_of("gyro", "rad/s"), derivative_of("current", "A")
    (0, 1, 2)
    """
    known = dict(zip(mechanism.channels, mechanism.quantities, strict=True)) if mechanism is not None else {}
    if channel in known:
        return known[channel].derivative
    return 1 if unit.endswith("/s") else 2 if unit == "A" else 0


def motion_channels(units: Mapping[str, str], mechanism: Mechanism | None = None) -> tuple[str, ...]:
    """Channels that measure a position or a speed, in their order.

    Args:
        units: Channel -> its unit.
        mechanism: Defines what the channels measure.
    """
    return tuple(c for c, unit in units.items() if derivative_of(c, unit, mechanism) < 2)


def condition_sets(
    recording: Recording,
    channels: Sequence[str],
    noise: Mapping[str, float],
    mechanism: Mechanism | None,
) -> tuple[ConditionSet, ...]:
    """Sets of conditions on speed, deflection and reversals of the recorded motion; none at rest.

    Speed and reversals are taken from the first channel that measures a motion. The deflection is another
    channel that measures a position; if there is no other, the only position serves for both.

    Args:
        recording: Measured outputs.
        channels: Channels of the model.
        noise: Channel -> standard deviation of the sensor noise.
        mechanism: Defines what the channels measure; if None, their names and units decide.
    """
    half = half_width(recording)
    units = {c: recording.unit(c) for c in channels}
    moving = motion_channels(units, mechanism)
    if not half or not moving:
        return ()
    turning = moving[0]
    positions = [c for c in moving if derivative_of(c, units[c], mechanism) == 0]
    bending = next((c for c in positions if c != turning), positions[0] if positions else None)
    speed, error, unit = _speed(recording, turning, noise.get(turning, 0.0), mechanism)
    what = _subject(turning, mechanism)
    found = [_sides("speed", speed, unit, error, _turning(what, unit))]
    if bending is not None:
        position = smoothed(recording.channel(bending).astype(float), 2 * half + 1, 2)
        subject = "the deflection" if _subject(bending, mechanism) == "the joint" else bending
        found.append(
            _sides("deflection", position, units[bending], noise.get(bending, 0.0), _beyond(subject))
        )
    found.append(_reversals(speed, error, recording.Ts, what))
    return tuple(conditions for conditions in found if conditions is not None)


def _subject(channel: str, mechanism: Mechanism | None) -> str:
    ports = {c: port for c, (port, _) in mechanism.outputs} if mechanism is not None else {}
    port = ports.get(channel, {"theta": "hub", "alpha": "joint"}.get(channel, channel))
    return f"the {port}"


def _speed(
    recording: Recording, channel: str, noise: float, mechanism: Mechanism | None
) -> tuple[np.ndarray, float, str]:
    """Smoothed speed of a channel, the standard deviation of its error, and its unit."""
    window = 2 * half_width(recording) + 1
    unit = recording.unit(channel)
    order = 1 - derivative_of(channel, unit, mechanism)
    weights = local_polynomial(window, 2, order, recording.Ts)[window // 2]
    y = recording.channel(channel).astype(float)
    speed = smoothed(y, window, 2, order, recording.Ts)
    return speed, noise * float(np.linalg.norm(weights)), f"{unit}/s" if order else unit


def _turning(what: str, unit: str) -> dict[str, str]:
    verb = "turns" if unit.startswith("rad") else "moves"
    return {
        "inside": f"while {what} {verb} slower than {{}}",
        "outside": f"while {what} {verb} faster than {{}}",
        "above": f"while {what} {verb} forwards faster than {{}}",
        "below": f"while {what} {verb} backwards faster than {{}}",
        "positive": f"while {what} {verb} forwards",
        "negative": f"while {what} {verb} backwards",
    }


def _beyond(what: str) -> dict[str, str]:
    return {
        "inside": f"while {what} is within ±{{}}",
        "outside": f"while {what} is beyond ±{{}}",
        "above": f"while {what} is above {{}}",
        "below": f"while {what} is below -{{}}",
        "positive": f"while {what} is positive",
        "negative": f"while {what} is negative",
    }


def _sides(kind: str, x: np.ndarray, unit: str, error: float, phrases: dict[str, str]) -> ConditionSet | None:
    """Conditions that a signal is small, large, or on one side of zero; None where it is within the noise."""
    reach = float(np.quantile(np.abs(x), 0.98))
    if reach <= 5 * error or reach == 0.0:
        return None
    factor, read = as_read(1.0, unit)
    step = _round_number(factor * reach / PROFILE_BINS) / factor
    count = max(2, math.floor(reach / step + 1e-9))
    limits = step * np.arange(1, count + 1)
    size = np.abs(x)
    masks = [x > 0, x < 0]
    words = [phrases["positive"], phrases["negative"]]
    for limit in limits:
        masks += [size < limit, size > limit, x > limit, x < -limit]
        text = f"{factor * limit:.4g} {read}".rstrip()
        words += [phrases[k].format(text) for k in ("inside", "outside", "above", "below")]
    edges = step * np.arange(-count, count + 1)
    bins = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    return _informative(ConditionSet(kind, np.array(masks), tuple(words), bins, edges, unit))


def _reversals(speed: np.ndarray, error: float, Ts: float, what: str) -> ConditionSet | None:
    """Conditions on the time since the last reversal of the motion; noise at standstill is no reversal."""
    threshold = max(4 * error, 0.03 * float(np.sqrt(np.mean(speed**2))))
    clear = np.flatnonzero(np.abs(speed) > threshold)
    signs = np.sign(speed)
    turned = np.flatnonzero(signs[clear][1:] != signs[clear][:-1]) + 1
    if not len(turned):
        return None
    # A reversal is the last change of sign before the speed is clearly in the other direction.
    changes = np.flatnonzero(signs[1:] != signs[:-1]) + 1
    times = changes[np.searchsorted(changes, clear[turned], side="right") - 1]
    samples = np.arange(len(speed))
    last = np.concatenate([[-len(speed)], times])[np.searchsorted(times, samples, side="right")]
    since = (samples - last) * Ts
    since[last < 0] = np.inf
    masks = np.array([since < h for h in REVERSAL_SECONDS])
    words = tuple(f"within {1e3 * h:.0f} ms after {what} reverses" for h in REVERSAL_SECONDS)
    edges = np.array([0.0, *REVERSAL_SECONDS, np.inf])  # the last bin: later, or before the first reversal
    bins = np.searchsorted(edges[:-1], since, side="right") - 1
    return _informative(ConditionSet("reversal", masks, words, bins, edges, "s"))


def _informative(conditions: ConditionSet) -> ConditionSet | None:
    """The set without conditions that hold too rarely or too often; None if no condition is left."""
    shares = conditions.masks.mean(axis=1)
    chosen = (shares >= MIN_TIME_SHARE) & (shares <= MAX_TIME_SHARE)
    if not chosen.any():
        return None
    words = tuple(p for p, k in zip(conditions.phrases, chosen, strict=True) if k)
    return dataclasses.replace(conditions, masks=conditions.masks[chosen], phrases=words)


def _round_number(x: float) -> float:
    """The nearest of 1, 2, 5 times a power of ten.

    >>> [_round_number(x) for x in (0.7, 3.4, 60.0)]
    [0.5, 5.0, 50.0]
    """
    power = 10.0 ** math.floor(math.log10(x))
    return min((1.0, 2.0, 5.0, 10.0), key=lambda m: abs(math.log(m * power / x))) * power


TIME_SEGMENTS = 20
# Edges of frequency bands [Hz], decades of these.
BAND_EDGES = (1.0, 2.0, 5.0)
NOISE_DRAWS = 999


class ErrorShare(NamedTuple):
    """A statement on where the error lies, and the share that an evenly spread error would have there."""

    where: Where
    expected: float

    @property
    def share(self) -> float:
        """Share of the squared error."""
        return self.where.share


def relative_entropy(
    share: float | Float[np.ndarray, "..."], expected: float | Float[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    """Divergence of a share s from a smaller expected share p [nat]; 0 where s is no larger than p.

    s log(s/p) + (1-s) log((1-s)/(1-p))

    >>> float(relative_entropy(0.2, 0.2)), round(float(relative_entropy(0.78, 0.21)), 3)
    (0.0, 0.742)
    """
    s = np.clip(share, 1e-12, 1 - 1e-12)
    p = np.clip(expected, 1e-12, 1 - 1e-12)
    return np.where(s > p, s * np.log(s / p) + (1 - s) * np.log((1 - s) / (1 - p)), 0.0)


def in_conditions(
    channel: str, energies: Mapping[str, Float[np.ndarray, " N"] | None], conditions: ConditionSet
) -> ErrorShare:
    """The condition of a set that stands out most, with its p-value over all circular shifts of the error.

    Args:
        channel: Channel that has the error.
        energies: Verb of the statement -> squared error ("lies") or its squared acceleration ("arises", None
            where it is unknown).
        conditions: The conditions that are compared.
    """
    expected = conditions.masks.mean(axis=1)
    spectrum = np.conj(np.fft.rfft(conditions.masks, axis=1))
    N = conditions.masks.shape[1]
    best: tuple[float, str, int, float] | None = None
    highest = np.zeros(N)
    for verb, energy in energies.items():
        if energy is None:
            continue
        shares = np.fft.irfft(spectrum * np.fft.rfft(energy / energy.sum()), N, axis=1)
        divergence = relative_entropy(shares, expected[:, None])
        highest = np.maximum(highest, divergence.max(axis=0))
        k = int(divergence[:, 0].argmax())
        if best is None or divergence[k, 0] > best[0]:
            best = float(divergence[k, 0]), verb, k, float(shares[k, 0])
    assert best is not None  # the error itself is always among the energies
    largest, verb, k, share = best
    # The identity is one of the shifts, so that p is never zero.
    p_value = float(np.mean(highest >= largest * (1 - 1e-9)))
    energy = energies[verb]
    profile = np.bincount(conditions.bins, energy, len(conditions.edges) - 1)
    statement = (
        f"{percent_of_whole(share)} of the {channel} error {verb} {conditions.phrases[k]}, "
        f"where the machine spends {percent_of_whole(expected[k])} of the time."
    )
    usual = np.bincount(conditions.bins, minlength=len(profile)) / N
    profile /= profile.sum()
    kind, edges = conditions.kind, conditions.edges
    where = Where(statement, share, p_value, kind, channel, edges, profile, usual, conditions.unit)
    return ErrorShare(where, float(expected[k]))


def in_time(channel: str, error: Float[np.ndarray, " N"], recording: Recording) -> ErrorShare:
    """The stretch of time in which the error is largest, with its p-value.

    The test statistic is the range of the cumulative sum of the squared error less its mean, divided by the
    standard deviation that follows from the autocorrelation. If the size of the error does not change over
    time, this statistic has the distribution of Kuiper's statistic.
    """
    energy = error**2
    N = len(energy)
    deviation = energy - energy.mean()
    walk = np.concatenate([[0.0], np.cumsum(deviation)])
    # The number of lags comes from the error, not its square: a lasting change of size is no correlation.
    lags = correlation_length(error[:, None])
    r = np.fft.irfft(np.abs(np.fft.rfft(deviation, 2 * N)) ** 2)[: lags + 1]
    long_run = float(r[0] + 2 * np.sum((1 - np.arange(1, lags + 1) / (lags + 1)) * r[1:]))
    v = np.ptp(walk) / np.sqrt(max(long_run, 1e-12 * float(r[0]), 1e-300))
    j = np.arange(1, 100)
    tail = 2 * np.sum((4 * j**2 * v**2 - 1) * np.exp(-2 * j**2 * v**2))
    p_value = float(np.clip(tail, 0.0, 1.0)) if v > 0.4 else 1.0
    # The error is large where the cumulative sum rises. If that wraps around the ends, there are two
    # stretches, of which the one with the larger excess is reported.
    low, high = int(walk.argmin()), int(walk.argmax())
    if low > high:
        low, high = max(((0, high), (low, N)), key=lambda part: walk[part[1]] - walk[part[0]])
    # A few samples at an end do not count as a stretch of their own.
    low, high = (0 if low < N / 100 else low), (N if high > 0.99 * N else high)
    share, expected = float(energy[low:high].sum() / energy.sum()), (high - low) / N
    start, end = (recording.start + recording.Ts * k for k in (low, high))
    when = f"between {start:.1f} s and {end:.1f} s"
    when = f"before {end:.1f} s" if low == 0 else f"after {start:.1f} s" if high == N else when
    bins = np.minimum(np.arange(N) * TIME_SEGMENTS // N, TIME_SEGMENTS - 1)
    edges = recording.start + recording.Ts * N * np.linspace(0, 1, TIME_SEGMENTS + 1)
    profile = np.bincount(bins, energy, TIME_SEGMENTS) / energy.sum()
    usual = np.bincount(bins, minlength=TIME_SEGMENTS) / N
    statement = (
        f"{percent_of_whole(share)} of the {channel} error lies {when}, which is "
        f"{percent_of_whole(expected)} of the recording."
    )
    where = Where(statement, share, p_value, "time", channel, edges, profile, usual, "s")
    return ErrorShare(where, expected)


def in_frequency(channel: str, error: Float[np.ndarray, " N"], recording: Recording, unit: str) -> ErrorShare:
    """The frequency range, of all unions of neighbouring bands, where the error exceeds white noise most."""
    N = len(error)
    power = np.abs(np.fft.rfft(error)) ** 2
    weight = np.full(len(power), 2.0)  # squares of a real and an imaginary part
    weight[0] = 1.0
    if N % 2 == 0:
        weight[-1] = 1.0
    f = np.fft.rfftfreq(N, recording.Ts)
    decades = [m * 10.0**k for k in range(-3, 6) for m in BAND_EDGES]
    inner = [edge for edge in decades if 4 * f[1] <= edge < f[-1]]
    # The first band is the constant part alone.
    edges = np.array([0.0, 0.5 * f[1], *inner, f[-1]])
    band = np.minimum(np.searchsorted(edges, f, side="right") - 1, len(edges) - 2)
    profile = np.bincount(band, weight * power, len(edges) - 1)
    freedom = np.bincount(band, weight, len(edges) - 1)
    profile, usual = profile / profile.sum(), freedom / freedom.sum()
    runs = [(0, 1)] + [(a, b) for a in range(1, len(usual)) for b in range(a + 1, len(usual) + 1)]
    first, last = np.array(runs).T

    def divergence(shares: np.ndarray) -> np.ndarray:
        ends = np.insert(np.cumsum(shares, axis=-1), 0, 0.0, axis=-1)
        total = np.insert(np.cumsum(usual), 0, 0.0)
        return relative_entropy(ends[..., last] - ends[..., first], total[last] - total[first])

    noise = np.random.default_rng(0).gamma(freedom / 2, size=(NOISE_DRAWS, len(freedom)))
    highest = divergence(noise / noise.sum(axis=1, keepdims=True)).max(axis=1)
    each = divergence(profile)
    best = int(each.argmax())
    low, high = runs[best]
    share, expected = float(profile[low:high].sum()), float(usual[low:high].sum())
    p_value = (1 + int(np.sum(highest >= each[best]))) / (1 + NOISE_DRAWS)
    if low == 0:
        offset, read = as_read(float(error.mean()), unit)
        what = f"is a constant offset of {offset:.2g} {read}".rstrip()
    else:
        below, above = f"{edges[low]:g} Hz", f"{edges[high]:.4g} Hz"
        what = f"lies below {above}" if low == 1 else f"lies between {edges[low]:g} and {above}"
        what = f"lies above {below}" if high == len(usual) else what
    statement = (
        f"{percent_of_whole(share)} of the {channel} error {what}, "
        f"where white sensor noise would have {percent_of_whole(expected)} of its power."
    )
    where = Where(statement, share, p_value, "frequency", channel, edges, profile, usual, "Hz")
    return ErrorShare(where, expected)


SIGNIFICANCE = 0.05
# A share must exceed the expected one by this much and by this factor to be worth a sentence.
MIN_EXCESS, MIN_RATIO = 0.08, 1.3


def locate(
    recording: Recording,
    residual: Real[np.ndarray, "..."],
    channels: Sequence[str],
    noise: Mapping[str, float] | Sequence[float] | Real[np.ndarray, " C"],
    mechanism: Mechanism | None = None,
    *,
    window_seconds: float | None = None,
) -> tuple[Where, ...]:
    """Where the error of a model is larger than elsewhere, in sentences with their evidence.

        share of a condition = sum of e^2 over its samples / sum of e^2

    Each condition (such as "within 80 ms after the hub reverses") is rated by the divergence
    `s log(s/p) + (1-s) log((1-s)/(1-p))` between its share `s` of the error and its share `p` of the
    samples. The divergence is compared with its values under all circular shifts of the error against the
    motion, which keep the autocorrelation of both. For each quantity, the largest divergence over all
    conditions is compared with the largest one of every shift, which corrects for the number of conditions.
    The number of quantities is corrected for by the rule of Benjamini and Hochberg.

    An error of a free run persists long after its cause. Speed, deflection and reversals are therefore also
    compared with the acceleration of the error, which shows where it *arises*. The error of a current or a
    duty does not persist, and these channels give neither speed nor deflection. Frequencies are compared
    with white sensor noise, time with an error of constant size.

    Do not use it for data of a few correlation lengths: there shifts prove nothing, and nothing is found.

    Args:
        recording: What was measured.
        residual: Measured minus simulated outputs (N, C), of windowed free runs for instance.
        channels: Name of each column.
        noise: Standard deviation of the sensor noise by channel, or in the order of `channels`.
        mechanism: Defines which port a channel measures; if None, the name of the channel decides.
        window_seconds: Length of the windows after which the free run started again [s]; None for one run
            over the whole recording. Jumps at these starts are left out of the acceleration.

    Returns:
        Significant statements, those with the largest divergence first. Frequencies come last, since no real
        error is white. If no statement is significant, one statement that nothing stands out.

    Raises:
        InputError: If shapes do not fit together, or values are not finite.

    Source: Westfall and Young 1993 (largest statistic over several); Lo 1991 (time); Benjamini and
        Hochberg 1995.
    """
    recording = single(recording, "recording")
    channels = names(channels, "channels")
    for channel in channels:
        recording.channel(channel)
    if mechanism is not None and not isinstance(mechanism, Mechanism):
        raise InputError(
            f"Argument `mechanism` must be a Mechanism, but is {shown(mechanism)}; leave it out."
        )
    if window_seconds is not None:
        positive(window_seconds, "window_seconds")
    e = _numbers(residual)
    e = e[:, None] if e.ndim == 1 else e
    if e.shape != (recording.N, len(channels)) or not np.isfinite(e).all():
        raise InputError(
            f"Argument `residual` must have a finite number for each of the {recording.N} samples "
            f"and {len(channels)} channels, but has the shape {e.shape} with "
            f"{np.sum(~np.isfinite(e))} of them not finite; give measured minus simulated outputs."
        )
    if not isinstance(noise, Mapping):
        listed = np.ravel(_numbers(noise)).tolist()
        complete = len(listed) == len(channels)
        noise = dict(zip(channels, listed if complete else [math.nan] * len(channels), strict=True))
    if not all(0 <= real(noise.get(c, 0.0)) < math.inf for c in channels):
        raise InputError(
            "Argument `noise` must have a finite number from 0 for each of the channels "
            f"{', '.join(channels)}; give standard deviations by name or in this order."
        )
    sets = condition_sets(recording, channels, noise, mechanism)
    found: list[ErrorShare] = []
    for channel, error in zip(channels, e.T, strict=True):
        if np.sum(error**2) <= 0.0:
            continue
        unit = recording.unit(channel)
        found.append(in_time(channel, error, recording))
        found.append(in_frequency(channel, error, recording, unit))
        order = 2 - derivative_of(channel, unit, mechanism)
        lacking = _acceleration_energy(error, recording, window_seconds, order) if order else None
        energies = {"lies": error**2, "arises": lacking}
        found += [in_conditions(channel, energies, conditions) for conditions in sets]
    notable = [
        f for f in _significant(found) if f.share >= max(f.expected + MIN_EXCESS, MIN_RATIO * f.expected)
    ]
    notable.sort(key=lambda f: (f.where.kind == "frequency", -float(relative_entropy(f.share, f.expected))))
    return tuple(f.where for f in notable) or (_nothing_stands_out(e, channels, noise),)


def locate_in_windows(
    model: Model,
    recording: Recording,
    simulated: Real[np.ndarray, "N C"],
    noise: Mapping[str, float] | Real[np.ndarray, " C"],
    window_seconds: float,
) -> tuple[Where, ...]:
    """`locate` for free runs of a model over windows of a recording, which may diverge.

    Args:
        model: The model.
        recording: What was measured.
        simulated: Its runs.
        noise: Standard deviation of the sensor noise by channel, or in the order of the channels.
        window_seconds: Length of the windows [s].
    """
    residual, channels = model.measured(recording) - np.asarray(simulated, float), model.mechanism.channels
    if not np.isfinite(residual).all():
        what = (
            f"Free runs over {window_seconds:g} s diverge, so that their error does not show what is missing."
        )
        return (_nowhere(what, channels),)
    return locate(recording, residual, channels, noise, model.mechanism, window_seconds=window_seconds)


def _numbers(given: Any) -> Float[np.ndarray, "..."]:
    """Real numbers as an array; one nan for anything else."""
    try:
        array = np.asarray(given)
    except ValueError:  # rows of unequal length
        return np.array(math.nan)
    return array.astype(float) if array.dtype.kind in "iuf" else np.array(math.nan)


def _acceleration_energy(
    error: np.ndarray, recording: Recording, window_seconds: float | None, order: int
) -> np.ndarray | None:
    """Squared acceleration of an error (N,), which is large where the error arises; None if it is unknown."""
    starts = [] if window_seconds is None else window_starts(recording, window_seconds)[0].tolist()
    acceleration, seen = missing_acceleration(error, recording, starts, order)
    squared = acceleration**2
    if not np.sum(squared[seen]) > 0.0:
        return None
    # Samples where it is unknown get the mean.
    return np.where(seen, squared, squared[seen].mean())


def _significant(found: Sequence[ErrorShare]) -> list[ErrorShare]:
    """Statements that are significant after correction for their number (Benjamini and Hochberg)."""
    ranked = sorted(found, key=lambda f: f.where.p_value)
    passed = [k for k, f in enumerate(ranked, 1) if f.where.p_value <= SIGNIFICANCE * k / len(ranked)]
    return ranked[: max(passed, default=0)]


def _nothing_stands_out(e: np.ndarray, channels: Sequence[str], noise: Mapping[str, float]) -> Where:
    """The statement that nothing stands out."""
    rms = dict(zip(channels, np.sqrt(np.mean(e**2, axis=0)).tolist(), strict=True))
    small = all(rms[c] <= 1.3 * noise.get(c, 0.0) for c in channels)
    return _nowhere(
        "The error is spread evenly: no time, frequency, speed or deflection stands out"
        + (", and it is no larger than the noise of the sensors." if small else "."),
        channels,
    )


def _nowhere(statement: str, channels: Sequence[str]) -> Where:
    """A statement that is about no part of a recording, and so has no profile."""
    none = np.zeros(0)
    return Where(statement, 1.0, 1.0, "time", ", ".join(channels), none, none, none, "s")
