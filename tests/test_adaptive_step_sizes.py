"""Bounds, misadjustment and settling of LMS against direct computation, published values and long runs."""

import numpy as np
import pytest
from gaussian_rule import gauss_hermite, monomials

from rotflex_jax.adaptive import LMS, run
from rotflex_jax.adaptive.learning_curve import (
    learning_curve,
    settling_factor,
    settling_samples,
    settling_step_size,
)
from rotflex_jax.adaptive.moments import Moments, ar1_covariance
from rotflex_jax.adaptive.step_sizes import MeanSquare, analyse, mean_bound, mean_square_bound
from rotflex_jax.basis import Delays, Volterra
from rotflex_jax.errors import InputError

WHITE = Moments.gaussian(np.eye(5))
BASIS = Volterra(Delays(5))
LINEAR, QUADRATIC = BASIS.degrees == 1, BASIS.degrees == 2


def by_degree(mu1: float, mu2: float) -> np.ndarray:
    return BASIS.step_sizes({0: mu1, 1: mu1, 2: mu2})


def radius_by_brute_force(a: float, columns: np.ndarray, mu: float) -> float:
    """Spectral radius of C -> E[(I - mu x x') C (I - mu x x')] as a matrix over all entries of C."""
    z, p = gauss_hermite(ar1_covariance(a, 5), 5)
    x = monomials(z)[:, columns]
    P = x.shape[1]
    # vec of (I - mu xx') C (I - mu xx'), with the products of four x as one sum over the nodes
    pairs = (x[:, :, None] * x[:, None, :]).reshape(len(x), -1)
    fourth = (pairs.T * p) @ pairs
    fourth = fourth.reshape(P, P, P, P).transpose(0, 2, 1, 3).reshape(P * P, P * P)
    R, eye = x.T @ (p[:, None] * x), np.eye(P)
    T = np.eye(P * P) - mu * (np.kron(R, eye) + np.kron(eye, R)) + mu**2 * fourth
    return float(np.max(np.abs(np.linalg.eigvals(T))))


@pytest.mark.parametrize("memory", [1, 5, 9])
def test_white_linear_bounds_are_the_textbook_ones(memory: int) -> None:
    moments = Moments.gaussian(np.eye(memory), (1,))
    assert mean_bound(moments) == pytest.approx(2.0)
    assert mean_square_bound(moments) == pytest.approx(2 / (memory + 2), rel=1e-10)


def test_white_quadratic_mean_bound() -> None:
    assert mean_bound(Moments.gaussian(np.eye(5), (2,))) == pytest.approx(2 / 7)


@pytest.mark.parametrize(
    ("a", "linear", "quadratic", "both"),
    [
        (0.0, 0.285, 0.0276, 0.0255),
        (0.2846, 0.270, 0.0224, 0.0211),
        (0.5335, 0.232, 0.0137, 0.0131),
        (0.7304, 0.190, 0.0082, 0.0080),
        (0.9391, 0.144, 0.0044, 0.0044),
    ],
)
def test_mean_square_bounds_of_coloured_inputs(
    a: float, linear: float, quadratic: float, both: float
) -> None:
    R1 = ar1_covariance(a, 5)
    # The reference is rounded, so half of its last digit is added to the tolerance of 3 %.
    for degrees, expected in (((1,), linear), ((2,), quadratic), ((0, 1, 2), both)):
        rounding = 0.0005 if expected > 0.1 else 0.00005
        found = mean_square_bound(Moments.gaussian(R1, degrees))
        assert abs(found - expected) < 0.03 * expected + rounding


@pytest.mark.parametrize("a", [0.0, 0.5335, 0.9391])
def test_bound_is_where_the_spectral_radius_crosses_one(a: float) -> None:
    bound = mean_square_bound(Moments.gaussian(ar1_covariance(a, 5), (2,)))
    columns = np.arange(6, 21)
    assert (
        radius_by_brute_force(a, columns, 0.998 * bound)
        < 1
        < radius_by_brute_force(a, columns, 1.002 * bound)
    )
    exact = MeanSquare(Moments.gaussian(ar1_covariance(a, 5), (2,)), np.full(15, 0.5 * bound))
    assert exact.radius() == pytest.approx(radius_by_brute_force(a, columns, 0.5 * bound), rel=1e-9)


def test_rule_of_thumb_is_unsafe_for_coloured_squares() -> None:
    moments = Moments.gaussian(ar1_covariance(0.9391, 5), (2,))
    assert 2 / (3 * np.trace(moments.R)) > 3 * mean_square_bound(moments)


def test_full_layout_has_the_bound_of_the_triangular_one_with_doubled_products() -> None:
    # Both filters have the same errors and so the same bound, although R of the full layout is singular.
    full = Moments.gaussian(ar1_covariance(0.5, 5), (0, 1, 2), "full")
    triangular = Moments.gaussian(ar1_covariance(0.5, 5))
    doubled = BASIS.step_sizes({0: 1.0, 1: 1.0, 2: 1.0}, as_full=True)
    assert mean_square_bound(full) == pytest.approx(mean_square_bound(triangular, doubled), rel=1e-8)


def test_bound_of_two_step_sizes_lies_between_those_of_each_alone() -> None:
    pair = by_degree(0.05, 0.005)
    factor = mean_square_bound(WHITE, pair)
    assert analyse(WHITE, 0.99 * factor * pair).stable
    assert not analyse(WHITE, 1.01 * factor * pair).stable
    assert analyse(WHITE, factor * pair).radius == pytest.approx(1.0, abs=1e-9)
    alone = [mean_square_bound(WHITE, np.where(mask, pair, 0.0)) for mask in (LINEAR, QUADRATIC)]
    assert factor < min(alone)


def test_large_sets_are_found_by_iteration(monkeypatch: pytest.MonkeyPatch) -> None:
    moments = Moments.gaussian(ar1_covariance(0.5, 4))
    direct = mean_square_bound(moments), MeanSquare(moments, np.full(15, 0.01)).radius()
    monkeypatch.setattr("rotflex_jax.adaptive.step_sizes.MOST_DENSE_PAIRS", 10)
    iterated = mean_square_bound(moments), MeanSquare(moments, np.full(15, 0.01)).radius()
    np.testing.assert_allclose(iterated, direct, rtol=1e-5)


def test_bound_of_a_recording_is_near_the_exact_one() -> None:
    u = np.random.default_rng(0).standard_normal(40_000)
    sampled = Moments.of_regressors(BASIS.regressors(u)[5:])
    assert mean_square_bound(sampled) == pytest.approx(mean_square_bound(WHITE), rel=0.08)


@pytest.mark.parametrize(
    ("mu2", "theory", "tolerance"), [(1e-4, 0.0263, 0.005), (4.3e-4, 0.0304, 0.005), (1e-3, 0.0375, 0.005)]
)
def test_small_step_misadjustment(mu2: float, theory: float, tolerance: float) -> None:
    moments = Moments.gaussian(np.eye(5), (1, 2))
    found = analyse(moments, np.r_[np.full(5, 0.01), np.full(15, mu2)])
    assert found.small_step == pytest.approx(theory, rel=tolerance)
    # Fourth moments increase the misadjustment.
    assert found.small_step < found.misadjustment < 1.15 * found.small_step


def long_run_misadjustment(mu: np.ndarray, independent: bool, seed: int, N: int = 300_000) -> float:
    """Excess mean-square error of LMS from the true weights, which are zero, with noise of variance 1."""
    rng = np.random.default_rng(seed)
    phi = monomials(rng.standard_normal((N, 5))) if independent else BASIS.regressors(rng.standard_normal(N))
    noise = rng.standard_normal(N)
    result = run(LMS(mu), phi, noise)
    assert not result.diverged
    settled = N // 10
    # The noise is known and subtracted, so that its scatter does not enter the excess error.
    return float(np.mean((result.errors - noise)[settled:] ** 2))


def test_misadjustment_of_independent_samples_is_the_exact_one() -> None:
    mu = by_degree(0.03, 3e-3)
    exact = analyse(WHITE, mu)
    measured = long_run_misadjustment(mu, independent=True, seed=1)
    assert measured == pytest.approx(exact.misadjustment, rel=0.05)
    # At these step sizes, the formula for small steps is too low by more than 15 %.
    assert exact.small_step < 0.85 * measured


@pytest.mark.parametrize("mu2", [1e-4, 3e-3])
def test_misadjustment_of_a_delay_line_is_near_it_well_inside_the_bound(mu2: float) -> None:
    mu = by_degree(0.01, mu2)
    measured = long_run_misadjustment(mu, independent=False, seed=2)
    assert analyse(WHITE, mu).factor > 3
    assert measured == pytest.approx(analyse(WHITE, mu).misadjustment, rel=0.15)


def test_a_delay_line_breaks_out_before_the_bound_of_independent_samples() -> None:
    mu = by_degree(0.01, 0.02)
    theory = analyse(WHITE, mu)
    assert 1 < theory.factor < 1.5
    assert long_run_misadjustment(mu, independent=False, seed=3, N=60_000) > 3 * theory.misadjustment


def test_learning_curve_agrees_with_the_average_of_many_runs() -> None:
    rng = np.random.default_rng(3)
    w = rng.standard_normal(21)
    mu = by_degree(0.02, 2e-3)
    times = np.array([0, 20, 100, 400])
    expected = learning_curve(WHITE, mu, w, times, noise=0.1)
    errors, paths = [], []
    for _ in range(400):
        phi = monomials(rng.standard_normal((401, 5)))
        noise = np.sqrt(0.1) * rng.standard_normal(401)
        result = run(LMS(mu), phi, phi @ w + noise, keep_every=20)
        errors.append((result.errors - noise)[times] ** 2)
        paths.append(result.path[times // 20])
    scatter = np.std(errors, axis=0) / 20
    assert np.all(np.abs(np.mean(errors, axis=0) - expected.excess) < 4 * scatter)
    np.testing.assert_allclose(np.mean(paths, axis=0), expected.weights, atol=0.15)
    assert expected.excess[0] == pytest.approx(w @ WHITE.R @ w)


def test_learning_curve_ends_in_the_misadjustment() -> None:
    mu = by_degree(0.01, 1e-3)
    end = learning_curve(WHITE, mu, np.ones(21), np.array([1e6]), noise=2.0)
    assert end.excess[0] == pytest.approx(2.0 * analyse(WHITE, mu).misadjustment, rel=1e-6)
    np.testing.assert_allclose(end.weights[0], 1.0, atol=1e-9)


def test_learning_curve_of_unstable_steps_grows_beyond_bounds() -> None:
    mu = 1.2 * mean_square_bound(WHITE) * np.ones(21)
    curve = learning_curve(WHITE, mu, np.ones(21), np.array([10.0, 1000.0, 100_000.0]), noise=1.0)
    assert curve.excess[1] > 10 * curve.excess[0]
    assert np.isinf(curve.excess[2])


@pytest.mark.parametrize(("eigenvalue", "expected"), [(1, 4.28e-4), (2, 2.14e-4), (7, 6.11e-5)])
def test_step_size_that_settles_after_7000_samples(eigenvalue: float, expected: float) -> None:
    assert settling_step_size(eigenvalue, 7000) == pytest.approx(expected, rel=2e-3)


def test_settling_time_measured_on_a_series_of_the_class_is_the_one_asked_for() -> None:
    # Under a white input, each off-diagonal quadratic weight is a separate mode with eigenvalue 1.
    rng = np.random.default_rng(4)
    w = rng.uniform(0.5, 1.0, 21) * rng.choice([-1.0, 1.0], 21)
    products = np.array([name.count("u[t") == 2 for name in BASIS.names])
    mu = by_degree(0.01, settling_step_size(1.0, 7000))
    times = []
    for _ in range(6):
        phi = BASIS.regressors(rng.standard_normal(12_000))[5:]
        path = run(LMS(mu), phi, phi @ w + 0.01 * rng.standard_normal(len(phi)), keep_every=10)
        left = np.abs(path.path / w - 1)[:, products]
        # the last time that the mean over these weights is outside of 5 %
        times.append(10 * (np.flatnonzero(left.mean(axis=1) > 0.05)[-1] + 1))
    assert np.mean(times) == pytest.approx(7000, rel=0.1)
    assert settling_samples(WHITE, mu, w, int(np.flatnonzero(products)[0])) == pytest.approx(7000, rel=0.001)


@pytest.mark.parametrize("known", [0, 2])
def test_settling_agrees_with_stepping_the_mean(known: int) -> None:
    """Also where the first weights are known and have no step."""
    R1 = ar1_covariance(0.5, 2)
    moments = Moments.gaussian(R1)
    rng = np.random.default_rng(5)
    w, start = rng.standard_normal(6), rng.standard_normal(6)
    mu = np.array([0.05, 0.05, 0.05, 0.02, 0.01, 0.02])
    start[:known], mu[:known] = w[:known], 0.0
    d, outside = start - w, np.zeros(6)
    for k in range(5000):
        outside = np.where(np.abs(d) > 0.05 * np.abs(w), k + 1, outside)
        d = d - mu * (moments.R @ d)
    found = [settling_samples(moments, mu, w, i, start=start) for i in range(6)]
    np.testing.assert_array_equal(found, outside)


def test_a_weight_whose_best_value_is_out_of_reach_never_settles() -> None:
    """Of two equal regressors, LMS from zero finds half of the sum of the weights for each."""
    x = np.random.default_rng(7).standard_normal(500)
    moments, mu = Moments.of_regressors(np.column_stack([x, x])), 0.01
    assert settling_samples(moments, mu, np.array([1.0, 0.8]), 0) == np.inf  # ends 10 % below
    # With equal weights the error falls by 1 - 2 mu mean x^2 with each sample.
    falls = 1 - 2 * mu * np.mean(x**2)
    assert settling_samples(moments, mu, np.ones(2), 0) == np.ceil(np.log(0.05) / np.log(falls))
    # It ends 4 % below 1 here, so that 1 % is left for what decays from 0.96.
    steps = np.ceil(np.log(0.01 / 0.96) / np.log(falls))
    assert settling_samples(moments, mu, np.array([1.0, 0.92]), 0) == steps


def test_a_difference_of_weights_that_no_signal_shows_stays() -> None:
    x = np.random.default_rng(7).standard_normal(500)
    moments, mu, w = Moments.of_regressors(np.column_stack([x, x])), 0.01, np.array([1.0, 0.5])
    start = np.array([2.0, -1.0])
    found = learning_curve(moments, mu, w, np.array([0.0, 50.0, 5000.0]), start=start).weights
    R = np.full((2, 2), np.mean(x**2))
    expected = [w + np.linalg.matrix_power(np.eye(2) - mu * R, t) @ (start - w) for t in (0, 50, 5000)]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(found[2], [2.25, -0.75], atol=1e-9)  # sum of the best, difference of the first


def test_time_of_a_weight_and_bound_of_the_mean_are_those_of_the_mean_recursion() -> None:
    """The mean errors are (I - D R)^t d, whose sum over t is (D R)^-1 d, with D the step sizes."""
    moments = Moments.gaussian(ar1_covariance(0.7, 2))
    mu = np.array([0.03, 0.02, 0.05, 0.004, 0.01, 0.002])
    found, DR = analyse(moments, mu), np.diag(mu) @ moments.R
    np.testing.assert_allclose(found.coefficient_times, np.diag(np.linalg.inv(DR)), rtol=1e-8)
    assert found.mean_factor == pytest.approx(2 / np.max(np.linalg.eigvals(DR).real), rel=1e-9)
    np.testing.assert_allclose(found.time_constants, np.sort(1 / np.linalg.eigvals(DR).real), rtol=1e-8)


def test_settling_factor_puts_a_weight_where_it_was_asked_for() -> None:
    moments = Moments.gaussian(ar1_covariance(0.5, 5))
    w = np.random.default_rng(6).standard_normal(21)
    mu = by_degree(0.01, 1e-3)
    factor = settling_factor(moments, mu, w, 8, 7000, scaled=QUADRATIC)
    found = settling_samples(moments, np.where(QUADRATIC, factor * mu, mu), w, 8)
    assert found == pytest.approx(7000, rel=1e-3)


def test_weights_without_a_step_stay() -> None:
    mu = by_degree(0.0, 1e-3)
    assert settling_samples(WHITE, mu, np.ones(21), 1) == np.inf
    assert analyse(WHITE, mu).coefficient_times[1] == np.inf
    curve = learning_curve(WHITE, mu, np.ones(21), np.array([100.0]))
    np.testing.assert_array_equal(curve.weights[0][BASIS.degrees < 2], 0.0)


def test_the_summary_says_inside_or_outside() -> None:
    assert "inside the mean-square bound by a factor of 1" in str(analyse(WHITE, by_degree(0.01, 1e-3)))
    assert "may still run away" in str(analyse(WHITE, 0.6 * mean_square_bound(WHITE)))
    outside = analyse(WHITE, 2 * mean_square_bound(WHITE))
    assert "outside the mean-square bound: 2 times" in str(outside)
    assert outside.misadjustment == np.inf


@pytest.mark.parametrize(
    ("call", "phrase"),
    [
        (lambda: analyse(WHITE, np.ones(3)), "3 step sizes for 21"),
        (lambda: analyse(WHITE, -0.1), "not negative"),
        (lambda: analyse(WHITE, 0.0), "one above zero"),
        (lambda: settling_step_size(0.0, 7000), "positive eigenvalue"),
        (lambda: settling_samples(WHITE, 0.01, np.zeros(21), 0), "best value 0"),
        (lambda: settling_samples(WHITE, 0.01, np.ones(21), 21), "`coefficient` must be .* from 0 to 20"),
        (lambda: settling_samples(WHITE, 0.01, np.ones(3), 0), "`weights` must be 21 numbers"),
        (lambda: learning_curve(WHITE, 0.01, np.ones(3), np.arange(3.0)), "`weights` must be 21 numbers"),
        (
            lambda: learning_curve(WHITE, 0.01, np.ones(21), np.arange(3.0), start=np.ones(2)),
            "`start` must be 21 numbers",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(call: object, phrase: str) -> None:
    with pytest.raises(InputError, match=phrase):
        call()  # type: ignore[operator]
