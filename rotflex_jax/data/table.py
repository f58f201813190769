"""A table: named columns of whatever length and type, nothing interpreted yet."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rotflex_jax.errors import InputError


@dataclass(frozen=True)
class Table:
    """Named columns.

    Args:
        label: what an error calls it.
        columns: by name; a matrix gives a column `name[k]` for each of its own.
        where: what a row is called.
        first: number of the first row.
        units: as a line of its own gives them, by name.
    """

    label: str
    columns: Mapping[str, np.ndarray]
    where: str = "row"
    first: int = 1
    units: Mapping[str, str] = field(default_factory=dict)

    def column(self, name: str, what: str) -> np.ndarray:
        """One column.

        Args:
            name: its name.
            what: the argument by which a user could name another.

        Raises:
            InputError: there is none; the error lists those that are there.
        """
        if isinstance(name, str) and name in self.columns:
            return self.columns[name]
        if isinstance(name, str) and set(parts := name.split(",")) < set(self.columns):
            raise self._lacks(f"column {name!r}", f"name {' and '.join(parts)} one by one with {what}")
        raise self._lacks(f"column {name!r}", f"name the right one with {what}")

    def check(self, wanted: Sequence[tuple[str, str]]) -> None:
        """Refuse at once all columns that are not there, where they are more than one.

        Args:
            wanted: columns, each with the argument by which a user could name another.

        Raises:
            InputError: several are missing; the error lists those that are there.
        """
        missing = [(n, what) for n, what in wanted if isinstance(n, str) and n not in self.columns]
        if len(missing) > 1:
            names = ", ".join(repr(n) for n, _ in missing)
            arguments = list(dict.fromkeys(what for _, what in missing))
            told = ", ".join(arguments[:-1]) + " and " * (len(arguments) > 1) + arguments[-1]
            raise self._lacks(f"columns {names}", f"name the right ones with {told}")

    def _lacks(self, what: str, then: str) -> InputError:
        longer = [key for key, values in self.columns.items() if len(values) > 1]
        there = longer or list(self.columns)  # settings of one value are not worth offering
        names = ", ".join(there[:20]) + (f" and {len(there) - 20} more" if len(there) > 20 else "")
        return InputError(f"{self.label} has no {what}; it has {names or 'none'}: {then}.")


def distinct(names: Sequence[str], label: str) -> Sequence[str]:
    """The names, if no two are equal.

    Raises:
        InputError: two are.
    """
    twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
    if twice is not None:
        raise InputError(
            f"{label} has more than one column {twice!r}, so that it is open which is meant; "
            "rename or remove one."
        )
    return names


def unreadable(path: Path, what: str, error: Exception) -> InputError:
    """The error for a file that is not what its ending says."""
    reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    return InputError(
        f"{path.name} cannot be read as {what} ({reason[:120]}); it may be damaged: export it again."
    )
