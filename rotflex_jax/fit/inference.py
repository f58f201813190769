"""Covariances and intervals of estimates from residuals that may be correlated in time."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Real

from rotflex_jax.parameters import Estimate, Specification

# Relative curvature below which a combination of parameters counts as not determined.
UNDETERMINED_CURVATURE = 1e-11


def correlation_length(e: Float[np.ndarray, "N C"]) -> int:
    """Number of samples after which the autocorrelation of residuals stays small; from 1 to N / 10."""
    N = len(e)
    if N < 20:
        return 1  # N / 10 is less than 2
    longest = 1
    for column in (e - e.mean(axis=0)).T:
        spectrum = np.abs(np.fft.rfft(column, 2 * N)) ** 2
        r = np.fft.irfft(spectrum)[: N // 10 + 1]
        if r[0] <= 0:
            continue
        large = np.flatnonzero(np.abs(r / r[0]) > max(0.05, 2 / np.sqrt(N)))
        # Large values after the first gap are noise of the estimated autocorrelation.
        gaps = np.flatnonzero(np.diff(large) > 1)
        last = large[gaps[0]] if len(gaps) else large[-1]
        longest = max(longest, int(last) + 1)
    return min(2 * longest, N // 10)


def bandwidth(e: Float[np.ndarray, "N C"]) -> int:
    """Number of lags in the sum of a sandwich: as far as residuals are visibly correlated, or sqrt(N)."""
    N = len(e)
    # A weak but long correlation is not visible in single lags, but its sum matters.
    return max(correlation_length(e), min(round(np.sqrt(N)), N // 10), 1)


class RecordingSlopes(NamedTuple):
    """Scaled residuals of one recording, their slopes by d of the coordinates, and the columns of these."""

    J: Float[np.ndarray, "N C d"]
    e: Float[np.ndarray, "N C"]
    columns: Int[np.ndarray, " d"]


def by_recording(
    J: Float[np.ndarray, "N C D"], e: Float[np.ndarray, "N C"], segments: Real[np.ndarray, " N"]
) -> list[RecordingSlopes]:
    """Slopes and residuals of each recording, if every recording depends on every parameter.

    Args:
        J: Derivative of the scaled residuals.
        e: Scaled residuals.
        segments: Number of the recording to which each sample belongs.
    """
    every = np.arange(J.shape[2])
    return [RecordingSlopes(J[segments == s], e[segments == s], every) for s in np.unique(segments)]


def curvature(parts: Sequence[RecordingSlopes], size: int) -> Float[np.ndarray, "D D"]:
    """Sum of J'J over all samples, for `size` coordinates; nan if a slope is not finite."""
    if not all(np.isfinite(part.J).all() for part in parts):
        return np.full((size, size), np.nan)
    H = np.zeros((size, size))
    for J, _, columns in parts:
        flat = flattened(J)
        H[np.ix_(columns, columns)] += flat.T @ flat
    return H


def flattened(J: Float[np.ndarray, "N C D"]) -> Float[np.ndarray, "NC D"]:
    """Slopes with samples and channels along one axis, also if there is no coordinate."""
    return J.reshape(J.shape[0] * J.shape[1], J.shape[2])


def long_run_scores(parts: Sequence[RecordingSlopes], size: int) -> Float[np.ndarray, "D D"]:
    """Covariance of the sum of `J_k' e_k` for errors that are correlated in time (Bartlett kernel)."""
    S = np.zeros((size, size))
    for J, e, columns in parts:
        scores = np.einsum("nc,ncd->nd", e, J)
        width, none = bandwidth(e), np.zeros((1, len(columns)))
        # Sums over all stretches of `width` samples give exactly the Bartlett kernel.
        total = np.cumsum(np.concatenate([none, scores, np.repeat(none, width - 1, axis=0)]), axis=0)
        sums = total[1:].copy()
        sums[width:] -= total[1:-width]
        S[np.ix_(columns, columns)] += sums.T @ sums / width
    return S


def nats_that_count(parts: Sequence[RecordingSlopes], H: Float[np.ndarray, "D D"]) -> float:
    """Number of nats of a likelihood that count as one nat with white errors; at least 1.

        trace(H^-1 S) / D

    Errors of an incomplete model are correlated over many samples, so that the likelihood counts the same
    information many times.

    Args:
        parts: Residuals and slopes of the recordings, scaled by the size of the errors.
        H: Their `curvature`.
    """
    if not np.isfinite(H).all():
        return 1.0
    ratios, size = scaled_inverse(H)
    S = long_run_scores(parts, len(H)) / np.outer(size, size)
    return max(1.0, float(np.sum(ratios * S)) / len(H))


def scaled_inverse(
    H: Float[np.ndarray, "D D"],
) -> tuple[Float[np.ndarray, "D D"], Float[np.ndarray, " D"]]:
    """Inverse of a curvature scaled to a unit diagonal, and the scales; zero in undetermined directions."""
    size = np.sqrt(np.maximum(np.diag(H), 1e-300))
    return np.linalg.pinv(H / np.outer(size, size), rcond=UNDETERMINED_CURVATURE, hermitian=True), size


def sandwich(parts: Sequence[RecordingSlopes], H: Float[np.ndarray, "D D"]) -> Float[np.ndarray, "D D"]:
    """Covariance of least-squares estimates, robust to autocorrelation and unequal variance of the residuals.

        H^-1 S H^-1,  H = sum J_k' J_k,  S = sum over lags of Bartlett-weighted products of J_k' e_k

    The formula for white residuals, sigma^2 H^-1, gives intervals that are many times too narrow if the model
    is incomplete. If it is complete, the sum over lags scatters. Where it happens to be small, intervals
    would miss the true value too often. So no combination gets less variance than with white residuals.

    Args:
        parts: Residuals and slopes of the recordings; products do not cross recordings. Each part has only
            the slopes by coordinates on which it depends, so first states of other recordings take no memory
            or time.
        H: Their `curvature`.

    Returns:
        Covariance; nan if the residuals are not finite, and for parameters that the data do not determine.

    Source: Newey and West 1987, Econometrica 55; the larger of two variances: Angrist and Pischke,
    Mostly Harmless Econometrics, 2009, section 8.1.
    """
    size, n = len(H), sum(len(p.e) for p in parts)
    if not (np.isfinite(H).all() and all(np.isfinite(p.e).all() for p in parts)):
        return np.full((size, size), np.nan)
    residual_covariance = sum(p.e.T @ p.e for p in parts) / n
    white, S = np.zeros((size, size)), long_run_scores(parts, size)
    for J, _, columns in parts:
        own = np.ix_(columns, columns)
        white[own] += flattened(J).T @ flattened(residual_covariance @ J)
    # Scaled to a unit diagonal, an eigenvalue at the level of rounding belongs to a direction that the data
    # do not determine. Its parameters get no interval instead of a narrow one.
    scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    undetermined = eigenvalues < UNDETERMINED_CURVATURE
    inverse = (vectors / np.where(undetermined, np.inf, eigenvalues)) @ vectors.T / np.outer(scale, scale)
    robust, plain = (inverse @ M @ inverse * (n / max(n - size, 1)) for M in (S, white))
    covariance = _larger(robust, plain)
    lost = (np.abs(vectors[:, undetermined]) > 1e-3).any(axis=1) | (np.diag(H) <= 0)
    covariance[lost, :] = covariance[:, lost] = np.nan
    return covariance


def _larger(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest covariance that is at least `a` and `b` in every direction that `b` determines.

    The result does not depend on the coordinates in which the two are written.
    """
    size = np.sqrt(np.maximum(np.diag(b), 1e-300))
    d, u = np.linalg.eigh(b / np.outer(size, size))
    u, d = u[:, d > UNDETERMINED_CURVATURE], d[d > UNDETERMINED_CURVATURE]
    root, back = size[:, None] * u * np.sqrt(d), (u / np.sqrt(d)).T / size
    m, v = np.linalg.eigh(back @ a @ back.T)
    turned = root @ v
    return (turned * np.maximum(m, 1.0)) @ turned.T


class Combination(NamedTuple):
    """A parameter as a weighted sum of fitted coordinates, to first order: rows of these, and derivatives."""

    rows: Sequence[int]
    weights: Float[np.ndarray, " k"]


def combined_covariance(
    covariance: Float[np.ndarray, "D D"], combinations: Sequence[Combination]
) -> Float[np.ndarray, "P P"]:
    """Covariance of parameters that are combinations of fitted coordinates."""
    return np.array(
        [[a @ covariance[np.ix_(i, k)] @ b for k, b in combinations] for i, a in combinations]
    ).reshape(len(combinations), len(combinations))


def estimates(
    names: Sequence[str],
    values: Float[np.ndarray, " P"],
    specifications: Sequence[Specification],
    combinations: Sequence[Combination | None],
    covariance: Float[np.ndarray, "D D"],
    notes: Sequence[str] | None = None,
) -> tuple[Estimate, ...]:
    """Estimates with 95 % intervals from the covariance of fitted coordinates.

        var p = w' covariance w,   w = dp / d coordinates

    Args:
        names: Full names.
        values: Estimated values [declared units].
        specifications: Declared specification of each parameter.
        combinations: Each parameter as a combination of fitted coordinates; None for a parameter that was
            held.
        covariance: Covariance of the fitted coordinates; nan where the data do not determine them.
        notes: A note on each parameter; none if None.
    """
    found = []
    for name, value, spec, combination, note in zip(
        names, values.tolist(), specifications, combinations, notes or [""] * len(names), strict=True
    ):
        if combination is None:
            nan = float("nan")
            found.append(Estimate(name, value, nan, (nan, nan), spec.unit, free=False, note=note))
            continue
        rows, weights = combination
        variance = weights @ covariance[np.ix_(rows, rows)] @ weights
        found.append(Estimate.of(name, value, float(np.sqrt(np.maximum(variance, 0.0))), spec, note))
    return tuple(found)
