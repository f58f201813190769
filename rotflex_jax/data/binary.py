"""Binary files, spreadsheets and DataFrames as tables; optional packages are imported on use.

The description of a Parquet file is read here: pyarrow reads it too, but a damaged one ends the interpreter.

Source:
    Apache Parquet, File format and parquet.thrift; Apache Thrift, Compact protocol.
"""

import itertools
import math
import os
import zipfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from rotflex_jax.data.matlab import MatlabObject, Timetable, variables_of_mat
from rotflex_jax.data.tables import MAX_BYTES, Table, check_size, distinct, unreadable
from rotflex_jax.errors import InputError, optional
from rotflex_jax.recording.quality import SHORTEST_RECORDING


def table_from_xlsx(path: Path, max_bytes: int = MAX_BYTES) -> Table:
    """The columns of the first sheet that has any: names in its first row, possibly units in the second.

    Raises:
        InputError: openpyxl is missing, the file is damaged or too large, no sheet has names and numbers, or
            a row among the numbers is empty.
    """
    openpyxl: Any = optional("openpyxl", f"Reading {path.name}")
    try:
        with zipfile.ZipFile(path) as archive:  # a part larger than its stated size fails its checksum
            check_size(path.name, sum(part.file_size for part in archive.infolist()), max_bytes)
        book = openpyxl.load_workbook(path, read_only=True, data_only=True)
        sheets = [(name, _filled(book[name])) for name in book.sheetnames if hasattr(book[name], "iter_rows")]
        book.close()
    except InputError:
        raise
    except Exception as error:  # a damaged file fails in many ways within openpyxl
        raise unreadable(path, "a spreadsheet", error) from error
    for name, rows in sheets:
        if len(rows) > 1:
            return _table(f"{path.name}, sheet {name}", rows)
    raise InputError(f"{path.name} has no sheet with names of columns and numbers below; export it again.")


def _filled(sheet: Any) -> list[tuple[int, tuple[Any, ...]]]:
    """Rows that are not empty, with their numbers in the spreadsheet."""
    rows = enumerate(sheet.iter_rows(values_only=True), 1)
    return [(k, row) for k, row in rows if any(cell is not None for cell in row)]


def _table(label: str, rows: list[tuple[int, tuple[Any, ...]]]) -> Table:
    heading, rows = rows[0][1], rows[1:]
    used = [k for k, cell in enumerate(heading) if cell is not None]
    names = [str(heading[k]).strip() for k in used]
    if all(isinstance(heading[k], int | float) for k in used):
        raise InputError(
            f"{label} has no header, its first row holds numbers; put the names of the columns there, such "
            "as t, voltage, theta, alpha."
        )
    distinct(names, label)
    cells = [[_cell(row, k) for k in used] for _, row in rows]
    units: dict[str, str] = {}
    if len(cells) > 1 and all(isinstance(c, str) for c in cells[0]) and "".join(cells[0]).strip():
        units, cells, rows = dict(zip(names, cells[0], strict=True)), cells[1:], rows[1:]
    empty = next((k + 1 for (k, _), (after, _) in itertools.pairwise(rows) if after > k + 1), None)
    if empty is not None:
        raise InputError(
            f"{label} has the empty row {empty} among its samples, where some may be missing; cut the "
            "recording there, or remove the row if none is."
        )
    columns = {name: _column([row[k] for row in cells]) for k, name in enumerate(names)}
    return Table(label, columns, "row", rows[0][0], units)


def _cell(row: tuple[Any, ...], k: int) -> Any:
    value = row[k] if k < len(row) else None
    return "" if value is None else value


def _column(values: list[Any]) -> np.ndarray:
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        return np.array(values, float)
    return np.array([str(v) for v in values])


DEEPEST_STRUCTURE = 30
"""Largest depth of nested structures in the description."""

_BYTE_ARRAY, _FIXED_LENGTH = 6, 7  # physical types
_TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = 1, 2, 3, 7, 8, 9, 10, 11, 12


class ParquetColumn(NamedTuple):
    """A column of one group of rows.

    Attributes:
        name: name, with the names of the structures around it, joined by points.
        size: unpacked size, with repeated words counted once [bytes].
        is_text: whether its values have variable length.
    """

    name: str
    size: int
    is_text: bool


def columns_of_parquet(path: Path) -> list[ParquetColumn]:
    """The columns of each group of rows.

    Raises:
        OSError: the file cannot be read.
        ValueError: the description at the end of the file is damaged.
    """
    with path.open("rb") as file:
        start, size = file.read(4), file.seek(0, os.SEEK_END)
        file.seek(max(size - 8, 0))
        length, end = int.from_bytes(file.read(4), "little"), file.read(4)
        if start != b"PAR1" or end != b"PAR1" or length > size - 12:
            raise ValueError("it does not begin and end as one")
        file.seek(size - 8 - length)
        description = file.read(length)
    found = []
    try:
        whole = _Description(description).structure(0)
        widest = max([8, *(part.get(2, 0) for part in whole[2] if part.get(1) == _FIXED_LENGTH)])
        for group in whole.get(4, []):
            for column in group[1]:
                about = column[3]
                kind, count, size = about[1], about[5], about[6]
                if min(count, size) < 0:
                    raise ValueError("a column has a negative size")
                size = max(size, count * (widest if kind == _FIXED_LENGTH else 8))
                name = ".".join(part.decode() for part in about[3])
                found.append(ParquetColumn(name, size, kind == _BYTE_ARRAY))
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise ValueError("its description is damaged") from error
    return found


class _Description:
    """Reader of structures in the compact protocol: each is a dictionary, by the numbers of the fields."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, count: int) -> bytes:
        """The next `count` bytes."""
        self.at += count
        if self.at > len(self.data):
            raise ValueError("its description is incomplete")
        return self.data[self.at - count : self.at]

    def natural(self) -> int:
        """A non-negative whole number, stored in groups of seven bits."""
        value = 0
        for shift in range(0, 70, 7):
            byte = self.take(1)[0]
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise ValueError("a number of its description is too long")

    def whole(self) -> int:
        """A whole number that may be negative."""
        value = self.natural()
        return (value >> 1) ^ -(value & 1)

    def structure(self, depth: int) -> dict[int, Any]:
        """The fields up to the end of the structure."""
        if depth > DEEPEST_STRUCTURE:
            raise ValueError("its description is nested too deeply")
        found: dict[int, Any] = {}
        number = 0
        while head := self.take(1)[0]:
            number = number + (head >> 4) if head >> 4 else self.whole()
            kind = head & 15
            found[number] = kind == _TRUE if kind in (_TRUE, _FALSE) else self.value(kind, depth)
        return found

    def value(self, kind: int, depth: int) -> Any:
        """A value of a type; truth values in a list have one byte each."""
        if kind in (_TRUE, _FALSE, _BYTE):
            return self.take(1)[0]
        if kind < _DOUBLE:
            return self.whole()
        if kind == _DOUBLE:
            return self.take(8)
        if kind == _BINARY:
            return self.take(self.natural())
        if kind == _STRUCT:
            return self.structure(depth + 1)
        if depth > DEEPEST_STRUCTURE:
            raise ValueError("its description is nested too deeply")
        if kind in (_LIST, _SET):
            head = self.take(1)[0]
            count = self.natural() if head >> 4 == 15 else head >> 4
            return [self.value(head & 15, depth + 1) for _ in range(count)]
        if kind == _MAP:
            count = self.natural()
            kinds = self.take(1)[0] if count else 0
            return [
                (self.value(kinds >> 4, depth + 1), self.value(kinds & 15, depth + 1)) for _ in range(count)
            ]
        raise ValueError(f"its description has a value of the unknown type {kind}")


def read_mat(path: Path, max_bytes: int = MAX_BYTES) -> dict[str, Any]:
    """All variables of a MATLAB file up to version 7.2, structures as nested dictionaries.

    Raises:
        InputError: the file is damaged, no MATLAB file, or larger than `max_bytes` when unpacked.
    """
    try:
        return variables_of_mat(path.read_bytes(), path.name, max_bytes)
    except InputError:
        raise
    except (ValueError, OverflowError, OSError, MemoryError) as error:
        raise unreadable(path, "a MATLAB file", error) from error


def table_from_mat(path: Path, max_bytes: int = MAX_BYTES) -> Table:
    """The variables of a MATLAB file of any version."""
    with path.open("rb") as file:
        is_hdf5 = b"\x89HDF\r\n\x1a\n" in file.read(1024)  # MATLAB 7.3 begins with 512 bytes of its own
    values = _read_hdf5(path, max_bytes) if is_hdf5 else read_mat(path, max_bytes)
    columns = dict(_flat(values))
    clocks = {
        name: f"{start}Time" for start in _timetables(values) for name in columns if name.startswith(start)
    }
    return Table(path.name, columns, objects=dict(_objects(values)), clocks=clocks)


def _timetables(values: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Prefixes of the names of columns in timetables."""
    found: list[str] = []
    for key, value in values.items():
        if isinstance(value, Timetable):
            found.append(f"{prefix}{key}.")
        elif isinstance(value, Mapping):
            found += _timetables(value, f"{prefix}{key}.")
        elif (parts := _parts(value)) is not None:
            found += _timetables(parts, f"{prefix}{key}")
    return found


def _objects(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Objects of MATLAB by dotted name, with their classes."""
    found: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, MatlabObject):
            found.append((prefix + key, value.kind))
        elif isinstance(value, Mapping):
            found += _objects(value, f"{prefix}{key}.")
        elif (parts := _parts(value)) is not None:
            found += _objects(parts, f"{prefix}{key}")
    return found


DEEPEST_GROUP = 50
"""Largest depth of nested groups in an HDF5 file."""


def _read_hdf5(path: Path, max_bytes: int) -> dict[str, Any]:
    """The data sets of the file itself; links to other places or files are not followed."""
    h5py = optional("h5py", f"Reading {path.name}, a MATLAB file of version 7.3,")
    seen: set[int] = set()
    size = 0

    def array(item: Any) -> np.ndarray:
        nonlocal size
        if item.external or item.is_virtual:
            raise InputError(
                f"{path.name} keeps {item.name!r} in another file, which is not read; store it in one file."
            )
        # A small file can claim any size, also for a block to unpack.
        blocks = item.dtype.itemsize * math.prod(item.chunks or ())
        check_size(path.name, blocks, max_bytes)
        size += item.dtype.itemsize * math.prod(item.shape)
        check_size(path.name, size, max_bytes)
        # MATLAB stores column by column.
        return np.asarray(item[()]).T

    def values(group: Any, depth: int) -> dict[str, Any]:
        found: dict[str, Any] = {}
        if depth > DEEPEST_GROUP:
            raise ValueError(f"more than {DEEPEST_GROUP} groups stand within one another")
        for name in group:
            if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
                continue
            item = group[name]
            address = h5py.h5o.get_info(item.id).addr
            if address in seen:
                raise ValueError(f"{item.name!r} stands in two places")
            seen.add(address)
            if "MATLAB_object_decode" in item.attrs:  # numbers that refer to the contents of an object
                found[name] = MatlabObject(np.bytes_(item.attrs.get("MATLAB_class", b"object")).decode())
            elif isinstance(item, h5py.Group):
                found[name] = values(item, depth + 1)
            elif isinstance(item, h5py.Dataset) and is_signal(item):
                found[name] = array(item)
        return found

    def is_signal(item: Any) -> bool:
        if item.shape is None or item.dtype.kind == "O":
            return False
        # An empty array is stored as its sizes, text as whole numbers with a note that it is text.
        return "MATLAB_empty" not in item.attrs and item.attrs.get("MATLAB_class") != b"char"

    try:
        with h5py.File(path, "r") as file:
            return values(file, 0)
    except InputError:
        raise
    except Exception as error:  # a damaged file fails in many ways within HDF5
        raise unreadable(path, "a MATLAB file of version 7.3", error) from error


def _flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Shaped[np.ndarray, " N"]]]:
    """Nested variables with dotted names, matrices as columns; values that are no arrays are left out.

    A matrix with too few rows for a recording, but enough columns, has its signals in its rows.
    """
    found: list[tuple[str, Shaped[np.ndarray, " N"]]] = []
    for key, value in values.items():
        name = prefix + str(key)
        if isinstance(value, Mapping):
            found += _flat(value, f"{name}.")
            continue
        if isinstance(value, MatlabObject):
            continue
        parts = _parts(value)
        if parts is not None:  # an array of structures or cells with values inside
            found += _flat(parts, name)
            continue
        try:
            array = np.asarray(value)
        except ValueError:  # cells of different length
            continue
        if array.dtype.names:  # records with named fields
            found += _flat({key: array[key] for key in array.dtype.names}, f"{name}.")
            continue
        if name.startswith("__") or array.dtype.kind == "V":  # header of the file, or not decoded
            continue
        if array.ndim == 2 and array.size and 1 not in array.shape:
            if array.shape[0] < SHORTEST_RECORDING <= array.shape[1]:  # Simulink's "To File" writes rows
                array = array.T
            found += [(f"{name}[{k}]", array[:, k]) for k in range(array.shape[1])]
        elif array.ndim <= 2 and array.size:
            found.append((name, array.ravel()))
    return found


def _parts(value: Any) -> dict[str, Any] | None:
    """Members of an array of structures, or of cells that hold arrays, by index; None for anything else."""
    if isinstance(value, np.ndarray) and value.dtype == object and value.ndim == 1:
        value = list(value)
    if not isinstance(value, list):
        return None
    nested = [isinstance(v, Mapping | list) or (isinstance(v, np.ndarray) and v.ndim > 0) for v in value]
    return {f"[{k}]": v for k, v in enumerate(value) if nested[k]} if any(nested) else None


def table_from_npz(path: Path, max_bytes: int = MAX_BYTES) -> Table:
    """The arrays of an NPZ file, never unpickled."""
    with path.open("rb") as file:
        start = file.read(6)
    if start == b"\x93NUMPY":
        raise InputError(f"{path.name} holds one array without names; save it with numpy.savez.")
    if start[0] == 0x80:
        raise _pickled(path.name)
    try:
        with zipfile.ZipFile(path) as archive:
            parts = [part for part in archive.infolist() if part.filename.endswith(".npy")]
            # Before anything is unpacked; a part larger than its stated size fails its checksum.
            check_size(path.name, sum(part.file_size for part in parts), max_bytes)
            names = distinct([part.filename.removesuffix(".npy") for part in parts], path.name)
            arrays = {
                name: _npy(archive.read(part), path.name) for name, part in zip(names, parts, strict=True)
            }
    except InputError:
        raise
    except Exception as error:  # a damaged file fails in many ways within zipfile, zlib and NumPy
        raise unreadable(path, "an NPZ file", error) from error
    return Table(path.name, dict(_flat(arrays)))


def _npy(data: bytes, label: str) -> np.ndarray:
    """The array in the content of an NPY file, whose size must agree with its header."""
    file = BytesIO(data)
    version = np.lib.format.read_magic(file)
    headers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in headers:
        raise ValueError(f"an array has the format {version[0]}.{version[1]}")
    shape, by_columns, dtype = headers[version](file)
    if dtype.hasobject:
        raise _pickled(label)
    count, start = math.prod(shape), file.tell()
    if min(shape, default=0) < 0 or count * dtype.itemsize != len(data) - start:
        raise ValueError(f"an array of shape {shape} has {len(data) - start} bytes")
    if not count:
        return np.empty(0)
    return np.frombuffer(data, dtype, count, start).reshape(shape, order="F" if by_columns else "C")


def _pickled(label: str) -> InputError:
    return InputError(
        f"{label} holds pickled objects, which could run any code when opened, and is not read; save plain "
        "arrays of numbers."
    )


def table_from_parquet(path: Path, max_bytes: int = MAX_BYTES) -> Table:
    """The columns of a Parquet file."""
    optional("pandas", f"Reading {path.name}")
    parquet: Any = optional("pyarrow.parquet", f"Reading {path.name}")
    try:
        columns = columns_of_parquet(path)
        # Equal values are stored once, but counted as often as they are unpacked.
        check_size(path.name, sum(column.size for column in columns), max_bytes)
        # Text stays a list of words with a number for each row.
        texts = [column.name for column in columns if column.is_text]
        table = parquet.read_table(path, partitioning=None, read_dictionary=texts)
        frame = table.to_pandas(ignore_metadata=True)  # else it may expand words to text in every row
        return table_from_frame(frame, path.name)
    except InputError:
        raise
    except Exception as error:  # a damaged file fails in many ways within pyarrow
        raise unreadable(path, "a Parquet file", error) from error


def table_from_frame(frame: Any, label: str = "DataFrame") -> Table:
    """The columns of a DataFrame; rows are counted from 0."""
    names = distinct([str(name) for name in frame.columns], label)
    columns = {name: _entries(frame[key]) for name, key in zip(names, frame.columns, strict=True)}
    return Table(label, columns, first=0)


def _entries(column: Any) -> np.ndarray:
    """The entries of a column of a DataFrame; equal words of a category are one object."""
    if column.dtype != "category" or column.cat.categories.dtype.kind in "iuf":
        return column.to_numpy()
    return np.array([*column.cat.categories, np.nan], dtype=object)[column.cat.codes]
