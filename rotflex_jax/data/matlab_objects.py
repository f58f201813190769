"""Timetables and tables in MATLAB files up to version 7.2.

MATLAB keeps the insides of objects apart from the variables, in a part of the file without a name: names,
then for each object the numbers of its class and of its properties, then the values. Of those objects,
timetables and tables are signals; durations and dates are their times.
"""

import itertools
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8, UInt32

REFERENCE = 0xDD000000
"""First number of what stands for an object."""

_NEWEST = 4  # version of the part
_VALUE = 1  # kind of a property that has a value of its own
_FIRST_VALUE = 2  # values before those of properties
_MOST_RECORDS = 100_000


@dataclass(frozen=True)
class MatlabObject:
    """Stands for an object whose insides only MATLAB knows, such as a timeseries.

    Args:
        kind: its class.
        content: what is stored in its place: the number of the object, or all values of the nameless part.
    """

    kind: str
    content: Any = field(default=None, compare=False, repr=False)


class Timetable(dict[str, Any]):
    """Columns of a timetable by name, `Time` with the times of all [s]."""


class StoredObjects:
    """The insides of the objects of a file.

    Args:
        values: names and numbers as bytes, then values.
        order: `<` or `>`.

    Raises:
        ValueError: they are not as MATLAB writes them.
    """

    def __init__(self, values: Sequence[Any], order: str) -> None:
        head = _bytes(values[0])
        version, count, *ends = struct.unpack_from(f"{order}10I", head)
        if not 2 <= version <= _NEWEST or not 40 <= ends[0] <= len(head) or ends[:5] != sorted(ends[:5]):
            raise ValueError(f"objects of version {version} are not known")
        self.values = values
        self.names = [name.decode("latin-1") for name in head[40 : ends[0]].split(b"\0")[:count]]
        parts = [head[a:b] for a, b in itertools.pairwise(ends[:5])]
        self.of_class, saved, of_object, plain = (
            np.frombuffer(part[: len(part) // 4 * 4], f"{order}u4").tolist() for part in parts
        )
        self.of_object = of_object
        self.records = _records(saved), _records(plain)

    def properties(self, reference: Any) -> dict[str, Any]:
        """Values of the properties of an object that are stored with it."""
        number = referred(reference)
        if number is None or number < 1 or 6 * number + 6 > len(self.of_object):
            raise ValueError("a reference leads to no object")
        saved, plain = self.of_object[6 * number + 3 : 6 * number + 5]
        records, which = (self.records[0], saved) if saved else (self.records[1], plain)
        found = {}
        for name, kind, value in records[which]:
            if kind == _VALUE:
                found[self.names[name - 1]] = self.values[_FIRST_VALUE + value]
        return found

    def seconds(self, reference: Any) -> Float[np.ndarray, " N"]:
        """Durations [s], or dates as seconds since the first."""
        inside = self.properties(reference)
        if "millis" in inside:
            return np.atleast_1d(np.asarray(inside["millis"], float)) * 1e-3
        dates = np.real(np.atleast_1d(np.asarray(inside["data"])))
        return (dates - dates[0]) * 1e-3

    def timetable(self, reference: Any) -> Timetable:
        """Columns and times of a timetable."""
        inside = self.properties(reference)["any"]
        columns = dict(zip(_cells(inside["varNames"]), _cells(inside["data"]), strict=True))
        times = inside["rowTimes"]
        if isinstance(times, dict):  # evenly spaced, by a step or by a rate
            rate = bool(np.any(times.get("specifiedAsRate", False)))
            step = 1 / float(times["sampleRate"]) if rate else float(self.seconds(times["stepSize"])[0])
            rows = max(len(np.atleast_1d(column)) for column in columns.values())
            t = float(self.seconds(times["origin"])[0]) + step * np.arange(rows)
        else:
            t = self.seconds(times)
        return Timetable({"Time": t} | columns)

    def table(self, reference: Any) -> dict[str, Any]:
        """Columns of a table."""
        inside = self.properties(reference)
        return dict(zip(_cells(inside["varnames"]), _cells(inside["data"]), strict=True))

    def opened(self, value: Any) -> Any:
        """A value with the timetables and tables in it as columns; other objects stay as they are."""
        if isinstance(value, dict):
            return {name: self.opened(part) for name, part in value.items()}
        if not isinstance(value, MatlabObject) or value.kind not in ("timetable", "table"):
            return value
        try:
            read = self.timetable if value.kind == "timetable" else self.table
            return read(value.content)
        except (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError):
            return (
                value  # of a version that is not known, or damaged: an error names it where it is asked for
            )


def referred(value: Any) -> int | None:
    """Number of the one object that an array stands for, None where it stands for none or several."""
    numbers = np.asarray(value)
    if numbers.dtype != np.uint32 or numbers.ndim != 1 or len(numbers) != 6 or numbers[0] != REFERENCE:
        return None
    return int(numbers[4])


def _bytes(value: Any) -> bytes:
    array: UInt8[np.ndarray, " N"] | UInt32[np.ndarray, " N"] = np.asarray(value)
    if array.dtype != np.uint8 or array.nbytes < 40:
        raise ValueError("the numbers of the objects are missing")
    return array.tobytes()


def _records(numbers: list[int]) -> list[list[tuple[int, int, int]]]:
    """Name, kind and value of the properties of each object, behind their count, with an even length each."""
    found, at = [], 0
    while at < len(numbers) and len(found) < _MOST_RECORDS:
        end = at + 1 + 3 * numbers[at]
        part = numbers[at + 1 : end]
        if end > len(numbers):
            raise ValueError("an object has properties beyond the end")
        found.append([(part[k], part[k + 1], part[k + 2]) for k in range(0, len(part), 3)])
        at = end + end % 2
    return found


def _cells(value: Any) -> list[Any]:
    """Cells, of which a single one stands alone."""
    return list(value) if isinstance(value, np.ndarray) and value.dtype == object else [value]
