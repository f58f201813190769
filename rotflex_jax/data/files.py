"""Recordings from files and DataFrames, and back into text.

Objects of other packages are recognised by their attributes `u`, `y`, `sampling_time`, and if present
`state_initialization_window_length` and `name`; those packages are not imported.
"""

import csv
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Real

from rotflex_jax.checks import real, shown
from rotflex_jax.data.binary import (
    table_from_frame,
    table_from_mat,
    table_from_npz,
    table_from_parquet,
    table_from_xlsx,
)
from rotflex_jax.data.logs import Channel, table_from_mcap, table_from_mdf, table_from_tdms, table_of_channels
from rotflex_jax.data.tables import (
    MAX_BYTES,
    Table,
    TimedSignal,
    check_size,
    name_and_unit,
    resampled,
    resampled_apart,
    table_from_json,
    table_from_text,
    unreadable,
)
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import Finding, acceptable, whole_numbers
from rotflex_jax.recording.recording import single
from rotflex_jax.recording.samples import even_spacing, finite, real_numbers, sampling_period
from rotflex_jax.text.files import write_file

READERS: dict[str, Callable[[Path, int], Table]] = {
    ".csv": table_from_text,
    ".tsv": table_from_text,
    ".txt": table_from_text,
    ".mat": table_from_mat,
    ".npz": table_from_npz,
    ".parquet": table_from_parquet,
    ".xlsx": table_from_xlsx,
    ".tdms": table_from_tdms,
    ".mf4": table_from_mdf,
    ".mcap": table_from_mcap,
}


def read_table(source: Any, max_bytes: int = MAX_BYTES, time: str | None = None) -> Table:
    """Reads a file by its ending, files with one channel each, or takes a DataFrame.

    Args:
        source: path of a file, several, or that of a folder with one file for each channel; or a pandas
            DataFrame.
        max_bytes: largest size of a file, and of what it unpacks to [bytes].
        time: column of the time in each of several files, where it has another name than `t` or `time`.

    Returns:
        The table.

    Raises:
        InputError: no such file, nothing in it, unknown ending, too large, or not what the ending says.
    """
    if hasattr(source, "columns") and hasattr(source, "to_numpy"):
        return table_from_frame(source)
    if isinstance(source, list | tuple):
        return _together(source, f"{len(source)} files", max_bytes, time)
    if isinstance(source, str | os.PathLike) and os.path.isdir(source):
        folder = Path(source)
        files = sorted(p for p in folder.iterdir() if p.suffix.lower() in READERS and p.is_file())
        try:
            return _together(files, f"{folder!s:.300}", max_bytes, time)
        except InputError as error:
            if not files:
                raise
            told = f"The folder {folder!s:.100} as one recording with a file for each channel: {error}"
            raise InputError(told) from error
    path = readable_file(source)
    # Beside recordings JSON files hold settings and results: one is read where it is named itself.
    reader = table_from_json if path.suffix.lower() == ".json" else READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(
            f"{path.name} has the ending {path.suffix or '(none)'}, but a recording is read from "
            f"{', '.join(READERS)}; rename or export it."
        )
    check_size(path.name, path.stat().st_size, max_bytes, "has")
    try:
        return reader(path, max_bytes)
    except (OSError, MemoryError, csv.Error) as error:
        raise unreadable(path, "a recording", error) from error


def _together(sources: Sequence[Any], label: str, max_bytes: int, time: str | None) -> Table:
    """One table of files with a channel or more each.

    Channels have the names of the columns; where two are equal, those of the files that have one each.
    """
    if not sources:
        raise InputError(
            f"{label} is a folder, but a recording is one file, or a folder with a file for each channel, "
            f"which end in {', '.join(READERS)}; name the file."
        )
    paths = [readable_file(source) for source in sources]
    tables = [read_table(path, max_bytes) for path in paths]
    clocks: dict[str, Any] = {}
    units: set[str] = set()
    channels: list[Channel] = []
    alone: list[str | None] = []  # names of files with one channel
    for path, table in zip(paths, tables, strict=True):
        clock = table.find(time or "t", *(() if time else OTHER_NAMES["t"]))
        own = [name for name in table.columns if name != clock]
        if not own:
            raise InputError(f"{table.label} has no column beside the time; export that channel again.")
        group = path.stem
        if clock in table.columns:
            t = real_numbers(
                table.columns[clock], f"{table.label}: column {clock!r}", table.where, table.first
            )
            units.add(name_and_unit(clock)[1] or table.units.get(clock, ""))
            # Files with equal times share their clock.
            group = next((g for g, other in clocks.items() if np.array_equal(t, other)), group)
            clocks.setdefault(group, t)
        channels += [Channel(group, name, table.units.get(name, ""), table.columns[name]) for name in own]
        alone += [path.stem] if len(own) == 1 else [None] * len(own)
    if len(units) > 1:
        named = " and ".join(repr(unit) for unit in sorted(units))
        raise InputError(f"{label}: the times are in {named}, but must have one unit; export them alike.")
    if len({channel.name for channel in channels}) < len(channels):
        channels = [
            c if name is None else c._replace(name=name) for c, name in zip(channels, alone, strict=True)
        ]
    unit = "".join(units)
    return table_of_channels(label, channels, clocks, f"t [{unit}]" if unit else "t")


def readable_file(source: Any) -> Path:
    """The path of a file that is there, readable and not empty.

    Raises:
        InputError: it is not.
    """
    if not isinstance(source, str | os.PathLike):
        raise InputError(
            f"A recording is read from a path or a DataFrame, but {type(source).__name__} was "
            "given; make a Recording of arrays with Recording(u=..., y=..., Ts=...)."
        )
    path = Path(source)
    try:
        status = path.stat()
    except (OSError, ValueError) as error:  # a name that is too long or a circle of links is none either
        missing = isinstance(error, FileNotFoundError | NotADirectoryError)
        reason = "" if missing else f" ({getattr(error, 'strerror', None) or error})"
        there = "may not be read" if isinstance(error, PermissionError) else "does not exist"
        raise InputError(f"{path!s:.300} {there}{reason}; give the path of a recording.") from error
    if path.is_dir():
        raise InputError(f"{path} is a folder, but a recording is one file; name the file.")
    if not path.is_file():
        raise InputError(f"{path} is a device or a pipe, but a recording is a file; save it in one first.")
    if status.st_size == 0:
        raise InputError(f"{path.name} is empty; export the recording again.")
    if not os.access(path, os.R_OK):
        raise InputError(f"{path.name} may not be read; change its permissions.")
    return path


FOREIGN_NAMES = {
    "Ts": ("sampling_time", "Ts", "dt"),
    "n_init": ("state_initialization_window_length", "n_init"),
}
"""Attribute of a recording -> names that other packages give it."""


def is_foreign(source: Any) -> bool:
    """Whether an object holds an input and outputs.

    >>> from types import SimpleNamespace
    >>> is_foreign(SimpleNamespace(u=[1.0], y=[2.0])), is_foreign("run.csv")
    (True, False)
    """
    # A table with columns u and y has these attributes too.
    table = isinstance(source, Mapping | Recording) or hasattr(source, "columns")
    return not table and hasattr(source, "u") and hasattr(source, "y")


def from_foreign(
    source: Any,
    channels: str | Sequence[str] | None = None,
    units: Mapping[str, str] | None = None,
    Ts: float | None = None,
    accept: str | Sequence[str] = (),
) -> Recording:
    """A recording from an object with `u` and `y`.

    Such objects name neither channels nor units, so give them; one output is called `output` otherwise,
    several `output_1`, `output_2` and so on, without a unit.

    Args:
        source: the object.
        channels: names of the outputs, in order.
        units: channel to unit.
        Ts: sampling period [s], where the object has none.
        accept: faults to accept, as in `Recording`.

    Returns:
        The recording; its `n_init` is the object's, if it has one.

    Raises:
        InputError: no sampling period, or as `Recording`.

    >>> from types import SimpleNamespace
    >>> k = np.arange(100)
    >>> run = SimpleNamespace(u=np.sin(k), y=np.cos(k), sampling_time=0.01, name="train",
    ...     state_initialization_window_length=20)
    >>> from_foreign(run, channels="position", units={"position": "m"}).n_init
    20
    """
    label = str(getattr(source, "name", "") or type(source).__name__)
    known = {key: _first(source, names) for key, names in FOREIGN_NAMES.items()}
    period = known["Ts"] if Ts is None else Ts
    if period is None:
        raise InputError(f"{label} has no sampling_time, but a recording needs one; give Ts= in seconds.")
    y = real_numbers(source.y, f"{label}: `y`")
    width = 1 if y.ndim < 2 else y.shape[1]
    numbered = ["output"] if width == 1 else [f"output_{k + 1}" for k in range(width)]
    given = numbered if channels is None else [channels] if isinstance(channels, str) else list(channels)
    return Recording(
        u=real_numbers(source.u, f"{label}: `u`"),
        y=y,
        Ts=float(np.asarray(period)),
        channels=given,
        units=[(units or {}).get(name, "") for name in given],
        n_init=known["n_init"],
        source=label,
        accept=accept,
    )


def _first(source: Any, names: Sequence[str]) -> Any:
    """The first of these attributes that is not None."""
    return next((v for n in names if (v := getattr(source, n, None)) is not None), None)


OTHER_NAMES = {"t": ("time",), "theta": ("θ",), "alpha": ("α",)}
"""What the columns of the joint may be called as well."""

JOINT_SENSORS = ("theta", "alpha", "speed")
"""Columns that a joint may have as sensors."""

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
"""Unit of a time -> seconds."""

TIME_WORDS = {
    "sec": "s",
    "second": "s",
    "seconds": "s",
    "msec": "ms",
    "milliseconds": "ms",
    "µs": "us",
    "μs": "us",
}
"""Other ways to write them."""

ANGLE_UNITS = {
    "rad": {"rad", "rads", "radian", "radians"},
    "deg": {"deg", "degs", "degree", "degrees", "°"},
}


def load(
    source: Any,
    *,
    input: str | None = None,
    outputs: str | Sequence[str] | Mapping[str, str] | None = None,
    degrees: bool = False,
    Ts: float | None = None,
    time: str | None = None,
    accept: str | Sequence[str] = (),
    units: Mapping[str, str] | None = None,
    max_bytes: int = MAX_BYTES,
    counts: float | Mapping[str, float] | None = None,
    arm_absolute: bool = False,
    time_unit: str | None = None,
    resample: float | str | None = None,
) -> Recording:
    """Reads a recording and checks it; nothing is repaired unless it is asked for by name.

    Text (.csv, .tsv, .txt; any delimiter), MATLAB (.mat of any version), NumPy (.npz), Parquet,
    spreadsheets (.xlsx), LabVIEW (.tdms), MDF4 (.mf4), ROS 2 (.mcap), or a pandas DataFrame; a folder or a
    list of files with one channel each is one recording. Columns `t,voltage,theta,alpha` in seconds,
    volts and radians unless other names are given; capitals and a unit behind the name, as in
    `Theta [deg]`, are understood. In .mat and .npz, a matrix `log` gives the columns `log[0]`, `log[1]`,
    and a structure `log` with a field `u` the column `log.u`. An object that has `u`, `y` and
    `sampling_time`, such as those of `nonlinear_benchmarks`, is taken as it is, with the channels named in
    `outputs`.

    Args:
        source: path of a file, or of a folder with a file for each channel; a list of such files; a
            DataFrame; or an object with `u` and `y`.
        input: column of the motor voltage [V].
        outputs: columns of theta, then of alpha [rad]; or a mapping of channel name to column.
        degrees: whether the outputs are in degrees.
        Ts: sampling period [s], where no column has the time.
        time: column of the time [s].
        accept: faults to accept by name, such as `saturated`; see `Recording`.
        units: channel to unit, where it is not rad; the column of the input to its unit, where that is not V.
        max_bytes: largest size of the file, and of what it unpacks to [bytes].
        counts: counts of one turn, where the outputs are the counts of an encoder; or a mapping of channel to
            counts, the others being angles.
        arm_absolute: whether alpha is the angle of the arm in the room, from which theta is then subtracted.
        time_unit: of the time, "s", "ms" or "us"; what the header says, else seconds.
        resample: sampling period to have [s], or "auto" for the usual one, where times are uneven, or signals
            have times of their own: the
            input is held, outputs follow straight lines, and a finding says what was done.

    Returns:
        The recording.

    Raises:
        InputError: the file or its data are unusable; the message says what to do.

    >>> import pandas as pd
    >>> k = np.arange(100)
    >>> frame = pd.DataFrame({"t": k / 50, "volts": np.sin(k), "theta": 0.01 * np.cos(k)})
    >>> load(frame, input="volts", outputs="theta")
    Recording(100 samples, 2 s at 50 Hz, voltage [V] to theta [rad], DataFrame)
    >>> load(frame, input="volts", outputs="theta", units={"volts": "rad"})
    Recording(100 samples, 2 s at 50 Hz, volts [rad] to theta [rad], DataFrame)
    >>> turned = pd.DataFrame({"Time [ms]": 20 * k, "Voltage [V]": np.sin(k), "Theta [deg]": np.cos(k)})
    >>> load(turned, outputs="theta").y[0]
    array([0.01745329])
    """
    accepted = acceptable(accept)
    if resample is not None and Ts is not None:
        raise InputError(
            f"Argument `resample` and Ts={shown(Ts)} were both given, but resampling "
            "needs the times of the samples, and that period stands in their place; leave one of the two out."
        )
    if is_foreign(source):
        names = list(outputs) if isinstance(outputs, Mapping) else outputs
        return from_foreign(source, names, units, Ts, accepted)
    table = read_table(source, sys.maxsize if "huge" in accepted else max_bytes, time)
    u_name = table.find("voltage" if input is None else input)
    chosen = {
        channel: table.find(name, *OTHER_NAMES.get(name, ())) for channel, name in _outputs(outputs).items()
    }
    if u_name in chosen.values():
        raise InputError(
            f"{table.label}: the column {u_name!r} was given as input and as output, but it can be "
            "only one; correct input= or outputs=."
        )
    clock = table.find(time or "t", *(() if time else OTHER_NAMES["t"]))
    names = [u_name, *chosen.values()]
    own = list(dict.fromkeys(clock for name, clock in table.clocks.items() if name in names))
    if own and clock not in table.columns:  # the file says what times a signal has
        clock = own[0]
    apart = len(own) > 1 and any(not np.array_equal(table.columns[c], table.columns[own[0]]) for c in own)
    stamps = [] if Ts is not None and time is None else [(clock, "time=")]
    table.check([(u_name, "input="), *((name, "outputs=") for name in chosen.values()), *stamps])
    u = _column(table, u_name, "input=", {"mv": "volts"})
    per_turn = _counts(counts, tuple(chosen), degrees)
    y = {}
    for channel, name in chosen.items():
        values = _column(table, name, "outputs=", {})
        per = per_turn.get(channel)
        unit = (units or {}).get(channel, "rad")
        if unit.startswith("rad"):
            y[channel] = _angle(table, channel, name, values, degrees, per, accepted)
        elif degrees or per is not None:
            raise InputError(
                f"{table.label}: column {name!r} was to be converted to rad, but its unit is given as "
                f"{unit!r}; leave out the unit, or the conversion (degrees, counts)."
            )
        else:
            y[channel] = values
        if len(values) != len(u) and not apart:
            raise InputError(
                f"{table.label}: {u_name!r} has {len(u)} samples and {name!r} has "
                f"{len(values)}, but they must be measured together; cut both to the same ones."
            )
    if arm_absolute:
        y = _deflection(y)
    remarks = _unused(table, tuple(y), {u_name, clock, *chosen.values()})
    if apart:
        if resample is None:
            raise InputError(
                f"{table.label}: {', '.join(map(repr, names))} have times of their own "
                f"({', '.join(own)}), but are needed at the same ones; bring them together with "
                "resample='auto', or give a sampling period in its place."
            )
        any_unit = "units" in accepted
        stamps_of = {
            c: _stamps(table, c, time_unit, len(table.columns[c]), any_unit) for c in dict.fromkeys(own)
        }
        signals = [
            TimedSignal(
                stamps_of[c := table.clocks[name]], x[:, None], k == 0, f"{table.label}: the time {c!r}"
            )
            for k, (name, x) in enumerate(zip(names, [u, *y.values()], strict=True))
        ]
        start, period, brought, told = resampled_apart(signals, resample, table.where, table.first)
        u, together = brought[0][:, 0], np.column_stack(brought[1:])
        remarks.append(told)
    elif resample is None:
        together = np.column_stack(list(y.values()))
        start, period = _timing(table, clock, time, Ts, time_unit, len(u), "units" in accepted)
    else:
        together = np.column_stack(list(y.values()))
        t = _stamps(table, clock, time_unit, len(u), "units" in accepted)
        at = f"{table.label}: the time {clock!r}", table.where, table.first
        start, period, u, together, told = resampled(t, u, together, resample, *at)
        remarks.append(told)
    try:
        other = (units or {}).get(u_name) or _input_unit(table, u_name)
        recording = Recording(
            u=u,
            input_name="voltage" if other is None else name_and_unit(u_name)[0],
            input_unit=other or "V",
            y=together,
            Ts=period,
            channels=tuple(y),
            units=tuple((units or {}).get(channel, "rad") for channel in y),
            source=table.label,
            start=start,
            accept=accepted,
            remarks=remarks,
        )
    except InputError as error:
        raise InputError(f"{table.label}: {error}") from error
    for finding in recording.findings:
        # Arrays come from a program that knows what they are; the columns of a file are less certain.
        if finding.kind in ("units", "absolute", "swapped") and finding.kind not in accepted:
            raise InputError(f"{table.label}: {finding.message}")
    if table.cut:  # said of the file, not of parts of the recording
        cut = Finding("cut", [*table.columns][-1], table.cut, "note")
        vars(recording)["findings"] = (*recording.findings, cut)
    return recording


def _unused(table: Table, channels: Sequence[str], used: set[str]) -> list[Finding]:
    """What is said of sensors of a joint that the file has too, where one alone is read."""
    if len(channels) != 1 or channels[0] not in JOINT_SENSORS:
        return []
    there = {c: table.find(c, *OTHER_NAMES.get(c, ())) for c in JOINT_SENSORS}
    left = {c: name for c, name in there.items() if name in table.columns and name not in used}
    if not left:
        return []
    sensors = [c for c in JOINT_SENSORS if c in left or c in channels]
    others = ", ".join(map(repr, left.values()))
    message = (
        f"{table.label}: {channels[0]} alone is read, though the file has {others} too; for a search with "
        f"all of them give a joint with these sensors, --joint paper:sensors={'+'.join(sensors)}."
    )
    return [Finding("unused", next(iter(left)), message, "warning")]


def save_csv(recording: Recording, path: str | os.PathLike[str]) -> Path:
    """Writes a recording as text that `load` reads: time, input, outputs.

    Args:
        recording: what to write.
        path: of the file, which is replaced if it exists.

    Returns:
        The path.

    Raises:
        InputError: it cannot be written; an old file stays.
    """
    recording = single(recording, "recording")
    header = ",".join(["t", recording.input_name, *recording.channels])
    columns = np.column_stack([recording.t, recording.u, recording.y])
    # 17 digits carry a number exactly; the time is known to fewer.
    formats = ["%.15g"] + ["%.17g"] * (columns.shape[1] - 1)
    np.savetxt(text := StringIO(), columns, fmt=formats, delimiter=",", header=header, comments="")
    return write_file(path, text.getvalue())


def _outputs(outputs: Any) -> dict[str, str]:
    """Channel name to column name."""
    if outputs is None:
        return {"theta": "theta", "alpha": "alpha"}
    chosen: dict[str, Any]
    if isinstance(outputs, Mapping):
        chosen = dict(outputs)
    else:
        names = list(outputs) if isinstance(outputs, list | tuple) else [outputs]
        chosen = dict(zip(("theta", "alpha"), names, strict=False)) if len(names) <= 2 else {}
    if not chosen or len(set(map(str, chosen.values()))) < len(chosen):
        raise InputError(
            f"Argument `outputs` must name the column of theta, then that of alpha, but is "
            f"{outputs!r}; for other channels give a mapping such as {{'position': 'column'}}."
        )
    return chosen


def _column(table: Table, name: str, argument: str, wrong: Mapping[str, str]) -> Real[np.ndarray, " N"]:
    values = table.column(name, argument)
    label = f"{table.label}: column {name!r}"
    for unit in _words(table, name) & set(wrong):
        raise InputError(
            f"{label} is in {unit} by its {_unit_source(name, unit)}, but {wrong[unit]} are needed; "
            + ("pass time_unit='ms'." if unit == "ms" else "convert and rename it.")
        )
    numbers = real_numbers(values, label, table.where, table.first)
    finite(numbers, label, table.where, table.first)
    return numbers


def _words(table: Table, name: str) -> set[str]:
    """The words of a name and of its unit, in small letters."""
    return set(re.split(r"[^a-z°]+", f"{name} {table.units.get(name, '')}".lower()))


def _unit_source(name: str, unit: str) -> str:
    """Where the unit of a column comes from."""
    return "name" if unit in name.lower() else "line of units"


def _input_unit(table: Table, name: str) -> str | None:
    """The unit of the input where the file says that it is another than volts."""
    unit = name_and_unit(name)[1] or table.units.get(name, "").strip(" []()")
    if not unit and "current" in _words(table, name):
        return "A"
    return None if unit.lower() in ("", "v", "volt", "volts", "-", "–", "1") else unit


def _counts(counts: Any, channels: Sequence[str], degrees: bool) -> dict[str, float]:
    """Channel -> counts of one turn."""
    if counts is None:
        return {}
    each: dict[str, Any] = dict(counts) if isinstance(counts, Mapping) else dict.fromkeys(channels, counts)
    if degrees and not isinstance(counts, Mapping):
        raise InputError(
            f"Arguments counts={counts} and degrees=True were both given, but a column holds one of the two; "
            "give one, or the counts of the channels that have them, such as counts={'theta': 4096}."
        )
    for channel, value in each.items():
        if channel not in channels:
            raise InputError(
                f"Argument `counts` names the channel {channel!r}, but the recording has "
                f"{', '.join(channels)}; name one of these."
            )
        if not 1 <= real(value) < 1e12:
            raise InputError(
                f"Argument `counts` must be the counts of one turn, a number from 1 on, but is {shown(value)}"
                "; give for instance 4096, four times the lines of an encoder that is counted at every edge."
            )
    return {channel: float(value) for channel, value in each.items()}


def _angle(
    table: Table,
    channel: str,
    name: str,
    values: Real[np.ndarray, " N"],
    degrees: bool,
    counts: float | None,
    accepted: Sequence[str],
) -> Real[np.ndarray, " N"]:
    """An output in radians: from counts, from degrees, or as it is."""
    if counts is not None:
        return values * (2 * np.pi / counts)
    behind = set(re.split(r"[^a-z°]+", name_and_unit(name)[1].lower()))
    if behind & ANGLE_UNITS["deg"]:  # the header says so, right behind the name
        degrees = True
    else:
        _check_angle_unit(table, name, degrees)
    if degrees and whole_numbers(values) and "units" not in accepted:
        # Of a joint, in degrees: no encoder is so coarse, and no arm bends so far.
        most = 90.0 if channel == "alpha" else 1000.0
        if np.ptp(values) > most:
            raise InputError(
                f"{table.label}: column {name!r} holds whole numbers from {values.min():g} to "
                f"{values.max():g}, as the counts of an encoder are, but degrees=True was given; give the "
                "counts of one turn in its place, counts=4096 for instance, or accept=('units',)."
            )
    return np.deg2rad(values) if degrees else values


def _deflection(y: dict[str, Real[np.ndarray, " N"]]) -> dict[str, Real[np.ndarray, " N"]]:
    """The arm's angle in the room as its deflection from the hub."""
    if not {"theta", "alpha"} <= set(y):
        raise InputError(
            f"Argument arm_absolute=True needs the channels theta and alpha, but the outputs are "
            f"{', '.join(y)}; leave it out, or name both."
        )
    return {channel: x - y["theta"] if channel == "alpha" else x for channel, x in y.items()}


def _check_angle_unit(table: Table, name: str, degrees: bool) -> None:
    given, other = ("deg", "rad") if degrees else ("rad", "deg")
    words = _words(table, name)
    if words & ANGLE_UNITS[other] and not words & ANGLE_UNITS[given]:
        word = min(words & ANGLE_UNITS[other])
        raise InputError(
            f"{table.label}: column {name!r} is in {other} by its {_unit_source(name, word)}, but "
            f"degrees={degrees} was given; pass degrees={not degrees}, or correct what the file says."
        )


def _stamps(
    table: Table, name: str, time_unit: str | None, samples: int, any_unit: bool
) -> Real[np.ndarray, " N"]:
    """The times of all samples [s]."""
    if time_unit is not None and time_unit not in TIME_UNITS:
        raise InputError(
            f"Argument `time_unit` must be one of {', '.join(TIME_UNITS)}, but is {time_unit!r}; give "
            "for instance time_unit='ms'."
        )
    behind = name_and_unit(name)[1].lower()
    unit = time_unit or TIME_WORDS.get(behind, behind if behind in TIME_UNITS else None)
    t = _column(table, name, "time=", {} if any_unit or unit else {"ms": "seconds"})
    if len(t) != samples:
        raise InputError(
            f"{table.label}: the time {name!r} has {len(t)} stamps for {samples} samples, but each sample "
            "needs one; name the right column with time=."
        )
    return t.astype(float) * TIME_UNITS[unit] if unit and unit != "s" else t.astype(float)


def _timing(
    table: Table,
    name: str,
    time: str | None,
    Ts: float | None,
    time_unit: str | None,
    samples: int,
    any_unit: bool,
) -> tuple[float, float]:
    """Time of the first sample and sampling period [s], from the column, the argument or both."""
    if Ts is not None:
        Ts = sampling_period(Ts)
    if time is None and name not in table.columns:
        if Ts is None:
            table.column("t", "time=, or give the sampling period with Ts=")
        return 0.0, float(Ts or 0.0)
    t = _stamps(table, name, time_unit, samples, any_unit)
    label = f"{table.label}: the time {name!r}"
    measured = even_spacing(t, label, table.where, table.first)
    if Ts is not None and abs(measured - Ts) > 0.01 * Ts:
        raise InputError(
            f"{label} advances by {measured:g} s, but Ts={Ts:g} was given; leave Ts out, or correct it."
        )
    if measured >= 0.5 and not any_unit and time_unit is None:
        raise InputError(
            f"{label} advances by {measured:g} per sample, too slow for a joint: it looks like "
            "milliseconds; pass time_unit='ms', or time_unit='s' if these are seconds."
        )
    return float(t[0]), measured
