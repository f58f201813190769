"""Properties of all filters: causality, continuation from a state, precision, derivatives, divergence."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adaptive_records import noisy_record

from rotflex_jax.adaptive import (
    LMS,
    NLMS,
    RLS,
    AffineProjection,
    Kalman,
    VolterraLattice,
    identify,
    run,
    scan,
)
from rotflex_jax.adaptive.running import _run
from rotflex_jax.basis import Delays, Volterra
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording

FILTERS = {
    "lms": LMS(0.01, leakage=0.02),
    "lms per weight": LMS(np.linspace(0.002, 0.02, 6), leakage=0.01),
    "nlms": NLMS(0.3, eps=0.1),
    "apa": AffineProjection(0.2, eps=0.1, window=3),
    "rls": RLS(0.98, delta=10.0),
    "kalman": Kalman(q=1e-4, r=0.5, p0=10.0),
    "lattice": VolterraLattice(2, 0.98, delta=10.0),
}
every_filter = pytest.mark.parametrize("filter", FILTERS.values(), ids=FILTERS)


def record(filter, N: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Regressors (N, 6), or the input from which the filter computes them, and the output."""
    phi, y = noisy_record(N, memory=2)
    return (phi[:, 1] if filter.from_input else phi), y


def test_a_run_is_said_in_a_line() -> None:
    """Without adaptation the errors are the outputs, here 4 and, in the last quarter, 2."""
    got = run(LMS(0.0), np.ones((8, 1)), np.array([4.0] * 6 + [-2.0] * 2))
    rms = np.sqrt((6 * 16 + 2 * 4) / 8)
    assert str(got) == f"Run of 8 samples, 1 weight: a-priori error {rms:.3g} rms, 2 over the last quarter"
    wrong = run(LMS(mu=3.0), np.ones((100, 1)), np.ones(100))
    assert str(wrong) == "Run of 100 samples, 1 weight: diverged at sample 14"


def test_what_was_identified_is_said_in_two_lines() -> None:
    u = np.random.default_rng(3).normal(size=300)
    recording = Recording(u=u, y=np.c_[2.0 * u], Ts=0.01, channels=("theta",), n_init=20)
    got = identify(NLMS(0.5), Volterra(Delays(2), order=1), recording, "theta")
    first, second = str(got).split("\n")
    assert first == f"Filter for theta over 3 terms, every 0.01 s, online NMSE {got.online_nmse:.3g}"
    assert second == str(got.run) and second.startswith("Run of 280 samples, 3 weights: ")


@every_filter
def test_it_learns(filter) -> None:
    phi, y = record(filter, 2000)
    got = run(filter, phi, y)
    assert got.status == "ok"
    assert not got.diverged
    assert got.errors.shape == (2000,)
    assert got.weights.shape == (6,)
    assert np.std(got.errors[-500:]) < 0.5 * np.std(y)


@every_filter
def test_the_first_error_is_the_output_itself(filter) -> None:
    phi, y = record(filter)
    assert run(filter, phi, y).errors[0] == y[0]


@every_filter
def test_an_error_knows_nothing_of_its_own_sample_or_later_ones(filter) -> None:
    phi, y = record(filter)
    other = y.copy()
    other[100:] += np.linspace(1.0, 2.0, 100)
    a, b = run(filter, phi, y).errors, run(filter, phi, other).errors
    np.testing.assert_array_equal(a[:100], b[:100])
    assert b[100] - a[100] == pytest.approx(1.0, abs=1e-12)


@every_filter
def test_going_on_from_a_state_is_going_on(filter) -> None:
    """Two runs, the second from the state of the first, give the same errors and weights as one run."""
    phi, y = record(filter)
    whole = run(filter, phi, y)
    first = run(filter, phi[:77], y[:77])
    second = run(filter, phi[77:], y[77:], state=first.state)
    np.testing.assert_array_equal(np.concatenate([first.errors, second.errors]), whole.errors)
    np.testing.assert_array_equal(second.weights, whole.weights)


@every_filter
@pytest.mark.parametrize("every", [7, 200])
def test_the_path_holds_the_weights_after_every_so_many_samples(filter, every: int) -> None:
    phi, y = record(filter)
    plain, kept = run(filter, phi, y), run(filter, phi, y, keep_every=every)
    np.testing.assert_array_equal(kept.path_times, np.arange(200 // every + 1) * every)
    np.testing.assert_array_equal(kept.path[0], np.zeros(6))
    np.testing.assert_allclose(kept.errors, plain.errors, atol=1e-12)
    np.testing.assert_allclose(kept.weights, plain.weights, atol=1e-12)
    if every == 7:
        np.testing.assert_allclose(kept.path[5], run(filter, phi[:35], y[:35]).weights, atol=1e-12)
    if every == 200:
        np.testing.assert_allclose(kept.path[-1], plain.weights, atol=1e-12)


@pytest.mark.parametrize("every", [1, 500])
def test_the_path_may_hold_every_sample_or_none(every: int) -> None:
    phi, y = noisy_record(200)
    kept = run(LMS(0.01), phi, y, keep_every=every)
    assert kept.path.shape == (200 // every + 1, 10)
    if every == 1:
        np.testing.assert_allclose(kept.errors, y - np.sum(kept.path[:-1] * phi, axis=1), atol=1e-13)
    np.testing.assert_allclose(kept.weights, run(LMS(0.01), phi, y).weights, atol=1e-14)


def test_without_being_asked_no_path_is_kept() -> None:
    got = run(LMS(0.01), *noisy_record(50))
    assert got.path.shape == (0, 10)
    assert got.path_times.shape == (0,)


@every_filter
def test_it_follows_the_precision_of_the_data(filter) -> None:
    phi, y = record(filter)
    single = run(filter, phi.astype(np.float32), y.astype(np.float32), keep_every=50)
    double = run(filter, phi, y)
    for array in (single.errors, single.weights, single.path, *jax.tree.leaves(single.state)):
        assert array.dtype == np.float32
    for array in (double.errors, double.weights, *jax.tree.leaves(double.state)):
        assert array.dtype == np.float64
    np.testing.assert_allclose(single.errors, double.errors, atol=2e-4 * np.max(np.abs(y)))
    assert run(filter, phi.astype(np.float32), y).errors.dtype == np.float64
    assert not jax.config.read("jax_enable_x64")


def test_whole_numbers_are_taken_as_numbers() -> None:
    got = run(LMS(0.5), np.ones((4, 1), int), np.ones(4, int))
    np.testing.assert_array_equal(got.errors, [1.0, 0.5, 0.25, 0.125])


@every_filter
def test_a_state_is_taken_in_the_precision_of_the_data(filter) -> None:
    phi, y = record(filter)
    first = run(filter, phi.astype(np.float32), y.astype(np.float32))
    assert run(filter, phi, y, state=first.state).errors.dtype == np.float64


@every_filter
def test_new_values_compile_nothing(filter) -> None:
    phi, y = record(filter, 60)
    leaves, shape = jax.tree.flatten(filter)
    run(filter, phi, y)
    compiled = _run.programs_made
    for change in (lambda x: np.asarray(x) * 0.9, lambda x: float(x) * 0.8 if np.ndim(x) == 0 else x * 0.8):
        run(jax.tree.unflatten(shape, [change(x) for x in leaves]), 1.1 * phi, y + 0.1)
    assert _run.programs_made == compiled
    run(filter, phi[:59], y[:59])
    assert _run.programs_made == compiled + 1  # a new length compiles, which shows that the count works


@every_filter
def test_derivatives_by_every_setting_are_those_of_differences(filter) -> None:
    phi, y = record(filter, 80)
    with jax.enable_x64(True):
        phi, y = jnp.asarray(phi), jnp.asarray(y)
        leaves, shape = jax.tree.flatten(jax.tree.map(lambda x: jnp.asarray(x, float), filter))

        def cost(factors: jax.Array) -> jax.Array:
            scaled = jax.tree.unflatten(shape, [x * s for x, s in zip(leaves, factors, strict=True)])
            state, errors = scan(scaled, phi, y)
            return jnp.log(jnp.mean(errors**2)) + jnp.sum(scaled.weights(state) ** 2)

        one, moved = jnp.ones(len(leaves)), 1e-5 * np.eye(len(leaves))
        slopes = np.asarray(jax.jit(jax.jacfwd(cost))(one))
        costs = np.asarray(jax.jit(jax.vmap(cost))(jnp.asarray(np.concatenate([1 + moved, 1 - moved]))))
    np.testing.assert_allclose(slopes, (costs[: len(leaves)] - costs[len(leaves) :]) / 2e-5, rtol=1e-5)
    assert np.all(slopes != 0)


def test_a_batch_of_settings_is_one_call() -> None:
    phi, y = noisy_record(100)
    steps = np.array([0.001, 0.01, 0.03])
    with jax.enable_x64(True):
        phi_, y_ = jnp.asarray(phi), jnp.asarray(y)
        batch = jax.jit(jax.vmap(lambda mu: scan(LMS(mu), phi_, y_)[1]))(jnp.asarray(steps))
        forgetting = jax.vmap(lambda f: scan(f, phi_, y_)[1])(RLS(jnp.asarray([1.0, 0.9]), jnp.ones(2)))
    for mu, errors in zip(steps, batch, strict=True):
        np.testing.assert_allclose(errors, run(LMS(mu), phi, y).errors, atol=1e-13)
    np.testing.assert_allclose(forgetting[1], run(RLS(0.9, 1.0), phi, y).errors, atol=1e-12)


# --- divergence


def test_divergence_is_reported_at_its_sample_with_the_errors_up_to_there() -> None:
    # With a constant regressor 1 the error is multiplied by 1 - mu = -2 at every sample.
    got = run(LMS(3.0), np.ones((2000, 1)), np.ones(2000))
    assert got.status == "diverged at sample 14"
    assert got.diverged
    np.testing.assert_array_equal(got.errors[:15], (-2.0) ** np.arange(15))
    assert np.all(np.isnan(got.errors[15:]))


def test_divergence_to_infinity_within_one_sample_is_reported() -> None:
    phi = np.ones((10, 1), np.float32)
    phi[4] = 1e30
    got = run(LMS(0.1), phi, np.ones(10, np.float32))
    assert got.status in ("diverged at sample 4", "diverged at sample 5")


def test_an_unstable_volterra_filter_is_reported() -> None:
    phi, y = noisy_record(3000)
    assert run(LMS(0.3), phi, y).status.startswith("diverged at sample ")


def test_units_of_the_output_do_not_decide_about_divergence() -> None:
    phi, y = noisy_record(500)
    for scale in (1e-12, 1e12):
        assert run(LMS(0.01), phi, scale * y).status == "ok"
        assert run(LMS(0.3), phi, scale * y).status == run(LMS(0.3), phi, y).status


def test_silence_is_no_divergence() -> None:
    assert run(LMS(0.1), np.ones((20, 2)), np.zeros(20)).status == "ok"


def test_a_state_for_larger_outputs_does_not_diverge_on_smaller_ones() -> None:
    phi = np.ones((50, 1))
    first = run(LMS(0.5), phi, np.full(50, 1e9))
    assert run(LMS(0.5), phi, np.full(50, 1e-3), state=first.state).status == "ok"


# --- invalid arguments


@pytest.mark.parametrize(
    ("phi", "y", "options", "phrase"),
    [
        (np.ones((5, 2)), np.ones(4), {}, r"but have \(5, 2\) and \(4,\)"),
        (np.ones(5), np.ones(5), {}, r"LMS must have the shapes \(N, P\) and \(N,\)"),
        (np.ones((0, 2)), np.ones(0), {}, "for every output sample"),
        (np.ones((5, 2)), np.ones((5, 1)), {}, r"but have \(5, 2\) and \(5, 1\)"),
        (np.ones((5, 2)), np.array([1, 2, np.nan, 4, 5]), {}, "`y` must be finite, but is not at sample 2"),
        (np.full((5, 2), np.inf), np.ones(5), {}, "`phi` must be finite, but is not at sample 0"),
        (np.full((5, 2), "a"), np.ones(5), {}, "`phi` must hold numbers"),
        (np.ones((5, 2)), np.ones(5), {"keep_every": -1}, "`keep_every` must be a whole number"),
        (np.ones((5, 2)), np.ones(5), {"keep_every": 2.0}, "`keep_every` must be a whole number"),
    ],
)
def test_what_makes_no_sense_is_refused(phi, y, options: dict, phrase: str) -> None:
    with pytest.raises(InputError, match=phrase):
        run(LMS(0.1), phi, y, **options)


def test_a_state_of_another_filter_or_size_is_refused() -> None:
    phi, y = noisy_record(20)
    state = run(LMS(0.01), phi, y).state
    with pytest.raises(InputError, match="`state` must come from a run of the same kind of filter"):
        run(RLS(), phi, y, state=state)
    with pytest.raises(InputError, match="for 3 is needed"):
        run(LMS(0.01), phi[:, :3], y, state=state)


def test_the_lattice_wants_the_input_itself() -> None:
    phi, y = noisy_record(20)
    with pytest.raises(InputError, match=r"VolterraLattice must have the shapes \(N,\) and \(N,\)"):
        run(VolterraLattice(3), phi, y)
