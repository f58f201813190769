"""The most telling place of an error in one view, and the chance to see it by accident."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rotflex_jax.discover.looks import View, as_read
from rotflex_jax.discover.result import Where
from rotflex_jax.fit.covariance import correlation_length
from rotflex_jax.recording import Recording

SEGMENTS = 20
# Edges of frequency bands [Hz], decades of these.
OCTAVES = (1.0, 2.0, 5.0)
DRAWS = 999


class Finding(NamedTuple):
    """A place, and the share of the error that an even spread would have there."""

    where: Where
    expected: float

    @property
    def share(self) -> float:
        """Share of the squared error."""
        return self.where.share


def information(share: np.ndarray | float, expected: np.ndarray | float) -> np.ndarray:
    """How much a share above the expected one tells [nat]; 0 for one below.

    s log(s/p) + (1-s) log((1-s)/(1-p))

    >>> float(information(0.2, 0.2)), round(float(information(0.78, 0.21)), 3)
    (0.0, 0.742)
    """
    s = np.clip(share, 1e-12, 1 - 1e-12)
    p = np.clip(expected, 1e-12, 1 - 1e-12)
    return np.where(s > p, s * np.log(s / p) + (1 - s) * np.log((1 - s) / (1 - p)), 0.0)


def in_view(channel: str, energies: Mapping[str, np.ndarray | None], view: View) -> Finding:
    """The most telling look of a view, its p-value over all circular shifts."""
    expected = view.masks.mean(axis=1)
    spectrum = np.conj(np.fft.rfft(view.masks, axis=1))
    N = view.masks.shape[1]
    best: tuple[float, str, int, float] | None = None
    highest = np.zeros(N)
    for verb, energy in energies.items():
        if energy is None:
            continue
        shares = np.fft.irfft(spectrum * np.fft.rfft(energy / energy.sum()), N, axis=1)
        told = information(shares, expected[:, None])
        highest = np.maximum(highest, told.max(axis=0))
        look = int(told[:, 0].argmax())
        if best is None or told[look, 0] > best[0]:
            best = float(told[look, 0]), verb, look, float(shares[look, 0])
    assert best is not None  # the error itself is always among the energies
    told, verb, look, share = best
    # The identity is one of the shifts, so that p is never zero.
    p_value = float(np.mean(highest >= told * (1 - 1e-9)))
    energy = energies[verb]
    profile = np.bincount(view.bins, energy, len(view.edges) - 1)
    statement = (
        f"{percent(share)} of the {channel} error {verb} {view.phrases[look]}, "
        f"where the machine spends {percent(expected[look])} of the time."
    )
    usual = np.bincount(view.bins, minlength=len(profile)) / N
    profile /= profile.sum()
    where = Where(statement, share, p_value, view.kind, channel, view.edges, profile, usual, view.unit)
    return Finding(where, float(expected[look]))


def in_time(channel: str, error: np.ndarray, recording: Recording) -> Finding:
    """The stretch of time that holds more than its share of the error.

    The range of the cumulated deviation from the mean, over the deviation that its autocorrelation
    explains, follows Kuiper's law where the error stays the same.
    """
    energy = error**2
    N = len(energy)
    deviation = energy - energy.mean()
    walk = np.concatenate([[0.0], np.cumsum(deviation)])
    # The lags come from the error itself: a lasting change of its size is no correlation.
    lags = correlation_length(error[:, None])
    r = np.fft.irfft(np.abs(np.fft.rfft(deviation, 2 * N)) ** 2)[: lags + 1]
    long_run = float(r[0] + 2 * np.sum((1 - np.arange(1, lags + 1) / (lags + 1)) * r[1:]))
    v = np.ptp(walk) / np.sqrt(max(long_run, 1e-12 * float(r[0]), 1e-300))
    j = np.arange(1, 100)
    law = 2 * np.sum((4 * j**2 * v**2 - 1) * np.exp(-2 * j**2 * v**2))
    p_value = float(np.clip(law, 0.0, 1.0)) if v > 0.4 else 1.0
    # The error gathers where the walk climbs; round the ends that is two pieces: one is told.
    low, high = int(walk.argmin()), int(walk.argmax())
    if low > high:
        low, high = max(((0, high), (low, N)), key=lambda part: walk[part[1]] - walk[part[0]])
    # A few samples at an end are no piece of their own.
    low, high = (0 if low < N / 100 else low), (N if high > 0.99 * N else high)
    share, expected = float(energy[low:high].sum() / energy.sum()), (high - low) / N
    start, end = (recording.start + recording.Ts * k for k in (low, high))
    when = f"between {start:.1f} s and {end:.1f} s"
    when = f"before {end:.1f} s" if low == 0 else f"after {start:.1f} s" if high == N else when
    bins = np.minimum(np.arange(N) * SEGMENTS // N, SEGMENTS - 1)
    edges = recording.start + recording.Ts * N * np.linspace(0, 1, SEGMENTS + 1)
    profile = np.bincount(bins, energy, SEGMENTS) / energy.sum()
    usual = np.bincount(bins, minlength=SEGMENTS) / N
    statement = (
        f"{percent(share)} of the {channel} error lies {when}, which is {percent(expected)} of the recording."
    )
    where = Where(statement, share, p_value, "time", channel, edges, profile, usual, "s")
    return Finding(where, expected)


def in_frequency(channel: str, error: np.ndarray, recording: Recording, unit: str) -> Finding:
    """The band, of all runs of neighbouring ones, that tells most against white noise."""
    N = len(error)
    power = np.abs(np.fft.rfft(error)) ** 2
    weight = np.full(len(power), 2.0)  # squares of a real and an imaginary part
    weight[0] = 1.0
    if N % 2 == 0:
        weight[-1] = 1.0
    f = np.fft.rfftfreq(N, recording.Ts)
    decades = [m * 10.0**k for k in range(-3, 6) for m in OCTAVES]
    inner = [edge for edge in decades if 4 * f[1] <= edge < f[-1]]
    # The first band is the constant part alone.
    edges = np.array([0.0, 0.5 * f[1], *inner, f[-1]])
    band = np.minimum(np.searchsorted(edges, f, side="right") - 1, len(edges) - 2)
    profile = np.bincount(band, weight * power, len(edges) - 1)
    freedom = np.bincount(band, weight, len(edges) - 1)
    profile, usual = profile / profile.sum(), freedom / freedom.sum()
    runs = [(0, 1)] + [(a, b) for a in range(1, len(usual)) for b in range(a + 1, len(usual) + 1)]
    first, last = np.array(runs).T

    def told(shares: np.ndarray) -> np.ndarray:
        ends = np.insert(np.cumsum(shares, axis=-1), 0, 0.0, axis=-1)
        total = np.insert(np.cumsum(usual), 0, 0.0)
        return information(ends[..., last] - ends[..., first], total[last] - total[first])

    noise = np.random.default_rng(0).gamma(freedom / 2, size=(DRAWS, len(freedom)))
    highest = told(noise / noise.sum(axis=1, keepdims=True)).max(axis=1)
    each = told(profile)
    look = int(each.argmax())
    low, high = runs[look]
    share, expected = float(profile[low:high].sum()), float(usual[low:high].sum())
    p_value = (1 + int(np.sum(highest >= each[look]))) / (1 + DRAWS)
    if low == 0:
        offset, read = as_read(float(error.mean()), unit)
        what = f"is a constant offset of {offset:.2g} {read}".rstrip()
    else:
        below, above = f"{edges[low]:g} Hz", f"{edges[high]:.4g} Hz"
        what = f"lies below {above}" if low == 1 else f"lies between {edges[low]:g} and {above}"
        what = f"lies above {below}" if high == len(usual) else what
    statement = (
        f"{percent(share)} of the {channel} error {what}, "
        f"where white sensor noise would have {percent(expected)} of its power."
    )
    where = Where(statement, share, p_value, "frequency", channel, edges, profile, usual, "Hz")
    return Finding(where, expected)


def percent(share: float) -> str:
    """A share for a sentence.

    >>> percent(0.784), percent(0.0042), percent(0.998), percent(1.0)
    ('78 %', '0.4 %', '99.8 %', 'all')
    """
    p = 100 * float(share)
    if p >= 99.5:
        return f"{p:.1f} %" if p < 99.95 else "all"
    return f"{p:.0f} %" if p >= 1 else f"{max(p, 0.1):.1f} %"
