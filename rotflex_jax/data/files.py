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

from rotflex_jax.data.binary import table_from_frame, table_from_mat, table_from_npz, table_from_parquet
from rotflex_jax.data.tables import MAX_BYTES, Table, check_size, table_from_text, unreadable
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.recording.listing import listed
from rotflex_jax.recording.quality import Finding, acceptable
from rotflex_jax.recording.samples import even_spacing, finite, real_numbers, sampling_period
from rotflex_jax.text.files import write_file

READERS: dict[str, Callable[[Path, int], Table]] = {
    ".csv": table_from_text,
    ".tsv": table_from_text,
    ".txt": table_from_text,
    ".mat": table_from_mat,
    ".npz": table_from_npz,
    ".parquet": table_from_parquet,
}


def read_table(source: Any, max_bytes: int = MAX_BYTES) -> Table:
    """Reads a file by its ending, or takes a DataFrame.

    Args:
        source: path, or pandas DataFrame.
        max_bytes: largest size of the file, and of what it unpacks to [bytes].

    Returns:
        The table.

    Raises:
        InputError: no such file, nothing in it, unknown ending, too large, or not what the ending says.
    """
    if hasattr(source, "columns") and hasattr(source, "to_numpy"):
        return table_from_frame(source)
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
) -> Recording:
    """Reads a recording and checks it; nothing is repaired.

    Text (.csv, .tsv, .txt; any delimiter), MATLAB (.mat of any version), NumPy (.npz), Parquet, or
    a pandas DataFrame. Columns `t,voltage,theta,alpha` in seconds, volts and radians unless other
    names are given. In .mat and .npz, a matrix `log` gives the columns `log[0]`, `log[1]`, and a
    structure `log` with a field `u` the column `log.u`. An object that has `u`, `y` and `sampling_time`,
    such as those of `nonlinear_benchmarks`, is taken as it is, with the channels named in `outputs`.

    Not for unevenly sampled data: resample them first.

    Args:
        source: path, DataFrame, or an object with `u` and `y`.
        input: column of the motor voltage [V].
        outputs: columns of theta, then of alpha [rad]; or a mapping of channel name to column.
        degrees: whether the outputs are in degrees.
        Ts: sampling period [s], where no column has the time.
        time: column of the time [s].
        accept: faults to accept by name, such as `saturated`; see `Recording`.
        units: channel to unit, where it is not rad; the column of the input to its unit, where that is not V.
        max_bytes: largest size of the file, and of what it unpacks to [bytes].

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
    """
    accepted = acceptable(accept)
    if is_foreign(source):
        names = list(outputs) if isinstance(outputs, Mapping) else outputs
        return from_foreign(source, names, units, Ts, accepted)
    table = read_table(source, sys.maxsize if "huge" in accepted else max_bytes)
    u_name = "voltage" if input is None else input
    chosen = _outputs(outputs)
    if u_name in chosen.values():
        raise InputError(
            f"{table.label}: the column {u_name!r} was given as input and as output, but it can be "
            "only one; correct input= or outputs=."
        )
    stamps = [] if Ts is not None and time is None else [(time or "t", "time=")]
    table.check([(u_name, "input="), *((name, "outputs=") for name in chosen.values()), *stamps])
    u = _column(table, u_name, "input=", {"mv": "volts"})
    y = {}
    for channel, name in chosen.items():
        y[channel] = _column(table, name, "outputs=", {})
        _check_angle_unit(table, name, degrees)
        if len(y[channel]) != len(u):
            raise InputError(
                f"{table.label}: {u_name!r} has {len(u)} samples and {name!r} has "
                f"{len(y[channel])}, but they must be measured together; cut both to the same ones."
            )
    start, period = _timing(table, time, Ts, len(u), "units" in accepted)
    together = np.column_stack(list(y.values()))
    try:
        other = (units or {}).get(u_name)
        recording = Recording(
            u=u,
            input_name="voltage" if other is None else u_name,
            input_unit=other or "V",
            y=np.deg2rad(together) if degrees else together,
            Ts=period,
            channels=tuple(y),
            units=tuple((units or {}).get(channel, "rad") for channel in y),
            source=table.label,
            start=start,
            accept=accepted,
        )
    except InputError as error:
        raise InputError(f"{table.label}: {error}") from error
    for finding in recording.findings:
        # Arrays come from a program that knows its units; the units of a file are less certain.
        if finding.kind == "units" and "units" not in accepted:
            raise InputError(f"{table.label}: {finding.message}")
    if table.cut:  # said of the file, not of parts of the recording
        cut = Finding("cut", [*table.columns][-1], table.cut, "note")
        vars(recording)["findings"] = (*recording.findings, cut)
    return recording


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
    (recording,) = listed(recording, "recording")
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
            f"convert and rename it{', or leave it out and give Ts=' if unit == 'ms' else ''}."
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


def _check_angle_unit(table: Table, name: str, degrees: bool) -> None:
    given, other = ("deg", "rad") if degrees else ("rad", "deg")
    words = _words(table, name)
    if words & ANGLE_UNITS[other] and not words & ANGLE_UNITS[given]:
        word = min(words & ANGLE_UNITS[other])
        raise InputError(
            f"{table.label}: column {name!r} is in {other} by its {_unit_source(name, word)}, but "
            f"degrees={degrees} was given; pass degrees={not degrees}, or correct what the file says."
        )


def _timing(
    table: Table, time: str | None, Ts: float | None, samples: int, any_unit: bool
) -> tuple[float, float]:
    """Time of the first sample and sampling period [s], from the column, the argument or both."""
    if Ts is not None:
        Ts = sampling_period(Ts)
    if time is None and "t" not in table.columns:
        if Ts is None:
            table.column("t", "time=, or give the sampling period with Ts=")
        return 0.0, float(Ts or 0.0)
    name = "t" if time is None else time
    t = _column(table, name, "time=", {} if any_unit else {"ms": "seconds"})
    label = f"{table.label}: the time {name!r}"
    if len(t) != samples:
        raise InputError(
            f"{label} has {len(t)} stamps for {samples} samples, but each sample needs one; "
            "name the right column with time=."
        )
    measured = even_spacing(t.astype(float), label, table.where, table.first)
    if Ts is not None and abs(measured - Ts) > 0.01 * Ts:
        raise InputError(
            f"{label} advances by {measured:g} s, but Ts={Ts:g} was given; leave Ts out, or correct it."
        )
    if measured >= 0.5 and not any_unit:
        raise InputError(
            f"{label} advances by {measured:g} per sample, too slow for a joint: it looks like "
            "milliseconds; divide it by 1000, or pass accept=('units',)."
        )
    return float(t[0]), measured
