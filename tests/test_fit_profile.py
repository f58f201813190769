"""Profile likelihoods: the exact interval of a linear regression, open ends, two minima, messages."""

import functools
import json

import numpy as np
import pytest
import scipy

import rotflex_jax as rf
from rotflex_jax.effects import Inertia, Motor
from rotflex_jax.fit import Fit, Profile

N, TS, NOISE = 300, 0.01, 0.02
CONSTANT, INERTIA = "hub.motor.torque_constant", "hub.inertia.inertia"


def axis(*free: str) -> rf.Mechanism:
    """A double integrator, whose angle is linear in its torque constant."""
    motor = Motor("hub", torque_constant=0.01, back_emf=0.0, resistance=2.0, gear_ratio=10.0)
    m = rf.Mechanism(("theta",), {"hub": (1.0,)}, (Inertia("hub", inertia=0.01), motor), {"theta": "hub"})
    return m.trust(*(name for name in m.parameter_names if name not in free))


@functools.cache
def recording(noise: float = NOISE) -> rf.Recording:
    u = rf.data.excitation.multisine(N, TS, seed=1)
    y = rf.simulate(axis(CONSTANT), u, TS) + noise * np.random.default_rng(1).normal(size=(N, 1))
    return rf.Recording(u=u, y=y, Ts=TS, channels=("theta",))


@functools.cache
def fitted() -> Fit:
    return rf.fit(axis(CONSTANT), recording())


@functools.cache
def profiled() -> Profile:
    return rf.profile(fitted(), recording(), CONSTANT)


def regression() -> tuple[float, float, float]:
    """Estimate, its entry of the inverse normal matrix, and the residual sum of squares, in numpy."""
    gain = 0.1 * 10 / (2.0 * 0.01) / 0.1  # angular acceleration per volt and torque constant, K_g / (R J)
    u = recording().u
    speed = np.concatenate([[0.0], np.cumsum(u)[:-1]]) * TS
    angle = np.concatenate([[0.0], np.cumsum(speed[:-1] * TS + u[:-1] * TS**2 / 2)])
    X = np.column_stack([gain * angle, np.ones(N), TS * np.arange(N)])
    y = recording().y[:, 0]
    b, rss, _, _ = np.linalg.lstsq(X, y, rcond=None)
    return float(b[0]), float(np.linalg.inv(X.T @ X)[0, 0]), float(rss[0])


def test_profile_of_a_linear_regression_is_exact():
    """n ln(RSS(c) / RSS) <= quantile, with RSS(c) = RSS + (c - estimate)^2 / (X'X)^-1."""
    value, entry, rss = regression()
    p = profiled()
    assert p.value == pytest.approx(value, abs=0.01 * np.sqrt(rss / N * entry))
    for level in (0.5, 0.8, 0.95):
        quantile = scipy.stats.chi2.ppf(level, 1) * p.factor
        half = np.sqrt(rss * entry * np.expm1(quantile / N))
        np.testing.assert_allclose(p.interval(level), (value - half, value + half), rtol=0, atol=2e-3 * half)
    # White errors: the factor is N over the degrees of freedom, and the interval is that of Student's t.
    assert p.factor == pytest.approx(N / (N - 3), rel=1e-6)
    half = np.sqrt(rss / (N - 3) * entry) * scipy.stats.t.ppf(0.975, N - 3)
    np.testing.assert_allclose(p.interval(), (value - half, value + half), rtol=0, atol=0.01 * half)


def test_profile_and_wald_agree_where_the_cost_is_a_parabola():
    p = profiled()
    np.testing.assert_allclose(p.interval(), p.wald, rtol=0, atol=0.01 * p.std)
    np.testing.assert_allclose(p.wald, fitted()[CONSTANT].ci95, rtol=0, atol=0.01 * p.std)
    assert p.shape == "closed" and not p.wald_is_poor and fitted().profile_advised == ()
    assert p.gained == pytest.approx(0.0, abs=1e-3)


def test_a_product_that_alone_is_known_leaves_its_factors_open():
    """Torque constant over inertia is determined; the inertia alone is not."""
    both = rf.fit(axis(CONSTANT, INERTIA), recording())
    assert set(both.profile_advised) == {CONSTANT, INERTIA}
    p = both.profile(INERTIA, recording())
    assert p.shape == "open" and p.wald_is_poor
    assert p.interval() == (0.0, np.inf)
    assert "not determined" in p.sentence
    ratio = both.profile(lambda values: values[CONSTANT] / values[INERTIA], recording())
    value, entry, rss = regression()
    assert ratio.shape == "closed"
    half = np.sqrt(rss * entry * np.expm1(scipy.stats.chi2.ppf(0.95, 1) * ratio.factor / N))
    expected = np.array([value - half, value + half]) / 0.01
    np.testing.assert_allclose(ratio.interval(), expected, rtol=0, atol=0.02 * half / 0.01)


def test_a_function_of_one_parameter_is_the_same_profile():
    """Likelihood intervals do not depend on the parametrisation; reference: the profile of the parameter."""
    p = rf.profile(fitted(), recording(), lambda values: 1 / values[CONSTANT] ** 2)
    low, high = profiled().interval()
    np.testing.assert_allclose(p.interval(), (1 / high**2, 1 / low**2), rtol=1e-4)


def test_a_level_that_is_too_small_to_see_is_open_below():
    """Data without friction: any small level fits, a large one does not."""
    m = axis(CONSTANT) + rf.effects.Viscous("hub", coefficient=0.01) + rf.effects.Coulomb("hub", level=0.01)
    m = m.trust("hub.viscous.coefficient")
    u = recording().u
    true = m.with_values({"hub.coulomb.level": 0.0})
    y = rf.simulate(true, 5 * u, TS) + 0.1 * np.random.default_rng(2).normal(size=(N, 1))
    rec = rf.Recording(u=5 * u, y=y, Ts=TS, channels=("theta",))
    p = rf.profile(rf.fit(m, rec), rec, "hub.coulomb.level")
    low, high = p.interval()
    assert p.shape == "open below" and low == 0.0 and 0 < high < 0.1
    assert "at most" in p.sentence and p.wald_is_poor


def made(drop: list[float]) -> Profile:
    values = np.linspace(-3.0, 3.0, len(drop))
    k = int(np.argmin(drop))
    return Profile(
        "a",
        "rad",
        values[k],
        values,
        np.array(drop),
        1.0,
        1.0,
        (-np.inf, np.inf),
        np.zeros((len(drop), 1)),
        ("a",),
    )


def test_two_minima_leave_a_gap():
    p = made([9.0, 1.0, 8.0, 9.0, 4.5, 0.0, 7.0])
    first, second = p.regions()
    assert p.shape == "two minima" and first[1] < second[0]
    assert p.interval() == (first[0], second[1])
    assert p.wald_is_poor and " or " in p.sentence


@pytest.mark.parametrize(
    ("drop", "shape"),
    [
        ([9.0, 4.0, 1.0, 0.0, 1.0, 4.0, 9.0], "closed"),
        ([9.0, 4.0, 1.0, 0.0, 0.5, 0.7, 0.8], "open above"),
        ([0.5, 0.4, 0.1, 0.0, 1.0, 4.0, 9.0], "open below"),
    ],
)
def test_shapes(drop: list[float], shape: str):
    p = made(drop)
    assert p.shape == shape
    if shape == "closed":  # the drop is a parabola
        np.testing.assert_allclose(p.interval(), (-1.95996, 1.95996), atol=1e-4)
        assert not p.wald_is_poor


def test_a_profile_is_shown_and_written():
    p = profiled()
    assert json.loads(json.dumps(p.to_dict()))["shape"] == "closed"
    assert CONSTANT in p._repr_html_() and "Wald" in str(p)
    ax = p.plot().axes[0]
    assert "N m/A" in ax.get_xlabel() and ax.get_ylabel().endswith("[-]")
    open_below = made([0.5, 0.4, 0.1, 0.0, 1.0, 4.0, 9.0])
    assert json.loads(json.dumps(open_below.to_dict()))["interval95"][0] is None
    assert "deg" in open_below._repr_html_()


def test_nuisances_are_fitted_again():
    """Along the profile of the torque constant, the damping follows the slope of their covariance."""
    m = axis(CONSTANT) + rf.effects.Viscous("hub", coefficient=0.02)
    y = rf.simulate(m, recording().u, TS) + 0.01 * np.random.default_rng(3).normal(size=(N, 1))
    rec = rf.Recording(u=recording().u, y=y, Ts=TS, channels=("theta",))
    fit = rf.fit(m, rec)
    p = rf.profile(fit, rec, CONSTANT)
    k = fit.free_names.index(CONSTANT)
    other = fit.free_names.index("hub.viscous.coefficient")
    slope = fit.covariance[other, k] / fit.covariance[k, k]
    found = p.nuisances[:, p.parameter_names.index("hub.viscous.coefficient")]
    measured = np.polyfit(p.values, found, 1)[0]
    assert measured == pytest.approx(slope, rel=0.05)
    held = p.nuisances[:, p.parameter_names.index("hub.motor.resistance")]
    np.testing.assert_array_equal(held, 2.0)


@pytest.mark.parametrize(
    "options",
    [{"process_noise": {"hub": 1e-7}}, {"window_seconds": 1.0}, {"local": [CONSTANT]}],
    ids=lambda options: next(iter(options)),
)
def test_profiles_are_of_what_was_fitted(options):
    """Fits to predictions, to windows, and with a local parameter.

    The outputs are linear in the torque constant, so the profile gives the Wald interval of the fit.
    """
    recordings = [recording(), recording()] if "local" in options else [recording()]
    fit = rf.fit(axis(CONSTANT), recordings, **options)
    p = fit.profile(CONSTANT, recordings)
    np.testing.assert_allclose(p.interval(), fit[CONSTANT].ci95, rtol=0, atol=0.1 * p.std)
    assert p.shape == "closed" and not p.wald_is_poor and p.gained == pytest.approx(0.0, abs=1e-2)


def test_profiles_of_all_that_are_in_doubt():
    both = rf.fit(axis(CONSTANT, INERTIA), recording())
    found = both.profiles(recording())
    assert set(found) == set(both.profile_advised) == {CONSTANT, INERTIA}
    assert all(p.shape == "open" for p in found.values())


def test_what_makes_no_sense_is_refused():
    with pytest.raises(rf.InputError, match="was to be profiled, but the free parameters"):
        rf.profile(fitted(), recording(), "hub.coulomb.level")
    with pytest.raises(rf.InputError, match="must be the full name of a parameter or a function"):
        rf.profile(fitted(), recording(), 3)
    with pytest.raises(rf.InputError, match="failed with KeyError"):
        rf.profile(fitted(), recording(), lambda values: values["nothing"])
    with pytest.raises(rf.InputError, match="gives nan"):
        rf.profile(fitted(), recording(), lambda values: float("nan"))
    for fixed in (lambda values: 1.0, lambda values: values[INERTIA]):  # the inertia is trusted
        with pytest.raises(rf.InputError, match="whatever the fitted parameters are, but a profile needs"):
            rf.profile(fitted(), recording(), fixed)
    local = rf.fit(axis(CONSTANT), [recording(), recording()], local=[CONSTANT])
    with pytest.raises(rf.InputError, match="for 2 recordings, but 1 were given"):
        rf.profile(local, recording(), CONSTANT)
    for other in (recording(2 * NOISE), [recording(), recording()], recording().slice(1, N)):
        with pytest.raises(rf.InputError, match="differ from those of the fit"):
            rf.profile(fitted(), other, CONSTANT)


def test_no_interval_is_wider_than_the_profile():
    """A level above that of the profile is refused, not reported as open; reference: a linear regression."""
    with pytest.raises(rf.InputError, match=r"the profile reaches 0.95; make it with level=0.99"):
        profiled().interval(0.99)
    value, entry, rss = regression()
    wide = rf.profile(fitted(), recording(), CONSTANT, level=0.99)
    half = np.sqrt(rss * entry * np.expm1(scipy.stats.chi2.ppf(0.99, 1) * wide.factor / N))
    np.testing.assert_allclose(wide.interval(0.99), (value - half, value + half), rtol=0, atol=2e-3 * half)
    assert rf.profile(fitted(), recording(), CONSTANT, level=0.5).shape == "closed"


def test_a_difference_may_be_negative():
    """A parameter less a constant, half a standard deviation above zero.

    The interval is that of the parameter, shifted, and is not cut at zero.
    """
    low, high = profiled().interval()
    shift = profiled().value - profiled().std / 2
    p = rf.profile(fitted(), recording(), lambda values: values[CONSTANT] - shift)
    assert p.shape == "closed" and p.limits == (-np.inf, np.inf)
    np.testing.assert_allclose(p.interval(), (low - shift, high - shift), rtol=0, atol=0.01 * p.std)
    assert rf.profile(fitted(), recording(), lambda values: 1 / values[CONSTANT]).limits == (0.0, np.inf)


def test_a_profile_has_the_ranges_of_its_fit():
    """A damper that begins at a negative value may stay negative, in the fit and in its profile."""
    damper = rf.effects.Viscous("hub", coefficient=-0.003)
    name = "hub.viscous.coefficient"
    m = (axis() + damper).trust(CONSTANT, INERTIA)
    assert m.free_names == (name,)
    u = rf.data.excitation.multisine(N, TS, seed=1)
    y = rf.simulate(m.with_values({name: -0.0008}), u, TS)
    noisy = y + NOISE * np.random.default_rng(1).normal(size=y.shape)
    data = rf.Recording(u=u, y=noisy, Ts=TS, channels=("theta",))
    found = rf.fit(m, data)
    p = rf.profile(found, data, name)
    assert p.value < 0
    low, high = p.interval(0.95)
    width = found[name].std
    assert low == pytest.approx(p.value - 1.96 * width, abs=0.3 * width)
    assert high == pytest.approx(p.value + 1.96 * width, abs=0.3 * width)


def test_a_fit_whose_only_parameter_ends_at_its_bound_has_no_interval():
    name = "hub.viscous.coefficient"
    m = (axis() + rf.effects.Viscous("hub", coefficient=0.002)).trust(CONSTANT, INERTIA)
    u = rf.data.excitation.multisine(N, TS, seed=1)
    y = rf.simulate(m.with_values({name: -0.0008}), u, TS)
    noisy = y + 1e-4 * np.random.default_rng(1).normal(size=y.shape)
    found = rf.fit(m, rf.Recording(u=u, y=noisy, Ts=TS, channels=("theta",)), first="measured")
    assert found[name].value == 0 and "bound" in found[name].note
    assert np.isnan(found[name].std)
