"""Errors of new users with files of their own machines, in Python and on the command line."""

import dataclasses
import json
import re
from typing import ClassVar

import numpy as np
import pandas as pd
import pytest
import scipy.io
from test_cli import assert_one_sentence, run  # noqa: F401 - a fixture

import rotflex_jax as rf
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.cli.recordings import Columns
from rotflex_jax.data.datasets import demo_recording
from rotflex_jax.data.tables import name_and_unit
from rotflex_jax.discover.supermodel import build
from rotflex_jax.effects import CATALOG, Force
from rotflex_jax.effects.base import Scale
from rotflex_jax.errors import InputError
from rotflex_jax.parameters import parameter

RECORDING = demo_recording().slice(0, 3000)
T, U = RECORDING.t, RECORDING.u
THETA, ALPHA = RECORDING.y.T
COUNTS = 4096


def frame(**changed) -> pd.DataFrame:
    columns = {"t": T, "voltage": U, "theta": THETA, "alpha": ALPHA} | changed
    return pd.DataFrame({name: values for name, values in columns.items() if values is not None})


def counted(x: np.ndarray, per_turn: float = COUNTS) -> np.ndarray:
    return np.round(x * per_turn / (2 * np.pi)).astype(int)


# Encoder counts


def test_counts_become_angles() -> None:
    table = frame(theta=counted(THETA), alpha=counted(ALPHA, 8192))
    found = rf.load(table, counts={"theta": COUNTS, "alpha": 8192})
    assert np.max(np.abs(found.y[:, 0] - THETA)) <= np.pi / COUNTS * 1.001
    assert np.max(np.abs(found.y[:, 1] - ALPHA)) <= np.pi / 8192 * 1.001
    assert rf.load(frame(theta=counted(THETA), alpha=counted(ALPHA)), counts=COUNTS).units == ("rad", "rad")


def test_counts_are_named_as_counts_and_the_cure_works(run, tmp_path) -> None:  # noqa: F811
    file = tmp_path / "run.csv"
    frame(theta=counted(THETA), alpha=counted(ALPHA)).to_csv(file, index=False)
    status, _, err = run("check", file)
    assert status == 2
    assert_one_sentence(err, "counts of an encoder", "--counts 4096")
    status, out, _ = run("check", file, "--counts", COUNTS)
    assert status == 0
    assert "0.0879" in out  # the step of the encoder [deg]
    assert run("check", file, "--counts-per-turn", COUNTS)[1] == out
    # Counts that are read as degrees would give wrong angles, and errors far above the noise.
    status, _, err = run("check", file, "--degrees")
    assert status == 2
    assert_one_sentence(err, "counts of an encoder", "--counts 4096")


def test_whole_degrees_are_no_counts() -> None:
    whole = np.round(np.rad2deg(RECORDING.y))
    found = rf.load(frame(theta=whole[:, 0], alpha=whole[:, 1]), degrees=True)
    assert np.allclose(np.rad2deg(found.y), whole)
    # No arm deflects over more than 90 degrees, while a hub may turn further.
    hub, arm = np.round(400 * THETA / np.ptp(THETA)), np.round(92 * ALPHA / np.ptp(ALPHA))
    with pytest.raises(InputError, match="'alpha' holds whole numbers"):
        rf.load(frame(theta=hub, alpha=arm), degrees=True)
    assert rf.load(frame(theta=hub, alpha=np.round(0.9 * arm)), degrees=True).N == RECORDING.N


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"counts": 4096, "degrees": True}, "one of the two"),
        ({"counts": {"beta": 4096}}, "'beta'.*theta, alpha"),
        ({"counts": 0}, "counts of one turn"),
    ],
)
def test_wrong_counts_are_refused(given, said) -> None:
    with pytest.raises(InputError, match=said):
        rf.load(frame(), **given)


@pytest.mark.parametrize("options", [["--counts", "many"], ["--counts", "4096", "--counts", "8192"]])
def test_wrong_counts_are_refused_on_the_command_line(options, run, tmp_path) -> None:  # noqa: F811
    frame().to_csv(tmp_path / "run.csv", index=False)
    status, _, err = run("check", tmp_path / "run.csv", *options)
    assert status == 2
    assert_one_sentence(err, "--counts theta=4096")


# The absolute angle of the arm, and swapped columns


def test_the_arms_angle_in_the_room_is_refused_and_the_cure_works(run, tmp_path) -> None:  # noqa: F811
    file = tmp_path / "run.csv"
    frame(alpha=THETA + ALPHA).to_csv(file, index=False)
    with pytest.raises(InputError, match="arm_absolute=True"):
        rf.load(file)
    status, _, err = run("check", file)
    assert status == 2
    assert_one_sentence(err, "angle of the arm in the room", "--arm-absolute")
    assert np.allclose(rf.load(file, arm_absolute=True).y, RECORDING.y, atol=1e-9)
    assert run("check", file, "--arm-absolute")[0] == 0
    assert rf.load(file, accept="absolute").N == RECORDING.N


def test_swapped_channels_are_noticed_and_the_cure_works(run, tmp_path) -> None:  # noqa: F811
    file = tmp_path / "run.csv"
    frame(theta=ALPHA, alpha=THETA).to_csv(file, index=False)
    status, _, err = run("discover", file)
    assert status == 2
    assert_one_sentence(err, "look swapped", "--output")
    found = rf.load(file, outputs=("alpha", "theta"))
    assert np.allclose(found.y, RECORDING.y)


# One column alone, under another name


def test_one_column_under_another_name_says_which_sensor_it_is(run, tmp_path) -> None:  # noqa: F811
    file = tmp_path / "run.csv"
    frame(theta=None, alpha=None, servo=THETA).to_csv(file, index=False)
    for command in ("check", "discover", "compare"):
        status, _, err = run(command, file, "--output", "servo")
        assert status == 2
        assert_one_sentence(err, "two sensors", "--output theta=servo", "--output alpha=servo")
    status, out, _ = run("check", file, "--output", "theta=servo")
    assert status == 0 and "sensors=theta" in out
    status, longer, _ = run("check", file, "--output", "servo", "--joint", "paper:sensors=theta")
    assert status == 0 and longer.startswith(out)
    frame(theta=None, alpha=None, alph=ALPHA).rename(columns={"alph": "alpha"}).to_csv(file, index=False)
    assert "sensors=alpha" in run("check", file, "--output", "alpha")[1]


def test_faults_of_samples_and_times_name_options_of_the_command_line(run, tmp_path) -> None:  # noqa: F811
    file = tmp_path / "run.csv"
    spike = np.where(np.arange(len(T)) == 700, -9999.0, ALPHA)
    wrapped = (THETA * 8 + np.pi) % (2 * np.pi) - np.pi
    for changed, options, words in (
        ({"alpha": spike}, (), ("outliers", "--accept outliers")),
        ({"theta": wrapped}, (), ("a whole turn", "numpy.unwrap", "--accept wrapped")),
        ({"t": None}, ("--Ts", 2.5), ("too slow", "--Ts 0.0025", "--accept slow")),
        (
            {"t": 1e3 * T},
            ("--time-unit", "us"),
            ("unit of the time", "--time-unit", "--Ts", "--accept units"),
        ),
    ):
        frame(**changed).to_csv(file, index=False)
        status, _, err = run("check", file, *options)
        assert status == 2
        assert_one_sentence(err, *words)
        assert "=" not in err.partition("unwrap")[0]


def test_measured_joints_are_not_called_swapped(measured) -> None:
    for recording in [*measured("rotflex"), *measured("rotary_arm")]:
        assert not {"swapped", "absolute"} & {f.kind for f in recording.findings}


def test_arm_absolute_needs_both_angles() -> None:
    with pytest.raises(InputError, match="theta and alpha"):
        rf.load(frame(), outputs="theta", arm_absolute=True)


# Time: its unit, its steps


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("s", 1.0)])
def test_time_has_a_unit(unit, factor, run, tmp_path) -> None:  # noqa: F811
    file = tmp_path / "run.csv"
    frame(t=factor * T).to_csv(file, index=False)
    assert rf.load(file, time_unit=unit).Ts == pytest.approx(RECORDING.Ts)
    assert run("check", file, "--time-unit", unit)[0] == 0


def test_milliseconds_are_refused_with_a_cure_that_works(run, tmp_path) -> None:  # noqa: F811
    file = tmp_path / "run.csv"
    frame(t=1e3 * T).to_csv(file, index=False)
    status, _, err = run("check", file)
    assert status == 2
    assert_one_sentence(err, "--time-unit ms")
    with pytest.raises(InputError, match="one of s, ms, us"):
        rf.load(file, time_unit="minutes")


def uneven(seed: int = 0) -> np.ndarray:
    jitter = np.random.default_rng(seed).uniform(-0.2, 0.2, len(T))
    return T + RECORDING.Ts * jitter


def test_uneven_times_are_resampled_on_request(run, tmp_path) -> None:  # noqa: F811
    t = uneven()
    table = frame(t=t, theta=np.interp(t, T, THETA), alpha=np.interp(t, T, ALPHA))
    table.to_csv(tmp_path / "run.csv", index=False)
    with pytest.raises(InputError, match="resample='auto'"):
        rf.load(tmp_path / "run.csv")
    status, _, err = run("check", tmp_path / "run.csv")
    assert status == 2
    assert_one_sentence(err, "--resample auto")
    found = rf.load(tmp_path / "run.csv", resample=RECORDING.Ts)
    assert found.Ts == RECORDING.Ts
    inside = slice(5, -5)
    expected = np.interp(found.t, T, THETA)
    # The error of a line between samples is at most an eighth of the second difference.
    bound = 0.25 * np.max(np.abs(np.diff(THETA, 2))) + 1e-12
    assert np.max(np.abs(found.y[inside, 0] - expected[inside])) < bound
    assert set(found.u) <= set(U)  # the input is held, so that only given values occur
    assert [f.severity for f in found.findings if f.kind == "resampled"] == ["note"]
    assert "Resampled" in run("check", tmp_path / "run.csv", "--resample", "auto")[1]


def test_lost_rows_are_said_and_parts_of_the_recording_still_say_it() -> None:
    keep = np.ones(len(T), bool)
    keep[[700, 701, 1500]] = False
    table = frame()[keep]
    with pytest.raises(InputError, match="about 2 samples lost"):
        rf.load(table)
    found = rf.load(table, resample="auto")
    assert found.N == RECORDING.N
    for recording in (found, *found.split(0.7)):
        said = [f for f in recording.findings if f.kind == "resampled"]
        assert [f.severity for f in said] == ["warning"]
        assert "about 3 rows are lost" in said[0].message


def test_an_input_that_is_thinned_out_is_said_to_be_late() -> None:
    """Reference: the phase of a sine of 4 Hz that is held at every fourth of its samples."""
    t = 0.0005 * np.arange(4001)
    u = np.sin(2 * np.pi * 4 * t)
    table = pd.DataFrame({"t": t, "voltage": u, "theta": 0.1 * u, "alpha": 0.01 * np.cos(9 * t)})
    found = rf.load(table, resample=0.002)
    turn = np.exp(-2j * np.pi * 4 * t[:-1])
    late = np.angle((u[:-1] @ turn) / (np.repeat(found.u, 4)[:4000] @ turn)) / (2 * np.pi * 4)
    (said,) = (f for f in found.findings if f.kind == "resampled")
    assert said.severity == "warning" and "of about 4 samples of the input one is used" in said.message
    assert f"late by {1000 * late:.2g} ms" in said.message
    assert [f.severity for f in rf.load(table, resample=0.0005).findings if f.kind == "resampled"] == ["note"]


def test_a_long_gap_is_not_bridged() -> None:
    with pytest.raises(InputError, match="no resampling should bridge"):
        rf.load(frame().drop(range(700, 800)), resample="auto")
    with pytest.raises(InputError, match="must not fall"):
        rf.load(frame(t=np.r_[T[:100], T[:-100]]), resample="auto")


# Headers


@pytest.mark.parametrize(
    ("names", "scale"),
    [
        (("Time [s]", "Voltage [V]", "Theta [rad]", "Alpha [rad]"), (1.0, 1.0)),
        (("Time [ms]", "Voltage (V)", "Theta [deg]", "Alpha [°]"), (1e3, 180 / np.pi)),
        (("t", "voltage", "theta (degrés)", "alpha [º]"), (1.0, 180 / np.pi)),
        (("T", "VOLTAGE", "THETA", "ALPHA"), (1.0, 1.0)),
    ],
)
def test_headers_with_units_are_recognised(names, scale, run, tmp_path) -> None:  # noqa: F811
    table = np.column_stack([scale[0] * T, U, scale[1] * THETA, scale[1] * ALPHA])
    pd.DataFrame(table, columns=list(names)).to_csv(tmp_path / "run.csv", index=False)
    found = rf.load(tmp_path / "run.csv")
    assert found.Ts == pytest.approx(RECORDING.Ts)
    assert np.allclose(found.y, RECORDING.y)
    assert (found.input_name, found.input_unit) == ("voltage", "V")
    assert run("check", tmp_path / "run.csv")[0] == 0


def test_two_columns_that_could_be_meant_are_none() -> None:
    table = frame(theta=None).assign(**{"Theta [rad]": THETA, "THETA": THETA})
    with pytest.raises(InputError, match="no column 'theta'"):
        rf.load(table)


def test_an_index_is_no_unit() -> None:
    assert name_and_unit("log[0]") == ("log[0]", "")
    assert name_and_unit("Speed [rad/s]") == ("Speed", "rad/s")


# The input


@pytest.mark.parametrize("name", ["Current [A]", "motor_current"])
def test_a_current_is_no_voltage(name, run, tmp_path) -> None:  # noqa: F811
    file = tmp_path / "run.csv"
    frame(voltage=None).assign(**{name: U}).to_csv(file, index=False)
    found = rf.load(file, input=name)
    assert (found.input_name, found.input_unit) == (name.split(" [")[0], "A")
    status, _, err = run("discover", file, "--input", name)
    assert status == 2
    assert_one_sentence(err, "is in A, but the model is driven in V")


def test_a_smooth_input_on_the_command_line(run, tmp_path) -> None:  # noqa: F811
    file = tmp_path / "run.csv"
    frame().to_csv(file, index=False)
    held, smooth = (run("simulate", file, "--intersample", kind) for kind in ("held", "smooth"))
    assert held[0] == smooth[0] == 0
    assert held[1] != smooth[1]
    solver = rf.Exponential(between="smooth", substeps=4)
    y_hat = rf.Model(rf.joints.paper(), solver).simulate(RECORDING)
    fit = rf.metrics.fit_percent(RECORDING, y_hat)
    assert f"theta {fit['theta']:.1f} %" in smooth[1]
    status, _, err = run("simulate", file, "--intersample", "linear")
    assert status == 2
    assert_one_sentence(err, "held or smooth")


def test_steps_of_integration_on_the_command_line(run, tmp_path) -> None:  # noqa: F811
    made = make_record([("coulomb", "hub")], seed=2, seconds=8.0, fs=250.0)
    other, file = tmp_path / "other.csv", tmp_path / "run.csv"
    table = pd.DataFrame({"t": np.arange(len(made["u"])) * made["Ts"], "voltage": made["u"]})
    table["theta"], table["alpha"] = made["y"].T
    table.to_csv(other, index=False)
    table[:1200].to_csv(file, index=False)
    options = ("--add", "coulomb@hub:level=0.03", "--save", tmp_path / "saved.csv")
    for given, solver in (
        ((), rf.Exponential()),
        (("--substeps", "4"), rf.Exponential(substeps=4)),
        (("--intersample", "smooth"), rf.Exponential(substeps=4, between="smooth")),
        (("--intersample", "smooth", "--substeps", "6"), rf.Exponential(substeps=6, between="smooth")),
    ):
        assert run("simulate", file, *options, *given)[0] == 0
        y_hat = rf.Model(rf.joints.paper() + rf.effects.Coulomb(at="hub", level=0.03), solver).simulate(
            rf.load(file)
        )
        saved = pd.read_csv(tmp_path / "saved.csv")
        assert np.allclose(saved["theta_simulated"], y_hat[:, 0], rtol=0, atol=1e-6)
    # A fit with too long steps has a remark; with the advised number of steps it has none.
    page = tmp_path / "page"
    status, out, _ = run("simulate", file, "--fit", other, "--add", "coulomb@hub", "--report", page)
    (note,) = [line for line in out.splitlines() if line.startswith("note: ")]
    assert status == 0 and note.endswith("on the command line --substeps 4.")
    (remark,) = json.loads((page / "simulation.json").read_text())["remarks"]
    assert note == f"note: {remark['sentence']}." and remark["kind"] == "step of integration"
    assert "rf.Exponential(substeps=4)" in (page / "simulation.html").read_text()
    out = run("simulate", file, "--fit", other, "--add", "coulomb@hub", "--substeps", "4")[1]
    assert "note: " not in out
    # A comparison and the design of an experiment have the same remark for the models that they fit.
    model = rf.joints.paper() + rf.effects.Coulomb(at="hub")
    later = make_record([("coulomb", "hub")], seed=4, seconds=4.0, fs=250.0)
    test = rf.Recording(u=later["u"], y=later["y"], Ts=later["Ts"])
    (row,) = rf.compare(rf.load(other), ["grey_box"], mechanism=model, test=test).rows
    assert row.note == remark["sentence"]
    between = ("--between", "coulomb@hub", "delay@input", "--voltage", "2", "--seconds", "2", "--rank-only")
    status, _, err = run("experiment", "--fit", other, *between)
    assert status == 0 and f"note: fit with coulomb@hub: {remark['sentence']}." in err.splitlines()


def test_steps_are_no_matter_of_an_input_that_is_switched_within_samples(tmp_path) -> None:
    model = rf.Model(rf.joints.paper(), rf.Exponential(between="switched"))
    with pytest.raises(rf.InputError, match=r"--substeps 4 was given.*leave it out"):
        Columns(substeps=4).of(model)
    assert Columns(substeps=1).of(model)[0] == model


# Public data by name


def test_a_public_joint_is_searched_by_its_name(run, measured, monkeypatch) -> None:  # noqa: F811
    recordings = measured("rotflex")
    calls: list = []

    def search(model, train, validation, **options):
        calls.append((model, train, validation))
        raise InputError("Enough.")

    monkeypatch.setattr(rf, "discover", search)
    assert run("discover", "rotflex")[0] == 2
    ((model, train, validation),) = calls
    assert model.mechanism == rf.joints.quanser_2010()
    assert validation == []  # the two validate each other
    assert [r.source for r in train] == [r.source for r in recordings]
    assert np.array_equal(train[1].y, recordings[1].y)
    run("discover", "rotflex", "--joint", "paper:stiffness=1.2", "--split", "0.6")
    assert calls[1][0].mechanism == rf.joints.paper(stiffness=1.2)
    assert len(calls[1][1]) == len(calls[1][2]) == 2
    status, out, _ = run("check", "rotflex")
    assert status == 0
    assert out.count("do not contradict quanser_2010") == 2


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (("emps",), "not searched by its name"),
        (("rotflex", "--degrees"), "leave that option out"),
        (("rotflex", "rotflex"), "twice"),
    ],
)
def test_what_is_no_search_by_name_is_refused(line, said, run, measured) -> None:  # noqa: F811
    measured("rotflex")
    status, _, err = run("discover", *line)
    assert status == 2
    assert_one_sentence(err, said)


# Effects of a user


@dataclasses.dataclass(frozen=True)
class Power(Force):
    """tau = -stiffness position^order"""

    name: ClassVar[str] = "test_power"
    title: ClassVar[str] = "spring of a power"
    equation: ClassVar[str] = "tau = -stiffness * position^order"
    amplitudes: ClassVar[tuple[str, ...]] = ("stiffness",)
    given: ClassVar[object] = [[{"stiffness": 1, "offset": 0.0}]]

    stiffness: float = parameter(1.0, unit="N m/rad^3")
    offset: float = parameter(0.0, unit="rad", lower=-1.0)
    order: int = 3  # chosen, not fitted

    def force(self, position, speed, voltage):
        return -self.stiffness * (position - self.offset) ** self.order

    @classmethod
    def probes(cls, scale):
        return cls.given


SCALE = Scale(voltage=5.0, speed=3.0, position=0.3, torque=0.1)


@pytest.mark.parametrize(
    ("probes", "said"),
    [
        ([[{"stiffness": 0.1}]], "A probe of Power lacks offset, but needs .* stiffness, offset"),
        ([[{"stiffness": 0.1, "offset": 0.0, "width": 1.0}]], "has width too"),
        ([{"stiffness": 0.1, "offset": 0.0}], "list of shapes, each a list"),
        ([["stiffness"]], "must name its parameters"),
        ([[{"stiffness": "large", "offset": 0.0}]], "stiffness='large', but needs a finite number"),
        ([[{"stiffness": np.nan, "offset": 0.0}]], "finite number"),
    ],
)
def test_a_wrong_probe_is_told_in_a_sentence(probes, said, monkeypatch) -> None:
    monkeypatch.setattr(Power, "given", probes)
    with pytest.raises(InputError, match=said):
        Power.probe_values(SCALE)
    # The search makes the same check.
    monkeypatch.setitem(CATALOG, Power.name, Power)
    scales = dict.fromkeys(("hub", "arm", "joint"), SCALE)
    with pytest.raises(InputError, match=said):
        build(rf.joints.paper(), [(Power, "joint")], scales)


@pytest.mark.parametrize("declared", ["amplitudes", "vanishes_with"])
def test_a_name_that_is_no_parameter_is_refused(declared, monkeypatch) -> None:
    """A comma is easily forgotten in a tuple of one name, which then is a text of letters."""
    monkeypatch.setattr(Power, declared, ("stifness"))
    with pytest.raises(InputError, match=r"Power has 's', 't', .* parameters are stiffness, offset; .*,\)"):
        Power.probe_values(SCALE)


def test_a_right_probe_is_taken_and_whole_numbers_are_numbers() -> None:
    assert Power.probe_values(SCALE) == (((1.0, 0.0),),)


def test_a_whole_number_that_is_chosen_is_a_plain_field(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(CATALOG, Power.name, Power)
    model = rf.Model(rf.joints.paper() + Power(at="joint", stiffness=40.0, order=5))
    assert "joint.test_power.order" not in model.mechanism.parameter_names
    model.save(tmp_path / "model.json")
    assert rf.Model.load(tmp_path / "model.json") == model
    assert Power(at="joint", order=5).force(2.0, 0.0, 0.0) == -32.0


# Sensors


def test_a_sensor_that_is_not_read_is_said_and_the_cure_works(run, tmp_path, monkeypatch) -> None:  # noqa: F811
    file, searched = tmp_path / "run.csv", []
    speed = np.gradient(THETA, T)
    frame(alpha=None, speed=speed).to_csv(file, index=False)

    def kept(joint, train, validation, **options):
        searched.append((joint.mechanism if hasattr(joint, "mechanism") else joint, train[0]))
        raise InputError("That is enough for this test; stop here.")

    monkeypatch.setattr(rf, "discover", kept)
    _, _, err = run("discover", file)
    assert err.startswith("Look at run.csv: The file has 'speed' too, but theta is the only output") and (
        err.count("run.csv") == 1
    )
    assert "--joint paper:sensors=theta+speed" in err and searched[0][0].channels == ("theta",)
    _, _, err = run("discover", file, "--joint", "paper:sensors=theta+speed")
    assert "only output" not in err and searched[1][0].channels == ("theta", "speed")
    assert searched[1][1].units == ("rad", "rad/s") and np.allclose(searched[1][1].y[:, 1], speed[:2100])
    # Nothing is left out where both angles are read, or where the file has no other sensor.
    for table in (frame(speed=speed), frame(alpha=None)):
        found = rf.load(table, outputs=None if "alpha" in table else "theta")
        assert not [x for x in found.findings if x.kind == "unused"]


# MATLAB and spreadsheets


def test_simulinks_structure_with_time_is_listed_to_its_leaves(tmp_path) -> None:
    signals = np.zeros(3, dtype=[("values", object), ("label", object), ("dimensions", object)])
    for k, (values, label) in enumerate(((U, "u"), (THETA, "theta"), (ALPHA, "alpha"))):
        signals[k] = (values[:, None], label, 1.0)
    scipy.io.savemat(
        tmp_path / "run.mat", {"out": {"time": T, "signals": signals, "blockName": "bench/Scope"}}
    )
    outputs = ("out.signals[1].values", "out.signals[2].values")
    found = rf.load(tmp_path / "run.mat", time="out.time", input="out.signals[0].values", outputs=outputs)
    assert np.allclose(found.y, RECORDING.y)
    with pytest.raises(InputError, match=r"out\.time, out\.signals\[0\]\.values, out\.signals\[1\]\.values"):
        rf.load(tmp_path / "run.mat")


def test_cells_of_signals_are_listed_too(tmp_path) -> None:
    cells = np.empty(2, dtype=object)
    cells[:] = [THETA, ALPHA]
    scipy.io.savemat(tmp_path / "run.mat", {"t": T, "voltage": U, "y": cells})
    assert np.allclose(rf.load(tmp_path / "run.mat", outputs=("y[0]", "y[1]")).y, RECORDING.y)


def test_objects_that_only_matlab_reads_are_named(measured) -> None:
    # A measured file has an object of class string among its matrices.
    from rotflex_jax.data.datasets import fetch

    measured("rotflex")
    with pytest.raises(InputError, match=r"it has .*data_vm\[1\], .*; control_mode \(a MATLAB string"):
        rf.load(fetch("rotflex")[0])


def test_a_spreadsheet_is_read(run, tmp_path) -> None:  # noqa: F811
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.append(["Time [ms]", "Voltage [V]", "Theta [deg]", "Alpha [deg]"])
    for row in zip(1e3 * T, U, np.rad2deg(THETA), np.rad2deg(ALPHA), strict=True):
        sheet.append([float(x) for x in row])
    book.save(tmp_path / "run.xlsx")
    found = rf.load(tmp_path / "run.xlsx")
    assert np.allclose(found.y, RECORDING.y)
    assert found.source == "run.xlsx, sheet Sheet"
    sheet.cell(row=12, column=3, value="n/a")
    book.save(tmp_path / "bad.xlsx")
    with pytest.raises(InputError, match=r"'Theta .deg.' holds 'n/a' at row 12"):
        rf.load(tmp_path / "bad.xlsx")
    (tmp_path / "broken.xlsx").write_bytes((tmp_path / "run.xlsx").read_bytes()[:2000])
    with pytest.raises(InputError, match="cannot be read as a spreadsheet"):
        rf.load(tmp_path / "broken.xlsx")
    with pytest.raises(InputError, match="more than the"):
        rf.load(tmp_path / "run.xlsx", max_bytes=50_000)


def test_a_spreadsheet_without_its_package_says_which(tmp_path, monkeypatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "openpyxl", None)
    (tmp_path / "run.xlsx").write_bytes(b"PK")
    with pytest.raises(InputError, match="needs the package openpyxl"):
        rf.load(tmp_path / "run.xlsx")


def test_degrees_are_converted_and_other_units_are_kept(tmp_path) -> None:
    rows = np.column_stack([np.arange(60) * 0.01, np.sin(np.arange(60)), 100 * np.cos(np.arange(60))])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header="t [s],u [V],w", comments="")
    told = {"time": "t", "input": "u", "outputs": {"w": "w"}}
    for unit, kept, factor in (("deg/s", "rad/s", np.pi / 180), ("rad/s", "rad/s", 1.0), ("mm", "mm", 1.0)):
        found = rf.load(tmp_path / "a.csv", **told, units={"w": unit})
        np.testing.assert_allclose(found.y[:, 0], factor * rows[:, 2])
        assert found.units == (kept,)
    with pytest.raises(InputError, match="was to be converted to rad"):
        rf.load(tmp_path / "a.csv", **told, units={"w": "mm"}, degrees=True)


def test_one_angle_in_degrees_and_one_in_radians(run, tmp_path) -> None:  # noqa: F811
    mixed = frame(theta=None, alpha=None, servo_deg=np.rad2deg(THETA), arm_rad=ALPHA)
    names = ("servo_deg", "arm_rad")
    assert np.allclose(rf.load(mixed, outputs=names).y, RECORDING.y)
    plain = mixed.rename(columns={"servo_deg": "servo", "arm_rad": "arm"})
    assert np.allclose(rf.load(plain, outputs=("servo", "arm"), units={"theta": "deg"}).y, RECORDING.y)
    below = frame(theta=np.rad2deg(THETA)).astype(object)
    below.loc[-1] = ["ms", "V", "deg", "rad"]
    below = below.sort_index()
    below.loc[0:, "t"] = 1e3 * T
    below.to_csv(tmp_path / "units.csv", index=False)
    found = rf.load(tmp_path / "units.csv")
    assert np.allclose(found.y, RECORDING.y) and found.Ts == pytest.approx(RECORDING.Ts)
    mixed.to_csv(tmp_path / "mixed.csv", index=False)
    plain.to_csv(tmp_path / "plain.csv", index=False)
    both = ("--output", "servo_deg", "--output", "arm_rad")
    assert run("check", tmp_path / "mixed.csv", *both)[0] == 0
    status, _, err = run("check", tmp_path / "mixed.csv", *both, "--degrees")
    assert status == 2
    assert_one_sentence(err, "'arm_rad' is in rad by its name", "leave --degrees out", "theta [deg]=COLUMN")
    told = ("--output", "theta [deg]=servo", "--output", "alpha=arm")
    status, out, err = run("check", tmp_path / "plain.csv", *told)
    assert status == 0, err
    by_name = run("check", tmp_path / "mixed.csv", *both)[1].replace("mixed.csv", "plain.csv")
    note = "note: Column 'servo_deg' was converted from degrees because of its name.\n"
    assert note in by_name and out == by_name.replace(note, "")
    late = rf.load(plain.rename(columns={"t": "t_ms"}).assign(t_ms=1e3 * T), time="t_ms", outputs="arm")
    assert [str(f) for f in late.remarks if f.kind == "converted"] == [
        "The time 't_ms' was converted from ms because of its name."
    ]
    strange = ("--output", "theta [gon]=servo", "--output", "alpha=arm")
    status, _, err = run("check", tmp_path / "plain.csv", *strange)
    assert status == 2
    assert_one_sentence(err, "'theta' is in gon, but that of the model is in rad")
    twice = ("--output", "theta=servo", "--output", "theta=arm")
    status, _, err = run("check", tmp_path / "plain.csv", *twice)
    assert status == 2
    assert_one_sentence(err, "the channel 'theta' for 'servo' and for 'arm'")


def test_a_unit_at_the_end_of_a_name_in_capitals_is_read() -> None:
    table = pd.DataFrame(
        {"timeMs": 1e3 * T, "voltage": U, "servoDeg": np.rad2deg(THETA), "armRad": RECORDING.y[:, 1]}
    )
    found = rf.load(table, time="timeMs", outputs=("servoDeg", "armRad"))
    assert np.allclose(found.y, RECORDING.y) and found.Ts == pytest.approx(RECORDING.Ts)
    assert [str(f) for f in found.remarks if f.kind == "converted"] == [
        "Column 'servoDeg' was converted from degrees because of its name.",
        "The time 'timeMs' was converted from ms because of its name.",
    ]
    with pytest.raises(rf.InputError, match="'servoDeg' is in deg by its name, but was given in rad"):
        rf.load(table, time="timeMs", outputs=("servoDeg", "armRad"), units={"theta": "rad"})


def test_columns_are_found_by_names_that_end_with_a_unit(run, tmp_path) -> None:  # noqa: F811
    alpha = RECORDING.y[:, 1]
    plain = pd.DataFrame({"t_ms": 1e3 * T, "voltage_V": U, "theta_deg": np.rad2deg(THETA), "alphaRad": alpha})
    found = rf.load(plain)
    assert np.allclose(found.y, RECORDING.y) and found.Ts == pytest.approx(RECORDING.Ts)
    assert [str(f) for f in found.remarks if f.kind == "converted"] == [
        "Column 'theta_deg' was converted from degrees because of its name.",
        "The time 't_ms' was converted from ms because of its name.",
    ]
    # The name itself comes first; two columns that differ in the unit alone leave it open which is meant.
    exact = rf.load(plain.assign(theta=2.0 * THETA))
    assert np.allclose(exact.y[:, 0], 2.0 * THETA)
    with pytest.raises(InputError, match=r"has no column 'theta'; it has .*theta_deg, alphaRad, theta_rad"):
        rf.load(plain.assign(theta_rad=THETA))
    for rival in ("theta_counts", "theta_mm", "theta_V"):
        with pytest.raises(InputError, match="has no column 'theta'; it has"):
            rf.load(plain.assign(**{rival: THETA}))
    with pytest.raises(
        InputError, match="'theta_deg' is in deg by its name, but counts=4096 of one turn were"
    ):
        rf.load(plain, counts={"theta": 4096})
    # With a given period or accepted units the end of a name does not make a column the time.
    steady = rf.load(plain.rename(columns={"t_ms": "t_s"}).assign(t_s=RECORDING.Ts), Ts=RECORDING.Ts)
    assert np.allclose(steady.y, RECORDING.y)
    with pytest.raises(InputError, match="has no column 't'"):
        rf.load(plain, accept=("units",))
    # Other ends of names are no units of the quantity, and counts have no size of their own.
    for end in ("V", "counts", "ref", "mrad"):
        with pytest.raises(InputError, match=rf"has no column 'theta'; it has .*theta_{end}"):
            rf.load(plain.rename(columns={"theta_deg": f"theta_{end}"}))
    plain[["t_ms", "voltage_V", "theta_deg"]].to_csv(tmp_path / "run.csv", index=False)
    status, _, err = run("check", tmp_path / "run.csv")
    assert status == 0 and "not read" not in err, err


def test_a_model_in_radians_takes_no_recording_in_degrees() -> None:
    recording = rf.Recording(
        RECORDING.u, RECORDING.y, RECORDING.Ts, channels=RECORDING.channels, units=("deg", "rad")
    )
    with pytest.raises(InputError, match=r"'theta' .* in deg, but the output theta of the model is in rad"):
        rf.Model(rf.joints.paper()).simulate(recording)


def test_the_voltage_is_not_read_as_the_goal_of_a_servo(run, tmp_path) -> None:  # noqa: F811
    servo = ("--joint", "position_servo", "--output", "theta")
    for header, given in (("voltage", ()), ("Voltage [V]", ("--input", "Voltage [V]"))):
        frame().rename(columns={"voltage": header}).to_csv(tmp_path / "run.csv", index=False)
        status, _, err = run("check", tmp_path / "run.csv", *servo, *given)
        assert status == 2
        assert_one_sentence(err, "in V", "in rad", "--input")


def test_a_deflection_is_not_made_relative_twice(run, tmp_path) -> None:  # noqa: F811
    frame().to_csv(tmp_path / "run.csv", index=False)
    with pytest.raises(InputError, match="leave arm_absolute=True out"):
        rf.load(tmp_path / "run.csv", arm_absolute=True)
    status, _, err = run("check", tmp_path / "run.csv", "--arm-absolute")
    assert status == 2
    assert_one_sentence(err, "held the deflection already", "leave --arm-absolute out")
    assert rf.load(tmp_path / "run.csv", arm_absolute=True, accept="absolute").N == RECORDING.N


def test_one_model_is_given_once(run, tmp_path) -> None:  # noqa: F811
    frame().to_csv(tmp_path / "run.csv", index=False)
    saved = rf.Model(rf.joints.paper()).save(tmp_path / "A_model.json")
    for command in ("check", "simulate", "discover", "compare"):
        status, _, err = run(command, tmp_path / "run.csv", "--model", saved, "--joint", "paper")
        assert status == 2
        assert_one_sentence(err, "A_model.json and paper were given")
    assert run("check", tmp_path / "run.csv", "--joint", "paper", "--model", "paper")[0] == 0


def test_findings_name_options_of_the_command_line(run, tmp_path) -> None:  # noqa: F811
    frame(t=None).to_csv(tmp_path / "run.csv", index=False)
    status, out, err = run("check", tmp_path / "run.csv", "--Ts", 4, "--accept", "slow", "--accept", "units")
    assert status == 0, err
    assert "warning: The sampling period is 4 s" in out and "pass --Ts 0.004, or --accept slow" in out


def test_messages_name_the_fault_and_options_of_the_command_line(run, tmp_path) -> None:  # noqa: F811
    file, counted = tmp_path / "run.csv", tmp_path / "counted.csv"
    frame().to_csv(file, index=False)
    frame(theta=np.round(651.9 * THETA), alpha=np.round(651.9 * ALPHA)).to_csv(counted, index=False)
    found = tmp_path / "result.json"
    found.write_text(json.dumps({"schema": 1, "verdict": "found", "baseline": {}, "rounds": [{"a": 1}]}))
    for line, words in (
        (("check", file, "--output", "gamma=alpha"), ("--output theta=COLUMN",)),
        (("check", file, "--Ts", 0.004), ("leave --Ts 0.004 out",)),
        (("check", counted, "--counts", 4096, "--degrees"), ("--counts 4096 and --degrees",)),
        (("discover", file, "--save-model"), ("rotflex discover --help",)),
        (("simulate", file, "--model", found), ("is the result of a search", "`--save-model`")),
        (("check", found), ("is the result of a search, not a recording",)),
        (
            ("check", file, "--output", "theta=alpha", "--output", "alpha=alpha"),
            ("has one column, 'alpha', for two channels",),
        ),
    ):
        status, _, err = run(*line)
        assert status == 2, line
        assert_one_sentence(err, *words)
    frame(alpha=-ALPHA).to_csv(file, index=False)
    status, _, err = run("check", file)
    assert status == 2
    assert_one_sentence(err, "starting values nearer to the machine, such as --joint paper:stiffness=1.2.")


def test_a_table_is_no_recording() -> None:
    with pytest.raises(InputError, match="is a DataFrame; read a file"):
        rf.fit(rf.joints.paper(), frame())


def test_two_files_with_one_channel_are_not_one_recording(tmp_path) -> None:
    for name in "AB":
        frame().to_csv(tmp_path / f"{name}.csv", index=False)
    with pytest.raises(InputError, match=r"A\.csv and B\.csv both have the channel 'voltage'"):
        rf.load(tmp_path)


def test_nan_and_an_empty_cell_have_one_remedy(tmp_path) -> None:
    cure = "cut the recording there (docs/load_data.md shows how), since nothing is filled in"
    hole = frame()
    hole.loc[700, "alpha"] = np.nan
    for word in ("nan", ""):
        hole.to_csv(tmp_path / "run.csv", index=False, na_rep=word)
        with pytest.raises(InputError, match=re.escape(cure)):
            rf.load(tmp_path / "run.csv")


def test_signals_come_first_in_the_list_of_columns(tmp_path) -> None:
    settings = {f"setting_{k}": np.arange(3.0) for k in range(25)}
    np.savez(tmp_path / "run.npz", **settings, u=U, servo=THETA)
    with pytest.raises(InputError, match=r"it has u, servo, setting_0, .* and 7 more"):
        rf.load(tmp_path / "run.npz", Ts=RECORDING.Ts)
