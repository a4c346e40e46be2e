"""Opens logs as one Dataset: files -> whole episodes of each -> transitions."""

from __future__ import annotations

import glob
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, NoEpisodesError, UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.image_cache import Storage
from mcaprl.recorder.dataset.log_reader import LogReader, Selection

Answer = TypeVar("Answer")
Episodes = int | slice | Sequence[int]


def open_logs(
    data: str | Path | Sequence[str | Path],
    *,
    columns: Sequence[str] | None = None,
    episodes: Episodes | None = None,
    images: Storage = "auto",
    threads: int = 1,
) -> Dataset:
    """Read logs, or a part of them; what is not asked for is not read.

    All chunks read are checked against their CRCs. A log that was cut off, or is still being
    written, gives its finished episodes and a warning; one of several that has none yet is left
    out, with a warning.

    Args:
        data: a file, a folder of `.mcap` files, a glob, or a sequence of these. Logs of one call
            must have the same spaces; their episodes follow each other in the order of the files.
        columns: keys of a Dict observation space, nested ones as `joints/q`; the dataset's
            observation space has just these then. None of them (`[]`) reads no observations.
            Actions, rewards and ends are always read. Default: all.
        episodes: a number, a slice or several numbers, counted over all logs; they come in the
            order of the logs. Default: all.
        images: where image observations are kept: in `memory`; `mapped`, which leaves them on disk
            and reads those that are asked for (in the log itself if it is not compressed, else in a
            copy beside it that is made once); or `auto`: mapped if they would take more than half
            of the memory that is free.
        threads: that read chunks of a file at a time.

    Raises:
        LogError: a file is missing, no MCAP, damaged, or has no finished episode.
        SpaceError: the logs' spaces differ.
        UsageError: there is no such column or episode.
    """
    if threads < 1:
        raise UsageError(f"threads {threads}: give 1 or more")
    chosen = None if columns is None else tuple(columns)
    selection = Selection(columns=chosen, images=images, threads=threads)
    logs = [LogReader(path, selection) for path in find_logs(data)]
    if episodes is None:
        return Dataset.concatenate([part for _, part in _ask(logs, LogReader.read)])
    return _read_episodes(logs, episodes)


def _ask(
    logs: Sequence[LogReader], ask: Callable[[LogReader], Answer]
) -> list[tuple[LogReader, Answer]]:
    """What each log answers, but for those of several that have no finished episode yet.

    Raises:
        NoEpisodesError: none has one.
    """
    answers = []
    for log in logs:
        try:
            answers.append((log, ask(log)))
        except NoEpisodesError as error:
            if len(logs) == 1:
                raise
            warnings.warn(f"{error}: left out", stacklevel=4)
    if not answers:
        raise NoEpisodesError(f"none of {len(logs)} logs has a finished episode")
    return answers


def _read_episodes(logs: Sequence[LogReader], episodes: Episodes) -> Dataset:
    counted = _ask(logs, lambda log: len(log.lengths))
    numbers = _numbers(episodes, sum(count for _, count in counted))
    parts, first = [], 0
    for log, count in counted:
        mine = numbers[(first <= numbers) & (numbers < first + count)]
        if len(mine):
            parts.append(log.read(mine - first))
        first += count
    return Dataset.concatenate(parts)


def _numbers(episodes: Episodes, count: int) -> NDArray[np.int64]:
    """The numbers that are meant, each once, in order.

    Raises:
        UsageError: one is not there, or none is meant.
    """
    if isinstance(episodes, slice):
        asked = np.arange(count)[episodes]
    else:
        asked = np.atleast_1d(np.asarray(episodes, np.int64))
    outside = asked[(asked < -count) | (asked >= count)]
    if len(outside) or not len(asked):
        what = f"no episode {outside[0]}" if len(outside) else "no episodes are asked for"
        raise UsageError(f"{what}: the logs have {count}, counted from 0")
    return np.unique(asked % count)


def find_logs(data: str | Path | Sequence[str | Path]) -> list[Path]:
    """The files that `data` means: see `open_logs`; sorted within a folder or glob.

    Raises:
        LogError: there are none.
    """
    if not isinstance(data, str | Path):
        every = [path for part in data for path in find_logs(part)]
        if not every:
            raise LogError("no data: the list of files is empty")
        # A file that is meant twice counts once.
        return list({path.resolve(): path for path in every}.values())
    path = Path(data)
    if path.is_dir():
        found = sorted(path.glob("*.mcap"))
        if not found:
            raise LogError(f"{path} has no .mcap files")
        return found
    if path.exists():
        return [path]
    found = sorted(Path(name) for name in glob.glob(str(data)))
    if not found:
        raise LogError(f"{data}: no such file, folder or match")
    return found
