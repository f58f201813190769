"""Binary files and DataFrames as tables; what they need beyond SciPy is imported on use."""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rotflex_jax.data.table import Table, distinct, unreadable
from rotflex_jax.errors import InputError, optional
from rotflex_jax.recording.quality import SHORTEST


def read_mat(path: Path) -> dict[str, Any]:
    """All variables of a MATLAB file up to version 7.2, structures as nested dictionaries.

    Raises:
        InputError: the file is damaged, or none.
    """
    from scipy.io import loadmat  # takes long to import, and only this needs it

    try:
        return loadmat(path, simplify_cells=True)
    except Exception as error:  # a damaged file fails in many ways within scipy
        raise unreadable(path, "a MATLAB file", error) from error


def table_from_mat(path: Path) -> Table:
    """The variables of a MATLAB file of any version."""
    with path.open("rb") as file:
        is_hdf5 = b"\x89HDF\r\n\x1a\n" in file.read(1024)  # MATLAB 7.3 puts 512 bytes in front
    values = _read_hdf5(path) if is_hdf5 else read_mat(path)
    return Table(path.name, dict(_flat(values)))


def _read_hdf5(path: Path) -> dict[str, Any]:
    h5py = optional("h5py", f"Reading {path.name}, a MATLAB file of version 7.3,")

    def values(group: Any) -> dict[str, Any]:
        return {
            # MATLAB stores column by column; text is whole numbers with a note that it is text.
            name: values(item) if isinstance(item, h5py.Group) else np.asarray(item[()]).T
            for name, item in group.items()
            if not name.startswith("#") and item.attrs.get("MATLAB_class") != b"char"
        }

    try:
        with h5py.File(path, "r") as file:
            return values(file)
    except (OSError, RuntimeError, AttributeError) as error:
        raise unreadable(path, "a MATLAB file of version 7.3", error) from error


def _flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, np.ndarray]]:
    """Nested variables with dotted names, matrices as columns; what is no array is left out.

    The columns of a matrix that is too short to hold signals, but long enough across, are its rows.
    """
    found: list[tuple[str, np.ndarray]] = []
    for key, value in values.items():
        name = prefix + str(key)
        if isinstance(value, Mapping):
            found += _flat(value, f"{name}.")
            continue
        try:
            array = np.asarray(value)
        except ValueError:  # cells of different length
            continue
        if name.startswith("__") or array.dtype.kind == "V":  # of the file itself, or not decoded
            continue
        if array.ndim == 2 and 1 not in array.shape:
            if array.shape[0] < SHORTEST <= array.shape[1]:  # Simulink's "To File" writes rows
                array = array.T
            found += [(f"{name}[{k}]", array[:, k]) for k in range(array.shape[1])]
        elif array.ndim <= 2 and array.size:
            found.append((name, array.ravel()))
    return found


def table_from_npz(path: Path) -> Table:
    """The arrays of an NPZ file, never unpickled."""
    try:
        with path.open("rb") as file:
            content = np.load(file, allow_pickle=False)
            if isinstance(content, np.lib.npyio.NpzFile):
                return Table(path.name, dict(_flat({name: content[name] for name in content})))
    except (ValueError, EOFError, OSError, KeyError, zipfile.BadZipFile) as error:
        if "pickle" in str(error):
            raise InputError(
                f"{path.name} holds pickled objects, which could run any code when opened, and is "
                "not read; save plain arrays of numbers."
            ) from error
        raise unreadable(path, "an NPZ file", error) from error
    raise InputError(f"{path.name} holds one array without names; save it with numpy.savez.")


def table_from_parquet(path: Path) -> Table:
    """The columns of a Parquet file."""
    pandas = optional("pandas", f"Reading {path.name}")
    optional("pyarrow", f"Reading {path.name}")
    try:
        frame = pandas.read_parquet(path)
    except Exception as error:  # a damaged file fails in many ways within pyarrow
        raise unreadable(path, "a Parquet file", error) from error
    return table_from_frame(frame, path.name)


def table_from_frame(frame: Any, label: str = "DataFrame") -> Table:
    """The columns of a DataFrame; rows are counted from 0."""
    names = distinct([str(name) for name in frame.columns], label)
    columns = {name: frame[key].to_numpy() for name, key in zip(names, frame.columns, strict=True)}
    return Table(label, columns, first=0)
