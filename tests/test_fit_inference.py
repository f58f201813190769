"""Coverage of intervals for white, correlated and unequal residuals; limits tested from both sides."""

import numpy as np
import pytest
from scipy.signal import lfilter

from rotflex_jax.fit.inference import (
    Combination,
    RecordingSlopes,
    bandwidth,
    by_recording,
    combined_covariance,
    correlation_length,
    curvature,
    estimates,
    nats_that_count,
    sandwich,
)
from rotflex_jax.parameters import Specification

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
    """Repeated least-squares fits: errors of the parameters (RUNS, 3), robust and plain covariances."""
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
    """Share of the runs whose 95 % interval contains the true value, for each parameter."""
    std = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return np.mean(np.abs(errors) < 1.96 * std, axis=0)


def test_white_residuals_give_the_ordinary_formula():
    errors, robust, plain = experiments(lambda rng: rng.normal(size=N))
    # Never less than the ordinary variance, and more only by the scatter of sums over many lags.
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
    """If noise is large where a regressor is, the ordinary interval of its parameter is too narrow."""
    size = 0.1 + regressors()[:, 0, 1] ** 2
    errors, robust, plain = experiments(lambda rng: size * rng.normal(size=N))
    assert coverage(errors, plain)[1] < 0.8
    assert (coverage(errors, robust) > 0.90).all()


def test_recordings_do_not_mix():
    """Products of residuals do not cross recordings; reference: the sums over lags of each, written out."""
    rng = np.random.default_rng(3)
    # The residuals are correlated, so that the lags matter.
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
    """Two recordings with an offset each: the covariance is the same with and without columns of zeros."""
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
    """Standard deviations are proportional to the residuals and inversely proportional to the slopes."""
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


COUNT = 10_000


def spread(J: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Standard deviations of the parameters of slopes (COUNT, D)."""
    parts = [RecordingSlopes(J[:, None], e[:, None], np.arange(J.shape[1]))]
    return np.sqrt(np.diag(sandwich(parts, curvature(parts, J.shape[1]))))


@pytest.mark.parametrize(("relative", "determined"), [(1e-9, True), (1.05e-11, True), (0.95e-11, False)])
def test_a_direction_is_determined_down_to_a_curvature(relative: float, determined: bool) -> None:
    """Two nearly equal columns: the smaller eigenvalue of their correlation matrix is `relative`."""
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.standard_normal((COUNT, 2)))[0]
    angle = 2 * np.arcsin(np.sqrt(relative / 2))  # 1 - cos(angle) = relative
    J = np.column_stack([basis[:, 0], np.cos(angle) * basis[:, 0] + np.sin(angle) * basis[:, 1]])
    assert np.isfinite(spread(J, rng.standard_normal(COUNT))).all() == determined


@pytest.mark.parametrize(("share", "lost"), [(1.05e-3, True), (0.95e-3, False)])
def test_who_has_a_part_in_what_is_not_determined_has_no_interval(share: float, lost: bool) -> None:
    """The second column is the first plus `sqrt(2) share` of the third, so one direction is undetermined."""
    rng = np.random.default_rng(1)
    a, b = np.linalg.qr(rng.standard_normal((COUNT, 2)))[0].T
    std = spread(np.column_stack([a, a + np.sqrt(2) * share * b, b]), rng.standard_normal(COUNT))
    assert np.isnan(std[:2]).all() and bool(np.isnan(std[2])) is lost


def test_lags_go_as_far_as_the_root_of_the_samples() -> None:
    """A weak but long correlation is not visible in single lags, so sqrt(N) lags are used in any case."""
    white = np.random.default_rng(2).standard_normal((COUNT, 1))
    assert bandwidth(white) == 100
    assert bandwidth(white[:50]) == 5  # a tenth of the samples at most


@pytest.mark.parametrize("D", [1, 5])
def test_nats_of_white_errors_count_each(D: int) -> None:
    rng = np.random.default_rng(3)
    parts = [
        RecordingSlopes(rng.standard_normal((COUNT, 1, D)), rng.standard_normal((COUNT, 1)), np.arange(D))
    ]
    assert 1.0 <= nats_that_count(parts, curvature(parts, D)) < 1.3


def test_nats_of_errors_that_go_on_count_less() -> None:
    """With AR(1) errors and a constant slope, (1 + a) / (1 - a) nats count as one of white errors."""
    rng, a, most = np.random.default_rng(4), 0.8, []
    for _ in range(20):
        w = rng.standard_normal(COUNT)
        e = np.empty(COUNT)
        e[0] = w[0]
        for k in range(1, COUNT):
            e[k] = a * e[k - 1] + w[k]
        parts = [RecordingSlopes(np.ones((COUNT, 1, 1)), e[:, None] / e.std(), np.arange(1))]
        most.append(nats_that_count(parts, curvature(parts, 1)))
    assert np.mean(most) == pytest.approx((1 + a) / (1 - a), rel=0.25)


def test_slopes_or_errors_that_are_no_numbers_determine_nothing() -> None:
    rng = np.random.default_rng(6)
    J, e = rng.standard_normal((2, COUNT, 1))
    for bad_slope, bad_error in ((np.nan, 0.0), (0.0, np.inf), (0.0, np.nan)):
        slopes, errors = J.copy(), e.copy()
        slopes[7] += bad_slope
        errors[7] += bad_error
        assert np.isnan(spread(slopes, errors[:, 0])).all()
    parts = [RecordingSlopes(np.full((COUNT, 1, 1), np.nan), e, np.arange(1))]
    assert nats_that_count(parts, curvature(parts, 1)) == 1.0


@pytest.mark.parametrize("samples", [100_000, 400])
@pytest.mark.parametrize(("share", "length"), [(0.99, 2), (1.01, 4)])
def test_errors_are_correlated_above_a_twentieth_and_above_their_scatter(
    samples: int, share: float, length: int
) -> None:
    """Residuals with a correlation at lag one that is 1 % below or above the limit, by construction.

    The limit is the larger one of 0.05 and 2 / sqrt(N).
    """
    limit, w = max(0.05, 2 / np.sqrt(samples)), np.random.default_rng(7).standard_normal(samples)

    def neighbours(part: float) -> tuple[np.ndarray, float]:
        e = w + part * np.roll(w, 1)
        e -= e.mean()
        return e, float(e[1:] @ e[:-1] / (e @ e))

    low, high = -0.5, 0.5
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if neighbours(middle)[1] < share * limit else (low, middle)
    assert correlation_length(neighbours(low)[0][:, None]) == length


def test_a_parameter_is_a_weighted_sum_of_what_was_fitted() -> None:
    A = np.random.default_rng(8).standard_normal((3, 3)) * 1e-3
    covariance = A @ A.T
    sums = [Combination([0, 2], np.array([1.0, -2.0])), Combination([1], np.array([3.0]))]
    W = np.array([[1.0, 0.0, -2.0], [0.0, 3.0, 0.0]])
    np.testing.assert_allclose(combined_covariance(covariance, sums), W @ covariance @ W.T)
    spec = Specification("N m", 0.01)
    first, held = estimates(["a", "b"], np.array([1.0, 2.0]), [spec] * 2, [sums[0], None], covariance)
    assert first.std == pytest.approx(np.sqrt((W @ covariance @ W.T)[0, 0]))
    assert (held.value, held.free) == (2.0, False) and np.isnan(held.std)


def test_an_offset_of_residuals_is_no_correlation() -> None:
    white = np.random.default_rng(9).standard_normal((COUNT, 1))
    assert correlation_length(white + 5.0) == correlation_length(white) <= 4


def test_what_lies_beyond_one_small_value_is_noise() -> None:
    """Autocorrelation is large at lags 1 and 3 and small at lag 2, so lag 3 does not count."""
    w = np.random.default_rng(10).standard_normal(100_000)
    e = lfilter([1.0, 0.2, 0.0, 0.2], [1.0], w)
    r = np.array([e[k:] @ e[: len(e) - k] for k in range(5)]) / (e @ e)
    assert r[1] > 0.1 > 0.05 > r[2] and r[3] > 0.1 and abs(r[4]) < 0.05
    assert correlation_length(e[:, None]) == 4  # twice the two samples of lags 0 and 1


def test_one_residual_more_than_parameters_has_the_textbook_variance() -> None:
    """`s^2 inv(J'J)` with `s^2 = e'e / (n - 4)`, here of five residuals of one size."""
    e = 0.3 * np.array([1.0, -1.0, 1.0, -1.0, 1.0])
    J = np.linalg.svd(e[:, None])[0][:, 1:]  # orthonormal, and orthogonal to the residuals
    variance = robust_covariance(J[:, None], e[:, None], np.zeros(5, int))
    np.testing.assert_allclose(variance, e @ e * np.eye(4), atol=1e-12)


@pytest.mark.parametrize("N", range(1, 20))
def test_few_residuals_are_taken_for_uncorrelated(N: int) -> None:
    e = np.random.default_rng(N).normal(size=(N, 2))
    assert correlation_length(e) == correlation_length(np.zeros((N, 2))) == 1
    H = np.eye(1)
    assert np.isfinite(sandwich(by_recording(np.ones((N, 2, 1)), e, np.zeros(N)), N * H)).all()
