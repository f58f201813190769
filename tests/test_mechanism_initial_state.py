"""The first state comes from the first samples, and a free run uses no other measured output."""

import dataclasses
import re

import jax
import numpy as np
import pytest

import rotflex_jax.effects as fx
from rotflex_jax.arena.simulator.plant import Plant
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.joints import paper, rotary_arm
from rotflex_jax.mechanism import Exponential, simulate, simulate_states
from rotflex_jax.mechanism.initial_state import _fitted_states, initial_states, rough_states
from rotflex_jax.metrics import window_starts
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording


def joint(plant: Plant | dict):
    p = plant if isinstance(plant, dict) else dataclasses.asdict(plant)
    return paper(
        hub_inertia=p["J_hub"],
        arm_inertia=p["J_arm"],
        stiffness=p["K"],
        torque_constant=p["k_t"],
        hub_damping=p["B_hub"],
        joint_damping=p["B_joint"],
    )


@pytest.fixture(scope="module")
def truth():
    """A joint in motion, by the arena's own simulator, and a model with the true parameters."""
    r = make_record({("coulomb", "hub"): 1.0}, seed=11, seconds=4.0, fs=200.0, rms=2.0)
    return r, joint(r["truth"]["plant"]) + fx.Coulomb("hub", level=0.03)


def stretches(r, key: str, starts, m: int):
    pick = np.asarray(starts)[:, None] + np.arange(m)
    return r["u"][pick], r[key][pick]


STARTS = [60, 200, 333, 500, 704]


def test_recovers_the_true_state_from_noise_free_samples(truth):
    r, mechanism = truth
    u, y = stretches(r, "clean", STARTS, 40)
    gates = np.ones(len(mechanism.effects))
    # Steps short enough that the simulators differ by little.
    found = initial_states(mechanism, Exponential(substeps=4), gates, u, y, r["Ts"])
    true = r["state"][STARTS]
    assert np.ptp(true[:, 2]) > 1 and np.ptp(true[:, 3]) > 1  # in motion
    np.testing.assert_allclose(found[:, :2], true[:, :2], atol=2e-5)
    np.testing.assert_allclose(found[:, 2:], true[:, 2:], atol=2e-3)
    # The accuracy is due to the fit with the simulator: straight lines are far off.
    rough = rough_states(mechanism.structure, y, r["Ts"])
    assert np.abs(rough - true).max() > 0.3


def test_recovers_its_own_state_exactly(truth):
    r, mechanism = truth
    true = simulate_states(mechanism, r["u"], r["Ts"])
    u, y = stretches({"u": r["u"], "own": true[:, :2]}, "own", STARTS, 40)
    gates = np.ones(len(mechanism.effects))
    found = initial_states(mechanism, Exponential(), gates, u, y, r["Ts"])
    np.testing.assert_allclose(found, true[STARTS], rtol=0, atol=1e-7)


def test_a_stretch_is_read_by_itself(truth):
    """The first state of a segment does not depend on other segments, with a large angle or with noise."""
    r, mechanism = truth
    u, y = stretches(r, "y", STARTS, 40)
    gates = np.ones(len(mechanism.effects))
    found = initial_states(mechanism, Exponential(), gates, u, y, r["Ts"])
    other = y.copy()
    other[0, :, 0] += 600.0
    other[2] += np.random.default_rng(2).normal(size=other[2].shape)
    again = initial_states(mechanism, Exponential(), gates, u, other, r["Ts"])
    same = [1, 3, 4]
    np.testing.assert_allclose(again[same], found[same], rtol=0, atol=1e-9)
    # A constant in the angle of the hub only adds to that angle.
    np.testing.assert_allclose(again[0] - found[0], [600, 0, 0, 0], atol=1e-5)


def test_other_numbers_of_stretches_compile_nothing_and_change_none(truth):
    """Arrays have a least number of rows; larger ones are filled up to the next power of two."""
    r, mechanism = truth
    gates, starts = np.ones(len(mechanism.effects)), np.linspace(50, 740, 70).astype(int)
    u, y = stretches(r, "y", starts, 40)
    found = initial_states(mechanism, Exponential(), gates, u, y, r["Ts"])
    assert found.shape == (70, 4)
    few = initial_states(mechanism, Exponential(), gates, u[:3], y[:3], r["Ts"])
    held = _fitted_states.programs_made
    for chosen in ([69], range(20, 70)):
        pick = list(chosen)
        alone = initial_states(mechanism, Exponential(), gates, u[pick], y[pick], r["Ts"])
        np.testing.assert_allclose(alone, found[pick], rtol=0, atol=1e-7)
    np.testing.assert_allclose(few, found[:3], rtol=0, atol=1e-7)
    assert _fitted_states.programs_made == held


def test_samples_of_another_shape_compile_nothing_but_the_program_that_uses_them(truth, caplog):
    """`jnp.asarray` would compile a program for each shape that it has not seen."""
    r, mechanism = truth
    gates = np.ones(len(mechanism.effects))
    u, y = stretches(r, "y", STARTS, 43)
    with jax.log_compiles():
        initial_states(mechanism, Exponential(), gates, u, y, r["Ts"])
    names = re.findall(r"Finished XLA compilation of (\S+)", caplog.text)
    assert set(names) <= {"jit(flat)"}


def test_encoder_noise_is_averaged(truth):
    """Errors of the speeds are smaller than those of a difference of two samples."""
    r, mechanism = truth
    starts = np.arange(50, 750, 20)
    u, y = stretches(r, "y", starts, 40)
    gates = np.ones(len(mechanism.effects))
    found = initial_states(mechanism, Exponential(), gates, u, y, r["Ts"])
    error = found - r["state"][starts]
    noise = np.std(r["y"] - r["clean"])
    assert np.sqrt(np.mean(error[:, :2] ** 2)) < noise
    assert np.sqrt(np.mean(error[:, 2:] ** 2)) < 0.3 * noise / r["Ts"]


def test_what_is_not_measured_is_told_by_the_motion(truth):
    """The deflection is estimated from the angle of the hub alone."""
    r, mechanism = truth
    alone = dataclasses.replace(mechanism, outputs={"theta": "hub"})
    u, y = stretches(r, "clean", [200, 500], 60)
    gates = np.ones(len(alone.effects))
    found = initial_states(alone, Exponential(), gates, u, y[..., :1], r["Ts"])
    true = r["state"][[200, 500]]
    np.testing.assert_allclose(found[:, :2], true[:, :2], atol=2e-4)
    np.testing.assert_allclose(found[:, 2:], true[:, 2:], atol=2e-2)


class Flexure(fx.Spring):
    """A spring that a user has defined, with another name."""

    name = "flexure"


class Flywheel(fx.Inertia):
    """An inertia that a user has defined."""

    name = "flywheel"


def test_springs_and_inertias_of_a_user_are_what_they_say():
    """From the angle of the arm alone, the spring at the joint is set relaxed, whatever its name is."""
    plain = dataclasses.replace(paper(), outputs={"arm": "arm"})
    own = plain.without("spring", "joint") + Flexure("joint", 1.2)
    y = 0.3 + np.zeros((1, 20, 1))
    for mechanism in (plain, own):
        np.testing.assert_allclose(rough_states(mechanism.structure, y, 0.01)[0], [0.3, 0, 0, 0], atol=1e-12)
    loose = plain.without("spring", "joint")
    assert rough_states(loose.structure, y, 0.01)[0][1] == pytest.approx(0.15)
    assert (plain.without("inertia", "hub") + Flywheel("hub", 0.002)).has_inertia("hub")


def test_a_measured_speed_is_read_as_a_speed():
    mechanism = dataclasses.replace(paper(), outputs={"omega": ("hub", "speed"), "alpha": "joint"})
    t = np.arange(20) * 0.01
    y = np.column_stack([1.5 + 4 * t, 0.02 - 0.3 * t])
    state = rough_states(mechanism.structure, y[None], 0.01)[0]
    assert state[2] == pytest.approx(1.5) and state[1] == pytest.approx(0.02)


@pytest.mark.parametrize("samples", [1, 20])
@pytest.mark.parametrize(
    ("mechanism", "channel", "state"),
    [
        (dataclasses.replace(paper(), outputs={"alpha": "joint", "theta": "hub"}), 1, 0),
        (rotary_arm(flexible=False), 0, 0),  # no spring
        (dataclasses.replace(paper(), outputs={"omega": ("hub", "speed")}), 0, 2),  # no sensor of a position
    ],
)
def test_each_segment_is_read_by_itself(mechanism, channel, state, samples):
    """Straight lines through five segments: the value of one channel is a state at the start of each."""
    rng, t = np.random.default_rng(3), np.arange(samples)[:, None] * 0.01
    start, slope = rng.normal(size=(2, 5, len(mechanism.channels)))
    y = start[:, None] + slope[:, None] * t
    found, n = rough_states(mechanism.structure, y, 0.01), len(mechanism.coordinates)
    alone = [rough_states(mechanism.structure, segment[None], 0.01)[0] for segment in y]
    np.testing.assert_allclose(found, alone, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found[:, state], start[:, channel], atol=1e-9)
    if state < n:
        speed = slope[:, channel] if samples > 1 else 0.0
        np.testing.assert_allclose(found[:, n + state], speed, atol=1e-8)


def scrambled(y: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """The outputs, with noise of their own size added at all samples that a model must not use."""
    rng = np.random.default_rng(9)
    out = y + rng.normal(size=y.shape) * y.std(axis=0)
    out[kept] = y[kept]
    return out


def recorded(r, y=None) -> Recording:
    return Recording(u=r["u"], y=r["y"] if y is None else y, Ts=r["Ts"], accept=("units",))


def test_simulate_looks_at_the_first_samples_only(truth):
    r, mechanism = truth
    model, record = Model(mechanism), recorded(r)
    kept = np.arange(record.N) < record.n_init
    run = model.simulate(record)
    other = recorded(r, scrambled(r["y"], kept))
    assert other.n_init == record.n_init
    np.testing.assert_array_equal(model.simulate(other), run)
    # The last of the first samples is used.
    y = r["y"].copy()
    y[record.n_init - 1] += 0.05
    assert np.abs(model.simulate(recorded(r, y)) - run).max() > 1e-3
    assert np.sqrt(np.mean((run - r["clean"]) ** 2)) < 5e-3


def test_each_window_looks_at_its_own_first_samples_only(truth):
    r, mechanism = truth
    model, record = Model(mechanism), recorded(r)
    starts, length = window_starts(record, 1.0)
    assert starts.tolist() == [0, 200, 400, 600] and length == 200
    kept = np.arange(record.N) % 200 < record.n_init
    run = model.simulate_windows(record, 1.0)
    other = recorded(r, scrambled(r["y"], kept))
    np.testing.assert_array_equal(model.simulate_windows(other, 1.0), run)
    # A window is the free run of that part of the recording.
    part = model.simulate(record.slice(200, 400))
    np.testing.assert_allclose(run[200:400], part, rtol=0, atol=1e-8)


def sine_means(sine: float, cosine: float, w: float, t: np.ndarray) -> np.ndarray:
    """Means of a sine and a cosine between times, by their integrals."""
    return np.diff((sine * -np.cos(w * t) + cosine * np.sin(w * t)) / w) / np.diff(t)


@pytest.mark.parametrize(
    ("effect", "driven"),
    [
        (fx.VoltageDrift(rate=0.5), lambda u: u + 0.5 * 0.004 * (np.arange(len(u)) + 0.5)),
        (
            fx.PeriodicDisturbance(sine=0.3, cosine=0.2, frequency=5.0),
            lambda u: u + sine_means(0.3, 0.2, 2 * np.pi * 5.0, 0.004 * np.arange(len(u) + 1)),
        ),
        (fx.Delay(time=0.1), lambda u: np.concatenate([np.full(25, u[0]), u[:-25]])),
    ],
    ids=["drift", "disturbance", "delay"],
)
def test_the_voltage_of_a_window_is_that_of_the_whole_recording(effect, driven):
    """Each window repeats a run of the bare joint under the voltage that the effect makes, in closed form."""
    u = np.random.default_rng(4).normal(size=600)
    record = Recording(u=u, y=simulate(paper(), driven(u), 0.004), Ts=0.004, accept=("units",))
    run = Model(paper() + effect).simulate_windows(record, 0.4)
    np.testing.assert_allclose(run, record.y, rtol=0, atol=1e-6)


def test_a_short_rest_joins_the_last_window(truth):
    record = recorded(truth[0]).slice(0, 650)
    starts, length = window_starts(record, 1.0)  # n_init is 40: a rest of 50 is too short
    assert starts.tolist() == [0, 200, 400] and length == 250


def test_prediction_uses_the_past_only(truth):
    """A measured sample changes later predictions, but not its own or an earlier one."""
    r, mechanism = truth
    model, noise = Model(mechanism), np.array([5e-4, 5e-4])
    run = model.predict(recorded(r), {"hub": 1e-4}, noise)
    y = r["y"].copy()
    y[500:] += 0.3
    other = model.predict(recorded(r, y), {"hub": 1e-4}, noise)
    np.testing.assert_array_equal(other[:501], run[:501])
    assert np.abs(other[501:] - run[501:]).min(axis=0).max() > 1e-4
