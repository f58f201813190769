"""Recordings in the file formats of users, and typical commands with mistakes.

A message that names an option as the remedy is tested with that option: the file is then accepted.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io
from test_cli import assert_one_sentence, run  # noqa: F401 - a fixture

import rotflex_jax as rf
from rotflex_jax.data.datasets import demo_recording
from rotflex_jax.mechanism import Units

RECORDING = demo_recording().slice(0, 2000)
T, U = RECORDING.t, RECORDING.u
THETA, ALPHA = RECORDING.y.T
NAMES = ["t", "voltage", "theta", "alpha"]


def table(**changed: object) -> pd.DataFrame:
    columns = dict(zip(NAMES, (T, U, THETA, ALPHA), strict=True)) | changed
    return pd.DataFrame({name: values for name, values in columns.items() if values is not None})


def renamed(*names: str) -> pd.DataFrame:
    return table().set_axis(list(names), axis=1)


def as_csv(frame: pd.DataFrame, **options: object) -> Callable[[Path], Path]:
    return lambda folder: _saved(folder / "run.csv", lambda f: frame.to_csv(f, index=False, **options))


def _saved(file: Path, write: Callable[[Path], object]) -> Path:
    write(file)
    return file


def counted(x: np.ndarray) -> np.ndarray:
    return np.round(x * 4096 / (2 * np.pi)).astype(int)


def of_text(name: str, text: str) -> Callable[[Path], Path]:
    return lambda folder: _saved(folder / name, lambda f: f.write_text(text))


def matlab(**variables: object) -> Callable[[Path], Path]:
    return lambda folder: _saved(folder / "run.mat", lambda f: scipy.io.savemat(f, variables))


def in_the_room(folder: Path) -> Path:
    """Absolute angles of the arm over 6 s, since 4 s contain too little slow motion to detect them."""
    whole = demo_recording().slice(0, 3000)
    columns = {"t": whole.t, "voltage": whole.u, "theta": whole.y[:, 0], "alpha": whole.y.sum(axis=1)}
    return as_csv(pd.DataFrame(columns))(folder)


def npz(folder: Path) -> Path:
    return _saved(
        folder / "run.npz", lambda f: np.savez(f, **dict(zip(NAMES, (T, U, THETA, ALPHA), strict=True)))
    )


def simulink(folder: Path) -> Path:
    """A structure with time, as a Simulink scope saves it: one entry for each signal."""
    signals = np.zeros(3, dtype=[("values", object), ("label", object)])
    for k, x in enumerate((U, THETA, ALPHA)):
        signals[k] = (x[:, None], NAMES[k + 1])
    return matlab(out={"time": T, "signals": signals})(folder)


def timeseries(folder: Path) -> Path:
    matio = pytest.importorskip("matio")
    from matio.utils import MatlabOpaque

    def one(x: np.ndarray) -> object:
        return MatlabOpaque({"Data_": x[:, None], "Time_": T[:, None]}, "timeseries")

    signals = {name: one(x) for name, x in zip(NAMES[1:], (U, THETA, ALPHA), strict=True)}
    return _saved(folder / "run.mat", lambda f: matio.save_to_mat(str(f), signals, version="v7"))


def sheet(folder: Path) -> Path:
    pytest.importorskip("openpyxl")
    return _saved(folder / "run.xlsx", lambda f: table().to_excel(f, index=False))


def parquet(folder: Path) -> Path:
    pytest.importorskip("pyarrow")
    return _saved(folder / "run.parquet", table().to_parquet)


def of_channels(folder: Path) -> Path:
    """A folder with the time and one channel in each file."""
    whole = folder / "run"
    whole.mkdir()
    for name, x in zip(NAMES[1:], (U, THETA, ALPHA), strict=True):
        pd.DataFrame({"t": T, name: x}).to_csv(whole / f"{name}.csv", index=False)
    return whole


jitter = 0.2 * 0.002 * np.random.default_rng(1).uniform(-1, 1, len(T))
holed = THETA.copy()
holed[700] = np.nan
MATRIX = np.column_stack([T, U, THETA, ALPHA])


def samples(folder: Path) -> Path:
    """A JSON file with one object per sample, as loggers write it."""
    rows = [dict(zip(NAMES, row, strict=True)) for row in MATRIX.tolist()]
    return _saved(folder / "run.json", lambda f: f.write_text(json.dumps(rows)))


READ = {
    "samples in a JSON file": (samples, ""),
    "as the manual says": (as_csv(table()), ""),
    "semicolons": (as_csv(table(), sep=";"), ""),
    "tabs": (as_csv(table(), sep="\t"), ""),
    "semicolons and decimal commas": (as_csv(table(), sep=";", decimal=","), ""),
    "units in the header": (as_csv(renamed("Time [s]", "Voltage [V]", "Theta [rad]", "Alpha [rad]")), ""),
    "Greek letters": (as_csv(renamed("t", "voltage", "θ", "α")), ""),
    "other columns beside": (as_csv(table(temperature=np.full(len(T), 21.0))), ""),
    "theta alone": (as_csv(table(alpha=None)), "--output theta"),
    "no time": (as_csv(table(t=None)), "--Ts 0.002"),
    "own names": (
        as_csv(renamed("zeit", "uin", "servo", "link")),
        "--time zeit --input uin --output servo --output link",
    ),
    "numpy": (npz, ""),
    "MATLAB, variables": (matlab(t=T, voltage=U, theta=THETA, alpha=ALPHA), ""),
    "MATLAB, a matrix": (
        matlab(data=MATRIX),
        "--time data[0] --input data[1] --output data[2] --output data[3]",
    ),
    "MATLAB, a structure": (
        matlab(run={"t": T, "voltage": U, "theta": THETA, "alpha": ALPHA}),
        "--time run.t --input run.voltage --output run.theta --output run.alpha",
    ),
    "Simulink, a structure with time": (
        simulink,
        "--time out.time --input out.signals[0].values --output out.signals[1].values "
        "--output out.signals[2].values",
    ),
    "MATLAB, timeseries": (timeseries, ""),
    "a spreadsheet": (sheet, ""),
    "parquet": (parquet, ""),
    "a folder with a file for each channel": (of_channels, ""),
    "capitals": (as_csv(renamed("T", "VOLTAGE", "THETA", "ALPHA")), ""),
    "degrees and milliseconds by the header": (
        as_csv(
            table(t=1e3 * T, theta=np.rad2deg(THETA), alpha=np.rad2deg(ALPHA)).set_axis(
                ["Time [ms]", "Voltage [V]", "Theta [deg]", "Alpha [°]"], axis=1
            )
        ),
        "",
    ),
    "a mark of the byte order": (as_csv(table(), encoding="utf-8-sig"), ""),
    "a line of units": (
        of_text(
            "run.csv",
            "t,voltage,theta,alpha\ns,V,rad,rad\n"
            + "\n".join(",".join(f"{x:.9g}" for x in row) for row in np.column_stack([T, U, THETA, ALPHA])),
        ),
        "",
    ),
}  # fmt: skip
"""Case -> file, and options with which all of its samples are read."""

CURED = {
    "degrees": (as_csv(table(theta=np.rad2deg(THETA), alpha=np.rad2deg(ALPHA))), "degrees", "--degrees"),
    "counts": (
        as_csv(table(theta=counted(THETA), alpha=counted(ALPHA))),
        "counts of an encoder",
        "--counts 4096",
    ),
    "milliseconds": (as_csv(table(t=1e3 * T)), "milliseconds", "--time-unit ms"),
    "jitter": (as_csv(table(t=T + jitter)), "", "--resample auto"),
    "the absolute angle of the arm": (in_the_room, "in the room", "--arm-absolute"),
    "some rows lost": (as_csv(table().drop(index=[700, 701, 1500])), "samples lost", "--resample auto"),
}  # fmt: skip
"""Case -> file, words of the refusal, and the option that the message names and that works."""

REFUSED = {
    "a hole": (as_csv(table(theta=holed)), "check", "theta"),
    "words in a column": (of_text("run.csv", "t,voltage,theta,alpha\n0,1,2,3\n1,1,x,3\n"), "check", "theta"),
    "a header alone": (of_text("run.csv", "t,voltage,theta,alpha\n"), "check", "run.csv"),
    "nothing": (of_text("run.csv", ""), "check", "run.csv"),
    "a picture": (of_text("run.png", "no recording"), "check", ".csv"),
    "swapped": (as_csv(renamed("t", "voltage", "alpha", "theta")), "check", "swapped"),
    "another machine": (as_csv(table()), "discover --joint robot", "robot"),
    "a wrong option": (as_csv(table()), "discover --hold-out a.csv", "--hold-out"),
    "a share of all": (as_csv(table()), "discover --split 1", "--split"),
    "rows lost": (as_csv(table().drop(index=range(500, 520))), "check", "gap"),
    "no such effect": (as_csv(table()), "simulate --add glue@hub", "glue"),
    "no such method": (as_csv(table()), "compare --methods magic", "magic"),
    "a report on a file": (as_csv(table()), "discover --report FILE", "folder"),
    "the same file twice": (as_csv(table()), "discover FILE", "twice"),
    "no such file": (as_csv(table()), "discover other.csv", "other.csv"),
    "a constant voltage": (as_csv(table(voltage=0 * U + 1)), "check", "voltage"),
    "a sensor at rest": (as_csv(table(alpha=0 * ALPHA)), "check", "alpha"),
    "a current as the voltage": (
        as_csv(renamed("t", "Current [A]", "theta", "alpha")),
        "discover --input Current",
        "driven in V",
    ),
    "millivolts": (as_csv(table(voltage=1e3 * U)), "check", "millivolts"),
    "too short": (as_csv(table().head(30)), "check", "50 samples"),
    "an unknown command": (as_csv(table()), "dicsover", "dicsover"),
}  # fmt: skip
"""Case -> file, command, and a word that the message must contain."""


@pytest.mark.parametrize("case", READ)
def test_it_is_read(case: str, run, tmp_path: Path) -> None:  # noqa: F811
    make, options = READ[case]
    status, out, err = run("check", make(tmp_path), *options.split())
    assert status == 0, err
    assert "2000 samples, 4 s at 500 Hz" in out


@pytest.mark.parametrize("case", CURED)
def test_it_is_refused_and_the_cure_works(case: str, run, tmp_path: Path) -> None:  # noqa: F811
    make, said, cure = CURED[case]
    file = make(tmp_path)
    status, _, err = run("check", file)
    assert status == 2
    assert_one_sentence(err, said, cure)
    status, _, err = run("check", file, *cure.split())
    assert status == 0, err


@pytest.mark.parametrize("case", REFUSED)
def test_it_is_refused(case: str, run, tmp_path: Path) -> None:  # noqa: F811
    make, command, named = REFUSED[case]
    file = make(tmp_path)
    first, *options = command.replace("FILE", str(file)).split()
    status, _, err = run(first, file, *options)
    assert status == 2
    assert_one_sentence(err, named)


def test_counts_of_one_column_beside_degrees_of_the_other(run, tmp_path: Path) -> None:  # noqa: F811
    """Each refusal names an option that leads on, and the last one is accepted."""
    frame = pd.DataFrame({"t": T, "voltage": U, "hub": counted(THETA), "tip [deg]": np.rad2deg(ALPHA)})
    file = as_csv(frame)(tmp_path)
    columns = ("--output", "hub", "--output", "tip")
    status, _, err = run("check", file, *columns)
    assert status == 2
    assert_one_sentence(err, "counts of one turn, --counts 4096")
    status, _, err = run("check", file, *columns, "--counts", "4096")
    assert status == 2
    assert_one_sentence(err, "'tip [deg]' is in deg by its name", "--counts theta=4096")
    status, _, err = run("check", file, *columns, "--counts", "theta=4096")
    assert status == 0, err


CART = """
from rotflex_jax import Mechanism
from rotflex_jax.effects import CurrentDrive, Inertia, Viscous

cart = Mechanism(
    coordinates=["x"],
    ports={"cart": (1,)},
    effects=[CurrentDrive("cart", gain=2.0), Inertia("cart", inertia=4.0), Viscous("cart", coefficient=1.0)],
    outputs={"x": "cart"},
    trusted=["cart.current_drive.gain"],
    units=("m", "N"),
)
"""


@pytest.mark.parametrize(
    ("column", "option"),
    [("Lage [mm]", "x=Lage [mm]"), ("Lage [mm]", "x [mm]=Lage"), ("Lage", "x [mm]=Lage"), ("x [mm]", "")],
)
def test_millimetres_are_converted_for_a_model_in_metres(
    column: str,
    option: str,
    run,  # noqa: F811
    tmp_path: Path,
) -> None:
    position = np.cumsum(np.cumsum(U))
    position /= np.abs(position).max()  # [m]
    (tmp_path / "plant.py").write_text(CART)
    file = as_csv(pd.DataFrame({"t": T, "voltage": U, column: 1e3 * position}))(tmp_path)
    where = ["--joint", f"{tmp_path / 'plant.py'}:cart", *(["--output", option] if option else [])]
    status, _, err = run("simulate", file, *where, "--save", tmp_path / "out.csv")
    assert status == 0, err
    found = pd.read_csv(tmp_path / "out.csv")
    measured = next(c for c in found if c.startswith("x"))
    np.testing.assert_allclose(found[measured], position, rtol=1e-8)


def test_millimetres_are_no_metres_for_a_model_in_python(tmp_path: Path) -> None:
    cart = rf.Mechanism(
        coordinates=("x",),
        ports={"cart": (1,)},
        effects=(rf.effects.CurrentDrive("cart"), rf.effects.Inertia("cart"), rf.effects.Viscous("cart")),
        outputs={"x": "cart"},
        trusted=("cart.current_drive.gain",),
        units=Units("m", "N"),
    )
    recording = rf.Recording(u=U, y=1e3 * THETA, Ts=0.002, channels="x", units="mm")
    with pytest.raises(rf.InputError, match=r"is in mm, but .* is in m; multiply it by 0.001, or"):
        rf.fit(cart, recording)


def test_the_documentation_lists_them_all() -> None:
    page = (Path(__file__).parents[1] / "docs" / "files_tried.md").read_text()
    shown = {case: options for case, (_, options) in READ.items()}
    shown |= {case: option for case, (*_, option) in CURED.items()}
    for case, options in shown.items():
        assert f"| {case} | {f'`{options}`' if options else ''} |" in page, case
    for case in REFUSED:
        assert f"| {case} |" in page, case
    rows = [line for line in page.splitlines() if line.startswith("| ") and not line.startswith("| file")]
    assert len(rows) == len(READ) + len(CURED) + len(REFUSED)
    assert len(READ) + len(CURED) + len(REFUSED) >= 40


def test_a_fitted_model_is_exported_without_another_word(run, tmp_path: Path) -> None:  # noqa: F811
    from rotflex_jax.export import Saved, save

    joint = rf.joints.paper()
    file = save(Saved(rf.Model(joint), Ts=RECORDING.Ts), tmp_path / "fit.json")
    status, out, err = run("export", file, "--to", "c")
    assert status == 0 and "0.002" in out, err
    status, _, err = run("export", rf.Model(joint).save(tmp_path / "bare.json"), "--to", "c")
    assert status == 2
    assert_one_sentence(err, "--Ts")
    status, out, err = run("effects", "--json")
    assert status == 0 and len(json.loads(out)["effects"]) > 30
