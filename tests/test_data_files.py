"""Every kind of file gives the same recording."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io

from rotflex_jax.data import load, save_csv
from rotflex_jax.data.excitation import noise
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording

Ts = 0.004
N = 200
U = noise(N, Ts, seed=7)
Y = np.column_stack([np.cumsum(U) * Ts, 0.1 * np.sin(np.arange(N) / 9)])
T = Ts * np.arange(N)
TABLE = np.column_stack([T, U, Y])


def write_text(
    path: Path,
    header: str = "t,voltage,theta,alpha",
    delimiter: str = ",",
    table: np.ndarray = TABLE,
    comma: bool = False,
) -> Path:
    rows = [delimiter.join(f"{x:.17g}" for x in row) for row in table]
    text = "\n".join(rows).replace(".", ",") if comma else "\n".join(rows)
    path.write_text(header + "\n" + text + "\n", encoding="utf-8")
    return path


def assert_is_the_run(recording: Recording) -> None:
    np.testing.assert_allclose(recording.u, U, rtol=1e-14)
    np.testing.assert_allclose(recording.y, Y, rtol=1e-14, atol=1e-16)
    assert recording.Ts == pytest.approx(Ts, rel=1e-12)
    assert recording.channels == ("theta", "alpha")


def write_hdf5(path: Path, values: dict) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in values.items():
            file.create_dataset(name, data=np.atleast_2d(value))
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        file.create_dataset("note", data=np.array([[104], [105]], dtype=np.uint16))
        file["note"].attrs["MATLAB_class"] = np.bytes_("char")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, written by a test".ljust(512))


COLUMNS = {"t": T, "voltage": U, "theta": Y[:, 0], "alpha": Y[:, 1]}

WRITERS: dict[str, Callable[[Path], object]] = {
    "run.csv": write_text,
    "run.tsv": lambda path: write_text(path, "t\tvoltage\ttheta\talpha", "\t"),
    "run.txt": lambda path: write_text(path, "t  voltage theta alpha", "  "),
    "run.npz": lambda path: np.savez(path, **COLUMNS),
    "run.mat": lambda path: scipy.io.savemat(path, COLUMNS),
    "run.7.3.mat": lambda path: write_hdf5(path, COLUMNS),
    "run.parquet": lambda path: pd.DataFrame(COLUMNS).to_parquet(path),
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_gives_the_same_run(name: str, tmp_path: Path) -> None:
    WRITERS[name](tmp_path / name)
    for path in (tmp_path / name, str(tmp_path / name)):
        recording = load(path)
        assert_is_the_run(recording)
        assert recording.source == name


def test_dataframe_is_taken_as_it_is() -> None:
    assert_is_the_run(load(pd.DataFrame(COLUMNS)))
    nullable = pd.DataFrame(COLUMNS).convert_dtypes()
    assert_is_the_run(load(nullable))


@pytest.mark.parametrize(
    ("header", "delimiter", "comma"),
    [
        ("t;voltage;theta;alpha", ";", False),
        ("t;voltage;theta;alpha", ";", True),
        ("t|voltage|theta|alpha", "|", False),
        ('"t","voltage","theta","alpha"', ",", False),
        (" t , voltage , theta , alpha ", ",", False),
        ("% t\tvoltage\ttheta\talpha", "\t", False),
        ("# made by hand\n#\nt,voltage,theta,alpha", ",", False),
        ("# made by hand\n# t,voltage,theta,alpha", ",", False),
        ("\ufefft,voltage,theta,alpha", ",", False),
        ("\nt,voltage,theta,alpha", ",", False),
    ],
)
def test_text_of_many_hands(header: str, delimiter: str, comma: bool, tmp_path: Path) -> None:
    path = write_text(tmp_path / "run.csv", header, delimiter, comma=comma)
    assert_is_the_run(load(path))


@pytest.mark.parametrize("mark", [";", "\t", ","])
def test_a_first_line_for_excel_names_the_delimiter(mark: str, tmp_path: Path) -> None:
    write_text(tmp_path / "run.csv", mark.join(("t", "voltage", "theta", "alpha")), mark)
    plain = (tmp_path / "run.csv").read_text()
    (tmp_path / "run.csv").write_text(f"sep={mark}\n{plain}")
    assert_is_the_run(load(tmp_path / "run.csv"))


def test_windows_line_ends(tmp_path: Path) -> None:
    path = write_text(tmp_path / "run.csv")
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n") + b"\r\n\r\n")
    assert_is_the_run(load(path))


def test_columns_of_other_names(tmp_path: Path) -> None:
    path = write_text(tmp_path / "run.csv", "zeit,vm,hub angle,tip")
    named: dict[str, Any] = {"time": "zeit", "input": "vm"}
    assert_is_the_run(load(path, outputs=["hub angle", "tip"], **named))
    other = load(path, outputs={"position": "tip"}, **named)
    assert other.channels == ("position",)
    np.testing.assert_allclose(other.y[:, 0], Y[:, 1])
    single = load(path, outputs="hub angle", **named)
    assert single.channels == ("theta",)


def test_other_columns_may_hold_what_they_like(tmp_path: Path) -> None:
    frame = pd.DataFrame(COLUMNS)
    frame["remark"] = "fine"
    frame["spare"] = np.nan
    frame.to_csv(tmp_path / "run.csv", index=False)
    assert_is_the_run(load(tmp_path / "run.csv"))


PUSH = np.cos(np.arange(N) / 11)


def test_signals_are_columns_too(tmp_path: Path) -> None:
    table = np.column_stack([TABLE, PUSH, 2 * PUSH])
    path = write_text(tmp_path / "run.csv", "t,voltage,theta,alpha,Base [m/s^2],i2", table=table)
    for given, names in {
        "Base [m/s^2]": ["Base [m/s^2]"],
        "base": ["Base [m/s^2]"],
        ("base", "i2"): ["Base [m/s^2]", "i2"],
    }.items():
        recording = load(path, signals=given)
        assert_is_the_run(recording)
        assert list(recording.signals) == names
        for name, factor in zip(names, (1, 2), strict=False):
            np.testing.assert_allclose(recording.signals[name], factor * PUSH, rtol=1e-14)
    assert list(load(path, signals={"second motor [A]": "i2"}).signals) == ["second motor [A]"]
    for none in (None, [], {}):
        assert load(path, signals=none).signals == {}
    # Signals keep their unit; degrees are not converted.
    frame = pd.DataFrame(COLUMNS | {"tilt [deg]": PUSH})
    np.testing.assert_array_equal(load(frame, signals="tilt").signals["tilt [deg]"], PUSH)
    # The unit may come from a line of units below the header.
    header = "t,voltage,theta,alpha,push\ns,V,rad,rad,N"
    other = write_text(tmp_path / "units.csv", header, table=table[:, :5])
    assert list(load(other, signals="push").signals) == ["push [N]"]


@pytest.mark.parametrize(
    ("signals", "phrase"),
    [
        (3, "`signals` must name columns, each once, but is 3"),
        (["push", 3], "each once, but is a list"),
        (["push", "Push"], "each once, but is"),
        ({"a": "push", "b": "push"}, "each once, but is"),
        ("wind", "has no column 'wind'; it has .*: name the right one with signals="),
        (["wind", "rain"], "has no columns 'wind', 'rain'; .* with signals="),
        ("theta", "'theta' was given as a signal and as input or output"),
        ("voltage", "'voltage' was given as a signal and as input or output"),
        ("gap", "column 'gap' is nan at row 3"),
        ({"": "push"}, "given the name '', but it needs one line of text"),
    ],
)
def test_columns_that_are_no_signals_are_refused(signals: Any, phrase: str) -> None:
    frame = pd.DataFrame(COLUMNS | {"push": PUSH, "gap": np.where(np.arange(N) == 3, np.nan, PUSH)})
    with pytest.raises(InputError, match=phrase):
        load(frame, signals=signals)


def test_signals_are_held_where_times_are_uneven() -> None:
    """With `resample`, signals are held like the input; only outputs are interpolated."""
    uneven = T + np.where(np.arange(N) % 2, 0.4 * Ts, 0.0)  # odd samples come late
    frame = pd.DataFrame(COLUMNS | {"t": uneven, "push": PUSH})
    recording = load(frame, signals="push", resample=Ts)
    late = recording.signals["push"]
    np.testing.assert_array_equal(late, PUSH[np.arange(N) // 2 * 2][: recording.N])
    np.testing.assert_array_equal(recording.u, U[np.arange(N) // 2 * 2][: recording.N])


def test_signals_in_files_of_their_own(tmp_path: Path) -> None:
    for name, values in COLUMNS.items():
        if name != "t":
            pd.DataFrame({"t": T, name: values}).to_csv(tmp_path / f"{name}.csv", index=False)
    # Half the sampling rate, and one sample late.
    pd.DataFrame({"t": T[::2] + Ts, "push": PUSH[::2]}).to_csv(tmp_path / "push.csv", index=False)
    with pytest.raises(InputError, match=r"'push'.* have times of their own"):
        load(tmp_path, signals="push")
    recording = load(tmp_path, signals="push", resample=Ts)
    assert recording.start == pytest.approx(Ts)
    np.testing.assert_array_equal(recording.signals["push"], np.repeat(PUSH[::2], 2)[: recording.N])
    np.testing.assert_allclose(recording.y, Y[1:][: recording.N], atol=1e-12)
    assert load(tmp_path).signals == {}  # columns that are not named need no common times


def test_degrees_become_radians(tmp_path: Path) -> None:
    table = np.column_stack([T, U, np.rad2deg(Y)])
    assert_is_the_run(load(write_text(tmp_path / "run.csv", table=table), degrees=True))


def test_sampling_period_from_the_argument_the_column_or_both(tmp_path: Path) -> None:
    path = write_text(tmp_path / "bare.csv", "voltage,theta,alpha", table=TABLE[:, 1:])
    recording = load(path, Ts=Ts)
    assert_is_the_run(recording)
    assert recording.start == 0.0
    assert_is_the_run(load(write_text(tmp_path / "both.csv"), Ts=Ts))


def test_clock_that_starts_late_is_kept_and_rounding_forgiven(tmp_path: Path) -> None:
    table = TABLE.copy()
    table[:, 0] = np.round(1.7e9 + T, 3)
    recording = load(write_text(tmp_path / "run.csv", table=table))
    assert recording.start == 1.7e9
    assert recording.Ts == Ts


def test_matrices_and_structures_have_columns(tmp_path: Path) -> None:
    log = {"log": {"u": U, "angles": Y}, "clock": np.column_stack([T, U]), "gain": 3.0}
    scipy.io.savemat(tmp_path / "run.mat", log)
    recording = load(
        tmp_path / "run.mat",
        time="clock[0]",
        input="log.u",
        outputs=("log.angles[0]", "log.angles[1]"),
    )
    assert_is_the_run(recording)


@pytest.mark.parametrize("write", [scipy.io.savemat, write_hdf5])
def test_signals_in_rows_are_signals(write: Callable, tmp_path: Path) -> None:
    """Simulink's block To File writes signals as rows.

    A matrix with fewer than 50 rows is transposed, since a recording has at least 50 samples.
    """
    write(tmp_path / "run.mat", {"ans": TABLE.T})
    outputs = ("ans[2]", "ans[3]")
    assert_is_the_run(load(tmp_path / "run.mat", time="ans[0]", input="ans[1]", outputs=outputs))


@pytest.mark.parametrize("units", ["s,V,rad,rad", '"[s]","[V]","[rad]","[rad]"', "s,,rad,rad"])
def test_line_of_units_is_read(units: str, tmp_path: Path) -> None:
    path = write_text(tmp_path / "run.csv", header="t,voltage,theta,alpha\n" + units)
    assert_is_the_run(load(path))
    with pytest.raises(InputError, match="in rad by its line of units, but degrees=True"):
        load(path, degrees=True)


def test_matrix_of_matlab_7_3_is_not_transposed(tmp_path: Path) -> None:
    # MATLAB stores arrays column by column, so their axes are exchanged in HDF5.
    write_hdf5(tmp_path / "run.mat", {"log": TABLE.T})
    outputs = ("log[2]", "log[3]")
    assert_is_the_run(load(tmp_path / "run.mat", time="log[0]", input="log[1]", outputs=outputs))


def test_accepted_faults_reach_the_recording(tmp_path: Path) -> None:
    table = TABLE.copy()
    table[:, 2] = 0.3
    recording = load(write_text(tmp_path / "run.csv", table=table), accept=("constant",))
    assert [finding.kind for finding in recording.findings] == ["constant"]


def test_no_files_and_no_size_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="list of files was given, but it is empty"):
        load([])
    for size in ("2 GB", -1):
        with pytest.raises(InputError, match="`max_bytes` must be a finite number above 0"):
            load(write_text(tmp_path / "run.csv"), max_bytes=size)


def test_an_array_of_records_gives_a_column_for_each_field(tmp_path: Path) -> None:
    records = np.rec.fromarrays(list(COLUMNS.values()), names=list(COLUMNS))
    np.savez(tmp_path / "run.npz", log=records)
    options = {"time": "log.t", "input": "log.voltage", "outputs": ("log.theta", "log.alpha")}
    assert_is_the_run(load(tmp_path / "run.npz", **options))


@pytest.mark.parametrize("options", [{}, {"Ts": Ts}])
def test_an_empty_row_of_a_spreadsheet_is_not_passed_over(options, tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (list(COLUMNS), [], *np.column_stack(list(COLUMNS.values())).tolist()):
        book.active.append(row)
    book.save(tmp_path / "run.xlsx")
    assert_is_the_run(load(tmp_path / "run.xlsx"))  # an empty row below the names is none of the samples
    for cell in book.active[50]:
        cell.value = None
    if options:
        book.active.delete_cols(1)
    book.save(tmp_path / "run.xlsx")
    with pytest.raises(InputError, match="has the empty row 50 among its samples"):
        load(tmp_path / "run.xlsx", **options)


def test_a_recording_that_could_not_be_loaded_again_is_not_saved(tmp_path: Path) -> None:
    file = tmp_path / "run.csv"
    recording = Recording(u=U, y=Y, Ts=Ts, channels=("voltage", "alpha"))
    with pytest.raises(InputError, match="more than one column 'voltage'"):
        save_csv(recording, file)
    assert not file.exists()


def test_what_is_saved_is_loaded_again_bit_by_bit(tmp_path: Path) -> None:
    recording = Recording(u=U, y=Y, Ts=Ts, start=86400.5)
    again = load(save_csv(recording, tmp_path / "run.csv"))
    np.testing.assert_array_equal(again.u, recording.u)
    np.testing.assert_array_equal(again.y, recording.y)
    assert (again.Ts, again.start) == (recording.Ts, recording.start)
    assert (tmp_path / "run.csv").read_text().startswith("t,voltage,theta,alpha\n86400.5,")
    named = {"acceleration of the base, filtered [m/s^2]": PUSH, "second motor [A]": 2 * PUSH}
    save_csv(recording.with_signals(named), tmp_path / "moving.csv")
    again = load(tmp_path / "moving.csv", signals=list(named))
    np.testing.assert_array_equal(again.y, recording.y)
    assert list(again.signals) == list(named)
    for name, values in named.items():
        np.testing.assert_array_equal(again.signals[name], values)


def test_what_is_saved_in_other_units_keeps_them(tmp_path: Path) -> None:
    moved = Recording(u=U, y=np.rad2deg(Y), Ts=Ts, units=("deg", "deg"), input_name="goal", input_unit="rad")
    path = save_csv(moved, tmp_path / "run.csv")
    assert path.read_text().startswith("t,goal [rad],theta [deg],alpha [deg]\n")
    again = load(path, input="goal")
    assert (again.input_name, again.input_unit, again.units) == ("goal", "rad", ("rad", "rad"))
    np.testing.assert_allclose(again.y, Y, rtol=1e-14)


def test_a_unit_of_the_file_is_not_called_radians(tmp_path: Path) -> None:
    speed = write_text(tmp_path / "speed.csv", "t,voltage,theta [rad],n [rad/s]")
    assert load(speed, outputs={"theta": "theta", "speed": "n"}).units == ("rad", "rad/s")
    turned = load(write_text(tmp_path / "deg.csv", "t,voltage,theta [deg],n [deg/s]"), outputs=("theta", "n"))
    assert turned.units == ("rad", "rad/s")
    np.testing.assert_allclose(turned.y, np.deg2rad(Y), rtol=1e-14)
    remark = write_text(tmp_path / "remark.csv", "t,voltage,theta (measured),alpha (strain gauge)")
    assert load(remark).units == ("rad", "rad")
    small = write_text(tmp_path / "small.csv", "t,voltage,theta [mrad],alpha [mrad]")
    german = write_text(tmp_path / "german.csv", "t,voltage,theta [rad],alpha [Grad]")
    counted = write_text(tmp_path / "counted.csv", "t,voltage,theta [counts],alpha [rad]")
    assert load(small, units={"theta": "mrad", "alpha": "mrad"}).units == ("mrad", "mrad")
    assert load(small, accept=("units",)).units == ("rad", "rad")
    assert load(counted, counts={"theta": 4096}, accept=("swapped",)).units == ("rad", "rad")
    for path, options, phrase in (
        (small, {}, r"is in mrad by its name, but an output .* pass units=\{'theta': 'mrad'\}, or convert"),
        (small, {"units": {"theta": "m"}}, "is in mrad by its name, but was given in m; leave out that unit"),
        (small, {"degrees": True}, "is in mrad by its name, but degrees=True was given"),
        (german, {}, "'alpha .Grad.' is in Grad by its name, but an output is taken in rad unless"),
        (counted, {}, "is in counts by its name, but an output .* pass counts=4096 or what one turn has,"),
    ):
        with pytest.raises(InputError, match=phrase):
            load(path, **options)


@pytest.mark.parametrize(
    ("column", "unit", "given", "factor"),
    [
        ("x [mm]", "mm", "m", 1e-3),
        ("x [cm/s]", "cm/s", "m/s", 1e-2),
        ("x [µm]", "µm", "m", 1e-6),
        ("x [mrad]", "mrad", "rad", 1e-3),
        ("x [rpm]", "rpm", "rad/s", np.pi / 30),
        ("x [1/min]", "1/min", "rad/s", np.pi / 30),
        ("x_mm", "mm", "m", 1e-3),
        ("x_rpm", "rpm", "rad/s", np.pi / 30),
    ],
)
def test_the_unit_of_the_file_is_converted_to_the_one_that_is_given(
    column: str, unit: str, given: str, factor: float, tmp_path: Path
) -> None:
    path = write_text(tmp_path / "run.csv", f"t,voltage,{column},alpha [rad]")
    found = load(path, outputs={"x": column}, units={"x": given})
    assert found.units == (given,)
    np.testing.assert_allclose(found.y[:, 0], factor * Y[:, 0], rtol=1e-14)
    note = f"Column {column!r} was converted from {unit} because of its name."
    assert [str(f) for f in found.remarks if f.kind == "converted"] == [note] * ("[" not in column)
    kept = load(path, outputs={"x": column}, units={"x": unit})
    assert kept.units == (unit,)
    np.testing.assert_array_equal(kept.y[:, 0], Y[:, 0])
    with pytest.raises(InputError, match=f"is in {unit} by its name, but an output is taken in rad unless"):
        load(path, outputs={"x": column})


@pytest.mark.parametrize("unit", ["ns", "min", "h"])
def test_a_time_in_a_unit_that_is_not_read_is_refused(unit: str, tmp_path: Path) -> None:
    path = write_text(tmp_path / "run.csv", f"t [{unit}],voltage,theta,alpha")
    with pytest.raises(
        InputError, match=rf"'t \[{unit}\]' is in {unit} by its name, but a time is read in s, ms"
    ):
        load(path)
    assert load(path, accept=("units",)).Ts == pytest.approx(Ts)


def test_unit_of_nothing_in_the_recording_is_refused(tmp_path: Path) -> None:
    path = write_text(tmp_path / "run.csv")
    assert load(path, units={"theta": "rad", "voltage": "V"}).units == ("rad", "rad")
    phrase = "names 'thet', but the channels are theta, alpha and the input is 'voltage'; name one of these"
    with pytest.raises(InputError, match=phrase):
        load(path, units={"thet": "deg"})
