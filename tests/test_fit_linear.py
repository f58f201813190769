"""Batch fits of a basis against normal equations and numpy, and the effect of friction on the degrees."""

import functools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from rotflex_jax.basis import Delays, GramSchmidt, Orthonormal, Volterra
from rotflex_jax.data.excitation import noise
from rotflex_jax.errors import InputError
from rotflex_jax.fit import forward_regression, least_squares
from rotflex_jax.fit.linear import ROWS_PER_FACTOR, RegressionRows, factor, solve
from rotflex_jax.recording import Recording
from rotflex_jax.reproduce.plants import plant, response


def record(N: int = 600, seed: int = 0, sigma: float = 0.1) -> Recording:
    rng = np.random.default_rng(seed)
    u = rng.standard_normal(N)
    late = np.concatenate([[0.0], u[:-1]])
    y = 0.2 + u - 0.5 * late + 0.3 * u * late + sigma * rng.standard_normal(N)
    return Recording(u=u, y=y, Ts=0.1, channels="alpha", n_init=20)


@functools.cache
def joint(name: str, N: int = 6000, seed: int = 5, sign: float = 1.0) -> Recording:
    """Deflection of a joint with known effects, every 0.1 s; steps of 1 ms are enough for signs and sizes."""
    Ts = 0.1
    u = sign * noise(N, Ts, seed=seed)
    return Recording(u=u, y=response(plant(name), u, Ts, step=1e-3)[:, 1], Ts=Ts, channels="alpha")


def test_weights_are_those_of_the_normal_equations() -> None:
    basis, r = Volterra(Delays(3)), record()
    fit = least_squares(basis, r, "alpha")
    phi, y = basis.regressors(r.u)[20:], r.y[20:, 0]
    np.testing.assert_allclose(fit.weights, np.linalg.solve(phi.T @ phi, phi.T @ y), atol=1e-12)
    assert fit.status == "converged"
    assert fit.rank == basis.size
    assert fit.condition == pytest.approx(np.linalg.cond(phi.T @ phi), rel=1e-9)
    e = y - phi @ fit.weights
    assert fit.nmse == pytest.approx(e @ e / np.sum((y - y.mean()) ** 2), rel=1e-9)
    assert fit.noise["alpha"] == pytest.approx(np.sqrt(np.mean(e**2)), rel=1e-9)
    np.testing.assert_allclose(fit.model.simulate(r)[20:, 0], y - e, atol=1e-12)


def test_intervals_are_the_usual_ones_where_the_residual_is_white() -> None:
    basis, r = Volterra(Delays(2)), record(20_000)
    fit = least_squares(basis, r)
    phi = basis.regressors(r.u)[20:]
    usual = 0.1 * np.sqrt(np.diag(np.linalg.inv(phi.T @ phi)))
    np.testing.assert_allclose(fit.std, usual, rtol=0.15)
    true = {"1": 0.2, "u[t]": 1.0, "u[t-1]": -0.5, "u[t] * u[t-1]": 0.3}
    for name, std in zip(basis.names, fit.std, strict=True):
        assert abs(fit[name].value - true.get(name, 0.0)) < 4.5 * std
    np.testing.assert_allclose(fit.t, fit.weights / fit.std)


@pytest.mark.parametrize("blocks", [1, 3])
def test_the_triangular_factor_is_that_of_all_rows(blocks: int) -> None:
    A = np.random.default_rng(0).standard_normal((blocks * ROWS_PER_FACTOR - 7, 5))
    R = factor(A)
    np.testing.assert_allclose(R.T @ R, A.T @ A, rtol=1e-11, atol=1e-9)
    assert factor(A[:3]).shape == (5, 5)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 999),
    ridge=st.sampled_from([0.0, 1e-6, 0.1, 10.0]),
    rank=st.integers(1, 6),
)
def test_any_problem_is_solved_as_numpy_solves_it(seed: int, ridge: float, rank: int) -> None:
    rng = np.random.default_rng(seed)
    phi = rng.standard_normal((30, rank)) @ rng.standard_normal((rank, 6))
    y = rng.standard_normal(30)
    # A ridge is equivalent to one more row for each weight, with zero as its target.
    padded = np.concatenate([phi, np.sqrt(ridge) * np.eye(6)])
    target = np.concatenate([y, np.zeros(6)])
    expected = np.linalg.lstsq(padded, target, rcond=1e-9)[0]
    found = solve(factor(np.column_stack([phi, y])), ridge)
    # The minimum norm depends on the units of the columns, the modelled output does not.
    np.testing.assert_allclose(phi @ found.w, phi @ expected, atol=1e-7)
    assert found.rank == rank
    if ridge or rank == 6:
        np.testing.assert_allclose(found.w, expected, atol=1e-6, rtol=1e-6)


def test_the_full_layout_has_the_minimum_norm_and_that_is_symmetric() -> None:
    r = record(1000)
    full = least_squares(Volterra(Delays(5), layout="full", constant=False), r)
    triangular = least_squares(Volterra(Delays(5), constant=False), r)
    assert (full.rank, full.model.basis.size) == (20, 30)
    assert full.status == "converged, minimum norm (rank 20 of 30)"
    kernel = full.weights[5:].reshape(5, 5)
    assert np.max(np.abs(kernel - kernel.T)) < 1e-14
    np.testing.assert_allclose(full.model.simulate(r), triangular.model.simulate(r), atol=1e-12)
    for degree in (1, 2):
        np.testing.assert_allclose(
            full.model.kernels()[degree], triangular.model.kernels()[degree], atol=1e-13
        )
    # In the symmetric kernel a product has two equal entries, each with half the std of the single weight.
    wide = triangular["u[t] * u[t-1]"].std
    assert full["u[t] * u[t-1]"].std == pytest.approx(wide / 2, rel=1e-6)
    assert full.condition == pytest.approx(triangular.condition, rel=2.0)


def test_a_column_of_zeros_has_no_interval() -> None:
    u = np.random.default_rng(0).standard_normal(300)
    u[:] = np.sign(u)  # then u^2 equals the constant
    r = Recording(u=u, y=2 * u + 0.01 * np.cos(np.arange(300.0)), Ts=0.1, channels="alpha")
    fit = least_squares(Volterra(Delays(1)), r)
    assert fit.rank == 2
    assert fit.weights[0] == pytest.approx(fit.weights[2])
    late = Recording(u=np.eye(1, 300)[0], y=r.y, Ts=0.1, channels="alpha")
    silent = least_squares(Volterra(Delays(2), 1), late)  # the impulse is in the samples that are left out
    assert np.isnan(silent.std[1:]).all()
    assert silent["u[t]"].note == "not determined by these data"


def test_where_no_weight_is_determined_none_has_an_interval() -> None:
    u = np.zeros(300)
    r = Recording(u=u, y=np.cos(np.arange(300.0)), Ts=0.1, channels="alpha", accept=("constant_input",))
    for fit in (
        least_squares(Volterra(Delays(3), 1, constant=False), r),
        forward_regression(Volterra(Delays(3), 1, constant=False), r),
    ):
        assert not fit.weights.any() and np.isnan(fit.std).all()


def test_several_recordings_count_as_one_but_do_not_touch() -> None:
    basis, parts = Volterra(Delays(3)), [record(300, 1), record(500, 2)]
    fit = least_squares(basis, parts)
    phi = np.concatenate([basis.regressors(r.u)[20:] for r in parts])
    y = np.concatenate([r.y[20:, 0] for r in parts])
    np.testing.assert_allclose(fit.weights, np.linalg.lstsq(phi, y, rcond=None)[0], atol=1e-12)
    rows = RegressionRows.of(basis, parts, "alpha", 5)
    assert rows.phi.shape == (790, 10)
    block = rows.blocks(8)
    assert [len(set(rows.segments[block == k])) for k in set(block)] == [1] * 8
    assert np.all(np.diff(block) >= 0)


def test_a_ridge_is_a_penalty_on_the_weights_as_they_are() -> None:
    basis, r = Volterra(Delays(3)), record()
    fit = least_squares(basis, r, ridge=5.0, skip=0)
    phi, y = basis.regressors(r.u), r.y[:, 0]
    expected = np.linalg.solve(phi.T @ phi + 5.0 * np.eye(10), phi.T @ y)
    np.testing.assert_allclose(fit.weights, expected, atol=1e-12)
    assert fit.ridge == 5.0
    # A ridge shrinks the noise of the weights like the weights, here to a half, and so the intervals.
    loud = record(3000, sigma=30.0)
    plain, shrunk = (
        least_squares(Volterra(Delays(3), 1, constant=False), loud, ridge=k) for k in (0.0, 2980.0)
    )
    np.testing.assert_allclose(shrunk.std, plain.std / 2, rtol=0.05)


def test_cross_validation_finds_the_ridge_that_pays() -> None:
    # 120 samples for 91 weights, nearly all of them zero, and a coloured input.
    u = noise(900, 0.1, bandwidth=1.0, seed=1)
    rng = np.random.default_rng(2)
    y = np.convolve(u, 0.7 ** np.arange(12))[:900] + 0.5 * rng.standard_normal(900)
    r = Recording(u=u, y=y, Ts=0.1, channels="alpha", n_init=12)
    train, test = r.slice(0, 120), r.slice(120, 900)
    basis = Volterra(Delays(12))
    plain, chosen = (least_squares(basis, train, ridge=k, skip=12) for k in (0.0, "cv"))
    assert chosen.status == "converged, ridge by cross-validation"

    def error(fit) -> float:
        return float(np.mean((fit.model.simulate(test)[12:, 0] - test.y[12:, 0]) ** 2))

    assert error(chosen) < 0.5 * error(plain)
    # No ridge of a grid is much better on the test data.
    grid = [error(least_squares(basis, train, ridge=k, skip=12)) for k in np.logspace(-2, 4, 13)]
    assert error(chosen) < 1.5 * min(grid)
    # With many data the ridge is small.
    assert least_squares(Volterra(Delays(2)), record(5000), ridge="cv").ridge < 50


def test_symmetric_friction_has_no_quadratic_kernel() -> None:
    fit = least_squares(Volterra(Delays(5)), joint("S1"))
    quadratic = fit.model.basis.degrees == 2
    assert np.max(np.abs(fit.t[quadratic])) < 4
    # The weight at lag zero is left out: the voltage acts on the deflection one sample later.
    assert np.min(np.abs(fit.t[2:6])) > 5
    assert fit.nmse == pytest.approx(0.0174, abs=0.002)


def test_with_every_input_and_its_mirror_the_even_weights_are_nothing() -> None:
    pair = [joint("S1", 800), joint("S1", 800, sign=-1.0)]
    np.testing.assert_array_equal(pair[0].y, -pair[1].y)
    for basis in (Volterra(Delays(5)), Volterra(Orthonormal.at((-34.8, -9 + 18j, -9 - 18j), 0.1), 3)):
        fit = least_squares(basis, pair)
        even = basis.degrees % 2 == 0
        assert np.max(np.abs(fit.weights[even])) < 1e-12
        assert np.min(np.abs(fit.weights[~even]).max()) > 0.01


@pytest.mark.parametrize(("name", "least"), [("S6", 10.0), ("S5s", 25.0)])
def test_what_is_not_symmetric_shows_in_the_quadratic_kernel(name: str, least: float) -> None:
    fit = least_squares(Volterra(Delays(5)), joint(name))
    quadratic = fit.model.basis.degrees == 2
    assert np.max(np.abs(fit.t[quadratic])) > least
    linear = least_squares(Volterra(Delays(5), 1), joint(name))
    assert fit.nmse < (0.85 if name == "S6" else 0.25) * linear.nmse
    # Without a constant the quadratic terms have to represent the mean as well.
    bent = least_squares(Volterra(Delays(5), constant=False), joint(name))
    assert fit.nmse < bent.nmse
    if name == "S5s":
        bare = least_squares(Volterra(Delays(5), 1, constant=False), joint(name))
        published = (0.0314, 0.00419, 0.00405)
        np.testing.assert_allclose([bare.nmse, bent.nmse, fit.nmse], published, rtol=0.05)


def test_an_orthogonalised_basis_gives_the_same_model() -> None:
    r = record()
    raw = Volterra(Delays(3))
    one, other = least_squares(raw, r), least_squares(GramSchmidt.of(raw, r.u), r)
    np.testing.assert_allclose(one.model.simulate(r), other.model.simulate(r), atol=1e-12)
    assert other.condition < 1.2 < one.condition
    # The covariance of the original weights is the same from both bases.
    T = np.asarray(other.model.basis.transform)
    np.testing.assert_allclose(T @ other.covariance @ T.T, one.covariance, rtol=1e-6, atol=1e-12)


def test_the_table_has_a_line_per_weight() -> None:
    fit = least_squares(Volterra(Delays(2)), record())
    lines = str(fit).splitlines()
    assert lines[0].startswith("Series of alpha: converged, residual 0.")
    assert "rank 6 of 6" in lines[1]
    assert lines[2].split() == ["term", "weight", "std", "t", "unit"]
    assert len(lines) == 9
    assert lines[7].split()[0] == "u[t]"
    assert fit.selected == fit.model.basis.names
    with pytest.raises(InputError, match=r"Regressor 'u\[t-9\]' was asked for"):
        fit["u[t-9]"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"basis": Delays(2)}, "is needed, but Delays was given; wrap a bank in a Volterra series"),
        ({"recordings": []}, "No recording was given as `recordings`"),
        ({"ridge": -1.0}, "Argument `ridge` must be 0 or more, or 'cv', but is -1.0"),
        ({"ridge": "best"}, "or 'cv', but is 'best'"),
        ({"ridge": "cv", "blocks": 1}, "`blocks` must be a whole number from 2, but is 1"),
        ({"channel": "tip"}, "no channel 'tip'"),
        ({"skip": 600}, "The first 600 samples are left out, but recording 0 has 600"),
        (
            {
                "recordings": Recording(
                    u=np.sin(np.arange(99.0)), y=np.ones((99, 2)), Ts=0.1, accept="constant"
                )
            },
            "say which with `channel`",
        ),
        ({"recordings": [record(), record().decimate(2)]}, "sampling periods 0.1 s, 0.2 s"),
    ],
)
def test_bad_input_is_told_in_a_sentence(arguments: dict, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        least_squares(**{"basis": Volterra(Delays(2)), "recordings": record(), **arguments})
