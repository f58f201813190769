"""A part of a table: numbers by row and column, compared with the reference."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

REFERENCE: dict[str, Any] = json.loads(Path(__file__).with_name("reference.json").read_text())["tables"]

Number = float | None
"""None for an event that never happens, NaN for a cell that is left empty."""

SPREADS = 3.0
"""Numbers with a spread may differ by this many standard deviations of a single recording."""


@dataclasses.dataclass(frozen=True)
class Block:
    """Numbers with their tolerances, and notes on differences from the reference.

    Attributes:
        title: Title, and key in `reference.json`.
        about: What was computed, in a sentence or two.
        columns: Names of the columns.
        rows: Numbers by row.
        spread: Standard deviations over recordings or runs, for numbers that are means over them.
        relative: Tolerance, as a share of the reference.
        absolute: Tolerance, in the unit of the number, for instance half of the last digit of the reference.
        notes: Reasons of differences, found by experiment. A key is "" for all numbers, a row, a column or
            "row | column".
    """

    title: str
    about: str
    columns: tuple[str, ...]
    rows: dict[str, tuple[Number, ...]]
    spread: dict[str, tuple[Number, ...]] = dataclasses.field(default_factory=dict)
    relative: float = 0.0
    absolute: float = 0.0
    notes: dict[str, str] = dataclasses.field(default_factory=dict)

    def beside(self, section: str) -> dict[str, Any]:
        """The part for JSON: numbers with reference, difference and whether this is tolerated."""
        given = REFERENCE.get(section, {}).get(self.title, {})
        rows, beyond, unexplained = {}, [], []
        for row, values in self.rows.items():
            spreads = self.spread.get(row, (None,) * len(values))
            rows[row] = {}
            for column, value, spread in zip(self.columns, values, spreads, strict=True):
                cell = _cell(value, spread, given.get(row, {}).get(column, "none"), self)
                rows[row][column] = cell
                if cell.get("agrees") is False:
                    beyond.append(f"{row} | {column}")
                    if not {"", row, column, beyond[-1]} & set(self.notes):
                        unexplained.append(beyond[-1])
        tolerance = {"relative": self.relative, "absolute": self.absolute, "spreads": SPREADS}
        return {
            "title": self.title,
            "about": self.about,
            "tolerance": tolerance,
            "columns": list(self.columns),
            "rows": rows,
            "notes": self.notes,
            "beyond": beyond,
            "unexplained": unexplained,
        }


def _cell(value: Number, spread: Number, given: Any, block: Block) -> dict[str, Any]:
    """One number with its comparison.

    The reference `given` is a number, an interval, None for an event that never happens, or "none" if there
    is no reference.
    """
    if value is not None and math.isnan(value):
        return {}
    cell: dict[str, Any] = {"value": finite(value)}
    if spread is not None:
        cell["spread"] = finite(spread)
    if given == "none":
        return cell
    cell["reference"] = given
    if given is None or cell["value"] is None:
        return cell | {"agrees": given == cell["value"]}
    low, high = given if isinstance(given, list) else (given, given)
    difference = min(0.0, cell["value"] - low) + max(0.0, cell["value"] - high)
    allowed = max(
        block.relative * max(abs(low), abs(high)), block.absolute, SPREADS * (cell.get("spread") or 0.0)
    )
    return cell | {"difference": difference, "agrees": abs(difference) <= allowed * (1 + 1e-9)}


def finite(x: Number) -> Number:
    """The number, or None in place of NaN and infinity, which JSON does not have."""
    return None if x is None or not math.isfinite(x) else float(x)


def mean_and_spread(values: list[list[Number]]) -> tuple[tuple[Number, ...], tuple[Number, ...]]:
    """Means and standard deviations over recordings, from one list of numbers for each recording.

    A number that is None for one recording has neither.
    """
    means, spreads = [], []
    for column in zip(*values, strict=True):
        if any(v is None for v in column):
            means.append(None)
            spreads.append(None)
            continue
        mean = sum(column) / len(column)
        means.append(mean)
        several = len(column) > 1
        spreads.append(
            math.sqrt(sum((v - mean) ** 2 for v in column) / (len(column) - 1)) if several else None
        )
    return tuple(means), tuple(spreads)
