"""Conditions under which an error may be larger: ranges of speed and deflection, times after reversals."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from rotflex_jax.mechanism import Mechanism
from rotflex_jax.recording import Recording
from rotflex_jax.text.numbers import as_read

# Angles are smoothed over this half width before they are differentiated [s].
SMOOTHING_SECONDS = 0.03
# Times after a reversal that are tried [s].
REVERSAL_SECONDS = (0.02, 0.04, 0.08, 0.12, 0.2, 0.3, 0.5)
# Least and largest share of the samples that a condition may hold for.
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
        edges: Of the bins [unit].
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
    """Smoothed acceleration of an error: what the model lacks at that time, not what earlier errors left.

    Args:
        error: Of one channel [unit].
        recording: Gives the sampling.
        starts: Samples at which the free run started again; a jump there is no physics.
        order: Of the derivative; 1 for a channel that measures a speed.

    Returns:
        Acceleration [unit/s^2], and where it is known; nowhere in a very short recording.
    """
    half, seen = half_width(recording), np.ones(len(error), bool)
    if not half:
        return np.zeros(len(error)), ~seen
    window = 2 * half + 1
    smooth = scipy.signal.savgol_filter(error, window, 2, deriv=order, delta=recording.Ts)
    for k in (0, *starts, len(error)):
        seen[max(0, k - half) : k + half + 1] = False
    return np.asarray(smooth), seen


def condition_sets(
    recording: Recording,
    channels: Sequence[str],
    noise: Mapping[str, float],
    mechanism: Mechanism | None,
) -> tuple[ConditionSet, ...]:
    """The sets of conditions that the motion of the recording allows; none for a recording at rest.

    The first channel is taken for what turns and the second for what deflects; a single channel
    for both.

    Args:
        recording: Measured outputs.
        channels: Those of the model.
        noise: Channel -> standard deviation of the sensor noise.
        mechanism: Says what the channels measure; by their names if None.
    """
    half = half_width(recording)
    if not half:
        return ()
    turning, bending = channels[0], channels[min(1, len(channels) - 1)]
    speed, error, unit = _speed(recording, turning, noise.get(turning, 0.0), mechanism)
    what = _subject(turning, mechanism)
    position = np.asarray(scipy.signal.savgol_filter(recording.channel(bending), 2 * half + 1, 2))
    subject = "the deflection" if _subject(bending, mechanism) == "the joint" else bending
    found = (
        _sides("speed", speed, unit, error, _turning(what, unit)),
        _sides(
            "deflection",
            position,
            recording.units[recording.channels.index(bending)],
            noise.get(bending, 0.0),
            _beyond(subject),
        ),
        _reversals(speed, error, recording.Ts, what),
    )
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
    unit = recording.units[recording.channels.index(channel)]
    known = dict(zip(mechanism.channels, mechanism.quantities, strict=True)) if mechanism is not None else {}
    # The reading of a machine says what it is; without one its unit tells a speed.
    is_speed = known[channel].derivative > 0 if channel in known else unit.endswith("/s")
    order = 0 if is_speed else 1
    weights = scipy.signal.savgol_coeffs(window, 2, deriv=order, delta=recording.Ts)
    y = recording.channel(channel).astype(float)
    speed = np.asarray(scipy.signal.savgol_filter(y, window, 2, deriv=order, delta=recording.Ts))
    return speed, noise * float(np.linalg.norm(weights)), unit if is_speed else f"{unit}/s"


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
    """Small and large values, on either side; None where nothing moves beyond the noise."""
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
    """Times after each reversal of the motion; noise about standstill is none."""
    threshold = max(4 * error, 0.03 * float(np.sqrt(np.mean(speed**2))))
    clear = np.flatnonzero(np.abs(speed) > threshold)
    signs = np.sign(speed)
    turned = np.flatnonzero(signs[clear][1:] != signs[clear][:-1]) + 1
    if not len(turned):
        return None
    # The reversal is the last change of sign before the motion is clearly the other way.
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
    """The set without conditions that hold for too little or too much of the time."""
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
