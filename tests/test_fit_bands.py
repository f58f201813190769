"""Bands of a free run: closed forms of each part, coverage on recordings that were not fitted, mixtures."""

import dataclasses
import functools
import json
from types import SimpleNamespace

import numpy as np
import pytest
import scipy

import rotflex_jax as rf
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.discover import Discovery
from rotflex_jax.discover.probabilities import Probabilities, SetProbability
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.effects import Inertia, Motor
from rotflex_jax.fit import Fit
from rotflex_jax.fit.bands import _fast_bristles, scatter
from rotflex_jax.fit.result import FitOptions
from rotflex_jax.parameters import Estimate, Specification

N, TS, NOISE = 300, 0.01, 0.02
CONSTANT = "hub.motor.torque_constant"
NOISE_OF_ANGLES = 5e-4  # standard deviation of the noise of the arena's angles [rad]


def axis() -> rf.Mechanism:
    """A double integrator, whose angle is linear in its torque constant."""
    motor = Motor("hub", torque_constant=0.01, back_emf=0.0, resistance=2.0, gear_ratio=10.0)
    m = rf.Mechanism(("theta",), {"hub": (1.0,)}, (Inertia("hub", inertia=0.01), motor), {"theta": "hub"})
    return m.trust(*(name for name in m.parameter_names if name != CONSTANT))


@functools.cache
def recording(seed: int = 1, noise: float = NOISE) -> rf.Recording:
    u = rf.data.excitation.multisine(N, TS, seed=seed)
    y = rf.simulate(axis(), u, TS) + noise * np.random.default_rng(seed).normal(size=(N, 1))
    return rf.Recording(u=u, y=y, Ts=TS, channels=("theta",))


@functools.cache
def fitted() -> Fit:
    return rf.fit(axis(), recording())


def with_std(fit: Fit, share: float) -> Fit:
    """The fit with another standard deviation of its parameter, as a share of the value."""
    variance = (share * fit[CONSTANT].value) ** 2
    return dataclasses.replace(fit, covariance=np.array([[variance]]))


def test_parts_are_those_of_a_linear_regression():
    """Reference: a linear regression in numpy.

    theta_k = c g_k + position + speed t_k, with position and speed by least squares on the first samples.
    """
    rec = recording(2)
    bands = rf.prediction_bands(with_std(fitted(), 0.1), rec, 0.9)
    head, t = slice(0, rec.n_init), TS * np.arange(N)
    g = rf.simulate(axis().with_values({CONSTANT: 1.0}), rec.u, TS)[:, 0]
    X = np.column_stack([np.ones(N), t])
    fit = np.linalg.pinv(X[head])
    sensor = bands.parts["sensor"][0, 0]
    assert sensor == pytest.approx(NOISE, rel=0.15)
    covariance = fit @ fit.T * sensor**2
    first = np.sqrt(np.einsum("ns,st,nt->n", X, covariance, X))
    np.testing.assert_allclose(bands.parts["first state"][:, 0], first, rtol=1e-6)
    # The first state follows the torque constant, since it is fitted to samples that depend on it.
    whole = g - X @ (fit @ g[head])
    std = 0.1 * fitted()[CONSTANT].value
    np.testing.assert_allclose(bands.parts["parameters"][:, 0], std * np.abs(whole), rtol=1e-6, atol=1e-12)
    half = (bands.upper - bands.lower)[:, 0] / 2
    total = np.sqrt(sum(part[:, 0] ** 2 for part in bands.parts.values()))
    np.testing.assert_allclose(half, scipy.stats.norm.ppf(0.95) * total, rtol=1e-9)


def test_a_speed_that_is_hardly_known_widens_the_band_with_time():
    bands = rf.prediction_bands(fitted(), recording(3))
    half = (bands.upper - bands.lower)[:, 0]
    assert half[-1] > 5 * half[10]
    assert max(bands.shares["theta"], key=bands.shares["theta"].__getitem__) == "first state"


def test_what_each_recording_has_for_itself_widens_the_band():
    """Of a local parameter that scatters by a tenth between runs, the scatter is a part of the band."""
    runs = []
    for k, factor in enumerate((0.9, 1.0, 1.1)):
        m = axis().with_values({CONSTANT: 0.01 * factor})
        u = rf.data.excitation.multisine(N, TS, seed=k)
        y = rf.simulate(m, u, TS) + 1e-3 * np.random.default_rng(k).normal(size=(N, 1))
        runs.append(rf.Recording(u=u, y=y, Ts=TS, channels=("theta",)))
    fit = rf.fit(axis(), runs, local=[CONSTANT])
    bands = rf.prediction_bands(fit, recording(4, 1e-3))
    spread = np.std([e.value for e in fit.local[CONSTANT]], ddof=1)
    own = bands.parts["own of each recording"][:, 0]
    same = rf.prediction_bands(with_std(fit, 1.0), recording(4, 1e-3)).parts["parameters"][:, 0]
    np.testing.assert_allclose(own, same * spread / fit[CONSTANT].value, rtol=1e-6)


def test_another_run_scatters_about_the_value_that_is_used():
    """The variance of the runs, and the square of the distance of their mean from the value."""
    of_runs = [Estimate.of(CONSTANT, value, 0.1, Specification("N m/A", 0.01)) for value in (1.0, 2.0, 3.0)]
    assert scatter(of_runs, 2.0) == pytest.approx(1.0) and scatter(of_runs, 4.0) == pytest.approx(1.0 + 4.0)
    assert scatter(of_runs[:1], 3.0) == pytest.approx(4.0)  # one run does not scatter


def test_a_constant_of_the_recording_is_no_source_of_uncertainty():
    fit, rec = with_std(fitted(), 0.1), recording(2)
    known = dataclasses.replace(rec, constants={CONSTANT: 0.01})
    assert "parameters" in rf.prediction_bands(fit, rec).parts
    assert "parameters" not in rf.prediction_bands(fit, known).parts


def test_process_torques_integrate_twice():
    """White torque of intensity q on an inertia J: the angle has the variance q t^3 / (3 J^2)."""
    q, rec = 1e-6, recording(5)
    noisy = dataclasses.replace(fitted(), options=FitOptions(process_noise={"hub": q}))
    part = rf.prediction_bands(noisy, rec).parts["process torque"][:, 0]
    t = TS * (np.arange(N) - rec.n_init + 1)[rec.n_init :]
    np.testing.assert_allclose(part[rec.n_init :], np.sqrt(q * t**3 / 3) / 0.01, rtol=1e-6)
    assert not part[: rec.n_init].any()


def test_known_recordings_say_what_the_model_lacks():
    """With a known recording, the band of a wrong model contains as many of its samples as it should."""
    wrong = dataclasses.replace(
        fitted(), model=rf.Model(fitted().model.mechanism.with_values({CONSTANT: 0.05}))
    )
    rec = recording(6)
    blind = rf.prediction_bands(wrong, rec).coverage()["theta"]
    knowing = rf.prediction_bands(wrong, rec, known=rec)
    assert knowing.coverage()["theta"] == pytest.approx(0.9, abs=0.02)
    assert blind < 0.6 and knowing.shares["theta"]["what the model lacks"] > 0.3
    half = rf.prediction_bands(wrong, rec, 0.5, known=[rec]).coverage()["theta"]
    assert half == pytest.approx(0.5, abs=0.02)


def test_bands_of_several_models_are_those_of_the_mixture():
    """The middle is the weighted mean of the runs, the ends are the 5 % and 95 % quantiles of the mixture."""
    rec, one = recording(7), with_std(fitted(), 1e-6)
    other = dataclasses.replace(one, model=rf.Model(one.model.mechanism.with_values({CONSTANT: 0.02})))
    alone = [rf.prediction_bands(f, rec) for f in (one, other)]
    bands = rf.prediction_bands([(one, 3.0), (other, 1.0)], rec)
    np.testing.assert_allclose(bands.middle, 0.75 * alone[0].middle + 0.25 * alone[1].middle, rtol=1e-12)
    quantile = scipy.stats.norm.ppf(0.95)
    std = [(b.upper - b.lower) / 2 / quantile for b in alone]
    for end, probability in ((bands.lower, 0.05), (bands.upper, 0.95)):
        inside = sum(
            w * scipy.stats.norm.cdf((end - b.middle) / s)
            for w, b, s in zip((0.75, 0.25), alone, std, strict=True)
        )
        np.testing.assert_allclose(inside, probability, atol=1e-6)
    same = rf.prediction_bands([(one, 1.0), (one, 5.0)], rec)
    np.testing.assert_allclose(same.upper, alone[0].upper, rtol=1e-9)


def test_bands_of_a_search_are_those_of_its_probable_sets():
    """Each set is fitted to the training data and weighted by its probability; one of 1 % is left out."""
    train, rec = recording(1), recording(9)
    shares = {frozenset(): 0.7, frozenset({"viscous@hub"}): 0.2, frozenset({"coulomb@hub"}): 0.01}
    found = Probabilities(tuple(SetProbability(s, p) for s, p in shares.items()), {}, 0.09)
    baseline, said = SimpleNamespace(model=rf.Model(axis()), friction_of_runs=()), []
    search = Discovery(
        Verdict.FOUND, "", (train,), (recording(2),), baseline, (), (), (), {}, 0.0, probabilities=found
    )
    bands = search.prediction_bands(rec, 0.8, progress=said.append)
    damped = rf.fit(axis() + rf.effects.Viscous("hub"), train)
    expected = rf.prediction_bands([(fitted(), 0.7), (damped, 0.2)], rec, 0.8)
    np.testing.assert_allclose(bands.upper, expected.upper, rtol=1e-6)
    np.testing.assert_allclose(bands.middle, expected.middle, rtol=1e-6)
    search.prediction_bands(rec, 0.9, progress=said.append)
    assert len(said) == 2  # fitted once
    alone = dataclasses.replace(search, probabilities=None).prediction_bands(rec, 0.8)
    np.testing.assert_allclose(alone.upper, rf.prediction_bands(fitted(), rec, 0.8).upper, rtol=1e-6)


def test_bands_hold_what_another_run_of_the_arena_measures():
    """With the true friction law fitted to the first half, 90 % bands contain 86 to 94 % of the second half.

    The second half begins in motion, where a friction with memory is not at rest. A run that assumes rest is
    off by more than twice the noise on average; the middle of the band, whose first state includes the
    memory, by less than half the noise. A band that allowed for the error of the former would contain all
    samples.
    """
    inside = {"theta": [], "alpha": []}
    for seed, effect in ((100, rf.effects.Coulomb("hub")), (100, rf.effects.BoucWen("hub"))):
        made = make_record([(effect.name, "hub")], seed=seed, seconds=6.0, fs=400.0, rms=1.5)
        train, test = rf.Recording(u=made["u"], y=made["y"], Ts=made["Ts"]).split(0.5)
        test = dataclasses.replace(test, continues=None)
        fit = rf.fit(rf.Model(rf.joints.paper() + effect, rf.Exponential(substeps=3)), train)
        bands = rf.prediction_bands(fit, test)
        for channel, share in bands.coverage().items():
            inside[channel].append(share)
    run_off, shown_off = (
        np.mean((test.y - run)[test.n_init :, 0]) for run in (fit.model.simulate(test), bands.middle)
    )
    assert abs(run_off) > 2 * NOISE_OF_ANGLES > 4 * abs(shown_off)
    assert bands.parts["first state"][-1, 0] < NOISE_OF_ANGLES
    for shares in inside.values():
        assert all(0.86 < share < 0.94 for share in shares)


def test_bands_are_shown_and_written():
    bands = rf.prediction_bands(fitted(), recording(8))
    assert json.loads(json.dumps(bands.to_dict()))["level"] == 0.9
    assert "first state" in bands._repr_html_() and "theta" in str(bands)
    labels = [ax.get_ylabel() for ax in bands.plot().axes]
    assert labels == ["theta [deg]", "standard deviation [deg]"]
    assert bands.coverage(recording(8)) == bands.coverage()


def test_what_makes_no_sense_is_refused():
    bands = rf.prediction_bands(fitted(), recording(8))
    with pytest.raises(rf.InputError, match="has 100 samples; give a measurement under the same input"):
        bands.coverage(recording(8).slice(0, 100))
    with pytest.raises(rf.InputError, match="A fit, or pairs of a fit and its weight, is needed"):
        rf.prediction_bands([fitted()], recording(8))
    with pytest.raises(rf.InputError, match="`weight` must be a finite number above 0"):
        rf.prediction_bands([(fitted(), -1.0)], recording(8))


def test_a_run_that_diverges_has_no_bands():
    """A run that diverges over the recording or over a known recording is refused."""
    calm = recording(8)
    huge = rf.Recording(u=1e307 * calm.u / np.abs(calm.u).max(), y=calm.y, Ts=TS, channels=("theta",))
    strong = {"hub.motor.gear_ratio": 1e4}
    fit = dataclasses.replace(fitted(), model=rf.Model(fitted().model.mechanism.with_values(strong)))
    assert np.isfinite(rf.prediction_bands(fit, calm).upper).all()
    with pytest.raises(rf.InputError, match="diverges"):
        rf.prediction_bands(fit, huge)
    with pytest.raises(rf.InputError, match="diverges"):
        rf.prediction_bands(fit, calm, known=[huge])


def test_a_run_whose_slopes_grow_without_limit_has_no_bands():
    """Negative damping that exceeds the friction is refused, although the run and its slopes are finite."""
    calm = recording(8)
    m = axis() + rf.effects.Viscous("hub") + rf.effects.Dahl("hub", level=0.5, presliding=0.02)
    held, loose = (rf.Model(m.with_values({"hub.viscous.coefficient": d})) for d in (-0.1, -0.3))
    fit = with_std(fitted(), 0.1)
    assert np.isfinite(loose.simulate(calm)).all() and np.ptp(held.simulate(calm)) < 0.1
    assert np.ptp(rf.prediction_bands(dataclasses.replace(fit, model=held), calm).upper) < 1.0
    with pytest.raises(rf.InputError, match="negative damping, and to first order nothing is known"):
        rf.prediction_bands(dataclasses.replace(fit, model=loose), calm)


def test_bristles_that_swing_within_a_sample_are_named_where_slopes_grow():
    """Bristles of 1000 N m/rad on 0.01 kg m^2: 316 rad/s, or 3.2 rad per 10 ms and 0.1 rad per 0.3 ms."""
    stiff = axis() + rf.effects.Viscous("hub") + rf.effects.Dahl("hub", level=0.1, presliding=1e-4)
    fit = dataclasses.replace(with_std(fitted(), 0.1), model=rf.Model(stiff))
    with pytest.raises(rf.InputError, match="the Dahl friction at the hub swings within a sample"):
        rf.prediction_bands(fit, recording(8))
    assert _fast_bristles(stiff, TS) and not _fast_bristles(stiff, TS / 30)
    assert not _fast_bristles(axis() + rf.effects.Coulomb("hub", level=0.1), TS)


def test_bands_are_of_one_recording():
    with pytest.raises(rf.InputError, match="2 recordings were given as `recording`, but one is needed"):
        rf.prediction_bands(fitted(), [recording(1), recording(2)])
    with pytest.raises(rf.InputError, match="one is needed"):
        rf.prediction_bands(fitted(), recording(1)).coverage([recording(1), recording(2)])
