"""Adaptive filters against closed forms, least squares by NumPy, and another library."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adaptive_records import coloured, lags, noisy_record, volterra

from rotflex_jax.adaptive import LMS, NLMS, RLS, AffineProjection, Kalman, fixed_point, run
from rotflex_jax.adaptive.filter import Weights
from rotflex_jax.adaptive.lms import solve
from rotflex_jax.errors import InputError


def ridge(phi: np.ndarray, y: np.ndarray, ridge: float | np.ndarray, lam: float = 1.0) -> np.ndarray:
    """Weights that minimise sum lam^(n-k) e_k^2 + lam^n ridge |w|^2, by least squares on stacked rows."""
    n, P = phi.shape
    weight = np.sqrt(lam ** np.arange(n - 1, -1, -1.0))
    start = np.diag(np.sqrt(np.broadcast_to(ridge, P) * lam**n))
    stacked = np.concatenate([phi * weight[:, None], start])
    return np.linalg.lstsq(stacked, np.concatenate([y * weight, np.zeros(P)]), rcond=None)[0]


# --- LMS


def test_one_lms_step_is_half_the_gradient_step() -> None:
    phi, y = noisy_record(1, seed=1)
    w = np.random.default_rng(2).normal(size=phi.shape[1])
    mu = np.linspace(0.01, 0.2, len(w))
    with jax.enable_x64(True):
        gradient = jax.grad(lambda w: (y[0] - w @ phi[0]) ** 2)(jnp.asarray(w))
    after = run(LMS(mu), phi, y, state=Weights(w)).weights
    np.testing.assert_allclose(after - w, -mu / 2 * np.asarray(gradient), rtol=1e-13)


def test_leaky_lms_is_the_gradient_step_of_the_error_and_a_ridge() -> None:
    phi, y = noisy_record(1, seed=1)
    w = np.random.default_rng(2).normal(size=phi.shape[1])
    with jax.enable_x64(True):
        gradient = jax.grad(lambda w: (y[0] - w @ phi[0]) ** 2 + 0.3 * w @ w)(jnp.asarray(w))
    after = run(LMS(0.05, leakage=0.3), phi, y, state=Weights(w)).weights
    np.testing.assert_allclose(after - w, -0.05 / 2 * np.asarray(gradient), rtol=1e-12)


def test_one_complex_lms_step_is_the_gradient_step_in_real_and_imaginary_parts() -> None:
    rng = np.random.default_rng(3)
    phi = rng.normal(size=(1, 4)) + 1j * rng.normal(size=(1, 4))
    y, w = rng.normal(size=1) + 1j * rng.normal(size=1), rng.normal(size=4) + 1j * rng.normal(size=4)

    def cost(parts: jax.Array) -> jax.Array:
        e = y[0] - jax.lax.complex(parts[0], parts[1]) @ jnp.asarray(phi[0])
        return e.real**2 + e.imag**2

    with jax.enable_x64(True):
        d = np.asarray(jax.grad(cost)(jnp.asarray([w.real, w.imag])))
    after = run(LMS(0.1), phi, y, state=Weights(w)).weights
    np.testing.assert_allclose(after - w, -0.1 / 2 * (d[0] + 1j * d[1]), rtol=1e-13)


@pytest.mark.parametrize("filter", [LMS(0.01, leakage=0.1), NLMS(0.3)])
def test_complex_filters_reduce_to_real_ones(filter) -> None:
    phi, y = noisy_record(300)
    real, both = run(filter, phi, y), run(filter, phi + 0j, y + 0j)
    np.testing.assert_allclose(both.errors, real.errors, atol=1e-14)
    assert both.errors.dtype == np.complex128
    np.testing.assert_allclose(run(filter, 1j * phi, 1j * y).weights, real.weights, atol=1e-14)


def test_complex_lms_identifies_complex_weights() -> None:
    rng = np.random.default_rng(4)
    phi = rng.normal(size=(2000, 3)) + 1j * rng.normal(size=(2000, 3))
    w = np.array([1 + 2j, -0.5j, 0.3])
    np.testing.assert_allclose(run(LMS(0.05), phi, phi @ w).weights, w, atol=1e-10)


def test_full_kernel_lms_is_triangular_lms_with_twice_the_step_off_the_diagonal() -> None:
    # The full layout contains every mixed product twice. Its two equal weights are one weight of twice
    # the value in the triangular layout, which therefore needs twice the step size.
    M, mu1, mu2 = 5, 0.01, 0.003
    u = coloured(3000, 0.3, seed=5)
    y = np.tanh(u) + 0.4 * np.roll(u, 1) * u
    square, triangle = volterra(u, M, full=True), volterra(u, M)
    twice = [mu2 if i == j else 2 * mu2 for i in range(M) for j in range(i, M)]
    full = run(LMS(np.concatenate([np.full(1 + M, mu1), np.full(M * M, mu2)])), square, y)
    half = run(LMS(np.concatenate([np.full(1 + M, mu1), twice])), triangle, y)
    assert full.status == half.status == "ok"
    np.testing.assert_allclose(full.errors, half.errors, atol=4e-15 * np.max(np.abs(y)))
    kernel = full.weights[1 + M :].reshape(M, M)
    np.testing.assert_array_equal(kernel, kernel.T)
    rows, columns = np.triu_indices(M)
    np.testing.assert_allclose(
        half.weights[1 + M :], np.where(rows == columns, 1, 2) * kernel[rows, columns], atol=1e-14
    )


# --- agreement with padasip


@pytest.mark.parametrize(
    ("ours", "name", "options"),
    [
        (LMS(0.01), "FilterLMS", {"mu": 0.01}),
        (NLMS(0.4, eps=0.02), "FilterNLMS", {"mu": 0.4, "eps": 0.02}),
        (RLS(0.99, delta=50.0), "FilterRLS", {"mu": 0.99, "eps": 1 / 50.0}),
        (AffineProjection(0.3, eps=0.02, window=4), "FilterAP", {"mu": 0.3, "ifc": 0.02, "order": 4}),
        (AffineProjection(0.3, eps=0.02, window=1), "FilterNLMS", {"mu": 0.3, "eps": 0.02}),
    ],
)
def test_padasip_gives_the_same(ours, name: str, options: dict) -> None:
    filters = pytest.importorskip("padasip.filters")
    phi, y = noisy_record(400)
    _, errors, history = getattr(filters, name)(n=phi.shape[1], w="zeros", **options).run(y, phi)
    run_ = run(ours, phi, y, keep_every=1)
    scale = np.max(np.abs(y))
    # padasip's RLS updates P instead of a root of it, which loses digits at the start.
    tolerance = 1e-10 if name == "FilterRLS" else 1e-13
    np.testing.assert_allclose(run_.errors, errors, atol=tolerance * scale)
    # The history of padasip contains the weights before each sample.
    np.testing.assert_allclose(run_.path[:-1], history, atol=tolerance * scale)


def test_elimination_solves_small_positive_definite_systems() -> None:
    rng = np.random.default_rng(6)
    for K in (1, 2, 5):
        X = rng.normal(size=(K, K))
        A, b = X @ X.T + 1e-3 * np.eye(K), rng.normal(size=K)
        with jax.enable_x64(True):
            x = np.asarray(solve(jnp.asarray(A), jnp.asarray(b)))
        np.testing.assert_allclose(A @ x, b, atol=1e-11)


# --- recursive least squares


def test_rls_is_ridge_regression() -> None:
    phi, y = noisy_record(2000, memory=5)
    for delta in (1e6, 2.0):
        got = run(RLS(delta=delta), phi, y)
        np.testing.assert_allclose(got.weights, ridge(phi, y, 1 / delta), atol=1e-12)


def test_rls_is_least_squares_of_the_past_at_every_sample() -> None:
    phi, y = noisy_record(120)
    delta = np.linspace(0.5, 20.0, phi.shape[1])
    got = run(RLS(0.97, delta=delta), phi, y)
    for k in (1, 5, 40, 119):
        e = y[k] - phi[k] @ ridge(phi[:k], y[:k], 1 / delta, lam=0.97)
        assert got.errors[k] == pytest.approx(e, abs=1e-12 * np.max(np.abs(y)))


def test_rls_state_holds_the_inverse_gram_matrix() -> None:
    phi, y = noisy_record(200)
    S = run(RLS(0.98, delta=3.0), phi, y).state.S
    weight = 0.98 ** np.arange(199, -1, -1.0)
    gram = (phi * weight[:, None]).T @ phi + np.eye(phi.shape[1]) * 0.98**200 / 3.0
    np.testing.assert_allclose(S @ S.T, np.linalg.inv(gram), atol=1e-12)


@pytest.mark.parametrize("lam", [1.0, 0.98])
def test_rls_in_single_precision_stays_near_the_exact_answer(lam: float) -> None:
    phi, y = noisy_record(3000, memory=5, a=0.9)
    single = run(RLS(lam, delta=1e6), phi.astype(np.float32), y.astype(np.float32))
    # P falls from 1e6 to about 1e-3, by more than the seven digits of single precision.
    assert single.status == "ok"
    np.testing.assert_allclose(single.weights, ridge(phi, y, 1e-6, lam), atol=1e-3)


# --- Kalman


def test_kalman_without_walk_is_rls() -> None:
    phi, y = noisy_record(1000)
    a, b = run(Kalman(q=0.0, r=1.0, p0=100.0), phi, y), run(RLS(delta=100.0), phi, y)
    np.testing.assert_allclose(a.errors, b.errors, atol=1e-11)
    np.testing.assert_allclose(a.weights, b.weights, atol=1e-12)
    np.testing.assert_allclose(a.state.P, b.state.S @ b.state.S.T, atol=1e-12)


def test_kalman_is_the_textbook_recursion() -> None:
    phi, y = noisy_record(60)
    P = phi.shape[1]
    q, r = np.linspace(1e-4, 1e-2, P), 0.3
    w, C = np.zeros(P), np.diag(np.linspace(1.0, 2.0, P))
    got = run(Kalman(q, r, p0=np.linspace(1.0, 2.0, P)), phi, y)
    for k in range(60):
        e = y[k] - phi[k] @ w
        assert got.errors[k] == pytest.approx(e, abs=1e-11)
        # The reference is in information form, while the code updates the covariance.
        after = np.linalg.inv(np.linalg.inv(C) + np.outer(phi[k], phi[k]) / r)
        w = w + after @ phi[k] * e / r
        C = after + np.diag(q)
    np.testing.assert_allclose(got.state.P, C, atol=1e-12)


def test_kalman_knows_how_far_off_it_is() -> None:
    """The normalised squared error of the weights has the mean of its chi-square distribution."""
    rng = np.random.default_rng(7)
    misses = []
    for _ in range(60):
        phi = rng.normal(size=(300, 2))
        w = np.cumsum(0.03 * rng.normal(size=(301, 2)), axis=0)
        y = np.sum(phi * w[:300], axis=1) + 0.5 * rng.normal(size=300)
        got = run(Kalman(q=0.03**2, r=0.25, p0=0.03**2), phi, y)
        miss = w[300] - got.weights
        misses.append(miss @ np.linalg.solve(got.state.P, miss))
    # Chi-square with 2 degrees of freedom: mean 2; standard deviation of the mean 2 / sqrt(60) = 0.26.
    assert np.mean(misses) == pytest.approx(2.0, abs=0.8)


# --- fixed point of NLMS


def test_nlms_rests_at_its_own_fixed_point_and_not_at_least_squares() -> None:
    # The model lacks the cubic term, so the solution depends on the weighting of the samples.
    u = coloured(40_000, 0.5, seed=8)
    phi = volterra(u, 2)
    y = u + 0.5 * u**3 + 0.3 * u**2
    eps = 1e-3
    weight = 1 / (eps + np.sum(phi**2, axis=1))
    normal = np.linalg.solve((phi * weight[:, None]).T @ phi, (phi * weight[:, None]).T @ y)
    np.testing.assert_allclose(fixed_point(phi, y, eps), normal, rtol=1e-10)
    squares = np.linalg.lstsq(phi, y, rcond=None)[0]
    e = y - phi @ squares
    excess = lambda w: np.mean((phi @ (w - squares)) ** 2) / np.mean(e**2)  # noqa: E731
    path = run(NLMS(0.005, eps), phi, y, keep_every=10).path
    rest = path[len(path) // 4 :].mean(axis=0)
    assert excess(normal) > 0.1
    assert excess(rest) == pytest.approx(excess(normal), rel=0.1)
    assert np.mean((phi @ (rest - normal)) ** 2) < 0.02 * np.mean((phi @ (squares - normal)) ** 2)


def test_nlms_fixed_point_is_least_squares_where_the_model_is_complete() -> None:
    x = lags(coloured(200, 0.5, seed=9), 3)
    np.testing.assert_allclose(fixed_point(x, x @ [1.0, -2.0, 0.5]), [1.0, -2.0, 0.5], atol=1e-12)


# --- settings out of range


@pytest.mark.parametrize(
    ("make", "phrase"),
    [
        (lambda: LMS(-0.1), "`mu` must lie at or above 0 and be finite, but is -0.1"),
        (lambda: LMS(np.array([0.1, np.nan])), "`mu` must lie at or above 0 and be finite, but is nan"),
        (lambda: LMS("fast"), "`mu` must be a number"),
        (lambda: LMS("0.1"), "`mu` must be a number or an array of numbers, but is '0.1'"),
        (lambda: NLMS(True), "`mu` must be a number or an array of numbers, but is True"),
        (lambda: LMS(0.1, leakage=-1.0), "`leakage`"),
        (lambda: NLMS(eps=0.0), "`eps` must lie above 0"),
        (lambda: AffineProjection(window=0), "`window` must be a whole number from 1, but is 0"),
        (lambda: AffineProjection(window=2.5), "`window`"),
        (lambda: RLS(1.01), "`lam` must lie above 0 and not above 1, but is 1.01"),
        (lambda: RLS(0.0), "`lam`"),
        (lambda: RLS(delta=0.0), "`delta`"),
        (lambda: Kalman(q=-1.0), "`q`"),
        (lambda: Kalman(r=0.0), "`r`"),
        (lambda: fixed_point(np.ones(3), np.ones(3)), r"shapes \(N, P\) and \(N,\)"),
        (lambda: fixed_point(np.full((3, 1), np.nan), np.ones(3)), "`phi` must be finite"),
    ],
)
def test_settings_out_of_range_are_refused(make, phrase: str) -> None:
    with pytest.raises(InputError, match=phrase):
        make()


@pytest.mark.parametrize(
    ("filter", "name"),
    [
        (LMS(np.ones(2)), "mu"),
        (RLS(delta=np.ones(2)), "delta"),
        (Kalman(q=np.ones(2)), "q"),
        (Kalman(p0=np.ones(2)), "p0"),
        (LMS(0.1, leakage=np.ones(2)), "leakage"),
        (NLMS(np.ones(2)), "mu"),
        (AffineProjection(np.ones(2)), "mu"),
    ],
)
def test_settings_per_weight_must_be_as_many_as_weights(filter, name: str) -> None:
    with pytest.raises(InputError, match=f"`{name}` must be one number or one for each of the 10 weights"):
        run(filter, *noisy_record(20))


@pytest.mark.parametrize(
    ("filter", "name"),
    [
        (NLMS(eps=np.ones(10)), "eps"),
        (AffineProjection(eps=np.ones(10)), "eps"),
        (RLS(np.ones(10)), "lam"),
        (Kalman(r=np.ones(10)), "r"),
    ],
)
def test_settings_of_all_weights_are_one_number(filter, name: str) -> None:
    with pytest.raises(InputError, match=f"`{name}` must be one number, but has the shape .10,.; give one"):
        run(filter, *noisy_record(20))


@pytest.mark.parametrize("filter", [RLS(), Kalman(), AffineProjection()])
def test_filters_for_real_data_refuse_complex_data(filter) -> None:
    with pytest.raises(InputError, match=f"{type(filter).__name__} works on real data"):
        run(filter, np.ones((5, 2)) * 1j, np.ones(5))
