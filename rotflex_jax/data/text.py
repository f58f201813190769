"""Delimited text as a table, with the line of whatever is wrong in it."""

import csv
from pathlib import Path

import numpy as np

from rotflex_jax.data.table import Table, distinct, unreadable
from rotflex_jax.errors import InputError


def table_from_text(path: Path) -> Table:
    """The columns of a text file with a header.

    The delimiter is a tab, semicolon, bar or comma, the first of these in the header, otherwise
    spaces; a comma beside another delimiter is a decimal comma. Remarks with # or % may stand on
    top, the last of them may be the header. A line of units may follow it.

    Raises:
        InputError: no text, no header, no samples, or a line with more or fewer cells than names.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise unreadable(path, "text in UTF-8", error) from error
    start = _header(lines)
    if start is None:
        raise InputError(f"{path.name} has no text in it; export the recording again.")
    delimiter = next((mark for mark in "\t;|," if mark in lines[start]), None)
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
    first = start + 2  # as an editor counts
    units = _units(rows, names, delimiter)
    if units:
        rows, first = rows[1:], first + 1
    return Table(path.name, _columns(rows, names, delimiter, path.name, first), "line", first, units)


def _header(lines: list[str]) -> int | None:
    """The index of the line with the names."""
    filled = [k for k, line in enumerate(lines) if line.strip(" \t,;#%")]
    for before, k in zip([None, *filled], filled, strict=False):
        if not lines[k].startswith(("#", "%")):
            # Below remarks come the names, or the numbers that the last remark has named.
            numbers = _are_numbers(lines[k].replace(",", " ").replace(";", " ").split())
            return before if numbers and before is not None else k
    return filled[-1] if filled else None


def _units(rows: list[str], names: list[str], delimiter: str | None) -> dict[str, str]:
    """The units, where the line below the names holds no number and the next one nothing else."""
    cells = _cells(rows[0], delimiter)
    if len(cells) != len(names) or len(rows) < 2 or not _are_numbers(_cells(rows[1], delimiter)):
        return {}
    if not "".join(cells).strip() or any(_are_numbers([cell]) for cell in cells):
        return {}
    return dict(zip(names, cells, strict=True))


def _columns(
    rows: list[str], names: list[str], delimiter: str | None, label: str, first: int
) -> dict[str, np.ndarray]:
    try:
        numbers = np.loadtxt(rows, delimiter=delimiter, ndmin=2, comments=None, quotechar='"')
    except ValueError:
        numbers = np.empty((0, 0))
    if numbers.shape == (len(rows), len(names)):
        return dict(zip(names, numbers.T, strict=True))
    # Slower, cell by cell: text stays text, so that the error can name its place.
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
