"""The learned torque: splines against SciPy's, smoothness against its likelihood, maps against the truth."""

import dataclasses
import importlib
import json
import re
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.optimize import minimize

from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.discover.hypothesis import Hypothesis, Whitener
from rotflex_jax.discover.spline_map import (
    FUNCTIONS,
    FittedMap,
    Formula,
    MapEquations,
    Term,
    _smoother,
    penalties,
    read_formula,
    terms_to_try,
)
from rotflex_jax.effects import CATALOG, LearnedTorque, QuadraticDrag
from rotflex_jax.errors import InputError
from rotflex_jax.joints import paper
from rotflex_jax.mechanism import simulate
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import double_precision

learned = importlib.import_module("rotflex_jax.discover.learned_torque")

TRUE = {"hub_damping": 0.004, "joint_damping": 0.003}
MAP = LearnedTorque(at="hub", position=(-1.0, 2.0), speed=(-3.0, 4.0), bend=0.2, count=(5, 9))


# -- the effect ------------------------------------------------------------------------------------------


def test_splines_are_those_of_scipy():
    rng = np.random.default_rng(0)
    q, w = rng.uniform(-1, 2, 50), rng.uniform(-3, 4, 50)
    s = np.arcsinh(w / 0.2)
    low, high = np.arcsinh(-3 / 0.2), np.arcsinh(4 / 0.2)
    pair = []
    for x, a, b, n in ((q, -1.0, 2.0, 5), (s, low, high, 9)):
        step = (b - a) / (n - 3)
        knots = a + step * np.arange(-3, n + 1)
        pair.append(BSpline.design_matrix(x, knots, 3).toarray())
    expected = np.einsum("ki,kj->kij", *pair).reshape(50, -1)
    np.testing.assert_allclose(MAP.design(q, w), expected, atol=1e-12)
    # Outside its ranges a map has its value at their end.
    np.testing.assert_allclose(
        MAP.design(np.array([9.0]), np.array([-7.0])), MAP.design(np.array([2.0]), np.array([-3.0]))
    )


def test_the_force_is_the_design_times_the_weights():
    weights = 0.01 * np.random.default_rng(1).normal(size=45)
    effect = MAP.replace(weights=tuple(weights))
    assert effect.values["w7"] == weights[7] and len(effect.own_specifications()) == 45
    assert effect.replace(w7=0.5).weights[7] == 0.5
    q, w = np.linspace(-1.5, 2.5, 20), np.linspace(5, -4, 20)
    with double_precision():
        many = np.asarray(effect.force(jnp.asarray(q), jnp.asarray(w), 0.0))
        one = float(jax.jit(effect.force)(jnp.asarray(q[3]), jnp.asarray(w[3]), jnp.asarray(0.0)))
    np.testing.assert_allclose(many, effect.design(q, w) @ weights, atol=1e-14)
    assert one == pytest.approx(many[3], rel=1e-12)


def test_a_map_of_a_known_law_moves_like_the_law():
    drag = QuadraticDrag(at="hub", coefficient=0.01)
    fine = dataclasses.replace(MAP, speed=(-6.0, 6.0), bend=1.0, count=(1, 24), weights=())
    w = np.linspace(-6, 6, 600)
    law = np.asarray(drag.force(0.0, w, 0.0))
    weights = np.linalg.lstsq(fine.design(0 * w, w), law, rcond=None)[0]
    u = 2 * np.sin(np.arange(600) / 30)
    by_law = simulate(paper(**TRUE) + drag, u, 0.005)
    by_map = simulate(paper(**TRUE) + fine.replace(weights=tuple(weights)), u, 0.005)
    without = simulate(paper(**TRUE), u, 0.005)
    assert np.abs(by_map - by_law).max() < 2e-3 * np.abs(without - by_law).max()


def test_no_search_tries_it_by_itself():
    assert LearnedTorque.name not in CATALOG
    assert LearnedTorque.searched == ()


def test_bad_maps_are_refused():
    for given, text in (
        ({"position": (1.0, -1.0)}, "needs a range"),
        ({"count": (2, 9)}, "1 or at least 4 splines"),
        ({"bend": 0.0}, "positive sizes"),
        ({"weights": (1.0, 2.0)}, "need one each"),
    ):
        with pytest.raises(InputError, match=text):
            LearnedTorque(at="hub", **given)


# -- smoothness -------------------------------------------------------------------------------------------


def test_penalties_are_squared_differences():
    w = np.random.default_rng(2).normal(size=(5, 9))
    along, across, size = (w.ravel() @ S @ w.ravel() for S in penalties(MAP))
    assert along == pytest.approx(np.sum(np.diff(w, axis=0) ** 2))
    assert across == pytest.approx(np.sum(np.diff(w, axis=1) ** 2))
    assert size == pytest.approx(np.sum(w**2))
    flat = dataclasses.replace(MAP, count=(1, 9), weights=())
    assert len(penalties(flat)) == 2


def information(J: np.ndarray, r: np.ndarray, physics: np.ndarray, excess: float = 1.0) -> MapEquations:
    """Equations of residuals `r + J c + physics a` at parameters of zero."""
    W, n = np.hstack([physics, J]), physics.shape[1]
    indices = np.arange(W.shape[1])
    return MapEquations(W.T @ W, W.T @ r, indices[:n], indices[:n], indices[n:], 0.5 * float(r @ r), excess)


def test_smoothness_is_of_largest_likelihood():
    rng = np.random.default_rng(3)
    flat = dataclasses.replace(MAP, count=(1, 12), weights=())
    S = penalties(flat)
    N, physics = 120, rng.normal(size=(120, 2))
    Phi = flat.design(np.zeros(N), rng.uniform(-3, 4, N))
    r = physics @ [1.0, -2.0] - Phi @ np.cumsum(rng.normal(size=12)) + rng.normal(size=N)
    found = _smoother(information(Phi, r, physics), S, np.ones(2), np.eye(12), np.zeros(12), 1e-6)
    basis = np.linalg.svd(np.eye(N) - physics @ np.linalg.pinv(physics))[0][:, : N - 2]

    def cost(logs):
        """Negative log-likelihood of the part orthogonal to the physics, with weights integrated out."""
        prior = np.linalg.inv(np.einsum("i,ijk->jk", np.exp(logs), np.array(S)))
        C, e = basis.T @ (Phi @ prior @ Phi.T) @ basis + np.eye(N - 2), basis.T @ r
        return 0.5 * (np.linalg.slogdet(C)[1] + e @ np.linalg.solve(C, e))

    best = minimize(cost, np.zeros(2), method="Nelder-Mead", options={"maxfev": 80})
    assert cost(np.log(found)) < best.fun + 0.1


# -- formulas ---------------------------------------------------------------------------------------------


def mapped(found: MapEquations, weights: int, prior: float = 1e-3) -> FittedMap:
    """The best weights in closed form."""
    H, g = found.projected()
    V = np.linalg.inv(H + prior * np.eye(weights))
    z = -V @ g
    n = len(found.physics)
    H_all = found.H
    rest = -np.linalg.lstsq(H_all[:n, :n], found.g[:n] + H_all[:n, n:] @ z, rcond=None)[0]
    full = np.r_[rest, z]
    at = dataclasses.replace(found, g=found.g + H_all @ full)
    h = Hypothesis(
        (),
        tuple(range(n + weights)),
        (),
        full,
        np.zeros((1, 0)),
        np.zeros((1, 1, 0)),
        np.zeros((1, 0, 1)),
        {},
        Whitener(np.eye(1)),
    )
    return FittedMap(h, V, False, at)


@pytest.mark.parametrize(
    ("law", "wanted"),
    [
        (lambda q, w: -0.03 * np.sign(w), {"sign(w)": -0.03}),
        (lambda q, w: -0.008 * w * np.abs(w), {"w |w|": -0.008}),
        (lambda q, w: -0.02 * np.sign(w) - 0.05 * np.sin(3 * q), {"sign(w)": -0.02, "sin(3 q)": -0.05}),
        (
            lambda q, w: -0.03 * np.sign(w) * (1 + 0.8 * np.sin(3 * q)),
            {"sign(w)": -0.03, "sin(3 q) sign(w)": -0.024},
        ),
        (lambda q, w: 0.01 * w, {}),
    ],
)
def test_a_formula_is_read_in_noise_beside_a_damper(law, wanted):
    rng = np.random.default_rng(4)
    N = 3000
    q, w = rng.uniform(-1, 2, N), rng.normal(scale=1.2, size=N).clip(-3, 4)
    effect = dataclasses.replace(MAP, count=(9, 17), bend=0.1, scale=0.02, weights=())
    # The outputs are the torque itself, in units of the noise.
    noise, design = 0.01, effect.design(q, w)
    r = -law(q, w) / noise + rng.normal(size=N)
    physics = np.stack([w, np.ones(N)], axis=1) / noise
    found = read_formula(mapped(information(effect.scale * design / noise, r, physics), 153), effect, q, w)
    assert {t.name for t in found.terms} == set(wanted)
    for term in found.terms:
        assert term.coefficient == pytest.approx(
            wanted[term.name], abs=max(4 * term.std, 0.04 * abs(wanted[term.name]))
        )
    if wanted:
        assert found.share > 0.85
        # A line in the speed is left to the damper, so it is subtracted.
        slope = np.polyfit(w, law(q, w) - found(q, w), 1)
        assert np.std(law(q, w) - found(q, w) - np.polyval(slope, w)) < 0.15 * np.std(law(q, w))


def test_terms_name_themselves():
    text = str(
        Formula(
            (
                Term("sign(w)", 0.0, -0.03, 1e-3, 0.9),
                Term("w |w|", 0.0, 0.012, 1e-3, 0.05),
                Term("1", 0.0, -0.002),
            )
        )
    )
    assert text == "-0.03 sign(w) + 0.012 w |w| - 0.002"
    assert str(Formula(())) == "0"
    assert Term("w |w|", 0.0).unit == "N m s^2/rad^2"
    small = terms_to_try(np.linspace(-0.1, 0.1, 9), np.linspace(-1, 1, 9))
    assert any(t.name == "sin(12 q)" for t in small) and not any(t.name == "sin(2 q)" for t in small)
    assert {t.function for t in terms_to_try(np.linspace(-3, 3, 9), np.linspace(-1, 1, 9))} == set(FUNCTIONS)


# -- through the simulator -----------------------------------------------------------------------------------


def taught(effects=(), seed: int = 101, **given):
    made = make_record(effects, seed=seed, seconds=8.0, fs=250.0, perturb=0.0, rms=1.5)
    rec = Recording(u=made["u"], y=made["y"], Ts=made["Ts"], accept=("units",))
    return learned.learn_torque(paper(hub_damping=0.006, joint_damping=0.003), *rec.split(0.7), **given)


@pytest.fixture(scope="module")
def small_map():
    """Maps of the speed alone, which are compiled faster."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learned, "SPLINES", (1, 13))
        yield


@pytest.fixture(scope="module")
def friction(small_map):
    lines: list[str] = []
    return taught({("coulomb", "hub"): {"level": 0.03}}, progress=lines.append), lines


def test_friction_is_learned_and_read(friction):
    found, lines = friction
    assert found.kept and any("kept" in line for line in lines)
    for channel, before in found.before.held_out_rmse_windows.items():
        assert found.after.held_out_rmse_windows[channel] < 0.3 * before
        assert re.search(rf"{channel} [\d.e-]+ -> [\d.e-]+ rad[,;]", str(found))
    (term,) = found.formula.terms
    assert term.name == "sign(w)" and term.coefficient == pytest.approx(-0.03, rel=0.08)
    # The map is the friction less the line that the damper has taken over, mostly within its band.
    w = np.linspace(*np.quantile(found.speed, (0.05, 0.95)), 60)
    w = w[np.abs(w) > 0.3]
    mean, std = found.torque(np.zeros(len(w)), w)
    own = np.stack([np.ones_like(found.speed), found.speed], axis=1)
    line = np.linalg.lstsq(own, -0.03 * np.sign(found.speed), rcond=None)[0]
    truth = -0.03 * np.sign(w) - line[0] - line[1] * w
    assert np.sqrt(np.mean((mean - truth) ** 2)) < 0.1 * 0.03
    assert np.mean(np.abs(mean - truth) < 3 * std + 0.05 * 0.03) > 0.8
    assert 0.5 < np.sqrt(np.mean(((mean - truth) / std) ** 2)) < 2.0  # errors are as large as the band says
    np.testing.assert_allclose(found.read_torque(0 * w, w), truth, atol=0.1 * 0.03)
    # Nothing is left for the damper or an offset to explain.
    inside = found.torque(found.position, found.speed)[0]
    assert np.abs(np.linalg.lstsq(own, inside, rcond=None)[0]).max() < 1e-3


def test_the_model_simulates_with_its_map_and_goes_to_json(friction):
    found, _ = friction
    assert found.model.mechanism.effect("learned_torque", "hub").weights == pytest.approx(
        found.effect.weights
    )
    text = json.loads(json.dumps(found.to_dict()))
    assert text["kept"] and text["terms"][0]["unit"] == "N m" and "sign(w)" in text["formula"]
    seen = np.array([[v is not None for v in row] for row in text["map"]["torque"]])
    assert seen.any() and not seen.all()
    figure = found.plot()
    labels = [a for ax in figure.axes for a in (ax.get_xlabel(), ax.get_ylabel()) if a]
    assert len(labels) >= 6 and all("[" in a for a in labels)
    assert "sign(w)" in str(found)


@pytest.mark.slow
def test_a_model_that_lacks_nothing_stays_as_it_is(small_map):
    found = taught(seed=102)
    assert not found.kept and found.after is found.before and not found.formula.terms
    assert not any(found.effect.weights)
    with pytest.raises(InputError):
        found.model.mechanism.effect("learned_torque", "hub")
    assert "No map" in str(found)


@pytest.mark.slow
def test_a_map_that_does_not_gain_surely_enough_is_told_in_plain_json(small_map, monkeypatch):
    monkeypatch.setattr(learned, "HELD_OUT_Z", np.inf)
    found = taught({("coulomb", "hub"): {"level": 0.03}})
    assert found.held_out_gain_nats > learned.HELD_OUT_NATS and not found.kept
    assert json.loads(json.dumps(found.to_dict()))["kept"] is False  # as a report writes it beside its page


def test_a_cell_is_visited_by_three_samples():
    moved = SimpleNamespace(position=np.array([0.5, 0.5, 1.5, 1.5, 1.5]), speed=np.full(5, 0.5))
    edges = [np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0])]
    visited = learned.LearnedTorqueResult.visited(moved, edges)
    np.testing.assert_array_equal(visited, [[False], [True]])


def test_ports_that_cannot_be_taught_are_told():
    rec = Recording(
        u=np.sin(np.arange(900.0)),
        y=np.zeros((900, 2)) + np.sin(np.arange(900.0))[:, None],
        Ts=0.01,
        accept=("units",),
    )
    with pytest.raises(InputError, match="'wrist' was asked for"):
        learned.learn_torque(paper(), *rec.split(0.7), at="wrist")
    with pytest.raises(InputError, match="already has one"):
        learned.learn_torque(paper() + MAP, *rec.split(0.7))
    half = dataclasses.replace(paper(), outputs={"theta": "hub"})
    with pytest.raises(InputError, match="do not determine its motion"):
        learned.learn_torque(half, *rec.split(0.7), at="joint")
