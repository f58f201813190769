"""Tests of residuals: are they white, and do they depend on the input."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int, Real

from rotflex_jax.errors import InputError

# Quantile of the normal distribution that leaves 1 % on both sides together.
QUANTILE_99 = 2.5758293035489004


@dataclasses.dataclass(frozen=True)
class ResidualTests:
    """Correlations of residuals with themselves and with the input, each with its 99 % band.

    Attributes:
        channels: Outputs, in order.
        Ts: Sampling period [s].
        lags: From 0 [samples].
        autocorrelation: Of each channel at each lag, 1 at lag 0 [-].
        white_band: A white residual stays within plus and minus this in 99 of 100 lags [-].
        input_lags: The residual comes so much after the input; negative ones show feedback [samples].
        cross_correlation: Of each channel with the input [-].
        input_band: A residual that is independent of the input stays within plus and minus this in 99 of 100
            lags, by channel [-].
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
        """Lags at which a residual is not white; lag 0 is none."""
        return (np.abs(self.autocorrelation) > self.white_band) & (self.lags > 0)

    @property
    def outside_input(self) -> Bool[np.ndarray, "C M"]:
        """Lags at which a residual follows the input."""
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

    with means removed. For white residuals r_e has the standard deviation 1 / sqrt(N); for residuals that
    are independent of the input, r_ue has sqrt(sum_k r_e(k) r_u(k) / N), whatever their spectra.

    Not for a conclusion on physics at negative lags: under feedback the input follows the past residual.

    Args:
        residual: Measured less modelled [unit of the channel].
        u: Input [unit of the input].
        Ts: Sampling period [s].
        channels: Names of the outputs.
        most: Largest lag [samples].

    Returns:
        Both correlations with their bands.

    Raises:
        InputError: Fewer than twice as many samples as lags.

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
    # Far lags matter for the band, since slow inputs and slow residuals look alike for long.
    far = min(N - 1, max(most, N // 4))
    own = np.stack([_correlation(x, x, 0, far) for x in e.T])
    of_input = _correlation(v, v, 0, far)
    # Products at far lags are of few samples: weights that fall to zero keep the sum from being noise.
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
    """Normalised sums of a(t) b(t + k), for k from the first to the last lag; zeros where a signal rests."""
    N = len(a)
    size = 1 << (2 * N - 1).bit_length()
    sums = np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size)
    scale = float(np.sqrt((a @ a) * (b @ b)))
    picked = sums[np.arange(first, last + 1) % size]
    return picked / scale if scale > 0 else np.zeros_like(picked)
