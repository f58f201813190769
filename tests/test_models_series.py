"""A series with fixed weights: its simulations, its kernels, and the inputs that it refuses."""

import numpy as np
import pytest

from rotflex_jax.basis import Delays, GramSchmidt, Orthonormal, Volterra
from rotflex_jax.errors import InputError
from rotflex_jax.models.series import Series
from rotflex_jax.recording import Recording


def recording(N: int = 60, Ts: float = 0.01, dtype: type = float) -> Recording:
    rng = np.random.default_rng(0)
    return Recording(
        u=rng.standard_normal(N).astype(dtype), y=rng.standard_normal((N, 2)).astype(dtype), Ts=Ts
    )


def test_a_linear_series_is_a_convolution_of_the_input_alone() -> None:
    r, h = recording(), np.array([0.3, -0.2, 0.1])
    series = Series(Volterra(Delays(3), 1, constant=False), h, "alpha", 0.01)
    y_hat = series.simulate(r)
    assert y_hat.shape == (60, 1)
    np.testing.assert_allclose(y_hat[:, 0], np.convolve(r.u, h)[:60], atol=1e-15)
    assert series.channels == ("alpha",)
    np.testing.assert_array_equal(series.measured(r)[:, 0], r.y[:, 1])


def test_zero_kernels_give_the_constant() -> None:
    series = Series(Volterra(Delays(3)), np.array([0.7, *np.zeros(9)]), "alpha", 0.01)
    np.testing.assert_array_equal(series.simulate(recording()), np.full((60, 1), 0.7))


def test_kernels_are_those_of_the_basis_orthogonalised_or_not() -> None:
    r = recording()
    raw = Volterra(Orthonormal((0.5, 0.3)), 2)
    basis = GramSchmidt.of(raw, r.u)
    w = np.random.default_rng(1).standard_normal(basis.size)
    one, other = Series(basis, w, "alpha", 0.01), Series(raw, basis.raw_weights(w), "alpha", 0.01)
    np.testing.assert_allclose(one.simulate(r), other.simulate(r), atol=1e-12)
    for degree in (0, 1, 2):
        np.testing.assert_allclose(one.kernels(9)[degree], other.kernels(9)[degree], atol=1e-12)
    assert other.kernels()[2].shape == (raw.bank.reach,) * 2


def test_precision_follows_the_recording() -> None:
    series = Series(Volterra(Delays(3)), np.ones(10), "alpha", 0.01)
    assert series.simulate(recording(dtype=np.float32)).dtype == np.float32
    assert series.simulate(recording()).dtype == np.float64


def test_it_says_what_it_is() -> None:
    series = Series(Volterra(Delays(1)), np.array([0.1, 0.2, 0.3]), "alpha", 0.01)
    assert str(series).splitlines() == [
        "Series of alpha, 3 terms, every 0.01 s",
        "  1: 0.1 rad",
        "  u[t]: 0.2 rad/V",
        "  u[t]^2: 0.3 rad/V^2",
    ]


def test_weights_cannot_be_changed_from_outside() -> None:
    w = np.zeros(3)
    series = Series(Volterra(Delays(1)), w, "alpha", 0.01)
    w[0] = 5.0
    assert series.weights[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        series.weights[0] = 1.0


def test_a_recording_may_come_in_a_list() -> None:
    series = Series(Volterra(Delays(1)), np.array([0.5, 2.0, 0.0]), "alpha", 0.01)
    np.testing.assert_allclose(series.simulate([recording()])[:, 0], 0.5 + 2.0 * recording().u)
    assert np.array_equal(series.measured([recording()]), series.measured(recording()))


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda b: Series(b.bank, [1.0], "alpha", 0.01), "is needed, but Delays was given"),
        (
            lambda b: Series(b, [1.0], "alpha", 0.01),
            r"3 regressors, but the weights are float64 of shape \(1,\)",
        ),
        (lambda b: Series(b, [1.0, np.inf, 0.0], "alpha", 0.01), r"Weight 'u\[t\]' is not finite"),
        (lambda b: Series(b, [1j, 0, 0], "alpha", 0.01), "complex128"),
        (lambda b: Series(b, np.ones(3), "alpha", 0.0), "Argument `Ts` must be a positive number"),
        (
            lambda b: Series(b, np.ones(3), "alpha", 0.02).simulate(recording()),
            "period of 0.02 s, but the recording has 0.01",
        ),
        (lambda b: Series(b, np.ones(3), "tip", 0.01).measured(recording()), "no channel 'tip'"),
        (lambda b: Series(b, np.ones(3), "alpha", 0.01).simulate(recording().u), "must be a Recording"),
    ],
)
def test_bad_input_is_told_in_a_sentence(make, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        make(Volterra(Delays(1)))
