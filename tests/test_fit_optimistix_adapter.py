"""The toolkit's own Levenberg-Marquardt against the solvers of optimistix."""

import optimistix as optx
import pytest

import rotflex_jax as rf
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.fit import optimistix_adapter


@pytest.fixture(scope="module")
def recording():
    r = make_record([("coulomb", "hub")], seed=31, seconds=2.0, fs=250.0)
    return rf.Recording(u=r["u"], y=r["y"], Ts=r["Ts"], accept=("units",))


@pytest.fixture(scope="module")
def model():
    return rf.joints.paper() + rf.effects.Coulomb(at="hub", level=0.01)


@pytest.fixture(scope="module")
def own(model, recording):
    return rf.fit(model, recording)


def test_scales_that_have_not_settled_are_no_end(model, recording, monkeypatch):
    monkeypatch.setattr(optimistix_adapter, "MAX_RESCALINGS", 1)
    found = rf.fit(model, recording, minimiser=optx.LevenbergMarquardt(rtol=1e-7, atol=1e-7))
    assert found.status.startswith("stopped")


@pytest.mark.parametrize("kind", [optx.LevenbergMarquardt, optx.Dogleg])
def test_solvers_of_optimistix_end_where_the_own_one_does(kind, model, recording, own):
    found = rf.fit(model, recording, minimiser=kind(rtol=1e-7, atol=1e-7))
    assert found.status == own.status == "converged"
    assert found.cost == pytest.approx(own.cost, rel=1e-6)
    for name in own.free_names:  # the toolkit's stops at 1e-3 nats, or 0.045 std
        assert abs(found[name].value - own[name].value) < 0.05 * own[name].std, name
