"""A filter on a recording: its start, its final model, and its errors online and with frozen weights."""

import numpy as np
import pytest
from adaptive_records import coloured, lags, volterra

from rotflex_jax import InputError, Recording
from rotflex_jax.adaptive import LMS, NLMS, RLS, VolterraLattice, identify
from rotflex_jax.basis import Delays, Orthonormal, Volterra

WEIGHTS = np.array([0.3, 1.0, -0.5, 0.2, 0.4, -0.1])


def recording(N: int = 600, seed: int = 0, offset: float = 0.0, noise: float = 0.0) -> Recording:
    """A second-order Volterra plant of memory 2 with a constant, recorded as the deflection."""
    u = coloured(N, 0.5, seed) + offset
    y = volterra(u, 2) @ WEIGHTS + noise * np.random.default_rng(seed).normal(size=N)
    return Recording(u=u, y=np.stack([np.cumsum(u), y], axis=1), Ts=0.01)


def test_it_finds_the_weights_and_the_model_simulates() -> None:
    train, test = recording(), recording(seed=1)
    found = identify(RLS(delta=1e8), Volterra(Delays(2)), train, "alpha")
    np.testing.assert_allclose(found.run.weights, WEIGHTS, atol=1e-7)
    np.testing.assert_allclose(found.model.simulate(test)[:, 0], test.channel("alpha"), atol=1e-6)
    assert found.frozen_nmse(test) < 1e-12
    assert found.model.channels == ("alpha",)
    assert str(found.model)
    np.testing.assert_allclose(found.model.kernels()[2], [[0.2, 0.2], [0.2, -0.1]], atol=1e-7)


def test_means_stay_where_they_are() -> None:
    # No mean is subtracted, so the weights are the same about another operating point.
    found = identify(RLS(delta=1e8), Volterra(Delays(2)), recording(offset=1.5), "alpha")
    np.testing.assert_allclose(found.run.weights, WEIGHTS, atol=1e-6)


def test_the_filter_starts_at_n_init_with_its_memory_filled() -> None:
    record = recording()
    found = identify(LMS(0.01), Volterra(Delays(2)), record, "alpha", keep_every=100)
    n = record.n_init
    assert n >= 10
    assert found.run.errors.shape == (600 - n,)
    assert found.run.errors[0] == record.channel("alpha")[n]
    # The second error, from the weights after one step from zero.
    phi = volterra(record.u, 2)[n : n + 2]
    y = record.channel("alpha")[n : n + 2]
    assert found.run.errors[1] == pytest.approx(y[1] - 0.01 * y[0] * phi[0] @ phi[1], abs=1e-14)
    assert found.run.path.shape == ((600 - n) // 100 + 1, 6)


def test_the_lattice_identifies_too() -> None:
    train, test = recording(), recording(seed=1)
    for first in (0, 1):
        basis = Volterra(Delays(2 + first, first=0) if first == 0 else Delays(2, first=1))
        lattice = identify(VolterraLattice(2, 0.99), basis, train, "alpha")
        direct = identify(RLS(0.99), basis, train, "alpha")
        # The lattice assumes zero input before `n_init`; with forgetting, this difference decays.
        np.testing.assert_allclose(lattice.run.weights, direct.run.weights, atol=0.02)
        np.testing.assert_allclose(lattice.run.errors[-50:], direct.run.errors[-50:], atol=0.02)
    assert lattice.frozen_nmse(test) == pytest.approx(direct.frozen_nmse(test), rel=0.05)


@pytest.mark.parametrize(
    "basis",
    [
        Volterra(Delays(3)),
        Volterra(Delays(2), order=1),
        Volterra(Delays(2), constant=False),
        Volterra(Delays(2), layout="full"),
        Volterra(Orthonormal.laguerre(0.5, 2)),
    ],
)
def test_the_lattice_refuses_regressors_that_are_not_its_own(basis) -> None:
    with pytest.raises(InputError, match=r"needs the basis Volterra\(Delays\(2\), order=2, constant=True\)"):
        identify(VolterraLattice(2), basis, recording(), "alpha")


def test_moving_weights_look_better_than_the_model_they_make() -> None:
    # The input is slow and the memory of the plant is longer than that of the filter. The two weights
    # track the output, but frozen they do not predict it.
    def slow(seed: int) -> Recording:
        u = coloured(4000, 0.98, seed)
        y = lags(u, 60) @ np.sin(np.arange(60) / 8)
        return Recording(u=u, y=y, Ts=0.01, channels="alpha")

    basis = Volterra(Delays(2), order=1)
    found = identify(NLMS(0.3), basis, slow(2), "alpha")
    held_out = slow(3)
    assert found.run.status == "ok"
    y = held_out.channel("alpha")[held_out.n_init :]
    e = y - found.model.simulate(held_out)[held_out.n_init :, 0]
    assert found.frozen_nmse(held_out) == pytest.approx(np.sum(e**2) / np.sum((y - y.mean()) ** 2), rel=1e-12)
    assert found.online_nmse < 0.5 * found.frozen_nmse(held_out)


def test_a_diverged_filter_has_a_status_and_no_model() -> None:
    found = identify(LMS(1.0), Volterra(Delays(2)), recording(), "alpha")
    assert found.run.status.startswith("diverged at sample ")
    assert np.isnan(found.online_nmse)
    with pytest.raises(InputError, match=r"diverged at sample .* make no model; give a smaller step size"):
        _ = found.model


def test_it_follows_the_precision_of_the_recording() -> None:
    double = recording()
    single = Recording(u=double.u.astype(np.float32), y=double.y.astype(np.float32), Ts=0.01)
    for record, dtype in ((double, np.float64), (single, np.float32)):
        assert identify(LMS(0.01), Volterra(Delays(2)), record, "alpha").run.errors.dtype == dtype


def test_a_channel_that_is_not_there_is_refused() -> None:
    with pytest.raises(InputError, match="no channel 'beta'"):
        identify(LMS(0.01), Volterra(Delays(2)), recording(), "beta")
