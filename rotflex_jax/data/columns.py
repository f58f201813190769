"""Columns of a table as signals in SI units: angles from degrees or counts, times, units in the header."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Real

from rotflex_jax.checks import real, shown
from rotflex_jax.data.tables import Table, name_and_unit
from rotflex_jax.errors import InputError
from rotflex_jax.recording.quality import SLOWEST_SAMPLING, Finding, whole_numbers
from rotflex_jax.recording.samples import even_spacing, finite, real_numbers, sampling_period

OTHER_NAMES = {"t": ("time",), "theta": ("θ",), "alpha": ("α",)}
"""Other accepted names of the columns of the joint."""

JOINT_SENSORS = ("theta", "alpha", "speed")
"""Columns of possible sensors of the joint."""

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
"""Unit of time -> its length in seconds."""

TIME_WORDS = {
    "sec": "s",
    "second": "s",
    "seconds": "s",
    "msec": "ms",
    "milliseconds": "ms",
    "µs": "us",
    "μs": "us",
}
"""Other spellings of units of time."""

ANGLE_UNITS = {
    "rad": {"rad", "rads", "radian", "radians"},
    "deg": {"deg", "degs", "degree", "degrees", "°"},
}


def unused_sensors(table: Table, channels: Sequence[str], used: set[str]) -> list[Finding]:
    """Finding on further sensors of a joint in the file, if only one sensor is read."""
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


def named_outputs(outputs: Any) -> dict[str, str]:
    """Channel name -> column name."""
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


def named_signals(signals: Any, table: Table) -> dict[str, str]:
    """Signal name -> column name; a signal without a given name has the name of its column, with the unit."""
    if isinstance(signals, Mapping):
        columns, names = list(signals.values()), list(signals)
    else:
        several = isinstance(signals, list | tuple)
        columns, names = list(signals) if several else [] if signals is None else [signals], []
    if all(isinstance(column, str) for column in columns):
        found = [table.find(column) for column in columns]
        chosen = dict(zip(names or [_with_unit(table, column) for column in found], found, strict=True))
        if len(set(chosen.values())) == len(columns):
            return chosen
    raise InputError(
        f"Argument `signals` must name columns, each once, but is {shown(signals)}; for other names of "
        "signals give a mapping such as {'acceleration of the base [m/s^2]': 'column'}."
    )


def _with_unit(table: Table, column: str) -> str:
    """Name of a column with its unit in brackets, if the file has a unit for it."""
    name, unit = name_and_unit(column)[0], _unit(table, column)
    return f"{name} [{unit}]" if unit else name


def _unit(table: Table, column: str) -> str:
    return name_and_unit(column)[1] or table.units.get(column, "").strip(" []()")


def column_of(table: Table, name: str, argument: str, wrong: Mapping[str, str]) -> Real[np.ndarray, " N"]:
    """A column as finite numbers.

    Args:
        table: Table with the column.
        name: Name of the column.
        argument: Argument of the user that names the column, for messages.
        wrong: Unit that the column must not have -> the unit that is needed.
    """
    values = table.column(name, argument)
    label = f"{table.label}: column {name!r}"
    for unit in _words(table, name) & set(wrong):
        written = _as_written(table, name, unit)
        raise InputError(
            f"{label} is in {written} by its {_unit_source(name, unit)}, but {wrong[unit]} are needed; "
            + ("pass time_unit='ms'." if unit == "ms" else "convert and rename it.")
        )
    numbers = real_numbers(values, label, table.where, table.first)
    finite(numbers, label, table.where, table.first)
    return numbers


def _words(table: Table, name: str) -> set[str]:
    """The words of a name and of its unit, in lower case."""
    return set(re.split(r"[^a-z°]+", f"{name} {table.units.get(name, '')}".lower()))


def _as_written(table: Table, name: str, word: str) -> str:
    """A word of a name or of its unit in its original spelling."""
    said = re.search(rf"(?<![a-z°]){re.escape(word)}(?![a-z°])", f"{name} {table.units.get(name, '')}", re.I)
    return said[0] if said else word


def _unit_source(name: str, unit: str) -> str:
    """Where the unit of a column comes from."""
    return "name" if unit in name.lower() else "line of units"


def input_unit(table: Table, name: str) -> str | None:
    """The unit of the input, if the file has a unit other than volts for it."""
    unit = _unit(table, name)
    if not unit and "current" in _words(table, name):
        return "A"
    return None if unit.lower() in ("", "v", "volt", "volts", "-", "–", "1") else unit


def counts_per_turn(counts: Any, channels: Sequence[str], degrees: bool) -> dict[str, float]:
    """Channel -> counts per turn."""
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


def angle(
    table: Table,
    channel: str,
    name: str,
    values: Real[np.ndarray, " N"],
    degrees: bool,
    counts: float | None,
    accepted: Sequence[str],
) -> Real[np.ndarray, " N"]:
    """An output in radians: converted from counts or degrees, or unchanged."""
    if counts is not None:
        return values * (2 * np.pi / counts)
    behind = set(re.split(r"[^a-z°]+", name_and_unit(name)[1].lower()))
    if behind & ANGLE_UNITS["deg"]:  # the header has the unit right after the name
        degrees = True
    else:
        _check_angle_unit(table, name, degrees)
    if degrees and whole_numbers(values) and "units" not in accepted:
        # In degrees, no encoder of a joint would be so coarse, and no arm would deflect so far.
        most = 90.0 if channel == "alpha" else 1000.0
        if np.ptp(values) > most:
            raise InputError(
                f"{table.label}: column {name!r} holds whole numbers from {values.min():g} to "
                f"{values.max():g}, as the counts of an encoder are, but degrees=True was given; give the "
                "counts of one turn in its place, counts=4096 for instance, or accept=('units',)."
            )
    return np.deg2rad(values) if degrees else values


def deflection(y: dict[str, Real[np.ndarray, " N"]]) -> dict[str, Real[np.ndarray, " N"]]:
    """The outputs with the absolute angle of the arm converted to its deflection relative to the hub."""
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


def time_stamps(
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
    t = column_of(table, name, "time=", {} if any_unit or unit else {"ms": "seconds"})
    if len(t) != samples:
        raise InputError(
            f"{table.label}: the time {name!r} has {len(t)} stamps for {samples} samples, but each sample "
            "needs one; name the right column with time=."
        )
    return t.astype(float) * TIME_UNITS[unit] if unit and unit != "s" else t.astype(float)


def timing(
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
    t = time_stamps(table, name, time_unit, samples, any_unit)
    label = f"{table.label}: the time {name!r}"
    measured = even_spacing(t, label, table.where, table.first)
    if Ts is not None and abs(measured - Ts) > 0.01 * Ts:
        raise InputError(
            f"{label} advances by {measured:g} s, but Ts={Ts:g} was given; leave Ts out, or correct it."
        )
    if measured >= SLOWEST_SAMPLING and not any_unit and time_unit is None:
        raise InputError(
            f"{label} advances by {measured:g} per sample, too slow for a joint: it looks like "
            "milliseconds; pass time_unit='ms', or time_unit='s' if these are seconds."
        )
    return float(t[0]), measured
