"""Exported models against MuJoCo, a co-simulation master and BAM; certificates name what is left out."""

import io
import json
import math
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
import zipfile

import numpy as np
import pytest

from rotflex_jax import Mechanism, Recording
from rotflex_jax.effects import (
    Backlash,
    Coulomb,
    CoulombAsymmetric,
    CubicSpring,
    CurrentDrive,
    Delay,
    GearFriction,
    Gravity,
    Inertia,
    JointPlay,
    Lag,
    LoadFriction,
    LuGre,
    PositionServo,
    Saturation,
    SecondMode,
    SensorBias,
    Spring,
    Stribeck,
    Viscous,
    VoltageOffset,
)
from rotflex_jax.errors import InputError
from rotflex_jax.export import to_bam, to_fmu, to_mjcf, to_urdf
from rotflex_jax.export.certificate import Subject, standard_input
from rotflex_jax.export.fmu import platform_folder
from rotflex_jax.export.mjcf import run_in_mujoco
from rotflex_jax.joints import emps, paper, position_servo, single_inertia, xl330_pendulum
from rotflex_jax.mechanism import simulate
from rotflex_jax.models.model import Model

Ts = 0.002
U = standard_input(Ts, 2.0)[:1500]  # 3 s: motion, then a rest
NOISE = math.radians(360 / 4096) / math.sqrt(12)
"""Standard deviation of the rounding of an encoder of 4096 counts [rad]."""

JOINT = paper(hub_damping=0.01, joint_damping=0.003)
cc = shutil.which("cc")

SAID = {
    "viscous, spring, motor": JOINT,
    "Coulomb": JOINT + Coulomb("hub", level=0.03),
    "armature": single_inertia(0.002, damping=0.01) + Coulomb("hub", level=0.03),
    "inductance": paper(inductance=2e-4, back_emf=0.006, efficiency=0.8) + Coulomb("hub", level=0.03),
    "at the arm": JOINT + Viscous("arm", coefficient=0.01) + Coulomb("arm", level=0.01) + Spring("arm"),
    "two contacts": JOINT + Coulomb("hub", level=0.02) + Coulomb("joint", level=0.005),
    "two levels": JOINT + CoulombAsymmetric("hub", forward=0.03, backward=0.02),
    "offset": JOINT + VoltageOffset(offset=0.2),
    "lag": JOINT + Lag(time=0.006),
    "saturation": JOINT + Saturation(limit=1.0),
    "weight": JOINT + Gravity("hub", sine=0.01, cosine=0.03) + Gravity("arm", sine=0.05, cosine=-0.02),
    "combination": Mechanism(
        ["a", "b"],
        {"motor": (1, 0), "load": (0, 1), "belt": (-0.5, 1)},
        [
            Inertia("motor", inertia=0.001),
            Inertia("load", inertia=0.004),
            Inertia("belt", inertia=0.0005),
            CurrentDrive("motor", gain=0.05),
            Spring("belt", stiffness=2.0),
            Viscous("belt", coefficient=0.02),
            Coulomb("load", level=0.01),
            Viscous("motor", coefficient=0.01),
        ],
        {"a": "motor", "load speed": ("load", "speed"), "slip": "belt"},
    ),
}


def certified(mechanism, u=U, **options):
    pytest.importorskip("mujoco")
    return to_mjcf(mechanism, Ts, u=u, **options)


@pytest.mark.parametrize("name", SAID)
def test_mujoco_does_what_the_toolkit_does(name):
    """Differences are below the noise of an encoder; for a speed, below this noise divided by 5 ms."""
    certificate = certified(SAID[name]).certificate
    assert certificate.left_out == () == certificate.approximated and not certificate.not_simulated
    limits = [NOISE / (0.005 if unit == "rad/s" else 1.0) for unit in certificate.units]
    assert np.all(np.array(certificate.largest) < limits), str(certificate)
    assert np.all(np.array(certificate.spans) > 20 * np.array(limits))


def test_mujoco_begins_with_a_lag_in_its_steady_state():
    """An input that begins away from zero finds the lag where its first value has brought it."""
    certificate = certified(SAID["lag"], 1.0 + U[:500]).certificate
    assert np.all(np.array(certificate.largest) < NOISE), str(certificate)


def test_mujoco_has_the_servo_with_its_limit_and_its_weight():
    firmware = PositionServo(limit=0.3, derivative=0.03)
    servo = position_servo(0.0069, servo=firmware, weight=0.48) + Coulomb("hub", level=0.03)
    certificate = certified(servo, 0.4 * U).certificate
    assert certificate.left_out == () and certificate.largest[0] < NOISE
    unlimited = simulate(servo.with_values({"hub.position_servo.limit": 1.0}), 0.4 * U, Ts)
    assert np.abs(unlimited - simulate(servo, 0.4 * U, Ts)).max() > 50 * NOISE  # the limit acts
    weak = position_servo(0.0069, servo=PositionServo(dead_band=0.01, source_resistance=1.0), weight=0.48)
    told = "\n".join(certified(weak, 0.4 * U[:50]).certificate.left_out)
    assert "dead_band of 0.01 rad" in told and "source_resistance of 1 ohm" in told
    assert "derivative of 0.03 s/rad" in "\n".join(to_bam(servo, u=U[:50]).certificate.left_out)


def test_mujoco_has_the_motor_with_its_torque_and_its_time_constant():
    """Torque per volt and per speed at constant current, and inductance over resistance, are the motor's."""
    machine = paper(inductance=2e-3, back_emf=0.006, efficiency=0.8)
    (motor,) = ET.fromstring(certified(machine, U[:100]).content).iter("dcmotor")
    constant, resistance, inductance = (
        float(motor.get(k)) for k in ("motorconst", "resistance", "inductance")
    )
    of = {name.rpartition(".")[2]: v for name, v in machine.named_values.items() if "hub.motor" in name}
    torque = of["efficiency"] * of["torque_constant"] * of["gear_ratio"] / of["resistance"]
    assert constant / resistance == pytest.approx(torque)
    assert constant**2 / resistance == pytest.approx(torque * of["back_emf"] * of["gear_ratio"])
    assert inductance / resistance == pytest.approx(2e-3 / of["resistance"])


def test_mujoco_has_an_axis_that_slides():
    certificate = certified(emps() + Coulomb("axis", level=20.0)).certificate
    assert certificate.units == ("m",) and certificate.largest[0] < 2e-3 * certificate.spans[0]


def test_a_difference_shows_in_the_certificate():
    """With another friction or inertia in the file, the difference exceeds the noise."""
    text = certified(SAID["Coulomb"]).content
    own = simulate(SAID["Coulomb"], U, Ts)
    for old, new in (
        ('frictionloss="0.03"', 'frictionloss="0.031"'),
        ('armature="0.0021"', 'armature="0.0022"'),
    ):
        assert old in text
        assert np.abs(run_in_mujoco(text.replace(old, new), U, Ts) - own).max() > NOISE


def test_a_certificate_has_the_size_of_each_difference_and_of_the_motion():
    """The outputs of the other program are those of the toolkit, moved by known amounts."""
    u = -np.ones(200)  # a motion to one side of zero
    subject, own = Subject.of(JOINT, Ts, u), simulate(JOINT, u, Ts)
    k = np.arange(200)
    apart = np.column_stack([np.where(k == 7, -math.radians(3.0), 0.0), np.full(200, 1e-3)])
    found = subject.certificate("X", "Y", own + apart)
    assert found.largest == pytest.approx((math.radians(3.0), 1e-3), rel=1e-9)
    assert found.rms == pytest.approx((math.radians(3.0) / math.sqrt(200), 1e-3), rel=1e-9)
    assert found.spans == pytest.approx(tuple(own.max(axis=0) - own.min(axis=0)))
    assert "theta: largest difference 0.0524 rad = 3 deg, rms" in str(found)


@pytest.mark.parametrize(
    ("effect", "said", "at_least"),
    [
        (
            Stribeck("hub", excess=0.02),
            "friction at hub (stribeck): as Coulomb friction of 0.02",
            NOISE,
        ),
        (LuGre("hub"), "LuGre friction at hub (lugre): as Coulomb friction", NOISE),
        (JointPlay("joint"), "spring play at joint (joint_play)", NOISE),
        (Backlash("hub"), "(backlash)", 0.0),
        (CubicSpring("joint", stiffness=20.0), "cubic spring at joint (cubic_spring)", NOISE),
        (SecondMode("arm"), "(second_mode)", 0.0),
        (SensorBias("theta", bias=0.01), "sensor bias at the sensor theta (sensor_bias)", NOISE / 2),
        (Delay(time=0.01), "input delay on the voltage (delay)", NOISE),
    ],
    ids=lambda x: getattr(x, "name", ""),
)
def test_what_mujoco_cannot_say_is_named(effect, said, at_least):
    certificate = certified(JOINT + effect).certificate
    named = "\n".join((*certificate.left_out, *certificate.approximated))
    assert said in named and said in str(certificate)
    assert max(certificate.largest) >= at_least


@pytest.mark.parametrize("other", [Lag(), VoltageOffset(offset=0.2)], ids=["lag", "offset"])
def test_order_on_the_voltage_counts(other):
    """A limit after a lag or an offset is left out of the file; a limit before them is exported."""
    assert "saturation" in certified(JOINT + other + Saturation(limit=1.0), U[:500]).certificate.left_out[0]
    before = certified(JOINT + Saturation(limit=1.0) + other, U[:500]).certificate
    assert before.left_out == () and before.largest[0] < NOISE


def test_names_of_others_stay_names():
    evil = 'a" --> <b>&-- \x1b'
    machine = Mechanism(
        [evil], {"p<": (1,)}, [Inertia("p<"), CurrentDrive("p<"), Stribeck("p<")], {evil: "p<"}
    )
    exported = certified(machine, name=evil)
    assert certified(machine, name=evil).content == exported.content
    root = ET.fromstring(exported.content)
    joints = [e.get("name") for e in root.iter("joint")]
    assert joints == [r'a" --> <b>&-- \x1b'] and "\x1b" not in exported.content
    ET.fromstring(to_urdf(machine, Ts, name=evil, u=U).content)


def test_without_mujoco_the_certificate_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    for exported in (to_mjcf(JOINT, Ts), to_urdf(JOINT, Ts)):
        certificate = exported.certificate
        assert "the package mujoco, which is not installed" in certificate.not_simulated
        assert certificate.largest == () and "Not simulated" in exported.content
        ET.fromstring(exported.content)


def test_a_mujoco_that_does_not_know_an_element_is_named(monkeypatch):
    mujoco = pytest.importorskip("mujoco")

    def refuse(text: str) -> None:
        raise ValueError("unrecognized element\nline 3")

    monkeypatch.setattr(mujoco, "MjModel", type("Old", (), {"from_xml_string": staticmethod(refuse)}))
    told = to_mjcf(JOINT, Ts, u=U[:9]).certificate.not_simulated
    assert (
        told.startswith(f"MuJoCo {mujoco.__version__} does not read the file: unrecognized")
        and "\n" not in told
    )


def test_a_machine_that_neither_turns_nor_slides_is_refused():
    from rotflex_jax.joints import silverbox

    for export in (to_mjcf, to_urdf):
        with pytest.raises(InputError, match=r"moves in V, but .* joints that turn"):
            export(silverbox(), Ts)


def test_switched_off_effects_are_not_exported():
    model = Model(JOINT + Coulomb("hub", level=0.5), gates=(*[1.0] * 6, 0.0))
    assert certified(model).certificate.largest[0] < NOISE
    with pytest.raises(InputError, match="effects that are on or off"):
        to_mjcf(Model(JOINT, gates=(0.5,) * 6), Ts)


# -- URDF ----------------------------------------------------------------------------------------------


def test_urdf_turns_as_the_toolkit_under_the_efforts_of_the_motor():
    pytest.importorskip("mujoco")
    for machine in (SAID["armature"], emps() + Coulomb("axis", level=20.0)):
        certificate = to_urdf(machine, Ts, u=U).certificate
        assert len(certificate.left_out) == 1
        limit = NOISE if certificate.units == ("rad",) else 2e-3 * certificate.spans[0]
        assert certificate.largest[0] < limit


def test_urdf_names_what_it_lacks():
    pytest.importorskip("mujoco")
    exported = to_urdf(JOINT + Viscous("arm", coefficient=0.01) + Saturation(limit=1.5) + Lag(), Ts, u=U)
    told = str(exported.certificate)
    for words in (
        "spring at joint: 1.61 N m/rad",
        "0.2065 V input",
        "at arm, which is no joint",
        "limit of the input: 1.5 V",
        "input lag of 0.006 s",
    ):
        assert words in told
    root = ET.fromstring(exported.content)
    assert [j.get("type") for j in root.findall("joint")] == ["continuous", "continuous"]
    inertia = [float(i.get("iyy") or 0) for i in root.iter("inertia")]
    np.testing.assert_allclose(inertia, [0.0021, 0.0059])


# -- BAM -----------------------------------------------------------------------------------------------

SERVO = xl330_pendulum().with_values({"hub.position_servo.period": 0.0})


def test_bam_takes_the_friction_of_a_gear_as_that_of_its_load():
    """Both effects give the same file; the certificate names the torque that it depends on in BAM."""
    one, other = (
        to_bam(SERVO + effect, 0.005, u=0.3 * U[::2])
        for effect in (
            GearFriction("hub", level=0.03, share=0.27),
            LoadFriction("hub", level=0.03, driving=0.27, tied=True, of="motor"),
        )
    )
    assert json.loads(one.content) == json.loads(other.content)
    assert "not of the motor alone" in str(one.certificate)


@pytest.mark.parametrize(
    ("effects", "model", "keys"),
    [
        ((Coulomb("hub", level=0.03), Viscous("hub", coefficient=0.005)), "m1", set()),
        ((Stribeck("hub"),), "m2", {"friction_stribeck", "dtheta_stribeck", "alpha"}),
        ((LoadFriction("hub", driving=0.15, tied=True),), "m3", {"load_friction_base"}),
        ((Coulomb("hub", level=0.03), Delay(time=0.023)), "m1", {"command_delay"}),
    ],
    ids=["m1", "m2", "m3", "delay"],
)
def test_bam_does_what_the_toolkit_does(effects, model, keys):
    servo = SERVO.with_values({"hub.gravity.cosine": 0.02})
    for effect in effects:
        servo = servo + effect
    exported = to_bam(servo, 0.005, u=0.3 * U[::2])
    content = json.loads(exported.content)
    always = {"kt", "R", "armature", "q_offset", "friction_base", "friction_viscous", "model", "actuator"}
    assert set(content) == always | keys and content["model"] == model and content["actuator"] == "xl330"
    assert content["q_offset"] == pytest.approx(math.atan2(0.02, 0.49 * 9.80665 * 0.1))
    # The cosine increases the weight of the pendulum, and with it the inertia at the same length.
    inertia = content["armature"] + math.hypot(0.02, 0.49 * 9.80665 * 0.1) * 0.1 / 9.80665
    assert inertia == pytest.approx(0.0069)
    # While the pendulum accelerates, the loads of both sides of the gear differ from their mean.
    assert exported.certificate.largest[0] < (5 if model == "m3" else 2) * NOISE, str(exported.certificate)
    assert [line for line in exported.certificate.left_out if "firmware" not in line] == []


def test_bam_names_what_it_lacks_and_refuses_what_is_no_servo():
    told = to_bam(xl330_pendulum() + CubicSpring("hub", stiffness=0.1), u=U[:50]).certificate.left_out
    assert any("cubic_spring" in line for line in told) and any("control period" in line for line in told)
    with pytest.raises(InputError, match="one servo, but the mechanism has 2 coordinates and 0"):
        to_bam(JOINT)
    with pytest.raises(InputError, match="give the length of the pendulum"):
        to_bam(xl330_pendulum(), length=0.5)


# -- FMU -----------------------------------------------------------------------------------------------

LADEN = JOINT + Stribeck("hub") + JointPlay("joint") + Delay(time=0.0055) + LuGre("joint")


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    pytest.importorskip("fmpy")
    if cc is None:
        pytest.skip("no C compiler on this machine")
    exported = to_fmu(LADEN, Ts, name="my joint", u=U)
    return exported, str(exported.save(tmp_path_factory.mktemp("fmu") / "joint.fmu"))


def test_fmu_passes_its_validator_and_follows_the_simulator(fmu):
    from fmpy import simulate_fmu
    from fmpy.validation import validate_fmu

    exported, file = fmu
    assert validate_fmu(file) == []
    assert max(exported.certificate.largest) < 1e-6 and exported.certificate.left_out == ()
    t = Ts * np.arange(len(U))
    signals = np.array(list(zip(t, U, strict=True)), dtype=[("time", float), ("u", float)])
    found = simulate_fmu(
        file,
        input=signals,
        stop_time=t[-1],
        step_size=Ts,
        output_interval=Ts,
        start_values={"theta_start": 0.3, "alpha_rate_start": -1.0},
    )
    y = np.column_stack([found["theta"], found["alpha"]])
    recording = Recording(u=U, y=y[: len(U)], Ts=Ts)
    expected = Model(LADEN).simulate(recording, x0=[0.3, 0.0, 0.0, -1.0])
    assert np.ptp(expected[:, 0]) > 0.5
    np.testing.assert_allclose(y[: len(U)], expected, rtol=0, atol=1e-6)


def test_fmu_steps_by_whole_samples_only_and_goes_back_to_a_saved_state(fmu, tmp_path):
    from fmpy import extract, read_model_description
    from fmpy.fmi3 import FMU3Slave

    folder = extract(fmu[1], str(tmp_path))
    told = read_model_description(folder)
    options = {
        "unzipDirectory": folder,
        "modelIdentifier": told.coSimulation.modelIdentifier,
        "instanceName": "a",
    }
    unit = FMU3Slave(guid=told.guid, **options)
    unit.instantiate()
    unit.enterInitializationMode()
    unit.exitInitializationMode()
    unit.setFloat64([1], [2.0])
    unit.doStep(0.0, 3 * Ts)
    saved = unit.getFMUState()
    unit.doStep(3 * Ts, 50 * Ts)
    first = unit.getFloat64([0, 2, 3])
    unit.setFMUState(saved)
    for k in range(50):
        unit.doStep((3 + k) * Ts, Ts)
    np.testing.assert_allclose(unit.getFloat64([0, 2, 3]), first, rtol=1e-12)
    assert first[1] > 0.01
    bytes_of = unit.serializeFMUState(saved)
    unit.setFMUState(unit.deserializeFMUState(bytes_of))
    assert unit.getFloat64([0])[0] == pytest.approx(3 * Ts)
    for call in (
        lambda: unit.doStep(3 * Ts, 0.7 * Ts),
        lambda: unit.doStep(9 * Ts, Ts),
        lambda: unit.setFloat64([1], [math.nan]),
        lambda: unit.setFloat64([4], [0.1]),  # a first position cannot be set after the start
        lambda: unit.getFloat64([99]),
    ):
        with pytest.raises(Exception, match=r"status 3 \(error\)"):
            call()
    assert unit.getFloat64([0])[0] == pytest.approx(3 * Ts)
    unit.freeInstance()
    wrong = FMU3Slave(guid="{another}", **options)
    with pytest.raises(Exception, match="instantiate"):
        wrong.instantiate()


def test_fmu_holds_its_source_which_compiles_without_a_warning(fmu, tmp_path):
    exported, _ = fmu
    with zipfile.ZipFile(io.BytesIO(exported.content)) as archive:
        names = set(archive.namelist())
        archive.extractall(tmp_path)
    sources = {"sources/buildDescription.xml", "sources/fmi3_model.c", "sources/model.h"}
    assert {"modelDescription.xml", f"binaries/{platform_folder()}/my_joint.so"} | sources == names
    assert "largest difference" in (tmp_path / "modelDescription.xml").read_text()
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1", "-c", "-o", "x.o"]
    assert cc is not None
    subprocess.run([cc, *flags, "fmi3_model.c"], cwd=tmp_path / "sources", check=True)
    assert to_fmu(LADEN, Ts, name="my joint", u=U).content == exported.content


def test_fmu_without_a_compiler_is_source_alone(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    exported = to_fmu(single_inertia(), Ts, name='<1 & "2">', u=U[:9])
    assert "no C compiler" in exported.certificate.not_simulated
    with zipfile.ZipFile(io.BytesIO(exported.content)) as archive:
        assert not [name for name in archive.namelist() if name.startswith("binaries")]
        root = ET.fromstring(archive.read("modelDescription.xml"))
    assert root.get("modelName") == '<1 & "2">'
    simulation = root.find("CoSimulation")
    assert simulation is not None and simulation.get("modelIdentifier") == "_1____2__"
