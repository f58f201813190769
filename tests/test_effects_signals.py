"""Measured disturbances: signals beside the input that drive a machine, from integration to search."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiler_options import ROUGH
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete

import rotflex_jax as rf
from rotflex_jax.effects import (
    Coulomb,
    CubicSpring,
    Delay,
    Gravity,
    MeasuredDisturbance,
    SensorGain,
    Viscous,
)
from rotflex_jax.errors import InputError
from rotflex_jax.experiment.rig import SimulatedRig
from rotflex_jax.experiment.standard_inputs import Limits
from rotflex_jax.export import to_c
from rotflex_jax.fit.identifiable import _other_inputs
from rotflex_jax.mechanism import Exponential, Mechanism, SmoothRK4, simulate
from rotflex_jax.mechanism.sensitivities import (
    RecordingSamples,
    RunParameters,
    TangentDirections,
    outputs_with_sensitivities,
)
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import double_precision

BASE = "acceleration of the base [rad/s^2]"
OTHER = "current of motor 2 [A]"
TS = 0.004


def coloured(samples: int, size: float, seed: int, width: int = 15) -> np.ndarray:
    """Low-pass noise with a standard deviation of `size`."""
    x = np.convolve(np.random.default_rng(seed).normal(size=samples + width), np.hanning(width), "same")
    return size * x[:samples] / np.std(x)


def moving_base(u: np.ndarray, a: np.ndarray, friction: float = 0.0) -> np.ndarray:
    """Outputs of a flexible joint on a base that turns with the acceleration `a`, by scipy's integrator.

    The coordinates differ from those of the package: `phi` of the hub and `psi` of the arm are absolute, the
    base turns by `b`, and torques between the parts depend on differences. Inputs are held over each sample.
    """
    Jh, Ja, k, d, dh, gain = 0.002, 0.006, 1.6, 0.004, 0.02, 0.05
    y, x = np.zeros((len(u), 2)), np.zeros(6)  # phi, psi, b and their speeds
    for i in range(len(u)):
        y[i] = x[0] - x[2], x[1] - x[0]

        def slope(_: float, s: np.ndarray, i: int = i) -> list[float]:
            spring = k * (s[1] - s[0]) + d * (s[4] - s[3])
            speed = s[3] - s[5]
            hub = gain * u[i] - dh * speed - friction * np.tanh(speed / 1e-3)
            return [s[3], s[4], s[5], (hub + spring) / Jh, -spring / Ja, a[i]]

        x = solve_ivp(slope, (0, TS), x, rtol=1e-9, atol=1e-11, max_step=TS / 4).y[:, -1]
    return y


def joint(*effects: object) -> Mechanism:
    """The joint of `moving_base` with the base at rest."""
    motor = rf.effects.Motor(at="hub", torque_constant=0.05, back_emf=0.0, resistance=1.0, gear_ratio=1.0)
    plain = rf.joints.flexible_joint(
        hub_inertia=0.002,
        arm_inertia=0.006,
        stiffness=1.6,
        joint_damping=0.004,
        hub_damping=0.02,
        motor=motor,
    )
    return dataclasses.replace(plain, effects=(*plain.effects, *effects))


def on_moving_base(hub: float = -0.002, arm: float = -0.006) -> tuple[MeasuredDisturbance, ...]:
    return tuple(
        MeasuredDisturbance(at=f"{port}: {BASE}", gain=gain) for port, gain in (("hub", hub), ("arm", arm))
    )


def test_a_joint_on_a_moving_base_is_one_with_a_disturbance_at_each_inertia():
    u, a = coloured(300, 3.0, 1), coloured(300, 20.0, 2)
    y = simulate(joint(*on_moving_base()), np.column_stack([u, a]), TS)
    np.testing.assert_allclose(y, moving_base(u, a), atol=3e-8)
    assert np.max(np.abs(simulate(joint(), u, TS) - y)) > 0.05


@pytest.mark.parametrize(
    "solver", [Exponential(), Exponential(order=4), Exponential(substeps=3), SmoothRK4(substeps=4)]
)
def test_every_rule_holds_the_signal_as_it_holds_the_input(solver):
    """Reference for a linear machine: scipy's zero-order hold with two inputs."""
    m = joint(MeasuredDisturbance(at=f"joint: {OTHER}", gain=0.3))
    M, D, K = np.array([[0.008, 0.006], [0.006, 0.006]]), np.diag([0.02, 0.004]), np.diag([0.0, 1.6])
    inverse, zero, one = np.linalg.inv(M), np.zeros((2, 2)), np.eye(2)
    A = np.block([[zero, one], [-inverse @ K, -inverse @ D]])
    B = np.vstack([zero, inverse @ np.array([[0.05, 0.0], [0.0, 0.3]])])
    E, F, *_ = cont2discrete((A, B, np.eye(4), np.zeros((4, 2))), TS, "zoh")
    w, x, expected = np.column_stack([coloured(400, 3.0, 3), coloured(400, 0.1, 4)]), np.zeros(4), []
    for here in w:
        expected.append(x[:2])
        x = E @ x + F @ here
    np.testing.assert_allclose(simulate(m, w, TS, solver=solver), expected, atol=2e-7)


def test_friction_holds_against_a_signal():
    """The hub rests while the torque of the signal is below the level of friction, and moves above it."""
    m = joint(MeasuredDisturbance(at=f"hub: {OTHER}", gain=1.0), Coulomb(at="hub", level=0.05))
    w = np.zeros((500, 2))
    w[:, 1] = 0.049 * np.sin(np.arange(500) / 20)
    assert np.max(np.abs(simulate(m, w, TS)[:, 0])) < 1e-12
    w[:, 1] *= 1.2
    assert np.max(np.abs(simulate(m, w, TS)[:, 0])) > 1e-3


@pytest.mark.parametrize("solver", [Exponential(), Exponential(substeps=2, between="smooth"), SmoothRK4()])
def test_slopes_equal_central_differences(solver):
    m = joint(*on_moving_base(), CubicSpring(at="joint", stiffness=20.0), Delay(time=0.006))
    structure, values = m.structure, m.values
    w = np.column_stack([coloured(120, 3.0, 6), coloured(120, 20.0, 7)])

    def run(values):
        mechanism = m.with_values(values)
        return simulate(mechanism, w, TS, x0=[0.1, 0.02, 0.5, -0.3], solver=solver)

    with double_precision():
        parameters = RunParameters(
            jnp.asarray(values), jnp.ones(len(m.effects)), jnp.asarray([0.1, 0.02, 0.5, -0.3]), None
        )
        P = len(values)
        ways = TangentDirections(jnp.eye(P), jnp.zeros((P, len(m.effects))), jnp.zeros((P, 4)))
        samples = RecordingSamples(jnp.asarray(w), jnp.zeros((120, 2)), jnp.ones(120), jnp.asarray(TS))
        slopes = jax.jit(outputs_with_sensitivities, static_argnums=(0, 1), compiler_options=ROUGH)
        y, J = slopes(structure, solver, parameters, ways, samples)
    np.testing.assert_allclose(y, run(values), atol=1e-12)
    for name in m.free_names:
        i = m.parameter_names.index(name)
        h = 1e-5 * max(abs(values[i]), 1e-3)
        step = h * np.eye(P)[i]
        expected = (run(values + step) - run(values - step)) / (2 * h)
        np.testing.assert_allclose(
            J[..., i], expected, atol=1e-5 * np.abs(expected).max() + 1e-9, err_msg=name
        )


def test_two_signals_at_one_port_are_two_effects():
    both = joint(
        MeasuredDisturbance(at=f"arm: {BASE}", gain=-0.006),
        MeasuredDisturbance(at=f"arm: {OTHER}", gain=0.02),
    )
    assert both.signals == (BASE, OTHER)
    w = np.column_stack([coloured(100, s, k) for k, s in enumerate((3.0, 20.0, 1.0))])
    each = [simulate(joint(e), w[:, [0, c]], TS) for c, e in ((1, both.effects[-2]), (2, both.effects[-1]))]
    alone = simulate(joint(), w[:, 0], TS)
    np.testing.assert_allclose(simulate(both, w, TS), each[0] + each[1] - alone, atol=1e-12)


@pytest.mark.parametrize(
    ("signal", "name", "per"),
    [
        (BASE, "acceleration of the base", "rad/s^2"),
        (OTHER, "current of motor 2", "A"),
        ("torque of motor 2 (N m)", "torque of motor 2", "N m"),
        ("noise [V/Hz^0.5]", "noise", "V/Hz^0.5"),
        ("log[0]", "log[0]", ""),
    ],
)
def test_the_gain_has_the_unit_of_its_signal_on_any_machine(signal, name, per):
    divided = "" if not per else f"/{per}" if per == "A" else f"/({per})"
    for machine, port, unit in ((joint(), "arm", "N m"), (rf.joints.emps(), "axis", "N")):
        e = MeasuredDisturbance(at=f"{port}: {signal}", gain=0.1)
        assert (machine + e).parameter_specifications[-1].unit == unit + divided
        size = f"0.1 {unit} per {per}" if per else f"0.1 {unit}"
        assert machine.sentence(e) == f"the {name} acts at the {port} ({size})"


def spun_base(N: int = 100, seed: int = 15) -> Recording:
    """A joint with dry friction on a moving base, with noise: scipy's run at 250 Hz."""
    u, a = coloured(N, 3.0, seed, 40), coloured(N, 25.0, seed + 1, 40)
    y = moving_base(u, a, friction=0.02) + np.random.default_rng(seed + 2).normal(scale=2e-4, size=(N, 2))
    return Recording(u=u, y=y, Ts=TS, signals={BASE: a})


@pytest.fixture(scope="module")
def measured() -> Recording:
    """A recording of 6 s on the moving base."""
    return spun_base(1500, 11)


def test_a_fit_finds_the_inertias_of_the_parts(measured):
    start = joint(*on_moving_base(0.0, 0.0), Coulomb(at="hub", level=0.005)).trust("arm.inertia.inertia")
    fit = rf.fit(start, measured)
    assert fit.status == "converged"
    for name, true in ((f"hub: {BASE}", -0.002), (f"arm: {BASE}", -0.006)):
        e = fit[f"{name}.measured_disturbance.gain"]
        assert abs(e.value - true) < max(3 * e.std, 0.02 * abs(true)), e
    assert np.max(np.std(fit.model.simulate(measured) - measured.y, axis=0)) < 4e-4


def test_a_fit_needs_the_signal_in_every_recording(measured):
    model = joint(*on_moving_base())
    with pytest.raises(
        InputError, match=r"driven by the signal 'acceleration of the base .* are none; add it"
    ):
        rf.fit(model, dataclasses.replace(measured, signals={}))
    with pytest.raises(InputError, match=r"the shape \(1500,\); give 2 columns"):
        simulate(model, measured.u, TS)


CANDIDATES = [
    (MeasuredDisturbance, f"arm: {BASE}"),
    (MeasuredDisturbance, f"joint: {BASE}"),
    (Viscous, "arm"),
    (CubicSpring, "joint"),
    (Gravity, "arm"),
    (SensorGain, "alpha"),
]


def test_a_search_names_the_signal_that_acts_and_no_other_one(measured, request):
    """The moving base is found if it acts; the same signal is not added to data of a base at rest."""
    model = joint(Coulomb(at="hub", level=0.01)).trust("arm.inertia.inertia")
    train, validation = measured.split(0.6)
    found = rf.discover(model, train, validation, candidates=CANDIDATES, rounds=1)
    assert [(r.effect, r.port) for r in found.rounds] == [("measured_disturbance", f"arm: {BASE}")]
    assert found.model.mechanism.signals == (BASE,)
    request.getfixturevalue("without_final_fit")
    whole = moving_base(measured.u, np.zeros(measured.N), friction=0.02)
    still = dataclasses.replace(
        measured, y=whole + np.random.default_rng(14).normal(scale=2e-4, size=whole.shape)
    )
    nothing = rf.discover(model, *still.split(0.6), candidates=CANDIDATES, rounds=1)
    assert not nothing.rounds
    assert nothing.model.mechanism.signals == ()


def test_recordings_with_a_say_decide_which_signals_are_tried(measured):
    model = joint(Coulomb(at="hub", level=0.02))
    train, validation = measured.split(0.6)
    with pytest.raises(InputError, match=r"have the signal 'acceleration of the base .* to test lacks it"):
        rf.discover(model, train, validation, test=spun_base().with_signals({}), candidates=CANDIDATES)
    found = rf.discover(
        model, train, dataclasses.replace(validation, signals={}), candidates=CANDIDATES[2:3], rounds=0
    )
    assert any("Not all recordings have the signal 'acceleration of the base" in note for note in found.notes)
    with pytest.raises(InputError, match="the recordings have no signal in common"):
        rf.discover(model, train, dataclasses.replace(validation, signals={}), candidates=CANDIDATES)


def test_other_inputs_of_a_machine_with_signals_leave_these_as_they_are():
    """Other inputs are tried; signals keep their values."""
    model = rf.Model(joint(*on_moving_base()))
    short = spun_base(60)
    quiet = dataclasses.replace(short, u=1e-2 * short.u)
    found = rf.identifiable(model, quiet)
    assert not found.practical
    others = _other_inputs(np.column_stack([quiet.u, quiet.signals[BASE]]), TS)
    assert set(found.inputs_here) <= set(others)
    for u in others.values():
        np.testing.assert_array_equal(u[:, 1], quiet.signals[BASE])
        assert np.abs(u[:, 0]).max() > np.abs(quiet.u).max() / 2


def test_what_knows_the_input_alone_says_so():
    model = joint(*on_moving_base())
    for ask in (
        lambda: to_c(model, TS),
        lambda: SimulatedRig(model, Limits(voltage=5.0), TS),
        lambda: rf.next_experiment(model, "delay@input", "lag@input", limits=Limits(voltage=5.0), Ts=TS),
    ):
        with pytest.raises(InputError, match=r"driven by 'acceleration of the base .* has the input alone"):
            ask()


def test_a_place_names_a_port_and_a_signal():
    with pytest.raises(InputError, match="needs a port and the name of a signal"):
        MeasuredDisturbance(at="arm")
    with pytest.raises(InputError, match=f"'elbow: {OTHER.split('[')[0]}"):
        joint(MeasuredDisturbance(at=f"elbow: {OTHER}"))


def test_a_model_comes_back_from_its_file_with_the_order_of_its_signals(tmp_path):
    plain = dataclasses.replace(joint(), signals=(OTHER, BASE))
    model = Model(plain + MeasuredDisturbance(at=f"arm: {BASE}") + MeasuredDisturbance(at=f"hub: {OTHER}"))
    back = Model.load(model.save(tmp_path / "model.json"))
    assert back == model
    assert back.mechanism.signals == (OTHER, BASE)


def test_a_signal_goes_with_the_last_effect_that_takes_it():
    both = joint(*on_moving_base())
    one = both.without("measured_disturbance", f"arm: {BASE}")
    assert one.signals == (BASE,)
    assert one.without("measured_disturbance", f"hub: {BASE}") == joint()


def test_a_fit_does_not_take_a_signal_for_a_wrong_sign():
    """The torque of the base is larger than that of the input and has the opposite sign."""
    u = coloured(1500, 0.2, 11, 300)
    w = np.column_stack([u, 50 * u])
    model = joint(*on_moving_base())
    y = simulate(model, w, TS) + np.random.default_rng(0).normal(scale=1e-5, size=(1500, 2))
    recording = Recording(u=u, y=y, Ts=TS, signals={BASE: w[:, 1]})
    assert rf.fit(model, recording).status == "converged"


def test_stages_of_the_serial_link_in_one():
    """With link 1 fixed, link 2 is the joint of stage 2; otherwise the links move each other."""
    both = rf.joints.two_stage_link()
    assert both.signals == (OTHER,)
    held = both.with_values({"joint1.spring.stiffness": 1e7, "hub1.inertia.inertia": 1e4})
    w = np.column_stack([np.zeros(800), coloured(800, 0.5, 5)])
    alone = simulate(rf.joints.two_dof_link(2), w[:, 1], 0.002)
    np.testing.assert_allclose(simulate(held, w, 0.002)[:, 2:], alone, atol=2e-4 * np.ptp(alone))
    assert np.ptp(simulate(both, w, 0.002)[:, 1]) > 1e-4
