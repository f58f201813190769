"""Spreadsheets as tables; openpyxl is imported on use."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from rotflex_jax.data.tables import MAX_BYTES, Table, check_size, distinct, unreadable
from rotflex_jax.errors import InputError, optional


def table_from_xlsx(path: Path, max_bytes: int = MAX_BYTES) -> Table:
    """The columns of the first sheet that has any; names in its first row, units in the next or nowhere.

    Raises:
        InputError: openpyxl is missing, the file is damaged or too large, or no sheet has names and numbers.
    """
    openpyxl: Any = optional("openpyxl", f"Reading {path.name}")
    try:
        with zipfile.ZipFile(path) as archive:  # a part that is larger than it says fails its checksum
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
    """Rows that are not empty, with their numbers as the spreadsheet counts."""
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
    columns = {name: _column([row[k] for row in cells]) for k, name in enumerate(names)}
    return Table(label, columns, "row", rows[0][0], units)


def _cell(row: tuple[Any, ...], k: int) -> Any:
    value = row[k] if k < len(row) else None
    return "" if value is None else value


def _column(values: list[Any]) -> np.ndarray:
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        return np.array(values, float)
    return np.array([str(v) for v in values])
