"""Robust fits, in which large errors count linearly, against scipy on a run that is disturbed for a while."""

import dataclasses

import numpy as np
import optimistix
import pytest
from scipy.optimize import least_squares

import rotflex_jax as rf
from rotflex_jax.errors import InputError

TS, N = 0.01, 400
NAMES = ("hub.inertia.inertia", "hub.viscous.coefficient")
TRUTH = (0.02, 0.05)


def machine() -> rf.Mechanism:
    return rf.Mechanism(
        ("q",),
        {"hub": (1.0,)},
        [
            rf.effects.Inertia("hub", inertia=0.02),
            rf.effects.CurrentDrive("hub", gain=0.1),
            rf.effects.Spring("hub", stiffness=0.5),
            rf.effects.Viscous("hub", coefficient=0.05),
        ],
        outputs={"theta": "hub"},
        trusted=("hub.current_drive.gain", "hub.spring.stiffness"),
    )


@pytest.fixture(scope="module")
def knocked() -> rf.Recording:
    """A run with noise, and with a disturbance of the measured angle for a tenth of the time."""
    u = rf.data.excitation.multisine(N, TS, rms=1.0, seed=2)
    y = rf.simulate(machine(), u, TS) + np.random.default_rng(0).normal(0, 1e-3, (N, 1))
    y[200:240, 0] += 0.4 * np.hanning(40)
    return rf.Recording(u=u, y=y, Ts=TS, channels=("theta",))


def test_it_ends_where_scipys_does_and_near_the_truth(knocked):
    start = machine().with_values(dict(zip(NAMES, (0.027, 0.035), strict=True)))
    plain = rf.fit(start, knocked, first="measured")
    found = rf.fit(start, knocked, first="measured", robust=1.5)
    assert found.status == "converged" and found.options.bend is not None
    model = rf.Model(machine())
    x0 = model.states_at(knocked, np.array([0]))[0]

    def errors(x: np.ndarray) -> np.ndarray:
        m = machine().with_values(dict(zip(NAMES, x.tolist(), strict=True)))
        return rf.simulate(m, knocked.u, TS, x0=x0)[:, 0] - knocked.y[:, 0]

    values = np.array([found[n].value for n in NAMES])
    with_scipy = least_squares(
        errors, TRUTH, loss="soft_l1", f_scale=found.options.bend[0], x_scale=TRUTH, xtol=1e-12, ftol=1e-12
    )
    np.testing.assert_allclose(values, with_scipy.x, rtol=2e-3)
    away = lambda fit: max(abs(fit[n].value / t - 1) for n, t in zip(NAMES, TRUTH, strict=True))  # noqa: E731
    assert away(found) < 0.04 and away(plain) > 3 * away(found)
    # The profile uses the same robust cost.
    low, high = found.profile(NAMES[0], knocked).interval(0.95)
    assert low < values[0] < high


def test_what_cannot_be_asked_for(knocked):
    with pytest.raises(InputError, match="`robust` must be"):
        rf.fit(machine(), knocked, robust=0.0)
    with pytest.raises(InputError, match="minimiser of optimistix, but only the toolkit's own bends"):
        rf.fit(machine(), knocked, robust=1.0, minimiser=optimistix.Dogleg(rtol=1e-6, atol=1e-6))


def test_friction_of_the_motors_torque_alone_lets_go_of_a_machine_without_torque():
    """Friction by the motor's torque alone vanishes with it, so the machine moves as without friction.

    Friction by the torques of both sides depends on the weight too, and changes the motion.
    """
    base = rf.joints.position_servo(0.007, servo=rf.effects.PositionServo(enabled=0.0), weight=0.48)
    runs = {}
    for of in ("both", "motor"):
        m = base + rf.effects.LoadFriction("hub", level=0.0, driving=0.5, tied=True, of=of)
        runs[of] = rf.simulate(m, np.zeros(200), 0.005, x0=[1.0, 0.0])[:, 0]
    free = rf.simulate(base, np.zeros(200), 0.005, x0=[1.0, 0.0])[:, 0]
    np.testing.assert_allclose(runs["motor"], free, atol=1e-9)
    assert np.max(np.abs(runs["both"] - free)) > 0.3
    # To lift the weight slowly, the motor must give weight / (1 - share).
    driven = dataclasses.replace(
        base, effects=tuple(e.replace(enabled=1.0) if e.name == "position_servo" else e for e in base.effects)
    )
    slow = driven + rf.effects.LoadFriction("hub", level=0.0, driving=0.4, tied=True, of="motor")
    goal = np.linspace(0.0, 1.0, 4000)
    error = (goal - rf.simulate(slow, goal, 0.005)[:, 0])[3000]
    stiffness = driven.effect("position_servo", "hub").stamp().stiffness  # pyright: ignore[reportAttributeAccessIssue]
    weight = 0.48 * np.sin(goal[3000] - error)
    assert error * stiffness == pytest.approx(weight / (1 - 0.4), rel=0.02)
