"""Moments of regressors against closed forms, Gauss-Hermite quadrature and random samples."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from gaussian_rule import gauss_hermite, monomials

from rotflex_jax.adaptive.moments import GaussianMoments, Moments, ar1_covariance, pack, unpack
from rotflex_jax.basis import Delays, Hermite, Orthonormal, Volterra
from rotflex_jax.errors import InputError

NUMBERS = json.loads((Path(__file__).parent / "paper_numbers.json").read_text())


def random_covariance(n: int, seed: int) -> np.ndarray:
    L = np.random.default_rng(seed).standard_normal((n, n))
    return L @ L.T / n


@pytest.mark.parametrize("power", range(0, 13, 2))
def test_moments_of_one_number_are_the_double_factorials(power: int) -> None:
    expected = np.prod(np.arange(power - 1, 0, -2, dtype=float)) * 2.0 ** (power / 2)
    assert GaussianMoments(np.array([[2.0]])).moment((power,)) == pytest.approx(expected, rel=1e-14)


def test_fourth_moments_follow_isserlis() -> None:
    R = random_covariance(4, 0)
    wick = GaussianMoments(R)
    for i, j, k, m in itertools.product(range(4), repeat=4):
        powers = tuple(np.bincount([i, j, k, m], minlength=4).tolist())
        expected = R[i, j] * R[k, m] + R[i, k] * R[j, m] + R[i, m] * R[j, k]
        assert wick.moment(powers) == pytest.approx(expected, rel=1e-12, abs=1e-14)


def test_odd_moments_are_zero() -> None:
    wick = GaussianMoments(random_covariance(3, 1))
    assert wick.moment((1, 0, 0)) == wick.moment((2, 1, 0)) == wick.moment((3, 3, 1)) == 0.0


def test_eighth_moments_agree_with_an_integration_rule_and_with_random_numbers() -> None:
    R = random_covariance(3, 2)
    z, p = gauss_hermite(R, 5)
    draws = np.random.default_rng(3).multivariate_normal(np.zeros(3), R, 400_000)
    for powers in ((2, 2, 4), (8, 0, 0), (1, 3, 4), (3, 3, 2)):
        value = GaussianMoments(R).moment(powers)
        assert value == pytest.approx(p @ np.prod(z**powers, axis=1), rel=1e-11)
        sample = np.prod(draws**powers, axis=1)
        assert abs(sample.mean() - value) < 5 * sample.std() / np.sqrt(len(sample))


def test_eigenvalues_for_a_white_input() -> None:
    quadratic = Moments.gaussian(np.eye(5), (2,))
    np.testing.assert_allclose(quadratic.eigenvalues, [1.0] * 10 + [2.0] * 4 + [7.0], atol=1e-12)
    np.testing.assert_allclose(quadratic.eigenvalues, NUMBERS["eigR2tri_M5_a0"], atol=1e-12)
    every = Moments.gaussian(np.eye(5)).eigenvalues
    # The constant and the sum of the squares are coupled by the block [[1, sqrt 5], [sqrt 5, 7]].
    ends = np.linalg.eigvalsh([[1.0, np.sqrt(5)], [np.sqrt(5), 7.0]])
    np.testing.assert_allclose(every, np.sort([*ends, *[1.0] * 15, *[2.0] * 4]), atol=1e-12)
    assert every[0] == pytest.approx(0.25834, abs=1e-5)
    assert every[-1] == pytest.approx(7.74166, abs=1e-5)


@pytest.mark.parametrize("a", ["0.5", "0.9"])
def test_eigenvalues_and_condition_for_a_coloured_input(a: str) -> None:
    R1 = ar1_covariance(float(a), 5)
    eigenvalues = Moments.gaussian(R1, (2,)).eigenvalues
    np.testing.assert_allclose(eigenvalues, NUMBERS[f"eigR2tri_M5_a{a}"], rtol=1e-9)
    condition = Moments.gaussian(R1).condition
    assert condition == pytest.approx(NUMBERS[f"condR_const_lin_quad_M5_a{a}"], rel=1e-8)


@pytest.mark.parametrize(
    ("a", "linear", "quadratic"), [(0.2846, 2.73, 21), (0.7304, 19.1, 584), (0.9391, 131, 2.5e4)]
)
def test_conditions_of_linear_and_quadratic_regressors(a: float, linear: float, quadratic: float) -> None:
    R1 = ar1_covariance(a, 5)
    assert Moments.gaussian(R1, (1,)).condition == pytest.approx(linear, rel=0.01)
    assert Moments.gaussian(R1, (2,)).condition == pytest.approx(quadratic, rel=0.02)


@pytest.mark.parametrize("a", [0.0, 0.8])
def test_second_and_fourth_moments_agree_with_an_integration_rule(a: float) -> None:
    R1 = ar1_covariance(a, 5)
    z, p = gauss_hermite(R1, 5)
    x = monomials(z)
    moments = Moments.gaussian(R1)
    np.testing.assert_allclose(moments.R, x.T @ (p[:, None] * x), atol=1e-11)
    W = np.random.default_rng(4).standard_normal((21, 21))
    W += W.T
    expected = np.einsum("k,ki,ka,ab,kb,kj->ij", p, x, x, W, x, x, optimize=True)
    np.testing.assert_allclose(moments.S(W), expected, atol=1e-10 * np.abs(expected).max())


def test_linear_regressors_have_the_textbook_fourth_moments() -> None:
    R = random_covariance(4, 5)
    W = random_covariance(4, 6)
    expected = 2 * R @ W @ R + R * np.trace(R @ W)
    np.testing.assert_allclose(Moments.gaussian(R, (1,)).S(W), expected, rtol=1e-12)


def test_full_layout_counts_a_product_in_every_order() -> None:
    full = Moments.gaussian(ar1_covariance(0.5, 5), (2,), "full")
    assert full.size == 25
    assert np.linalg.matrix_rank(full.R, tol=1e-9) == 15
    assert full.condition > 1e12


def test_moments_of_a_basis_are_those_of_its_regressors() -> None:
    bank = Orthonormal((0.5, 0.6 + 0.3j, 0.6 - 0.3j))
    basis = Volterra(bank, degrees=(1, 2))
    u = np.random.default_rng(7).standard_normal(200_000)
    exact = Moments.of_basis(basis, np.eye(3))
    sampled = Moments.of_regressors(basis.regressors(u)[100:])
    np.testing.assert_allclose(sampled.R, exact.R, atol=0.06)
    W = np.eye(basis.size)
    np.testing.assert_allclose(sampled.S(W), exact.S(W), atol=0.05 * np.abs(exact.S(W)).max())


def test_hermite_regressors_are_white_in_the_second_moments_only() -> None:
    R1 = ar1_covariance(0.8, 3)
    moments = Moments.of_basis(Hermite.of(Volterra(Delays(3)), R1), R1)
    np.testing.assert_allclose(moments.R, np.eye(10), atol=1e-12)
    # For any colour, the fourth moments are those of Hermite polynomials of independent variables.
    white = Moments.of_basis(Hermite.of(Volterra(Delays(3)), np.eye(3)), np.eye(3))
    W = random_covariance(10, 13)
    np.testing.assert_allclose(moments.S(W), white.S(W), atol=1e-10)
    assert np.abs(moments.S(np.eye(10)) - 12 * np.eye(10)).max() > 1  # Gaussian regressors would have 12 I


def test_sample_moments_are_plain_means() -> None:
    phi = np.random.default_rng(8).uniform(-1, 1, (50, 3))
    W = np.diag([1.0, 2.0, 3.0])
    moments = Moments.of_regressors(phi)
    np.testing.assert_allclose(moments.R, np.mean([np.outer(x, x) for x in phi], axis=0), atol=1e-15)
    np.testing.assert_allclose(
        moments.S(W), np.mean([np.outer(x, x) @ W @ np.outer(x, x) for x in phi], axis=0)
    )


def test_a_change_of_regressors_changes_exact_and_sample_moments_alike() -> None:
    R1 = ar1_covariance(0.6, 2)
    exact = Moments.gaussian(R1)
    T = np.random.default_rng(9).standard_normal((6, 4))
    C = random_covariance(4, 10)
    np.testing.assert_allclose(exact.transformed(T).S(C), T.T @ exact.S(T @ C @ T.T) @ T, rtol=1e-10)
    phi = Volterra(Delays(2)).regressors(np.random.default_rng(11).standard_normal(300))
    expected = Moments.of_regressors(phi @ T)
    np.testing.assert_allclose(Moments.of_regressors(phi).transformed(T).S(C), expected.S(C), rtol=1e-10)


def test_packing_keeps_lengths_and_comes_back() -> None:
    W = random_covariance(5, 12)
    assert np.linalg.norm(pack(W)) == pytest.approx(np.linalg.norm(W))
    np.testing.assert_allclose(unpack(pack(W)), W)


@pytest.mark.parametrize(
    ("make", "phrase"),
    [
        (lambda: Moments.gaussian(np.eye(16)), "take 1059 MB, but 512 MB are allowed"),
        (lambda: Moments.gaussian(np.array([[1.0, 2.0], [2.0, 1.0]])), "without negative eigenvalues"),
        (lambda: Moments.gaussian(np.ones((2, 3))), "square matrix"),
        (lambda: Moments.of_basis(Volterra(Delays(3)), np.eye(2)), "3 outputs"),
        (lambda: Moments.of_regressors(np.ones(4)), "matrix"),
        (lambda: Moments.of_regressors(np.array([[1.0, np.nan]])), "finite"),
        (lambda: ar1_covariance(1.0, 3), "-1 < a < 1"),
    ],
)
def test_what_has_no_moments_is_refused(make: object, phrase: str) -> None:
    with pytest.raises(InputError, match=phrase):
        make()  # type: ignore[operator]
