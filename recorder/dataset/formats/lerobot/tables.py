"""Writing of the Parquet and JSON files of LeRobot datasets, version 3.0."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mcaprl.errors import import_extra
from mcaprl.recorder.dataset.formats.lerobot.features import DATA_PATH, Feature

MAX_FILE_BYTES = 100 << 20
CHUNK_FILES = 1000
"""Number of files in a folder."""


class ParquetFiles:
    """Writer of the data files, with one row group for each episode."""

    def __init__(self, path: Path, every: list[Feature]) -> None:
        """Create a writer; the first episode creates a file."""
        self._path = path
        self._stored = [feature for feature in every if feature.dtype != "video"]
        self._number, self._file = -1, Path()
        self._writer: Any = None

    def add_episode(self, columns: dict[str, Any]) -> dict[str, int]:
        """Write the columns of an episode, and return the indexes of its folder and its file."""
        arrow = import_extra("pyarrow", "tables")
        table = arrow.table(columns)
        if self._writer is None or self._file.stat().st_size + table.nbytes > MAX_FILE_BYTES:
            self._next_file(table.schema)
        self._writer.write_table(table, row_group_size=len(table))
        return {
            "data/chunk_index": self._number // CHUNK_FILES,
            "data/file_index": self._number % CHUNK_FILES,
        }

    def close(self) -> None:
        """Finish the last file."""
        if self._writer is not None:
            self._writer.close()

    def _next_file(self, schema: Any) -> None:
        self.close()
        self._number += 1
        chunk, number = divmod(self._number, CHUNK_FILES)
        self._file = self._path / DATA_PATH.format(chunk_index=chunk, file_index=number)
        self._file.parent.mkdir(parents=True, exist_ok=True)
        parquet = import_extra("pyarrow.parquet", "tables")
        described = {f.name: _hugging_face(f) for f in self._stored}
        text = json.dumps({"info": {"features": described}})
        self._writer = parquet.ParquetWriter(
            self._file,
            schema.with_metadata({b"huggingface": text.encode()}),
            compression="snappy",
            write_page_checksum=True,
            use_dictionary=[f.name for f in self._stored if not f.is_image],
        )


def write_tasks(path: Path, tasks: Mapping[str, int]) -> None:
    """Write the table of tasks; `tasks` contains the index of each task by its text."""
    arrow = import_extra("pyarrow", "tables")
    table = arrow.table({"task_index": list(tasks.values()), "task": list(tasks)})
    # LeRobot reads this table with pandas, and needs the task texts as the index of the DataFrame.
    metadata = {b"pandas": json.dumps(_TASKS_IN_PANDAS).encode()}
    parquet = import_extra("pyarrow.parquet", "tables")
    parquet.write_table(table.replace_schema_metadata(metadata), path)


def _hugging_face(feature: Feature) -> dict[str, Any]:
    """Return the description of a column for the library `datasets`."""
    if feature.dtype == "image":
        return {"_type": "Image"}
    value = {"dtype": feature.dtype, "_type": "Value"}
    if feature.shape == (1,):
        return value
    if len(feature.shape) == 1:
        return {"feature": value, "length": feature.shape[0], "_type": "List"}
    kind = f"Array{len(feature.shape)}D"
    return {"shape": list(feature.shape), "dtype": feature.dtype, "_type": kind}


def write_table(columns: dict[str, Any], path: Path) -> None:
    """Write Arrow arrays by name as a Parquet file."""
    arrow, parquet = import_extra("pyarrow", "tables"), import_extra("pyarrow.parquet", "tables")
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(arrow.table(columns), path, write_page_checksum=True)


def write_json(path: Path, value: Any) -> None:
    """Write JSON; non-finite numbers become `NaN` and `Infinity`, which Python can read."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{json.dumps(value, indent=4)}\n")


def _pandas_column(name: str | None, field: str | None, kind: str, dtype: str) -> dict[str, Any]:
    return {
        "name": name,
        "field_name": field,
        "pandas_type": kind,
        "numpy_type": dtype,
        "metadata": {"encoding": "UTF-8"} if name is None else None,
    }


_TASKS_IN_PANDAS = {
    "index_columns": ["task"],
    "column_indexes": [_pandas_column(None, None, "unicode", "object")],
    "columns": [
        _pandas_column("task_index", "task_index", "int64", "int64"),
        _pandas_column("task", "task", "unicode", "object"),
    ],
    "pandas_version": "2.2.0",
}
