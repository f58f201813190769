"""What a Parquet file says of its columns, before pyarrow unpacks them.

pyarrow tells it too, but ends the interpreter where the description is damaged.

Source:
    Apache Parquet, File format and parquet.thrift; Apache Thrift, Compact protocol.
"""

import os
from pathlib import Path
from typing import Any, NamedTuple

DEEPEST_STRUCTURE = 30
"""Structures of the description within one another."""

_BYTE_ARRAY, _FIXED_LENGTH = 6, 7  # physical types
_TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = 1, 2, 3, 7, 8, 9, 10, 11, 12


class ParquetColumn(NamedTuple):
    """A column of one group of rows.

    Attributes:
        name: with those of the structures around it, joined by points.
        size: when unpacked, words counted once [bytes].
        is_text: whether its values have lengths of their own.
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
    """Structures in the compact protocol: a dictionary for each, by the numbers of the fields."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, count: int) -> bytes:
        """The next bytes."""
        self.at += count
        if self.at > len(self.data):
            raise ValueError("its description is incomplete")
        return self.data[self.at - count : self.at]

    def natural(self) -> int:
        """A number in groups of seven bits."""
        value = 0
        for shift in range(0, 70, 7):
            byte = self.take(1)[0]
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise ValueError("a number of its description is too long")

    def whole(self) -> int:
        """A number that may be negative."""
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
        """A value of a type; of truths in a list, one byte each."""
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
