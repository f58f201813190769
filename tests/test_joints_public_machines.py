"""Machines that move in metres or volts, a smooth input, and the protocols of public benchmarks."""

import dataclasses
import re
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import freqs

import rotflex_jax as rf
from rotflex_jax.data.datasets import Benchmark, Published, benchmark
from rotflex_jax.effects import (
    CATALOG,
    Coulomb,
    CubicSpring,
    PeriodicDisturbance,
    ViscousAsymmetric,
    VoltageDrift,
    VoltageOffset,
)
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import sensor_noise
from rotflex_jax.mechanism.intersample import substep_voltages
from rotflex_jax.mechanism.quantity import Units
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.recording import Recording

Measured = Callable[[str], list[Recording]]


def test_every_effect_speaks_of_forces_on_a_linear_axis():
    axis = rf.joints.emps()
    for cls in CATALOG.values():
        if not cls.searched or cls.turning or cls.ports == ("input",) or "theta" in cls.ports:
            continue
        sizes = [{}, {"damping": 0.05}, {"damping": 0.05, "level": 0.0}] if cls.name == "lugre" else [{}]
        for own in sizes:
            at = "axis: signal" if cls.acts_on == "signal" else "axis"
            said = axis.units.sentence(cls(at=at, **own).sentence())
            assert not re.search(r"N m\b|rad\b|torque|turn|degree|kg m\b", said), said
        for spec in cls.declared().values():
            assert not re.search(r"N m\b|rad|kg m", axis.units.unit(spec.unit)), spec.unit


def test_units_follow_by_dimensions():
    axis, circuit, joint = Units("m", "N"), Units("V", "V"), Units()
    turning = ("N m s/rad", "kg m^2", "N m/rad^3", "rad/s", "1/((N m)^2 s)", "V", "")
    assert [joint.unit(u) for u in turning] == list(turning)
    assert [axis.unit(u) for u in turning] == ["N s/m", "kg", "N/m^3", "m/s", "1/N^2/s", "V", ""]
    assert [circuit.unit(u) for u in turning[:4]] == ["s", "s^2", "1/V^2", "V/s"]
    # Twice the effort at half the motion: a damper is four times as large.
    assert Units(motion_size=0.5, effort_size=2.0).size("N m s/rad") == 4.0
    assert str(rf.joints.emps()).count("N m") == 0


def test_a_linear_axis_is_searched_for_what_a_line_can_have():
    found = {(cls.name, place) for cls, place in search_places(rf.joints.emps())}
    assert {("coulomb", "axis"), ("stribeck", "axis"), ("viscous_asymmetric", "axis")} <= found
    assert not {name for name, _ in found} & {"gravity", "cogging", "cubic_spring"}
    assert "viscous_asymmetric" not in {cls.name for cls, _ in search_places(rf.joints.paper())}
    box = {(cls.name, place) for cls, place in search_places(rf.joints.silverbox())}
    assert ("cubic_spring", "joint") in box
    # With one sensor its gain is only a matter of units; with two sensors a gain error is a candidate.
    assert ("sensor_gain", "output") not in box
    assert ("sensor_gain", "alpha") in {(c.name, p) for c, p in search_places(rf.joints.paper())}


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_the_axis_runs_up_to_the_speed_of_its_direction(way: float):
    """M v' = F - (c + a sign v) |v| from rest: an exponential to F / (c + a sign v)."""
    mass, c, a, volts, Ts = 90.0, 200.0, -40.0, 0.4, 1e-3
    axis = rf.joints.emps(mass, damping=c, gain=35.0) + ViscousAsymmetric(at="axis", asymmetry=a)
    u = np.full(3000, way * volts)
    x = rf.simulate(axis, u, Ts)[:, 0]
    t, own = np.arange(3000) * Ts, c + way * a
    expected = way * 35.0 * volts / own * (t - mass / own * -np.expm1(-own * t / mass))
    np.testing.assert_allclose(x, expected, atol=2e-9)


def test_a_drift_adds_its_mean_over_each_sample():
    v = VoltageDrift(rate=0.5).drive(jnp.asarray([1.0, 2.0, 3.0]), 0.1)
    np.testing.assert_allclose(v, [1.025, 2.075, 3.125], rtol=1e-6)


def test_a_disturbance_adds_its_mean_over_each_sample():
    """Reference: the integral of the sine and of the cosine over each sample, at two samples per period."""
    Ts, f = 0.1, 5.0
    w, t = 2 * np.pi * f, Ts * np.arange(7)
    mean = (0.3 * -np.diff(np.cos(w * t)) + 0.4 * np.diff(np.sin(w * t))) / (w * Ts)
    v = PeriodicDisturbance(sine=0.3, cosine=0.4, frequency=f).drive(jnp.zeros(6), Ts)
    np.testing.assert_allclose(v, mean, atol=1e-6)


@pytest.mark.parametrize("substeps", [1, 2, 4])
def test_a_smooth_input_drives_a_linear_circuit_as_its_frequency_response_says(substeps: int):
    box = rf.joints.silverbox(70.0, damping_ratio=0.1)
    m, c, k = (box.effect(n, "joint").values for n in ("inertia", "viscous", "spring"))
    Ts, N = 1 / 610.0, 3000
    t, tones = np.arange(N) * Ts, {12.0: 0.3, 68.0: -0.8, 150.0: 1.9}
    u = 0.01 * sum(np.sin(2 * np.pi * f * t + p) for f, p in tones.items())
    w, H = freqs([1.0], [m["inertia"], c["coefficient"], k["stiffness"]], 2 * np.pi * np.array(list(tones)))
    y = 0.01 * sum(
        abs(h) * np.sin(x * t + p + np.angle(h)) for x, h, p in zip(w, H, tones.values(), strict=True)
    )
    smooth = rf.Exponential(substeps=substeps, between="smooth")
    e = (rf.simulate(box, u, Ts, solver=smooth)[:, 0] - y)[300:-50]
    held = (rf.simulate(box, u, Ts)[:, 0] - y)[300:-50]
    assert np.std(e) < {1: 4e-3, 2: 3e-4, 4: 1e-4}[substeps] * np.std(y)
    assert np.std(held) > 0.2 * np.std(y)


def test_what_is_smoothed_is_linear_and_keeps_a_constant():
    v = jax.random.normal(jax.random.key(3), (200,))
    np.testing.assert_allclose(substep_voltages(jnp.full(200, 0.7), 3), 0.7, atol=1e-4)
    np.testing.assert_allclose(substep_voltages(2 * v, 2), 2 * substep_voltages(v, 2), rtol=1e-5, atol=1e-5)
    with pytest.raises(InputError, match="smooth between its samples"):
        rf.kernels.local_kernels(
            rf.Model(rf.joints.silverbox(), rf.Exponential(substeps=2, between="smooth")), 0.001, "output", 4
        )


def test_noise_under_fast_motion():
    """A motion with a period of nine samples does not count as noise of the sensor."""
    rng, k = np.random.default_rng(0), np.arange(6000)
    y = 0.05 * np.sin(2 * np.pi * k / 9.1) + 3e-4 * rng.normal(size=6000)
    run = Recording(u=np.sin(k), y=y, Ts=1 / 610, channels="output", units="V")
    assert sensor_noise([run], rf.Model(rf.joints.silverbox()))[0] == pytest.approx(3e-4, rel=0.5)


def test_first_states_held_where_a_drift_would_move_them():
    """An axis with a force that the model lacks: a fitted first position hides a part of the error.

    With measured first states, the residuals of the fit are those of a free run by the benchmark's protocol.
    """
    rng, Ts, mass, c = np.random.default_rng(1), 0.01, 90.0, 200.0
    u = np.repeat(rng.choice([-1.0, 1.0], 40), 50)
    y, x, v = np.empty(len(u)), 0.0, 0.0
    for k, volts in enumerate(u):
        y[k] = x
        free, fade = (35.0 * volts + 1.5) / c, np.exp(-c * Ts / mass)
        x, v = x + free * Ts + (v - free) * mass / c * (1 - fade), free + (v - free) * fade
    run = Recording(
        u=u, y=y + 1e-6 * rng.normal(size=len(u)), Ts=Ts, channels="position", units="m", n_init=20
    )
    model = rf.joints.emps(60.0, damping=120.0, gain=35.0)
    share = {}
    for first in ("fitted", "measured"):
        found = rf.fit(model, run, first=first)
        share[first] = found.noise["position"] / rf.metrics.rmse(run, found.model.simulate(run))["position"]
    assert share["measured"] == pytest.approx(1.0, abs=0.15)
    assert share["fitted"] < 0.8


def _box(error: float = 0.0) -> Benchmark:
    k = np.arange(300.0)
    run = Recording(u=np.sin(k), y=np.cos(0.1 * k), Ts=0.01, channels="position", units="m", n_init=20)
    return Benchmark("box", run, {"one": run}, "mm", 1e3, (Published("a", {"one": 3.0}, ""),), (), "")


def test_a_score_counts_what_follows_the_first_samples_in_the_unit_of_the_benchmark():
    box = _box()

    class Shifted:
        def simulate(self, recording: Recording) -> np.ndarray:
            shift = np.where(np.arange(recording.N) < 20, 1.0, 0.002)
            return recording.y + shift[:, None]

    assert box.score(Shifted()) == {"one": pytest.approx(2.0)}
    assert box.error("one", box.train.y[:, 0] - 0.001) == pytest.approx(1.0)
    assert box.best("one") == 3.0
    with pytest.raises(InputError, match="no test 'two'"):
        box.error("two", box.train.y)
    with pytest.raises(InputError, match="no benchmark 'robot'; choose one of emps, silverbox"):
        benchmark("robot")


def test_emps_with_published_constants_scores_as_an_explicit_simulation(measured: Measured):
    """Reference: 8.56 and 5.46 mm of an explicit Euler simulation of the published equation, 1 ms steps."""
    measured("emps")
    emps = benchmark("emps")
    constants = {c.parameter: c.value for c in emps.constants}
    machine = rf.joints.emps() + Coulomb(at="axis") + VoltageOffset()
    model = rf.Model(machine.with_values(constants))
    assert emps.score(model)["pulses"] == pytest.approx(8.56, abs=0.4)
    train = dataclasses.replace(emps, tests={"train": emps.train})
    assert train.score(model)["train"] == pytest.approx(5.46, abs=0.4)


def test_silverbox_with_one_cubic_spring_scores_as_an_explicit_simulation(measured: Measured):
    """Reference: 0.353, 0.451 and 0.351 mV of a Runge-Kutta simulation on an input interpolated 8 times."""
    measured("silverbox")
    gain = 0.9301 * 2e5
    box = (
        rf.joints.silverbox()
        + CubicSpring(at="joint", stiffness=7.2722e5 / gain)
        + VoltageOffset(offset=-5.372e-3)
    )
    numbers = {"inertia.inertia": 1.0, "viscous.coefficient": 41.900, "spring.stiffness": 1.84299e5}
    box = box.with_values({f"joint.{n}": v / gain for n, v in numbers.items()})
    scored = benchmark("silverbox").score(
        rf.Model(box, rf.Exponential(order=4, substeps=2, between="smooth"))
    )
    assert list(scored.values()) == pytest.approx([0.353, 0.451, 0.351], abs=0.015)
    held = benchmark("silverbox").score(rf.Model(box))
    assert held["multisine"] > 10


def test_presets_of_the_laboratory():
    rigid, bent = rf.joints.rotary_arm(), rf.joints.rotary_arm(flexible=True)
    assert (rigid.channels, bent.channels) == (("theta",), ("theta", "alpha"))
    # Stall torque and free speed per volt from the laboratory's constants.
    motor = rigid.effect("motor", "hub").stamp()
    assert motor.drive == pytest.approx(48.4 * 0.0107 / 3.29)
    assert motor.drive / motor.damping == pytest.approx(1 / (48.4 * 0.0107))
