"""MATLAB files up to version 7.2: arrays, timetables, timeseries, tables and logs of Simulink.

MATLAB stores the contents of objects apart from the variables, in a part of the file without a name: names,
then for each object the numbers of its class and of its properties, then the values. Among these objects,
timetables, timeseries and tables are signals; durations and dates are their times. A Simulink Dataset is an
object that contains other objects, each with a name and, at some depth, a timeseries or timetable.

The reader of SciPy trusts the sizes and types that it finds, and a damaged file can end the interpreter. Here
each size and type is compared with the available bytes before it is used.

Source:
    The MathWorks, MAT-File Format, 2023.
"""

import itertools
import math
import struct
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8, UInt32

from rotflex_jax.data.tables import check_size

REFERENCE = 0xDD000000
"""First number of an array that refers to an object."""

SECONDS = {"milliseconds": 1e-3, "seconds": 1.0, "minutes": 60.0, "hours": 3600.0, "days": 86400.0}
"""Units of the times of a timeseries [s]."""

_NEWEST = 4  # newest known version of the nameless part
_VALUE = 1  # kind of a property that has a value of its own
_FIRST_VALUE = 2  # number of values before the values of properties
_MOST_RECORDS = 100_000


@dataclass(frozen=True)
class MatlabObject:
    """An object whose contents only MATLAB can read, such as iddata.

    Args:
        kind: class of the object.
        content: stored value: the reference to the object, or all values of the nameless part.
    """

    kind: str
    content: Any = field(default=None, compare=False, repr=False)


class Timetable(dict[str, Any]):
    """Columns of a timetable by name, with their times in `Time` [s]; a timeseries has the column `Data`."""


class StoredObjects:
    """The contents of the objects of a file.

    Args:
        values: names and numbers as bytes, then values.
        order: byte order, `<` or `>`.

    Raises:
        ValueError: the values do not have the format of MATLAB.
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
        self._signals: dict[int, Any] = {}
        self._logged: dict[tuple[int, str], dict[str, Any]] = {}

    def properties(self, reference: Any) -> dict[str, Any]:
        """Values of the properties that are stored with an object."""
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
        """Durations [s], or dates as seconds since the first date."""
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
        if isinstance(times, dict):  # evenly spaced, given by a step or by a rate
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

    def timeseries(self, reference: Any) -> Timetable:
        """Data and times of a timeseries; the times are stored, or follow from a first time and a step."""
        inside = self.properties(reference)
        about = self.properties(inside["TimeInfo"]) if "TimeInfo" in inside else {}
        data, t = (_either(inside, name) for name in ("Data", "Time"))
        t = np.atleast_1d(np.asarray([] if t is None else t, float)).ravel()
        if not len(t):
            count = _either(about, "Length")
            shape = np.shape(data) or (1,)
            # Without stored times it may be from Simulink, with time as the last axis.
            count = shape[-1 if len(shape) > 2 else 0] if count is None else int(count)
            if not 0 <= count <= np.size(data):
                raise ValueError("a timeseries has more times than values")
            t = float(_either(about, "Start") or 0.0) + float(_either(about, "Increment")) * np.arange(count)
        data = np.atleast_1d(np.asarray(data))
        if data.shape[0] != len(t):  # Simulink has time as the last axis
            data = np.moveaxis(data, -1, 0)
        if data.shape[0] != len(t) or data.dtype == object:
            raise ValueError("a timeseries has not as many values as times")
        data = data.reshape(len(t), -1)
        values = data[:, 0] if data.shape[1] == 1 else data
        return Timetable({"Time": SECONDS[about.get("Units", "seconds")] * t, "Data": values})

    def kind(self, reference: Any) -> str:
        """Class of an object, with its package."""
        package, name = self.of_class[4 * int(np.asarray(reference)[-1]) :][:2]
        return f"{self.names[package - 1]}.{self.names[name - 1]}" if package else self.names[name - 1]

    def logged(self, value: Any, name: str = "", seen: tuple[int, ...] = ()) -> dict[str, Any]:
        """Timeseries and timetables at any depth of an object, by the names of the objects that contain them.

        It does not matter in which property a version of Simulink stores its signals.

        Args:
            value: reference to the object, or cells or a structure of references.
            name: name of the object that contains it.
            seen: numbers of the objects on the path to it.

        Raises:
            ValueError: objects contain themselves or are nested too deeply, or two signals have one name.
        """
        number = referred(value)
        if number is None:
            parts = value.values() if isinstance(value, dict) else value
            cells = isinstance(value, np.ndarray) and value.dtype == object
            nested = cells or isinstance(value, dict | list)
            return _joined(self.logged(part, name, seen) for part in parts) if nested else {}
        if number in seen or len(seen) > DEEPEST_NESTING:
            raise ValueError("objects hold each other")
        # An object with several paths to it is read once: each object may refer to the next one twice.
        if (kind := self.kind(value)) in self.signals:
            if number not in self._signals:
                self._signals[number] = self.signals[kind](value)
            return {name: self._signals[number]}
        inside = self.properties(value)
        own = inside.get("Name")
        name = own if isinstance(own, str) and own else name
        if (number, name) not in self._logged:
            parts = inside.values()
            self._logged[number, name] = _joined(self.logged(part, name, (*seen, number)) for part in parts)
        return self._logged[number, name]

    @property
    def signals(self) -> dict[str, Callable[[Any], Any]]:
        """Class with times and values -> method that reads it."""
        return {"timetable": self.timetable, "timeseries": self.timeseries}

    def opened(self, value: Any) -> Any:
        """A value with the signals of its objects as columns; objects without signals stay unchanged."""
        if isinstance(value, dict):
            return {name: self.opened(part) for name, part in value.items()}
        if isinstance(value, list):
            return [self.opened(part) for part in value]
        read = self.signals | {"table": self.table}
        if not isinstance(value, MatlabObject) or not (
            value.kind in read or value.kind.startswith("Simulink.")
        ):
            return value
        try:
            return read.get(value.kind, self.logged)(value.content) or value
        except (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError):
            return value  # unknown version, or damaged: an error names it if the user asks for it


def _either(inside: dict[str, Any], name: str) -> Any:
    """A property that MATLAB stores under its name, with or without an underscore after it."""
    return inside.get(f"{name}_", inside.get(name))


def referred(value: Any) -> int | None:
    """Number of the object to which an array refers; None if it refers to no object or to several."""
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
    """Name, kind and value of the properties of each object; each record begins with their count."""
    found, at = [], 0
    while at < len(numbers) and len(found) < _MOST_RECORDS:
        end = at + 1 + 3 * numbers[at]
        part = numbers[at + 1 : end]
        if end > len(numbers):
            raise ValueError("an object has properties beyond the end")
        found.append([(part[k], part[k + 1], part[k + 2]) for k in range(0, len(part), 3)])
        at = end + end % 2
    return found


def _joined(parts: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Signals of several objects in one dictionary."""
    found: dict[str, Any] = {}
    for part in parts:
        # One signal may be reached by several paths.
        if twice := {name for name in found.keys() & part.keys() if found[name] is not part[name]}:
            raise ValueError(f"two signals have the name {min(twice)!r}")
        found |= part
    return found


def _cells(value: Any) -> list[Any]:
    """List of cells; a single cell is stored without a list."""
    return list(value) if isinstance(value, np.ndarray) and value.dtype == object else [value]


DEEPEST_NESTING = 50
"""Largest depth of nested structures and cells."""

MOST_PARTS = 1_000_000
"""Largest number of arrays in structures and cells of one file."""

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_ENCODINGS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_OPAQUE = 17  # class of an object
_INT32, _UINT32, _MATRIX, _COMPRESSED = 5, 6, 14, 15  # types of elements
_CELL, _STRUCT, _OBJECT, _CHAR, _FIRST_NUMBER, _LAST_NUMBER = 1, 2, 3, 4, 6, 15  # classes of arrays
_VERSION_4 = ("f8", "f4", "i4", "i2", "u2", "u1")


SKIPPED = object()
"""Placeholder for values that are no signals: sparse matrices, objects, functions."""


def variables_of_mat(data: bytes, label: str, max_bytes: int) -> dict[str, Any]:
    """The variables: arrays without axes of length 1, text, structures as dictionaries.

    Args:
        data: content of the file.
        label: name of the file in an error message.
        max_bytes: largest unpacked size [bytes].

    Raises:
        ValueError: sizes or types in the file do not agree.
        InputError: the file unpacks to more than `max_bytes`.
    """
    if 0 in data[:4]:
        return _version_4(data)
    mark = data[126:128]
    if mark not in (b"IM", b"MI") or data[124:126] not in (b"\x00\x01", b"\x01\x00"):
        raise ValueError("it does not begin as one")
    order = "<" if mark == b"IM" else ">"
    file = _Elements(data, order)
    found: dict[str, Any] = {}
    inside: Any = None  # contents of the objects
    place = struct.unpack_from(f"{order}Q", data, 116)[0]
    at, unpacked = 128, len(data)
    while at < len(data):
        begin = at
        kind, start, end, _ = file.element(at, len(data))
        part = file
        if kind == _COMPRESSED:
            content = _unpack(data[start:end], label, unpacked, max_bytes)
            unpacked += len(content)
            part = _Elements(content, order, file.parts)
            kind, first, last, _ = part.element(0, len(content))
        else:
            first, last = start, end
        if kind != _MATRIX:
            raise ValueError(f"an element of type {kind} stands where a variable should")
        name, value = part.array(first, last, 0)
        file.parts = part.parts
        at = end
        if begin == place and not name:
            inside = value
        if value is SKIPPED or not name:  # without a name: internal data of MATLAB
            continue
        if name in found:
            raise ValueError(f"it has two variables {name!r}")
        found[name] = value
    stored = None if inside is None else _stored_objects(inside, order)
    return found if stored is None else stored.opened(found)


def _stored_objects(inside: Any, order: str) -> StoredObjects | None:
    """The contents of the objects; None if their version is not known."""
    try:
        data = np.asarray(inside, np.uint8).tobytes()
        part = _Elements(data, order)
        kind, first, last, _ = part.element(8, len(data))
        if kind != _MATRIX:
            return None
        return StoredObjects(part.array(first, last, 0)[1]["MCOS"].content, order)
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, struct.error):
        return None


def _unpack(data: bytes, label: str, before: int, max_bytes: int) -> bytes:
    stream = zlib.decompressobj()
    try:
        content = stream.decompress(data, max(max_bytes - before, 0) + 1)
    except zlib.error as error:
        raise ValueError(str(error)) from error
    check_size(label, before + len(content), max_bytes)
    if not stream.eof:
        raise ValueError("a compressed variable is incomplete")
    return content


@dataclass
class _Elements:
    """Elements of data: a type, a size, and as many bytes as the size.

    Args:
        data: bytes.
        order: byte order, `<` or `>`.
        parts: number of arrays in structures and cells so far.
    """

    data: bytes
    order: str
    parts: int = 0

    def element(self, at: int, end: int) -> tuple[int, int, int, int]:
        """Type, start and end of the content, and where the next element begins."""
        if at + 8 > end:
            raise ValueError(f"it ends at byte {at}, inside a variable")
        kind, size = struct.unpack_from(f"{self.order}II", self.data, at)
        if kind >> 16:  # up to four bytes, stored in place of the size
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
            if size > 4:
                raise ValueError(f"a short element at byte {at} claims {size} bytes")
            return kind, start, start + size, at + 8
        start = at + 8
        if start + size > end:
            raise ValueError(f"{size} bytes are claimed at byte {at}, but {end - start} are there")
        return kind, start, start + size, start + size + -size % 8

    def numbers(self, at: int, end: int, kinds: tuple[int, ...] = ()) -> tuple[np.ndarray, int]:
        """The numbers of an element, and where the next element begins."""
        kind, start, stop, after = self.element(at, end)
        if kind not in _NUMBERS or (kinds and kind not in kinds):
            raise ValueError(f"an element of type {kind} stands where numbers should, at byte {at}")
        dtype = np.dtype(self.order + _NUMBERS[kind])
        if (stop - start) % dtype.itemsize:
            raise ValueError(f"{stop - start} bytes at byte {at} are no whole count of {dtype.name}")
        values = np.frombuffer(self.data, dtype, (stop - start) // dtype.itemsize, start)
        return values.astype(dtype.newbyteorder("=")), after

    def text(self, at: int, end: int) -> tuple[str, int]:
        """A name, and where the next element begins."""
        kind, start, stop, after = self.element(at, end)
        if kind not in (1, 16):
            raise ValueError(f"an element of type {kind} stands where a name should, at byte {at}")
        return self.data[start:stop].decode("latin-1"), after

    def array(self, at: int, end: int, depth: int) -> tuple[str, Any]:
        """Name and value of the content of a matrix element."""
        if at == end:  # an empty part of a structure or cell
            return "", np.array([])
        self.parts += 1
        if depth > DEEPEST_NESTING or self.parts > MOST_PARTS:
            raise ValueError("its structures are too deep or too many for a recording")
        flags, at = self.numbers(at, end, (_UINT32,))
        if len(flags) != 2:
            raise ValueError("a variable lacks its flags")
        kind, is_complex = int(flags[0]) & 0xFF, bool(flags[0] & 0x800)
        if not (kind in (_CELL, _STRUCT, _OBJECT, _CHAR) or _FIRST_NUMBER <= kind <= _LAST_NUMBER):
            return self.object(at, end, depth) if kind == _OPAQUE else ("", SKIPPED)
        sizes, at = self.numbers(at, end, (_INT32, _UINT32))
        shape = [int(n) for n in sizes]
        if not 2 <= len(shape) <= 32 or min(shape) < 0:
            raise ValueError(f"a variable has the shape {tuple(shape)[:8]}")
        name, at = self.text(at, end)
        if kind == _CELL:
            return name, self.cells(at, end, shape, depth)
        if kind == _OBJECT:
            _, at = self.text(at, end)  # its class; the rest is as in a structure
        if kind in (_STRUCT, _OBJECT):
            return name, self.structures(at, end, shape, depth)
        if kind == _CHAR:
            return name, self.characters(at, end, shape)
        values, at = self.numbers(at, end)
        if is_complex:
            imaginary, at = self.numbers(at, end)
            if len(imaginary) != len(values):
                raise ValueError(f"the variable {name!r} has not as many real as imaginary parts")
            values = values + 1j * imaginary
        if len(values) != math.prod(shape):
            raise ValueError(f"the variable {name!r} of shape {tuple(shape)} has {len(values)} numbers")
        return name, _squeezed(values, shape)

    def object(self, at: int, end: int, depth: int) -> tuple[str, Any]:
        """Name of an object, and the object with its class and stored value."""
        name, at = self.text(at, end)
        _, at = self.text(at, end)  # the system it belongs to
        kind, at = self.text(at, end)
        content = self.parts_of(at, end, 1, depth)[0] if at < end else None
        return name, MatlabObject(kind, content)

    def parts_of(self, at: int, end: int, count: int, depth: int) -> list[Any]:
        """The next `count` arrays."""
        if 8 * count > end - at:  # each has at least a type and a size
            raise ValueError(f"{count} parts are claimed at byte {at}, but {end - at} bytes are there")
        found = []
        for _ in range(count):
            kind, start, stop, at = self.element(at, end)
            if kind != _MATRIX:
                raise ValueError(f"an element of type {kind} stands where an array should")
            found.append(self.array(start, stop, depth + 1)[1])
        return found

    def cells(self, at: int, end: int, shape: list[int], depth: int) -> Any:
        """Values of cells, in an array of Python objects."""
        values = self.parts_of(at, end, math.prod(shape), depth)
        cells = np.empty(len(values), dtype=object)
        for k, value in enumerate(values):
            cells[k] = None if value is SKIPPED else value
        return _squeezed(cells, shape)

    def structures(self, at: int, end: int, shape: list[int], depth: int) -> Any:
        """A structure as a dictionary, or an array of structures as a list of dictionaries."""
        lengths, at = self.numbers(at, end, (_INT32,))
        if len(lengths) != 1 or lengths[0] < 1:
            raise ValueError("a structure has names without length")
        names, at = self.numbers(at, end, (1,))
        raw, length = names.tobytes(), int(lengths[0])
        if len(raw) % length:
            raise ValueError("a structure has incomplete names")
        keys = [raw[k : k + length].split(b"\0")[0].decode("latin-1") for k in range(0, len(raw), length)]
        if len(set(keys)) < len(keys):
            raise ValueError("a structure has two fields of one name")
        count = math.prod(shape)
        if not keys:
            return {} if count == 1 else []
        values = self.parts_of(at, end, count * len(keys), depth)
        rows = [values[k : k + len(keys)] for k in range(0, len(values), len(keys))]
        found = [{k: v for k, v in zip(keys, row, strict=True) if v is not SKIPPED} for row in rows]
        return found[0] if count == 1 else found

    def characters(self, at: int, end: int, shape: list[int]) -> Any:
        """Text, or an array of texts."""
        kind, start, stop, _ = self.element(at, end)
        if kind not in _ENCODINGS:
            raise ValueError(f"an element of type {kind} stands where text should, at byte {at}")
        wide = {"<": "-le", ">": "-be"}[self.order] if _ENCODINGS[kind][:6] in ("utf-16", "utf-32") else ""
        text = self.data[start:stop].decode(_ENCODINGS[kind] + wide, errors="replace")
        rows = math.prod(shape[:-1])
        if rows == 1:
            return text
        if len(text) != math.prod(shape):
            raise ValueError(f"text of shape {tuple(shape)} has {len(text)} characters")
        return _squeezed(np.array(["".join(text[k::rows]) for k in range(rows)]), shape[:-1])


def _squeezed(values: np.ndarray, shape: list[int]) -> Any:
    """The array without axes of length 1, or a single number; MATLAB stores column by column."""
    if not values.size:
        return values
    found = values.reshape(shape, order="F").squeeze()
    return found if found.ndim else found.item()


def _version_4(data: bytes) -> dict[str, Any]:
    """Full matrices and text of version 4, the format before 1996."""
    order = "<" if 0 <= struct.unpack_from("<i", data.ljust(4, b"\0"))[0] <= 5000 else ">"
    found: dict[str, Any] = {}
    at = 0
    while at < len(data):
        if at + 20 > len(data):
            raise ValueError(f"it ends at byte {at}, inside a variable")
        code, rows, width, is_complex, length = struct.unpack_from(f"{order}5i", data, at)
        precision, kind = code // 10 % 10, code % 10
        if not 0 <= code < 5000 or code // 100 % 10 or precision > 5 or kind > 2 or is_complex not in (0, 1):
            raise ValueError(f"no variable begins at byte {at}")
        if min(rows, width) < 0 or length < 1:
            raise ValueError(f"a variable of {rows} times {width} numbers is claimed at byte {at}")
        start = at + 20 + length
        dtype = np.dtype(order + _VERSION_4[precision])
        size = rows * width * dtype.itemsize * (1 + is_complex)
        if start + size > len(data):
            raise ValueError(f"{size} bytes are claimed at byte {at}, but {len(data) - start} are there")
        name = data[at + 20 : start].split(b"\0")[0].decode("latin-1")
        values = np.frombuffer(data, dtype, rows * width * (1 + is_complex), start)
        values = values.astype(dtype.newbyteorder("="))
        if is_complex:
            values = values[: rows * width] + 1j * values[rows * width :]
        at = start + size
        if name in found:
            raise ValueError(f"it has two variables {name!r}")
        if kind == 0:
            found[name] = _squeezed(values, [rows, width])
        elif kind == 1:
            letters = np.array([chr(int(c) & 0xFF) for c in np.real(values)]).reshape(rows, width, order="F")
            text = ["".join(row) for row in letters]
            found[name] = text[0] if rows == 1 else np.array(text)
    return found
