"""Opening of one or more logs as a Dataset."""

from __future__ import annotations

import glob
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import BAG_HINT, LogError, NoEpisodesError, UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.image_cache import Storage
from mcaprl.recorder.dataset.log_reader import LogReader, Selection
from mcaprl.recorder.dataset.manifest import is_manifest, listed_logs
from mcaprl.storage.remote import RemotePath, as_path, find_remote, is_url
from mcaprl.texts import counted

# Largest number of logs open at the same time; the system limits the open files of a process.
_MAX_OPEN = 64
Result = TypeVar("Result")
Episodes = int | slice | Sequence[int]


def open_logs(
    data: str | Path | Sequence[str | Path],
    *,
    columns: Sequence[str] | None = None,
    episodes: Episodes | None = None,
    images: Storage = "auto",
    threads: int = 1,
    weights: Sequence[float] | None = None,
) -> Dataset:
    """Read logs, or a selection of their columns and episodes.

    The CRCs of all chunks that are read are checked. If a log was cut off or is still being
    written, its finished episodes are read, with a warning. If there are several logs, logs without
    a finished episode are skipped, with a warning.

    Args:
        data: A file, a folder of `.mcap` files, its `manifest.json`, a glob, a URL, or a sequence
            of these. The logs must have the same spaces; their episodes are concatenated in the
            order of the files.
        columns: Keys to read from a Dict observation space, for example `joints/q` for a nested
            key. The dataset's observation space contains only these keys. An empty sequence reads
            no observations. Actions, rewards and end flags are always read. Default: all keys.
        episodes: Index, slice or indexes of the episodes to read, counted over all logs and
            returned in the logs' order. Default: all episodes.
        images: Storage of image observations: `memory`, `mapped` or `auto`. `mapped` leaves images
            on disk and reads them when they are indexed. For a compressed log, `mapped` needs an
            uncompressed copy of the images, which is written once, next to the log. `auto` is
            `mapped` if the images would take more than half of the free memory, else `memory`.
        threads: Number of threads that read chunks of a file.
        weights: Weight of each element of `data`; see `Dataset.weights`. Default: all are 1.

    Raises:
        LogError: A file is missing, not an MCAP file, damaged, or has no finished episode.
        SpaceError: The logs' spaces differ.
        UsageError: A column or an episode does not exist, a weight is negative or infinite, or a
            file has two weights.
    """
    if threads < 1:
        raise UsageError(f"threads is {threads}, expected 1 or more")
    chosen = None if columns is None else tuple(columns)
    selection = Selection(columns=chosen, images=images, threads=threads)
    found = weighted_logs(data, weights)
    # With `episodes`, each log is needed twice: for their number, and for those that are selected.
    log_at = lru_cache(0 if episodes is None else _MAX_OPEN)(
        partial(LogReader, selection=selection)
    )

    def read(path: Path, rows: NDArray[np.int64] | None = None) -> Dataset:
        part = log_at(path).read(rows)
        if columns is None and rows is None:
            part.origin = replace(part.origin, logs=((path.absolute(), found[path]),))
        part.weights[:] = found[path]
        return part

    if episodes is None:
        every = _call_each(list(found), read)
        return Dataset.concatenate([part for _, part in every])
    counts = _call_each(list(found), lambda path: len(log_at(path).lengths))
    numbers = episode_indexes(episodes, sum(count for _, count in counts))
    parts, first = [], 0
    for path, count in counts:
        mine = numbers[(first <= numbers) & (numbers < first + count)]
        if len(mine):
            parts.append(read(path, mine - first))
        first += count
    return Dataset.concatenate(parts)


def _call_each(
    paths: Sequence[Path], function: Callable[[Path], Result]
) -> list[tuple[Path, Result]]:
    """Call a function on each log. If there are several logs, skip those without finished episodes.

    Raises:
        NoEpisodesError: No log has a finished episode.
    """
    results = []
    for path in paths:
        try:
            results.append((path, function(path)))
        except NoEpisodesError as error:
            if len(paths) == 1:
                raise
            warnings.warn(f"{error}: skipped", stacklevel=4)
    if not results:
        raise NoEpisodesError(f"no finished episode in {counted(len(paths), 'log')}")
    return results


def episode_indexes(episodes: Episodes, count: int) -> NDArray[np.int64]:
    """Resolve a selection of episodes to sorted, unique indexes.

    Raises:
        UsageError: An index is out of range, or the selection is empty.
    """
    if isinstance(episodes, slice):
        selected = np.arange(count)[episodes]
    else:
        selected = np.atleast_1d(np.asarray(episodes, np.int64))
    outside = selected[(selected < -count) | (selected >= count)]
    if len(outside) or not len(selected):
        what = f"no episode {outside[0]}" if len(outside) else "no episodes are selected"
        raise UsageError(f"{what}: the logs have {counted(count, 'episode')}; indexes start at 0")
    # The first call of `np.unique` imports `numpy.ma`, which takes longer than reading an episode.
    return np.array(sorted(set((selected % count).tolist())), np.int64)


def find_logs(data: str | Path | Sequence[str | Path]) -> list[Path]:
    """Resolve `data` (see `open_logs`) to files, sorted within a folder or glob.

    Raises:
        LogError: There are no files.
    """
    return list(weighted_logs(data))


def weighted_logs(
    data: str | Path | Sequence[str | Path], weights: Sequence[float] | None = None
) -> dict[Path, float]:
    """Resolve `data` and its weights (see `open_logs`) to files with their weights.

    Raises:
        LogError: There are no files.
        UsageError: A weight is negative or infinite, or a file has two weights.
    """
    names = [data] if isinstance(data, str | Path) else list(data)
    if not names:
        raise LogError("no data: the list of files is empty")
    # A file that is listed under several paths is read once.
    found: dict[str, tuple[Path, float]] = {}
    for name, weight in zip(names, path_weights(weights, len(names)), strict=True):
        for path in _logs_of(name):
            key = str(path) if isinstance(path, RemotePath) else os.path.realpath(path)
            _, earlier = found.setdefault(key, (path, weight))
            if earlier != weight:
                raise UsageError(
                    f"{key} is named twice, with weights {earlier:g} and {weight:g}; name it once"
                )
    return dict(found.values())


def path_weights(weights: Sequence[float] | None, count: int) -> list[float]:
    """Return a weight for each of `count` paths; by default, all are 1.

    Raises:
        UsageError: There is not one valid weight for each path.
    """
    given = [1.0] * count if weights is None else list(map(float, weights))
    if len(given) != count or not all(0 <= weight < np.inf for weight in given):
        raise UsageError(f"weights must be {count} numbers of at least 0, one for each path")
    return given


def _logs_of(name: str | Path) -> list[Path]:
    if is_manifest(name):
        return listed_logs(name)
    if is_url(name):
        return list(find_remote(str(name)))
    path = as_path(name)
    if path.is_dir():
        found = sorted(path.glob("*.mcap"))
        if not found:
            has_bags = any(each.suffix in (".db3", ".bag") for each in path.iterdir())
            hint = f"; {BAG_HINT}" if has_bags else ""
            raise LogError(f"{path} has no .mcap files{hint}")
        return found
    if path.exists():
        return [path]
    found = sorted(Path(match) for match in glob.glob(str(name)))
    if not found:
        raise LogError(f"{name}: no such file, folder or match")
    return found
