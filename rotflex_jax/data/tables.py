"""Tables of named columns, from delimited text and JSON, and resampling to even times on request."""

import csv
import json
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Shaped

from rotflex_jax.errors import InputError
from rotflex_jax.recording.quality import Finding
from rotflex_jax.recording.samples import LONGEST_STEP, finite, name_and_unit, sampling_period
from rotflex_jax.text.files import is_search_result


@dataclass(frozen=True, eq=False)
class Table:
    """Named columns.

    Args:
        label: name of the table in an error message.
        columns: name -> column; column k of a matrix is `name[k]`.
        where: word for one row in an error message.
        first: number of the first row.
        units: name of a column -> unit, if the file has a line of units.
        cut: sentence on what may be missing at the end; empty if nothing may be missing.
        objects: name -> class, for objects that only the program that wrote the file can read.
        clocks: name of a column -> name of the column with its times, if the file has this information.
    """

    label: str
    columns: Mapping[str, Shaped[np.ndarray, " _"]]
    where: str = "row"
    first: int = 1
    units: Mapping[str, str] = field(default_factory=dict)
    cut: str = ""
    objects: Mapping[str, str] = field(default_factory=dict)
    clocks: Mapping[str, str] = field(default_factory=dict)

    def find(
        self, name: str, *others: str, units: Collection[str] = (), other_units: Collection[str] = ()
    ) -> str:
        """The column with a name, where capital letters and a unit after the name do not matter.

        Args:
            name: name that is wanted.
            others: other names of the same column.
            units: words in lower case that may end the name of the column without brackets, as in
                `theta_deg`; used where no column has the name itself.
            other_units: further such words; with a column that ends with one of them, it is open which is
                meant.

        Returns:
            The name of the column, or `name` if there is no such column, or more than one.

        >>> names = ("Time [s]", "Theta (deg)", "alpha_deg")
        >>> table = Table("run.csv", dict.fromkeys(names, np.zeros(1)))
        >>> table.find("theta"), table.find("t", "time"), table.find("alpha")
        ('Theta (deg)', 'Time [s]', 'alpha')
        >>> table.find("alpha", units=("deg",)), table.find("alpha", units=("rad",), other_units=("deg",))
        ('alpha_deg', 'alpha')
        """
        if not isinstance(name, str) or name in self.columns:
            return name
        wanted = {other.casefold() for other in (name, *others)}
        wanted |= {f"{other}.data" for other in wanted}  # column of a MATLAB timeseries
        like = [column for column in self.columns if name_and_unit(column)[0].casefold() in wanted]
        if not like and units:
            parts = {c: re.fullmatch(r"(.+)[_ .-]([^\W\d_]+)", spaced(c).casefold()) for c in self.columns}
            said = {c: found[2] for c, found in parts.items() if found and found[1] in wanted}
            if not any(unit in other_units and unit not in units for unit in said.values()):
                like = [c for c, unit in said.items() if unit in units]
        return like[0] if len(like) == 1 else name

    def column(self, name: str, what: str) -> Shaped[np.ndarray, " N"]:
        """One column.

        Args:
            name: name of the column.
            what: argument with which a user could name another column.

        Raises:
            InputError: the column does not exist; the message lists the existing columns.
        """
        if isinstance(name, str) and name in self.columns:
            return self.columns[name]
        if isinstance(name, str) and set(parts := name.split(",")) < set(self.columns):
            raise self._lacks(f"column {name!r}", f"name {' and '.join(parts)} one by one with {what}")
        raise self._lacks(f"column {name!r}", f"name the right one with {what}")

    def check(self, wanted: Sequence[tuple[str, str]]) -> None:
        """Report all missing columns at once, if there are several.

        Args:
            wanted: columns, each with the argument with which a user could name another column.

        Raises:
            InputError: several columns are missing; the message lists the existing columns.
        """
        missing = [(n, what) for n, what in wanted if isinstance(n, str) and n not in self.columns]
        if len(missing) > 1:
            names = ", ".join(repr(n) for n, _ in missing)
            arguments = list(dict.fromkeys(what for _, what in missing))
            listed = ", ".join(arguments[:-1]) + " and " * (len(arguments) > 1) + arguments[-1]
            raise self._lacks(f"columns {names}", f"name the right ones with {listed}")

    def _lacks(self, what: str, then: str) -> InputError:
        longest = max(map(len, self.columns.values()), default=0)
        signals = [key for key, values in self.columns.items() if len(values) == longest]
        # Single values are settings, and shorter arrays often matrices: both come behind the signals.
        there = signals + [key for key, values in self.columns.items() if 1 < len(values) < longest]
        most = max(20, min(len(signals), MOST_LISTED))
        short = [name if len(name) <= 40 else f"{name[:37]}..." for name in there[:most]]
        names = ", ".join(short) + (f" and {len(there) - most} more" if len(there) > most else "")
        texts = [name for name, kind in self.objects.items() if kind == "string"]
        if texts:
            what, verb = ("a MATLAB string", "is") if len(texts) == 1 else ("MATLAB strings", "are")
            then += f"; {', '.join(texts):.200} ({what}) cannot be read and {verb} not needed"
        others = [(name, kind) for name, kind in self.objects.items() if kind != "string"]
        objects = ", ".join(f"{name} ({kind})" for name, kind in others[:5])
        if objects:
            cure = "save a timetable, timeseries or Dataset with -v7, and of others the arrays"
            then += f"; objects that only MATLAB reads are left out, {objects}: {cure}"
        return InputError(f"{self.label} has no {what}; it has {names or 'none'}: {then}.")


def spaced(name: str) -> str:
    """The name with a space before a word that begins with a capital letter.

    >>> spaced("thetaDeg")
    'theta Deg'
    """
    return re.sub(r"(?<=[a-z]{2})(?=[A-Z][a-z])", " ", name)


MOST_LISTED = 60
"""Largest number of columns in the message on one that is missing."""


def distinct(names: Sequence[str], label: str) -> Sequence[str]:
    """The names, if no two are equal.

    Raises:
        InputError: two names are equal.
    """
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InputError(
                f"{label} has more than one column {name!r}, so that it is open which is meant; "
                "rename or remove one."
            )
        seen.add(name)
    return names


MAX_BYTES = 2_000_000_000
"""Largest likely size of one recording, packed and unpacked [bytes]."""


def check_size(label: str, size: int, max_bytes: int, what: str = "unpacks to at least") -> None:
    """Refuse data that are larger than one recording can be.

    Args:
        label: name of the data in an error message.
        size: size of the data, or their size when unpacked [bytes].
        max_bytes: largest accepted size [bytes].
        what: verb before the size in the message.

    Raises:
        InputError: the size is larger than `max_bytes`.
    """
    if size > max_bytes:
        raise InputError(
            f"{label} {what} {size / 1e9:.3g} GB, more than the {max_bytes / 1e9:.3g} GB of any likely "
            "recording; check it, give a larger max_bytes, or pass accept=('huge',)."
        )


def unreadable(path: Path, what: str, error: Exception) -> InputError:
    """The error for a file that does not have the format of its ending."""
    reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    return InputError(
        f"{path.name} cannot be read as {what} ({reason[:120]}); it may be damaged: export it again."
    )


def table_from_text(path: Path, max_bytes: int = MAX_BYTES) -> Table:
    """The columns of a text file in UTF-8 with a header.

    The delimiter is that of a first line such as `sep=;`, which is for Excel, otherwise the first of tab,
    semicolon, bar and comma that the header contains, otherwise spaces. With a delimiter other than the
    comma, a comma is a decimal comma. Remark lines with # or % may come first; the last of them may be the
    header. A line of units may follow the header.

    Raises:
        InputError: the file has no text, another encoding, no header, no samples, a line with more or fewer
            cells than names, or a last line that is cut off.
    """
    text = _decoded(path, max_bytes)
    lines = text.splitlines()
    declared = re.fullmatch(r"sep=(.)", lines[0]) if lines else None
    if declared:
        lines[0] = ""
    start = _header(lines)
    if start is None:
        raise InputError(f"{path.name} has no text in it; export the recording again.")
    delimiter = declared[1] if declared else next((mark for mark in "\t;|," if mark in lines[start]), None)
    names = [name.strip() for name in _cells(lines[start].lstrip("#% "), delimiter)]
    if _are_numbers(names):
        raise InputError(
            f"{path.name} has no header, its line {start + 1} holds numbers; "
            "put the names of the columns there, such as t,voltage,theta,alpha."
        )
    distinct(names, path.name)
    rows = lines[start + 1 :]
    while rows and not rows[-1].strip():
        rows.pop()
    if not rows:
        raise InputError(f"{path.name} has a header, but no samples; export the recording again.")
    if delimiter != ",":
        rows = [row.replace(",", ".") for row in rows]
    first = start + 2  # line numbers as in an editor
    units = _units(rows, names, delimiter)
    if units:
        rows, first = rows[1:], first + 1
    columns = _columns(rows, names, delimiter, path.name, first)
    cut = _cut(rows, delimiter, path.name, first) if text[-1] in "0123456789." else ""
    return Table(path.name, columns, "line", first, units, cut)


def table_from_json(path: Path, max_bytes: int = MAX_BYTES) -> Table:
    """The columns of a JSON file: a list of samples, each an object, or lists under the names of columns.

    The list of samples may be under one name, with settings under other names, as in servo logs. A list of
    numbers in a sample gives several columns, `name[k]`.

    Raises:
        InputError: the file is no JSON, has no such list or more than one, or a sample has other names than
            the first sample.
    """
    try:
        data = json.loads(_decoded(path, max_bytes))
    except (ValueError, RecursionError, MemoryError) as error:
        if isinstance(error, InputError):
            raise
        raise unreadable(path, "JSON", error) from error
    if is_search_result(data):
        raise InputError(
            f"{path.name} is the result of a search, not a recording; give the recording itself."
        )
    named = data if isinstance(data, dict) else {"": data}
    lists = {name: v for name, v in named.items() if _are_samples(v)}
    if len(lists) > 1:
        raise InputError(
            f"{path.name} has samples under {', '.join(lists)}, but one recording is read; write each to a "
            "file of its own."
        )
    if lists:
        ((_, rows),) = lists.items()
        names = list(rows[0])
        for k, row in enumerate(rows, 1):
            if set(row) != set(names):
                raise InputError(
                    f"{path.name} has {', '.join(row)} in sample {k}, but {', '.join(names)} in the first; "
                    "give each sample the same names."
                )
        found = {name: [row[name] for row in rows] for name in names}
    else:
        found = {name: v for name, v in named.items() if name and isinstance(v, list)}
    columns = {}
    for name, values in found.items():
        whole = values and all(isinstance(v, list) and len(v) == len(values[0]) for v in values)
        parts = {f"{name}[{k}]": part for k, part in enumerate(zip(*values, strict=True))} if whole else None
        for column, cells in (parts or {name: values}).items():
            if not any(isinstance(cell, list | dict) for cell in cells):
                columns[column] = _numbers_or_text([math.nan if c is None else c for c in cells])
    if not columns:
        raise InputError(
            f"{path.name} has no table in it; write a list of samples, such as "
            '[{"t": 0.0, "goal": 0.1, "theta": 0.0}, ...], alone or under one name.'
        )
    return Table(path.name, columns, "sample")


def _are_samples(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(row, dict) for row in value)


def _numbers_or_text(cells: Sequence[Any]) -> Shaped[np.ndarray, " N"]:
    """Numbers if all cells are numbers; else text, so that an error message can name the place."""
    if not all(isinstance(cell, int | float) for cell in cells):
        return np.array([str(cell) for cell in cells])
    return np.array([_number(cell) for cell in cells])


def _number(cell: float) -> float:
    try:
        return float(cell)
    except OverflowError:
        return math.inf


def _decoded(path: Path, max_bytes: int) -> str:
    data = path.read_bytes()
    check_size(path.name, len(data), max_bytes, "has")
    try:
        if data[:2] in (b"\xff\xfe", b"\xfe\xff") or 0 in data[:2]:
            raise ValueError("it looks like UTF-16, to be saved as UTF-8")
        text = data.decode("utf-8-sig")
        if "\0" in text:
            raise ValueError(f"it has a zero byte in line {text[: text.index(chr(0))].count(chr(10)) + 1}")
    except UnicodeDecodeError as error:
        # Binary data have control characters; text in an old encoding has letters of one byte.
        if set(data) & (set(range(32)) - set(b"\t\n\v\f\r\x1a")):
            raise unreadable(path, "text in UTF-8", error) from error
        line = data.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"{path.name} cannot be read as text in UTF-8: its line {line} has the byte "
            f"0x{data[error.start]:02x}, as text in Latin-1 or Windows-1252 has for a degree sign or an "
            "umlaut; save it as UTF-8."
        ) from error
    except ValueError as error:
        raise unreadable(path, "text in UTF-8", error) from error
    return text


def _cut(rows: list[str], delimiter: str | None, label: str, first: int) -> str:
    """A sentence of doubt about the last number of a file that does not end with a line end.

    Raises:
        InputError: the last number is certainly cut: all other numbers of its column have the same number of
            decimals and of digits in the exponent, but the last number has not.
    """
    last = rows[-1].rsplit(delimiter, 1)[-1].strip()
    others = {_form(row.rsplit(delimiter, 1)[-1].strip()) for row in rows[:-1]}
    if len(rows) > 10 and len(others) == 1 and others != {_form(last)}:
        decimals, exponent = next(iter(others))
        if decimals >= 3 or exponent:
            raise InputError(
                f"{label} ends inside line {first + len(rows) - 1}, with {last!r} where the lines above have "
                f"{decimals} decimals; remove that line, or export it again."
            )
    return f"No line end follows the last number, {last}, which may be cut; see that it is whole."


def _form(cell: str) -> tuple[int, int]:
    """Number of decimals, and number of digits of the exponent.

    >>> _form("-1.250e-05"), _form("12")
    ((3, 2), (0, 0))
    """
    mantissa, _, exponent = cell.lower().strip('"').partition("e")
    return len(mantissa.partition(".")[2]), len(exponent.lstrip("+-"))


def _header(lines: list[str]) -> int | None:
    """The index of the line with the names."""
    filled = [k for k, line in enumerate(lines) if line.strip(" \t,;#%")]
    for before, k in zip([None, *filled], filled, strict=False):
        if not lines[k].startswith(("#", "%")):
            # After the remarks come the names, or numbers whose names are in the last remark.
            numbers = _are_numbers(lines[k].replace(",", " ").replace(";", " ").split())
            return before if numbers and before is not None else k
    return filled[-1] if filled else None


def _units(rows: list[str], names: list[str], delimiter: str | None) -> dict[str, str]:
    """The units, if the line below the names has no numbers and the line after that has only numbers."""
    cells = _cells(rows[0], delimiter)
    if len(cells) != len(names) or len(rows) < 2 or not _are_numbers(_cells(rows[1], delimiter)):
        return {}
    if not "".join(cells).strip() or any(_are_numbers([cell]) for cell in cells):
        return {}
    return dict(zip(names, cells, strict=True))


def _columns(
    rows: list[str], names: list[str], delimiter: str | None, label: str, first: int
) -> dict[str, Shaped[np.ndarray, " N"]]:
    try:
        numbers = np.loadtxt(rows, delimiter=delimiter, ndmin=2, comments=None, quotechar='"')
    except ValueError:
        numbers = np.empty((0, 0))
    if numbers.shape == (len(rows), len(names)):
        return dict(zip(names, numbers.T, strict=True))
    # Slower, cell by cell: text stays text, so that an error message can name the place.
    cells = [_cells(row, delimiter) for row in rows]
    for k, row in enumerate(cells):
        if len(row) != len(names):
            raise InputError(
                f"{label} has {len(row)} cells in line {first + k}, but {len(names)} names in "
                f"its header ({', '.join(names)}); correct the file, or export it again."
            )
    return {name: np.array([row[k] for row in cells]) for k, name in enumerate(names)}


def _cells(line: str, delimiter: str | None) -> list[str]:
    return line.split() if delimiter is None else next(csv.reader([line], delimiter=delimiter), [])


def _are_numbers(cells: list[str]) -> bool:
    try:
        return bool([float(cell) for cell in cells])
    except ValueError:
        return False


# Step of the times, in median steps, above which rows are lost.
LOST = 1.5

# Samples of the input in each new period from which on it matters that one of them is used.
THINNED = 1.5


def resampled(
    t: Float[np.ndarray, " N"],
    u: Float[np.ndarray, "N D"],
    y: Float[np.ndarray, "N C"],
    period: Any,
    label: str,
    where: str = "row",
    first: int = 1,
) -> tuple[float, float, Float[np.ndarray, "M D"], Float[np.ndarray, "M C"], Finding]:
    """Signals at even times: the input is held, the outputs are interpolated linearly.

    Not for wrong time stamps of a converter that samples evenly: then leave out the time and give the
    sampling period.

    Args:
        t: Times, which may repeat but not decrease [s].
        u: Input, and signals that are held like the input.
        y: Outputs.
        period: New sampling period [s], or "auto" for the median step.
        label: First words of an error message.
        where: Word for one entry in an error message.
        first: Number of the first entry.

    Returns:
        First time and period [s], input, outputs, and a finding that states what was done: a note, or a
        warning if rows are lost, or samples of the input are left out.

    Raises:
        InputError: The times decrease or are too few, or they have a gap that is too long to interpolate.

    >>> t = np.array([0.0, 0.01, 0.021, 0.03, 0.04])
    >>> _, Ts, u, y, said = resampled(t, np.arange(5.0)[:, None], 10 * t[:, None], "auto", "run.csv")
    >>> Ts, u[:, 0], said.message
    (0.01, array([0., 1., 1., 3., 4.]), 'Resampled every 0.01 s from steps of 0.009 to 0.011 s.')
    """
    both = [TimedSignal(t, u, True, label), TimedSignal(t, y, False, label)]
    start, Ts, (held, lines), finding = resampled_apart(both, period, where, first)
    return start, Ts, held, lines, finding


class TimedSignal(NamedTuple):
    """A signal with times of its own.

    Attributes:
        t: Times, which may repeat but not decrease [s].
        x: Values.
        held: Whether the signal keeps its value until the next sample; otherwise it is interpolated linearly.
        label: First words of an error message.
    """

    t: Float[np.ndarray, " N"]
    x: Float[np.ndarray, "N C"]
    held: bool
    label: str


def resampled_apart(
    signals: Sequence[TimedSignal],
    period: Any,
    where: str = "row",
    first: int = 1,
) -> tuple[float, float, list[Float[np.ndarray, "M _"]], Finding]:
    """Signals with times of their own, resampled to common even times, over the time that all have.

    Args:
        signals: Signals; those with the same array of times share a clock.
        period: New sampling period [s], or "auto" for the longest of the median steps.
        where: Word for one entry in an error message.
        first: Number of the first entry.

    Returns:
        First time and period [s], the signals, and a finding that states what was done.

    Raises:
        InputError: As in `resampled`, or the signals have no time in common.

    >>> k = np.arange(5.0)
    >>> fast = TimedSignal(0.01 * k, k[:, None], True, "u")
    >>> slow = TimedSignal(0.004 + 0.02 * k, k[:, None], False, "y")
    >>> start, Ts, (u, y), _ = resampled_apart([fast, slow], "auto")
    >>> start, Ts, u[:, 0], y[:, 0]
    (0.004, 0.02, array([0., 2.]), array([0., 1.]))
    """
    clocks: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
    for t, _, _, label in signals:
        if id(t) not in clocks:
            clocks[id(t)] = _checked(t, label, where, first)
    medians = [float(np.median(steps)) for _, steps, _ in clocks.values()]
    Ts = float(f"{max(medians):.6g}") if period == "auto" else sampling_period(period, "Argument `resample`")
    start = max(float(t[0]) for t, _, _ in clocks.values())
    end = min(float(t[-1]) for t, _, _ in clocks.values())
    if end < start:
        raise InputError(
            f"{signals[0][3]} and the times of the other signals have nothing in common: one begins at "
            f"{start:g} s, after another has ended at {end:g} s; take all signals from one run."
        )
    grid = start + Ts * np.arange(int(np.floor((end - start) / Ts + 1e-6)) + 1)
    found = []
    for times, values, held, _ in signals:
        t, _, keep = clocks[id(times)]
        x = values[keep]
        if held:
            found.append(x[np.clip(np.searchsorted(t, grid + 1e-9 * Ts, side="right") - 1, 0, len(t) - 1)])
        else:
            found.append(np.column_stack([np.interp(grid, t, column) for column in x.T]))
    kinds = zip(clocks.values(), medians, strict=True)
    lost = sum(int(np.sum(np.round(s[s > LOST * median] / median) - 1)) for (_, s, _), median in kinds)
    repeated = sum(int(np.sum(~keep)) for _, _, keep in clocks.values())
    shortest = min(steps.min() for _, steps, _ in clocks.values())
    longest = max(steps.max() for _, steps, _ in clocks.values())
    message = f"Resampled every {Ts:g} s from steps of {shortest:.4g} to {longest:.4g} s"
    if len(clocks) > 1:
        message += f" of {len(clocks)} clocks"
    if lost:
        message += f"; about {lost} rows are lost, and lines bridge them"
    if repeated:
        message += f"; {repeated} rows with a time that was there before are left out"
    thinned = Ts / min((float(np.median(clocks[id(t)][1])) for t, _, held, _ in signals if held), default=Ts)
    if thinned > THINNED:
        message += (
            f"; of about {thinned:.2g} samples of the input one is used, not their mean as by decimate(), so "
            f"that it is late by {500 * (Ts - Ts / thinned):.2g} ms"
        )
    severity = "warning" if lost or thinned > THINNED else "note"
    finding = Finding("resampled", "time", f"{message}.", severity)
    return start, Ts, found, finding


def _checked(
    t: Float[np.ndarray, " N"], label: str, where: str, first: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The times without repetitions, their steps, and which of the given times are kept; checked."""
    finite(t, label, where, first)
    steps = np.diff(t)
    fallen = np.flatnonzero(steps < 0)
    if len(fallen):
        raise InputError(
            f"{label} must not fall, but does by {-steps[fallen[0]]:g} s between {where}s "
            f"{first + fallen[0]} and {first + fallen[0] + 1}; sort the rows, or load one run at a time."
        )
    keep = np.concatenate([[True], steps > 0])
    t = t[keep]
    steps = np.diff(t)
    if len(steps) < 2:
        raise InputError(f"{label} has {len(t)} different times, but resampling needs three; record longer.")
    median = float(np.median(steps))
    worst = int(np.argmax(steps))
    if steps[worst] > LONGEST_STEP * median:
        raise InputError(
            f"{label} has a gap of {steps[worst]:g} s after {t[worst]:g} s, {steps[worst] / median:.0f} "
            "times the median step, which no resampling should bridge; load the parts before and after it "
            "as recordings of their own."
        )
    return t, steps, keep
