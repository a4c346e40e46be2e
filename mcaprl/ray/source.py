"""Logs as a source of Ray Data: each task reads whole episodes, and only the needed columns.

Ray divides blocks, and thus episodes, in two cases: a source has fewer tasks than Ray requests, or
a block is larger than Ray's maximum. Therefore, each task reads one block of at most the maximum
size, and `ray.read` requests exactly as many tasks as the source has.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from numpy.typing import NDArray
from ray.data.block import BlockMetadata
from ray.data.datasource import Datasource, ReadTask

from mcaprl.errors import NoEpisodesError, SpaceError, UnknownNameError
from mcaprl.ray.blocks import block_of, columns_of, empty_columns, keys_of, row_bytes
from mcaprl.ray.tasks import check_machine
from mcaprl.recorder.dataset.log_reader import LogReader, Selection
from mcaprl.recorder.dataset.open import Episodes, episode_indexes
from mcaprl.recorder.dataset.tables import described
from mcaprl.recorder.format.metadata import LogMetadata, installed_versions
from mcaprl.texts import counted

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
    """Source of the transitions of logs.

    Attributes:
        description: Metadata that the logs have in common.
        groups: Groups of episodes; each becomes one block.
    """

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
        """Read the summaries of the logs, but no transitions.

        There are at least `blocks` blocks, by default as many as the size of the data asks for, but
        at least `least`. Only a block of a single episode may have more than `most_bytes`. The
        other arguments, and the errors, are those of `mcaprl.ray.read`.
        """
        super().__init__()
        # The constructor of the base class does not set this attribute.
        self._projection_map = None if columns is None else {name: name for name in columns}
        self._paths = list(paths)
        self._lengths: list[NDArray[np.int64]] = []
        self.description = self._read_summaries()
        known = empty_columns(self.description)
        for name in columns or ():
            if name not in known:
                raise UnknownNameError("column", name, known)
        count = sum(map(len, self._lengths))
        self._chosen = None if episodes is None else episode_indexes(episodes, count)
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
            list(columns),
            keys_of(self.description, list(columns)),
            metadata,
            installed_versions(),
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

    def _chosen_episodes(
        self,
    ) -> Iterator[tuple[Path, int, NDArray[np.int64], NDArray[np.int64]]]:
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
