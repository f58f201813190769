"""A table: named columns of whatever length and type, nothing interpreted yet."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
    """

    label: str
    columns: Mapping[str, np.ndarray]
    where: str = "row"
    first: int = 1

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
        longer = [key for key, values in self.columns.items() if len(values) > 1]
        there = longer or list(self.columns)  # settings of one value are not worth offering
        names = ", ".join(there[:20]) + (f" and {len(there) - 20} more" if len(there) > 20 else "")
        raise InputError(
            f"{self.label} has no column {name!r}; it has {names or 'none'}: name the right one with {what}."
        )


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
