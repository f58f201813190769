"""The grey-box fit on recordings of the arena's simulator, which shares no code with the model."""

import dataclasses
import re

import numpy as np
import pytest
from scipy.optimize import least_squares

import rotflex_jax.effects as fx
from rotflex_jax.arena.simulator.records import COUNT, JITTER, make_record
from rotflex_jax.errors import InputError
from rotflex_jax.fit import fit
from rotflex_jax.joints import paper, single_inertia
from rotflex_jax.mechanism import Exponential, simulate
from rotflex_jax.metrics import rmse
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording

# Friction stops and starts within a sample; with three steps per sample the error of that is below the noise.
SOLVER = Exponential(substeps=3)
FRICTION = ("coulomb", "hub")
NOISE = np.sqrt(JITTER**2 + COUNT**2 / 12)


def record(seed: int, effects=(FRICTION,), seconds: float = 3.0):
    """A recording and the true parameters by their full names."""
    r = make_record(effects, seed=seed, seconds=seconds, fs=400.0, rms=1.5)
    p = r["truth"]["plant"]
    truth = {
        "hub.inertia.inertia": p["J_hub"],
        "joint.spring.stiffness": p["K"],
        "hub.motor.torque_constant": p["k_t"],
        "hub.viscous.coefficient": p["B_hub"],
        "joint.viscous.coefficient": p["B_joint"],
        "hub.coulomb.level": 0.03,
    }
    return Recording(u=r["u"], y=r["y"], Ts=r["Ts"]), truth


def off(truth, seed: int = 0, friction: bool = True) -> Model:
    """The true structure with parameters that are wrong by 30 to 50 %."""
    rng = np.random.default_rng(seed)
    start = {
        name: value * (1 + rng.choice([-1, 1]) * rng.uniform(0.3, 0.5))
        for name, value in truth.items()
        if friction or name != "hub.coulomb.level"
    }
    joint = paper() + fx.Coulomb("hub") if friction else paper()
    return Model(joint.with_values(start), SOLVER)


@pytest.fixture(scope="module")
def recovered():
    """Fits of the true structure to four machines, each from its own wrong start."""
    out = []
    for seed in range(1, 5):
        rec, truth = record(seed)
        out.append((fit(off(truth, seed), rec), rec, truth))
    return out


def test_the_truth_is_within_the_intervals(recovered):
    scores = []
    for found, _, truth in recovered:
        assert found.status == "converged"
        z = [(found[name].value - value) / found[name].std for name, value in truth.items()]
        assert np.abs(z).max() < 4, dict(zip(truth, z, strict=True))
        scores.append(z)
    # Standard deviations are neither too small nor too large.
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.8


def test_intervals_are_narrow_and_residuals_are_the_sensor_noise(recovered):
    for found, _, truth in recovered:
        for name, value in truth.items():
            estimate = found[name]
            assert 1e-5 < estimate.std / value < 0.1, name
            low, high = estimate.ci95
            assert low == pytest.approx(estimate.value - 1.96 * estimate.std)
            assert high == pytest.approx(estimate.value + 1.96 * estimate.std)
            assert estimate.free and estimate.note == ""
        np.testing.assert_allclose(list(found.noise.values()), NOISE, rtol=0.08)
        # Negative log-likelihood of two channels of Gaussian residuals, in closed form.
        N = 1200
        by_hand = sum(N * (np.log(s) + 0.5 * np.log(2 * np.pi * np.e)) for s in found.noise.values())
        assert found.cost == pytest.approx(by_hand)


def test_what_is_known_is_held(recovered):
    found = recovered[0][0]
    held = {
        "arm.inertia.inertia": 0.0059,
        "hub.motor.back_emf": 0.00767,
        "hub.motor.gear_ratio": 70.0,
    }
    for name, value in held.items():
        assert found[name].value == pytest.approx(value, rel=1e-12)
        assert not found[name].free and np.isnan(found[name].std)
        assert name not in found.free_names
    assert set(found.free_names) == set(recovered[0][2])


def test_the_covariance_is_that_of_the_intervals(recovered):
    found = recovered[0][0]
    std = [found[name].std for name in found.free_names]
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), std, rtol=1e-9)
    assert (np.linalg.eigvalsh(found.covariance / np.outer(std, std)) > 0).all()


def test_scipy_finds_the_same_optimum(recovered):
    """Reference: `scipy.optimize.least_squares` on the same residuals, with difference quotients."""
    found, rec, truth = recovered[1]
    joint, names = found.model.mechanism, list(truth)
    scale = np.array(list(found.noise.values()))
    sizes = np.array([truth[n] for n in names] + [0.01, 0.01, 0.1, 0.1])

    def residuals(shares):
        numbers, x0 = shares[:6] * sizes[:6], shares[6:] * sizes[6:]
        model = joint.with_values(dict(zip(names, numbers, strict=True)))
        return ((simulate(model, rec.u, rec.Ts, x0=x0, solver=SOLVER) - rec.y) / scale).ravel()

    start = np.concatenate([np.full(6, 1.02), np.zeros(4)])
    best = least_squares(residuals, start, diff_step=1e-6, xtol=1e-12, ftol=1e-12)
    for name, value in zip(names, best.x[:6] * sizes[:6], strict=True):
        assert abs(found[name].value - value) < 0.1 * found[name].std, name
    # Residuals are scaled by their standard deviations, so the sum of their squares is their number.
    assert 2 * best.cost == pytest.approx(2 * rec.N, abs=1.0)


def test_the_free_run_of_the_fitted_model_has_the_residuals(recovered):
    """A free run from the first samples has residuals below three times the noise.

    First states that are fitted to the whole recording, as in the fit, are a little better.
    """
    found, rec, _ = recovered[2]
    rms = np.sqrt(np.mean((found.model.simulate(rec) - rec.y) ** 2, axis=0))
    assert (rms < 3 * NOISE).all()


def test_no_bound_is_left_where_there_is_no_friction():
    rec, truth = record(5, effects=())
    found = fit(off(truth, 5), rec)
    level = found["hub.coulomb.level"].value
    assert 0 <= level < 1e-3
    assert found["joint.spring.stiffness"].value == pytest.approx(truth["joint.spring.stiffness"], rel=0.01)


def test_more_freedom_is_never_worse_and_prediction_hides_less():
    rec, truth = record(1)
    wrong = fit(off(truth, 1, friction=False), rec)
    right = fit(off(truth, 1), rec)
    assert right.cost < wrong.cost - 100
    # A predictor is corrected by the measurements where physics is missing, so its residuals are smaller.
    noises = {"hub": 1e-4, "joint": 1e-6}
    follows = fit(off(truth, 1, friction=False), rec, process_noise=noises)
    assert follows.noise["theta"] < 0.5 * wrong.noise["theta"]
    assert follows.noise["alpha"] < wrong.noise["alpha"]
    # In a recording without friction, the larger model is about as likely as the smaller one.
    rec, truth = record(5, effects=())
    small = fit(off(truth, 5, friction=False), rec)
    large = fit(off(truth, 5), rec)
    assert large.cost < small.cost + 0.5
    assert large.cost > small.cost - 10


def test_the_predictor_recovers_the_truth_too():
    rec, truth = record(2)
    found = fit(off(truth, 2), rec, process_noise={"hub": 1e-6, "joint": 1e-7})
    assert found.status == "converged"
    free_run = fit(off(truth, 2), rec)
    for name, value in truth.items():
        assert abs(found[name].value - value) < 4 * found[name].std, name
        # Predictions use less of the information in the data, so standard deviations are larger.
        assert found[name].std > free_run[name].std


def test_each_recording_has_an_offset_of_its_own():
    """The same machine with voltage offsets of +0.15 and -0.05 V: the fit gives each, and their mean."""
    pairs = [
        make_record({("voltage_offset", "input"): {"offset": v}}, seed=6, seconds=1.5, fs=400.0)
        for v in (0.15, -0.05)
    ]
    recs = [Recording(u=r["u"], y=r["y"], Ts=r["Ts"]) for r in pairs]
    joint = paper() + fx.VoltageOffset(offset=0.0)
    name = "input.voltage_offset.offset"
    own = fit(joint, recs, local=[name])
    assert own[name].value == pytest.approx(0.05, abs=4 * own[name].std)
    assert own[name].std < 0.01
    np.testing.assert_allclose(list(own.noise.values()), NOISE, rtol=0.08)
    # `local` has the offset of each recording, and `model_of` gives the model with it.
    assert list(own.local) == [name]
    for number, (rec, v, e) in enumerate(zip(recs, (0.15, -0.05), own.local[name], strict=True)):
        assert e.value == pytest.approx(v, abs=4 * e.std) and 0 < e.std < 0.01
        there = own.model_of(number)
        assert rmse(rec, there.simulate(rec))["theta"] < 1.3 * np.max(NOISE)
        assert rmse(rec, own.model.simulate(rec))["theta"] > 3 * np.max(NOISE)
    mean = np.mean([e.value for e in own.local[name]])
    assert own[name].value == pytest.approx(mean, rel=1e-9)
    # The mean of two separate estimates has a smaller standard deviation than the less certain one.
    k = own.free_names.index(name)
    assert own[name].std == pytest.approx(np.sqrt(own.covariance[k, k]), rel=1e-9)
    assert own[name].std < max(e.std for e in own.local[name])
    shared = fit(joint, recs)
    assert shared.cost > own.cost + 1000
    # A fit to one recording alone finds its offset.
    for rec, v in zip(recs, (0.15, -0.05), strict=True):
        alone = fit(joint, rec)
        assert alone[name].value == pytest.approx(v, abs=4 * alone[name].std)


def test_the_recording_that_fits_worst_is_named():
    """Three recordings of one inertia; the residual in each is the noise that was added to it."""
    machine, rng, Ts = single_inertia(0.002, damping=0.01), np.random.default_rng(4), 0.005
    recordings, noise = [], {"monday.csv": 5e-4, "tuesday.csv": 2e-2, "": 1e-3}
    for source, sd in noise.items():
        u = 2.0 * np.repeat(rng.standard_normal(40), 20)
        y = simulate(machine, u, Ts) + rng.normal(0.0, sd, (len(u), 1))
        recordings.append(Recording(u=u, y=y, Ts=Ts, channels="theta", source=source))
    found = fit(machine, recordings, restarts=0)
    assert [r.source for r in found.residuals] == list(noise)
    assert [r.rms["theta"] for r in found.residuals] == pytest.approx(list(noise.values()), rel=0.1)
    said = r"theta: .* rms, from 0\.0\d+ deg in monday.csv to 1\.\d+ deg in tuesday.csv\n"
    assert re.search(said, str(found))
    assert "monday.csv to 1." in found._repr_html_()
    unnamed = fit(machine, [recordings[2], recordings[2]], restarts=0)
    assert "in recording 1 to" in str(unnamed)
    assert " from " not in str(fit(machine, recordings[:1], restarts=0))


def test_windows_start_again_but_a_recording_keeps_its_own_offset():
    """A fit to thirds of two recordings finds one offset for each recording, not one for each third."""
    pairs = [
        make_record({("voltage_offset", "input"): {"offset": v}}, seed=6, seconds=1.5, fs=400.0)
        for v in (0.15, -0.05)
    ]
    recs = [Recording(u=r["u"], y=r["y"], Ts=r["Ts"]) for r in pairs]
    name = "input.voltage_offset.offset"
    cut = fit(paper() + fx.VoltageOffset(offset=0.0), recs, local=[name], window_seconds=0.5)
    assert cut.status == "converged"
    assert len(cut.local[name]) == 2
    for e, v in zip(cut.local[name], (0.15, -0.05), strict=True):
        assert e.value == pytest.approx(v, abs=4 * e.std)
    np.testing.assert_allclose(list(cut.noise.values()), NOISE, rtol=0.08)


def test_windows_give_the_numbers_with_which_short_free_runs_are_best():
    """Of a model without friction, a fit to windows has smaller errors over windows than one to the whole."""
    rec, truth = record(3)
    lacking = off(truth, 3, friction=False)
    cut, whole = fit(lacking, rec, window_seconds=0.5), fit(lacking, rec)
    errors = [
        np.mean(np.log(list(rmse(rec, f.model.simulate_windows(rec, 0.5)).values()))) for f in (cut, whole)
    ]
    assert errors[0] < errors[1] - 0.02
    with pytest.raises(InputError, match="window_seconds"):
        fit(lacking, rec, window_seconds=0.0)


@pytest.mark.parametrize("frequency", [8.0, 15.0, 20.0])
def test_a_mode_is_found_from_a_fitted_joint_without_it(frequency):
    """The fit finds a mode at 10 Hz from a start at 8, 15 or 20 Hz.

    Short predictions contain little information about a mode: a fit that begins with them ends above 13 Hz,
    240 nats worse.
    """
    mode = ("second_mode", "arm")
    r = make_record({mode: {"inertia": 2e-4, "frequency": 10.0, "damping": 0.03}}, seed=7, seconds=20.0)
    rec = Recording(u=r["u"], y=r["y"], Ts=r["Ts"])
    joint = fit(paper(), rec).model
    found = fit(joint + fx.SecondMode("arm", inertia=1e-4, frequency=frequency), rec)
    assert found["arm.second_mode.frequency"].value == pytest.approx(10.0, rel=0.02)
    assert found["arm.second_mode.inertia"].value == pytest.approx(2e-4, rel=0.15)


def test_a_fit_that_stops_early_says_so():
    rec, truth = record(3)
    lines: list[str] = []
    found = fit(off(truth, 3), rec, max_steps=1, progress=lines.append)
    assert found.status.startswith("stopped") and "converged" not in str(found)
    assert lines and all(line.startswith("fit: ") for line in lines) and "steps" in lines[0]
    with pytest.raises(RuntimeError, match="stopped"):
        fit(off(truth, 3), rec, max_steps=1, throw=True)


def test_a_fit_that_diverges_says_so():
    rec, truth = record(3)
    wild = dataclasses.replace(
        off(truth, 3), mechanism=off(truth, 3).mechanism + fx.QuadraticDrag("hub", 1e6)
    )
    found = fit(wild, rec)
    assert "diverged" in found.status and not np.isfinite(found.cost)
    with pytest.raises(RuntimeError, match="diverged"):
        fit(wild, rec, throw=True)


def test_what_cannot_be_fitted_is_refused():
    rec, _ = record(3)
    joint = paper()
    with pytest.raises(InputError, match="release"):
        fit(joint.trust(*joint.free_names), rec)
    with pytest.raises(InputError, match="local"):
        fit(joint, rec, local=["arm.inertia.inertia"])
    with pytest.raises(InputError, match="at least one"):
        fit(joint, [])
    with pytest.raises(InputError, match="theta"):
        fit(joint, Recording(u=rec.u, y=rec.y, Ts=rec.Ts, channels=("a", "b")))


def test_effects_that_are_switched_off_are_left_out():
    rec, truth = record(3, effects=(), seconds=1.0)
    joint = off(truth, friction=False).mechanism
    large = joint + fx.Coulomb("hub") + fx.Spring("hub", stiffness=1.0)
    model = Model(large.trust("hub.spring.stiffness"), SOLVER, [1] * 6 + [0, 0])
    for process_noise in (None, {"hub": 1e-7}):
        found, expected = (
            fit(m, rec, process_noise=process_noise, restarts=0) for m in (model, Model(joint, SOLVER))
        )
        assert found.model == expected.model and found.cost == expected.cost
    with pytest.raises(InputError, match=r"1, 0\.5, but only effects that are on or off"):
        fit(dataclasses.replace(model, gates=(*[1.0] * 7, 0.5)), rec)


def test_effects_that_are_switched_off_do_not_change_a_prediction():
    rec, _ = record(3, effects=(), seconds=1.0)
    large = paper() + fx.Coulomb("hub") + fx.Spring("hub", stiffness=1.0)
    found, expected = (
        model.predict(rec, {"hub": 1e-4}, [1e-3, 1e-3])
        for model in (Model(large, gates=np.r_[np.ones(6), 0, 0]), Model(paper()))
    )
    # First states are fitted until a step gains nothing, to 1e-9 rad. Switched on, an effect adds 0.007 rad.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)


def test_gates_may_be_given_in_any_sequence(tmp_path):
    model = Model(paper(), gates=np.array([1, 1, 1, 1, 1, 0]))
    assert model == Model(paper(), gates=(1.0, 1.0, 1.0, 1.0, 1.0, 0.0))
    assert hash(model) == hash(Model(paper(), gates=[True] * 5 + [False]))
    assert Model.load(model.save(tmp_path / "model.json")) == model


def test_asking_for_a_parameter_that_is_not_there(recovered):
    with pytest.raises(InputError, match=r"hub\.coulomb\.level"):
        recovered[0][0]["hub.coulomb.height"]


def test_a_machine_that_rests_without_voltage_can_be_fitted():
    """While friction holds it, its speed falls through numbers whose square is zero."""
    t = 0.005 * np.arange(400)
    u = np.where(t < 1.0, 2.0 * np.sin(9.0 * t), 0.0)
    truth = single_inertia() + fx.Coulomb("hub", level=0.02)
    theta = simulate(truth, u, 0.005)[:, 0] + 1e-3 * np.random.default_rng(0).standard_normal(len(t))
    found = fit(truth.with_values({"hub.coulomb.level": 0.03}), Recording(u=u, y=theta, Ts=0.005))
    assert found.status == "converged"
    assert found.model.mechanism.named_values["hub.coulomb.level"] == pytest.approx(0.02, rel=0.05)


def test_one_inertia_by_hand():
    """Reference in closed form: the speed approaches its final value as exp(-t / T)."""
    joint = single_inertia(0.004, damping=0.01)
    gain = 0.00767 * 70 / 2.6
    rate = (0.01 + gain * 0.00767 * 70) / 0.004
    u, Ts = np.repeat([1.0, -1.0, 2.0, 0.0], 60), 0.01
    a = np.exp(-rate * Ts)
    theta, omega, y = 0.0, 0.0, []
    for v in u:
        y.append(theta)
        target = gain * v / (rate * 0.004)
        theta += target * Ts + (omega - target) * (1 - a) / rate
        omega = target + (omega - target) * a
    rng = np.random.default_rng(0)
    rec = Recording(u=u, y=np.array(y) + 1e-3 * rng.normal(size=len(u)), Ts=Ts)
    found = fit(joint.with_values({"hub.inertia.inertia": 0.002, "hub.viscous.coefficient": 0.03}), rec)
    for name, value in (("hub.inertia.inertia", 0.004), ("hub.viscous.coefficient", 0.01)):
        assert abs(found[name].value - value) < 4 * found[name].std
        assert found[name].std < 0.05 * value
    assert found.noise["theta"] == pytest.approx(1e-3, rel=0.1)
