"""Structural identifiability against known results, and practical identifiability from a recording."""

import dataclasses
import importlib
import json
from fractions import Fraction

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax import joints
from rotflex_jax.effects import Coulomb, CurrentDrive, Inertia, LoadFriction, Spring, Viscous
from rotflex_jax.fit.identifiable import Identifiability, _information, _other_inputs, identifiable
from rotflex_jax.fit.structural_identifiability import Dual, impulse_slopes, null_space, random_values
from rotflex_jax.mechanism import Mechanism, linearise

JOINT = joints.paper()
ARM = "arm.inertia.inertia"


def two_masses(*outputs: tuple[str, str], free_gain: bool = False) -> Mechanism:
    """Motor, elastic shaft, load; damping in the shaft and at both bearings."""
    m = Mechanism(
        ("motor angle", "load angle"),
        {"motor": (1, 0), "shaft": (-1, 1), "load": (0, 1)},
        [
            Inertia("motor", inertia=0.01),
            Inertia("load", inertia=0.02),
            Spring("shaft", stiffness=5.0),
            Viscous("shaft", coefficient=0.01),
            Viscous("motor", coefficient=0.02),
            Viscous("load", coefficient=0.03),
            CurrentDrive("motor", gain=1.0),
        ],
        {f"channel {k}": output for k, output in enumerate(outputs)},
    )
    return m if free_gain else m.trust("motor.current_drive.gain")


def test_the_flexible_joint_has_one_unknown_scale():
    """Voltage and angles determine torques up to one common factor.

    M q'' + D q' + K q = B v is the same equation when all of M, D, K and B are multiplied by one factor.
    """
    free = identifiable(JOINT.release(ARM))
    assert free.exact and free.rank == len(free.free) - 1
    (unknown,) = free.unknown
    assert unknown.kind == "powers" and set(unknown.shares) == set(free.free)
    assert all(share == 1.0 for share in unknown.shares.values())
    assert "one common factor is open" in unknown.sentence
    assert free.trust == tuple((name,) for name in free.free)
    assert free.sensors == {} and "No further position or speed sensor would help" in str(free)
    assert identifiable(JOINT).structural


def test_the_scale_is_open_with_friction_too():
    """The same machine with dry friction, by the rank of sensitivities instead of exact arithmetic."""
    found = identifiable((JOINT + Coulomb("hub")).release(ARM))
    assert not found.exact and len(found.unknown) == 1
    np.testing.assert_allclose(list(found.unknown[0].shares.values()), 1.0, atol=1e-5)
    assert set(found.unknown[0].shares) == set(found.free)
    assert found.unknown[0].kind == "powers"
    assert identifiable(JOINT + Coulomb("hub")).structural


def test_two_masses_are_known_from_the_motor_alone():
    """Motor torque and motor speed determine both inertias, the shaft and all dampers.

    The transfer function of order 3 has three coefficients in the numerator and three in the denominator: six
    coefficients for six parameters, locally one to one. Source: S. Villwock and M. Pacas, IEEE Trans. Ind.
    Electron. 55, 2008 (identification of a two-mass drive from motor-side signals).
    """
    motor_speed = ("motor", "speed")
    assert identifiable(two_masses(motor_speed)).structural
    gain = identifiable(two_masses(motor_speed, free_gain=True))
    assert gain.rank == 6 and len(gain.free) == 7 and len(gain.unknown) == 1
    # To the speed of the load the numerator has two coefficients: five in all for six parameters.
    load = identifiable(two_masses(("load", "speed")))
    assert load.rank == 5 and "the speed of motor" in load.sensors
    assert load.sensors["the speed of motor"] == 0
    assert "Or measure" in str(load)


def test_a_resistance_hides_behind_the_torque_constant():
    """Only torque constant over resistance is determined; back-EMF and hub friction are one damping."""
    found = identifiable(JOINT.release("hub.motor.resistance"))
    (one,) = found.unknown
    assert one.shares == {"hub.motor.torque_constant": 1.0, "hub.motor.resistance": 1.0}
    assert one.kind == "powers" and "only their ratio is known" in one.sentence
    damping = identifiable(JOINT.release("hub.motor.back_emf"))
    (one,) = damping.unknown
    assert set(one.parameters) == {"hub.motor.back_emf", "hub.viscous.coefficient"}
    several = identifiable(JOINT.release("hub.motor.back_emf", "hub.motor.resistance", ARM))
    assert len(several.unknown) == 3 and all(len(names) == 3 for names in several.trust)
    for names in several.trust[:3]:  # trusting any of the sets is enough
        assert identifiable(
            JOINT.release("hub.motor.back_emf", "hub.motor.resistance", ARM).trust(*names)
        ).structural


def test_two_dampers_at_one_port_are_a_sum():
    m = Mechanism(
        ("x",),
        {"p": (1,), "q": (1,)},
        [
            Inertia("p", inertia=0.01),
            CurrentDrive("p"),
            Viscous("p", coefficient=0.1),
            Viscous("q", coefficient=0.2),
        ],
        {"x": "p"},
        trusted=("p.current_drive.gain",),
    )
    (one,) = identifiable(m).unknown
    assert one.kind == "sum" and "only a sum" in one.sentence


def test_what_has_no_effect_is_named():
    """A spring at a coordinate that nothing drives and no sensor measures."""
    m = Mechanism(
        ("x", "z"),
        {"p": (1, 0), "away": (0, 1)},
        [
            Inertia("p", inertia=0.01),
            Inertia("away", inertia=0.01),
            CurrentDrive("p"),
            Spring("away", stiffness=1.0),
        ],
        {"x": "p"},
        trusted=("p.current_drive.gain", "away.inertia.inertia"),
    )
    (one,) = identifiable(m).unknown
    assert one.sentence == "away.spring.stiffness has no effect on what is measured"


def test_exact_impulse_slopes_against_difference_quotients():
    m = JOINT.release(ARM).with_values({"hub.viscous.coefficient": 0.01, "joint.viscous.coefficient": 0.02})
    free = m.free_names
    values = random_values(m, free, seed=3)
    rows = [(1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0)]
    exact = np.array(impulse_slopes(m, values, free, rows), float)

    def impulses(at: dict[str, Fraction]) -> np.ndarray:
        ss = linearise(m.with_values({n: float(v) for n, v in at.items()}))
        x, found = ss.B, []
        for _ in range(2 * len(ss.A)):
            found += [np.array(row) @ x for row in rows]
            x = ss.A @ x
        return np.array(found)

    for k, name in enumerate(free):
        step = Fraction(1, 10**5)
        high, low = (impulses({**values, name: values[name] * (1 + s * step)}) for s in (1, -1))
        size = np.abs(exact[:, k]).max()
        np.testing.assert_allclose((high - low) / (2 * float(step)), exact[:, k], rtol=1e-5, atol=1e-6 * size)


def test_arithmetic_of_duals_and_null_space():
    x = Dual(Fraction(2), (Fraction(1), Fraction(0)))
    y = Dual(Fraction(3), (Fraction(0), Fraction(1)))
    found = (x - 1) ** -2 * y + (5 - x) / y - x
    assert found.value == 2
    assert found.slopes == (-6 - Fraction(1, 3) - 1, 1 - Fraction(1, 3))
    rows = [[Fraction(v) for v in row] for row in ((1, 2, 3), (2, 4, 6))]
    for vector in null_space(rows, 3):
        assert all(sum(a * b for a, b in zip(row, vector, strict=True)) == 0 for row in rows)
    assert len(null_space(rows, 3)) == 2


def pendulum() -> tuple[Mechanism, rf.Recording]:
    """A servo that lifts one known mass slowly, with friction that depends on the load."""
    m = joints.xl330_pendulum() + LoadFriction("hub")
    u = 0.5 * np.sin(2 * np.pi * 0.5 * 0.01 * np.arange(600))
    y = rf.simulate(m, u, 0.01) + 1e-3 * np.random.default_rng(0).normal(size=(600, 1))
    return m, rf.Recording(u=u, y=y, Ts=0.01, channels=("theta",), input_unit="rad")


def test_one_mass_does_not_say_how_friction_depends_on_the_load():
    """The shares are structurally identifiable, but one slow run with one mass determines them badly.

    Source: M. Duclusaud, G. Passault, V. Padois and O. Ly, arXiv 2410.08650, 2024, who record several masses
    and lengths for the friction that depends on the load.
    """
    found = identifiable(*pendulum())
    assert found.structural and found.practical is False
    (bad,) = found.badly_known
    assert set(bad.parameters) == {"hub.load_friction.driving", "hub.load_friction.driven"}
    assert bad.std > 0.2 and "only" in bad.sentence
    best = min(found.trust_here, key=found.trust_here.__getitem__)
    assert best.startswith("hub.load_friction.") and found.trust_here[best] < bad.std / 3


def test_standard_deviations_of_a_recording_are_those_of_least_squares():
    """Reference: the standard deviations of a fit to the same recording with white noise, as shares."""
    u = rf.data.excitation.noise(600, 0.004, seed=1, rms=2.0)
    m = JOINT.with_values({"hub.viscous.coefficient": 0.01, "joint.viscous.coefficient": 0.004})
    y = rf.simulate(m, u, 0.004) + 1e-3 * np.random.default_rng(1).normal(size=(600, 2))
    rec = rf.Recording(u=u, y=y, Ts=0.004)
    fit = rf.fit(m, rec)
    found, of_fit = identifiable(fit.model, rec), identifiable(fit, rec)
    for k, name in enumerate(fit.free_names):
        std = np.sqrt(fit.covariance[k, k]) / abs(fit[name].value)
        assert of_fit.std[name] == pytest.approx(std, rel=1e-6)
        assert found.std[name] == pytest.approx(std, rel=0.5)  # without the part by correlation in time
    assert found.structural


def test_unknown_first_states_take_their_part_of_the_information():
    """Reference: the covariance of the parameters is their block of the covariance of all coordinates."""
    J, noise = np.random.default_rng(3).normal(size=(40, 2, 5)), np.array([0.5, 2.0])
    rows = np.concatenate([J[:, 0] / 0.5, J[:, 1] / 2.0])
    of_all = np.linalg.inv(rows.T @ rows)
    np.testing.assert_allclose(np.linalg.inv(_information(J, noise, 3)), of_all[:3, :3], rtol=1e-9)


def test_what_would_help_is_what_it_brings(monkeypatch):
    """Reference for a further sensor: the machine that has it, with the relative noise of the best sensor.

    With three times the input from rest, all slopes of a linear machine are three times as large.
    """
    module = importlib.import_module("rotflex_jax.fit.identifiable")
    with_arm = dataclasses.replace(JOINT, outputs={"theta": "hub", "alpha": "joint", "arm": "arm"})
    u = rf.data.excitation.noise(600, 0.004, seed=2, rms=2.0)
    y = rf.simulate(with_arm, u, 0.004)
    y = y + np.std(y, axis=0) * [1.0, 0.1, 0.1] * np.random.default_rng(4).normal(size=y.shape)
    rec = rf.Recording(u=u, y=y, Ts=0.004, channels=with_arm.channels, units=("rad",) * 3)
    usual = identifiable(JOINT, rec)
    monkeypatch.setattr(module, "BADLY_KNOWN", 0.0)
    monkeypatch.setattr(module, "HELPS", 1e-9)
    every = identifiable(JOINT, rec)
    worst = every.badly_known[0].std
    reference = identifiable(with_arm, rec).badly_known[0].std
    assert every.sensors_here["the position of arm"] == pytest.approx(reference, rel=0.2)
    assert every.inputs_here["an input three times as large"] == pytest.approx(worst / 3, rel=0.05)
    for few, all_of_them in (
        (usual.trust_here, every.trust_here),
        (usual.sensors_here, every.sensors_here),
        (usual.inputs_here, every.inputs_here),
    ):
        assert few == {name: std for name, std in all_of_them.items() if std < worst / 3}
    # A fit whose standard deviations are twice as large: so is all that would be left with any help.
    fit = rf.fit(JOINT, rec)
    narrow, wide = (
        identifiable(dataclasses.replace(fit, covariance=k * fit.covariance), rec) for k in (1.0, 4.0)
    )
    for which in ("trust_here", "sensors_here", "inputs_here"):
        a, b = getattr(narrow, which), getattr(wide, which)
        assert a and b == pytest.approx({name: 2 * std for name, std in a.items()}, rel=1e-6)


def test_other_inputs_are_as_large_as_they_say():
    u = np.random.default_rng(5).normal(size=400)
    others = _other_inputs(u, 0.01)
    np.testing.assert_allclose(others["an input three times as large"], 3 * u)
    noise = others["noise of the same rms"]
    assert np.mean(noise**2) == pytest.approx(np.mean(u**2))
    slow = others["three slow swings of the same peak"]
    assert np.max(np.abs(slow)) == pytest.approx(np.max(np.abs(u)), rel=1e-3)
    assert int(np.argmax(np.abs(np.fft.rfft(slow)))) == 3


def test_it_is_shown_and_written():
    found = identifiable(JOINT.release(ARM))
    assert json.loads(json.dumps(found.to_dict()))["rank"] == 5
    assert "one common factor" in found._repr_html_()
    assert isinstance(rf.identifiable(JOINT), Identifiability)
    with pytest.raises(rf.InputError, match="All parameters are trusted"):
        identifiable(JOINT.trust(*JOINT.parameter_names))


def test_a_motor_side_sensor_alone_knows_the_paper_joint():
    """The angle of the hub alone determines all parameters, as for the two-mass drive."""
    hub = dataclasses.replace(JOINT, outputs={"theta": "hub"})
    assert identifiable(hub).structural
    deflection = dataclasses.replace(JOINT, outputs={"alpha": "joint"})
    found = identifiable(deflection)
    assert found.rank + len(found.unknown) == len(found.free)


def test_check_says_it_of_a_model_that_is_named(tmp_path, monkeypatch, capsys):
    from rotflex_jax.cli import app
    from rotflex_jax.data import save_csv
    from rotflex_jax.runtime import xla

    # Settings of the program for its own process must not affect other tests.
    monkeypatch.setattr(xla, "enable_fast_loops", lambda: True)
    monkeypatch.setattr(xla, "enable_compilation_cache", lambda: None)
    u = rf.data.excitation.noise(600, 0.004, seed=1, rms=2.0)
    rec = rf.Recording(u=u, y=rf.simulate(JOINT, u, 0.004) + 0.0, Ts=0.004)
    file = save_csv(rec, tmp_path / "run.csv")
    said = {}
    for options in ((), ("--joint", "paper")):
        with pytest.raises(SystemExit) as left:
            app.main(["check", str(file), *options])
        assert left.value.code == 0
        said[options] = capsys.readouterr().out
    assert "What can be known" not in said[()]
    assert "A perfect recording would determine all 5 free parameters" in said["--joint", "paper"]
    assert "This recording determines" in said["--joint", "paper"]
