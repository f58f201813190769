"""Constants of the covariance from both sides: what counts as determined, and for how long errors go on."""

import numpy as np
import pytest

from rotflex_jax.fit.inference import (
    Combination,
    RecordingSlopes,
    bandwidth,
    combined_covariance,
    correlation_length,
    curvature,
    estimates,
    nats_that_count,
    sandwich,
)
from rotflex_jax.parameters import Specification

N = 10_000


def spread(J: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Standard deviations of the parameters of slopes (N, D)."""
    parts = [RecordingSlopes(J[:, None], e[:, None], np.arange(J.shape[1]))]
    return np.sqrt(np.diag(sandwich(parts, curvature(parts, J.shape[1]))))


@pytest.mark.parametrize(("relative", "determined"), [(1e-9, True), (3e-11, True), (3e-12, False)])
def test_a_direction_is_determined_down_to_a_curvature(relative: float, determined: bool) -> None:
    """Two columns that differ by a little: the smaller eigenvalue of their correlation is `relative`."""
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.standard_normal((N, 2)))[0]
    angle = 2 * np.arcsin(np.sqrt(relative / 2))  # 1 - cos(angle) = relative
    J = np.column_stack([basis[:, 0], np.cos(angle) * basis[:, 0] + np.sin(angle) * basis[:, 1]])
    assert np.isfinite(spread(J, rng.standard_normal(N))).all() == determined


@pytest.mark.parametrize(("share", "lost"), [(0.01, True), (1e-4, False)])
def test_who_has_a_part_in_what_is_not_determined_has_no_interval(share: float, lost: bool) -> None:
    """The second column is the first and a little of the third: of the three only sums are determined."""
    rng = np.random.default_rng(1)
    a, b = np.linalg.qr(rng.standard_normal((N, 2)))[0].T
    std = spread(np.column_stack([a, a + np.sqrt(2) * share * b, b]), rng.standard_normal(N))
    assert np.isnan(std[:2]).all() and bool(np.isnan(std[2])) is lost


def test_lags_go_as_far_as_the_root_of_the_samples() -> None:
    """A weak correlation that lasts is seen in no single lag of white residuals."""
    white = np.random.default_rng(2).standard_normal((N, 1))
    assert bandwidth(white) == 100
    assert bandwidth(white[:50]) == 5  # a tenth of the samples at most


@pytest.mark.parametrize("D", [1, 5])
def test_nats_of_white_errors_count_each(D: int) -> None:
    rng = np.random.default_rng(3)
    parts = [RecordingSlopes(rng.standard_normal((N, 1, D)), rng.standard_normal((N, 1)), np.arange(D))]
    assert 1.0 <= nats_that_count(parts, curvature(parts, D)) < 1.3


def test_nats_of_errors_that_go_on_count_less() -> None:
    """Of an AR(1) with a constant slope the information counts (1 + a) / (1 - a) times over."""
    rng, a, most = np.random.default_rng(4), 0.8, []
    for _ in range(20):
        w = rng.standard_normal(N)
        e = np.empty(N)
        e[0] = w[0]
        for k in range(1, N):
            e[k] = a * e[k - 1] + w[k]
        parts = [RecordingSlopes(np.ones((N, 1, 1)), e[:, None] / e.std(), np.arange(1))]
        most.append(nats_that_count(parts, curvature(parts, 1)))
    assert np.mean(most) == pytest.approx((1 + a) / (1 - a), rel=0.25)


def test_slopes_or_errors_that_are_no_numbers_determine_nothing() -> None:
    rng = np.random.default_rng(6)
    J, e = rng.standard_normal((2, N, 1))
    for bad_slope, bad_error in ((np.nan, 0.0), (0.0, np.inf), (0.0, np.nan)):
        slopes, errors = J.copy(), e.copy()
        slopes[7] += bad_slope
        errors[7] += bad_error
        assert np.isnan(spread(slopes, errors[:, 0])).all()
    parts = [RecordingSlopes(np.full((N, 1, 1), np.nan), e, np.arange(1))]
    assert nats_that_count(parts, curvature(parts, 1)) == 1.0


@pytest.mark.parametrize("samples", [100_000, 400])
@pytest.mark.parametrize(("share", "length"), [(0.99, 2), (1.01, 4)])
def test_errors_are_correlated_above_a_twentieth_and_above_their_scatter(
    samples: int, share: float, length: int
) -> None:
    """Neighbours whose correlation is that by construction: 0.05, or 2 over the root of the samples."""
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
