"""Orthonormal filters against transfer functions, by their Gram matrix, and on a plant with their poles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from linear_joint import PAPER, POLES, impulse_response
from scipy.signal import lfilter

from rotflex_jax.basis import Orthonormal, Volterra, minimum_nmse
from rotflex_jax.basis.orthonormal import coordinates, parameters_of
from rotflex_jax.errors import InputError
from rotflex_jax.runtime.xla import double_precision


def noise(N: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(N)


def chained(sections: list, u: np.ndarray) -> np.ndarray:
    """Outputs of a chain of sections with all-passes between them, delayed by one sample, by scipy."""
    columns, through = [], np.concatenate([[0.0], u[:-1]])
    for numerators, allpass, denominator in sections:
        columns += [lfilter(numerator, denominator, through) for numerator in numerators]
        through = lfilter(allpass, denominator, through)
    return np.stack(columns, axis=1)


def real_section(a: float) -> tuple:
    return [[np.sqrt(1 - a**2)]], [-a, 1.0], [1.0, -a]


def pair_section(p: complex) -> tuple:
    c = -(abs(p) ** 2)
    b = -2 * p.real / (c - 1)
    numerators = [np.sqrt(1 - c**2) * np.array([1.0, -b]), [0.0, np.sqrt((1 - c**2) * (1 - b**2))]]
    return numerators, [-c, b * (c - 1), 1.0], [1.0, b * (c - 1), -c]


@pytest.mark.parametrize("a", [0.7, -0.3, 0.98])
def test_laguerre_is_its_transfer_function(a: float) -> None:
    u = noise(400)
    expected = chained([real_section(a)] * 4, u)
    np.testing.assert_allclose(Orthonormal.laguerre(a, 4).outputs(u), expected, atol=2e-13)


@pytest.mark.parametrize("p", [0.8 + 0.3j, -0.5 + 0.4j, 0.01 + 0.9j])
def test_kautz_is_its_transfer_function(p: complex) -> None:
    u = noise(400)
    expected = chained([pair_section(p)] * 3, u)
    np.testing.assert_allclose(Orthonormal.kautz(p, 6).outputs(u), expected, atol=2e-12)


def test_mixed_poles_are_the_chain_of_their_sections() -> None:
    u, p = noise(400), 0.6 + 0.5j
    expected = chained([real_section(0.9), pair_section(p), real_section(-0.2)], u)
    # The conjugate may be listed anywhere after its partner.
    bank = Orthonormal((0.9, p, -0.2, p.conjugate()))
    np.testing.assert_allclose(bank.outputs(u), expected, atol=1e-12)
    assert bank.poles == (0.9, p, p.conjugate(), -0.2)
    assert bank.outputs(u).dtype == np.float64  # real in spite of complex poles


@settings(max_examples=15, deadline=None, derandomize=True)
@given(
    real=st.lists(st.floats(-0.95, 0.95), max_size=3),
    pairs=st.lists(st.tuples(st.floats(0.05, 0.95), st.floats(0.05, 3.09)), max_size=2),
)
def test_any_poles_give_orthonormal_functions(real: list, pairs: list) -> None:
    complex_poles = [r * np.exp(1j * angle) for r, angle in pairs]
    poles = [*real, *complex_poles, *np.conj(complex_poles)]
    if not poles:
        return
    bank = Orthonormal(poles)
    B = bank.impulse_responses(3000)
    assert np.max(np.abs(B.T @ B - np.eye(len(poles)))) < 1e-10
    assert bank.size == len(poles)
    # The energy of the impulse responses beyond the reach is negligible.
    assert np.max(np.sum(B[bank.reach :] ** 2, axis=0)) < 1e-11


@pytest.mark.parametrize("Ts", [0.001, 0.01, 0.02, 0.05, 0.1])
def test_gram_matrix_of_the_plants_poles(Ts: float) -> None:
    B = Orthonormal.at(POLES, Ts).impulse_responses(round(4 / Ts))
    assert np.max(np.abs(B.T @ B - np.eye(3))) < 1e-12


@pytest.mark.parametrize("Ts", [0.001, 0.005, 0.01, 0.02, 0.05, 0.1])
def test_three_functions_with_the_plants_poles_are_the_plant(Ts: float) -> None:
    bank, h = Orthonormal.at(POLES, Ts), impulse_response(Ts, 4.0)
    w = bank.impulse_responses(len(h)).T @ h
    u = noise(500)
    y = np.convolve(u, h)[:500]
    np.testing.assert_allclose(bank.outputs(u) @ w, y, atol=1e-12)
    assert minimum_nmse(bank, h) < 1e-20


def test_coefficients_of_the_deflection_are_the_published_ones() -> None:
    given = {0.02: (-0.027218, -0.027547, 0.028531), 0.01: (-0.018490, -0.023142, 0.017519)}
    for Ts, expected in given.items():
        h = np.asarray(PAPER[f"impulse_alpha_{Ts:g}"])
        np.testing.assert_allclose(h, impulse_response(Ts)[: len(h)], atol=1e-14)
        bank = Orthonormal.at(POLES, Ts)
        long = impulse_response(Ts)
        np.testing.assert_allclose(bank.impulse_responses(len(long)).T @ long, expected, atol=1e-6)


def test_the_delay_of_the_bank_moves_it() -> None:
    u = noise(30)
    poles = (0.5, 0.6 + 0.3j, 0.6 - 0.3j)
    late = Orthonormal(poles).outputs(u)
    np.testing.assert_array_equal(Orthonormal(poles, first=0).outputs(u)[:-1], late[1:])
    np.testing.assert_array_equal(Orthonormal(poles, first=3).outputs(u)[2:], late[:-2])
    assert late[0].tolist() == [0.0, 0.0, 0.0]


def test_a_gradient_goes_through_the_poles() -> None:
    bank, u = Orthonormal((0.5, 0.6 + 0.3j, 0.6 - 0.3j)), noise(20)

    def output(parameters):
        phi = Volterra(bank.with_parameters(parameters), 2).respond(jnp.asarray(u))
        return jnp.sum(phi @ jnp.arange(1.0, 11.0))

    with double_precision():
        parameters = jnp.asarray(bank.parameters)
        slope = np.asarray(jax.jit(jax.jacfwd(output))(parameters))
        h = 1e-6
        by_difference = [
            float(output(parameters.at[k].add(h)) - output(parameters.at[k].add(-h))) / (2 * h)
            for k in range(3)
        ]
    np.testing.assert_allclose(slope, by_difference, rtol=1e-7)


def test_poles_from_a_generator_are_those_of_the_list() -> None:
    assert Orthonormal(p for p in (0.5, 0.25)).poles == (0.5, 0.25)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: Orthonormal(()), "must list finite numbers, at least one"),
        (lambda: Orthonormal((1.0,)), "inside the unit circle, but 1 has the modulus 1"),
        (lambda: Orthonormal((0.9 + 0.9j, 0.9 - 0.9j)), "has the modulus 1.27"),
        (lambda: Orthonormal((0.5 + 0.1j,)), r"needs its conjugate, but 0\.5\+0\.1j has none"),
        (lambda: Orthonormal((0.5 + 0.1j, 0.5 + 0.1j)), "needs its conjugate"),
        (lambda: Orthonormal((np.nan,)), "finite numbers"),
        (lambda: Orthonormal(["0.5"]), "`poles` must list finite numbers, at least one, but is a list"),
        (lambda: Orthonormal([True]), "`poles` must list finite numbers"),
        (
            lambda: Orthonormal.at("fast", 0.01),
            "`continuous_poles` must list finite numbers, .* is 'fast'",
        ),
        (lambda: Orthonormal.laguerre(0.5 + 0.1j, 3), "have one real pole"),
        (lambda: Orthonormal.laguerre(0.5, 0), "Argument `count` must be a whole number from 1"),
        (lambda: Orthonormal.kautz(0.5 + 0.1j, 3), "come in pairs, but 3"),
        (lambda: Orthonormal.kautz(0.5, 2), "use Orthonormal.laguerre"),
        (lambda: Orthonormal.at([-1.0, 0.0], 0.01), "leave out the integrator"),
        (lambda: Orthonormal.at([-1.0], -0.01), "Argument `Ts` must be a positive number"),
        (lambda: Orthonormal((0.5,), first=-1), "Argument `first`"),
    ],
)
def test_bad_input_is_told_in_a_sentence(make, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        make()


def test_coordinates_without_bounds_give_the_poles_back() -> None:
    """Real poles of either sign, and pairs left and right of the imaginary axis."""
    bank = Orthonormal((-0.4, 0.7, 0.6 + 0.3j, 0.6 - 0.3j, -0.2 + 0.5j, -0.2 - 0.5j))
    z, signs = coordinates(bank.kinds, np.asarray(bank.parameters))
    with double_precision():
        parameters = parameters_of(bank.kinds, signs, jnp.asarray(z))
    np.testing.assert_allclose(parameters, bank.parameters, rtol=1e-9)
