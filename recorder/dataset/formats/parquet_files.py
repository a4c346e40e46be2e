"""Reading of Parquet files whose sizes are checked first."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcaprl.errors import LogError, import_extra
from mcaprl.recorder.dataset.formats.budget import Budget
from mcaprl.texts import printable

_BYTES = {"BOOLEAN": 1, "INT32": 4, "INT64": 8, "FLOAT": 4, "DOUBLE": 8, "INT96": 8}
"""Bytes of a value in memory, by Parquet's type; texts and others also have their bytes."""


def read_table(
    path: Path, wanted: Callable[[str], bool] = lambda _: True, *, budget: Budget | None = None
) -> Any:
    """Read the columns of a Parquet file as a PyArrow table, and check the CRCs of its pages.

    Args:
        path: File.
        wanted: Whether a column is read, by its name.
        budget: Limit of the memory; default: a limit of this file.

    Raises:
        LogError: The file is missing or damaged, or its columns are too large.
        MissingExtraError: PyArrow is not installed.
    """
    arrow, parquet = import_extra("pyarrow", "tables"), import_extra("pyarrow.parquet", "tables")
    budget = budget or Budget.of_files(path, [path])
    try:
        with parquet.ParquetFile(path, page_checksum_verification=True) as file:
            names = [name for name in file.schema_arrow.names if wanted(name)]
            _check_sizes(file.metadata, set(names), budget)
            return file.read(names)
    # Names that are not UTF-8 raise a ValueError. Many PyArrow errors are also ValueErrors.
    except (OSError, ValueError, MemoryError, OverflowError, arrow.ArrowException) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise LogError(f"{path} cannot be read: {printable(reason)}") from error


def _check_sizes(metadata: Any, names: set[str], budget: Budget) -> None:
    """Subtract the columns from the budget.

    Raises:
        LogError: The columns are too large.
        ValueError: A size is negative.
    """
    for group in range(metadata.num_row_groups):
        rows = metadata.row_group(group)
        if rows.num_rows < 0:
            raise ValueError(f"row group {group} has {rows.num_rows} rows")
        for number in range(rows.num_columns):
            column = rows.column(number)
            # A name may contain dots, and the path of a list continues after the name.
            words = column.path_in_schema.split(".")
            path, count = column.path_in_schema, column.num_values
            if not names.intersection(itertools.accumulate(words, lambda *two: ".".join(two))):
                continue
            if count < 0 or column.total_uncompressed_size < 0:
                raise ValueError(f"column {path} has a negative size")
            budget.take(path, (count,), _BYTES.get(column.physical_type, 4))
            if column.physical_type not in _BYTES:
                budget.take(path, (column.total_uncompressed_size,), 1)
