"""A mechanism from a joint of an MJCF file moves as MuJoCo moves the joint."""

import math
import re
import sys

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.effects import Coulomb, CoulombAsymmetric, CurrentDrive, Gravity, Lag, Saturation, Viscous
from rotflex_jax.errors import InputError
from rotflex_jax.export import to_mjcf
from rotflex_jax.export.certificate import standard_input
from rotflex_jax.export.mjcf import run_in_mujoco
from rotflex_jax.joints import emps, paper, xl330_pendulum

Ts = 0.002
U = standard_input(Ts, 2.0)[:1000]

SHAPES = """
<mujoco>
  <compiler eulerseq="{sequence}"/>
  <option timestep="0.0001" integrator="implicitfast"><flag contact="disable" limit="disable"/></option>
  <default>
    <joint damping="0.3" armature="0.001"/>
    <geom density="800"/>
    <default class="heavy">
      <geom density="3000"/><default class="long"><geom size="0.01 0.2"/></default>
    </default>
  </default>
  <worldbody>
    <body name="post" pos="0.1 0.2 0.3" euler="10 20 30">
      <geom type="box" size="0.1 0.1 0.2"/>
      <body name="link" pos="0 0.1 0" quat="0.9 0.1 0.2 0.3" childclass="heavy">
        <joint name="shoulder" axis="1 2 0.5" pos="0.01 0.02 0" frictionloss="0.05" range="-90 90"/>
        <geom type="capsule" fromto="0 0 0 0.1 0.2 0.05" size="0.02"/>
        <geom type="sphere" size="0.03" pos="0.1 0 0"/>
        <geom type="box" size="1 1 1" mass="0"/>
        <body pos="0.1 0.2 0.05" axisangle="1 1 0 40">
          <geom type="cylinder" class="long" zaxis="1 0 1"/>
          <geom type="ellipsoid" size="0.02 0.03 0.05" mass="0.2" euler="15 25 35"/>
          <body pos="0 0 0.1" xyaxes="0 1 0 -1 0.5 0">
            <inertial mass="0.3" pos="0.01 0.02 0.03" fullinertia="0.002 0.003 0.004 0.0001 0.0002 0.0003"/>
          </body>
          <body pos="0.05 0 0">
            <inertial mass="0.1" pos="0 0 0.1" quat="0.8 0.6 0 0" diaginertia="1e-3 2e-3 2.5e-3"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>{actuator}</actuator>
  <sensor><jointpos joint="shoulder"/></sensor>
</mujoco>
"""

MOTOR = '<motor joint="shoulder" gear="3"/>'


def written(tmp_path, text):
    file = tmp_path / "robot.xml"
    file.write_text(text)
    return file


def loaded(tmp_path, text, *names, **options):
    return rf.load_mjcf(written(tmp_path, text), *names, **options)


@pytest.mark.parametrize("sequence", ["xyz", "ZYX"])
def test_inertia_and_weight_are_mujocos(tmp_path, sequence):
    """Shapes, frames, classes and degrees: the mass matrix and the bias of MuJoCo are the reference."""
    mujoco = pytest.importorskip("mujoco")
    text = SHAPES.format(actuator=MOTOR, sequence=sequence)
    machine = loaded(tmp_path, text)
    m = mujoco.MjModel.from_xml_string(text)
    d = mujoco.MjData(m)
    weight = machine.effect("gravity", "hub")
    assert isinstance(weight, Gravity) and math.hypot(weight.sine, weight.cosine) > 0.4
    for q in (0.0, 0.7, -2.0):
        d.qpos[:] = q
        mujoco.mj_forward(m, d)
        torque = weight.sine * math.sin(q) + weight.cosine * math.cos(q)
        assert d.qfrc_bias[0] == pytest.approx(torque, rel=1e-9)
    d.qpos[:], d.ctrl[:], d.qvel[:] = 0.0, 1.0, 0.0
    m.dof_frictionloss[:] = 0.0
    mujoco.mj_forward(m, d)
    inertia = machine.values[machine.parameter_names.index("hub.inertia.inertia")]
    assert d.qacc[0] * inertia == pytest.approx(3.0 - weight.cosine, rel=1e-9)
    assert machine.free_names[:2] == ("hub.inertia.inertia", "hub.viscous.coefficient")


ACTUATORS = {
    "motor": (MOTOR, 1.0),
    "motor, limits": ('<motor joint="shoulder" gear="3" ctrlrange="-0.6 0.6" forcerange="-0.5 0.5"/>', 1.0),
    "velocity": ('<velocity joint="shoulder" kv="1.5" gear="2"/>', 1.0),
    "position": ('<position joint="shoulder" kp="8" kv="0.4"/>', 0.5),
    "position, filtered": ('<position joint="shoulder" kp="8" timeconst="0.02" gear="1.5"/>', 0.5),
    "position, limited": ('<position joint="shoulder" kp="30" forcerange="-3 3"/>', 0.5),
    "position, limited with its damping": (
        '<position joint="shoulder" kp="30" kv="1" forcerange="-3 3"/>',
        0.5,
    ),
    "motor in the parent": ('<motor jointinparent="shoulder" gear="3"/>', 1.0),
    "general": (
        '<general joint="shoulder" gainprm="2" biastype="affine" biasprm="0.3 0 -0.5" gear="1.2"'
        ' ctrlrange="-1 1"/>',
        1.0,
    ),
    "dcmotor": (
        '<dcmotor joint="shoulder" motorconst="0.02 0.03" resistance="2" inductance="1e-3" gear="50"/>',
        1.0,
    ),
}


@pytest.mark.parametrize("kind", ACTUATORS)
def test_the_machine_moves_as_in_mujoco(tmp_path, kind):
    mujoco = pytest.importorskip("mujoco")
    if kind == "dcmotor" and not hasattr(mujoco.mjtDyn, "mjDYN_DCMOTOR"):
        pytest.skip("this MuJoCo has no dcmotor")
    actuator, size = ACTUATORS[kind]
    text = SHAPES.format(actuator=actuator, sequence="xyz")
    machine = loaded(tmp_path, text, "shoulder")
    u = size * U
    expected = run_in_mujoco(
        text.replace(
            'frictionloss="0.05"',
            'frictionloss="0.05" solreffriction="2e-4 1" solimpfriction="0.9999 0.9999 0.001"',
        ),
        u,
        Ts,
    )
    y = rf.simulate(machine, u, Ts)
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(y, expected, rtol=0, atol=1e-3 * np.ptp(expected))


@pytest.mark.parametrize(
    ("machine", "size"),
    [
        (paper(hub_damping=0.01) + Coulomb("hub") + Viscous("arm", coefficient=0.01) + Coulomb("arm"), 2.0),
        (paper(inductance=2e-4, efficiency=0.8) + Coulomb("joint", level=0.01), 2.0),
        (paper() + Saturation(limit=1.2) + Lag() + Gravity("arm", sine=0.05, cosine=0.02), 2.0),
        (paper() + CoulombAsymmetric("hub"), 2.0),
        (xl330_pendulum() + Coulomb("hub"), 0.6),
        (emps() + Coulomb("axis", level=20.0), 2.0),
    ],
    ids=["tendon", "inductance", "weight, lag, limit", "two levels", "servo", "slide"],
)
def test_an_exported_machine_comes_back(tmp_path, monkeypatch, machine, size):
    monkeypatch.setitem(sys.modules, "mujoco", None)  # neither export nor import needs it
    to_mjcf(machine, Ts).save(tmp_path / "m.xml")
    back = rf.load_mjcf(tmp_path / "m.xml", *machine.coordinates)
    assert back.units[:2] == machine.units[:2] and back.units.input == machine.units.input
    u = 0.5 * size * U
    expected = rf.simulate(machine, u, Ts)
    np.testing.assert_allclose(rf.simulate(back, u, Ts), expected, rtol=0, atol=1e-6 * np.ptp(expected))


TWO = """
<mujoco>
  <worldbody><body>
    <inertial mass="1" pos="0 0 0" diaginertia="0.01 0.01 0.01"/><joint name="a" axis="0 0 1" {a}/>
    <body pos="0 0 0.1" euler="180 0 0">
      <inertial mass="1" pos="0.1 0 0" diaginertia="0.01 0.01 0.01"/><joint name="b" axis="{axis}" {b}/>
    </body>
  </body></worldbody>
  <actuator>{actuator}</actuator>
  <sensor><jointpos joint="a"/><jointpos joint="b"/></sensor>{more}
</mujoco>
"""
PLAIN = {
    "a": 'damping="0.05"',
    "b": 'stiffness="3"',
    "axis": "0 0 1",
    "actuator": '<motor joint="a"/>',
    "more": "",
}


def test_a_child_that_turns_the_other_way(tmp_path):
    pytest.importorskip("mujoco")
    text = TWO.format(**PLAIN)
    machine = loaded(tmp_path, text, "a", "b")
    assert machine.port_vectors["arm"] == (1.0, -1.0)
    u = 0.2 * U
    fine = text.replace("<worldbody>", '<option timestep="1e-4" integrator="RK4"/><worldbody>')
    expected = run_in_mujoco(fine, u, Ts)
    np.testing.assert_allclose(rf.simulate(machine, u, Ts), expected, atol=1e-6 * np.ptp(expected))


@pytest.mark.parametrize(
    ("change", "words", "ignore"),
    [
        ({"axis": "0 1 0"}, "not about the same axis", None),
        ({"a": 'springref="5" stiffness="1"'}, "away from zero (springref)", "springref"),
        ({"a": 'ref="5"'}, "a reference angle (ref)", "ref"),
        ({"a": 'springdamper="1 1"'}, "springdamper", None),
        (
            {"actuator": '<motor joint="a" ctrlrange="-1 2"/>'},
            "an asymmetric ctrlrange of -1 to 2",
            "ctrlrange",
        ),
        (
            {"actuator": '<position joint="a" gear="2" forcerange="-2 2"/>'},
            "forcerange at a position",
            "forcerange",
        ),
        ({"actuator": '<general joint="a" dyntype="integrator"/>'}, "dyntype integrator", None),
        ({"actuator": '<dcmotor joint="a" motorconst="1" resistance="1" cogging="1 1 0"/>'}, "cogging", None),
        ({"actuator": '<dcmotor joint="a" motorconst="1"/>'}, "without motorconst and resistance", None),
        ({"actuator": '<motor joint="b"/>'}, "behind the first", None),
        ({"actuator": ""}, "has 0 actuators", None),
        ({"actuator": '<motor joint="a" gear="-1"/>'}, "turns backwards", None),
        ({"actuator": '<motor joint="a" gear="0"/>'}, "gives no force", None),
        ({"actuator": '<position joint="a" kp="0"/>'}, "gives no force", None),
        (
            {"actuator": '<general joint="a" biastype="affine" biasprm="0.5 0 0" forcerange="-1 1"/>'},
            "a filter or a constant of its own",
            "forcerange",
        ),
        (
            {"actuator": '<general joint="a" dyntype="filter" dynprm="0.1" forcerange="-1 1"/>'},
            "a filter or a constant of its own",
            "forcerange",
        ),
        (
            {
                "actuator": '<motor joint="a"/><position tendon="t"/>',
                "more": '<tendon><fixed name="t"><joint joint="a" coef="1"/></fixed></tendon>',
            },
            "an actuator at the tendon 't'",
            "actuator",
        ),
        ({"more": '<equality><joint joint1="a" joint2="b"/></equality>'}, "an equality", "equality"),
        (
            {"more": '<tendon><fixed stiffness="1"><joint joint="a" coef="2"/></fixed></tendon>'},
            "the tendon",
            "tendon",
        ),
        ({"more": '<option><flag damper="disable"/></option>'}, 'flag damper="disable"', None),
        ({"more": '<option viscosity="1"/>'}, "viscosity of a fluid", None),
        ({"more": '<option actuatorgroupdisable="0"/>'}, "switched off", None),
        ({"a": 'damping="x"'}, 'damping="x"', None),
        ({"axis": "0 0 0"}, 'a joint with axis="0 0 0"', None),
        ({"a": 'damping="nan"'}, 'damping="nan"', None),
        ({"a": 'class="none"'}, "the class 'none'", None),
        ({"more": '<include file="/etc/passwd"/>'}, "<include>", None),
        ({"b": "/><geom type='mesh' mesh='m'"}, None, None),
    ],
    ids=lambda x: str(x)[:40],
)
def test_what_cannot_be_said_is_refused_by_name(tmp_path, change, words, ignore):
    text = TWO.format(**(PLAIN | change))
    if words is None:  # a shape counts only where the body has no inertia of its own
        loaded(tmp_path, text, "a", "b")
        text = text.replace('<inertial mass="1" pos="0.1 0 0" diaginertia="0.01 0.01 0.01"/>', "")
        words = "shape of type 'mesh'"
    with pytest.raises(InputError) as caught:
        loaded(tmp_path, text, "a", "b")
    assert words in str(caught.value) and "\n" not in str(caught.value)
    if ignore:
        assert f"ignore=['{ignore}']" in str(caught.value)
        loaded(tmp_path, text, "a", "b", ignore=[ignore])


@pytest.mark.parametrize("zero", ['mass="1" pos="0.1', 'mass="1" pos="0 0', "0.01 0.01 0.01"])
def test_what_moves_has_mass_and_inertia(tmp_path, zero):
    """Moving bodies without mass or inertia are refused, as in MuJoCo."""
    mujoco = pytest.importorskip("mujoco")
    text = TWO.format(**PLAIN).replace(zero, zero.replace("1", "0"))
    with pytest.raises(ValueError, match="mass and inertia of moving bodies"):
        mujoco.MjModel.from_xml_string(text)
    with pytest.raises(InputError, match="has no mass, or no inertia about the axis, in what moves with"):
        loaded(tmp_path, text, "a", "b")


def test_options_add_up(tmp_path):
    pieces = '<option timestep="1e-3"/><option gravity="0 -5 0"/><option><flag contact="disable"/></option>'
    mujoco = pytest.importorskip("mujoco")
    text = TWO.format(**(PLAIN | {"more": pieces}))
    assert mujoco.MjModel.from_xml_string(text).opt.gravity[1] == -5.0
    weight = loaded(tmp_path, text, "a", "b").effect("gravity", "arm")
    assert isinstance(weight, Gravity) and math.hypot(weight.sine, weight.cosine) == pytest.approx(0.5)


def test_actuators_share_one_set_of_defaults(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    text = TWO.format(**(PLAIN | {"actuator": '<general joint="a"/>'}))
    text = text.replace("<worldbody>", '<default><motor gear="3" ctrlrange="-2 2"/></default><worldbody>', 1)
    assert mujoco.MjModel.from_xml_string(text).actuator_gear[0, 0] == 3.0
    machine = loaded(tmp_path, text, "a", "b")
    assert machine.effect("current_drive", "hub") == CurrentDrive(at="hub", gain=3.0)
    assert any(isinstance(e, Saturation) and e.limit == 2.0 for e in machine.effects)
    text = text.replace('motor gear="3" ctrlrange="-2 2"', 'velocity kv="2"')
    with pytest.raises(InputError, match="defaults of another kind"):
        loaded(tmp_path, text, "a", "b")
    text = text.replace('<general joint="a"/>', '<position joint="a" kp="5"/>')
    assert mujoco.MjModel.from_xml_string(text).actuator_biasprm[0, :3].tolist() == [0.0, -5.0, 0.0]
    assert loaded(tmp_path, text, "a", "b").effect("viscous", "hub") == Viscous(at="hub", coefficient=0.05)


def test_a_name_that_no_file_can_have():
    with pytest.raises(InputError, match="cannot be read"):
        rf.load_mjcf("a\0b.xml")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('<!DOCTYPE m [<!ENTITY a "aaaa">]><mujoco model="&a;"/>', "declares a document type"),
        ('<!DOCTYPE m SYSTEM "file:///etc/passwd"><mujoco/>', "declares a document type"),
        ("<mujoco>" + "<body>" * 300, "more than 200 elements inside"),
        ("<robot/>", "begins with <robot>"),
        ("not xml", "is no XML"),
        ('<?xml version="1.0" encoding="nobody"?><mujoco/>', "unknown encoding"),
        ('<?xml version="1.0" encoding="shift_jis"?><mujoco/>', "multi-byte encodings"),
        ("", "is no XML"),
        ("<mujoco/>", "turn or slide: none; no joint was named"),
        ("<mujoco><worldbody><frame/></worldbody></mujoco>", "the element <frame>"),
    ],
)
def test_files_of_others_are_read_safely(tmp_path, text, words):
    with pytest.raises(InputError, match=words):
        loaded(tmp_path, text)


def test_damaged_files_end_in_one_sentence(tmp_path):
    """A file with a random attribute or a missing part gives a mechanism, or an InputError in one line."""
    rng = np.random.default_rng(5)
    whole = SHAPES.format(actuator=ACTUATORS["general"][0], sequence="xyz")
    attributes = [m.span(1) for m in re.finditer(r'="([^"]*)"', whole)]
    junk = ["", "0", "-1", "1e400", "nan", "a b", "1 2", "0 0 0", "\x01", "free", "mesh", "1e-300", "-5 5"]
    refused = 0
    for k in range(200):
        text = whole
        if k % 4:
            a, b = attributes[rng.integers(len(attributes))]
            text = whole[:a] + junk[rng.integers(len(junk))] + whole[b:]
        else:
            a, b = sorted(rng.integers(len(whole), size=2))
            text = whole[:a] + whole[b:]
        try:
            assert isinstance(loaded(tmp_path, text), rf.Mechanism)
        except InputError as error:
            refused += 1
            assert "\n" not in str(error) and str(error).endswith(".")
    assert 50 < refused < 190


def test_a_large_file_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr("rotflex_jax.joints.mjcf_tree.LARGEST_FILE", 10)
    with pytest.raises(InputError, match="at most 10; give"):
        loaded(tmp_path, "<mujoco></mujoco>")


def test_a_joint_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="turn or slide: a, b; joint was given 'c', name one of these"):
        loaded(tmp_path, TWO.format(**PLAIN), "c")
