"""Delays and Volterra products against convolution, explicit sums, and each other."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from rotflex_jax.basis import Delays, Orthonormal, Volterra
from rotflex_jax.basis.bank import _respond
from rotflex_jax.errors import InputError

QUICK = settings(max_examples=12, deadline=None, derandomize=True)
GOBF = Orthonormal((0.5, 0.6 + 0.3j, 0.6 - 0.3j))


def noise(N: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(N)


def by_hand(u: np.ndarray, kernels: dict) -> np.ndarray:
    """Output of Volterra kernels, by explicit sums over all delays."""
    length = len(next(iter(h for d, h in kernels.items() if d)))
    lags = np.stack([np.concatenate([np.zeros(k), u])[: len(u)] for k in range(length)], axis=1)
    y = np.full(len(u), float(kernels.get(0, 0.0)))
    for d, H in kernels.items():
        for k in itertools.product(range(length), repeat=d) if d else ():
            y += H[k] * np.prod(lags[:, list(k)], axis=1)
    return y


@QUICK
@given(memory=st.integers(1, 9), first=st.integers(0, 4), seed=st.integers(0, 99))
def test_a_weighted_delay_line_is_a_convolution(memory: int, first: int, seed: int) -> None:
    u, h = noise(20, seed), noise(memory, seed + 100)
    shifted = np.concatenate([np.zeros(first), h])
    y = Delays(memory, first).outputs(u) @ h
    np.testing.assert_allclose(y, np.convolve(u, shifted)[:20], atol=1e-14)


def test_delays_know_their_impulse_response_and_their_reach() -> None:
    bank = Delays(3, first=2)
    np.testing.assert_array_equal(bank.impulse_responses(6), np.eye(6)[:, 2:5])
    assert bank.reach == 5
    assert bank.names == ("u[t-2]", "u[t-3]", "u[t-4]")


@pytest.mark.parametrize("bank", [Delays(3), Delays(2, first=1), GOBF], ids=["delays", "late", "gobf"])
@pytest.mark.parametrize("degrees", [(1,), (1, 2), (1, 2, 3), (1, 3), (2,)], ids=str)
@pytest.mark.parametrize("layout", ["triangular", "full"])
def test_kernels_in_delays_give_what_the_weights_give(bank, degrees, layout) -> None:
    basis = Volterra(bank, degrees=degrees, layout=layout)
    u, w = noise(14), noise(basis.size, 1)
    kernels = basis.kernels(w, length=14)
    assert set(kernels) == {0, *degrees}
    # 1.3e-13 is the rounding error of sums of this length in double precision.
    np.testing.assert_allclose(by_hand(u, kernels), basis.regressors(u) @ w, atol=1.3e-13)
    for d in degrees:
        for axes in itertools.permutations(range(d)):
            np.testing.assert_allclose(np.transpose(kernels[d], axes), kernels[d], atol=1e-14)


@QUICK
@given(
    order=st.integers(1, 3),
    constant=st.booleans(),
    layout=st.sampled_from(["triangular", "full"]),
    gobf=st.booleans(),
    seed=st.integers(0, 99),
)
def test_weights_come_back_from_their_kernels(order, constant, layout, gobf, seed) -> None:
    basis = Volterra(GOBF if gobf else Delays(3), order, constant=constant, layout=layout)
    w, u = noise(basis.size, seed), noise(30, seed + 1)
    back = basis.weights(basis.kernels(w, 30))
    # In the full layout only the symmetric part of the weights affects the output.
    np.testing.assert_allclose(basis.regressors(u) @ back, basis.regressors(u) @ w, atol=1e-11)
    if layout == "triangular":
        np.testing.assert_allclose(back, w, atol=1e-11)


def test_an_unsymmetric_kernel_is_worth_its_symmetric_part() -> None:
    """Weights of an unsymmetric kernel give its output, and their kernel is its symmetric part."""
    basis = Volterra(Delays(4))
    H = noise(16).reshape(4, 4)
    u = noise(30, 2)
    w = basis.weights({2: H})
    np.testing.assert_allclose(basis.regressors(u) @ w, by_hand(u, {2: H}), atol=1e-13)
    np.testing.assert_allclose(basis.kernels(w)[2], (H + H.T) / 2, atol=1e-15)


def test_full_and_triangular_layouts_are_one_model() -> None:
    full, triangular = Volterra(Delays(5), layout="full"), Volterra(Delays(5))
    assert (full.size, triangular.size) == (31, 21)
    w, u = noise(31), noise(100, 1)
    same = triangular.weights(full.kernels(w))
    np.testing.assert_allclose(full.regressors(u) @ w, triangular.regressors(u) @ same, atol=1e-13)
    # The weight of a mixed product is the sum of its two weights in the full layout.
    one = full.indices.index((0, 1)), full.indices.index((1, 0))
    assert same[triangular.indices.index((0, 1))] == pytest.approx(w[one[0]] + w[one[1]], abs=1e-14)


def test_the_full_layout_without_a_constant_has_rank_20_of_30() -> None:
    phi = Volterra(Delays(5), layout="full", constant=False).regressors(noise(5000))
    assert phi.shape[1] == 30
    assert np.linalg.matrix_rank(phi.T @ phi) == 20
    phi = Volterra(Delays(5), constant=False).regressors(noise(5000))
    assert phi.shape[1] == np.linalg.matrix_rank(phi.T @ phi) == 20


def test_with_a_constant_sums_of_inputs_do_not_give_sums_of_outputs() -> None:
    u, v = noise(20), noise(20, 1)

    def output(u: np.ndarray, constant: float) -> np.ndarray:
        return Volterra(Delays(2), 1).regressors(u) @ [constant, 1.0, 2.0]

    np.testing.assert_allclose(output(u + v, 0.0), output(u, 0.0) + output(v, 0.0), atol=1e-14)
    np.testing.assert_allclose(output(u + v, 0.5), output(u, 0.5) + output(v, 0.5) - 0.5, atol=1e-14)


def test_odd_degrees_alone_are_odd() -> None:
    basis = Volterra(GOBF, degrees=(1, 3), constant=False)
    u, w = noise(50), noise(basis.size, 1)
    np.testing.assert_array_equal(basis.regressors(-u) @ w, -(basis.regressors(u) @ w))


def test_names_degrees_and_units_of_a_cubic_series() -> None:
    basis = Volterra(Delays(2), 3)
    assert basis.names[6:] == ("u[t]^3", "u[t]^2 * u[t-1]", "u[t] * u[t-1]^2", "u[t-1]^3")
    assert basis.degrees.tolist() == [0, 1, 1, 2, 2, 2, 3, 3, 3, 3]
    assert basis.units("V", "rad")[::3] == ("rad", "rad/V^2", "rad/V^3", "rad/V^3")
    assert Volterra(GOBF, 2).names[5] == "(GOBF 1) * (GOBF 2)"


def test_step_sizes_by_degree() -> None:
    full, triangular = Volterra(Delays(3), layout="full"), Volterra(Delays(3))
    sizes = {0: 0.3, 1: 0.1, 2: 0.01}
    u, e = noise(10), 0.7
    # A step of the filter in the full layout, converted to the triangular one, equals that of `as_full`.
    moved = full.weights(full.kernels(full.step_sizes(sizes) * e * full.regressors(u)[-1]))
    folded = triangular.weights(full.kernels(moved))
    own = triangular.step_sizes(sizes, as_full=True) * e * triangular.regressors(u)[-1]
    np.testing.assert_allclose(own, folded, atol=1e-15)
    slope = jax.grad(lambda mu: jnp.sum(triangular.step_sizes({0: 0.0, 1: 1.0, 2: mu})))(0.1)
    assert float(slope) == 6.0


def test_single_precision_stays_single_and_integers_become_double() -> None:
    for basis in (Volterra(Delays(3)), Volterra(GOBF, 3)):
        u = noise(100)
        narrow, wide = basis.regressors(u.astype(np.float32)), basis.regressors(u)
        assert narrow.dtype == np.float32
        assert wide.dtype == np.float64
        np.testing.assert_allclose(narrow, wide, atol=1e-4, rtol=1e-4)
        assert basis.regressors(np.arange(5)).dtype == np.float64


def test_other_values_compile_nothing() -> None:
    u = noise(77)
    Volterra(Orthonormal((0.5, 0.6 + 0.3j, 0.6 - 0.3j)), 2).regressors(u)
    compiled = _respond.programs_made
    Volterra(Orthonormal((-0.4, 0.1 + 0.7j, 0.1 - 0.7j)), 2).regressors(2 * u)
    assert _respond.programs_made == compiled
    Volterra(Orthonormal((0.5, 0.4)), 2).regressors(u)
    assert _respond.programs_made == compiled + 1  # other kinds of poles compile, so the count works


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: Delays(0), "Argument `memory` must be a whole number from 1, but is 0"),
        (lambda: Delays(2.5), "Argument `memory` must be a whole number from 1, but is 2.5"),
        (lambda: Delays(True), "Argument `memory`"),
        (lambda: Delays(2, first=-1), "Argument `first` must be a whole number from 0, but is -1"),
        (lambda: Delays(2).outputs(np.ones((3, 2))), r"Argument `u` must be real numbers of shape \(N,\)"),
        (lambda: Delays(2).outputs([]), "Argument `u` must be real numbers"),
        (lambda: Delays(2).outputs([1.0, np.nan]), "is nan at sample 1"),
        (lambda: Delays(2).outputs([1j, 2.0]), "must be real numbers .* complex128"),
        (lambda: Delays(2).impulse_responses(0), "Argument `length` must be a number of samples"),
        (lambda: Volterra(5), "turn a signal into columns, but is 5"),
        (lambda: Volterra(Delays(2), 0), "Argument `order` must be a whole number from 1"),
        (lambda: Volterra(Delays(2), 2, degrees=(1, 3)), "both given"),
        (lambda: Volterra(Delays(2), degrees=(), constant=False), "lists no degree"),
        (lambda: Volterra(Delays(2), layout="upper"), "must be 'triangular' or 'full', but is 'upper'"),
        (
            lambda: Volterra(Delays(2)).kernels([1.0]),
            r"has 6 regressors, but the weights have the shape \(1,\)",
        ),
        (lambda: Volterra(Delays(2), 3).kernels(np.ones(10), 1000), "give a smaller `length`"),
        (lambda: Volterra(Delays(2)).weights({3: np.zeros((2, 2, 2))}), "kernel of degree 3 was given"),
        (lambda: Volterra(Delays(2)).weights({2: np.zeros((2, 3))}), "2 axes of one length"),
        (lambda: Volterra(Delays(2)).weights({1: np.ones(3)}), "outside the span of the bank by 58 %"),
        (lambda: Volterra(Delays(2)).step_sizes({1: 0.1}), "for the degrees 1, but the basis also has 0"),
    ],
)
def test_bad_input_is_told_in_a_sentence(make, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        make()


def test_the_best_approximation_is_there_for_the_asking() -> None:
    """With an infinite tolerance, a kernel longer than the bank is approximated instead of refused."""
    w = Volterra(Delays(2), 1).weights({1: np.ones(3)}, tolerance=np.inf)
    np.testing.assert_allclose(w, [0.0, 1.0, 1.0], atol=1e-15)
