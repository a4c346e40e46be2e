"""Logs as sources and targets of Ray Data, and their transitions as Arrow blocks.

A block has one row for each transition, with the columns of `Dataset.to_arrow`: `episode`, `step`,
`log_time_ns`, `reward`, `terminated`, `truncated`, `behavior_prob` (`behavior_log_prob` for actions
of floats), `action`, `observation` and `next_observation`, or `observation_<key>` for the parts of
a Dict. Vectors and images are tensors.

Ray divides blocks, and thus episodes, in two cases: a source has fewer tasks than Ray requests, or
a block is larger than Ray's maximum. Therefore, each task reads one block of at most the maximum
size, and `ray.read` requests exactly as many tasks as the source has.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from numpy.typing import NDArray
from ray.data import Datasink
from ray.data.block import BlockAccessor, BlockMetadata
from ray.data.datasource import Datasource, ReadTask
from ray.data.extensions import ArrowTensorArray

from mcaprl.errors import (
    NoEpisodesError,
    OutputExistsError,
    SpaceError,
    UnknownNameError,
    UsageError,
)
from mcaprl.files import parse_json, temporary_folder
from mcaprl.ray.tasks import check_machine
from mcaprl.recorder.dataset.arrays import behavior_of, columns_of_arrays
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.log_reader import LogReader, Selection
from mcaprl.recorder.dataset.open import (
    MANIFEST_NAME,
    Episodes,
    LogFile,
    episode_indexes,
    unfinished_folder,
    write_manifest,
)
from mcaprl.recorder.dataset.tables import described, observation_names, step_columns
from mcaprl.recorder.dataset.transitions import Transitions
from mcaprl.recorder.format.behavior import FIELDS, behavior_field
from mcaprl.recorder.format.metadata import METADATA_NAME, NO_TIMES, LogMetadata, installed_versions
from mcaprl.recorder.format.spaces import Leaf, action_leaf, leaves_of, nest
from mcaprl.storage.remote import check_upload, is_url, upload
from mcaprl.texts import counted

Columns = dict[str, NDArray[Any]]
_SCALARS = {
    "episode": np.int64,
    "step": np.int64,
    "log_time_ns": np.int64,
    "reward": np.float64,
    "terminated": np.bool_,
    "truncated": np.bool_,
}
_OPTIONAL = ("log_time_ns", *(field.name for field in FIELDS))
_NOT_WHOLE = (
    "{}: episode {} is not whole in its block, or two episodes have this number; bring the rows of"
    ' an episode together with rows.repartition(N, keys=["episode"])'
)


def empty_columns(description: LogMetadata) -> Columns:
    """Return all columns of a block without rows, to know their dtypes and shapes."""
    action = action_leaf(description.action_space)
    behavior = {behavior_field(description.action_space).name: np.float32}
    scalars = {**_SCALARS, **behavior}
    columns: Columns = {name: np.empty(0, dtype) for name, dtype in scalars.items()}
    columns["action"] = np.empty((0, *action.shape), action.dtype)
    for name, leaf in _leaves(description):
        for column in (name, f"next_{name}"):
            columns[column] = np.empty((0, *leaf.shape), leaf.dtype)
    return columns


def row_bytes(columns: Columns) -> int:
    """Return the size of a row with these columns."""
    return sum(int(np.prod(one.shape[1:])) * one.dtype.itemsize for one in columns.values())


def block_of(columns: Columns, metadata: dict[str, str]) -> pyarrow.Table:
    """Return a block whose schema has this metadata."""
    arrays = [_array(values) for values in columns.values()]
    fields = [pyarrow.field(name, array.type) for name, array in zip(columns, arrays, strict=True)]
    schema = pyarrow.schema(fields, metadata=metadata)
    return pyarrow.Table.from_arrays(arrays, schema=schema)


def columns_of(data: Dataset, episodes: NDArray[np.int64], names: Sequence[str]) -> Columns:
    """Return columns of a dataset; `episodes` (E,) are the numbers in the column `episode`."""
    columns = data._transitions
    found = step_columns(columns, data._description) | {"action": columns.actions}
    found["episode"] = np.repeat(episodes, columns.lengths)
    frames = columns.frame_of_step()
    leaves = leaves_of(data.observation_space)
    for name, leaf in zip(observation_names(leaves), columns.frames, strict=True):
        for column, offset in ((name, 0), (f"next_{name}", 1)):
            if column in names:
                found[column] = np.asarray(leaf[frames + offset])
    return {name: found[name] for name in names}


def keys_of(description: LogMetadata, names: Sequence[str]) -> tuple[str, ...] | None:
    """Return the keys of the observations in the columns `names`; None for all observations."""
    wanted = {name.removeprefix("next_") for name in names}
    leaves = _leaves(description)
    if all(name in wanted for name, _ in leaves):
        return None
    return tuple("/".join(leaf.path) for name, leaf in leaves if name in wanted)


def dataset_of(columns: Columns, description: LogMetadata, where: str) -> Dataset:
    """Return the episodes of a block, sorted by number and step."""
    missing = empty_columns(description).keys() - columns.keys() - {*_OPTIONAL}
    if missing:
        raise SpaceError(f"{where}: the rows have no column {', '.join(sorted(missing))}")
    order = np.lexsort((columns["step"], columns["episode"]))
    columns = {name: values[order] for name, values in columns.items()}
    lengths = _lengths(columns, where)
    leaves = leaves_of(description.observation_space)
    names = observation_names(leaves)
    transitions: Transitions = columns_of_arrays(
        description,
        nest(leaves, [columns[name] for name in names]),
        nest(leaves, [columns[f"next_{name}"] for name in names]),
        {
            "actions": columns["action"],
            "rewards": columns["reward"],
            "terminated": columns["terminated"],
            "truncated": columns["truncated"],
            "behavior": behavior_of(
                behavior_field(description.action_space),
                *(columns.get(field.name) for field in FIELDS),
                place=f"{where}: ",
                is_table=True,
            ),
        },
    )
    if not np.array_equal(transitions.lengths, lengths):
        raise SpaceError(
            f"{where}: a next observation differs from the observation of the next step, so a log"
            " cannot hold both: change both columns in the same way"
        )
    return Dataset(transitions, dataclasses.replace(description, times=NO_TIMES))


def _lengths(columns: Columns, where: str) -> NDArray[np.int64]:
    """Return the length of each episode of sorted columns; check that the episodes are whole."""
    lengths = np.unique(columns["episode"], return_counts=True)[1]
    lasts = np.cumsum(lengths) - 1
    steps = np.arange(len(columns["step"])) - np.repeat(lasts + 1 - lengths, lengths)
    ends = columns["terminated"] | columns["truncated"]
    expected = np.zeros(len(ends), bool)
    expected[lasts] = True
    wrong = np.flatnonzero((steps != columns["step"]) | (ends != expected))
    if len(wrong):
        raise SpaceError(_NOT_WHOLE.format(where, columns["episode"][wrong[0]]))
    return lengths.astype(np.int64)


def _leaves(description: LogMetadata) -> list[tuple[str, Leaf]]:
    leaves = leaves_of(description.observation_space)
    return list(zip(observation_names(leaves), leaves, strict=True))


def _array(values: NDArray[Any]) -> Any:
    if values.ndim == 1:
        return pyarrow.array(values)
    return ArrowTensorArray.from_numpy(np.ascontiguousarray(values))


class LogSink(Datasink[LogFile | None]):  # type: ignore[misc]
    """Sink that writes one log for each write task to a folder or URL."""

    def __init__(
        self, folder: str | Path, description: LogMetadata | None, compression: str
    ) -> None:
        """Create the folder. The arguments are those of `ray.write`."""
        self._url = str(folder).rstrip("/") if is_url(folder) else None
        self._description, self._compression = description, compression
        self._versions = installed_versions()
        if self._url is not None:
            check_upload(self._url, overwrite=True)
            return
        self._folder = Path(folder).absolute()
        if self._folder.is_file() or (self._folder.is_dir() and any(self._folder.glob("*.mcap"))):
            raise OutputExistsError(f"{folder} exists: choose the name of a new folder")
        self._hidden = unfinished_folder(self._folder)

    @property
    def manifest(self) -> Path | str:
        """Path or URL of the manifest."""
        if self._url is not None:
            return f"{self._url}/{MANIFEST_NAME}"
        return self._folder / MANIFEST_NAME

    def write(self, blocks: Iterable[Any], ctx: Any) -> LogFile | None:
        """Write the blocks of one task as a log; return None if there are no rows."""
        tables = [BlockAccessor.for_block(block).to_arrow() for block in blocks]
        tables = [table for table in tables if len(table)]
        if not tables:
            return None
        name = f"shard-{ctx.task_idx:05d}.mcap"
        data = dataset_of(_joined(tables), self._describe(tables[0]), name)
        if self._url is None:
            check_machine(self._versions, [self._hidden])
            return self._save(data, self._hidden / name)
        with temporary_folder() as folder:
            found = self._save(data, folder / name)
            upload(folder / name, f"{self._url}/{name}")
        return found

    def on_write_complete(self, write_result: Any) -> None:
        """Move the logs from the hidden folder to the target (no URL), and write the manifest."""
        files = sorted(filter(None, write_result.write_returns), key=lambda file: file.name)
        if self._url is not None:
            with temporary_folder() as folder:
                path = write_manifest(folder, files)
                upload(path, f"{self._url}/{path.name}")
            return
        for file in files:
            os.replace(self._hidden / file.name, self._folder / file.name)
        shutil.rmtree(self._hidden)
        write_manifest(self._folder, files)

    def on_write_failed(self, error: Exception) -> None:
        """Remove the unfinished logs."""
        if self._url is None:
            shutil.rmtree(self._hidden, ignore_errors=True)

    def _save(self, data: Any, path: Path) -> LogFile:
        # A repeated task replaces the log of the killed task.
        data.save(path, compression=self._compression, overwrite=True)
        return LogFile(path.name, len(data.episode_lengths), len(data), path.stat().st_size)

    def _describe(self, table: pyarrow.Table) -> LogMetadata:
        if self._description is not None:
            return self._description
        found = (table.schema.metadata or {}).get(METADATA_NAME.encode())
        if found is None:
            raise UsageError(
                "the rows have no metadata of their spaces: pass like=, the logs or the"
                " mcaprl.Dataset of the same environment"
            )
        return LogMetadata.from_strings(parse_json(found))


def _joined(tables: list[pyarrow.Table]) -> Columns:
    parts = [BlockAccessor.for_block(table).to_numpy(table.column_names) for table in tables]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


# Preferred minimum size of a block, because smaller blocks take more time in total. Blocks are
# smaller only if there would otherwise be too few of them.
_LEAST_BYTES = 16 << 20


@dataclass(frozen=True)
class _Group:
    """Episodes of one log that become one block; `rows` is their number of transitions."""

    path: Path
    # (E,) increasing indexes in the log, whose first episode has the index `first` over all logs.
    episodes: NDArray[np.int64]
    first: int
    rows: int


@dataclass(frozen=True)
class _Wanted:
    """Columns that every task reads, and metadata for their blocks."""

    names: list[str]
    keys: tuple[str, ...] | None
    metadata: dict[str, str]
    versions: dict[str, str]


class LogSource(Datasource):  # type: ignore[misc]
    """Source of the transitions of logs."""

    def __init__(
        self,
        paths: Sequence[Path],
        columns: Sequence[str] | None = None,
        episodes: Episodes | None = None,
        *,
        blocks: int | None = None,
        least: int = 1,
        most_bytes: int = 128 << 20,
    ) -> None:
        """Read the summaries of the logs, but no transitions."""
        # By default, there are as many blocks as the size asks for, but at least `least`. Only a
        # block of a single episode may have more than `most_bytes`. The rest is as of
        # `mcaprl.ray.read`.
        super().__init__()
        # The constructor of the base class does not set this attribute.
        self._projection_map = None if columns is None else {name: name for name in columns}
        self._paths = list(paths)
        self._lengths: list[NDArray[np.int64]] = []
        self.description = self._read_summaries()  # Metadata that the logs have in common
        known = empty_columns(self.description)
        for name in columns or ():
            if name not in known:
                raise UnknownNameError("column", name, known)
        count = sum(map(len, self._lengths))
        self._chosen = None if episodes is None else episode_indexes(episodes, count)
        # Groups of episodes; each becomes one block.
        self.groups = list(self._divided(blocks, least, most_bytes))

    def _read_summaries(self) -> LogMetadata:
        descriptions = []
        for path in self._paths:
            log = LogReader(path)
            try:
                self._lengths.append(log.lengths)
            except NoEpisodesError as error:
                if len(self._paths) == 1:
                    raise
                warnings.warn(f"{error}: skipped", stacklevel=4)
                self._lengths.append(np.empty(0, np.int64))
                continue
            descriptions.append(log.description)
            for role in ("observation_space", "action_space"):
                spaces = [getattr(descriptions[k], role) for k in (0, -1)]
                if spaces[0] != spaces[1]:
                    raise SpaceError(f"{path} differs in {role}: {spaces[1]}, not {spaces[0]}")
        if not descriptions:
            raise NoEpisodesError(f"no finished episode in {counted(len(self._paths), 'log')}")
        return LogMetadata.common(descriptions)

    def get_name(self) -> str:
        """Return the name of the read tasks."""
        return "McapLogs"

    def supports_projection_pushdown(self) -> bool:
        """Return True: the source reads only the columns that later steps need."""
        return True

    def estimate_inmemory_data_size(self) -> int:
        """Return the size of all blocks in bytes, computed from the summaries."""
        return row_bytes(self._columns()) * sum(group.rows for group in self.groups)

    def get_read_tasks(
        self, parallelism: int, per_task_row_limit: int | None = None, data_context: Any = None
    ) -> list[ReadTask]:
        """Return one task for each group of episodes. The number that Ray requests is ignored."""
        columns, metadata = self._columns(), described(self.description)
        schema = block_of(columns, metadata).schema
        wanted = _Wanted(
            list(columns), keys_of(self.description, list(columns)), metadata, installed_versions()
        )
        tasks = []
        for group in self.groups:
            facts = BlockMetadata(
                num_rows=group.rows,
                size_bytes=row_bytes(columns) * group.rows,
                input_files=[str(group.path)],
                exec_stats=None,
            )
            read = partial(_read, group, wanted)
            tasks.append(ReadTask(read, facts, schema, per_task_row_limit))
        return tasks

    def _columns(self) -> dict[str, NDArray[Any]]:
        """Return the wanted columns without rows."""
        every = empty_columns(self.description)
        names = self._get_data_columns()
        # A block without columns would have no rows, so read at least one column.
        return {name: every[name] for name in (every if names is None else names or ["episode"])}

    def _divided(self, blocks: int | None, least: int, most_bytes: int) -> Iterator[_Group]:
        """Yield groups of episodes with about equal numbers of rows."""
        chosen = list(self._chosen_episodes())
        rows = sum(int(lengths.sum()) for _, _, _, lengths in chosen)
        size = row_bytes(self._columns())
        if blocks is None:
            blocks = max(least, rows * size // _LEAST_BYTES)
        most = max(min(-(-rows // blocks), most_bytes // size), 1)
        for path, first, episodes, lengths in chosen:
            ends = np.cumsum(lengths)
            start = 0
            while start < len(ends):
                begin = int(ends[start] - lengths[start])
                stop = max(int(np.searchsorted(ends, begin + most, side="right")), start + 1)
                yield _Group(path, episodes[start:stop], first, int(ends[stop - 1]) - begin)
                start = stop

    def _chosen_episodes(self) -> Iterator[tuple[Path, int, NDArray[np.int64], NDArray[np.int64]]]:
        """Yield each log, the index of its first episode, and its chosen indexes and lengths."""
        first = 0
        for path, lengths in zip(self._paths, self._lengths, strict=True):
            mine = np.arange(len(lengths))
            if self._chosen is not None:
                low, high = np.searchsorted(self._chosen, [first, first + len(lengths)])
                mine = self._chosen[low:high] - first
            yield path, first, mine, lengths[mine]
            first += len(lengths)


def _read(group: _Group, wanted: _Wanted) -> Iterator[pyarrow.Table]:
    check_machine(wanted.versions, [group.path])
    facts = os.stat(group.path)
    log = _reader(group.path, facts.st_size, facts.st_mtime_ns, wanted.keys)
    data = log.read(group.episodes)
    columns = columns_of(data, group.first + group.episodes, wanted.names)
    yield block_of(columns, wanted.metadata)


@lru_cache(maxsize=2)
def _reader(path: Path, size: int, mtime_ns: int, keys: tuple[str, ...] | None) -> LogReader:
    """Open a log. If the file has not changed since an earlier task, return that task's reader."""
    return LogReader(path, Selection(columns=keys))
