"""State space and equations of a model against closed forms and other libraries."""

import re

import numpy as np
import pytest
import scipy.signal

from rotflex_jax.effects import (
    CATALOG,
    Coulomb,
    CubicSpring,
    Dahl,
    Delay,
    Gravity,
    QuadraticDrag,
    SecondMode,
    SensorGain,
)
from rotflex_jax.errors import InputError
from rotflex_jax.export import latex, state_space, text
from rotflex_jax.export.equations import equation
from rotflex_jax.joints import paper, xl330_pendulum
from rotflex_jax.mechanism import simulate, simulate_states
from rotflex_jax.models.model import Model

JOINT = {
    "hub_inertia": 0.0021,
    "arm_inertia": 0.0059,
    "stiffness": 1.61,
    "hub_damping": 0.01,
    "joint_damping": 0.002,
}


def by_hand() -> tuple[np.ndarray, np.ndarray]:
    """The textbook's equations, solved for the accelerations by hand."""
    Jh, Ja, K, Bh, Bj = JOINT.values()
    k = 0.00767 * 70 / 2.6  # torque per volt [N m/V]
    D = k * 0.00767 * 70 + Bh
    A = np.zeros((4, 4))
    A[0, 2] = A[1, 3] = 1.0
    A[2] = [0, K / Jh, -D / Jh, Bj / Jh]
    A[3] = [0, -K * (Jh + Ja) / (Jh * Ja), D / Jh, -Bj * (Jh + Ja) / (Jh * Ja)]
    return A, np.array([[0], [0], [k / Jh], [-k / Jh]])


def test_linear_joint_is_that_of_the_textbook():
    linear = state_space(Model(paper(**JOINT)))
    A, B = by_hand()
    np.testing.assert_allclose(linear.A, A, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(linear.B, B, rtol=1e-12)
    np.testing.assert_array_equal(linear.C, np.eye(4)[:2])
    assert not linear.D.any() and not linear.dropped
    assert linear.states == ("theta", "alpha", "d(theta)/dt", "d(alpha)/dt")
    discrete = scipy.signal.cont2discrete((A, B, linear.C, linear.D), 0.002)
    ours = linear.discretise(0.002)
    np.testing.assert_allclose(ours.A, discrete[0], rtol=1e-11, atol=1e-14)
    np.testing.assert_allclose(ours.B, discrete[1], rtol=1e-11)


def test_small_motion_about_an_operating_point_is_that_of_the_simulator():
    Ts, N = 0.001, 400
    m = paper(**JOINT) + CubicSpring("joint", stiffness=40.0) + Gravity("arm", sine=0.3, cosine=0.1)
    m = m + SecondMode("arm", inertia=1e-3) + SensorGain("alpha", error=0.05)
    # The operating point is the state of rest with a constant voltage.
    rest = simulate_states(m, np.full(20_000, 0.4), Ts)[-1]
    assert abs(rest[1]) > 0.02 and np.abs(rest[2:4]).max() < 1e-6
    linear = state_space(Model(m), Ts, positions=rest[:2], speeds=rest[2:4], voltage=0.4)
    wiggle = 1e-4 * np.sin(np.arange(N) * 0.05)
    truth = simulate(m, 0.4 + wiggle, Ts, x0=rest) - simulate(m, np.full(N, 0.4), Ts, x0=rest)
    system = scipy.signal.StateSpace(linear.A, linear.B, linear.C, linear.D, dt=Ts)
    expected = scipy.signal.dlsim(system, wiggle)[1]
    assert np.abs(truth[:, 1]).max() > 1e-6
    np.testing.assert_allclose(truth, expected, atol=2e-4 * np.abs(truth).max())
    away = state_space(Model(m), Ts)
    assert np.abs(away.A - linear.A).max() > 1e-3  # the matrix depends on the point


def test_memory_has_its_slope_and_friction_is_named():
    m = paper(**JOINT) + Coulomb("hub", level=0.02) + Dahl("joint", level=0.02, presliding=0.004) + Delay()
    linear = state_space(Model(m))
    assert linear.states[-1] == "joint.dahl[0]"
    # At rest, dz/dt = speed / presliding and tau = -level z.
    np.testing.assert_allclose(linear.A[4], [0, 0, 0, 1 / 0.004, 0])
    ratio = linear.A[2:4, 4] / by_hand()[0][2:4, 1]
    np.testing.assert_allclose(ratio, 0.02 / 1.61, rtol=1e-12)
    assert [d.split(" at ")[0] for d in linear.dropped] == [
        "Coulomb friction",
        "input delay",
    ]


def test_goal_of_a_servo_is_no_voltage():
    assert state_space(xl330_pendulum()).inputs == ("input",)
    assert state_space(paper()).inputs == ("voltage",)


def test_a_memory_about_a_motion_has_its_steady_value():
    """While the joint slides at w, z = 1, where dz/dt = (speed - |speed| z) / presliding has these slopes."""
    m = paper(**JOINT) + Dahl("joint", level=0.02, presliding=0.004)
    linear = state_space(Model(m), speeds=(0.0, 3.0))
    np.testing.assert_allclose(linear.A[4], [0, 0, 0, 0, -3.0 / 0.004], atol=1e-9)


def test_quadratic_drag_about_a_speed():
    m = paper(**JOINT) + QuadraticDrag("hub", coefficient=0.003)
    at_rest, turning = (state_space(Model(m), speeds=(w, 0.0)).A[2, 2] for w in (0.0, 5.0))
    assert turning - at_rest == pytest.approx(-2 * 0.003 * 5.0 / JOINT["hub_inertia"])


def test_python_control_takes_it():
    control = pytest.importorskip("control")
    model = Model(paper(**JOINT))
    system = state_space(model).to_control()
    assert system.state_labels == list(state_space(model).states) and system.output_labels == [
        "theta",
        "alpha",
    ]
    sampled, ours = control.c2d(system, 0.002, "zoh"), state_space(model, 0.002).to_control()
    assert ours.dt == 0.002
    np.testing.assert_allclose(sampled.A, ours.A, rtol=1e-10, atol=1e-13)
    # Its poles are those of the joint: one at zero, two of the spring, one of the motor.
    assert np.min(np.abs(system.poles())) < 1e-9 and np.sum(np.abs(system.poles().imag) > 10) == 2


def test_refuses_a_point_of_another_size():
    with pytest.raises(InputError, match=r"`positions` must be 2 numbers, .* of shape \(3,\)"):
        state_space(Model(paper()), positions=(0, 0, 0))
    with pytest.raises(InputError, match="is in discrete time already"):
        state_space(Model(paper()), 0.01).discretise(0.01)
    for Ts in ("0.01", None, True):
        with pytest.raises(InputError, match="`Ts` must be a finite number above 0"):
            state_space(Model(paper())).discretise(Ts)


@pytest.mark.parametrize("name", sorted(CATALOG))
def test_every_law_is_good_latex(name):
    """The parser of matplotlib accepts it, and it contains every parameter of the equation."""
    from matplotlib.mathtext import MathTextParser

    written = equation(CATALOG[name])
    size = MathTextParser("path").parse(f"${written}$")
    assert size.width > 20
    # A parameter may be missing only if the text of the equation leaves it out too.
    for parameter in CATALOG[name].declared():
        if re.search(rf"\b{parameter}\b", CATALOG[name].equation):
            assert rf"\mathit{{{parameter.replace('_', chr(92) + ' ')}}}" in written
    assert "**" not in written and "<=" not in written and "_" not in written.replace("y_0", "")


def test_laws_read_as_a_person_would_write_them():
    assert equation(CATALOG["quadratic_drag"]) == (
        r"\tau = -\mathit{coefficient} \cdot \dot{\varphi} \cdot |\dot{\varphi}|"
    )
    assert equation(CATALOG["coulomb"]) == (
        r"\tau = -\mathit{level} \cdot \operatorname{sign} (\dot{\varphi}), \quad "
        r"\text{ holds while } |\tau| \leq \mathit{level}"
    )


def test_matrices_and_numbers_are_in_text_and_latex():
    model = Model(paper(**JOINT) + Coulomb("hub", level=0.0312) + Delay(time=0.004))
    plain, tex = text(model), latex(model)
    assert re.search(r"M = \[ +0\.008 +0\.0059 \]", plain)
    assert "level = 0.0312 N m" in plain and "time = 0.004 s" in plain
    assert r"8 \times 10^{-3} & 5.9 \times 10^{-3}" in tex
    assert r"$0.0312$ $\mathrm{N\,m}$" in tex and r"gear\_ratio" in tex
    for opening, closing in (("{", "}"), (r"\[", r"\]"), (r"\begin", r"\end")):
        assert tex.count(opening) == tex.count(closing)
    assert plain.index("input delay") < plain.index("Coulomb")  # in the order of the signal


def test_what_is_switched_off_is_not_written():
    model = Model(paper() + Coulomb("hub"), gates=(*[1.0] * 6, 0.0))
    assert "Coulomb" not in text(model) and "Coulomb" not in latex(model)
    assert state_space(model).dropped == ()
