"""Arrays in the Arrow and Parquet files of Minari datasets, one folder for each episode."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, import_extra
from mcaprl.files import parse_json
from mcaprl.recorder.dataset.formats import parquet


def read_table(folder: Path, form: str) -> Any:
    """Read the PyArrow table of an episode."""
    pyarrow = import_extra("pyarrow", "interop")
    files = sorted(folder.glob(f"*.{form}"), key=_number)
    if not files:
        raise LogError(f"{folder} has no .{form} file")
    try:
        return pyarrow.concat_tables([_read_file(file, form) for file in files]).combine_chunks()
    except (pyarrow.ArrowException, OSError) as error:
        raise LogError(f"{folder} cannot be read: {error}") from error


def array_at(table: Any, path: tuple[str | int, ...], shape: tuple[int, ...] | None) -> Any:
    """Return a column, or a nested field of a column, as an array.

    Returns:
        An array, or a list of bytes for images that are stored as JPEG.
    """
    pyarrow = import_extra("pyarrow", "interop")
    name, *keys = path
    try:
        column = _whole(table[name])
        for key in keys:
            column = column.field(str(key))
    except (KeyError, pyarrow.ArrowException, AttributeError) as error:
        raise LogError(f"an episode has no column {'/'.join(map(str, path))}") from error
    if pyarrow.types.is_binary(column.type):
        return column.to_pylist()
    values = _values(column)
    if values is None:
        raise LogError(
            f"column {'/'.join(map(str, path))} has type {column.type}, expected numbers or"
            " fixed-size lists without nulls"
        )
    fits = shape is not None and values.size == len(values) * math.prod(shape)
    return values.reshape(len(values), *(shape or ())) if fits else values


def infos_of(table: Any) -> dict[str, NDArray[Any]]:
    """Return an episode's infos by dotted name; infos of unsupported types become empty arrays."""
    if "infos" not in table.column_names:
        return {}
    return dict(_infos_below(_whole(table["infos"]), ()))


def attributes_of(folder: Path) -> dict[str, Any]:
    """Return the metadata of an episode: `seed`, `options` and others."""
    try:
        found = parse_json((folder / "metadata.json").read_bytes())
    except (OSError, ValueError) as error:
        raise LogError(f"{folder}/metadata.json cannot be read: {error}") from error
    return found if isinstance(found, dict) else {}


def _infos_below(struct: Any, path: tuple[str, ...]) -> Iterator[tuple[str, NDArray[Any]]]:
    pyarrow = import_extra("pyarrow", "interop")
    for index, field in enumerate(struct.type):
        column, name = struct.field(index), (*path, field.name)
        if pyarrow.types.is_struct(field.type):
            yield from _infos_below(column, name)
            continue
        values = _values(column)
        if values is None:
            # The column contains text, or lists of equal lengths.
            values = _plain_array(column.to_pylist())
        shape = (field.metadata or {}).get(b"shape")
        if shape is not None:
            rest = [int(size) for size in shape.decode().split(",") if size]
            values = values.reshape(len(values), *rest)
        yield ".".join(name), values


def _plain_array(values: list[Any]) -> NDArray[Any]:
    """Convert lists or strings to an array, which is empty if their lengths or types differ."""
    if any(value is None for value in values):
        return np.empty(0)
    try:
        array = np.asarray(values)
    except ValueError:
        return np.empty(0)
    return array if array.dtype.kind in "biufU" else np.empty(0)


def _values(column: Any) -> NDArray[Any] | None:
    """Return numbers as an array (N,) or (N, size); None for other types and missing values."""
    pyarrow = import_extra("pyarrow", "interop")
    kind = column.type
    if column.null_count:
        return None
    if pyarrow.types.is_fixed_size_list(kind):
        flat = _values(column.flatten())
        return None if flat is None else flat.reshape(len(column), kind.list_size)
    if pyarrow.types.is_boolean(kind) or pyarrow.types.is_primitive(kind):
        values = column.to_numpy(zero_copy_only=False)
        return np.asarray(values) if values.dtype.kind in "biuf" else None
    return None


def _whole(column: Any) -> Any:
    """Combine the chunks of a column into one array."""
    pyarrow = import_extra("pyarrow", "interop")
    if column.num_chunks == 1:
        return column.chunk(0)
    return pyarrow.concat_arrays(column.chunks)


def _read_file(file: Path, form: str) -> Any:
    if form == "parquet":
        return parquet.read_table(file)
    ipc = import_extra("pyarrow.ipc", "interop")
    with ipc.open_file(str(file)) as opened:
        return opened.read_all()


def _number(file: Path) -> tuple[int, str]:
    """Return the sort key of a file: its number, for names such as `part-0`, `part-1`, ..."""
    digits = file.stem.rpartition("-")[2]
    return (int(digits) if digits.isdecimal() else 0, file.name)
