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
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError, import_extra
from mcaprl.files import parse_json
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats.budget import Budget
from mcaprl.recorder.dataset.formats.columns import check_duration, check_times
from mcaprl.recorder.dataset.formats.infos import info_type, masked
from mcaprl.recorder.dataset.formats.parquet_files import read_table
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
from mcaprl.recorder.dataset.values import behavior_of, exactly
from mcaprl.recorder.format.behavior import FIELDS, PROBABILITY, behavior_field
from mcaprl.recorder.format.infos import Masked
from mcaprl.recorder.format.messages import EpisodeSummary, summary_of
from mcaprl.recorder.format.metadata import METADATA_NAME, LogMetadata
from mcaprl.recorder.format.spaces import Leaf, action_leaf, leaves_of

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
        """Return the info (N, *shape) in the column `<prefix>.<name>`.

        Raises:
            LogError: There is no such column, or the metadata of its field is damaged.
        """
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
