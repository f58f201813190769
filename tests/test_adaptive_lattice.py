"""The Volterra lattice gives the same errors and weights as RLS on explicit Volterra regressors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adaptive_records import coloured, volterra

from rotflex_jax.adaptive import RLS, VolterraLattice, run
from rotflex_jax.adaptive.lattice import monomials
from rotflex_jax.adaptive.rls import potter_update
from rotflex_jax.errors import InputError


def record(N: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A coloured input, and an output that no second-order Volterra series describes exactly."""
    u = coloured(N, 0.8, seed)
    y = np.tanh(u) + 0.5 * np.roll(u, 3) ** 2 + 1.0
    return u, y + 0.1 * np.random.default_rng(seed + 1).normal(size=N)


def direct(u: np.ndarray, y: np.ndarray, memory: int, lam: float, delta: np.ndarray) -> np.ndarray:
    """A-priori errors of the plain recursion for P, in extended precision."""
    phi, P = volterra(u, memory).astype(np.longdouble), np.diag(delta.astype(np.longdouble))
    w, errors = np.zeros(len(P), np.longdouble), []
    for row, target in zip(phi, y, strict=True):
        # With the outer product of the gain and v, the asymmetry by rounding would grow without bound.
        v = P @ row
        left = lam + row @ v
        errors.append(target - w @ row)
        w, P = w + v * errors[-1] / left, (P - np.outer(v, v) / left) / lam
    return np.array(errors, float)


@pytest.mark.parametrize("lam", [1.0, 0.99])
@pytest.mark.parametrize("memory", range(1, 9))
def test_its_errors_and_weights_are_those_of_rls(memory: int, lam: float) -> None:
    u, y = record(600)
    lattice = VolterraLattice(memory, lam, delta=100.0)
    got = run(lattice, u, y)
    wanted = run(RLS(lam, delta=lattice.start), volterra(u, memory), y)
    scale = np.max(np.abs(wanted.errors))
    np.testing.assert_allclose(got.errors, wanted.errors, atol=1e-13 * scale)
    np.testing.assert_allclose(got.weights, wanted.weights, atol=1e-12)


@pytest.mark.parametrize("lam", [1.0, 0.9])
def test_it_stays_so_over_a_long_run(lam: float) -> None:
    """Errors and weights of the lattice still agree with RLS after 5000 samples."""
    u, y = record(5000, seed=2)
    lattice = VolterraLattice(5, lam)
    got = run(lattice, u, y, keep_every=1000)
    wanted = run(RLS(lam, delta=lattice.start), volterra(u, 5), y, keep_every=1000)
    scale = np.max(np.abs(wanted.errors))
    np.testing.assert_allclose(got.errors, wanted.errors, atol=1e-12 * scale)
    np.testing.assert_allclose(got.path, wanted.path, atol=1e-11)


@pytest.mark.parametrize("lam", [1.0, 0.95])
def test_it_agrees_with_extended_precision(lam: float) -> None:
    u, y = record(600, seed=3)
    lattice = VolterraLattice(4, lam, delta=1e6)
    wanted = direct(u, y, 4, lam, lattice.start)
    np.testing.assert_allclose(run(lattice, u, y).errors, wanted, atol=1e-11 * np.max(np.abs(wanted)))


def test_without_a_constant() -> None:
    u, y = record(500)
    lattice = VolterraLattice(2, 0.98, delta=10.0, constant=False)
    got = run(lattice, u, y)
    wanted = run(RLS(0.98, delta=lattice.start), volterra(u, 2, constant=False), y)
    np.testing.assert_allclose(got.errors, wanted.errors, atol=1e-13 * np.max(np.abs(wanted.errors)))
    np.testing.assert_allclose(got.weights, wanted.weights, atol=1e-12)


def test_with_forgetting_the_start_of_delayed_regressors_is_forgotten_too() -> None:
    lattice = VolterraLattice(2, 0.5, delta=8.0)
    # constant, u_t, u_(t-1), u_t^2, u_t u_(t-1), u_(t-1)^2
    np.testing.assert_array_equal(lattice.start, [8, 8, 4, 8, 8, 4])
    u, y = record(600)
    phi = volterra(u, 2)
    wrong = run(RLS(0.5, delta=8.0), phi, y).errors
    assert np.max(np.abs(run(lattice, u, y).errors - wrong)) > 1e-3


def test_in_single_precision() -> None:
    u, y = record(3000, seed=4)
    single = run(VolterraLattice(3, 0.99), u.astype(np.float32), y.astype(np.float32))
    double = run(VolterraLattice(3, 0.99), u, y)
    assert single.status == "ok"
    late = slice(100, None)
    np.testing.assert_allclose(single.errors[late], double.errors[late], atol=2e-3)


def test_it_counts_its_weights() -> None:
    for memory in (1, 3):
        assert VolterraLattice(memory).size == volterra(np.zeros(9), memory).shape[1]
        assert len(VolterraLattice(memory).start) == VolterraLattice(memory).size
        assert run(VolterraLattice(memory), np.ones(600), np.ones(600)).weights.shape == (
            VolterraLattice(memory).size,
        )
    assert len(monomials(5)) == 20


def test_the_root_is_that_of_the_inverse_gram_matrix() -> None:
    rng = np.random.default_rng(5)
    S, phi = rng.normal(size=(4, 4)), rng.normal(size=4)
    before = np.linalg.inv(S @ S.T)
    with jax.enable_x64(True):
        new, g, left = (np.asarray(x) for x in potter_update(jnp.asarray(S), jnp.asarray(phi), 0.9, 0.3))
    after = 0.9 * before + 0.3 * np.outer(phi, phi)
    np.testing.assert_allclose(np.linalg.inv(new @ new.T), after, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(g, 0.3 * np.linalg.solve(after, phi), rtol=1e-10)
    assert left == pytest.approx(0.3 * (1 - 0.3 * phi @ np.linalg.solve(after, phi)), rel=1e-10)


@pytest.mark.parametrize("settings", [{"memory": 0}, {"memory": 2.0}, {"memory": 2, "lam": 1.5}])
def test_settings_out_of_range_are_refused(settings: dict) -> None:
    with pytest.raises(InputError, match=r"Argument `(memory|lam)` must"):
        VolterraLattice(**settings)


def test_complex_data_are_refused() -> None:
    with pytest.raises(InputError, match="VolterraLattice works on real data"):
        run(VolterraLattice(2), np.ones(5) * 1j, np.ones(5))
