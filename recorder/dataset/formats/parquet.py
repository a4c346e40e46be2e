"""Parquet files: a folder with a table of transitions and a table of episodes.

`transitions.parquet` has a row for each transition: `episode`, `step`, `log_time_ns`, `reward`,
`terminated`, `truncated`, `behavior_prob`, `action`, `observation` and `next_observation`. For
actions of floats, `behavior_log_prob` replaces `behavior_prob`. The parts of a Dict observation are
`observation_<key>` and `next_observation_<key>`. A tensor is a fixed-size list in C order; the
field's metadata has its shape. The metadata of the schema has the spaces, as `tables.described`
writes them.

`episodes.parquet` has a row for each episode: the fields of `EpisodeSummary`, `final_log_time_ns`
and the last observation, `final_observation`. The columns of next observations are for
other tools; `read` ignores them.

The columns `info.<name>` contain the infos of each step, and `reset_info.<name>` the infos of each
reset; an array is a list. A null means that the environment returned no info.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError, import_extra
from mcaprl.files import parse_json
from mcaprl.recorder.dataset.arrays import behavior_of, exactly
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats.columns import (
    Budget,
    check_duration,
    check_times,
    info_type,
    masked,
)
from mcaprl.recorder.dataset.tables import (
    episode_table,
    field_of,
    fixed_lists,
    info_columns,
    info_problem,
    observation_names,
    transition_table,
)
from mcaprl.recorder.dataset.transitions import Transitions
from mcaprl.recorder.format.behavior import FIELDS, PROBABILITY, behavior_field
from mcaprl.recorder.format.infos import Masked
from mcaprl.recorder.format.messages import EpisodeSummary, summary_of
from mcaprl.recorder.format.metadata import METADATA_NAME, LogMetadata
from mcaprl.recorder.format.spaces import Leaf, action_leaf, leaves_of
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


TRANSITIONS, EPISODES = "transitions.parquet", "episodes.parquet"
_BLOCK_BYTES = 64 << 20
_FLAG, _TIME = np.dtype(np.bool_), np.dtype(np.int64)


def matches(path: Path) -> bool:
    """Return whether a folder has both tables."""
    return (path / TRANSITIONS).is_file() and (path / EPISODES).is_file()


def write(
    dataset: Dataset, path: Path, *, lossy: bool = False, next_observations: bool = True
) -> list[str]:
    """Write a dataset to an empty folder.

    Returns:
        One sentence for each info that was left out.
    """
    arrow, parquet = _pyarrow()
    leaves = leaves_of(dataset.observation_space)
    columns, lost = _without_some_infos(dataset._transitions)
    if lost and not lossy:
        raise SpaceError(f"{lost[0]}; pass `lossy=True` to leave it out")
    metadata = LogMetadata.from_strings(dataset.metadata)
    unwanted = [] if next_observations else [f"next_{name}" for name in observation_names(leaves)]
    writer = None
    try:
        for first, block in _blocks(columns):
            table = transition_table(block, leaves, metadata, tensors="lists")
            numbers = arrow.array(np.asarray(table["episode"]) + first)
            table = table.set_column(0, table.field(0), numbers).drop_columns(unwanted)
            if writer is None:
                target = path / TRANSITIONS
                writer = parquet.ParquetWriter(target, table.schema, **_settings(arrow, table))
            row_bytes = max(table.nbytes // len(table), 1)
            writer.write_table(table, max(_BLOCK_BYTES // row_bytes, 1))
    finally:
        if writer is not None:
            writer.close()
    episodes = _episodes_with_ends(arrow, columns, leaves)
    parquet.write_table(episodes, path / EPISODES, **_settings(arrow, episodes))
    return lost


def read(path: Path) -> Dataset:
    """Read a folder that `write` wrote. Whole episodes may have been removed from both tables."""
    steps, episodes = _Table(path / TRANSITIONS), _Table(path / EPISODES)
    metadata = steps.metadata()
    lengths = episodes.values("length", (), _TIME)
    if not len(lengths) or (lengths < 1).any():
        raise LogError(f"{path / EPISODES} has no episodes, or has an episode without transitions")
    if (lengths > len(steps)).any() or lengths.sum() != len(steps):
        raise LogError(f"{path}: {TRANSITIONS} and {EPISODES} contain different or reordered steps")
    check_duration(metadata, len(steps) + len(lengths), path)
    numbers = steps.values("episode", (), _TIME), steps.values("step", (), _TIME)
    first_steps = np.cumsum(lengths) - lengths
    expected = (
        np.repeat(episodes.values("episode", (), _TIME), lengths),
        np.arange(lengths.sum()) - np.repeat(first_steps, lengths),
    )
    if not all(map(np.array_equal, numbers, expected)):
        raise LogError(f"{path}: {TRANSITIONS} and {EPISODES} contain different or reordered steps")
    leaves, action = leaves_of(metadata.observation_space), action_leaf(metadata.action_space)
    columns = Transitions(
        frames=tuple(
            _with_finals(
                steps.values(name, leaf.shape, leaf.dtype),
                episodes.values(f"final_{name}", leaf.shape, leaf.dtype),
                lengths,
            )
            for name, leaf in zip(observation_names(leaves), leaves, strict=True)
        ),
        log_time_ns=_with_finals(
            steps.values("log_time_ns", (), _TIME),
            episodes.values("final_log_time_ns", (), _TIME),
            lengths,
        ),
        actions=steps.values("action", action.shape, action.dtype),
        rewards=steps.values("reward", (), np.dtype(np.float64)),
        terminated=steps.values("terminated", (), _FLAG),
        truncated=steps.values("truncated", (), _FLAG),
        behavior=_behavior(steps, metadata, path),
        episodes=episodes.summaries(),
        infos={
            name: _info(steps.info("info", name), episodes.info("reset_info", name), lengths)
            for name in steps.info_names()
        },
    )
    _check_ends(columns, path)
    return Dataset(columns, metadata)


def _behavior(steps: _Table, metadata: LogMetadata, path: Path) -> NDArray[np.float32]:
    field = behavior_field(metadata.action_space)
    # Earlier versions wrote the probabilities of all actions.
    stored = field if steps.has(field.name) else PROBABILITY
    values = steps.values(stored.name, (), np.dtype(np.float32))
    arrays = [values if one is stored else None for one in FIELDS]
    found = behavior_of(field, *arrays, place=f"{path / TRANSITIONS}: ", is_table=True)
    assert found is not None
    return found


class _Table:
    """A table that was read from a file, without the columns of next observations.

    Raises:
        LogError: The file is damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._budget = path, Budget.of_files(path, [path])
        self._table = read_table(path, lambda name: not name.startswith("next_"))

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self._table)

    def metadata(self) -> LogMetadata:
        """Return the log's metadata."""
        found = (self._table.schema.metadata or {}).get(METADATA_NAME.encode())
        if found is None:
            raise LogError(
                f"{self._path} has no metadata '{METADATA_NAME}', so its spaces are unknown; build"
                " the dataset with Dataset.from_arrays"
            )
        try:
            return LogMetadata.from_strings(parse_json(found))
        except (AttributeError, ValueError) as error:
            raise LogError(f"{self._path}: metadata '{METADATA_NAME}': {error}") from error

    def has(self, name: str) -> bool:
        """Return whether there is a column with this name."""
        return name in self._table.column_names

    def values(self, name: str, shape: Sequence[int], dtype: np.dtype[Any]) -> NDArray[Any]:
        """Return a column (N, *shape) in this dtype."""
        if name not in self._table.column_names:
            raise LogError(f"{self._path} has no column '{name}'")
        arrow, _ = _pyarrow()
        where, column = f"{self._path}: {name}", self._table[name]
        parts = [np.empty((0, *shape), dtype)]
        for chunk in column.chunks:
            flat = chunk.flatten() if _is_list(arrow, chunk.type) else chunk
            if not _is_number(arrow, flat.type):
                raise SpaceError(f"{where} is {column.type}, expected numbers")
            if chunk.null_count or flat.null_count:
                raise LogError(f"{where} has nulls")
            if len(flat) != len(chunk) * int(np.prod(shape)):
                raise SpaceError(f"{where} is {column.type}, expected rows of shape {shape}")
            found = flat.to_numpy(zero_copy_only=False).reshape(-1, *shape)
            parts.append(found if found.dtype == dtype else exactly(where, found, dtype))
        return np.concatenate(parts)

    def info_names(self) -> list[str]:
        """Return the names of the infos of the steps."""
        names = self._table.column_names
        return [name.removeprefix("info.") for name in names if name.startswith("info.")]

    def info(self, prefix: str, name: str) -> Masked:
        """Return the info (N, *shape) in the column `<prefix>.<name>`."""
        column = f"{prefix}.{name}"
        if column not in self._table.column_names:
            raise LogError(f"{self._path} has no column '{column}'")
        arrow, _ = _pyarrow()
        array, field = self._table[column].combine_chunks(), self._table.schema.field(column)
        is_missing = np.asarray(array.is_null())
        try:
            described = {key.decode(): value for key, value in field.metadata.items()}
            dtype = info_type(described["dtype"].decode())
            shape = [int(size) for size in parse_json(described["shape"])]
            found = array.flatten() if shape else array.drop_null()
            if found.null_count:
                raise ValueError("a list has nulls")
            if (
                len(found) != math.prod(shape) * int((~is_missing).sum())
                or min(shape, default=0) < 0
            ):
                raise ValueError(f"its rows do not have the shape {shape}")
            rows = found.to_numpy(zero_copy_only=False).reshape(-1, *shape)
            if dtype.kind == "U":
                longest = max(map(len, rows.flat), default=0)
                self._budget.take(column, (len(array), *shape), 4 * longest)
                rows = rows.astype(np.str_)
                dtype = rows.dtype
            self._budget.take(column, (len(array), *shape), dtype.itemsize)
            values = np.zeros((len(array), *shape), dtype)
            values[~is_missing] = rows
        except (AttributeError, KeyError, TypeError, ValueError, arrow.ArrowException) as error:
            raise LogError(f"{self._path}: {column} is damaged: {error}") from error
        return masked(values, is_missing)

    def summaries(self) -> tuple[EpisodeSummary, ...]:
        """Return the rows of the table of episodes."""
        missing = [n for n in EpisodeSummary._fields if n not in self._table.column_names]
        if missing:
            raise LogError(f"{self._path} has no column '{missing[0]}'")
        rows = self._table.select(list(EpisodeSummary._fields)).to_pylist()
        try:
            return tuple(summary_of({**row, "episode": k}) for k, row in enumerate(rows))
        except SpaceError as error:
            raise LogError(f"{self._path}: {error}") from error


def _check_ends(columns: Transitions, path: Path) -> None:
    """Check that flags and times do not contradict the lengths of the episodes."""
    lasts = columns.first_steps + columns.lengths - 1
    inner = np.ones(len(columns.rewards), np.bool_)
    inner[lasts] = False
    for name in ("terminated", "truncated"):
        wrong = getattr(columns, name) & inner
        if wrong.any():
            row = int(wrong.argmax())
            raise LogError(
                f"{path / TRANSITIONS}: {name} of row {row} is set, but its episode goes on"
            )
    for index, (first, length) in enumerate(
        zip(columns.first_frames.tolist(), columns.lengths.tolist(), strict=True)
    ):
        times = columns.log_time_ns[first : first + length + 1]
        check_times(f"{path}: log_time_ns of episode {index}", times)


def _pyarrow() -> tuple[Any, Any]:
    return import_extra("pyarrow", "tables"), import_extra("pyarrow.parquet", "tables")


def _without_some_infos(columns: Transitions) -> tuple[Transitions, list[str]]:
    """Leave out the infos that a table cannot store; return the columns and a reason per info."""
    problems = {name: info_problem(name, info) for name, info in columns.infos.items()}
    kept = {name: info for name, info in columns.infos.items() if not problems[name]}
    return dataclasses.replace(columns, infos=kept), list(filter(None, problems.values()))


def _is_list(arrow: Any, kind: Any) -> bool:
    types = arrow.types
    return bool(types.is_fixed_size_list(kind) or types.is_list(kind) or types.is_large_list(kind))


def _is_number(arrow: Any, kind: Any) -> bool:
    types = arrow.types
    return bool(types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind))


def _blocks(columns: Transitions) -> Iterator[tuple[int, Transitions]]:
    """Divide the columns into blocks of whole episodes, of about `_BLOCK_BYTES` each.

    For each block, yield the index of its first episode and its columns.
    """
    frame_bytes = sum(part.nbytes // len(part) for part in (*columns.frames, columns.actions))
    sizes = np.cumsum(columns.lengths * max(frame_bytes, 1)) // _BLOCK_BYTES
    firsts = np.flatnonzero(np.diff(sizes, prepend=-1)).tolist()
    for first, stop in zip(firsts, [*firsts[1:], len(sizes)], strict=True):
        yield first, columns.take(range(first, stop))


def _settings(arrow: Any, table: Any) -> dict[str, Any]:
    """Return the settings of the writer.

    Dictionary encoding is only used for columns of bytes, strings and episode indexes. Without
    dictionary encoding, Parquet stores each byte in four bytes. In other columns, dictionary
    encoding would give all NaN values the same bits, and would be slow for many distinct values.
    """
    small = []
    for field in table.schema:
        nested = _is_list(arrow, field.type)
        kind = field.type.value_type if nested else field.type
        if kind in (arrow.int8(), arrow.uint8(), arrow.string()) or field.name == "episode":
            small.append(f"{field.name}.list.element" if nested else field.name)
    return {"compression": "zstd", "use_dictionary": small, "write_page_checksum": True}


def _episodes_with_ends(arrow: Any, columns: Transitions, leaves: Sequence[Leaf]) -> Any:
    table = episode_table(columns)
    finals = columns.first_frames + columns.lengths
    parts = zip(observation_names(leaves), columns.frames, strict=True)
    for name, frames in [("log_time_ns", columns.log_time_ns), *parts]:
        array = fixed_lists(arrow, np.asarray(frames[finals]))
        field = field_of(arrow, f"final_{name}", array, frames.shape[1:])
        table = table.append_column(field, array)
    for field, array in info_columns(arrow, columns.infos, columns.first_frames, "reset_info"):
        table = table.append_column(field, array)
    return table


def _info(steps: Masked, resets: Masked, lengths: NDArray[np.int64]) -> Masked:
    """Return all rows (F, *shape) of an info.

    For each episode, the row of the reset is followed by the rows of the steps.
    """
    frames: Masked = np.ma.concatenate([steps, resets])  # type: ignore[no-untyped-call]
    firsts = np.cumsum(lengths + 1) - lengths - 1
    order = np.empty(len(frames), np.int64)
    is_step = np.ones(len(frames), bool)
    is_step[firsts] = False
    order[is_step], order[firsts] = np.arange(len(steps)), len(steps) + np.arange(len(resets))
    return frames[order]


def _with_finals(
    steps: NDArray[Any], finals: NDArray[Any], lengths: NDArray[np.int64]
) -> NDArray[Any]:
    """Return frames: for each episode, the rows of its steps and then its final row."""
    ends = np.cumsum(lengths) + np.arange(len(lengths))
    frames = np.empty((len(steps) + len(finals), *steps.shape[1:]), steps.dtype)
    is_step = np.ones(len(frames), bool)
    is_step[ends] = False
    frames[is_step], frames[ends] = steps, finals
    return frames
