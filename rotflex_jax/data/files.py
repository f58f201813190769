"""A file or a DataFrame to a table: which reader, and what must be so before it starts."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rotflex_jax.data.binary import (
    table_from_frame,
    table_from_mat,
    table_from_npz,
    table_from_parquet,
)
from rotflex_jax.data.table import Table
from rotflex_jax.data.text import table_from_text
from rotflex_jax.errors import InputError

LARGEST = 2_000_000_000
"""Size of a file beyond which it is hardly one recording [bytes]."""

READERS: dict[str, Callable[[Path], Table]] = {
    ".csv": table_from_text,
    ".tsv": table_from_text,
    ".txt": table_from_text,
    ".mat": table_from_mat,
    ".npz": table_from_npz,
    ".parquet": table_from_parquet,
}


def read_table(source: Any, *, huge: bool = False) -> Table:
    """Reads a file by its ending, or takes a DataFrame.

    Args:
        source: path, or pandas DataFrame.
        huge: whether more than 2 GB are meant.

    Returns:
        The table.

    Raises:
        InputError: no such file, nothing in it, unknown ending, or not what the ending says.
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
    if path.stat().st_size > LARGEST and not huge:
        raise InputError(
            f"{path.name} has {path.stat().st_size / 1e9:.3g} GB, more than the "
            f"{LARGEST / 1e9:.3g} GB of any likely recording; check it, or pass accept=('huge',)."
        )
    return reader(path)


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
    if path.is_dir():
        raise InputError(f"{path} is a folder, but a recording is one file; name the file.")
    if not path.exists():
        raise InputError(f"{path} does not exist; give the path of a recording.")
    if path.stat().st_size == 0:
        raise InputError(f"{path.name} is empty; export the recording again.")
    if not os.access(path, os.R_OK):
        raise InputError(f"{path.name} may not be read; change its permissions.")
    return path
