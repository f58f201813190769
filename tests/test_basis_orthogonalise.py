"""Orthonormal regressors: Gram matrix, span, and the degrees that a basis must contain."""

import numpy as np
import pytest

from rotflex_jax.basis import Delays, GramSchmidt, Hermite, Orthonormal, Volterra, ar1, bank_covariance
from rotflex_jax.data.excitation import noise
from rotflex_jax.errors import InputError

Ts = 0.01


def coloured(N: int, a: float, seed: int = 0) -> np.ndarray:
    bandwidth = -np.log(a) / (2 * np.pi * Ts)
    return noise(N, Ts, bandwidth=bandwidth, seed=seed)


def toeplitz(a: float, memory: int) -> np.ndarray:
    return a ** np.abs(np.subtract.outer(np.arange(memory), np.arange(memory)))


def gram(phi: np.ndarray) -> np.ndarray:
    return phi.T @ phi / len(phi)


def unexplained(targets: np.ndarray, phi: np.ndarray) -> float:
    """Largest relative part of a column of `targets` that `phi` does not span."""
    left = targets - phi @ np.linalg.lstsq(phi, targets, rcond=None)[0]
    return float(np.max(np.linalg.norm(left, axis=0) / np.linalg.norm(targets, axis=0)))


@pytest.mark.parametrize("a", [0.5, 0.8, 0.95])
def test_hermite_products_are_orthonormal_for_a_gaussian_input(a: float) -> None:
    raw = Volterra(Delays(5))
    basis = Hermite.of(raw, toeplitz(a, 5))
    u = coloured(400_000, a)
    G = gram(basis.regressors(u)[10:])
    # Fourth moments of 400,000 correlated samples scatter by about 0.01 to 0.03.
    assert np.max(np.abs(G - np.eye(21))) < (0.03 if a < 0.9 else 0.15)
    assert np.linalg.cond(gram(raw.regressors(u)[10:])) > 80
    assert np.linalg.cond(G) < (1.2 if a < 0.9 else 1.5)


def test_moments_of_hermite_products_are_exact_under_quadrature() -> None:
    # Gauss-Hermite quadrature integrates polynomials of Gaussian variables exactly.
    points, weights = np.polynomial.hermite_e.hermegauss(8)
    v = np.stack(np.meshgrid(points, points, indexing="ij"), axis=-1).reshape(-1, 2)
    weight = np.outer(weights, weights).ravel() / (2 * np.pi)
    R1 = np.array([[2.0, 0.9], [0.9, 0.7]])
    z = v @ np.linalg.cholesky(R1).T
    for degrees, count in (((1, 2), 6), ((1, 2, 3), 10), ((2, 4), 9)):
        raw = Volterra(Delays(2), degrees=degrees)
        basis = Hermite.of(raw, R1)
        powers = [np.prod(z[:, list(i)], axis=1) for i in raw.indices]
        psi = np.stack(powers, axis=1) @ np.asarray(basis.transform)
        assert basis.size == count
        np.testing.assert_allclose(psi.T @ (weight[:, None] * psi), np.eye(count), atol=1e-11)


@pytest.mark.parametrize("layout", ["triangular", "full"])
@pytest.mark.parametrize("kind", ["hermite", "gram-schmidt"])
def test_the_span_stays_and_weights_go_back(layout: str, kind: str) -> None:
    raw = Volterra(Orthonormal((0.5, 0.6 + 0.3j, 0.6 - 0.3j)), 3, layout=layout)
    u = coloured(3000, 0.8)
    if kind == "hermite":
        basis = Hermite.of(raw, bank_covariance(raw.bank, ar1(0.8, raw.bank.reach)))
    else:
        basis = GramSchmidt.of(raw, u)
    assert basis.size == 20
    phi, psi = raw.regressors(u), basis.regressors(u)
    assert unexplained(phi, psi) < 1e-11
    assert unexplained(psi, phi) < 1e-11
    w = np.random.default_rng(1).standard_normal(20)
    np.testing.assert_allclose(phi @ basis.raw_weights(w), psi @ w, atol=1e-10)
    for degree, kernel in basis.kernels(w, 8).items():
        np.testing.assert_allclose(kernel, raw.kernels(basis.raw_weights(w), 8)[degree], atol=1e-12)


def test_least_squares_gives_the_same_model_either_way() -> None:
    raw = Volterra(Delays(5))
    u = coloured(2000, 0.9)
    y = np.tanh(np.convolve(u, [0.5, -0.8, 0.3])[:2000]) + 0.2 * u**2
    predictions = []
    for basis in (raw, Hermite.of(raw, toeplitz(0.9, 5)), GramSchmidt.of(raw, u)):
        phi = basis.regressors(u)
        predictions.append(phi @ np.linalg.lstsq(phi, y, rcond=None)[0])
    np.testing.assert_allclose(predictions[1], predictions[0], atol=1e-11)
    np.testing.assert_allclose(predictions[2], predictions[0], atol=1e-11)


def test_without_the_constant_the_hermite_span_is_not_closed() -> None:
    raw = Volterra(Delays(3), constant=False)
    with pytest.raises(InputError, match=r"of degree 2 contain terms of degree 0.*add the constant"):
        Hermite.of(raw, np.eye(3))
    # No combination of the raw regressors equals v^2 - 1.
    phi = raw.regressors(coloured(3000, 0.5))
    assert unexplained((phi[:, 3:4] - 1) / np.sqrt(2), phi) > 0.3
    # Odd degrees need no constant, and Gram-Schmidt on a sample needs none.
    assert Hermite.of(Volterra(Delays(3), degrees=(1, 3), constant=False), np.eye(3)).size == 13
    assert GramSchmidt.of(raw, coloured(3000, 0.5)).size == 9


def test_cubes_need_the_linear_terms() -> None:
    with pytest.raises(InputError, match="add the degree 1"):
        Hermite.of(Volterra(Delays(2), degrees=(3,)), np.eye(2))


def test_gram_schmidt_is_exact_on_its_sample_and_leaves_doubles_out() -> None:
    u = coloured(2000, 0.8)
    basis = GramSchmidt.of(Volterra(Delays(4), layout="full"), u)
    assert basis.size == 15  # 21 columns, 6 of them duplicates
    np.testing.assert_allclose(gram(basis.regressors(u)), np.eye(15), atol=1e-11)
    assert basis.degrees.tolist() == [0] + [1] * 4 + [2] * 10
    assert basis.names[:2] == ("1", "GS(u[t])")
    # The transform is triangular: the first linear regressor contains no quadratic ones.
    assert np.all(np.asarray(basis.transform)[5:, 1] == 0)


def test_names_units_step_sizes_and_precision() -> None:
    basis = Hermite.of(Volterra(Delays(2)), np.eye(2))
    assert basis.names == ("1", "H1(v1)", "H1(v2)", "H2(v1)", "H1(v1) * H1(v2)", "H2(v2)")
    assert set(basis.units("V", "rad")) == {"rad"}
    assert basis.step_sizes({0: 0.1, 1: 0.2, 2: 0.3}).tolist() == [0.1, 0.2, 0.2, 0.3, 0.3, 0.3]
    assert basis.regressors(np.ones(9, np.float32)).dtype == np.float32
    assert basis.regressors(np.ones(9)).dtype == np.float64


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda raw: Hermite.of(raw, np.eye(3)), r"symmetric matrix of 2 rows.*has the shape \(3, 3\)"),
        (lambda raw: Hermite.of(raw, [[1.0, 0.5], [0.0, 1.0]]), "symmetric matrix"),
        (lambda raw: Hermite.of(raw, np.ones((2, 2))), "must be positive definite"),
        (lambda raw: GramSchmidt.of(raw, np.ones(4)), "6 regressors needs as many samples, but `u` has 4"),
        (lambda raw: Hermite.of(raw, np.eye(2)).raw_weights([1.0]), "6 regressors, but the weights"),
        (
            lambda raw: Hermite.of(raw, np.eye(2)).step_sizes({1: 0.1}),
            "for the degrees 1, but the basis also has 0",
        ),
    ],
)
def test_bad_input_is_told_in_a_sentence(make, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        make(Volterra(Delays(2)))
