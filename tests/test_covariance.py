"""Intervals that keep their promise: white residuals, correlated ones, unequal ones."""

import numpy as np
import pytest
from scipy.signal import lfilter

from rotflex_jax.fit.inference import (
    RecordingSlopes,
    bandwidth,
    by_recording,
    correlation_length,
    curvature,
    sandwich,
)

N, RUNS = 1000, 600


def robust_covariance(J: np.ndarray, e: np.ndarray, segments: np.ndarray) -> np.ndarray:
    parts = by_recording(J, e, segments)
    return sandwich(parts, curvature(parts, J.shape[2]))


def regressors(seed: int = 0) -> np.ndarray:
    """A constant and two slow signals (N, 1, 3)."""
    rng = np.random.default_rng(seed)
    slow = lfilter([1.0], [1.0, -0.95], rng.normal(size=(2, N)), axis=1)
    slow /= slow.std(axis=1, keepdims=True)
    return np.column_stack([np.ones(N), slow[0], slow[1]])[:, None, :]


def experiments(noise):
    """Least squares of known numbers, many times: errors (RUNS, 3) and both covariances."""
    X = regressors()
    H = np.linalg.inv(X[:, 0].T @ X[:, 0])
    rng = np.random.default_rng(1)
    errors, robust, plain = [], [], []
    for _ in range(RUNS):
        e = noise(rng)
        b = H @ X[:, 0].T @ e
        left = (e - X[:, 0] @ b)[:, None]
        errors.append(b)
        robust.append(robust_covariance(-X, left, np.zeros(N, int)))
        plain.append(H * np.sum(left**2) / (N - 3))
    return np.array(errors), np.array(robust), np.array(plain)


def coverage(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """How often the 95 % interval holds the truth, per parameter."""
    std = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return np.mean(np.abs(errors) < 1.96 * std, axis=0)


def test_white_residuals_give_the_ordinary_formula():
    errors, robust, plain = experiments(lambda rng: rng.normal(size=N))
    # Never less than the ordinary one, and more only by the scatter of sums over many lags.
    assert (np.diagonal(robust, axis1=1, axis2=2) >= 0.999 * np.diagonal(plain, axis1=1, axis2=2)).all()
    np.testing.assert_allclose(np.diagonal(robust.mean(axis=0)), np.diagonal(plain.mean(axis=0)), rtol=0.15)
    np.testing.assert_allclose(np.diagonal(robust.mean(axis=0)), errors.var(axis=0), rtol=0.2)
    np.testing.assert_allclose(coverage(errors, robust), 0.95, atol=0.03)


def test_correlated_residuals_keep_their_coverage():
    def noise(rng):
        return lfilter([1.0], [1.0, -0.8], rng.normal(size=N + 100))[100:]

    errors, robust, plain = experiments(noise)
    # Sums of an autoregression have (1 + a) / (1 - a) = 9 times the variance of white noise.
    assert coverage(errors, plain)[0] == pytest.approx(0.487, abs=0.06)
    assert (coverage(errors, plain) < 0.65).all()
    assert (coverage(errors, robust) > 0.88).all() and (coverage(errors, robust) < 0.98).all()
    np.testing.assert_allclose(np.diagonal(robust.mean(axis=0)), errors.var(axis=0), rtol=0.3)


def test_unequal_residuals_keep_their_coverage():
    """Noise that is large where the regressor is: the ordinary formula is too sure of that one."""
    size = 0.1 + regressors()[:, 0, 1] ** 2
    errors, robust, plain = experiments(lambda rng: size * rng.normal(size=N))
    assert coverage(errors, plain)[1] < 0.8
    assert (coverage(errors, robust) > 0.90).all()


def test_recordings_do_not_mix():
    """A drift from one recording to the next is no correlation within either."""
    rng = np.random.default_rng(3)
    # Correlated, so that the lags count.
    e = np.concatenate([lfilter([1.0], [1.0, -0.6], rng.normal(size=(n, 1)), axis=0) for n in (400, 600)])
    J = np.ones((1000, 1, 1))
    whole = robust_covariance(J, e, np.zeros(1000, int))
    parts = robust_covariance(J, e, np.repeat([0, 1], [400, 600]))
    by_hand = 0.0
    for start, end in ((0, 400), (400, 1000)):
        g, width = e[start:end, 0], bandwidth(e[start:end])
        lags = np.arange(1, width)
        products = np.array([g[k:] @ g[:-k] for k in lags]) if width > 1 else np.zeros(0)
        by_hand += g @ g + 2 * np.sum((1 - lags / width) * products)
    by_hand *= (1000 / 999) / 1000**2
    np.testing.assert_allclose(parts[0, 0], by_hand, rtol=1e-10)
    assert whole[0, 0] != parts[0, 0]


def test_what_a_recording_does_not_move_need_not_be_there():
    """Two recordings with an offset of their own each: the same with and without the columns of zeros."""
    rng = np.random.default_rng(8)
    segments = np.repeat([0, 1], [400, 600])
    slope, e = rng.normal(size=(1000, 2, 1)), rng.normal(size=(1000, 2))
    offsets = np.broadcast_to((segments[:, None] == [0, 1])[:, None, :], (1000, 2, 2))
    J = np.concatenate([slope, offsets], axis=2)
    own = [
        RecordingSlopes(J[segments == k][:, :, [0, 1 + k]], e[segments == k], np.array([0, 1 + k]))
        for k in (0, 1)
    ]
    covariance = sandwich(own, curvature(own, 3))
    np.testing.assert_allclose(covariance, robust_covariance(J, e, segments), rtol=1e-10, atol=1e-18)


def test_two_channels_may_be_correlated():
    """Residuals that are the same in both channels count once, not twice."""
    rng = np.random.default_rng(4)
    e = rng.normal(size=(4000, 1))
    J = np.ones((4000, 1, 1))
    once = robust_covariance(J, e, np.zeros(4000, int))
    twice = robust_covariance(np.tile(J, (1, 2, 1)), np.tile(e, (1, 2)), np.zeros(4000, int))
    np.testing.assert_allclose(twice, once, rtol=1e-10)


def test_scale_of_residuals_and_slopes():
    """Standard deviations follow the size of the residuals and the inverse of the slopes."""
    rng = np.random.default_rng(5)
    J, e = rng.normal(size=(500, 2, 3)), rng.normal(size=(500, 2))
    one, zeros = robust_covariance(J, e, np.zeros(500, int)), np.zeros(500, int)
    np.testing.assert_allclose(robust_covariance(J, 3 * e, zeros), 9 * one, rtol=1e-10)
    units = np.array([1.0, 0.05, 20.0])
    np.testing.assert_allclose(
        robust_covariance(J * units, e, zeros), one / np.outer(units, units), rtol=1e-8
    )


@pytest.mark.parametrize("a", [0.5, 0.9])
def test_correlation_length_grows_with_the_correlation(a):
    rng = np.random.default_rng(6)
    e = lfilter([1.0], [1.0, -a], rng.normal(size=(20000, 1)), axis=0)
    reach = np.log(0.05) / np.log(a)  # where the autocorrelation a^k falls below 0.05
    assert 1.4 * reach < correlation_length(e) < 3.5 * reach


def test_correlation_length_of_white_noise_and_of_nothing():
    e = np.random.default_rng(7).normal(size=(5000, 2))
    assert correlation_length(e) <= 4
    assert correlation_length(np.zeros((100, 2))) == 2
    drift = np.linspace(-1, 1, 500)[:, None]
    assert correlation_length(drift) == 50  # never more than a tenth of the recording
    assert correlation_length(1e-9 * drift) == 50  # whatever its unit
    assert correlation_length(drift[:15]) == bandwidth(drift[:15]) == 1
    assert correlation_length(drift[:5]) == bandwidth(drift[:5]) == 1
