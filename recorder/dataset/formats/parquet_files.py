"""Reading of Parquet files whose sizes are checked first."""

from __future__ import annotations

import itertools
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from mcaprl.errors import LogError, import_extra
from mcaprl.recorder.dataset.formats.budget import Budget
from mcaprl.texts import printable

_BYTES = {0: 1, 1: 4, 2: 8, 3: 8, 4: 4, 5: 8}
"""Bytes of a value in memory, by the number of Parquet's type (boolean, int32, int64, int96, float,
double); texts and others also have their bytes."""
_END = struct.Struct("<I4s")
"""Length of the footer, and magic bytes."""
# Numbers of the fields in parquet.thrift: of the file, of a row group, of a column chunk, and of
# the metadata of a column.
_GROUPS, _COLUMNS, _ROWS, _METADATA = 4, 1, 3, 3
_TYPE, _PATH, _VALUES, _SIZE = 1, 3, 5, 6
_MAX_DEPTH = 20


def read_table(
    path: Path, wanted: Callable[[str], bool] = lambda _: True, *, budget: Budget | None = None
) -> Any:
    """Read the columns of a Parquet file as a PyArrow table, and check the CRCs of its pages."""
    arrow, parquet = import_extra("pyarrow", "tables"), import_extra("pyarrow.parquet", "tables")
    budget = budget or Budget.of_files(path, [path])
    try:
        with parquet.ParquetFile(path, page_checksum_verification=True) as file:
            names = [name for name in file.schema_arrow.names if wanted(name)]
            _check_sizes(path, set(names), budget)
            return file.read(names)
    # Names that are not UTF-8 raise a ValueError. Many PyArrow errors are also ValueErrors.
    except (OSError, ValueError, MemoryError, OverflowError, arrow.ArrowException) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise LogError(f"{path} cannot be read: {printable(reason)}") from error


def _check_sizes(path: Path, names: set[str], budget: Budget) -> None:
    """Subtract the columns from the budget.

    PyArrow ends the process if it is asked for a column's sizes and the column's statistics are
    damaged; its reader then raises an error. So this function reads the sizes from the footer.
    """
    for rows, chunks in _row_groups(path):
        if rows < 0:
            raise ValueError(f"a row group has {rows} rows")
        for words, kind, count, stored_bytes in chunks:
            # A name may contain dots, and the path of a list continues after the name.
            name = ".".join(words)
            if not names.intersection(itertools.accumulate(words, lambda *two: ".".join(two))):
                continue
            if count < 0 or stored_bytes < 0:
                raise ValueError(f"column {name} has a negative size")
            budget.take(name, (count,), _BYTES.get(kind, 4))
            if kind not in _BYTES:
                budget.take(name, (stored_bytes,), 1)


class _Chunk(NamedTuple):
    """A column in a row group: words of its path, number of its type, values, and unpacked size."""

    words: list[str]
    kind: int
    values: int
    stored_bytes: int


def _row_groups(path: Path) -> list[tuple[int, list[_Chunk]]]:
    """Return the number of rows and the columns of each row group, from the footer of a file."""
    with path.open("rb") as file:
        file.seek(-_END.size, os.SEEK_END)
        length, magic = _END.unpack(file.read(_END.size))
        if magic != b"PAR1" or length > file.tell() - _END.size:
            raise ValueError("it has no footer of Parquet")
        file.seek(-_END.size - length, os.SEEK_END)
        footer = file.read(length)
    try:
        groups = _Thrift(footer).struct()[_GROUPS]
        return [
            (int(group[_ROWS]), [_chunk(each[_METADATA]) for each in group[_COLUMNS]])
            for group in groups
        ]
    except (LookupError, TypeError, AttributeError, struct.error) as error:
        raise ValueError("its footer is damaged") from error


def _chunk(found: dict[int, Any]) -> _Chunk:
    words = [word.decode() for word in found[_PATH]]
    return _Chunk(words, int(found[_TYPE]), int(found[_VALUES]), int(found[_SIZE]))


class _Thrift:
    """Reader of Thrift's compact protocol, in which the footers of Parquet files are written."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def struct(self, depth: int = 0) -> dict[int, Any]:
        """Return the fields of a struct by their numbers."""
        found: dict[int, Any] = {}
        number = 0
        while head := self._byte():
            number = number + (head >> 4) if head >> 4 else self._integer()
            kind = head & 15
            found[number] = kind == 1 if kind in (1, 2) else self._value(kind, depth + 1)
        return found

    def _value(self, kind: int, depth: int) -> Any:
        if depth > _MAX_DEPTH:
            raise ValueError("its footer has too many levels")
        match kind:
            case 1 | 2 | 3:
                return self._byte()
            case 4 | 5 | 6:
                return self._integer()
            case 7:
                return struct.unpack("<d", self._bytes(8))[0]
            case 8:
                return self._bytes(self._varint())
            case 9 | 10:
                head = self._byte()
                count = self._varint() if head >> 4 == 15 else head >> 4
                # Each value has a byte or more.
                if count > len(self._data):
                    raise ValueError("its footer is damaged")
                return [self._value(head & 15, depth + 1) for _ in range(count)]
            case 12:
                return self.struct(depth)
            case _:
                raise ValueError("its footer is damaged")

    def _integer(self) -> int:
        value = self._varint()
        return value >> 1 ^ -(value & 1)

    def _varint(self) -> int:
        value = 0
        for shift in range(0, 64, 7):
            byte = self._byte()
            value |= (byte & 127) << shift
            if byte < 128:
                return value
        raise ValueError("its footer is damaged")

    def _byte(self) -> int:
        self._at += 1
        return self._data[self._at - 1]

    def _bytes(self, count: int) -> bytes:
        found = self._data[self._at : self._at + count]
        if len(found) < count:
            raise ValueError("its footer is damaged")
        self._at += count
        return found
