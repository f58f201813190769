"""Kinds of bad input: each is refused with one sentence that names the fault."""

import pickle
import re
import sys
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io

from rotflex_jax import Model, fit, joints
from rotflex_jax.data import load
from rotflex_jax.data.excitation import noise
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording

N = 200
GOOD: dict[str, Any] = {
    "t": 0.002 * np.arange(N),
    "voltage": noise(N, 0.002, seed=8),
    "theta": 0.3 * np.sin(np.arange(N) / 20),
    "alpha": 0.1 * np.cos(np.arange(N) / 7),
}


def changed(**columns: Any) -> dict[str, Any]:
    """The good columns, some of them removed (None), changed at one sample (index, value) or replaced."""
    run = {name: values.copy() for name, values in GOOD.items()}
    for name, value in columns.items():
        if value is None:
            del run[name]
        elif isinstance(value, tuple):
            run[name] = run[name].astype(object if isinstance(value[1], str) else float)
            run[name][value[0]] = value[1]
        else:
            run[name] = value
    return run


def text(edit: Callable[[list[str]], list[str]] = lambda lines: lines, **columns: Any) -> bytes:
    lines = pd.DataFrame(changed(**columns)).to_csv(index=False).splitlines()
    return "\n".join(edit(lines)).encode()


def edited(k: int, line: str | None) -> Callable[[list[str]], list[str]]:
    return lambda lines: lines[:k] + ([] if line is None else [line]) + lines[k + 1 :]


def late(k: int, by: float) -> np.ndarray:
    """Time stamps with stamp `k` shifted by `by` [s], and all later ones too from one sampling period on."""
    t = GOOD["t"].copy()
    t[k : k + 1 if abs(by) < 0.002 else None] += by
    return t


MEASURED = 0.3 * np.sin(np.arange(N) / 6)
NAMED_IN_DEGREES = "t,voltage,theta_deg,alpha_deg"
OWN_NAMES: dict[str, Any] = {"outputs": ("theta_deg", "alpha_deg")}

# Kind -> content of the file, options of `load`, pattern that the message must match.
CONTENT: dict[str, tuple[bytes, dict[str, Any], str]] = {
    "empty": (b"", {}, "is empty"),
    "blank": (b"\n  \n\n", {}, "no text in it"),
    "binary": (b"\xff\xfe\x00\x81" * 50, {}, "cannot be read as text in UTF-8"),
    "no header": (text(lambda lines: lines[1:]), {}, "no header, its line 1 holds numbers"),
    "header only": (text(lambda lines: lines[:1]), {}, "a header, but no samples"),
    "no alpha": (text(alpha=None), {}, r"no column 'alpha'; it has t, voltage, theta: .*outputs="),
    "no voltage": (text(voltage=None), {}, r"no column 'voltage'; it has .* with input="),
    "no time": (text(t=None), {}, r"no column 't'.* or give the sampling period with Ts="),
    "one line": (
        b"t,voltage\n0,1\n",
        {},
        "no columns 'theta', 'alpha'; it has t, voltage: name the right ones",
    ),
    "no such column": (text(), {"input": "u"}, r"no column 'u'; it has t, voltage, theta, alpha"),
    "no such time": (text(), {"time": "clock"}, "no column 'clock'"),
    "column twice": (
        text(edited(0, "t,voltage,theta,theta")),
        {},
        "more than one column 'theta'",
    ),
    "short line": (text(edited(9, "0.016,0.1,0.2")), {}, "3 cells in line 10, but 4 names"),
    "blank line": (text(edited(9, "")), {}, "0 cells in line 10"),
    "text": (text(edited(9, "0.016,0.1,n/a,0.1")), {}, "'theta' holds 'n/a' at line 10"),
    "empty cell": (text(edited(9, "0.016,,0.1,0.1")), {}, "'voltage' is empty at line 10"),
    "two commas": (text(edited(9, "0;016,0.1,0.1,0.1")), {}, "'t' holds '0;016' at line 10"),
    "nan": (text(edited(9, "0.016,0.1,0.1,nan")), {}, "'alpha' is nan at line 10, in 1 of 200"),
    "infinite": (text(edited(9, "0.016,-inf,0.1,0")), {}, "'voltage' is -inf at line 10"),
    "nan in time": (text(edited(9, "nan,0.1,0.1,0.1")), {}, "'t' is nan at line 10"),
    "gap": (text(edited(9, None)), {}, "gap of 0.004 s between lines 9 and 10.*1 samples lost"),
    "long gap": (text(t=late(50, 0.1)), {}, "gap of 0.102 s .*about 50 samples lost"),
    "time falls": (text(t=late(50, -0.01)), {}, "falls by 0.008 s between lines 51 and 52"),
    "time stands": (text(t=late(50, -0.002)), {}, "duplicate time stamp between lines 51 and 52"),
    "jitter": (text(t=late(50, 1e-4)), {}, r"jittery: .* lines 5[12] and 5[23] .*off by 5 %"),
    "milliseconds": (text(t=2.0 * np.arange(N)), {}, "advances by 2 .*looks like milliseconds"),
    "microseconds": (
        text(t=2e3 * np.arange(N)),
        {},
        "like microseconds; pass time_unit='us', or",
    ),
    "nanoseconds": (text(t=2e6 * np.arange(N)), {}, "by 2e.06 .*: convert them to seconds, or time_unit='s'"),
    "seconds of ms": (
        text(edited(0, "t_ms,voltage,theta,alpha")),
        {"time": "t_ms", "time_unit": "s"},
        "'t_ms' is in ms by its name, but time_unit='s' was given; pass time_unit='ms'",
    ),
    "ms in front": (
        text(edited(0, "ms_since_start,voltage,theta,alpha")),
        {"time": "ms_since_start"},
        "in ms by its name, but seconds are needed",
    ),
    "named mV": (
        text(edited(0, "t,voltage [mV],theta,alpha")),
        {"input": "voltage [mV]"},
        "in mV by its name, but volts are needed",
    ),
    "mV below the header": (
        text(lambda lines: [lines[0], "s,mV,rad,rad", *lines[1:]]),
        {},
        "'voltage' is in mV by its line of units, but volts are needed",
    ),
    "millivolts": (text(voltage=1000 * GOOD["voltage"]), {}, "looks like millivolts"),
    "degrees": (
        text(theta=np.rad2deg(0.1 * GOOD["theta"]), alpha=np.rad2deg(GOOD["alpha"])),
        {},
        "'alpha' reaches 5.73 rad.* looks like degrees; pass degrees=True",
    ),
    "fast degrees": (
        text(theta=500 * MEASURED, alpha=None),
        {"outputs": "theta"},
        "'theta' turns at up to .* looks like degrees; pass degrees=True",
    ),
    "degrees of radians": (
        text(edited(0, "t,voltage,theta (rad),alpha (rad)")),
        {"outputs": ("theta (rad)", "alpha (rad)"), "degrees": True},
        "in rad by its name, but degrees=True was given, which is for all .* units={'theta': 'deg'}",
    ),
    "degrees of a unit rad": (
        text(),
        {"degrees": True, "units": {"theta": "deg", "alpha": "rad"}},
        "'alpha' was given in rad, but degrees=True was given too",
    ),
    "rad of the name deg": (
        text(edited(0, NAMED_IN_DEGREES)),
        {**OWN_NAMES, "units": {"theta": "rad"}},
        "'theta_deg' is in deg by its name, but was given in rad",
    ),
    "deg of the unit rad": (
        text(edited(0, "t,voltage,theta,alpha\ns,V,rad,rad")),
        {"units": {"theta": "deg"}},
        "'theta' is in rad by its line of units, but was given in deg",
    ),
    "counts in degrees": (text(), {"counts": 4096, "units": {"theta": "deg"}}, "in deg and as counts=4096"),
    "us below a name with ms": (
        text(edited(0, "t,voltage,theta,alpha\nus,V,rad,rad")),
        {"time_unit": "ms"},
        "'t' is in us by its line of units, but time_unit='ms' was given",
    ),
    "goal in volts": (
        text(edited(0, "t,Voltage [V],theta,alpha")),
        {"input": "Voltage [V]", "units": {"Voltage [V]": "rad"}},
        "'Voltage .V.' is in V by its name, but an input in rad is needed",
    ),
    "goal named voltage": (text(), {"units": {"voltage": "rad"}}, "'voltage' is in V by its name"),
    "text below the units": (
        text(edited(0, "t,voltage,theta,alpha\ns,V,rad,rad\nx,0,0,0")),
        {},
        "'voltage' holds 'V' at line 2",
    ),
    "two names in one": (
        text(),
        {"outputs": "theta,alpha"},
        "no column 'theta,alpha'; .*: name theta and alpha one by one with outputs=",
    ),
    "contradicting Ts": (text(), {"Ts": 0.001}, "advances by 0.002 s, but Ts=0.001 was given"),
    "no Ts": (text(t=None), {"Ts": 0.0}, "`Ts` must be a positive number of seconds, but is 0"),
    "input as output": (text(), {"input": "theta"}, "'theta' was given as input and as output"),
    "outputs twice": (text(), {"outputs": ("theta", "theta")}, "has one column, 'theta', for two channels"),
    "three outputs": (text(), {"outputs": ("t", "theta", "alpha")}, "give a mapping such as"),
    "no outputs": (text(), {"outputs": ()}, "`outputs` must name the column of theta"),
    "constant input": (text(voltage=np.full(N, 0.5)), {}, "'voltage' is 0.5 V throughout"),
    "constant output": (text(alpha=np.zeros(N)), {}, "'alpha' never changes from 0 rad"),
    "saturated": (
        text(alpha=np.minimum(0.3 * np.cos(np.arange(N) / 6), 0.2)),
        {},
        "'alpha' is exactly 0.2 rad.* saturated.* or pass accept=",
    ),
    "too short": (text(lambda lines: lines[:50]), {}, "at least 50 samples, but has 49"),
    "one sample": (text(lambda lines: lines[:2]), {}, "has 1 time stamps"),
    "input no name": (text(), {"input": ["voltage"]}, "`input` must be a word, but is a list"),
    "output no name": (text(), {"outputs": 3}, "no column 3"),
    "output no names": (text(), {"outputs": {}}, "`outputs` must name the column of theta"),
    "unknown fault": (text(), {"accept": "noise"}, "faults among short, .* but has 'noise'"),
}


def refused(do: Callable[[], object], phrase: str) -> None:
    """Assert an InputError that matches the phrase, in one short sentence without terms of NumPy."""
    with pytest.raises(InputError) as caught:
        do()
    sentence = str(caught.value)
    assert re.search(phrase, sentence), sentence
    assert sentence.endswith(".")
    assert "\n" not in sentence
    assert not re.search(r"[.!?] [A-Z]", sentence), sentence
    assert len(sentence) < 330
    assert not re.search("np[.]|dtype|array\\(", sentence), sentence


@pytest.mark.parametrize("kind", CONTENT)
def test_text_that_is_no_recording(kind: str, tmp_path: Path) -> None:
    content, options, phrase = CONTENT[kind]
    path = tmp_path / "run.csv"
    path.write_bytes(content)
    refused(lambda: load(path, **options), phrase)


def test_the_good_run_of_this_file_is_accepted(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_bytes(text())
    assert load(tmp_path / "run.csv").N == N
    (tmp_path / "run.csv").write_bytes(text(edited(0, NAMED_IN_DEGREES)))
    named = load(tmp_path / "run.csv", **OWN_NAMES)
    assert np.array_equal(named.y, load(tmp_path / "run.csv", degrees=True, **OWN_NAMES).y)


def pickled(path: Path) -> None:
    np.savez(path, **changed(theta=np.array([{"run": "code"}] * N)))


def old_mat(path: Path) -> None:
    scipy.io.savemat(path, GOOD)
    path.write_bytes(path.read_bytes()[:700])


def new_mat(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["t"] = GOOD["t"]
    path.write_bytes(path.read_bytes()[:300])


def array_file() -> bytes:
    buffer = BytesIO()
    np.save(buffer, GOOD["t"])
    return buffer.getvalue()


def huge(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(2_100_000_000)  # a sparse file takes no space on the disk


FILES: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "missing": ("run.csv", lambda path: None, "does not exist"),
    "folder": ("run.csv", lambda path: path.mkdir(), "is a folder, but a recording is one file"),
    "ending": (
        "run.ods",
        lambda path: path.write_text("x"),
        r"has the ending \.ods, but .*\.csv",
    ),
    "no ending": ("run", lambda path: path.write_text("x"), r"has the ending \(none\)"),
    "huge": ("run.csv", huge, r"has 2.1 GB, .* accept=\('huge',\)"),
    "broken mat": ("run.mat", old_mat, "cannot be read as a MATLAB file"),
    "no mat": ("run.mat", lambda path: path.write_text("hello" * 99), "cannot be read as a MATLAB"),
    "broken mat 7.3": ("run.mat", new_mat, "cannot be read as a MATLAB file of version 7.3"),
    "broken npz": (
        "run.npz",
        lambda path: path.write_bytes(b"PK\3\4" + b"0" * 99),
        "as an NPZ file",
    ),
    "pickle": ("run.npz", lambda path: path.write_bytes(pickle.dumps(GOOD)), "pickled objects"),
    "pickled npz": ("run.npz", pickled, "pickled objects, which could run any code"),
    "nameless npz": (
        "run.npz",
        lambda path: path.write_bytes(array_file()),
        "one array without names",
    ),
    "broken parquet": ("run.parquet", lambda path: path.write_text("hi"), "as a Parquet file"),
    "lengths": (
        "run.npz",
        lambda path: np.savez(path, **changed(alpha=GOOD["alpha"][:-1])),
        "'voltage' has 200 samples and 'alpha' has 199",
    ),
    "clock length": (
        "run.npz",
        lambda path: np.savez(path, **changed(t=GOOD["t"][:-5])),
        "has 195 stamps for 200 samples",
    ),
    "complex": (
        "run.npz",
        lambda path: np.savez(path, **changed(voltage=GOOD["voltage"] + 1j)),
        "'voltage' must hold real numbers, but holds complex128",
    ),
    "logical": (
        "run.npz",
        lambda path: np.savez(path, **changed(voltage=GOOD["voltage"] > 0)),
        "'voltage' must hold real numbers, but holds bool",
    ),
    "nan in mat": (
        "run.mat",
        lambda path: scipy.io.savemat(path, changed(theta=(7, np.nan))),
        "'theta' is nan at row 8, in 1 of 200",
    ),
    "matrix": (
        "run.npz",
        lambda path: np.savez(path, theta=np.ones((N, 2)), voltage=GOOD["voltage"]),
        r"no columns 'theta', .*; it has theta\[0\], theta\[1\], voltage",
    ),
}


@pytest.mark.parametrize("kind", FILES)
def test_file_that_is_no_recording(kind: str, tmp_path: Path) -> None:
    name, write, phrase = FILES[kind]
    write(tmp_path / name)
    refused(lambda: load(tmp_path / name), phrase)


def test_pickle_is_never_opened(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple:
            return Path.touch, (tmp_path / "sprung",)

    np.savez(tmp_path / "run.npz", **changed(theta=np.array([Trap()] * N)))
    refused(lambda: load(tmp_path / "run.npz"), "pickled")
    (tmp_path / "run.npz").write_bytes(pickle.dumps(Trap()))
    refused(lambda: load(tmp_path / "run.npz"), "pickled")
    assert not (tmp_path / "sprung").exists()


def twice() -> pd.DataFrame:
    frame = pd.DataFrame(GOOD)
    return pd.concat([frame, frame[["theta"]]], axis=1)


FRAMES: dict[str, tuple[Callable[[], Any], str]] = {
    "text": (lambda: pd.DataFrame(changed(theta=(9, "broken"))), "'broken' at row 9"),
    "missing value": (
        lambda: pd.DataFrame(changed(theta=(9, np.nan))).convert_dtypes(),
        "'theta' (is|holds) (nan|<NA>) at row 9",
    ),
    "column twice": (twice, "more than one column 'theta'"),
    "dates": (
        lambda: pd.DataFrame(changed(t=pd.date_range("2024", periods=N, freq="ms"))),
        "'t' must hold real numbers, but holds datetime64",
    ),
    "no rows": (lambda: pd.DataFrame(GOOD)[:0], "has 0 time stamps"),
    "arrays": (lambda: GOOD["theta"], "ndarray was given; make a Recording of arrays"),
    "nothing": (lambda: None, "NoneType was given"),
    "number": (lambda: 3, "int was given"),
}


@pytest.mark.parametrize("kind", FRAMES)
def test_object_that_is_no_recording(kind: str) -> None:
    make, phrase = FRAMES[kind]
    refused(lambda: load(make()), phrase)


U, Y = GOOD["voltage"], np.column_stack([GOOD["theta"], GOOD["alpha"]])

ARRAYS: dict[str, tuple[dict[str, Any], str]] = {
    "lengths": ({"u": U[:-1]}, "same length, but have 199 and 200"),
    "transposed": ({"y": Y.T}, "have 200 and 2 samples; transpose `y`"),
    "two inputs": ({"u": Y}, r"must have the shapes \(N,\) and \(N, C\)"),
    "no channel": ({"y": Y[:, :0]}, "must have the shapes"),
    "three axes": ({"y": Y[..., None]}, "must have the shapes"),
    "ragged": ({"y": [[1.0, 2.0], [1.0]]}, "its rows differ in length"),
    "complex": ({"u": U + 1j}, "`u` must hold real numbers, but holds complex128"),
    "text": ({"u": ["0.1"] * 199 + ["high"]}, "`u` holds 'high' at sample 199"),
    "none": ({"u": [0.1] * 199 + [None]}, "`u` holds 'None' at sample 199"),
    "logical": ({"u": U > 0}, "but holds bool"),
    "masked": ({"u": np.ma.masked_greater(U, 1.0)}, "`u` has masked samples"),
    "nan": ({"y": np.where(np.arange(400).reshape(N, 2) == 301, np.nan, Y)}, "'alpha' is nan at"),
    "infinite": ({"u": np.where(np.arange(N) == 3, np.inf, U)}, "'voltage' is inf at sample 3"),
    "Ts zero": ({"Ts": 0}, "`Ts` must be a positive number of seconds, but is 0"),
    "Ts negative": ({"Ts": -0.1}, "but is -0.1"),
    "Ts nan": ({"Ts": np.nan}, "but is nan"),
    "Ts text": ({"Ts": "2 ms"}, "but is '2 ms'"),
    "Ts none": ({"Ts": None}, "but is None"),
    "Ts many": ({"Ts": GOOD["t"]}, "but is 200 values"),
    "channel names": ({"channels": ("theta",)}, "each of the 2 columns"),
    "equal names": ({"channels": ("theta", "theta")}, "a name of its own"),
    "unnamed": ({"y": np.column_stack([Y, U])}, "each of the 3 columns"),
    "units": ({"units": ("rad",)}, "a unit for each of the 2 columns"),
    "n_init zero": ({"n_init": 0}, "`n_init` must be a whole number from 1 .* but is 0 of 200"),
    "n_init all": ({"n_init": 200}, "but is 200 of 200 samples; 0.2 s are 100 samples"),
    "n_init part": ({"n_init": 1.5}, "but is 1.5"),
    "short": ({"u": U[:49], "y": Y[:49]}, "at least 50 samples, but has 49"),
    "empty": ({"u": [], "y": np.empty((0, 2))}, r"have \(0,\) and \(0, 2\)"),
    "constant": ({"y": np.column_stack([Y[:, 0], np.full(N, 0.1)])}, "'alpha' never changes"),
    "constant but for rounding": (
        {"y": np.column_stack([Y[:, 0], np.where(U > 0, 0.3, 0.1 + 0.2)])},
        "'alpha' never changes",
    ),
    "fault": ({"accept": ("nan",)}, "but has 'nan'"),
}


@pytest.mark.parametrize("kind", ARRAYS)
def test_arrays_that_are_no_recording(kind: str) -> None:
    given, phrase = ARRAYS[kind]
    refused(lambda: Recording(**{"u": U, "y": Y, "Ts": 0.002, **given}), phrase)


def test_an_input_of_another_quantity_is_no_input_of_the_model() -> None:
    """A current for a model that a voltage drives; a unit that is not known, such as %, says nothing."""
    y = np.column_stack([GOOD["theta"], GOOD["alpha"]])
    given = {"u": GOOD["voltage"], "y": y, "Ts": 0.002}
    model = Model(joints.paper())
    assert model.simulate(Recording(**given, input_unit="%")).shape == (N, 2)
    assert model.simulate(Recording(**given, input_unit="A", accept="units")).shape == (N, 2)
    for unit in ("A", "N m"):
        refused(lambda unit=unit: model.simulate(Recording(**given, input_unit=unit)), f"is in {unit}; give")
    followed = {**given, "y": model.simulate(Recording(**given, input_unit="%"))}
    refused(
        lambda: fit(joints.paper(), Recording(**followed, input_unit="A")),
        "motor of the model is driven in V",
    )


def test_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "run.mat", "w") as file:
        file["t"] = GOOD["t"]
    monkeypatch.setitem(sys.modules, "h5py", None)
    lines = [f"h5py>=3.11; extra == '{extra}'" for extra in ("all", "dev", "io")]
    monkeypatch.setattr("importlib.metadata.requires", lambda name: ["jax", "h5pyd; extra == 'x'", *lines])
    refused(lambda: load(tmp_path / "run.mat"), r'needs the package h5py.*"rotflex_jax\[io\]"')
    monkeypatch.setattr("importlib.metadata.requires", lambda name: ["jax"])
    refused(lambda: load(tmp_path / "run.mat"), r'needs the package h5py.*"rotflex_jax\[all\]"')
