"""Tests whether residuals are white and independent of the input; frequency responses with coherence."""

import dataclasses

import numpy as np
import scipy
from jaxtyping import Bool, Complex, Float, Int, Real

from rotflex_jax.errors import InputError

# Least number of stretches that are averaged; each overlaps the next by half.
LEAST_STRETCHES = 7
# Longest stretch [s]: a finer frequency resolution is of no use for a joint.
LONGEST_STRETCH = 8.0
# Largest number of frequencies in a decade; closer frequencies are averaged.
BINS_PER_DECADE = 24


@dataclasses.dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """Response of outputs to an input, from their spectra.

    Attributes:
        frequency: Frequencies [Hz].
        response: Response of each channel [unit of the output / unit of the input].
        coherence: Coherence of each channel, 0 to 1: the share of the output's power that follows the input
            linearly.
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
        """Phase between -180 and 180 [deg]."""
        return np.rad2deg(np.angle(self.response))


def frequency_response(u: Real[np.ndarray, " N"], y: Real[np.ndarray, "N C"], Ts: float) -> FrequencyResponse:
    """Response of outputs to an input: quotient of the cross spectrum and the spectrum of the input.

        H(f) = S_uy(f) / S_uu(f),    coherence = |S_uy|^2 / (S_uu S_yy)

    Both are means over stretches of the recording with a Hann window, after a linear trend is removed from
    each stretch, and over neighbouring frequencies where a decade has many of them. The same estimate of a
    simulated run has the same leakage, so that the two can be compared frequency by frequency.

    Under feedback the input depends on the noise, and the estimate is a biased response of the machine. The
    fair comparison is then a simulated run that is driven by the same input.

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
    f, of_input = scipy.signal.welch(drive, **options)
    cross = np.stack([scipy.signal.csd(drive, x, **options)[1] for x in outputs])
    own = np.stack([scipy.signal.welch(x, **options)[1] for x in outputs])
    starts = _bins(f[1:])
    count = np.diff([*starts, len(f) - 1])
    f = np.add.reduceat(f[1:], starts) / count
    of_input, cross, own = (np.add.reduceat(s[..., 1:], starts, axis=-1) for s in (of_input, cross, own))
    floor = np.finfo(float).tiny
    coherence = np.abs(cross) ** 2 / np.maximum(of_input * own, floor)
    return FrequencyResponse(f, cross / np.maximum(of_input, floor), np.minimum(coherence, 1.0))


def _bins(f: Float[np.ndarray, " L"]) -> Int[np.ndarray, " F"]:
    """Index of the first frequency of each bin: low bins are single frequencies, others part of a decade."""
    part = np.floor(BINS_PER_DECADE * np.log10(f / f[0]) + 1e-9)
    return np.flatnonzero(np.diff(part, prepend=-1.0))


# Quantile of the normal distribution for a two-sided probability of 99 %.
QUANTILE_99 = 2.5758293035489004


@dataclasses.dataclass(frozen=True, eq=False)
class ResidualTests:
    """Correlations of residuals with themselves and with the input, each with its 99 % band.

    Attributes:
        channels: Outputs, in order.
        Ts: Sampling period [s].
        lags: Lags of the autocorrelation, from 0 [samples].
        autocorrelation: Autocorrelation of each residual at each lag, 1 at lag 0 [-].
        white_band: Half width of the band in which a white residual stays at 99 of 100 lags [-].
        input_lags: Delay of the residual after the input; negative lags show feedback [samples].
        cross_correlation: Correlation of each residual with the input [-].
        input_band: For each channel, half width of the band in which a residual that is independent of the
            input stays at 99 of 100 lags [-].
    """

    channels: tuple[str, ...]
    Ts: float
    lags: Int[np.ndarray, " K"]
    autocorrelation: Float[np.ndarray, "C K"]
    white_band: float
    input_lags: Int[np.ndarray, " M"]
    cross_correlation: Float[np.ndarray, "C M"]
    input_band: Float[np.ndarray, " C"]

    @property
    def outside_white(self) -> Bool[np.ndarray, "C K"]:
        """Whether a residual is outside of its white band, at each lag; False at lag 0."""
        return (np.abs(self.autocorrelation) > self.white_band) & (self.lags > 0)

    @property
    def outside_input(self) -> Bool[np.ndarray, "C M"]:
        """Whether a residual depends on the input (outside of its band), at each lag."""
        return np.abs(self.cross_correlation) > self.input_band[:, None]

    def sentences(self) -> list[str]:
        """One sentence for each channel.

        >>> e = np.random.default_rng(0).standard_normal((2000, 1))
        >>> residual_tests(e, np.random.default_rng(1).standard_normal(2000), 0.01, ["theta"]).sentences()
        ['theta: 0 of 25 lags of the autocorrelation and 1 of 26 of the correlation with the past input lie \
outside of their 99 % bands.']
        """
        past = self.input_lags >= 0
        return [
            f"{channel}: {white.sum()} of {len(self.lags) - 1} lags of the autocorrelation and "
            f"{follows[past].sum()} of {past.sum()} of the correlation with the past input lie outside of "
            "their 99 % bands."
            for channel, white, follows in zip(
                self.channels, self.outside_white, self.outside_input, strict=True
            )
        ]


def residual_tests(
    residual: Real[np.ndarray, "N C"],
    u: Real[np.ndarray, " N"],
    Ts: float,
    channels: tuple[str, ...] | list[str],
    most: int = 25,
) -> ResidualTests:
    """Autocorrelation of residuals, and their correlation with the input.

        r_e(k) = sum_t e(t) e(t + k) / sum_t e(t)^2
        r_ue(k) = sum_t u(t) e(t + k) / sqrt(sum_t u(t)^2 sum_t e(t)^2)

    with means removed. For white residuals r_e has the standard deviation 1 / sqrt(N). For residuals that are
    independent of the input, r_ue has the standard deviation sqrt(sum_k r_e(k) r_u(k) / N), whatever their
    spectra.

    Negative lags allow no conclusion on the physics: under feedback the input depends on past residuals.

    Args:
        residual: Measured less modelled outputs [unit of the channel].
        u: Input [unit of the input].
        Ts: Sampling period [s].
        channels: Names of the outputs.
        most: Largest lag [samples].

    Returns:
        Both correlations with their bands.

    Raises:
        InputError: There are fewer than `2 most + 2` samples.

    Source:
        T. Soderstrom, P. Stoica, System Identification, Prentice Hall, 1989, section 11.2.
    """
    N, least = len(u), 2 * most + 2
    if least > N:
        raise InputError(
            f"The residuals have {N} samples, but correlations up to lag {most} need {least}; give a "
            "longer recording, or a smaller lag."
        )
    e = np.asarray(residual, float) - np.mean(residual, axis=0)
    v = np.asarray(u, float) - np.mean(u)
    lags, both = np.arange(most + 1), np.arange(-most, most + 1)
    # Large lags matter for the band, since slow inputs and slow residuals stay correlated over many lags.
    far = min(N - 1, max(most, N // 4))
    own = np.stack([_correlation(x, x, 0, far) for x in e.T])
    of_input = _correlation(v, v, 0, far)
    # Correlations at large lags come from few samples: weights that fall to zero keep their noise small.
    weight = 2.0 * (1.0 - np.arange(far + 1) / (far + 1))
    weight[0] = 1.0
    variance = np.maximum(own @ (weight * of_input), 1e-12) / N
    return ResidualTests(
        tuple(channels),
        float(Ts),
        lags,
        own[:, : most + 1],
        QUANTILE_99 / float(np.sqrt(N)),
        both,
        np.stack([_correlation(v, x, -most, most) for x in e.T]),
        QUANTILE_99 * np.sqrt(variance),
    )


def _correlation(
    a: Float[np.ndarray, " N"], b: Float[np.ndarray, " N"], first: int, last: int
) -> Float[np.ndarray, " L"]:
    """Normalised sums of a(t) b(t + k) for k from the first to the last lag; zeros if a signal is zero."""
    N = len(a)
    size = 1 << (2 * N - 1).bit_length()
    sums = np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size)
    scale = float(np.sqrt((a @ a) * (b @ b)))
    picked = sums[np.arange(first, last + 1) % size]
    return picked / scale if scale > 0 else np.zeros_like(picked)
