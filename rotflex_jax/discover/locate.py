"""Where the error of a model lives: when, how fast, at which speeds and deflections, after what."""

from collections.abc import Mapping, Sequence

import numpy as np

from rotflex_jax.discover.looks import missing_acceleration, views
from rotflex_jax.discover.places import Finding, in_frequency, in_time, in_view, information
from rotflex_jax.discover.result import Where
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.metrics import window_starts
from rotflex_jax.recording import Recording

LEVEL = 0.05
# A share must exceed the expected one by this much and by this factor to be worth a sentence.
EXCESS, FACTOR = 0.08, 1.3


def locate(
    recording: Recording,
    residual: np.ndarray,
    channels: Sequence[str],
    noise: Mapping[str, float] | Sequence[float] | np.ndarray,
    mechanism: Mechanism | None = None,
    *,
    window_seconds: float | None = None,
) -> tuple[Where, ...]:
    """Where the error of a model lives, in sentences with their evidence.

        share of a look = sum of e^2 over its samples / sum of e^2

    Each look (a place such as "within 80 ms after the hub reverses") is judged by how much its
    share tells, `s log(s/p) + (1-s) log((1-s)/(1-p))` with `p` the share of the samples, against
    the same under all circular shifts of the error against the motion, which keep the correlation
    of either in time. The best look of a view is compared with the best of every shift, which
    corrects for having looked often; views are compared by the rule of Benjamini and Hochberg.

    A free run carries an error on long after it was made. Speed, deflection and reversals are
    therefore also held against the acceleration of the error, which says where it *arises*.
    Frequencies are compared with white sensor noise, time with an error that stays the same.

    Not for a few correlation lengths of data: there a shift proves nothing, and nothing is found.

    Args:
        recording: What was measured.
        residual: Measured minus simulated outputs (N, C), of windowed free runs for instance.
        channels: Name of each column.
        noise: Deviation of the sensor noise by channel, or in the order of `channels`.
        mechanism: Tells which port a channel measures; by its name if None.
        window_seconds: Length of the windows after which the free run started anew [s]; None for
            one run. The jumps there are no error of the physics.

    Returns:
        Significant places, the most telling first and frequencies last, since white noise is an
        easy opponent; one statement that nothing stands out if there is none.

    Raises:
        InputError: Shapes that do not fit, or numbers that are not finite.

    Source: Westfall and Young 1993 (largest statistic over looks); Lo 1991 (time); Benjamini and
        Hochberg 1995.
    """
    e = np.asarray(residual, dtype=float)
    e = e[:, None] if e.ndim == 1 else e
    if e.shape != (recording.N, len(channels)) or not np.isfinite(e).all():
        raise InputError(
            f"Argument `residual` must have a finite number for each of the {recording.N} samples "
            f"and {len(channels)} channels, but has the shape {e.shape} with "
            f"{np.sum(~np.isfinite(e))} of them not finite; give measured minus simulated outputs."
        )
    if not isinstance(noise, Mapping):
        noise = dict(zip(channels, np.asarray(noise, float).tolist(), strict=True))
    sorted_by = views(recording, channels, noise, mechanism)
    found: list[Finding] = []
    for channel, error in zip(channels, e.T, strict=True):
        if np.sum(error**2) <= 0.0:
            continue
        unit = recording.units[recording.channels.index(channel)]
        found.append(in_time(channel, error, recording))
        found.append(in_frequency(channel, error, recording, unit))
        energies = {"lies": error**2, "arises": _made(error, recording, window_seconds)}
        found += [in_view(channel, energies, view) for view in sorted_by]
    telling = [f for f in _significant(found) if f.share >= max(f.expected + EXCESS, FACTOR * f.expected)]
    telling.sort(key=lambda f: (f.where.kind == "frequency", -float(information(f.share, f.expected))))
    return tuple(f.where for f in telling) or (_evenly(e, channels, noise),)


def _made(error: np.ndarray, recording: Recording, window_seconds: float | None) -> np.ndarray | None:
    """Squared acceleration of an error (N,): where it is made, wherever it is carried to."""
    starts = [] if window_seconds is None else window_starts(recording, window_seconds)[0].tolist()
    acceleration, seen = missing_acceleration(error, recording, starts)
    squared = acceleration**2
    if not np.sum(squared[seen]) > 0.0:
        return None
    # What cannot be judged counts as the average does.
    return np.where(seen, squared, squared[seen].mean())


def _significant(found: Sequence[Finding]) -> list[Finding]:
    """Those that remain when the number of views is corrected for (Benjamini and Hochberg)."""
    ranked = sorted(found, key=lambda f: f.where.p_value)
    passed = [k for k, f in enumerate(ranked, 1) if f.where.p_value <= LEVEL * k / len(ranked)]
    return ranked[: max(passed, default=0)]


def _evenly(e: np.ndarray, channels: Sequence[str], noise: Mapping[str, float]) -> Where:
    """What is said where nothing stands out."""
    rms = dict(zip(channels, np.sqrt(np.mean(e**2, axis=0)).tolist(), strict=True))
    small = all(rms[c] <= 1.3 * noise.get(c, 0.0) for c in channels)
    return Where(
        "The error is spread evenly: no time, frequency, speed or deflection stands out"
        + (", and it is no larger than the noise of the sensors." if small else "."),
        1.0,
        1.0,
        "time",
        ", ".join(channels),
        np.zeros(0),
        np.zeros(0),
        np.zeros(0),
        "s",
    )
