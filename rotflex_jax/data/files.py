"""Recordings from files and DataFrames, and their export as text."""

import csv
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from rotflex_jax.checks import positive, shown, yes_or_no
from rotflex_jax.data.binary import (
    table_from_frame,
    table_from_mat,
    table_from_npz,
    table_from_parquet,
    table_from_xlsx,
)
from rotflex_jax.data.columns import (
    clock_column,
    column_of,
    conversions_by_name,
    counts_per_turn,
    deflection,
    input_column,
    input_unit,
    named_outputs,
    named_signals,
    output,
    sensor_column,
    stated_unit,
    time_stamps,
    time_unit_of,
    timing,
    unused_sensors,
)
from rotflex_jax.data.foreign import from_foreign, is_foreign
from rotflex_jax.data.logs import Channel, table_from_mcap, table_from_mdf, table_from_tdms, table_of_channels
from rotflex_jax.data.tables import (
    MAX_BYTES,
    Table,
    TimedSignal,
    check_size,
    distinct,
    name_and_unit,
    resampled,
    resampled_apart,
    table_from_json,
    table_from_text,
    unreadable,
)
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import DOUBTED, SLOWEST_SAMPLING, Finding, acceptable, converted
from rotflex_jax.recording.recording import single, with_findings_on_file
from rotflex_jax.recording.samples import real_numbers
from rotflex_jax.text.files import path_of, write_file

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
    ".json": table_from_json,
}
# In a folder of recordings, JSON files contain settings and results: they are read only if named directly.
FILES_OF_CHANNELS = tuple(ending for ending in READERS if ending != ".json")


def read_table(source: Any, max_bytes: int = MAX_BYTES, time: str | None = None) -> Table:
    """Reads a file according to its ending, or files with one channel each, or takes a DataFrame.

    Args:
        source: path of a file, several paths, or path of a folder with one file for each channel; or a pandas
            DataFrame.
        max_bytes: largest size of a file, packed and unpacked [bytes].
        time: column of the time in each of several files, if its name is not `t` or `time`.

    Returns:
        The table.

    Raises:
        InputError: the file does not exist, is empty, has an unknown ending, is too large, or does not have
            the format of its ending.
    """
    if hasattr(source, "columns") and hasattr(source, "to_numpy"):
        return table_from_frame(source)
    if isinstance(source, list | tuple):
        if not source:
            raise InputError("A list of files was given, but it is empty; name a file for each channel.")
        return _together(source, f"{len(source)} files", max_bytes, time)
    if isinstance(source, str | os.PathLike) and os.path.isdir(source):
        folder = Path(source)
        files = sorted(p for p in folder.iterdir() if p.suffix.lower() in FILES_OF_CHANNELS and p.is_file())
        try:
            return _together(files, f"{folder!s:.300}", max_bytes, time)
        except InputError as error:
            if not files:
                raise
            message = f"The folder {folder!s:.100} as one recording with a file for each channel: {error}"
            raise InputError(message) from error
    path = readable_file(source)
    reader = READERS.get(path.suffix.lower())
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
    """One table from files with one or more channels each.

    Channels have the names of the columns. If two names are equal, a file with a single channel gives the
    channel its own name.
    """
    if not sources:
        raise InputError(
            f"{label} is a folder, but a recording is one file, or a folder with a file for each channel, "
            f"which end in {', '.join(FILES_OF_CHANNELS)}; name the file."
        )
    paths = [readable_file(source) for source in sources]
    tables = [read_table(path, max_bytes) for path in paths]
    clocks: dict[str, Any] = {}
    units: set[str] = set()
    channels: list[Channel] = []
    alone: list[str | None] = []  # names of files with one channel
    file_of: dict[tuple[str, str], Path] = {}
    for path, table in zip(paths, tables, strict=True):
        clock = clock_column(table, time)
        own = [name for name in table.columns if name != clock]
        if not own:
            raise InputError(f"{table.label} has no column beside the time; export that channel again.")
        group = path.stem
        if clock in table.columns:
            t = real_numbers(
                table.columns[clock], f"{table.label}: column {clock!r}", table.where, table.first
            )
            stated = stated_unit(table, clock)
            unit = time_unit_of(table, clock)[0] or stated
            units.add("" if unit == "s" and not stated else unit)  # seconds need not be named
            # Files with equal times share their clock.
            group = next((g for g, other in clocks.items() if np.array_equal(t, other)), group)
            clocks.setdefault(group, t)
        for name in own:
            other = file_of.setdefault((group, name), path)
            if other != path and len(own) > 1:
                raise InputError(
                    f"{other.name} and {path.name} both have the channel {name!r}, but one recording has "
                    "each channel once; give one file alone, or give the channels different names."
                )
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
    """The path of a file that exists, is readable and is not empty.

    Raises:
        InputError: the file is not so.
    """
    if not isinstance(source, str | os.PathLike):
        raise InputError(
            f"A recording is read from a path or a DataFrame, but {type(source).__name__} was "
            "given; make a Recording of arrays with Recording(u=..., y=..., Ts=...)."
        )
    path = Path(source)
    try:
        status = path.stat()
    except (OSError, ValueError) as error:  # also for a name that is too long, or for a loop of links
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


def _check_options(words: Mapping[str, Any], choices: Mapping[str, Any], units: Any, resample: Any) -> None:
    """Refuses options of `load` that do not have the right type."""
    for name, word in words.items():
        example = {"input": "voltage", "time": "t"}.get(name, "ms")
        if not (word is None or isinstance(word, str)):
            raise InputError(
                f"Argument `{name}` must be a word, but is {shown(word)}; give for instance "
                f"{name}={example!r}."
            )
    for name, choice in choices.items():
        yes_or_no(choice, name)
    pairs = units.items() if isinstance(units, Mapping) else [(None, None)] * (units is not None)
    if not all(isinstance(word, str) for pair in pairs for word in pair):
        raise InputError(
            f"Argument `units` must be units by the names of channels, but is {shown(units)}; give for "
            "instance units={'theta': 'rad'}."
        )
    if not (resample is None or isinstance(resample, str)):
        positive(resample, "resample", "s", "'auto'")


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
    signals: str | Sequence[str] | Mapping[str, str] | None = None,
) -> Recording:
    """Reads a recording and checks it; nothing is repaired unless an argument asks for it.

    Formats are text (.csv, .tsv, .txt; any delimiter), JSON, MATLAB (.mat of any version), NumPy (.npz),
    Parquet, spreadsheets (.xlsx), LabVIEW (.tdms), MDF4 (.mf4), ROS 2 (.mcap), and pandas DataFrames. A
    folder or a list of files with one channel each is one recording. The default columns are
    `t,voltage,theta,alpha` in seconds, volts and radians. Capital letters and a unit after the name, as in
    `Theta [deg]`, are understood. In .mat and .npz, a matrix `log` gives the columns `log[0]`, `log[1]`, and
    a structure `log` with a field `u` gives the column `log.u`. An object that has `u`, `y` and
    `sampling_time`, such as those of `nonlinear_benchmarks`, is taken unchanged, with the channel names in
    `outputs`.

    Args:
        source: path of a file, or of a folder with a file for each channel; a list of such files; a
            DataFrame; or an object with `u` and `y`.
        input: column of the motor voltage [V].
        outputs: columns of theta, then of alpha [rad]; or a mapping of channel name to column.
        degrees: whether all outputs are in degrees; for one of several give `units`.
        Ts: sampling period [s], if no column has the time.
        time: column of the time [s].
        accept: faults to accept by name, such as `saturated`; see `Recording`.
        units: mapping of channel to unit, for units other than rad; `deg` and `deg/s` are converted to rad
            and rad/s, and a column that the file has in mm, cm, um or mrad to m or rad, if that is given.
            Also of the column of the input to its unit, if that is not V.
        max_bytes: largest size of the file, packed and unpacked [bytes].
        counts: counts per turn, if the outputs are counts of an encoder; or a mapping of channel to counts
            per turn, where the other channels are angles.
        arm_absolute: whether alpha is the absolute angle of the arm, from which theta is then subtracted.
        time_unit: unit of the time, "s", "ms" or "us"; by default the unit in the header, else seconds.
        resample: new sampling period [s], or "auto" for the median step, for uneven times or for signals with
            times of their own. The input and `signals` are held, outputs are interpolated linearly, and a
            finding states what was done.
        signals: columns of measured quantities other than the input that act on the machine, such as the
            acceleration of the base, see `Recording`; or a mapping of signal name to column. Their units are
            kept.

    Returns:
        The recording.

    Raises:
        InputError: the file or its data are unusable; the message states what to do.

    >>> import pandas as pd
    >>> k = np.arange(100)
    >>> frame = pd.DataFrame({"t": k / 50, "volts": np.sin(k), "theta": 0.01 * np.cos(k)})
    >>> load(frame, input="volts", outputs="theta")
    Recording(100 samples, 2 s at 50 Hz, voltage [V] to theta [rad], DataFrame)
    >>> goal = frame.rename(columns={"volts": "goal"})
    >>> load(goal, input="goal", outputs="theta", units={"goal": "rad"})
    Recording(100 samples, 2 s at 50 Hz, goal [rad] to theta [rad], DataFrame)
    >>> load(frame, input="volts", outputs="theta", units={"theta": "deg"}).y[0]
    array([0.00017453])
    >>> turned = pd.DataFrame({"Time [ms]": 20 * k, "Voltage [V]": np.sin(k), "Theta [deg]": np.cos(k)})
    >>> load(turned, outputs="theta").y[0]
    array([0.01745329])
    """
    accepted = acceptable(accept)
    _check_options(
        {"input": input, "time": time, "time_unit": time_unit},
        {"degrees": degrees, "arm_absolute": arm_absolute},
        units,
        resample,
    )
    positive(max_bytes, "max_bytes", "bytes", "2e9")
    if resample is not None and Ts is not None:
        raise InputError(
            f"Argument `resample` and Ts={shown(Ts)} were both given, but resampling "
            "needs the times of the samples, and that period stands in their place; leave one of the two out."
        )
    if is_foreign(source):
        if signals is not None:
            raise InputError(
                "Argument `signals` must name columns of a file or a table, but an object with `u` and `y` "
                "was given; leave it out, and give the samples to with_signals() of what is loaded."
            )
        choices = {"input": input, "degrees": degrees or None, "time": time, "counts": counts}
        choices |= {"arm_absolute": arm_absolute or None, "time_unit": time_unit, "resample": resample}
        if said := next((name for name, value in choices.items() if value is not None), None):
            raise InputError(
                f"Argument `{said}` says how to read a file or a table, but an object with `u` and `y` was "
                "given, which is taken unchanged; leave it out, and convert the object before."
            )
        names = list(outputs) if isinstance(outputs, Mapping) else outputs
        return from_foreign(source, names, units, Ts, accepted)
    table = read_table(source, sys.maxsize if "huge" in accepted else max_bytes, time)
    u_name = input_column(table, input)
    chosen = {channel: sensor_column(table, name) for channel, name in named_outputs(outputs).items()}
    if u_name in chosen.values():
        raise InputError(
            f"{table.label}: the column {u_name!r} was given as input and as output, but it can be "
            "only one; correct input= or outputs=."
        )
    given_as = "voltage" if input is None else input
    strange = [name for name in units or {} if name not in (*chosen, u_name, given_as)]
    if strange:
        raise InputError(
            f"Argument `units` names {strange[0]!r}, but the channels are {', '.join(chosen)} and the input "
            f"is {u_name!r}; name one of these."
        )
    acting = named_signals(signals, table)
    for name in acting.values():
        if name in (u_name, *chosen.values()):
            raise InputError(
                f"{table.label}: the column {name!r} was given as a signal and as input or output, but it "
                "can be only one; correct signals=."
            )
    # A unit at the end of a name is not used where units are accepted as they are, or the period is given.
    clock = clock_column(table, time, exact=Ts is not None or "units" in accepted)
    names = [u_name, *acting.values(), *chosen.values()]
    own = list(dict.fromkeys(clock for name, clock in table.clocks.items() if name in names))
    if own and clock not in table.columns:  # the file assigns times to each signal
        clock = own[0]
    apart = len(own) > 1 and any(not np.array_equal(table.columns[c], table.columns[own[0]]) for c in own)
    stamps = [] if Ts is not None and time is None else [(clock, "time=")]
    wanted = [(name, "outputs=") for name in chosen.values()]
    wanted += [(name, "signals=") for name in acting.values()]
    table.check([(u_name, "input="), *wanted, *stamps])
    u = column_of(table, u_name, "input=", {"mv": "volts"})
    held = [u, *(column_of(table, name, "signals=", {}) for name in acting.values())]
    per_turn = counts_per_turn(counts, tuple(chosen), degrees)
    y, unit_of, turned = {}, {}, set()  # the last: channels that have been converted
    for channel, name in chosen.items():
        values = column_of(table, name, "outputs=", {})
        conversion = (units or {}).get(channel), degrees, per_turn.get(channel)
        y[channel], unit_of[channel] = output(table, channel, name, values, *conversion, accepted)
        if y[channel] is not values:
            turned.add(channel)
    for name, values in zip(names, [*held, *y.values()], strict=True):
        if len(values) != len(u) and not apart:
            raise InputError(
                f"{table.label}: {u_name!r} has {len(u)} samples and {name!r} has "
                f"{len(values)}, but they must be measured together; cut both to the same ones."
            )
    if arm_absolute:
        y = deflection(y, table.label, accepted)
    said = set(chosen) if degrees else {*per_turn, *(units or {})}
    read = stamps and time_unit is None and "units" not in accepted
    remarks = unused_sensors(table, tuple(y), {clock, *names})
    converted_from = {c: name for c, name in chosen.items() if c in turned}
    remarks += conversions_by_name(table, converted_from, said, clock if read else "")
    if apart:
        if resample is None:
            raise InputError(
                f"{table.label}: {', '.join(map(repr, names))} have times of their own "
                f"({', '.join(own)}), but are needed at the same ones; bring them together with "
                "resample='auto', or give a sampling period in its place."
            )
        any_unit = "units" in accepted
        stamps_of = {
            c: time_stamps(table, c, time_unit, len(table.columns[c]), any_unit) for c in dict.fromkeys(own)
        }
        timed = [
            TimedSignal(
                stamps_of[c := table.clocks[name]],
                x[:, None],
                k < len(held),
                f"{table.label}: the time {c!r}",
            )
            for k, (name, x) in enumerate(zip(names, [*held, *y.values()], strict=True))
        ]
        start, period, brought, remark = resampled_apart(timed, resample, table.where, table.first)
        held, together = [x[:, 0] for x in brought[: len(held)]], np.column_stack(brought[len(held) :])
        remarks.append(remark)
    elif resample is None:
        together = np.column_stack(list(y.values()))
        start, period = timing(table, clock, time, Ts, time_unit, len(u), "units" in accepted)
    else:
        together = np.column_stack(list(y.values()))
        t = time_stamps(table, clock, time_unit, len(u), "units" in accepted)
        at = f"{table.label}: the time {clock!r}", table.where, table.first
        start, period, steps, together, remark = resampled(t, np.column_stack(held), together, resample, *at)
        held = list(steps.T)
        remarks.append(remark)
    # A user who gives the unit of the time means a long period; a column of times has been checked above.
    seconds = period >= SLOWEST_SAMPLING and (time_unit is not None or "units" in accepted)
    driven_in = (units or {}).get(u_name) or (units or {}).get(given_as)
    other = input_unit(table, u_name, driven_in, "units" in accepted)
    try:
        recording = Recording(
            u=held[0],
            input_name="voltage" if other is None else name_and_unit(u_name)[0],
            input_unit=other or "V",
            y=together,
            Ts=period,
            channels=tuple(y),
            units=tuple(unit_of[channel] for channel in y),
            source=table.label,
            start=start,
            accept=(*accepted, "slow") if seconds and "slow" not in accepted else accepted,
            remarks=remarks,
            signals=dict(zip(acting, held[1:], strict=True)),
        )
    except InputError as error:
        raise InputError(f"{table.label}: {error}") from error
    for finding in recording.findings:
        # Columns of a file are less certain than arrays, whose meaning the calling program knows.
        if finding.kind in DOUBTED and finding.kind not in accepted:
            worded = converted(finding) if finding.channel in turned else finding
            raise InputError(f"{table.label}: {worded.message}")
    cut = [Finding("cut", [*table.columns][-1], table.cut, "note")] if table.cut else []
    return with_findings_on_file(recording, cut)


def save_csv(recording: Recording, path: str | os.PathLike[str]) -> Path:
    """Writes a recording as text that `load` reads: time, input, outputs and signals, with their names.

    A unit that `load` does not assume, such as that of a goal or of an angle in degrees, is part of the name.

    Args:
        recording: recording to write.
        path: path of the file, which is replaced if it exists.

    Returns:
        The path.

    Raises:
        InputError: the file cannot be written, or two columns would have one name; an existing file then
            stays as it is.
    """
    recording, path = single(recording, "recording"), path_of(path)
    columns = np.column_stack([recording.t, recording.u, recording.y, *recording.signals.values()])
    # 17 digits represent a number exactly; the time is known to fewer digits.
    formats = ["%.15g"] + ["%.17g"] * (columns.shape[1] - 1)
    outputs = zip(recording.channels, recording.units, strict=True)
    header = ["t", column_title(recording.input_name, recording.input_unit, "V")]
    header += [*(column_title(name, unit, "rad") for name, unit in outputs), *recording.signals]
    csv.writer(text := StringIO(), lineterminator="\n").writerow(distinct(header, path.name))
    np.savetxt(text, columns, fmt=formats, delimiter=",")
    return write_file(path, text.getvalue())


def column_title(name: str, unit: str, assumed: str) -> str:
    """The name of a column, with its unit in brackets if that is not the one which `load` assumes."""
    return name if unit in ("", assumed) else f"{name} [{unit}]"
