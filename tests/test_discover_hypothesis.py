"""The likelihood of innovations against SciPy's densities."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from rotflex_jax.discover.hypothesis import Whitener, fit_whitener

FLOOR = np.array([1e-9, 1e-9])
MIXED = np.array([[2.0, 0.6], [0.6, 0.5]])


def white(R: int = 2, N: int = 500, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.multivariate_normal(np.zeros(2), MIXED, (R, N))


def everything(e: np.ndarray) -> np.ndarray:
    return np.ones(e.shape[:2])


def log_likelihood(e: np.ndarray, seen: np.ndarray, floor: np.ndarray) -> float:
    """Log-likelihood of innovations under the whitener that is fitted to them."""
    return float(fit_whitener(e, seen, floor).log_densities(e, seen).sum())


def test_densities_are_those_of_a_normal_distribution():
    e = white()
    w = fit_whitener(e, everything(e), FLOOR)
    sample = np.einsum("rni,rnj->ij", e, e) / e[..., 0].size
    expected = multivariate_normal(np.zeros(2), sample).logpdf(e)
    np.testing.assert_allclose(w.log_densities(e, everything(e)), expected, rtol=1e-9)
    np.testing.assert_allclose(w.log_det, np.log(np.linalg.det(sample)), rtol=1e-9)


def test_whitened_is_white_and_of_unit_size():
    e = white()
    flat = fit_whitener(e, everything(e), FLOOR)(e, everything(e)).reshape(-1, 2)
    np.testing.assert_allclose(flat.T @ flat / len(flat), np.eye(2), atol=1e-9)


def test_what_is_not_seen_does_not_count():
    e = white(N=300)
    seen = everything(e)
    seen[1, 200:] = 0
    other = e.copy()
    other[1, 200:] = 77.0  # masked values have no influence
    e[1, 200:] = 0.0
    a, b = (fit_whitener(x * seen[..., None], seen, FLOOR) for x in (e, other))
    np.testing.assert_array_equal(a.L, b.L)
    densities = a.log_densities(e, seen)
    assert (densities[1, 200:] == 0).all()
    assert (densities[0] != 0).all() and (densities[1, :200] != 0).all()
    assert densities.sum() == pytest.approx(log_likelihood(e, seen, FLOOR))


def test_no_other_whitener_is_likelier():
    e = white(N=400)
    seen = everything(e)
    best = log_likelihood(e, seen, FLOOR)
    L = fit_whitener(e, seen, FLOOR).L
    rng = np.random.default_rng(1)
    for _ in range(20):
        other = Whitener(L @ (np.eye(2) + 0.05 * np.tril(rng.normal(size=(2, 2)))))
        assert other.log_densities(e, seen).sum() < best


def test_slopes_are_whitened_like_innovations():
    """The whitener is linear, and its argument may have any leading axes."""
    e, J = white(N=100), np.random.default_rng(4).normal(size=(3, 2, 100, 2))
    seen = everything(e)
    w = fit_whitener(e, seen, FLOOR)
    together = w(J, seen)
    assert together.shape == J.shape
    for one, row in zip(J, together, strict=True):
        np.testing.assert_allclose(w(e + one, seen) - w(e, seen), row, atol=1e-10)


def test_noise_free_data_stay_finite():
    e = np.zeros((1, 50, 2))
    floor = np.array([1e-4, 2e-4])
    w = fit_whitener(e, everything(e), floor)
    np.testing.assert_allclose(np.linalg.inv(w.L), np.diag(0.05 * floor), rtol=1e-9)
    assert np.isfinite(log_likelihood(e, everything(e), floor))


def test_the_floor_does_not_matter_where_there_is_noise():
    e = white()
    low, high = (log_likelihood(e, everything(e), f * np.ones(2)) for f in (1e-6, 0.1))
    assert high == pytest.approx(low, abs=0.1)
