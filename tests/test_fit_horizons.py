"""Fits of long free runs with incomplete models, bounds, and sizes that the recordings do not reach."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import small_problem as sp
from scipy.linalg import expm
from scipy.optimize import least_squares, lsq_linear, minimize
from scipy.signal import lfilter

import rotflex_jax.effects as fx
from rotflex_jax.arena.simulator.records import COUNT, JITTER, make_record
from rotflex_jax.discover.hypothesis import Hypothesis, is_physical
from rotflex_jax.discover.search_state import SearchState
from rotflex_jax.discover.supermodel import EffectLocation, build, scales
from rotflex_jax.errors import InputError
from rotflex_jax.fit import fit
from rotflex_jax.fit.inference import RecordingSlopes, curvature, nats_that_count
from rotflex_jax.fit.plausibility import Reach, beyond_recordings, physical_ranges
from rotflex_jax.joints import paper, quanser_2010
from rotflex_jax.mechanism import Mechanism, simulate
from rotflex_jax.metrics import window_starts
from rotflex_jax.models.model import Model
from rotflex_jax.optimise.damped_least_squares import (
    NormalEquations,
    Rules,
    Status,
    minimise,
    solution_within,
)
from rotflex_jax.parameters import Transform
from rotflex_jax.recording import Recording

SECONDS, NOISE = 10.0, np.sqrt(JITTER**2 + COUNT**2 / 12)


def recorded(effects, seed: int = 3, seconds: float = SECONDS, fs: float = 250.0) -> tuple[Recording, dict]:
    r = make_record(effects, seed=seed, seconds=seconds, fs=fs, rms=1.5)
    return Recording(u=r["u"], y=r["y"], Ts=r["Ts"], accept=("units",)), r["truth"]["plant"]


@pytest.fixture(scope="module")
def lacking():
    """A machine with Stribeck friction, dead zone and cubic spring; the model has Coulomb friction alone."""
    effects = {
        ("stribeck", "hub"): 1.0,
        ("dead_zone", "input"): {"width": 0.2},
        ("cubic_spring", "joint"): 1.0,
    }
    rec, _ = recorded(effects)
    start = paper(hub_inertia=0.003, stiffness=1.2, joint_damping=0.01) + fx.Coulomb("hub", level=0.01)
    lines: list[str] = []
    return rec, start, fit(start, rec, progress=lines.append), lines


def likelihood(model: Mechanism, rec: Recording, x0: np.ndarray) -> float:
    """Negative log-likelihood of a free run, each channel with its own scale."""
    rms = np.sqrt(np.mean((simulate(model, rec.u, rec.Ts, x0=x0) - rec.y) ** 2, axis=0))
    return float(rec.N * np.sum(np.log(rms) + 0.5 * np.log(2 * np.pi) + 0.5))


def test_a_long_run_of_a_model_that_lacks_something_ends_at_the_best_end_of_scipy(lacking):
    """Reference: the best end of `scipy.optimize.least_squares` on the same residuals, from four starts."""
    rec, start, found, _ = lacking
    assert found.status == "converged"
    names = list(found.free_names)
    specs = dict(zip(start.parameter_names, start.parameter_specifications, strict=True))
    scale = np.array(list(found.noise.values()))
    sizes = np.array(
        [max(abs(found[n].value), 0.1 * specs[n].typical) for n in names] + [0.01, 0.01, 0.1, 0.1]
    )
    positive = np.array([np.isfinite(specs[n].lower) for n in names] + [False] * 4)

    def at(x: np.ndarray) -> tuple[Mechanism, np.ndarray]:
        values = np.where(positive, np.exp(x), x) * sizes
        return start.with_values(dict(zip(names, values[: len(names)], strict=True))), values[len(names) :]

    def residuals(x: np.ndarray) -> np.ndarray:
        model, x0 = at(x)
        return np.nan_to_num((simulate(model, rec.u, rec.Ts, x0=x0) - rec.y) / scale, nan=1e3).ravel()

    rng, best = np.random.default_rng(0), np.inf
    for spread in (0.0, 0.1, 0.2, 0.3):
        first = np.where(positive, 0.0, 0.5) * np.append(np.ones(len(names)), np.zeros(4))
        first = first + spread * rng.standard_normal(len(first))
        end = least_squares(residuals, first, diff_step=1e-5, max_nfev=40)
        best = min(best, likelihood(*(at(end.x)[0], rec, at(end.x)[1])))
    # Errors are correlated over tens of samples: with them a few nats are less than a confidence interval.
    assert found.cost < best + 5.0
    assert found.cost == pytest.approx(best, abs=0.01 * rec.N)


def test_fits_restart_only_where_something_is_missing(lacking):
    assert any("restart" in line for line in lacking[3])
    again: list[str] = []
    nearby = fit(lacking[2].model, lacking[0], progress=again.append)  # it starts near that end
    assert any("restart" in line for line in again) and nearby.cost < lacking[2].cost + 5.0
    rec, plant = recorded([("coulomb", "hub")])
    lines: list[str] = []
    right = fit(paper() + fx.Coulomb("hub", level=0.015), rec, progress=lines.append)
    assert right.status == "converged"
    assert not any("restart" in line or "again" in line for line in lines)
    np.testing.assert_allclose(list(right.noise.values()), NOISE, rtol=0.15)
    assert right["joint.spring.stiffness"].value == pytest.approx(plant["K"], rel=0.02)


def test_restarts_find_no_less_than_the_law_that_is_contained_finds():
    """LuGre friction has Coulomb friction as a limit, so its least cost is no higher.

    A fit from a single start may end above it in a local minimum.
    """
    rec, _ = recorded(
        {("stribeck", "hub"): 1.0, ("dead_zone", "input"): {"width": 0.2}, ("cubic_spring", "joint"): 1.0},
        seed=13,
    )
    joint = paper(hub_inertia=0.003, stiffness=1.2, joint_damping=0.01)
    short = {"first": "measured", "window_seconds": 2.0}
    simple, richer = joint + fx.Coulomb("hub"), joint + fx.LuGre("hub")
    found = fit(richer, rec, **short)
    assert found.cost < fit(simple, rec, **short).cost
    assert found.cost <= fit(richer, rec, restarts=0, **short).cost
    with pytest.raises(InputError, match="restarts"):
        fit(simple, rec, restarts=-1)


def linear_run(damping: float, emf: float = 1.0) -> Recording:
    """A joint without friction by the matrix exponential, with a given damping and factor of the back-EMF."""
    p = paper().named_values
    Jh, Ja, k = p["hub.inertia.inertia"], p["arm.inertia.inertia"], p["joint.spring.stiffness"]
    gain = p["hub.motor.gear_ratio"] * p["hub.motor.torque_constant"] / p["hub.motor.resistance"]
    hub = gain * p["hub.motor.gear_ratio"] * p["hub.motor.back_emf"] * emf
    M = np.linalg.inv([[Jh + Ja, Ja], [Ja, Ja]])
    big, Ts, N = np.zeros((5, 5)), 0.004, 800
    big[:2, 2:4] = np.eye(2)
    big[2:4, :2], big[2:4, 2:4] = -M @ np.diag([0.0, k]), -M @ np.diag([hub, damping])
    big[2:4, 4] = M @ [gain, 0.0]
    step, rng = expm(big * Ts), np.random.default_rng(5)
    u = np.repeat(rng.uniform(-3, 3, N // 25), 25)
    x, y = np.zeros(4), np.empty((N, 2))
    for n in range(N):
        y[n], x = x[:2], step[:4, :4] @ x + step[:4, 4] * u[n]
    return Recording(u=u, y=y + 3e-4 * rng.standard_normal(y.shape), Ts=Ts, accept=("units",))


def test_a_joint_that_would_feed_energy_in_is_held_at_none_and_that_is_said():
    name = "joint.viscous.coefficient"
    found = fit(paper(joint_damping=0.004, stiffness=1.4), linear_run(-0.0015))
    assert found[name].value == 0.0 and np.isnan(found[name].std)
    assert found[name].note == "at its lower bound"
    assert [r.parameter for r in found.remarks] == [name] and "lower bound" in str(found)
    others = [found[n].std for n in found.free_names if n != name]
    assert np.isfinite(others).all() and np.min(others) > 0
    free = fit(paper(joint_damping=0.004, stiffness=1.4), linear_run(0.0015))
    assert not free.remarks and free[name].value == pytest.approx(0.0015, abs=4 * free[name].std)


def test_a_damper_beside_a_motor_may_take_away_what_the_motor_has_too_much():
    """The back-EMF is a tenth below the trusted one: the damper becomes negative by the difference."""
    m = paper()
    p = m.named_values
    constant, emf = p["hub.motor.torque_constant"], p["hub.motor.back_emf"]
    motor = p["hub.motor.gear_ratio"] ** 2 * constant * emf / p["hub.motor.resistance"]
    found = fit(paper(stiffness=1.4), linear_run(0.002, emf=0.9))["hub.viscous.coefficient"]
    assert found.value == pytest.approx(-0.1 * motor, abs=4 * found.std)
    # The range ends where the damper cancels the damping of the motor, with and without inductance.
    k = m.parameter_names.index("hub.viscous.coefficient")
    low, high = physical_ranges(m)
    assert low[k] * m.parameter_specifications[k].typical == pytest.approx(-motor) and high[k] == np.inf
    slow = paper(inductance=2e-4)
    k = slow.parameter_names.index("hub.viscous.coefficient")
    assert physical_ranges(slow)[0][k] * slow.parameter_specifications[k].typical == pytest.approx(-motor)


@pytest.mark.parametrize(
    ("run", "seconds"),
    [
        (lambda: linear_run(0.0015, emf=0.9), 0.5),
        (lambda: recorded([("coulomb", "hub")], seconds=4.0)[0], 1.0),
    ],
    ids=["complete", "without friction"],
)
def test_no_parameters_have_smaller_errors_from_first_states_measured_with_them(run, seconds):
    """Reference: Powell's method on errors over windows, whose first states every model fits to the data."""
    rec = run()
    found = fit(paper(stiffness=1.3), rec, first="measured", window_seconds=seconds, restarts=0)
    names = found.free_names
    at, std = (np.array([getattr(found[n], what) for n in names]) for what in ("value", "std"))

    def cost(z: np.ndarray) -> float:
        values = dict(zip(names, (at + z * std).tolist(), strict=True))
        model = dataclasses.replace(found.model, mechanism=found.model.mechanism.with_values(values))
        errors = model.simulate_windows(rec, seconds) - rec.y
        return float(rec.N * np.sum(np.log(np.sqrt(np.mean(errors**2, axis=0)))))

    here = np.zeros(len(names))
    assert cost(here) - minimize(cost, here, method="Powell", options={"maxiter": 6}).fun < 0.05  # nats


def test_windows_are_driven_by_the_voltage_of_the_whole_recording():
    """Delay, lag and memories continue across windows in the fit, as in `simulate_windows`."""
    rec, _ = recorded([("coulomb", "hub")], seconds=3.0)
    late = np.concatenate([np.zeros(6), rec.u[:-6]])
    rec = Recording(u=rec.u, y=np.array(recorded_under(late)), Ts=rec.Ts, accept=("units",))
    model = paper() + fx.Dahl("hub", level=0.015) + fx.Delay(time=0.02) + fx.Lag(time=0.004)
    found = fit(model, rec, first="measured", window_seconds=0.25)
    e = found.model.simulate_windows(rec, 0.25) - rec.y
    np.testing.assert_allclose(np.sqrt(np.mean(e**2, axis=0)), list(found.noise.values()), rtol=1e-4)
    starts = window_starts(rec, 0.25)[0]
    going_on = found.model.simulate_states(rec)[starts, 4:]
    np.testing.assert_allclose(found.model.states_at(rec, starts)[:, 4:], going_on, atol=1e-12)
    assert np.abs(going_on[1:]).min() > 0
    both = found["input.delay.time"].value + found["input.lag.time"].value
    assert both == pytest.approx(6 * rec.Ts, abs=0.25 * rec.Ts)


def recorded_under(voltage: np.ndarray) -> np.ndarray:
    """Outputs of the machine with the same seed and friction, under another voltage."""
    return make_record([("coulomb", "hub")], seed=3, fs=250.0, played=voltage)["y"]


def test_a_size_that_no_signal_reaches_is_said():
    rec, _ = recorded([("coulomb", "hub")], seconds=3.0)
    model = paper() + fx.Coulomb("hub", level=0.02) + fx.Saturation(limit=200.0)
    found = fit(model, rec)
    beyond = [r for r in found.remarks if r.kind == "beyond the recordings"]
    assert [r.parameter for r in beyond] == ["input.saturation.limit"]
    assert f"{np.abs(rec.u).max():.3g} V" in beyond[0].sentence and beyond[0].sentence in str(found)
    assert beyond[0].to_dict()["kind"] == beyond[0].kind
    reach = Reach.of(Model(model), [rec])
    near = model.with_values({"input.saturation.limit": 2.9 * reach.input})
    assert not beyond_recordings(near, reach)
    # A trusted parameter is known by other means.
    assert not beyond_recordings(model.trust("input.saturation.limit"), reach)
    # Largest speed and half the travel at a port, whatever their sign and offset.
    hub = np.gradient(rec.y[:, 0], rec.Ts)
    assert reach.speed["hub"] == pytest.approx(np.abs(hub).max(), rel=0.2)
    assert reach.position["hub"] == pytest.approx(np.ptp(rec.y[:, 0]) / 2, rel=0.05)
    slow = paper() + fx.Stribeck("hub", speed=4 * reach.speed["hub"])
    assert [r.parameter for r in beyond_recordings(slow, reach)] == ["hub.stribeck.speed"]


@pytest.mark.parametrize(("seconds", "beyond"), [(9.9, False), (10.1, True)])
def test_a_lag_longer_than_the_recording_is_beyond_it(seconds, beyond):
    reach = Reach(input=1.0, position={}, speed={}, seconds=10.0)
    found = beyond_recordings(paper() + fx.Lag(time=seconds), reach)
    assert [r.parameter for r in found] == ["input.lag.time"] * beyond
    assert all("a third of the recording: 3.33 s" in r.sentence for r in found)


def test_a_cogging_that_repeats_less_than_half_a_time_is_beyond_the_recordings():
    """Half a period within the motion is a phase of pi; the limit is 3 rad."""
    cogging = fx.Cogging(at="hub", sine=0.01, periods=4.0)
    name = "hub.cogging.periods"
    for travel, hidden in ((2.8, True), (3.1, False)):  # phase over the whole motion [rad]
        half = travel / 2 / cogging.periods
        reach = Reach(input=1.0, position={"hub": half}, speed={}, seconds=10.0)
        m = paper() + cogging
        found = beyond_recordings(m, reach)
        assert [r.parameter for r in found] == [name] * hidden
        assert not beyond_recordings(m.trust(name), reach)
        assert not beyond_recordings(m, reach._replace(position={}))
    close = beyond_recordings(m, reach._replace(position={"hub": np.radians(10.0)}))
    assert close[0].sentence.startswith("hub.cogging.periods = 4 per turn is less than half a period")
    assert "(20 degrees)" in close[0].sentence and "spring or a constant torque" in close[0].sentence


def test_a_search_leaves_out_candidates_of_sizes_that_no_signal_reaches():
    found = sp.recordings(sp.records())
    at = sp.problem(found)
    s, location = at.supermodel, EffectLocation("coulomb", "hub")

    class Horizons:
        prediction = type("Prediction", (), {"problem": at})

    present: Any = SimpleNamespace(hypothesis=sp.start(at), free_run=None)
    state = SearchState(Model(sp.baseline()), Horizons, print, present)
    h = sp.start(at, locations=(*s.calibrations, location))
    assert is_physical(s, h, location) and state.is_plausible(h, location)
    damper = EffectLocation("viscous", "hub")
    values = h.mean_values(s)
    values[s.parameter_indices(damper)] = -1.0
    driving = dataclasses.replace(h, z=Transform.of(s.mechanism.parameter_specifications).unconstrain(values))
    assert state.fault(driving, damper) == "a parameter is outside its physical range"
    reach = state.reach
    assert reach.input == max(np.abs(r.u).max() for r in found)
    offset = next(c for c in s.calibrations if c.effect == "voltage_offset")
    z = h.local_z.copy()
    z[:, list(s.local).index(s.parameter_indices(offset)[0])] = 1e4
    large = type(h)(**{**vars(h), "local_z": z})
    assert not state.is_plausible(large, offset) and is_physical(s, large, offset)


@pytest.mark.parametrize(("present", "most"), [(0.0, 0.2), (0.05, 0.2), (-0.15, 0.3)])
def test_a_search_leaves_out_candidates_that_need_a_large_offset(present: float, most: float):
    """Four typical sizes of 0.05 V, or twice the offset of the present model, in any recording."""
    at = sp.problem(sp.recordings(sp.records()))
    s, location = at.supermodel, EffectLocation("coulomb", "hub")
    column = list(s.local).index(s.mechanism.parameter_names.index("input.voltage_offset.offset"))

    class Horizons:
        prediction = type("Prediction", (), {"problem": at})

    def with_offset(volts: float, *locations: EffectLocation) -> Hypothesis:
        h = sp.start(at, locations=(*s.calibrations, *locations))
        local_z = h.local_z.copy()
        local_z[1, column] = volts / 0.05
        return dataclasses.replace(h, local_z=local_z)

    given: Any = SimpleNamespace(hypothesis=with_offset(present), free_run=None)
    state = SearchState(Model(sp.baseline()), Horizons, print, given)
    for sign in (-1, 1):
        assert state.is_plausible(with_offset(sign * 0.98 * most, location), location)
        assert "offset" in state.fault(with_offset(sign * 1.02 * most, location), location)


@pytest.mark.parametrize(("share", "plausible"), [(0.98, False), (1.02, True)])
def test_a_search_leaves_out_sensors_that_could_not_read_what_was_recorded(
    share: float, plausible: bool, monkeypatch: pytest.MonkeyPatch
):
    """A cubic error limits the readings, here to 2 % below or above the largest recorded one."""
    found, location = sp.recordings(sp.records()), EffectLocation("sensor_cubic", "theta")
    sizes = scales(Model(sp.baseline()), found, sp.dataset(found).torque_scale)
    s = build(sp.baseline(), [(fx.SensorCubic, "theta")], sizes)
    monkeypatch.setattr(sp, "supermodel", lambda: s)
    at = sp.problem(found)
    largest = max(float(np.abs(r.y[:, 0]).max()) for r in found)

    class Horizons:
        prediction = type("Prediction", (), {"problem": at})

    def turn(cubic: float) -> float:
        """The largest reading before the readings decrease, on a grid."""
        value = np.linspace(0.0, 20 * largest, 200_001)
        reading = value + cubic * value**3
        return float(reading[: int(np.argmax(np.diff(reading) < 0)) + 1].max())

    # The relative error depends on `cubic value^2` only, so one maximum gives those of all coefficients.
    cubic = -((turn(-1.0) / (share * largest)) ** 2)
    assert turn(cubic) == pytest.approx(share * largest, rel=1e-3)
    h = sp.start(at, locations=(*s.calibrations, location))
    transform = Transform.of(s.mechanism.parameter_specifications)

    def with_error(cubic: float) -> Hypothesis:
        values = h.mean_values(s)
        values[s.parameter_indices(location)] = cubic
        return dataclasses.replace(h, z=transform.unconstrain(values))

    present: Any = SimpleNamespace(hypothesis=h, free_run=None)
    state = SearchState(Model(sp.baseline()), Horizons, print, present)
    reason = "" if plausible else "such a sensor could not read what was recorded"
    assert state.fault(with_error(cubic), location) == reason
    assert is_physical(s, with_error(cubic), location)
    assert state.is_plausible(with_error(10 * abs(cubic)), location)


def test_nats_of_errors_that_go_on_count_less():
    """With AR(1) errors and a constant slope, (1 + a) / (1 - a) nats count as one of white errors."""
    rng, a, N = np.random.default_rng(2), 0.9, 40_000
    e = lfilter([np.sqrt(1 - a**2)], [1.0, -a], rng.standard_normal(N))[:, None]
    X = np.ones((N, 1, 1))

    def counted(e: np.ndarray) -> float:
        parts = [RecordingSlopes(X, e / e.std(), np.array([0]))]
        return nats_that_count(parts, curvature(parts, 1))

    assert counted(e) == pytest.approx((1 + a) / (1 - a), rel=0.25)
    assert counted(rng.standard_normal((N, 1))) == pytest.approx(1.0, abs=0.5)


def test_a_step_within_a_box_is_that_of_scipy():
    rng = np.random.default_rng(4)
    for _ in range(20):
        A, b = rng.normal(size=(15, 5)), 3 * rng.normal(size=15)
        low, high = -rng.uniform(0, 0.5, 5), rng.uniform(0, 0.5, 5)
        reference = lsq_linear(A, b, (low, high), method="bvls", tol=1e-14)
        x, at_end = solution_within(A.T @ A, A.T @ b, low, high)
        ours = 0.5 * np.sum((A @ x - b) ** 2)
        # Each entry is released from its bound at most once, so a small excess of cost may remain.
        assert reference.cost <= ours * (1 + 1e-9) and ours <= reference.cost * 1.02
        assert ((x >= low) & (x <= high)).all() and (at_end >= ((x == low) | (x == high))).all()


def test_a_minimisation_ends_in_the_unit_of_its_end():
    """A unit that is large only at first does not stop the minimisation early; one that stays large does."""

    def valley(x: np.ndarray) -> NormalEquations:
        J = np.array([[-1.0, 0.0], [-20 * x[0], 10.0]])
        return NormalEquations.of(J, np.array([1.0 - x[0], 10 * (x[1] - x[0] ** 2)]))

    rules = Rules(enough=1e-12, window=8, least_progress=1e-6)
    seen: list[float] = []

    def unit(equations: NormalEquations) -> float:
        seen.append(float(equations.cost))
        return 1e8 if len(seen) == 1 else 1.0

    rough = minimise(valley, np.array([-1.2, 1.0]), rules, unit=lambda _: 1e8, max_steps=200)
    fine = minimise(valley, np.array([-1.2, 1.0]), rules, unit=unit, max_steps=200)
    assert rough.status == fine.status == Status.CONVERGED
    assert rough.cost > 1e-3 and fine.cost < 1e-10 and len(seen) > 1


def test_the_start_of_a_preset_is_within_its_ranges():
    for m in (paper(), quanser_2010()):
        low, high = physical_ranges(m)
        z = Model(m).mechanism.values
        assert len(low) == len(high) == len(z) and (low <= high).all()
