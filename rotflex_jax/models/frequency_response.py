"""Frequency response of data, measured or simulated, with its coherence."""

import dataclasses

import numpy as np
from jaxtyping import Complex, Float, Int, Real
from scipy.signal import csd, welch

# Stretches that are averaged, at least, half of each shared with the next.
LEAST_STRETCHES = 7
# A stretch is no longer than this [s]: lines that are closer say nothing of a joint.
LONGEST_STRETCH = 8.0
# Frequencies closer than this many to a decade are taken together.
BINS_PER_DECADE = 24


@dataclasses.dataclass(frozen=True)
class FrequencyResponse:
    """Response of outputs to an input, from their spectra.

    Attributes:
        frequency: [Hz].
        response: By channel [unit of the output / unit of the input].
        coherence: By channel, 0 to 1: the share of the output's power that follows the input linearly.
    """

    frequency: Float[np.ndarray, " F"]
    response: Complex[np.ndarray, "C F"]
    coherence: Float[np.ndarray, "C F"]

    @property
    def magnitude_db(self) -> Float[np.ndarray, "C F"]:
        """20 log10 of the magnitude [dB]."""
        return 20.0 * np.log10(np.maximum(np.abs(self.response), np.finfo(float).tiny))

    @property
    def phase_deg(self) -> Float[np.ndarray, "C F"]:
        """Phase, within half a turn [deg]."""
        return np.rad2deg(np.angle(self.response))


def frequency_response(u: Real[np.ndarray, " N"], y: Real[np.ndarray, "N C"], Ts: float) -> FrequencyResponse:
    """Response of outputs to an input: quotient of the cross spectrum and the spectrum of the input.

        H(f) = S_uy(f) / S_uu(f),    coherence = |S_uy|^2 / (S_uu S_yy)

    Both are means over stretches of the recording under a Hann window, trends taken out of each, and over
    neighbouring frequencies where they are many to a decade. The same estimate of a simulated run has
    the same leakage, so that the two can be compared frequency by frequency.

    Not an unbiased response of the machine under feedback, where the input follows the noise; there the
    simulated run, which the same input drives, is the fair comparison.

    Args:
        u: Input [unit of the input].
        y: Outputs [unit of the channel].
        Ts: Sampling period [s].

    Returns:
        Response and coherence, without frequency zero.
    """
    N = len(u)
    length = max(16, min(2 * N // (LEAST_STRETCHES + 1), round(LONGEST_STRETCH / Ts)))
    options = {"fs": 1.0 / Ts, "nperseg": min(length, N), "detrend": "linear"}
    outputs, drive = np.asarray(y, float).T, np.asarray(u, float)
    f, of_input = welch(drive, **options)
    cross = np.stack([csd(drive, x, **options)[1] for x in outputs])
    own = np.stack([welch(x, **options)[1] for x in outputs])
    starts = _bins(f[1:])
    count = np.diff([*starts, len(f) - 1])
    f = np.add.reduceat(f[1:], starts) / count
    of_input, cross, own = (np.add.reduceat(s[..., 1:], starts, axis=-1) for s in (of_input, cross, own))
    floor = np.finfo(float).tiny
    coherence = np.abs(cross) ** 2 / np.maximum(of_input * own, floor)
    return FrequencyResponse(f, cross / np.maximum(of_input, floor), np.minimum(coherence, 1.0))


def _bins(f: Float[np.ndarray, " L"]) -> Int[np.ndarray, " F"]:
    """Index of the first frequency of each bin; bins are single frequencies, then parts of a decade."""
    part = np.floor(BINS_PER_DECADE * np.log10(f / f[0]) + 1e-9)
    return np.flatnonzero(np.diff(part, prepend=-1.0))
