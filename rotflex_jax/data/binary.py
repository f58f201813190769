"""Binary files and DataFrames as tables; packages other than SciPy are imported on use."""

import math
import zipfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from rotflex_jax.data.matlab import variables_of_mat
from rotflex_jax.data.matlab_objects import MatlabObject, Timetable
from rotflex_jax.data.parquet import columns_of_parquet
from rotflex_jax.data.tables import MAX_BYTES, Table, check_size, distinct, unreadable
from rotflex_jax.errors import InputError, optional
from rotflex_jax.recording.quality import SHORTEST_RECORDING


def read_mat(path: Path, max_bytes: int = MAX_BYTES) -> dict[str, Any]:
    """All variables of a MATLAB file up to version 7.2, structures as nested dictionaries.

    Raises:
        InputError: the file is damaged, or none, or larger than `max_bytes` when unpacked.
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
        is_hdf5 = b"\x89HDF\r\n\x1a\n" in file.read(1024)  # MATLAB 7.3 puts 512 bytes in front
    values = _read_hdf5(path, max_bytes) if is_hdf5 else read_mat(path, max_bytes)
    columns = dict(_flat(values))
    clocks = {
        name: f"{start}Time" for start in _timetables(values) for name in columns if name.startswith(start)
    }
    return Table(path.name, columns, objects=dict(_objects(values)), clocks=clocks)


def _timetables(values: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Beginnings of the names of columns that stand in timetables."""
    found: list[str] = []
    for key, value in values.items():
        if isinstance(value, Timetable):
            found.append(f"{prefix}{key}.")
        elif isinstance(value, Mapping):
            found += _timetables(value, f"{prefix}{key}.")
    return found


def _objects(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Objects of MATLAB by dotted name, with their classes."""
    found: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, MatlabObject):
            found.append((prefix + key, value.kind))
        elif isinstance(value, Mapping):
            found += _objects(value, f"{prefix}{key}.")
    return found


DEEPEST_GROUP = 50
"""Groups of an HDF5 file within one another."""


def _read_hdf5(path: Path, max_bytes: int) -> dict[str, Any]:
    """The data sets of the file itself: links to other places or files are not followed."""
    h5py = optional("h5py", f"Reading {path.name}, a MATLAB file of version 7.3,")
    seen: set[int] = set()
    size = 0

    def array(item: Any) -> np.ndarray:
        nonlocal size
        if item.external or item.is_virtual:
            raise InputError(
                f"{path.name} keeps {item.name!r} in another file, which is not read; store it in one file."
            )
        # A size that is claimed costs nothing in the file, and so does that of a block to unpack.
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
            if "MATLAB_object_decode" in item.attrs:  # numbers that lead to the object's insides
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
    """Nested variables with dotted names, matrices as columns; what is no array is left out.

    The columns of a matrix that is too short to hold signals, but long enough across, are its rows.
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
        if parts is not None:  # an array of structures or of cells, each with leaves of its own
            found += _flat(parts, name)
            continue
        try:
            array = np.asarray(value)
        except ValueError:  # cells of different length
            continue
        if name.startswith("__") or array.dtype.kind == "V":  # of the file itself, or not decoded
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
            # Before anything is unpacked; a part that is larger than it says fails its checksum.
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
    """The array in the content of an NPY file, of the size that its header says."""
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
        # Equal values, stored once, are counted as often as they are unpacked.
        check_size(path.name, sum(column.size for column in columns), max_bytes)
        # Text stays a list of words with a number for each row.
        texts = [column.name for column in columns if column.is_text]
        table = parquet.read_table(path, partitioning=None, read_dictionary=texts)
        frame = table.to_pandas(ignore_metadata=True)  # which may turn words into text of every row
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
