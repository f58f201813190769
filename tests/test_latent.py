"""The latent torque against a textbook smoother in numpy, SciPy's optimum, and torques that are known."""

import dataclasses
import re
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp
from scipy.optimize import minimize

from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.data import excitation
from rotflex_jax.discover.explanation import calibrated, with_effects_of
from rotflex_jax.discover.result import Stage
from rotflex_jax.effects import Coulomb, CubicSpring, Gravity, SensorBias
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import StackedRecordings, sensor_noise
from rotflex_jax.joints import emps, paper, single_inertia
from rotflex_jax.latent import latent_torque, smoother
from rotflex_jax.latent.figure import _curve, latent_maps, latent_time
from rotflex_jax.latent.result import TorqueCurve, binned_mean, latent_torque_result
from rotflex_jax.latent.smoother import (
    AugmentedStep,
    InitialDistribution,
    IntensityEstimator,
    LinearTimeVaryingModel,
    UnknownTorque,
    fixed_interval_smoother,
    linearise_along,
    log_likelihood,
)
from rotflex_jax.mechanism import linearise, simulate, simulate_states
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Estimate
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import double_precision
from rotflex_jax.text.colours import BASELINE

TRUE = {"hub_damping": 0.004, "joint_damping": 0.003}


def recorded(effects=(), seed: int = 101, seconds: float = 8.0, **named) -> tuple[Recording, dict]:
    """A joint with exactly the paper's parameters, and hidden effects."""
    r = make_record(effects, seed=seed, seconds=seconds, fs=250.0, perturb=0.0, rms=1.5, **named)
    return Recording(u=r["u"], y=r["y"], Ts=r["Ts"], accept=("units",)), r


# -- the smoother --------------------------------------------------------------------------------


def time_varying_model(N: int = 40, m: int = 4, C: int = 2):
    """A time-varying model with process noise on its last state alone, as where a torque is estimated."""
    rng = np.random.default_rng(5)
    A = np.eye(m) + 0.1 * rng.normal(size=(N, m, m))
    H, seen = rng.normal(size=(N, C, m)), (rng.random(N) > 0.2).astype(float)
    model = LinearTimeVaryingModel(A, 0.1 * rng.normal(size=(N, m)), H, rng.normal(size=(N, C)), seen)
    return (
        model,
        InitialDistribution(rng.normal(size=m), np.full(m, 2.0)),
        np.array([0.3, 0.5]),
        np.r_[np.zeros(m - 1), 0.2],
    )


def textbook(model: LinearTimeVaryingModel, start: InitialDistribution, noise: np.ndarray, Q: np.ndarray):
    """Smoother of Rauch, Tung and Striebel, with inverses and all channels of an innovation at once."""
    m, P, R = start.mean, np.diag(start.variance), np.diag(noise**2)
    prior, after, total = [], [], 0.0
    for A, c, H, y, seen in zip(*model, strict=True):
        prior.append((m, P))
        if seen:
            S = H @ P @ H.T + R
            e = y - H @ m
            total -= 0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(2 * np.pi * S)[1])
            K = P @ H.T @ np.linalg.inv(S)
            m, P = m + K @ e, P - K @ S @ K.T
        after.append((m, P))
        m, P = A @ m + c, A @ P @ A.T + np.diag(Q)
    out = [after[-1]]
    for k in range(len(after) - 2, -1, -1):
        (m, P), (m1, P1) = after[k], prior[k + 1]
        G = P @ model.A[k].T @ np.linalg.inv(P1)
        out.append((m + G @ (out[-1][0] - m1), P + G @ (out[-1][1] - P1) @ G.T))
    out.reverse()
    return np.array([a for a, _ in out]), np.array([np.diag(b) for _, b in out]), total


def test_the_smoother_is_that_of_rauch_tung_and_striebel():
    given = time_varying_model()
    mean, variance, total = textbook(*given)
    with double_precision():
        arrays = jax.tree.map(jnp.asarray, given)
        found = [np.asarray(a) for a in fixed_interval_smoother(*arrays)]
        np.testing.assert_allclose(found[0], mean, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(found[1], variance, rtol=1e-7, atol=1e-10)
        assert float(log_likelihood(*arrays)) == pytest.approx(total, rel=1e-10)


def test_likelihoods_of_several_sets_are_those_of_each():
    """The intensities of a set are in a column."""
    model, start, noise, Q = time_varying_model()
    sets = np.stack([Q, 3 * Q, Q + 0.1], axis=1)
    expected = [textbook(model, start, noise, each)[2] for each in sets.T]
    with double_precision():
        found = log_likelihood(*jax.tree.map(jnp.asarray, (model, start, noise, sets)))
    np.testing.assert_allclose(np.asarray(found), expected, rtol=1e-10)


def test_a_torque_that_no_sample_shows_is_as_uncertain_at_the_first_sample_as_at_any_other():
    """The variance of an Ornstein-Uhlenbeck process of intensity q and time constant T is q T / 2."""
    T, q, N = 3.0, 2.0, 30
    decay = np.exp(-0.1 / T)
    growth = np.array([T / 2 * (1 - decay**2)])
    estimator = IntensityEstimator(
        np.ones(1), growth, time_constant=T, smallest=1e-9, largest=1e9, states=1, torques=1
    )
    A, none = np.tile(np.diag([0.5, decay]), (1, N, 1, 1)), np.zeros((1, N, 1, 2))
    start = InitialDistribution(np.zeros((1, 2)), np.ones((1, 2)))
    with double_precision():
        model = LinearTimeVaryingModel(A, none[:, :, 0], none, np.zeros((1, N, 1)), np.zeros((1, N)))
        _, std = estimator.smooth(jax.tree.map(jnp.asarray, model), start, np.array([q]))
    np.testing.assert_allclose(std[0, :, 1], np.sqrt(q * T / 2), rtol=1e-9)


def test_without_process_noise_it_is_least_squares():
    """The inverse of the textbook does not exist in this case; reference: regression of the first state."""
    model, start, noise, Q = time_varying_model(N=12)
    rows, targets, move, shift = [], [], np.eye(4), np.zeros(4)
    for A, c, H, y, seen in zip(*model, strict=True):
        if seen:
            rows.append(H @ move / noise[:, None])
            targets.append((y - H @ shift) / noise)
        move, shift = A @ move, A @ shift + c
    prior = np.eye(4) / np.sqrt(start.variance)
    J = np.vstack([*rows, prior])
    first = np.linalg.lstsq(J, np.concatenate([*targets, prior @ start.mean]), rcond=None)[0]
    with double_precision():
        mean, variance = fixed_interval_smoother(*jax.tree.map(jnp.asarray, (model, start, noise, 0 * Q)))
    np.testing.assert_allclose(np.asarray(mean)[0], first, rtol=1e-8)
    np.testing.assert_allclose(np.asarray(variance)[0], np.diag(np.linalg.inv(J.T @ J)), rtol=1e-7)


# -- the linear model ----------------------------------------------------------------------------


def linearised(
    mechanism, ports, S: np.ndarray, u: np.ndarray, Ts: float, decay: float
) -> LinearTimeVaryingModel:
    m = mechanism
    for port in ports:
        m = m + UnknownTorque(at=port)
    step = AugmentedStep(m.structure, Model(m).solver, len(ports))
    data = StackedRecordings(
        u[None], np.zeros((1, len(u), len(m.channels))), np.ones((1, len(u))), np.array([Ts])
    )
    with double_precision():
        arrays = jax.tree.map(
            jnp.asarray, (m.values, np.ones(len(m.effects)), S[None], data, np.array([decay]))
        )
        return jax.tree.map(lambda a: np.asarray(a)[0], linearise_along(step, *arrays))


def test_a_linear_joint_keeps_its_state_space_under_a_held_torque():
    joint, Ts = paper(**TRUE), 0.004
    rng = np.random.default_rng(2)
    S, u = rng.normal(size=(6, 6)), rng.normal(size=6)
    found = linearised(joint, ("hub", "joint"), S, u, Ts, 0.9)
    ss = linearise(joint)
    Ad, Bd = ss.discretise(Ts)
    for k in range(6):
        np.testing.assert_allclose(found.A[k, :4, :4], Ad, atol=1e-10)
        np.testing.assert_allclose(found.c[k], np.r_[Bd * u[k], 0, 0], atol=1e-10)
        np.testing.assert_allclose(found.A[k, 4:], np.c_[np.zeros((2, 4)), 0.9 * np.eye(2)], atol=1e-12)
        np.testing.assert_allclose(found.H[k], np.c_[ss.C, np.zeros((2, 2))], atol=1e-12)
    # Response to a constant torque, by scipy's integrator.
    J, Ja = 0.0021, 0.0059
    M = np.array([[J + Ja, Ja], [Ja, Ja]])
    for column, push in ((4, [1.0, 0.0]), (5, [0.0, 1.0])):

        def rate(_, x, push=push):
            return np.r_[x[2:], np.linalg.solve(M, push) + (ss.A @ x)[2:]]

        reached = solve_ivp(rate, (0, Ts), np.zeros(4), rtol=1e-11, atol=1e-13).y[:, -1]
        np.testing.assert_allclose(found.A[0, :4, column], reached, rtol=1e-6, atol=1e-12)


def test_the_linear_model_is_tangent_to_a_nonlinear_mechanism():
    m = paper(**TRUE) + CubicSpring(at="joint", stiffness=60.0) + Gravity(at="hub", sine=0.05)
    u, Ts = np.sin(np.arange(50)), 0.004
    X = simulate_states(m, u, Ts)
    S = np.c_[X, np.zeros((50, 2))]
    found = linearised(m, ("hub", "joint"), S, u, Ts, 1.0)
    on = np.einsum("kij,kj->ki", found.A, S) + found.c
    np.testing.assert_allclose(on[:-1, :4], X[1:], atol=1e-11)
    nudge = 1e-6 * np.random.default_rng(0).normal(size=S.shape)
    near = linearised(m, ("hub", "joint"), S + nudge, u, Ts, 1.0)
    moved = np.einsum("kij,kj->ki", near.A, S + nudge) + near.c
    np.testing.assert_allclose(moved - on, np.einsum("kij,kj->ki", found.A, nudge), atol=1e-11)


def test_the_intensity_is_that_of_scipy():
    """One inertia under a random-walk torque of known intensity, against the optimum of Nelder and Mead."""
    m, Ts, N = single_inertia(inertia=0.01, damping=0.02), 0.01, 500
    rng = np.random.default_rng(3)
    u, d, x, rows = rng.normal(size=N), 0.0, np.zeros(2), []
    found = linearised(m, ("hub",), np.zeros((N, 3)), u, Ts, 1.0)
    for k in range(N):
        rows.append(x[0] + 1e-4 * rng.normal())
        x = (found.A[k] @ np.r_[x, d] + found.c[k])[:2]
        d += np.sqrt(0.03 * Ts) * rng.normal()
    model = found._replace(y=np.array(rows)[:, None])
    start = InitialDistribution(np.zeros(3), np.r_[1e-6, 1e-6, 0.0])
    estimator = IntensityEstimator(np.array([1e-4]), np.array([Ts]), 5.0, 1e-12, 1e3, 2, 1)

    def cost(z, first=None):
        wide = start._replace(variance=np.r_[1e-6, 1e-6, np.exp(z[0] if first is None else first) * 2.5])
        return -textbook(model, wide, estimator.noise, np.r_[0, 0, np.exp(z[0]) * Ts])[2]

    best = minimize(cost, [np.log(1e-3)], method="Nelder-Mead", options={"xatol": 1e-3})
    with double_precision():
        whole = jax.tree.map(lambda a: jnp.asarray(a)[None], (model, start))
        level = estimator.maximise(*whole, np.array([1e-6]), 1e3)
        (gain,) = estimator.gains(*whole, level)
    assert cost(np.log(level)) < best.fun + 0.5
    assert level[0] == pytest.approx(0.03, rel=0.6)
    assert gain == pytest.approx(cost([np.log(1e-12)], np.log(level[0])) - cost(np.log(level)), rel=1e-4)


def test_the_variance_that_a_sample_adds_is_that_of_the_process(monkeypatch):
    """For d' = -d / T + w of intensity 1, from a known d: T / 2 (1 - exp(-2 Ts / T)) after Ts."""

    def made(**given):
        raise RuntimeError(given["variance_growth"], given["time_constant"])

    monkeypatch.setattr("rotflex_jax.latent.torque.IntensityEstimator", made)
    r, _ = recorded(seconds=2.0)
    with pytest.raises(RuntimeError) as stopped:
        latent_torque(paper(**TRUE), [r, r.slice(0, 300)])
    growth, T = stopped.value.args
    assert pytest.approx(r.N * r.Ts, rel=0.01) == T
    np.testing.assert_allclose(growth, -T / 2 * np.expm1(-2 * r.Ts / T), rtol=1e-12)


# -- against the independent simulator ---------------------------------------------------------------


def test_friction_is_seen_within_its_band():
    r, made = recorded({("coulomb", "hub"): {"level": 0.03}})
    lines: list[str] = []
    found = latent_torque(paper(**TRUE), r, progress=lines.append)
    said = r"latent torque: intensity of its random walk hub \S+ \(N m\)\^2/s, joint \S+ \(N m\)\^2/s"
    assert re.fullmatch(said, lines[-1])
    speed = made["state"][:, 2]
    truth, sliding = -0.03 * np.sign(speed), np.abs(speed) > 0.6
    off = found.torque[:, 0] - truth
    assert np.sqrt(np.mean(off[sliding] ** 2)) < 0.2 * 0.03
    assert np.mean(np.abs(off[sliding]) < 1.96 * found.std[sliding, 0]) > 0.9
    np.testing.assert_allclose(found.speed[:, 0][sliding], speed[sliding], atol=0.15)
    curve = found.curve("hub", "speed", 24)
    far = np.abs(curve.at) > 0.8
    inside = (curve.low < -0.03 * np.sign(curve.at)) & (-0.03 * np.sign(curve.at) < curve.high)
    assert far.sum() > 8 and inside[far].mean() > 0.8
    # Nothing acts on the joint, and nothing is estimated there.
    assert found.size("joint") < 0.02 * found.size("hub")
    assert found.gain_nats["hub"] > 1e4 > 10 > found.gain_nats["joint"]


@pytest.mark.parametrize("seed", [102, 103])
def test_with_nothing_hidden_there_is_no_torque(seed):
    r, _ = recorded(seed=seed)
    found = latent_torque(paper(**TRUE), r)
    assert all(found.size(p) < 2e-3 * found.scale for p in found.ports)
    assert all(nats < 10 for nats in found.gain_nats.values())


def test_what_a_damper_took_over_can_be_given_back():
    r, made = recorded({("coulomb", "hub"): {"level": 0.03}})
    bent = latent_torque(paper(hub_damping=0.024, joint_damping=0.003), r)
    true = latent_torque(paper(**TRUE), r)
    speed = made["state"][:, 2]
    sliding = np.abs(speed) > 0.6
    whole = -0.03 * np.sign(speed) - 0.004 * speed
    back = bent.given_back("hub.viscous")
    assert np.std((back.torque[:, 0] - whole)[sliding]) < 0.3 * 0.03
    assert np.std((bent.torque[:, 0] - whole)[sliding]) > 0.4 * 0.03
    # Relative to the model with the true damper, it is the friction alone.
    alone = bent.given_back(beyond=true)
    assert np.std((alone.torque[:, 0] + 0.03 * np.sign(speed))[sliding]) < 0.3 * 0.03
    np.testing.assert_array_equal(back.given_back("hub.viscous").torque, back.torque)


def test_once_the_effect_is_in_the_model_nothing_is_left():
    effects = {("coulomb", "hub"): {"level": 0.03}, ("cubic_spring", "joint"): {"coefficient": 60.0}}
    r, _ = recorded(effects)
    full = Model(paper(**TRUE) + Coulomb(at="hub", level=0.03) + CubicSpring(at="joint", stiffness=60.0))
    both = [r, r.slice(500, 1500)]
    before, after = (latent_torque(m, both) for m in (with_effects_of(Model(paper(**TRUE)), full), full))
    assert before.size("hub") > 0.015 and before.size("joint") > 0.01
    assert after.size("hub") < 0.02 * before.size("hub")
    assert after.size("joint") < 0.02 * before.size("joint")
    # The torque of the hardening spring over the deflection.
    curve = before.curve("joint", "deflection", 16)
    truth = -60.0 * curve.at**3
    np.testing.assert_allclose(curve.mean, truth, atol=0.1 * np.abs(truth).max())
    for figure in (latent_maps(before, after), latent_time(before, after), before.plot()):
        labels = [text for ax in figure.axes for text in (ax.get_xlabel(), ax.get_ylabel()) if text]
        assert labels and all("[" in text for text in labels)


def test_two_recordings_are_one_after_the_other():
    r, _ = recorded()
    found = latent_torque(paper(**TRUE), [r, r.slice(200, 900)], ports=["arm"])
    assert found.torque.shape == (r.N + 700, 1) and found.ports == ("arm",)
    assert (np.diff(found.recording) >= 0).all() and found.recording[-1] == 1
    np.testing.assert_allclose(found.time[r.N], r.t[200])
    f, size = found.spectrum("arm")
    assert f.shape == size.shape and (size >= 0).all()
    np.testing.assert_allclose(found.position[: r.N, 0], r.y.sum(axis=1), atol=4e-3)


def test_other_parameters_need_no_compilation():
    r, _ = recorded(seconds=2.0)
    latent_torque(paper(**TRUE), r)
    counts = len(linearise_along), len(smoother._log_likelihoods)
    latent_torque(paper(hub_damping=0.01, joint_damping=0.004), r)
    assert (len(linearise_along), len(smoother._log_likelihoods)) == counts


def test_torques_of_the_model_itself_and_the_spectrum_of_the_longest_recording():
    """A spring and dampers pull back. The longest recording is the second one, at another sampling period."""
    rng, made = np.random.default_rng(2), []
    for N, Ts in ((400, 0.01), (2000, 0.004)):
        u, y = rng.normal(size=N), rng.normal(size=(N, 2))
        made.append(Recording(u=u, y=y, Ts=Ts, accept=("units",)))
    S = rng.normal(size=(2, 2000, 6))
    S[1, :, 4] = np.sin(2 * np.pi * 10.0 * made[1].t)  # torque at the hub
    model, none = Model(paper(**TRUE)), np.zeros(2)
    found = latent_torque_result(model, made, ("hub", "joint"), (S, 0 * S), none, none, 1.0)
    theta_alpha, speeds = (np.concatenate([S[0, :400, k], S[1][:, k]]) for k in (slice(0, 2), slice(2, 4)))
    stiffness = model.mechanism.named_values["joint.spring.stiffness"]
    expected = {
        "joint.spring": -stiffness * theta_alpha[:, 1],
        "hub.viscous": -0.004 * speeds[:, 0],
        "joint.viscous": -0.003 * speeds[:, 1],
    }
    assert set(found.linear) == set(expected)
    for name, torque in expected.items():
        np.testing.assert_allclose(found.linear[name], torque)
    f, size = found.spectrum("hub")
    assert f[np.argmax(size)] == pytest.approx(10.0, abs=f[1] - f[0])


# -- curves and words ----------------------------------------------------------------------------------


def test_a_stay_in_a_bin_counts_once():
    """Samples within a stay are dependent, the means of stays are independent.

    The 95 % band of each bin follows from the stays, and misses the true mean in 1 to 10 % of the cases.
    """
    rng = np.random.default_rng(7)
    misses = []
    for _ in range(200):
        x = np.repeat(rng.permutation(np.tile(np.arange(4.0), 30)), 25)
        each = np.repeat(0.5 * rng.normal(size=120), 25)
        found = binned_mean(x + 0.01 * rng.normal(size=len(x)), x + each, 0 * x, 4, np.zeros(len(x), int))
        misses.append((found["low"] > np.arange(4)) | (found["high"] < np.arange(4)))
        assert found["count"].sum() == len(x)
    assert 0.01 < np.mean(misses) < 0.10


def test_a_stay_ends_with_its_recording():
    """The second recording begins in the bin in which the first one ends."""
    x, recording = np.repeat([0.0, 1.0, 1.0, 0.0], 40), np.repeat([0, 0, 1, 1], 40)
    assert binned_mean(x, x, 0 * x, 2, recording)["visits"].tolist() == [2, 2]


def test_a_curve_has_no_line_where_there_are_no_samples():
    """Samples at 0 to 3, 7 to 9 and 13 of 16: one line for each, and none over what lies between."""
    x = np.repeat([0.0, 1.0, 2.0, 3.0, 7.0, 9.0, 13.0, 15.0, 15.99], 20)
    found = binned_mean(x, x, 0 * x, 16, np.zeros(len(x), int))
    assert found["index"].tolist() == [0, 1, 2, 3, 7, 9, 13, 15]
    curve = TorqueCurve(**found, against="speed", unit="rad/s", port="hub")
    torque: Any = SimpleNamespace(curve=lambda *given: curve)
    ax = Figure().subplots()
    _curve(ax, torque, "hub", "speed", {"color": BASELINE})
    drawn = ax.lines[0].get_ydata()
    assert [len(part) for part in np.split(drawn, np.flatnonzero(np.isnan(drawn)))] == [4, 3, 3]


def test_a_single_stay_has_a_wide_band():
    x = np.r_[np.tile(np.repeat([0.0, 1.0], 20), 50), np.full(30, 2.0)]
    torque = np.r_[np.repeat(np.random.default_rng(1).normal(size=100), 20), np.full(30, 3.0)]
    found = binned_mean(x, torque, 0 * x, 3, np.zeros(len(x), int))
    width = found["high"] - found["low"]
    assert width[2] > 3 * width[0]


def test_the_band_of_a_mean_has_the_uncertainty_of_the_torque_itself():
    """Where all stays agree, k stays of standard deviation s leave s / sqrt(k)."""
    x, std = np.tile(np.repeat([0.0, 1.0], 20), 25), 0.2
    found = binned_mean(x, 3 * x, std + 0 * x, 2, np.zeros(len(x), int))
    np.testing.assert_allclose(found["high"] - found["mean"], 1.96 * std / np.sqrt(25), rtol=1e-3)


def test_offsets_of_a_recording_are_part_of_the_stage():
    nan = float("nan")
    estimate = Estimate("alpha.sensor_bias.bias", 0.01, 1e-3, (0.008, 0.012), "rad")
    stage = Stage(Model(paper()), (estimate,), {}, {}, (), (), 2.0, {}, nan, nan)
    bias = calibrated(stage).mechanism.effect("sensor_bias", "alpha")
    assert isinstance(bias, SensorBias) and bias.bias == 0.01


def test_curves_have_the_units_of_the_machine():
    axis = emps()
    u = excitation.noise(600, 0.004, seed=1)
    y = simulate(axis + Coulomb("axis", level=10.0), u, 0.004)
    recording = Recording(u=u, y=y, Ts=0.004, channels="position", units="m", accept=("units",))
    found = latent_torque(axis, recording)
    assert [found.curve("axis", x).unit for x in ("position", "speed", "voltage")] == ["m", "m/s", "V"]
    assert latent_maps(found).axes[2].get_xlabel() == "position of the axis [mm]"


def test_bad_input_is_named():
    r, _ = recorded(seconds=2.0)
    with pytest.raises(InputError, match="'wrist' was asked for"):
        latent_torque(paper(), r, ports=["wrist"])
    with pytest.raises(InputError, match="different directions"):
        latent_torque(paper(), r, ports=["hub", "joint", "arm"])
    found = latent_torque(paper(**TRUE), r)
    with pytest.raises(InputError, match=r"'arm\.viscous' was to be given back"):
        found.given_back("arm.viscous")
    with pytest.raises(InputError, match="'arm' was asked for"):
        found.curve("arm")
    with pytest.raises(InputError, match="'wind'"):
        found.curve("hub", "wind")  # type: ignore
    bare = dataclasses.replace(found, linear={})
    with pytest.raises(InputError, match="no port of the torques has a spring"):
        bare.curve("hub", "deflection")
    for bins in (0, -1, 2.5):
        with pytest.raises(InputError, match="`bins` must be a whole number from 1"):
            found.curve("hub", bins=bins)
    assert "hub" in str(found) and "nat" in str(found)
    assert " 0 nat" in str(dataclasses.replace(found, gain_nats=dict.fromkeys(found.ports, -0.2)))
    assert sensor_noise([r], Model(paper()))[0] > 0
