"""Columns of a table as signals in SI units: angles from degrees or counts, times, units in the header."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Real

from rotflex_jax.checks import real, shown
from rotflex_jax.data.tables import Table, name_and_unit, spaced
from rotflex_jax.errors import InputError
from rotflex_jax.recording.quality import SLOWEST_SAMPLING, Finding, is_absolute, whole_numbers
from rotflex_jax.recording.samples import (
    DEGREES,
    TURNS_PER_MINUTE,
    UNIT_SIZES,
    even_spacing,
    finite,
    in_radians,
    real_numbers,
    sampling_period,
    unit_factor,
)

OTHER_NAMES = {"t": ("time",), "theta": ("θ",), "alpha": ("α",)}
"""Other accepted names of the columns of the joint."""

JOINT_SENSORS = ("theta", "alpha", "speed")
"""Columns of possible sensors of the joint."""

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
"""Unit of time -> its length in seconds."""

LONG_NAMES = {"ms": "milliseconds", "us": "microseconds"}
"""Unit of time -> its name in a sentence."""

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

OTHER_TIMES = frozenset({"ns", "min", "minute", "minutes", "h", "hour", "hours"})
"""Units of time in lower case that are not read."""

ANGLE_UNITS = {"rad": {"rad", "rads", "radian", "radians"}, "deg": set(DEGREES)}
INPUT_UNITS = {"V": {"v", "volt", "volts", "voltage"}, "A": {"a", "amp", "ampere", "amperes"}} | ANGLE_UNITS
"""Unit of an input -> its spellings in lower case."""

COUNT_UNITS = frozenset({"count", "counts", "cnt", "cnts", "tick", "ticks"})
OTHER_UNITS = COUNT_UNITS | {
    *("mrad", "urad", "µrad", "μrad", "rev", "revs", "turn", "turns", "gon", "grad", *TURNS_PER_MINUTE),
    *("mdeg", "arcmin", "arcsec"),
    *("m", "cm", "mm", "um", "µm", "μm", "inch", "m/s", "cm/s", "mm/s", "v", "mv", "ma"),
}
"""Lower-case units of outputs other than radians and degrees; other words in brackets are remarks."""

OUTPUT_UNITS_IN_NAMES = ("mm", "cm", "um", "µm", "μm", "mrad", "rpm")
"""Units that are read at the end of the name of an output, as in `x_mm`."""


UNITS_IN_NAMES = {*TIME_UNITS, *TIME_WORDS, *OTHER_TIMES, *OTHER_UNITS}.union(*INPUT_UNITS.values()) | {
    *("nsec", "nanosec", "nanoseconds", "usec", "microseconds"),
}
"""Words that may end the name of a column as its unit; two such columns leave it open which is meant."""


def clock_column(table: Table, time: str | None = None, exact: bool = False) -> str:
    """The column of the time: the one that the user names, or `t`; a unit may end its name, as in `t_ms`.

    Args:
        table: The columns of the file.
        time: Name that the user gives, if any.
        exact: Whether only a column with the name itself is a time, if the user gives no name.
    """
    if time is None and exact:
        return table.find("t", *OTHER_NAMES["t"])
    others = () if time else OTHER_NAMES["t"]
    return table.find(time or "t", *others, units={*TIME_UNITS, *TIME_WORDS}, other_units=UNITS_IN_NAMES)


def input_column(table: Table, name: str | None = None) -> str:
    """The column of the input: the one that the user names, or `voltage`; `V` or `volts` may end its name."""
    units = INPUT_UNITS["V"] - {"voltage"}
    return table.find("voltage" if name is None else name, units=units, other_units=UNITS_IN_NAMES)


def sensor_column(table: Table, name: str) -> str:
    """The column of an output; a unit of angles may end its name, as in `theta_deg`."""
    units = set().union(*ANGLE_UNITS.values())
    return table.find(name, *OTHER_NAMES.get(name, ()), units=units, other_units=UNITS_IN_NAMES)


def unused_sensors(table: Table, channels: Sequence[str], used: set[str]) -> list[Finding]:
    """Finding on further sensors of a joint in the file, if only one sensor is read."""
    if len(channels) != 1 or channels[0] not in JOINT_SENSORS:
        return []
    there = {c: sensor_column(table, c) for c in JOINT_SENSORS}
    left = {c: name for c, name in there.items() if name in table.columns and name not in used}
    if not left:
        return []
    sensors = [c for c in JOINT_SENSORS if c in left or c in channels]
    others = ", ".join(map(repr, left.values()))
    message = (
        f"The file has {others} too, but {channels[0]} is the only output that is read; to use all of them "
        f"give a model that has them as outputs, such as --joint paper:sensors={'+'.join(sensors)}."
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
    columns = list(chosen.values())
    twice = [column for k, column in enumerate(columns) if column in columns[:k]]
    if twice:
        raise InputError(
            f"Argument `outputs` has one column, {shown(twice[0])}, for two channels; name another for "
            "one of them, or leave one channel out."
        )
    if not chosen:
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
    name, unit = name_and_unit(column)[0], stated_unit(table, column)
    return f"{name} [{unit}]" if unit else name


def stated_unit(table: Table, column: str) -> str:
    """The unit in brackets after the name of a column, or in the line of units; empty if there is none."""
    return name_and_unit(column)[1] or table.units.get(column, "").strip(" []()")


def _own_unit(table: Table, column: str) -> str:
    """The unit of an output that the file states, or with which its name ends; empty if there is none."""
    last = _last_word(column)
    return stated_unit(table, column) or (last if last.lower() in OUTPUT_UNITS_IN_NAMES else "")


def _last_word(column: str) -> str:
    """The last word of the name of a column, without a unit in brackets; empty if it has none."""
    return "".join(re.findall(r"[^\W\d_]+", spaced(name_and_unit(column)[0]))[-1:])


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
    return _split(f"{name} {table.units.get(name, '')}")


def _split(text: str) -> set[str]:
    return set(re.split(r"[^\w°]+|[\d_]+", spaced(text).lower()))


def _as_written(table: Table, name: str, word: str) -> str:
    """A word of a name or of its unit in its original spelling."""
    return _word_in(word, f"{name} {table.units.get(name, '')}") or word


def _word_in(word: str, text: str) -> str:
    """A word in the spelling of the text; empty if the text does not have it."""
    said = re.search(rf"(?<![^\W\d_]){re.escape(word)}(?![^\W\d_])", spaced(text), re.I)
    return said[0] if said else ""


def _unit_source(name: str, unit: str) -> str:
    """Where the unit of a column comes from."""
    return "name" if _word_in(unit, name) else "line of units"


def input_unit(table: Table, name: str, given: str | None, any_unit: bool) -> str | None:
    """The unit of the input, if it is not volts: the unit that was given, or else that of the file.

    Raises:
        InputError: The two are not the same unit.
    """
    unit, words = stated_unit(table, name), _words(table, name)
    source = _unit_source(name, unit)
    if unit.lower() in ("", "-", "–", "1"):
        unit, source = "A" if "current" in words else "V" if words & INPUT_UNITS["V"] else "", "name"
    said = _spelled(unit)
    if given and said and said != _spelled(given) and not any_unit:
        raise InputError(
            f"{table.label}: column {name!r} is in {unit} by its {source}, but an input in {given} is "
            f"needed; name its column with input=, or pass accept=('units',) if it is this one."
        )
    return given or (None if said in ("", "V") else unit)


def _spelled(unit: str) -> str:
    """A unit of an input in one spelling."""
    return next((one for one, spellings in INPUT_UNITS.items() if unit.lower() in spellings), unit)


def counts_per_turn(counts: Any, channels: Sequence[str], degrees: bool) -> dict[str, float]:
    """Channel -> counts per turn."""
    if counts is None:
        return {}
    each: dict[str, Any] = dict(counts) if isinstance(counts, Mapping) else dict.fromkeys(channels, counts)
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
    if degrees and not isinstance(counts, Mapping):
        raise InputError(
            f"Arguments counts={real(counts):g} and degrees=True were both given, but a column holds one of "
            "the two; give one, or the counts of the channels that have them, such as counts={'theta': 4096}."
        )
    return {channel: float(value) for channel, value in each.items()}


def output(
    table: Table,
    channel: str,
    name: str,
    values: Real[np.ndarray, " N"],
    unit: str | None,
    degrees: bool,
    counts: float | None,
    accepted: Sequence[str],
) -> tuple[Real[np.ndarray, " N"], str]:
    """An output and its unit: converted from degrees, counts, or the file's unit to a given one in m or rad.

    Args:
        table: Table with the column.
        channel: Name of the channel.
        name: Name of the column.
        values: The column.
        unit: Unit of the channel that the user gives, if any.
        degrees: Whether the user gives all outputs in degrees.
        counts: Counts per turn that the user gives for this channel, if any.
        accepted: Faults that the user accepts.
    """
    label = f"{table.label}: column {name!r}"
    if counts is None and "units" not in accepted:
        _check_other_unit(table, channel, name, unit, degrees)
    turned = None if unit is None else in_radians(unit)
    said, source = _angle_unit(table, name)
    if counts is not None and said and "units" not in accepted:
        raise InputError(
            f"{label} is in {said} by its {source}, but counts={counts:g} of one turn were given; give the "
            "counts of the channels that have them alone, such as counts={'theta': 4096}, or name the column "
            "with the counts."
        )
    factor = 1.0 if "units" in accepted else _factor_to_base(_own_unit(table, name), unit)
    if unit is not None and (factor != 1.0 or not (turned or unit.startswith("rad"))):
        if degrees or counts is not None:
            raise InputError(
                f"{label} was to be converted to rad, but its unit is given as "
                f"{unit!r}; leave out the unit, or the conversion (degrees, counts)."
            )
        return (values if factor == 1.0 else values * factor), unit
    if counts is not None:
        if turned:
            raise InputError(
                f"{label} was given in {unit} and as counts={counts:g} of one turn, but holds one of the "
                "two; leave one of the two out."
            )
        return values * (2 * np.pi / counts), unit or "rad"
    in_rad = unit in ANGLE_UNITS["rad"]  # a speed in rad/s may also be converted by the file or by `degrees`
    if degrees and in_rad:
        raise InputError(
            f"{label} was given in {unit}, but degrees=True was given too, which is for all outputs; leave "
            "degrees=True out, and give the unit of each output in degrees, such as units={'theta': 'deg'}."
        )
    if said == "rad" and degrees:
        raise InputError(
            f"{label} is in rad by its {source}, but degrees=True was given, which is for all outputs; leave "
            "degrees=True out, and give the unit of each output in degrees, such as units={'theta': 'deg'}."
        )
    if (said == "rad" and turned) or (said == "deg" and in_rad):
        raise InputError(
            f"{label} is in {said} by its {source}, but was given in {unit}; leave out that unit, or correct "
            "what the file says."
        )
    own = _own_radians(stated_unit(table, name))
    if not (turned or degrees or said == "deg"):
        return values, unit or own
    if whole_numbers(values) and "units" not in accepted:
        # In degrees, no encoder of a joint would be so coarse, and no arm would deflect so far.
        most = 90.0 if channel == "alpha" else 1000.0
        if np.ptp(values) > most:
            raise InputError(
                f"{label} holds whole numbers from {values.min():g} to {values.max():g}, as the counts of an "
                "encoder are, but was to be converted from degrees; give the counts of one turn in the place "
                "of degrees, counts=4096 for instance, or accept=('units',)."
            )
    return np.deg2rad(values), turned or unit or own


def _factor_to_base(own: str, given: str | None) -> float:
    """Factor from the unit of the file to the given one, if that is m, rad or their speed; otherwise 1."""
    if given is None or given.partition("/")[0].strip() not in UNIT_SIZES:
        return 1.0
    return unit_factor(own, given) or 1.0


def _own_radians(unit: str) -> str:
    """The unit in radians, or in radians per time, of a column with a unit in radians or degrees."""
    angle, slash, time = unit.partition("/")
    is_angle = any(angle.strip().lower() in spellings for spellings in ANGLE_UNITS.values())
    return f"rad{slash}{time}" if is_angle else "rad"


def _check_other_unit(table: Table, channel: str, name: str, given: str | None, degrees: bool) -> None:
    """Refuses a column that by the file is in neither radians nor degrees, unless its unit is given."""
    own = _own_unit(table, name)
    if own.lower() not in OTHER_UNITS or (given or "").lower() == own.lower():
        return
    if _factor_to_base(own, given) != 1.0:
        return
    said = f"{table.label}: column {name!r} is in {own} by its {_unit_source(name, own)}"
    if given is not None:
        raise InputError(
            f"{said}, but was given in {given}; leave out that unit, or correct what the file says."
        )
    if degrees:
        raise InputError(
            f"{said}, but degrees=True was given, which is for all outputs; leave degrees=True out, and give "
            "the unit of each output, such as units={'theta': 'deg'}."
        )
    keep = (
        "counts=4096 or what one turn has"
        if own.lower() in COUNT_UNITS
        else f"units={{{channel!r}: {own!r}}}"
    )
    raise InputError(
        f"{said}, but an output is taken in rad unless its unit is given; pass {keep}, or convert and rename "
        "the column."
    )


def _angle_unit(table: Table, name: str) -> tuple[str | None, str]:
    """Unit of an angle, "deg" or "rad", by the unit in the file or else by the name; and where it is said."""
    for words in (_split(stated_unit(table, name)), _words(table, name)):
        said = [unit for unit, spellings in ANGLE_UNITS.items() if words & spellings]
        if len(said) == 1:
            return said[0], _unit_source(name, min(words & ANGLE_UNITS[said[0]]))
    return None, ""


def deflection(
    y: dict[str, Real[np.ndarray, " N"]], label: str, accepted: Sequence[str]
) -> dict[str, Real[np.ndarray, " N"]]:
    """The outputs with the absolute angle of the arm converted to its deflection relative to the hub.

    Raises:
        InputError: theta or alpha is missing, or alpha was the deflection already.
    """
    if not {"theta", "alpha"} <= set(y):
        raise InputError(
            f"Argument arm_absolute=True needs the channels theta and alpha, but the outputs are "
            f"{', '.join(y)}; leave it out, or name both."
        )
    bent = y["alpha"] - y["theta"]
    if "absolute" not in accepted and is_absolute(y["theta"], -bent):
        raise InputError(
            f"{label}: alpha less theta follows -theta one to one in slow motion, so that alpha held the "
            "deflection already, but arm_absolute=True was given; leave arm_absolute=True out, or pass "
            "accept=('absolute',)."
        )
    return y | {"alpha": bent}


def time_stamps(
    table: Table, name: str, time_unit: str | None, samples: int, any_unit: bool
) -> Real[np.ndarray, " N"]:
    """The times of all samples [s]."""
    if time_unit is not None and time_unit not in TIME_UNITS:
        raise InputError(
            f"Argument `time_unit` must be one of {', '.join(TIME_UNITS)}, but is {time_unit!r}; give "
            "for instance time_unit='ms'."
        )
    said, source = time_unit_of(table, name, by_name=not any_unit)
    if time_unit is not None and said not in (None, time_unit):
        raise InputError(
            f"{table.label}: column {name!r} is in {said} by its {source}, but time_unit={time_unit!r} was "
            f"given; pass time_unit={said!r}, or correct what the file says."
        )
    own = stated_unit(table, name)
    if own.lower() in OTHER_TIMES and not any_unit:
        raise InputError(
            f"{table.label}: column {name!r} is in {own} by its {_unit_source(name, own)}, but a time is "
            f"read in {', '.join(TIME_UNITS)}; convert and rename it."
        )
    unit = time_unit or said
    t = column_of(table, name, "time=", {} if any_unit or unit else {"ms": "seconds"})
    if len(t) != samples:
        raise InputError(
            f"{table.label}: the time {name!r} has {len(t)} stamps for {samples} samples, but each sample "
            "needs one; name the right column with time=."
        )
    return t.astype(float) * TIME_UNITS[unit] if unit and unit != "s" else t.astype(float)


def time_unit_of(table: Table, name: str, by_name: bool = True) -> tuple[str | None, str]:
    """Unit of a time by the unit in the file, or by the last word of the name; and where it is said."""
    last = _last_word(name).lower() if by_name else ""
    for word in (stated_unit(table, name).lower(), last):
        unit = TIME_WORDS.get(word, word if word in TIME_UNITS else None)
        if unit is not None:
            return unit, _unit_source(name, word)
    return None, ""


def conversions_by_name(table: Table, turned: Mapping[str, str], said: set[str], clock: str) -> list[Finding]:
    """Notes on columns that were converted because of their names alone, which the file does not confirm.

    Args:
        table: Table with the columns.
        turned: Channel -> column, for outputs that were converted.
        said: Channels whose unit the user has given.
        clock: Column of the time; empty if the user has given its unit, or the sampling period.
    """
    notes = []
    for channel, name in turned.items():
        angle = "degrees" if channel not in said and _angle_unit(table, name)[0] == "deg" else ""
        unit = angle or _own_unit(table, name)
        if unit and not stated_unit(table, name):
            message = f"Column {name!r} was converted from {unit} because of its name."
            notes.append(Finding("converted", channel, message, "note"))
    unit = time_unit_of(table, clock)[0] if clock and not stated_unit(table, clock) else None
    if unit not in (None, "s"):
        message = f"The time {clock!r} was converted from {unit} because of its name."
        notes.append(Finding("converted", "time", message, "note"))
    return notes


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
            f"{label} advances by {measured:g} s, but Ts={Ts:g} was given; leave Ts={Ts:g} out, or correct "
            "it."
        )
    if measured >= SLOWEST_SAMPLING and not any_unit and time_unit is None:
        likely = [unit for unit, size in TIME_UNITS.items() if measured * size < SLOWEST_SAMPLING]
        cure = "convert them to seconds"
        if likely:
            cure = f"it looks like {LONG_NAMES[likely[0]]}; pass time_unit={likely[0]!r}"
        raise InputError(
            f"{label} advances by {measured:g} per sample, too slow for a joint: {cure}, or time_unit='s' if "
            "these are seconds."
        )
    return float(t[0]), measured
