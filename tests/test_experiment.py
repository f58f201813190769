"""Evidence of an input against least squares, scipy, finite differences and an independent simulator."""

import dataclasses
import re
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.data.excitation import multisine, noise, prbs
from rotflex_jax.errors import InputError
from rotflex_jax.experiment import rival_fit
from rotflex_jax.experiment.design import _notes
from rotflex_jax.experiment.discrimination import Discrimination, DiscriminationProblem, optimise_input
from rotflex_jax.experiment.result import Rated
from rotflex_jax.experiment.rival_fit import (
    RivalFit,
    effect_location,
    fit_rival,
    free_run_from_rest,
    rival_model,
)
from rotflex_jax.experiment.standard_inputs import Limits, standard_inputs
from rotflex_jax.models.model import Model
from rotflex_jax.runtime.xla import double_precision

# Recordings of one length share compiled programs.
Ts, N = 0.004, 500
NOISE = np.array([5.3e-4, 5.3e-4])
DELAY, LAG = ("delay", "input"), ("lag", "input")
V = Limits(voltage=2.0)


def machine() -> Model:
    """The joint of the independent simulator."""
    return Model(rf.joints.paper(joint_damping=0.003, hub_damping=0.004))


def pair(time: float = 0.003, Ts: float = Ts):
    """Delay and lag of the same size."""
    a = rival_model(machine(), fx.Delay(time=time), LAG, {}, NOISE, Ts)
    return a, rival_model(machine(), fx.Lag(time=time), DELAY, {}, NOISE, Ts)


@pytest.fixture(scope="module")
def problem():
    return DiscriminationProblem(pair(), Ts, V)


def test_nats_of_a_linear_rival_are_the_noncentrality_of_least_squares():
    """A free inertia with a delayed voltage, fitted by first state, offset and bias alone."""
    m = rf.Mechanism(
        coordinates=("x",),
        ports={"hub": (1.0,)},
        effects=(fx.Inertia(at="hub", inertia=0.5), fx.Motor(at="hub", back_emf=0.0)),
        outputs={"x": "hub"},
    )
    m = m.trust(*m.parameter_names)
    sd = np.array([1e-4])
    # Twice the sampling period: no interpolation between samples.
    a = rival_model(Model(m + fx.Delay(time=2 * Ts)), DELAY, ("sensor_bias", "x"), {}, sd, Ts)
    a = dataclasses.replace(a, free=())
    b = rival_model(Model(m), ("sensor_bias", "x"), DELAY, {}, sd, Ts)
    u = noise(N, Ts, seed=3)
    y = free_run_from_rest(a, u, Ts)
    t = Ts * np.arange(N)
    late = np.concatenate([[u[0]] * 2, u[:-2]])
    gain = fx.Motor(at="hub", back_emf=0.0).stamp().drive / 0.5
    speed = np.concatenate([[0.0], np.cumsum(gain * late * Ts)])[:-1]
    place = np.concatenate([[0.0], np.cumsum(speed * Ts + gain * late * Ts**2 / 2)])[:-1]
    np.testing.assert_allclose(y[:, 0], place, atol=1e-12)
    now = np.concatenate([[0.0], np.cumsum(gain * u * Ts)])[:-1]
    known = np.concatenate([[0.0], np.cumsum(now * Ts + gain * u * Ts**2 / 2)])[:-1]
    columns = np.stack([np.ones(N), t, t**2 / 2], axis=1)
    rest = (place - known) - columns @ np.linalg.lstsq(columns, place - known, rcond=None)[0]
    expected = 0.5 * np.sum((rest / sd[0]) ** 2)
    assert expected > 10
    found = fit_rival(b, u, y, Ts)
    assert found.nats == pytest.approx(expected, rel=1e-6)
    assert found.converged


def test_a_rival_fit_is_as_good_as_that_of_scipy(problem):
    a, b = problem.pair
    u = multisine(N, Ts, band=(0.5, 12.0), rms=1.0)
    y = free_run_from_rest(a, u, Ts)
    found = fit_rival(b, u, y, Ts)

    def errors(unknowns):
        with double_precision():
            part, fixed = rival_fit._static_and_arrays(b)
            x, *rest = map(jnp.asarray, (unknowns, u, y, Ts))
            return np.asarray(rival_fit._whitened_residuals(part, x, fixed, *rest)).ravel()

    start = found.unknowns + 0.02
    best = least_squares(errors, start, x_scale="jac", xtol=1e-12, ftol=1e-12)
    assert found.nats == pytest.approx(best.cost, rel=5e-3)
    assert found.converged and found.nats > 1


def test_a_model_reproduces_its_own_run(problem):
    u = noise(N, Ts, seed=1)
    a = problem.pair[0]
    wrong = a.start.copy()
    wrong[: len(a.free)] += 0.05
    assert fit_rival(a, u, free_run_from_rest(a, u, Ts), Ts, wrong).nats < 0.05


def test_a_rival_whose_errors_overflow_is_refused_without_a_warning(problem):
    b = problem.pair[1]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = fit_rival(b, noise(N, Ts, seed=1), np.full((N, len(b.mechanism.channels)), 1e200), Ts)
    assert found.nats == np.inf and not found.converged


def test_with_process_noise_an_innovation_is_weaker_evidence():
    """A predictor corrects slow errors, so the same difference is weaker evidence than in a free run."""
    u = noise(N, Ts, bandwidth=10.0, seed=2)
    free = pair()
    y = free_run_from_rest(free[0], u, Ts)
    q = {"hub": 1e-7, "joint": 1e-7}
    b = rival_model(machine(), fx.Lag(time=0.003), DELAY, q, NOISE, Ts)
    assert np.abs(b.K).max() > 1e-3
    held = fit_rival(b, u, y, Ts)
    assert held.converged
    assert held.nats < fit_rival(free[1], u, y, Ts).nats


def test_the_gradient_is_that_of_differences(problem):
    rng = np.random.default_rng(0)
    u = multisine(N, Ts, band=(0.5, 15.0), rms=0.8)
    m = problem.evaluate(u)
    m = problem.evaluate(u, m)
    nothing = np.zeros((2, 2))
    g = problem.gradient(u, m, nothing)
    for _ in range(3):
        # A direction with energy at all frequencies, along which the gradient does not vanish.
        way = 0.3 * rng.standard_normal(len(u)) + g / np.abs(g).max()
        up, down = (problem.evaluate(u + s * 1e-3 * way, m).mean_nats for s in (1, -1))
        assert g @ way == pytest.approx((np.log(up) - np.log(down)) / 2e-3, rel=0.01)


def test_the_gradient_of_a_peak(problem):
    """A penalty subtracts the gradient of the logarithm of a peak, which is a smooth maximum."""
    u = multisine(N, Ts, band=(0.5, 15.0), rms=0.8)
    m = problem.evaluate(u)
    penalty = np.array([[0.0, 1.0], [0.0, 0.0]])
    g = problem.gradient(u, m, np.zeros((2, 2))) - problem.gradient(u, m, penalty)
    # Along the input itself a peak of a linear machine grows in proportion.
    assert g @ u == pytest.approx(1.0, rel=1e-6)


def test_limits_on_voltage_and_slew_hold_exactly_and_change_nothing_needlessly():
    limits, rng = Limits(voltage=2.0, slew=150.0), np.random.default_rng(5)
    u = limits.playable(4 * rng.standard_normal(800), Ts)
    assert np.max(np.abs(u)) <= 2.0
    assert np.max(np.abs(np.diff(u, prepend=0.0, append=0.0))) <= 150.0 * Ts * (1 + 1e-9)
    np.testing.assert_allclose(limits.playable(u, Ts), u, atol=1e-12)
    smooth = np.sin(2 * np.pi * np.arange(800) * Ts)
    smooth *= np.minimum(1, np.minimum(np.arange(1, 801), np.arange(800, 0, -1)) / 20)
    np.testing.assert_allclose(limits.playable(smooth, Ts), smooth, atol=1e-12)
    # The largest admissible signal below a jump rises after it, the smallest one above rises before it.
    k, most = np.arange(200), 150.0 * Ts
    jump = np.where(k < 100, -1.0, 1.0) * (np.minimum(k, 199 - k) >= 20)
    below = np.where(k < 100, -1.0, np.minimum(1.0, -1.0 + most * (k - 99)))
    above = np.where(k < 100, np.maximum(-1.0, 1.0 - most * (100 - k)), 1.0)
    np.testing.assert_allclose(limits.playable(jump, Ts)[50:150], (below + above)[50:150] / 2, atol=1e-9)


def test_standard_inputs_have_the_bands_that_they_name_and_no_constant_part():
    """Noise of a corner f has the correlation exp(-2 pi f Ts) of neighbours; bands end at 0.4 / Ts."""
    fast = standard_inputs(8000, 0.005, Limits(voltage=5.0))
    for made in (i for i in fast if i.kind == "noise"):
        corner = float(made.setting.removesuffix(" Hz"))
        correlation = np.corrcoef(made.u[1:], made.u[:-1])[0, 1]
        assert correlation == pytest.approx(np.exp(-2 * np.pi * corner * 0.005), abs=0.03)
        assert abs(np.mean(made.u)) < 0.02
    slow = [i for i in standard_inputs(1000, 0.02, Limits(voltage=5.0)) if i.kind == "multisine"]
    assert [i.setting for i in slow] == ["to 6 Hz", "to 12 Hz", "to 20 Hz"]
    f = np.fft.rfftfreq(1000, 0.02)
    for made, high in zip(slow, (6.0, 12.0, 20.0), strict=True):
        power = np.abs(np.fft.rfft(made.u)) ** 2
        assert np.sum(power[f > 1.01 * high]) < 1e-3 * np.sum(power)
        assert np.sum(power[f > 0.8 * high]) > 0.05 * np.sum(power)


def test_a_tenth_of_a_second_has_all_standard_inputs():
    """One period in 0.1 s is 10 Hz, above the highest frequency of one of the multisines and sweeps."""
    kinds = [[s.kind for s in standard_inputs(N, 5e-4, Limits(voltage=5.0))] for N in (200, 20_000)]
    assert kinds[0] == kinds[1] and set(kinds[0]) == {"noise", "multisine", "sweep", "prbs", "steps"}


@pytest.mark.parametrize("before", [-1.0, -0.4, 0.0, 1.0])
def test_one_input_follows_another_within_the_slew(before):
    """The first sample follows any voltage that is within one step of 0 V, also at a reduced level."""
    limits, rng = Limits(voltage=2.0, slew=150.0), np.random.default_rng(7)
    start = before * 150.0 * Ts
    u = limits.playable(4 * rng.standard_normal(60), Ts, start)
    for level in (1.0, 0.4, 0.06):
        assert np.max(np.abs(np.diff(level * u, prepend=start, append=0.0))) <= 150.0 * Ts * (1 + 1e-9)
    np.testing.assert_allclose(limits.playable(u, Ts, start), u, atol=1e-12)
    # Away from its beginning it equals the input that follows 0 V.
    other = limits.playable(4 * np.random.default_rng(7).standard_normal(60), Ts)
    np.testing.assert_allclose(u[10:], other[10:], atol=1e-12)


@pytest.mark.parametrize("before", [-2.0, -1.0, 1.0, 2.0])
def test_a_start_beyond_one_step_counts_as_one_step(before):
    """Else an input could not be scaled down: a smaller first sample would be too far from the start."""
    limits, step = Limits(voltage=2.0, slew=150.0), 150.0 * Ts
    u = limits.playable(np.zeros(20), Ts, before * step)
    assert np.max(np.abs(np.diff(u, append=0.0))) <= step * (1 + 1e-9)
    np.testing.assert_allclose(u, np.zeros(20), atol=1e-9 * step)


def test_each_sample_follows_the_two_it_is_said_to_follow():
    limits, rng = Limits(voltage=2.0, slew=150.0), np.random.default_rng(6)
    x = 1.5 * rng.standard_normal(300)
    u, low, high = limits.playable_with_sources(x, Ts)
    k = rng.integers(40, 260)
    way = np.zeros(300)
    way[low[k]] += 0.5
    way[high[k]] += 0.5
    nudge = 1e-7 * rng.standard_normal(300)
    inside = np.abs(x) < 2.0
    moved = limits.playable(x + nudge * inside, Ts)
    assert moved[k] - u[k] == pytest.approx(way @ (nudge * inside), abs=1e-12)


def test_input_optimisation_gains_within_the_limits():
    """With an active limit of the deflection, the design beats its start, both as large as allowed."""
    c = DiscriminationProblem(pair(Ts=0.005), 0.005, Limits(voltage=6.0, travel=1.0, deflection=0.12))
    start = c.scaled_to_limits(prbs(N // 2, 0.005, amplitude=6.0, hold=0.02))
    before = c.evaluate(c.scaled_to_limits(np.tile(start, 2))).nats
    u = c.scaled_to_limits(c.limits.playable(np.tile(optimise_input(c, start, evaluations=12), 2), 0.005))
    assert c.evaluate(u).nats > 1.3 * before
    assert np.all(c.peaks(u) <= c.limits.outputs(2))
    assert np.max(np.abs(u)) <= 6.0


def test_the_expected_evidence_is_found_on_the_independent_simulator():
    """It is the log-likelihood of the truth less that of its rival, averaged over sensor noise."""
    h = 0.002
    a, b = pair(0.0021, h)
    u = prbs(2500, h, amplitude=1.5, hold=0.02, seed=4)
    expected = fit_rival(b, u, free_run_from_rest(a, u, h), h).nats
    got = []
    for seed in range(4):
        y = make_record({DELAY: {"time": 0.0021}}, seed=seed, perturb=0.0, played=u)["y"]
        cost = [fit_rival(x, u, y, h).nats for x in (a, b)]
        got.append(cost[1] - cost[0])
    # The difference of one recording has mean T and variance 2 T.
    spread = np.sqrt(2 * expected / len(got))
    assert expected > 40
    assert abs(np.mean(got) - expected) < 3 * spread + 0.15 * expected


@pytest.fixture(scope="module")
def experiment():
    limits = Limits(voltage=3.0, slew=400.0, travel=1.2, deflection=0.15)
    model = rf.joints.paper(joint_damping=0.003, hub_damping=0.004) + fx.Delay(time=0.003)
    sd = {"theta": 5.3e-4, "alpha": 5.3e-4}
    settings = {
        "limits": limits,
        "seconds": N * 0.005,
        "Ts": 0.005,
        "noise": sd,
        "starts": 1,
        "evaluations": 15,
    }
    return rf.next_experiment(model, "delay@input", "lag@input", **settings)


def test_an_experiment_keeps_every_limit(experiment):
    e, c = experiment, experiment.chosen
    assert np.max(np.abs(e.u)) <= 3.0 and c.voltage == np.max(np.abs(e.u))
    assert np.max(np.abs(np.diff(e.u, prepend=0.0))) <= 400.0 * 0.005 * (1 + 1e-9)
    assert c.peaks["theta"] <= 0.9 * 1.2 and c.peaks["alpha"] <= 0.9 * 0.15
    assert np.max(np.abs(e.outputs[0]), axis=0) == pytest.approx(list(c.peaks.values()), rel=0.3)


def test_an_experiment_is_no_worse_than_a_standard_input(experiment):
    e = experiment
    assert e.separates == ("delay@input", "lag@input")
    assert {"noise", "multisine", "prbs", "steps", "sweep"} <= {r.input for r in e.table}
    assert e.chosen.nats == max(r.nats for r in e.table) >= e.standard.nats
    assert e.evidence["nats_per_second"] == pytest.approx(e.chosen.nats / 2.5)
    # The differences are in units of the outputs: over white noise they give the expected evidence.
    nats = 0.5 * np.sum((e.differences / 5.3e-4) ** 2, axis=(1, 2))
    assert nats == pytest.approx(e.chosen.each, rel=0.02)
    assert e.to_dict()["limits"]["slew"] == 400.0
    assert "delay@input from lag@input" in str(e)


def test_the_file_can_be_played_and_read_back(experiment, tmp_path):
    path = experiment.save_csv(tmp_path / "next.csv")
    head, names, *rows = path.read_text().splitlines()
    assert "V" in head and names == "t,voltage"
    answer = ["theta,alpha", *(f"{a:.17g},{b:.17g}" for a, b in experiment.outputs[0])]
    path.write_text("\n".join([head, *(f"{r},{y}" for r, y in zip([names, *rows], answer, strict=True))]))
    back = rf.load(path)
    np.testing.assert_array_equal(back.u, experiment.u)
    np.testing.assert_array_equal(back.y, experiment.outputs[0])
    assert back.Ts == pytest.approx(0.005)
    with pytest.raises(InputError, match="folder"):
        experiment.save_csv(tmp_path / "none" / "next.csv")


def test_a_machine_in_metres_is_told_in_metres():
    axis, limits = rf.joints.emps(), Limits(voltage=2.0)
    e = rf.next_experiment(
        axis,
        "coulomb@axis",
        "quadratic_drag@axis",
        limits=limits,
        seconds=2.0,
        Ts=0.01,
        noise={"position": 1e-5},
        improve=False,
    )
    assert re.search(r"slew to [\d.]+ V/s, position to [\d.]+ mm predicted", str(e))
    assert "position [mm]" in {ax.get_ylabel() for ax in e.plot().axes}


def test_the_figure_names_units_and_both_effects(experiment):
    figure = experiment.plot()
    labels = [t for ax in figure.axes for t in (ax.get_xlabel(), ax.get_ylabel(), ax.get_title())]
    assert {"voltage [V]", "frequency [Hz]", "theta [mrad]", "alpha [mrad]"} <= set(labels)
    assert any("lag@input" in t.get_text() for legend in figure.legends for t in legend.get_texts())


def test_other_parameters_need_no_compilation(problem):
    u = noise(N, Ts, seed=1)
    problem.evaluate(u)
    before = len(rival_fit._residuals_and_jacobian)
    other = DiscriminationProblem(pair(0.004), Ts, V)
    other.evaluate(2 * u)
    assert len(rival_fit._residuals_and_jacobian) == before


def test_a_nested_direction_does_not_count():
    """Coulomb friction is nested in Stribeck's: if Coulomb is true, no input distinguishes them."""
    m = machine()
    a = rival_model(m, fx.Stribeck(at="hub", level=0.01, excess=0.02), ("coulomb", "hub"), {}, NOISE, Ts)
    b = rival_model(m, fx.Coulomb(at="hub", level=0.01), ("stribeck", "hub"), {}, NOISE, Ts)
    c = DiscriminationProblem((a, b), Ts, V)
    results = [c.evaluate(noise(N, Ts, seed=seed)) for seed in (2, 3)]
    assert c.without_nested_direction(results).counted == (True, False)


@pytest.mark.parametrize(("other", "counts"), [(500.0, True), (5.0, False)])
def test_a_direction_that_decides_counts_though_the_opposite_is_far_more_distinct(problem, other, counts):
    one, two = (RivalFit(np.zeros(1), nats, np.zeros((1, 2)), 0.0) for nats in (20_000.0, other))
    result = Discrimination(np.zeros((2, 1, 2)), (one, two))
    assert problem.without_nested_direction([result]).counted == (True, counts)


def test_a_machine_that_drifts_out_of_its_limits_is_named():
    m = machine() + fx.VoltageOffset(offset=0.5)
    a, b = (
        rival_model(m, e, other, {}, NOISE, Ts) for e, other in ((fx.Delay(time=0.003), LAG), (LAG, DELAY))
    )
    c = DiscriminationProblem((a, b), Ts, Limits(voltage=2.0, travel=0.1))
    with pytest.raises(InputError, match="offset"):
        c.scaled_to_limits(noise(N, Ts, seed=1))


@pytest.mark.parametrize(
    ("a", "b", "changes", "match"),
    [
        ("delay@input", "delay@input", {}, "two different ones"),
        ("dealy@input", "lag@input", {}, "not in the catalogue"),
        ("delay", "lag@input", {}, "name and a port"),
        (3, "lag@input", {}, "name and a port"),
        ("delay@input", "lag@input", {"noise": None}, "sensor noise"),
        ("delay@input", "lag@input", {"noise": {"theta": 1e-3}}, "sensor noise"),
        ("delay@input", "lag@input", {"seconds": 0.1}, "200 to 10000000 samples"),
        ("delay@input", "lag@input", {"Ts": 0.0}, "200 to 10000000 samples"),
        ("coulomb@wheel", "lag@input", {}, "wheel"),
        ("delay@input", "lag@input", {"process_noise": {"wheel": 1e-6}}, "wheel"),
    ],
)
def test_bad_input_is_named_in_a_sentence(a, b, changes, match):
    settings = {"noise": {"theta": 1e-3, "alpha": 1e-3}, "limits": V} | changes
    with pytest.raises(InputError, match=match):
        rf.next_experiment(machine(), a, b, **settings)


@pytest.mark.parametrize("wrong", [{"voltage": 0.0}, {"voltage": np.inf}, {"voltage": 1.0, "slew": -1.0}])
def test_limits_must_be_positive(wrong):
    with pytest.raises(InputError, match="positive number"):
        Limits(**wrong)
    with pytest.raises(InputError, match="margin"):
        Limits(voltage=1.0, margin=1.0)


def test_effects_may_be_given_in_three_ways():
    assert (
        effect_location("delay@input")
        == effect_location(("delay", "input"))
        == effect_location(fx.Delay(time=0.1))
        == DELAY
    )


def test_an_experiment_that_would_not_decide_says_so():
    chosen = Rated("steps", "", 0.2, (0.2, 0.3), 1.0, 1.0, {"theta": 0.1}, True)
    (note,) = _notes(rf.joints.paper(), chosen)
    assert "0.2 nats" in note and "4.6" in note
    assert _notes(rf.joints.paper(), dataclasses.replace(chosen, nats=4.7)) == ()
