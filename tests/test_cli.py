"""The command line: accepted and refused arguments, error messages, and output."""

import dataclasses
import functools
import hashlib
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.cli import app, main, terminal
from rotflex_jax.cli.arguments import check_writable
from rotflex_jax.data.datasets import DATASETS
from rotflex_jax.discover.result import RunErrors
from rotflex_jax.discover.verdict import Verdict, assess
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Estimate
from rotflex_jax.runtime import xla
from rotflex_jax.text.numbers import digits

NAMES = ("t", "voltage", "theta", "alpha")
DEMO_WHOLE = np.loadtxt(
    files("rotflex_jax.data").joinpath("demo.csv").read_text().splitlines(), delimiter=",", skiprows=1
)
DEMO = DEMO_WHOLE[:600]
IN_THE_ROOM = np.eye(4)  # absolute angle of the arm instead of its deflection
IN_THE_ROOM[2, 3] = 1.0
WAVE = np.sin(np.arange(len(DEMO)) / 50)
# Environment in which a separate process finds the package from any folder.
HERE = os.environ | {"PYTHONPATH": str(Path(rf.__path__[0]).parent)}


@pytest.fixture(autouse=True)
def no_global_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Settings that the program makes for its process must not affect other tests."""
    monkeypatch.setattr(xla, "enable_fast_loops", lambda: True)
    monkeypatch.setattr(xla, "enable_compilation_cache", lambda: None)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run the command line in this process: exit status, stdout, stderr."""

    def run(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as left:
            app.main([str(argument) for argument in arguments])
        assert isinstance(left.value.code, int)
        return left.value.code, *capsys.readouterr()

    return run


def write(file: Path, table: np.ndarray = DEMO, names: Sequence[str] = NAMES) -> Path:
    np.savetxt(file, table, delimiter=",", header=",".join(names), comments="", fmt="%.9g")
    return file


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    return write(tmp_path / "run.csv")


def put(table: np.ndarray, column: int, value: float) -> np.ndarray:
    table[50, column] = value
    return table


# Fault -> function that adds it to the table, and a word that the message must contain.
SPOILT: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "a value that is not a number": (lambda x: put(x, 2, np.nan), "theta"),
    "an infinite voltage": (lambda x: put(x, 1, np.inf), "voltage"),
    "a gap in time": (lambda x: np.delete(x, slice(100, 140), axis=0), "sampl"),
    "jitter": (
        lambda x: x + np.random.default_rng(0).uniform(-4e-4, 4e-4, len(x))[:, None] * [1, 0, 0, 0],
        "sampl",
    ),
    "time running backwards": (lambda x: x[::-1] * [1, 1, 1, 1], "time"),
    "too few samples": (lambda x: x[:20], "20"),
    "no samples": (lambda x: x[:0], ""),
    "a constant input": (lambda x: x * [1, 0, 1, 1], "voltage"),
    "a constant channel": (lambda x: x * [1, 1, 1, 0], "alpha"),
    "a saturated sensor": (
        lambda x: np.c_[x[:, 0], WAVE, np.minimum(WAVE, 0.7), 0.1 * WAVE],
        "saturated",
    ),
}


@pytest.mark.parametrize("fault", SPOILT)
def test_bad_recordings_are_refused_with_one_sentence(fault, run, tmp_path) -> None:
    spoil, word = SPOILT[fault]
    bad = write(tmp_path / "bad.csv", spoil(DEMO.copy()))
    status, out, err = run("discover", bad)
    assert (status, out) == (2, "")
    assert_one_sentence(err, word)


def assert_one_sentence(err: str, *words: str) -> None:
    assert err.startswith("rotflex: ")
    assert err.count("\n") == 1
    assert err.rstrip()[-1] in ".?"
    assert "Traceback" not in err
    for word in words:
        assert word.lower() in err.lower()


# Command line, {run} for a good recording and {tmp} for a folder -> words of the message.
REFUSED = {
    "discover": "FILE",
    "discover {tmp}/missing.csv": "does not exist",
    "discover {tmp}": "folder",
    "discover {tmp}/empty.csv": "empty.csv",
    "discover {tmp}/text.csv": "text.csv",
    "discover {tmp}/noise.mat": "noise.mat",
    "discover {tmp}/noise.npz": "noise.npz",
    "discover {tmp}/two_columns.csv": "theta",
    "discover {tmp}/run.xyz": ".xyz",
    "discover {run} --nonsense": "--nonsense",
    "discover {run} --split nonsense": "--split",
    "discover {run} --split 1.5": "between 0 and 1",
    "discover {run} --split 0.6 --held-out {tmp}/other.csv": "--held-out",
    "discover {run} --held-out {run}": "twice",
    "discover {run} {run}": "twice",
    "discover {run} --held-out {tmp}/missing.csv": "missing.csv",
    "discover {run} --joint papre": "paper",
    "discover {run} --joint paper:mass=1": "mass",
    "discover {run} --joint paper:stiffness=soft": "stiffness",
    "discover {run} --joint paper:stiffness=-1": "stiffness",
    "discover {run} --Ts 0.002 --time t": "--Ts",
    "discover {run} --Ts -1": "--Ts",
    "discover {run} --Ts 0.004": "Ts",
    "discover {run} --time clock": "clock",
    "discover {run} --input motor": "motor",
    "discover {run} --output theta --output beta": "beta",
    "discover {run} --output theta --output theta": "--output",
    "discover {tmp}/degrees.csv": "--degrees",
    "discover {tmp}/degrees.csv --output theta_deg --output alpha": "pass --degrees",
    "discover {run} --input theta": "theta",
    "check {run} --signal wind": "has no column 'wind'; it has t, voltage, theta, alpha: name the right one "
    "with --signal",
    "check {run} --signal wind --signal rain": "'wind', 'rain'; it has t, voltage, theta, alpha: name the "
    "right ones with --signal",
    "check {run} --signal wind=gust": "has no column 'gust'",
    "check {run} --signal alpha": "as a signal and as input or output, but it can be only one; correct "
    "--signal",
    "check {run} --output theta --signal alpha --signal Alpha": "--signal must name columns, each once, but "
    'is a list; for other names of signals give for instance "acceleration of the base [m/s^2]=column"',
    "check {run} --signal alpha --signal wind=t": "'alpha' and 'wind=t', but either each signal has a name "
    'or none; name that one too, for instance --signal "alpha=alpha"',
    "check {run} --signal wind=t --signal wind=alpha": "the name 'wind' for 't' and for 'alpha'",
    "check {run} --output theta --signal =alpha": "given the name ''",
    "reproduce --out {tmp}/page --signal wind": "--signal was given",
    "reproduce --out {tmp}/page --substeps 4": "--substeps was given, but",
    "discover {run} --substeps 0": "given 0, but each sample is integrated in one step or more; give for "
    "instance --substeps 4",
    "compare {run} --substeps -2": "given -2, but each sample",
    "simulate {run} --substeps 2.5": "--substeps",
    "discover {run} --accept everything": "everything",
    "discover {run} --json {tmp}/missing/r.json": "missing",
    "discover {run} --json {tmp}": "folder",
    "discover {run} --report {run}": "file",
    "demo --report {run}/page": "cannot be written to",
    "discover {run} --report {run}/page": "page cannot be written to (Not a directory), but the report needs "
    "a folder of its own; name another",
    "compare {run} --report {run}/page": "cannot be written to",
    "simulate {run} --report {run}/page": "cannot be written to",
    "simulate {run} --add colomb@hub": "coulomb",
    "simulate {run} --add coulomb": "hub",
    "simulate {run} --add coulomb@elbow": "elbow",
    "simulate {run} --add coulomb@hub:size=1": "size",
    "simulate {run} --add coulomb@hub:level=much": "level",
    "simulate {run} --add coulomb@hub:level=-1": "level",
    "simulate {run} --add coulomb@hub:level": "level",
    "simulate {run} --add coulomb@hub --add coulomb@hub": "coulomb",
    "simulate {run} --fit {run}": "twice",
    "simulate {run} --save {tmp}/missing/s.csv": "missing",
    "simulate {run} --save {run}": "would be written over {run}, which this command reads",
    "simulate {run} --save-model {tmp}/../{tmp.name}/run.csv": "would be written over",
    "simulate {run} --fit {tmp}/other.csv --save {tmp}/other.csv": "other.csv, which this command reads",
    "simulate {run} --save {tmp}/a --save-model {tmp}/a": "reads or writes already",
    "discover {run} --json {run}": "would be written over",
    "discover {run} --held-out {tmp}/other.csv --save-model {tmp}/other.csv": "would be written over",
    "discover {run} --each --json {run}": "would be written over",
    "compare {run} --json {run}": "would be written over",
    "reproduce --data {run} --json {run}": "would be written over",
    "experiment --fit {run} --between delay@input lag@input --voltage 6 --save {run}": "be written over",
    "export {tmp}/a.json --to text --out {tmp}/a.json": "would be written over",
    "arena {tmp}/a.py:f --json {tmp}/a.py": "would be written over",
    "simulate {run} --save -": "only --json goes to stdout",
    "discover {run} --save-model -": "only --json goes to stdout",
    "arena {tmp}/a.py:f --report -": "only --json goes to stdout",
    "export paper --to text --Ts 0.002": "--Ts was given, but text has no use of it; leave it out",
    "export paper --to statespace --prefix a": "--prefix was given, but statespace has",
    "export paper --to text --length 0.1": "--length was given",
    "export paper --to c --Ts 0.002 --actuator a": "--actuator was given",
    "data fetch nothing_of_this_name": "nothing_of_this_name",
    "data fetch": "NAME",
    "dicsover {run}": "dicsover",
}


@pytest.mark.parametrize("line", REFUSED)
def test_bad_arguments_are_refused_with_one_sentence(line, run, recorded, tmp_path) -> None:
    write(tmp_path / "other.csv", DEMO[:300])
    write(tmp_path / "run.xyz")
    write(tmp_path / "two_columns.csv", DEMO[:, :2], NAMES[:2])
    degrees = DEMO * [1, 1, 180 / np.pi, 180 / np.pi]
    write(tmp_path / "degrees.csv", np.c_[degrees, degrees[:, 2]], (*NAMES, "theta_deg"))
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "text.csv").write_text("t,voltage,theta,alpha\n" + "a,b,c,d\n" * 100)
    for name in ("noise.mat", "noise.npz"):
        (tmp_path / name).write_bytes(np.random.default_rng(0).bytes(500))
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    status, out, err = run(*line.format(run=recorded, tmp=tmp_path).split())
    assert (status, out) == (2, "")
    assert_one_sentence(err, REFUSED[line].format(run=recorded))
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_folder_for_a_report_is_tried_and_left_as_it_was(tmp_path, monkeypatch) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "report.html").write_text("<html>")
    for folder in ("old", "new", "several/new/ones"):
        check_writable(folder=tmp_path / folder)
    assert [path.name for path in tmp_path.rglob("*")] == ["old", "report.html"]

    def full(dir: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.TemporaryFile", full)
    for folder in ("old", "several/new/ones"):
        with pytest.raises(rf.InputError, match=r"No space left on device.*name another"):
            check_writable(folder=tmp_path / folder)
    assert [path.name for path in tmp_path.rglob("*")] == ["old", "report.html"]


def test_bad_input_in_a_process_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "bad.csv").write_text("t,voltage\n0,1\n")
    left = subprocess.run(
        [sys.executable, "-m", "rotflex_jax", "discover", "bad.csv"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=HERE,
        check=False,
    )
    assert (left.returncode, left.stdout) == (2, "")
    assert_one_sentence(left.stderr)


def test_version(run) -> None:
    assert run("--version") == (0, f"{rf.__version__}\n", "")


@pytest.mark.parametrize("line", ["", "--help", "discover --help", "data", "data --help"])
def test_help_is_no_error(line, run) -> None:
    status, out, err = run(*line.split())
    assert (status, err) == (0, "")
    assert "Usage" in out


def test_effects_as_json(run) -> None:
    status, out, err = run("effects", "--json")
    assert (status, err) == (0, "")
    described = json.loads(out)
    assert described["schema"] == 1
    assert {effect["name"] for effect in described["effects"]} == set(rf.effects.CATALOG)
    for effect in described["effects"]:
        assert {"name", "kind", "title", "equation", "ports", "parameters"} <= set(effect)
        assert effect["ports"]
        for parameter in effect["parameters"].values():
            assert {"unit", "typical", "meaning"} <= set(parameter)


def test_effects_for_people(run) -> None:
    status, out, _ = run("effects")
    assert status == 0
    assert all(name in out for name in rf.effects.CATALOG)
    assert "level [N m]" in out


def test_data_list_names_every_recording(run) -> None:
    status, out, _ = run("data", "list")
    assert status == 0
    assert all(name in out for name in DATASETS)


def test_data_fetch_prints_paths_and_checks_the_content(run, tmp_path, monkeypatch) -> None:
    file = DATASETS["silverbox"].files[0]
    there = tmp_path / file.name
    there.parent.mkdir()
    there.write_bytes(b"not what was published")
    monkeypatch.setenv("ROTFLEX_DATA", str(tmp_path))
    status, out, err = run("data", "fetch", "silverbox")
    assert (status, out) == (2, "")
    assert_one_sentence(err.splitlines(keepends=True)[-1], "SHA-256")
    known = dataclasses.replace(
        DATASETS["silverbox"],
        files=(dataclasses.replace(file, sha256=hashlib.sha256(there.read_bytes()).hexdigest()),),
    )
    monkeypatch.setitem(DATASETS, "silverbox", known)
    status, out, _ = run("data", "fetch", "silverbox")
    assert (status, out.strip()) == (0, str(there))


def test_simulate_tells_errors_and_saves(run, recorded, tmp_path) -> None:
    saved = tmp_path / "simulated.csv"
    status, out, _ = run("simulate", recorded, "--add", "coulomb@hub:level=0.03", "--save", saved)
    assert status == 0
    assert "theta [deg]" in out
    header, *rows = saved.read_text().splitlines()
    assert header == "t,voltage,theta,alpha,theta_simulated,alpha_simulated"
    slide = write(tmp_path / "slide.csv", DEMO[:, :3], ("t", "force [N]", "x [m]"))
    moved = rf.load(slide, input="force", outputs={"x": "x [m]"}, units={"x": "m"})
    terminal.save_simulation(tmp_path / "moved.csv", moved, {"x": moved.y[:, 0]})
    header = (tmp_path / "moved.csv").read_text().splitlines()[0]
    assert header == "t,force [N],x [m],x_simulated [m]"  # in other units than a reader would assume
    table = np.array([row.split(",") for row in rows], dtype=float)
    np.testing.assert_allclose(table[:, :4], DEMO, atol=1e-8)
    recording = rf.load(recorded)
    mechanism = rf.joints.paper() + rf.effects.Coulomb(at="hub", level=0.03)
    y_hat = Model(mechanism).simulate(recording)
    np.testing.assert_allclose(table[:, 4:], y_hat, atol=1e-6)
    degrees = np.rad2deg(rf.metrics.rmse(recording.y, y_hat, recording.n_init))
    assert all(digits(value) in out for value in degrees)
    theta, alpha = rf.metrics.fit_percent(recording.y, y_hat, recording.n_init)
    assert f"Fit, where 100 % is perfect: theta {theta:.1f} %, alpha {alpha:.1f} %" in out


def test_check_goes_on_after_a_file_that_is_refused(run, recorded, tmp_path) -> None:
    """Each file has its lines, in the order given; the last sentence names those that were refused."""
    turned = write(tmp_path / "turned.csv", DEMO * [1, 1, 1, -1])
    missing = tmp_path / "missing.csv"
    status, out, err = run("check", turned, missing, recorded)
    assert status == 2
    assert_one_sentence(err, "2 of 3 files were refused", f"{turned}, {missing};")
    first, second = (line for line in out.splitlines() if line.startswith("error: "))
    assert "negate the column of alpha" in first and f"{missing} does not exist" in second
    assert out.endswith("The signs of theta and alpha do not contradict paper.\n")


def test_check_lists_columns_that_are_not_read_beside_a_single_sensor(run, tmp_path) -> None:
    """The options in the note read both sensors. The note is no part of a result that is printed."""
    file = write(tmp_path / "tip.csv", DEMO, ("t", "voltage", "Theta [rad]", "tip angle"))
    _, out, err = run("check", file)
    (note,) = err.splitlines()
    assert "not read" not in out
    assert "'Theta [rad]'; not read: 'tip angle'." in note
    named = shlex.split(note.partition("such as ")[2].rstrip("."))
    status, out, err = run("check", file, *named)
    assert (status, err) == (0, "")
    assert "The signs of theta and alpha do not contradict paper." in out


def test_check_does_not_compare_signs_beside_a_signal(run, tmp_path) -> None:
    """A wrong sign is refused in the same file without the signal."""
    names = (*NAMES, "acc [m/s^2]")
    file = write(tmp_path / "base.csv", np.c_[DEMO * [1, 1, 1, -1], np.sin(DEMO[:, 0])], names)
    assert run("check", file)[0] == 2
    status, out, _ = run("check", file, "--signal", "acc [m/s^2]")
    assert status == 0 and "The signs of theta and alpha were not compared with paper" in out


def test_check_tells_what_is_in_a_file_and_refuses_a_wrong_sign(run, recorded, tmp_path) -> None:
    status, out, err = run("check", recorded)
    assert (status, err) == (0, "")
    assert "600 samples, 1.2 s at 500 Hz" in out
    ends = np.rad2deg([DEMO[:, 2].min(), DEMO[:, 2].max()])
    (row,) = (line.split() for line in out.splitlines() if line.startswith("theta "))
    assert row[:4] == ["theta", "deg", *(digits(end) for end in ends)]
    assert "note: Channel 'theta' is quantised" in out and "note: 1.2 s are little for a search" in out
    assert "The signs of theta and alpha do not contradict paper." in out and "not read" not in out
    status, _, err = run("check", write(tmp_path / "turned.csv", DEMO * [1, 1, 1, -1]))
    assert status == 2
    assert_one_sentence(err, "turned.csv", "negate the column of alpha")
    room = write(tmp_path / "room.csv", DEMO_WHOLE @ IN_THE_ROOM)
    status, out, _ = run("check", room, "--accept", "absolute")
    assert status == 0 and "warning: Channel 'alpha' follows 'theta' one to one" in out
    assert "little for a search" not in out


BASE = "acceleration of the base [m/s^2]"


@pytest.fixture
def pushed(tmp_path: Path) -> Path:
    """A recording with further columns, for signals that act on the machine."""
    more = np.column_stack([DEMO, WAVE, 2 * WAVE, 3 * WAVE])
    return write(tmp_path / "pushed.csv", more, (*NAMES, BASE, "i2", "a=b"))


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ((), {}),
        (("i2",), {"i2": 2}),
        (("Acceleration of the Base", "I2"), {BASE: 1, "i2": 2}),
        (("second motor [A]=i2", f"base = {BASE}"), {"second motor [A]": 2, "base": 1}),
        (("third [N]=a=b",), {"third [N]": 3}),  # a column with "=" in its name needs a name before it
    ],
)
def test_signals_are_read_where_they_are_named(options, found, run, search, pushed) -> None:
    given = [word for text in options for word in ("--signal", text)]
    status, _, err = run("discover", pushed, "--split", 0.5, *given)
    assert status == 0, err
    ((_, *parts),) = search.calls
    for (recording,), wave in zip(parts, (WAVE[:300], WAVE[300:]), strict=True):
        assert list(recording.signals) == list(found)
        for name, factor in found.items():
            np.testing.assert_allclose(recording.signals[name], factor * wave, atol=1e-7)


def test_check_lists_signals_beside_input_and_outputs(run, pushed) -> None:
    status, out, err = run("check", pushed, "--signal", BASE, "--signal", "i2")
    assert (status, err) == (0, "")
    ends = [digits(float(end)) for end in (WAVE.min(), WAVE.max())]
    (row,) = (line for line in out.splitlines() if line.startswith("acceleration of the base "))
    assert row.removeprefix("acceleration of the base").split() == ["m/s²", *ends, "-"]
    assert any(line.split()[:1] == ["i2"] for line in out.splitlines())


def test_a_signal_that_drives_the_model_is_read_by_its_name(run, pushed, recorded, tmp_path) -> None:
    """A signal is read from the column of its name, as outputs are, unless --signal gives another column."""
    pushing = rf.effects.MeasuredDisturbance(at=f"arm: {BASE}", gain=0.02)
    model = Model(rf.joints.paper() + pushing)
    file = model.save(tmp_path / "model.json")
    recording, saved = rf.load(pushed, signals=BASE), tmp_path / "simulated.csv"
    other = recording.with_signals({BASE: 2 * recording.signals[BASE]})
    for given, expected in (((), recording), (("--signal", f"{BASE}=i2"), other)):
        status, _, err = run("simulate", pushed, "--joint", file, "--save", saved, *given)
        assert status == 0, err
        table = np.loadtxt(saved, delimiter=",", skiprows=1)
        np.testing.assert_allclose(table[:, -2:], model.simulate(expected), atol=1e-6)
    for refused, words in (
        (
            (recorded,),
            f"has no column {BASE!r}; it has t, voltage, theta, alpha: name the right one with --signal",
        ),
        (
            (pushed, "--signal", "i2"),
            f"signals that were read are 'i2'; name its column, --signal \"{BASE}=COLUMN\"",
        ),
    ):
        status, out, err = run("simulate", *refused, "--joint", file)
        assert (status, out) == (2, "")
        assert_one_sentence(err, words)


class FakeSearch:
    """Replacement of `rf.discover` in tests of the command line around it."""

    def __init__(self) -> None:
        self.calls: list[tuple] = []

    def __call__(self, joint, train, validation, progress=None, **options) -> SimpleNamespace:
        self.calls.append((joint, train, validation))
        self.options = options
        progress("Fitting the [baseline]")
        rmse = {"theta": 0.1, "alpha": 0.01}
        stage = SimpleNamespace(
            held_out_rmse=rmse,
            held_out_rmse_windows=rmse,
            window_seconds=2.0,
            calibrate_seconds=0.5,
            calibrated=RunErrors(rmse, {"theta": 0.2, "alpha": 0.01}),
            test=None,
            test_calibrated=None,
        )
        level = Estimate("hub.coulomb.level", 0.03, 1e-3, (0.028, 0.032), "N m")
        turn = SimpleNamespace(
            effect="coulomb",
            port="hub",
            sentence="the hub meets friction [N m]",
            equation="tau = -level * sign(speed)",
            parameters={"level": level},
            equivalent=(("stribeck", "hub"),),
            doubt="these recordings cannot distinguish it from stribeck at hub",
            certain="",
            stage=stage,
        )
        return SimpleNamespace(
            stages=(stage, stage),
            test=(),
            verdict=Verdict.FOUND,
            sentence="The rounds explain the record.",
            train=train,
            validation=validation or train,
            baseline=stage,
            rounds=[turn],
            noise_floor={"theta": 5e-4, "alpha": 5e-4},
            notes=("a [note] to read",),
            where=[SimpleNamespace(statement="78 % of the error follows reversals")],
            to_dict=lambda: {"schema": 1, "verdict": "found"},
            report=self.report,
            probabilities=SimpleNamespace(sentence="Most probable: Coulomb friction at hub 93 %."),
            final_fit=None,
            estimates=(level,),
            assessment=assess({"theta": 0.2}, {"theta": 0.1}, {"theta": 5e-4}, 0.0),
        )

    @staticmethod
    def report(folder: Path) -> Path:
        folder.mkdir()
        page = folder / "index.html"
        page.write_text("<html>")
        return page


@pytest.fixture
def search(monkeypatch: pytest.MonkeyPatch) -> FakeSearch:
    fake = FakeSearch()
    monkeypatch.setattr(rf, "discover", fake)
    return fake


@pytest.mark.parametrize(
    ("names", "options", "channels"),
    [
        (("t", "voltage", "theta"), "", ("theta",)),
        (("t", "voltage", "Alpha [rad]"), "", ("alpha",)),
        (("t", "voltage", "speed"), "", ("speed",)),
        (("t", "voltage", "theta"), "--joint quanser_2010:arm=1", ("theta",)),
        (NAMES, "", ("theta", "alpha")),
        (NAMES, "--output theta", ("theta",)),
        (NAMES, "--output alpha=theta", ("alpha",)),
        (NAMES, "--joint paper:sensors=alpha", ("alpha",)),
    ],
)
def test_a_file_with_one_sensor_has_its_joint(
    names, options, channels, run, search, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(terminal, "print_discovery", lambda _: None)
    table = DEMO[:400, [*range(len(names) - 1), 3 if names[-1].lower().startswith("alpha") else 2]]
    file = write(tmp_path / "one.csv", DEMO[:400] if names == NAMES else table, names)
    status, _, err = run("discover", file, *options.split())
    assert status == 0, err
    ((model, train, _),) = search.calls
    assert model.mechanism.channels == channels and train[0].channels == channels


def test_several_files_validate_each_other(run, search, recorded, tmp_path) -> None:
    """Without --split and --held-out, no validation data are passed on; --test is passed on as test data."""
    other, third = (write(tmp_path / name, DEMO[:400]) for name in ("other.csv", "third.csv"))
    status, out, _ = run("discover", recorded, other, "--test", third, "--calibrate", 1)
    assert status == 0
    ((_, train, validation),) = search.calls
    assert [recording.N for recording in train] == [600, 400] and validation == []
    assert [recording.N for recording in search.options["test"]] == [400]
    assert search.options["calibrate_seconds"] == 1.0
    assert "of its own first 0.5 s" in out and "11.5" in out  # 0.2 rad
    status, _, err = run("discover", recorded, other, "--test", other)
    assert status == 2
    assert_one_sentence(err, "other.csv", "given twice")


def test_discover_splits_each_file(run, search, recorded, tmp_path) -> None:
    other = write(tmp_path / "other.csv", DEMO[:400])
    status, out, err = run("discover", recorded, other, "--split", 0.75)
    assert status == 0
    ((_, train, test),) = search.calls
    assert [recording.N for recording in train] == [450, 300]
    assert [recording.N for recording in test] == [150, 100]
    assert "Fitting the [baseline]" in err
    for text in (
        "FOUND",
        "the hub meets friction [N m]",
        "0.0280 .. 0.0320",
        "cannot distinguish it from stribeck at hub",
        "5.73",
        "reversals",
        "a [note] to read",
    ):
        assert text in out


def test_discover_judges_on_held_out_files_and_maps_columns(run, search, tmp_path) -> None:
    table = DEMO * [1, 1, 180 / np.pi, 180 / np.pi]
    names = ("time", "u", "servo", "tip")
    a, b = (write(tmp_path / f"{name}.csv", table, names) for name in "ab")
    line = "--time time --input u --output alpha=tip --output theta=servo --degrees"
    preset = "quanser_2010:spring=3,hub_anchor=A"
    status, *_ = run("discover", a, "--held-out", b, "--joint", preset, *line.split())
    assert status == 0
    ((joint, train, test),) = search.calls
    assert [recording.N for recording in (*train, *test)] == [600, 600]
    for channel, column in (("theta", 2), ("alpha", 3)):
        np.testing.assert_allclose(train[0].channel(channel), DEMO[:, column], atol=1e-7)
    softest = rf.joints.quanser_2010().effect("spring", "joint").values["stiffness"]
    assert joint.mechanism.effect("spring", "joint").values["stiffness"] > softest


def test_discover_writes_json_and_report(run, search, recorded, tmp_path) -> None:
    places = "--json", tmp_path / "r.json", "--report", tmp_path / "page"
    status, out, _ = run("discover", recorded, *places)
    assert status == 0
    assert json.loads((tmp_path / "r.json").read_text()) == {"schema": 1, "verdict": "found"}
    assert (tmp_path / "page" / "index.html").exists()
    assert "index.html" in out


def test_json_on_stdout_stands_alone(run, search, recorded, tmp_path) -> None:
    status, out, err = run("discover", recorded, "--json", "-", "--report", tmp_path / "page")
    assert status == 0
    assert json.loads(out)["verdict"] == "found"
    assert "index.html" in err


FAILURES = {
    "full disk": (OSError(28, "No space left on device"), "No space left on device"),
    "defect": (TypeError("Object of type bool is\nnot JSON serializable"), "TypeError: Object of type bool"),
    "bad folder": (rf.InputError("page cannot hold the report; name another folder."), "name another folder"),
}


@pytest.mark.parametrize("command", ["demo", "discover", "compare"])
@pytest.mark.parametrize("fault", FAILURES)
def test_a_report_that_fails_costs_no_result(
    fault, command, run, search, recorded, tmp_path, monkeypatch
) -> None:
    error, words = FAILURES[fault]
    out, kept = tmp_path / "r.json", tmp_path / "model.json"

    def broken(folder: Path) -> Path:
        assert json.loads(out.read_text())["verdict"] == "found"  # written before the report
        raise error

    def searched(*given, progress, **options) -> SimpleNamespace:
        result = FakeSearch()("paper", [], [], progress) if command == "compare" else search(*given, progress)
        save = lambda path: path.write_text("{}")  # noqa: E731
        return SimpleNamespace(**vars(result) | {"report": broken, "save": save})

    monkeypatch.setattr(rf, "compare" if command == "compare" else "discover", searched)
    monkeypatch.setattr(terminal, "print_comparison", lambda result: print(result.sentence))
    line = [command] if command == "demo" else [command, recorded]
    line += ["--save-model", kept] if command == "discover" else []
    status, told, err = run(*line, "--json", out, "--report", tmp_path / "page")
    assert status == 2
    assert "The rounds explain the record." in told and out.exists()
    assert kept.exists() == (command == "discover")
    assert_one_sentence("".join(err.splitlines(keepends=True)[-1:]), "report could not be written", words)
    assert "Traceback" not in err


def test_the_user_is_told_what_to_look_at(run, search, tmp_path) -> None:
    doubtful = write(tmp_path / "degrees.csv", DEMO * [1, 1, 180 / np.pi, 180 / np.pi])
    status, _, err = run("discover", doubtful, "--accept", "units")
    assert status == 0
    assert "looks like degrees" in err


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (None, f"--xla_backend_extra_options={xla._OPTION}=2097152"),
        ("--xla_a=1", f"--xla_a=1 --xla_backend_extra_options={xla._OPTION}=2097152"),
        (f"--xla_backend_extra_options={xla._OPTION}=7",) * 2,
        ("flags.txt",) * 2,
    ],
)
def test_fast_loops_keep_the_users_flags(before, after, monkeypatch) -> None:
    monkeypatch.undo()
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    if before is not None:
        monkeypatch.setenv("XLA_FLAGS", before)
    assert xla.enable_fast_loops() is (before != "flags.txt")
    assert os.environ["XLA_FLAGS"] == after


def test_compilation_cache_is_filled_and_spares_a_folder_that_was_chosen(tmp_path: Path) -> None:
    program = """
import sys
from rotflex_jax.runtime.xla import enable_compilation_cache
print(enable_compilation_cache(sys.argv[1]))
import jax
jax.jit(lambda x: x + 1)(1.0)
print(enable_compilation_cache())
"""
    left = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "c")],
        capture_output=True,
        text=True,
        env={name: value for name, value in HERE.items() if not name.startswith("JAX_")},
        check=True,
    )
    assert left.stdout.split() == [str(tmp_path / "c")] * 2
    assert any((tmp_path / "c").iterdir())


@pytest.mark.slow
def test_discover_on_the_demo_recording(run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command with a real search, but two candidates only; all candidates are tested elsewhere."""
    pairs = [(rf.effects.Coulomb, "hub"), (rf.effects.CubicSpring, "joint")]
    monkeypatch.setattr(rf, "discover", functools.partial(rf.discover, candidates=pairs, rounds=1))
    status, out, err = run("discover", write(tmp_path / "demo.csv", DEMO_WHOLE[:2000]), "--json", "-")
    assert status == 0, err
    found = json.loads(out, parse_constant=pytest.fail)
    assert found["schema"] == 1
    (turn,) = found["rounds"]
    assert (turn["effect"], turn["port"]) in {(effect.name, port) for effect, port in pairs}
    assert turn["held_out_rmse_windows"]["theta"] < found["baseline"]["held_out_rmse_windows"]["theta"]
    assert "Traceback" not in err


@pytest.mark.parametrize(("chosen", "expected"), [(None, "3"), ("0", "0")])
def test_remarks_of_the_compiler_do_not_reach_the_terminal(
    chosen: str | None, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["rotflex", "--version"])
    monkeypatch.setattr("rotflex_jax.cli.stopping.STOP.listen", lambda: None)
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", chosen or "")  # restored afterwards
    if chosen is None:
        del os.environ["TF_CPP_MIN_LOG_LEVEL"]
    with pytest.raises(SystemExit):
        main()
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == expected
