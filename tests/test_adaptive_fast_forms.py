"""Fast forms of filters agree with the plain recursions, for several bases and step sizes, and in parts."""

import jax.numpy as jnp
import numpy as np
import pytest
from adaptive_records import coloured, volterra

from rotflex_jax.adaptive import LMS, NLMS, RLS, grid, identify, run
from rotflex_jax.adaptive.fast_forms import (
    LMS_BLOCK_SAMPLES,
    BlockMatrixLMS,
    MatrixLMS,
    block_samples,
    fastest_form,
)
from rotflex_jax.adaptive.filter import tree_sum
from rotflex_jax.adaptive.objectives import evaluate, tuning_data, values_at
from rotflex_jax.adaptive.running import _run
from rotflex_jax.basis import Delays, Orthonormal, Volterra
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import double_precision

N, BEFORE = 150, 12


def plain_lms(phi: np.ndarray, y: np.ndarray, mu: np.ndarray, leakage: float = 0.0) -> tuple:
    """Errors and final weights of LMS by the recursion of textbooks, in NumPy."""
    w, e = np.zeros(phi.shape[1]), np.empty(len(y))
    for k in range(len(y)):
        e[k] = y[k] - w @ phi[k]
        w = (1 - mu * leakage) * w + mu * e[k] * phi[k]
    return e, w


def record(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    u = coloured(N + BEFORE, 0.5, seed)
    return u, u[BEFORE:] + 0.3 * u[BEFORE - 1 : -1] ** 2 + 0.1 * coloured(N, 0.0, seed + 1)


FORMS = [
    (1, 0.0, MatrixLMS),
    (3, 0.0, MatrixLMS),
    (9, 0.0, MatrixLMS),
    (9, 0.4, MatrixLMS),
    (41, 0.0, BlockMatrixLMS),
    (41, 0.4, MatrixLMS),
]


@pytest.mark.parametrize(("memory", "leakage", "form"), FORMS)
@pytest.mark.parametrize(("first", "degrees"), [(0, (0, 1, 2)), (2, (2,))])
def test_every_form_is_the_textbook(memory: int, leakage: float, form: type, first: int, degrees) -> None:
    u, y = record()
    basis = Volterra(Delays(memory, first=first), degrees=[d for d in degrees if d], constant=0 in degrees)
    mu = basis.step_sizes({0: 2e-3, 1: 5e-3 / memory, 2: 5e-3 / memory**2})
    filter = LMS(mu, leakage=leakage)
    assert type(fastest_form(filter, basis, True)) is form
    late = np.concatenate([np.zeros(first), u])[: len(u)]
    phi = volterra(late, memory)[:, 0 if 0 in degrees else 1 :]
    phi = phi if 1 in degrees else phi[:, memory:]
    e, w = plain_lms(phi[BEFORE:], y, mu, leakage)
    got = run(filter, u, y, basis=basis)
    np.testing.assert_allclose(got.errors, e, atol=1e-13)
    np.testing.assert_allclose(got.weights, w, atol=1e-14)


def test_step_sizes_that_differ_within_a_degree_are_kept_apart() -> None:
    u, y = record()
    basis = Volterra(Delays(41))
    mu = np.random.default_rng(0).uniform(1e-6, 1e-4, basis.size)
    assert type(fastest_form(LMS(mu), basis, True)) is MatrixLMS
    np.testing.assert_allclose(
        run(LMS(mu), u, y, basis=basis).errors, plain_lms(basis.regressors(u)[BEFORE:], y, mu)[0], atol=1e-13
    )


@pytest.mark.parametrize("memory", [4, 41])
def test_path_and_going_on_are_those_of_stored_regressors(memory: int) -> None:
    u, y = record()
    basis, filter = Volterra(Delays(memory)), LMS(1e-5)
    phi = basis.regressors(u)[BEFORE:]
    plain, quick = run(filter, phi, y, keep_every=40), run(filter, u, y, basis=basis, keep_every=40)
    np.testing.assert_allclose(quick.path, plain.path, atol=1e-15)
    # The input of the second part contains the earlier samples, which fill the delays.
    cut = 3 * LMS_BLOCK_SAMPLES + 3
    one = run(filter, u[: BEFORE + cut], y[:cut], basis=basis)
    two = run(filter, u, y[cut:], basis=basis, state=one.state)
    np.testing.assert_allclose(np.concatenate([one.errors, two.errors]), plain.errors, atol=1e-14)


@pytest.mark.parametrize(("memory", "length"), [(3, 4), (5, 4), (6, 2), (12, 16)])
@pytest.mark.parametrize("lam", [1.0, 0.97])
def test_rls_in_blocks_is_least_squares(memory: int, length: int, lam: float) -> None:
    u, y = record()
    basis = Volterra(Delays(memory))
    assert block_samples(basis.size) == length
    filter, phi = RLS(lam, delta=50.0), basis.regressors(u)[BEFORE:]
    got, plain = run(filter, u, y, basis=basis), run(filter, phi, y)
    np.testing.assert_allclose(got.errors, plain.errors, atol=1e-11)
    np.testing.assert_allclose(got.weights, plain.weights, atol=1e-11)
    # The weights that minimise sum lam^(n-k) e_k^2 + lam^n sum w_i^2 / delta.
    root = np.sqrt(lam ** np.arange(N - 1, -1, -1))
    ridge = np.eye(basis.size) * np.sqrt(lam**N / 50.0)
    best = np.linalg.lstsq(np.vstack([phi * root[:, None], ridge]), np.append(y * root, 0 * ridge[0]))[0]
    np.testing.assert_allclose(got.weights, best, atol=1e-9)


def test_rls_in_blocks_goes_on() -> None:
    u, y = record()
    basis, filter, cut = Volterra(Delays(3)), RLS(0.99, delta=10.0), 53
    one = run(filter, u[: BEFORE + cut], y[:cut], basis=basis)
    two = run(filter, u, y[cut:], basis=basis, state=one.state)
    plain = run(filter, basis.regressors(u)[BEFORE:], y)
    np.testing.assert_allclose(np.concatenate([one.errors, two.errors]), plain.errors, atol=1e-11)


@pytest.mark.parametrize("memory", [5, 12])
def test_rls_in_blocks_survives_what_an_inverse_matrix_does_not(memory: int) -> None:
    # One sine excites few directions; with forgetting, eigenvalues of P differ by more than 16 digits.
    t = np.arange(4000)
    u = np.sin(0.3 * t)
    y = u + 0.2 * u**2 + 0.01 * np.random.default_rng(0).normal(size=len(t))
    got = run(RLS(0.99, delta=1e6), u, y, basis=Volterra(Delays(memory)))
    spread = np.linalg.svd(got.state.S, compute_uv=False)
    assert (spread[0] / spread[-1]) ** 2 > 1e16
    assert got.status == "ok"
    assert np.std(got.errors[-500:]) < 0.02


@pytest.mark.parametrize("filter", [NLMS(0.3), RLS(0.99, delta=10.0)], ids=["nlms", "rls"])
def test_other_filters_and_banks_run_on_a_basis_too(filter) -> None:
    u, y = record()
    for basis in (Volterra(Delays(3), order=3, layout="full"), Volterra(Orthonormal([0.5, 0.3]))):
        given = run(filter, basis.regressors(u)[BEFORE:], y)
        np.testing.assert_allclose(run(filter, u, y, basis=basis).errors, given.errors, atol=1e-11)


def test_identify_is_a_run_from_the_first_scored_sample() -> None:
    u, y = record()
    recording = Recording(u=u[BEFORE:], y=y, Ts=0.01, channels="alpha", n_init=20)
    basis, filter = Volterra(Delays(9)), LMS(1e-4)
    found = identify(filter, basis, recording, "alpha")
    plain = run(filter, basis.regressors(recording.u)[20:], y[20:])
    np.testing.assert_allclose(found.run.errors, plain.errors, atol=1e-14)


def test_other_values_compile_nothing_again() -> None:
    u, y = record()
    basis = Volterra(Delays(9))
    run(LMS(1e-4), u, y, basis=basis)
    before = _run.programs_made
    run(LMS(2e-4), 2 * u, y, basis=Volterra(Delays(9)))
    assert _run.programs_made == before


@pytest.mark.parametrize("objective", ["final", "mean_error", "last_half"])
@pytest.mark.parametrize("leakage", [0.0, 0.1])
def test_a_sweep_is_each_setting_by_itself(objective, leakage) -> None:
    parts = [record(seed) for seed in (0, 2, 4)]
    listed = [Recording(u=u[BEFORE:], y=y, Ts=0.01, channels="alpha", n_init=10) for u, y in parts]
    basis = Volterra(Delays(3))

    def build(s):
        return LMS(basis.step_sizes({0: s["a"], 1: s["b"], 2: s["a"]}), leakage=leakage)

    points = np.random.default_rng(0).uniform(1e-4, 1e-2, (11, 2))
    with double_precision():
        data = tuning_data(basis, listed, "alpha", objective)
        swept = values_at(jnp.asarray(points), data, names=("a", "b"), build=build, objective=objective)
        each = [evaluate(data, objective, build({"a": a, "b": b})) for a, b in points]
    np.testing.assert_allclose(swept, each, rtol=1e-11)


def test_more_settings_than_fit_at_once_are_worked_off_in_parts() -> None:
    u, y = record()
    recording = Recording(u=u[BEFORE:], y=y, Ts=0.01, channels="alpha")
    basis = Volterra(Delays(12))  # 91 weights: 32 settings at a time

    def build(s):
        return LMS(s["mu"])

    axis = np.geomspace(1e-5, 1e-3, 100)
    found = grid(build, {"mu": axis}, basis, [recording], "alpha", objective="mean_error")
    for k in (0, 31, 32, 99):
        alone = grid(build, {"mu": axis[k : k + 1]}, basis, [recording], "alpha", objective="mean_error")
        assert found.values[k] == pytest.approx(alone.value, rel=1e-12)


@pytest.mark.parametrize("size", [1, 2, 7, 21, 64])
def test_a_sum_by_halves_is_the_sum(size: int) -> None:
    p = np.random.default_rng(size).normal(size=(size, 3)).astype(np.float32)
    np.testing.assert_allclose(tree_sum(jnp.asarray(p)), p.astype(float).sum(axis=0), atol=1e-5)


def test_an_output_longer_than_its_input_is_refused() -> None:
    with pytest.raises(InputError, match="no longer than its input"):
        run(LMS(0.1), np.ones(5), np.ones(6), basis=Volterra(Delays(2)))


def test_a_bank_is_no_basis() -> None:
    with pytest.raises(InputError, match="basis such as Volterra"):
        run(LMS(0.1), np.ones(5), np.ones(5), basis=Delays(2))
