"""`rotflex export`, saved models, and machines from files of users on the command line."""

import json
import sys
import textwrap

import numpy as np
import pytest

from rotflex_jax.cli import app
from rotflex_jax.effects import CATALOG, Coulomb
from rotflex_jax.export import Saved, save, to_c
from rotflex_jax.joints import paper
from rotflex_jax.mechanism import simulate
from rotflex_jax.models.model import Model
from rotflex_jax.runtime import xla


@pytest.fixture(autouse=True)
def no_global_settings(monkeypatch):
    """Settings that the program makes for its process must not affect other tests."""
    monkeypatch.setattr(xla, "enable_fast_loops", lambda: True)
    monkeypatch.setattr(xla, "enable_compilation_cache", lambda: None)


@pytest.fixture
def run(capsys):
    """Run the command line in this process: exit status, stdout, stderr."""

    def run(*arguments):
        with pytest.raises(SystemExit) as left:
            app.main([str(argument) for argument in arguments])
        return left.value.code, *capsys.readouterr()

    return run


@pytest.fixture
def saved(tmp_path):
    model = Model(paper(hub_damping=0.01) + Coulomb("hub", level=0.0312))
    return save(Saved(model, Ts=0.002, n_init=50), tmp_path / "model.json")


PLANT = """
    import dataclasses
    from typing import ClassVar
    import rotflex_jax as rf
    from rotflex_jax.effects import Force, Inertia, Motor, Viscous, register
    from rotflex_jax.parameters import parameter

    wheel = rf.Mechanism(
        coordinates=["angle"],
        ports={"axle": (1,)},
        effects=[Motor(at="axle", gear_ratio=20.0), Inertia(at="axle", inertia=0.01), Viscous(at="axle")],
        outputs={"tacho": ("axle", "speed")},
        trusted=["axle.motor.resistance"],
    )

    @register
    @dataclasses.dataclass(frozen=True)
    class PlantDrag(Force):
        name: ClassVar[str] = "plant_drag"
        title: ClassVar[str] = "drag of the plant"
        equation: ClassVar[str] = "tau = -coefficient * speed**3"
        amplitudes: ClassVar[tuple[str, ...]] = ("coefficient",)
        coefficient: float = parameter(1e-6, unit="N m s^3/rad^3")

        def force(self, position, speed, voltage):
            return -self.coefficient * speed**3

    number = 3
    braked = lambda: wheel + PlantDrag(at="axle")
    """


@pytest.fixture
def plant(tmp_path):
    file = tmp_path / "my_plant.py"
    file.write_text(textwrap.dedent(PLANT))
    yield file
    CATALOG.pop("plant_drag", None)


def one_sentence(err, *words):
    assert err.startswith("rotflex: ") and err.count("\n") == 1 and "Traceback" not in err
    for word in words:
        assert word in err


def test_c_code_of_a_saved_model(run, saved, tmp_path):
    status, out, _ = run("export", saved, "--to", "c")
    assert status == 0 and out == to_c(Model.load(saved), 0.002)
    target = tmp_path / "joint.h"
    assert run("export", saved, "--to", "c", "--Ts", "0.01", "--prefix", "joint", "--out", target)[0] == 0
    assert "joint_step(" in target.read_text() and "JOINT_TS 0.01" in target.read_text()


def test_other_forms(run, saved):
    assert "level = 0.0312 N m" in run("export", saved, "--to", "text")[1]
    assert r"\mathit{level}" in run("export", saved, "--to", "latex")[1]
    linear = json.loads(run("export", saved, "--to", "statespace", "--Ts", "0.002")[1])
    assert linear["Ts"] == 0.002 and np.array(linear["A"]).shape == (4, 4)
    assert linear["dropped"] == ["Coulomb friction at hub has no slope at rest"]


def test_simulators_with_their_certificates(run, saved, tmp_path):
    """With --out the certificate is printed on stdout; an export to stdout prints it on stderr."""
    target = tmp_path / "joint.xml"
    status, out, err = run("export", saved, "--to", "mjcf", "--out", target)
    assert (status, err) == (0, "") and out.startswith("Certificate of the export to MJCF")
    assert "<!--" in target.read_text() and 'model="model"' in target.read_text()
    status, out, err = run("export", "xl330_pendulum:gain=200", "--to", "bam", "--length", "0.05")
    assert status == 0 and err.startswith("Certificate of the export to BAM") and "gain 200" in err
    assert json.loads(out)["armature"] == pytest.approx(0.0069 - 0.49 * 0.1 * 0.05)
    status, out, _ = run("export", f"{target}:joint=theta,child=alpha", "--to", "text")
    assert status == 0 and "level = 0.0312 N m" in out


def test_a_controller_of_a_machine_without_a_hub_is_told_its_port(run, tmp_path):
    file = tmp_path / "axis_on_rail.py"
    file.write_text("from rotflex_jax.joints import emps\n\naxis = emps()\n")
    where = ("export", f"{file}:axis", "--to", "controller", "--Ts", "0.002")
    status, out, err = run(*where)
    assert (status, out) == (2, "")
    one_sentence(err, "--port must be one of 'axis'")
    status, out, err = run(*where, "--port", "axis")
    assert (status, err) == (0, "") and "Controller of axis" in out
    one_sentence(run("export", f"{file}:axis", "--to", "text", "--port", "axis")[2], "text has no use of it")


def test_what_cannot_be_exported_is_said_in_one_sentence(run, saved, tmp_path):
    for arguments, words in (
        ((saved, "--to", "fortran"), ("'fortran'", "c, latex, text, statespace")),
        (("paper", "--to", "c"), ("needs a sampling period", "--Ts")),
        (("paper", "--to", "fmu", "--out", tmp_path / "x.fmu"), ("an FMU needs a sampling period", "--Ts")),
        (("paper", "--to", "controller"), ("a controller needs a sampling period", "--Ts")),
        ((saved, "--to", "fmu"), ("archive", "--out")),
        (("paper", "--to", "bam"), ("one servo", "xl330_pendulum")),
        ((tmp_path / "no.xml", "--to", "text"), ("cannot be read",)),
        ((saved, "--to", "c", "--Ts", "-1"), ("--Ts must be a finite number above 0", "-1")),
        ((tmp_path / "no.json", "--to", "text"), ("does not exist",)),
        ((saved, "--to", "text", "--out", tmp_path / "no" / "where.txt"), ("does not", "exist")),
    ):
        status, out, err = run("export", *arguments)
        assert (status, out) == (2, "")
        one_sentence(err, *words)


def test_a_machine_of_ones_own_from_a_file(run, plant, tmp_path):
    """A mechanism in a Python file is named on the command line; its channels are read by their names."""
    from rotflex_jax.joints.by_name import named

    u = 2 * np.sin(np.arange(800) * 0.02) + 0.3
    braked = named(f"{plant}:braked").mechanism
    speed = simulate(braked, u, 0.005)[:, 0]
    table = np.column_stack([0.005 * np.arange(len(u)), u, speed])
    data = tmp_path / "run.csv"
    np.savetxt(data, table, delimiter=",", header="t,voltage,tacho", comments="", fmt="%.17g")
    status, out, _ = run("simulate", data, "--joint", f"{plant}:wheel", "--save-model", tmp_path / "w.json")
    assert status == 0 and "tacho [deg/s]" in out
    assert Model.load(tmp_path / "w.json").mechanism.ports == (("axle", (1.0,)),)
    status, out, _ = run("simulate", data, "--model", f"{plant}:wheel", "--add", "plant_drag@axle")
    (row,) = (line.split() for line in out.splitlines() if "free run" in line)
    assert status == 0 and float(row[-1]) < 1e-6 < np.std(speed) and "tacho 100.0 %" in out
    save(Saved(Model(braked), Ts=0.005), tmp_path / "braked.json")
    text = run("export", tmp_path / "braked.json", "--to", "text", "--with", plant)[1]
    assert "tau = -coefficient * speed**3" in text


def test_a_saved_model_with_an_effect_of_ones_own_is_read_with_its_file(run, plant, tmp_path):
    """The search of a new process may have saved an effect that the next process does not know."""
    from rotflex_jax.joints.by_name import named

    braked = named(f"{plant}:braked").mechanism
    u = 2 * np.sin(np.arange(400) * 0.02) + 0.3
    table = np.column_stack([0.005 * np.arange(len(u)), u, simulate(braked, u, 0.005)[:, 0]])
    data, model = tmp_path / "run.csv", tmp_path / "braked.json"
    np.savetxt(data, table, delimiter=",", header="t,voltage,tacho", comments="", fmt="%.17g")
    save(Saved(Model(braked), Ts=0.005), model)
    # As in a new process: the catalogue and the modules do not know the file.
    del CATALOG["plant_drag"], sys.modules["my_plant"]
    status, out, err = run("simulate", data, "--model", model)
    assert (status, out) == (2, "")
    one_sentence(err, "'plant_drag', which is not in the catalogue", "--with FILE.py")
    status, out, _ = run("simulate", data, "--model", model, "--with", plant)
    assert status == 0 and "tacho 100.0 %" in out


def test_mistakes_in_naming_ones_own_machine(run, plant, saved, tmp_path):
    (tmp_path / "broken.py").write_text("wheel = 1 / 0\n")
    for name, words in (
        (f"{plant}:whel", ("no mechanism called 'whel'", "it has wheel")),
        (f"{plant}:number", ("no mechanism called 'number'",)),
        (f"{tmp_path}/none.py:wheel", ("does not exist",)),
        ("no_such_module:wheel", ("cannot be imported",)),
        (f"{tmp_path}/broken.py:wheel", ("cannot be run: ZeroDivisionError",)),
        (f"{tmp_path}/none.json", ("does not exist",)),
    ):
        status, out, err = run("simulate", saved, "--joint", name)
        assert (status, out) == (2, "")
        one_sentence(err, *words)
