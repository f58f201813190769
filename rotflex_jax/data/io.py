"""Recordings from files and DataFrames, and back into text."""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rotflex_jax.data.files import read_table
from rotflex_jax.data.foreign import from_foreign, is_foreign
from rotflex_jax.data.table import Table
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import acceptable
from rotflex_jax.recording.samples import even_spacing, finite, real_numbers, sampling_period

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
) -> Recording:
    """Reads a recording, and refuses what is wrong with it; nothing is repaired.

    Text (.csv, .tsv, .txt; any delimiter), MATLAB (.mat of any version), NumPy (.npz), Parquet, or
    a pandas DataFrame. Columns `t,voltage,theta,alpha` in seconds, volts and radians unless other
    names are given. In .mat and .npz, a matrix `log` gives the columns `log[0]`, `log[1]`, and a
    structure `log` with a field `u` the column `log.u`. An object that has `u`, `y` and `sampling_time`,
    such as `nonlinear_benchmarks` gives, is taken as it is, with the channels named in `outputs`.

    Not for unevenly sampled data: resample them first.

    Args:
        source: path, DataFrame, or an object with `u` and `y`.
        input: column of the motor voltage [V].
        outputs: columns of theta, then of alpha [rad]; or a mapping of channel name to column.
        degrees: whether the outputs are in degrees.
        Ts: sampling period [s], where no column has the time.
        time: column of the time [s].
        accept: faults to accept by name, such as `saturated`; see `Recording`.
        units: channel to unit, where it is not rad.

    Returns:
        The recording.

    Raises:
        InputError: one sentence on what was given, what is needed and what to do.

    >>> import pandas as pd
    >>> k = np.arange(100)
    >>> frame = pd.DataFrame({"t": k / 50, "volts": np.sin(k), "theta": 0.01 * np.cos(k)})
    >>> load(frame, input="volts", outputs="theta")
    Recording(100 samples, 2 s at 50 Hz, voltage [V] to theta [rad], DataFrame)
    """
    accepted = acceptable(accept)
    if is_foreign(source):
        names = list(outputs) if isinstance(outputs, Mapping) else outputs
        return from_foreign(source, names, units, Ts, accepted)
    table = read_table(source, huge="huge" in accepted)
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
        recording = Recording(
            u=u,
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
        # Arrays come from a program that knows its units, a file from who knows where.
        if finding.kind == "units" and "units" not in accepted:
            raise InputError(f"{table.label}: {finding.message}")
    return recording


def save_csv(recording: Recording, path: str | os.PathLike[str]) -> Path:
    """Writes a recording as text that `load` reads: time, input, outputs.

    Args:
        recording: what to write.
        path: of the file, which is replaced if it exists.

    Returns:
        The path.
    """
    header = ",".join(["t", recording.input_name, *recording.channels])
    columns = np.column_stack([recording.t, recording.u, recording.y])
    # 17 digits carry a number exactly; the time is known to fewer.
    formats = ["%.15g"] + ["%.17g"] * (columns.shape[1] - 1)
    np.savetxt(path, columns, fmt=formats, delimiter=",", header=header, comments="")
    return Path(path)


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


def _column(table: Table, name: str, argument: str, wrong: Mapping[str, str]) -> np.ndarray:
    values = table.column(name, argument)
    label = f"{table.label}: column {name!r}"
    for unit in _words(table, name) & set(wrong):
        raise InputError(
            f"{label} is in {unit} by its {_told(name, unit)}, but {wrong[unit]} are needed; convert and "
            f"rename it{', or leave it out and give Ts=' if unit == 'ms' else ''}."
        )
    numbers = real_numbers(values, label, table.where, table.first)
    finite(numbers, label, table.where, table.first)
    return numbers


def _words(table: Table, name: str) -> set[str]:
    """The words of a name and of its unit, in small letters."""
    return set(re.split(r"[^a-z°]+", f"{name} {table.units.get(name, '')}".lower()))


def _told(name: str, unit: str) -> str:
    """What told that a column is in a unit."""
    return "name" if unit in name.lower() else "line of units"


def _check_angle_unit(table: Table, name: str, degrees: bool) -> None:
    given, other = ("deg", "rad") if degrees else ("rad", "deg")
    words = _words(table, name)
    if words & ANGLE_UNITS[other] and not words & ANGLE_UNITS[given]:
        word = min(words & ANGLE_UNITS[other])
        raise InputError(
            f"{table.label}: column {name!r} is in {other} by its {_told(name, word)}, but "
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
