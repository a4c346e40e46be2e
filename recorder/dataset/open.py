"""Reading of one or more logs as a Dataset, also while another process is recording them.

`manifest.json` is a JSON object with `manifest_version` ("1") and `files`, a list of objects with
the `name`, `episodes`, `steps` and `size_bytes` of each log in its folder. A manifest is needed to
read a folder from a server that cannot list folders. It also shows whether a file is missing.
"""

from __future__ import annotations

import glob
import os
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import BAG_HINT, LogError, NoEpisodesError, NoStepsError, UsageError
from mcaprl.files import as_type, fresh_folder, parse_json, read_file, write_json
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.images import Storage
from mcaprl.recorder.dataset.log_reader import LogReader, Selection
from mcaprl.recorder.dataset.transitions import Origin
from mcaprl.storage.remote import RemotePath, as_path, find_remote, is_url
from mcaprl.texts import counted

MANIFEST_NAME = "manifest.json"
UNFINISHED_NAME = ".unfinished"
"""Hidden folder of the logs that are not complete yet."""
_VERSION = "1"


@dataclass(frozen=True)
class LogFile:
    """A log that a manifest lists.

    Attributes:
        name: Name of the file in the folder of the manifest.
        episodes: Number of episodes.
        steps: Number of transitions.
        size_bytes: Size of the file.
    """

    name: str
    episodes: int
    steps: int
    size_bytes: int


@dataclass(frozen=True)
class _Manifest:
    """What is read of a manifest."""

    files: list[LogFile]


def unfinished_folder(folder: Path) -> Path:
    """Create a hidden folder for the unfinished logs of a folder, and return its path."""
    return fresh_folder(folder / UNFINISHED_NAME)


def write_manifest(folder: Path, files: Sequence[LogFile]) -> Path:
    """Write the manifest of a folder, and return its path."""
    path = folder / MANIFEST_NAME
    content = {"manifest_version": _VERSION, "files": [asdict(file) for file in files]}
    write_json(path, content, LogError)
    return path


def is_manifest(name: str | Path) -> bool:
    """Return whether a path or URL has the name of a manifest."""
    return str(name).partition("?")[0].rpartition("/")[2] == MANIFEST_NAME


def listed_logs(name: str | Path) -> list[Path]:
    """Return the logs that a manifest lists, from its path or URL."""
    try:
        files = as_type(_Manifest, parse_json(read_file(as_path(name, whole=True)))).files
        for file in files:
            _check_name(file.name)
    except OSError as error:
        raise LogError(f"cannot read {name}: {error.strerror or error}") from error
    except ValueError as error:
        raise LogError(f"{name} is not a manifest of logs: {error}") from error
    if not files:
        raise LogError(f"{name} lists no files")
    return [_found(name, file) for file in files]


def _check_name(name: str) -> None:
    # The manifest may come from an untrusted source, so it must not name files outside its folder.
    if name != PurePosixPath(name).name or not name.endswith(".mcap") or "\\" in name:
        raise ValueError(f"{name!r} is not the name of a log in its folder")


def _found(manifest: str | Path, file: LogFile) -> Path:
    path: Path
    if is_url(manifest):
        remote = RemotePath.of(f"{str(manifest).partition('?')[0].rpartition('/')[0]}/{file.name}")
        assert remote.remote is not None
        path, size = remote, remote.remote.size
    else:
        path = Path(manifest).with_name(file.name)
        if not path.is_file():
            raise LogError(f"{manifest} lists {file.name}, which is missing")
        size = path.stat().st_size
    if size != file.size_bytes:
        raise LogError(
            f"{path} has {size} bytes, but {manifest} lists {file.size_bytes}: it was changed, or"
            " its copy is not complete; to read it nevertheless, open the folder"
        )
    return path


# Largest number of logs open at the same time; the system limits the open files of a process.
_MAX_OPEN = 64
_POLL_S = 0.2
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
    """Read logs, or a selection of their columns and episodes; see `mcaprl.open`."""
    if threads < 1:
        raise UsageError(f"threads is {threads}, expected 1 or more")
    chosen = None if columns is None else tuple(columns)
    selection = Selection(columns=chosen, images=images, threads=threads)
    found = weighted_logs(data, weights)
    # With `episodes`, each log is needed twice: for their number, and for those that are selected.
    log_at = lru_cache(0 if episodes is None else _MAX_OPEN)(
        partial(LogReader, selection=selection)
    )
    wanted = dict.fromkeys(found) if episodes is None else _selected(found, log_at, episodes)

    def read(path: Path) -> Dataset:
        rows = wanted[path]
        part = log_at(path).read(rows)
        if columns is None and rows is None:
            part.origin = replace(part.origin, logs=((path.absolute(), found[path]),))
        part.weights[:] = found[path]
        return part

    return Dataset.concatenate([part for _, part in _call_each(list(wanted), read)])


def _selected(
    paths: Iterable[Path], log_at: Callable[[Path], LogReader], episodes: Episodes
) -> dict[Path, NDArray[np.int64] | None]:
    """Return the indexes of the selected episodes in each log that has some."""
    counts = dict(_call_each(list(paths), lambda path: len(log_at(path).lengths)))
    numbers = episode_indexes(episodes, sum(counts.values()))
    selected: dict[Path, NDArray[np.int64] | None] = {}
    first = 0
    for path, count in counts.items():
        mine = numbers[(first <= numbers) & (numbers < first + count)]
        if len(mine):
            selected[path] = mine - first
        first += count
    return selected


def _call_each(
    paths: Sequence[Path], function: Callable[[Path], Result]
) -> list[tuple[Path, Result]]:
    """Call a function on each log; of several logs, skip those without finished episodes."""
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
    """Resolve a selection of episodes to sorted, unique indexes."""
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
    """Resolve `data` (see `open_logs`) to files, sorted within a folder or glob."""
    return list(weighted_logs(data))


def weighted_logs(
    data: str | Path | Sequence[str | Path], weights: Sequence[float] | None = None
) -> dict[Path, float]:
    """Resolve `data` and its weights (see `open_logs`) to files with their weights."""
    names = [data] if isinstance(data, str | Path) else list(data)
    weights = [1.0] * len(names) if weights is None else weights
    if not names:
        raise LogError("no data: the list of files is empty")
    # A file that is listed under several paths is read once.
    found: dict[str, tuple[Path, float]] = {}
    for name, weight in zip(names, weights, strict=True):
        for path in _logs_of(name):
            key = str(path) if isinstance(path, RemotePath) else os.path.realpath(path)
            _, earlier = found.setdefault(key, (path, weight))
            if earlier != weight:
                raise UsageError(
                    f"{key} is named twice, with weights {earlier:g} and {weight:g}; name it once"
                )
    return dict(found.values())


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


class GrowingLogs:
    """Reader of growing logs; each episode is read once, when it is finished.

    Attributes:
        dataset: Episodes read so far, in the order of reading; their numbers do not change.
    """

    def __init__(
        self,
        data: str | Path | Sequence[str | Path],
        *,
        patience_s: float = 60.0,
        images: Storage = "auto",
        threads: int = 1,
    ) -> None:
        """Wait for the first finished episode, and read all finished ones; see `open_logs`."""
        self._data = [data] if isinstance(data, str | Path) else list(data)
        self._read = partial(open_logs, images=images, threads=threads)
        self._counts: dict[Path, int] = {}
        # End of the last episode that was read, nanoseconds.
        self._ends_ns: dict[Path, int] = {}
        self._states: dict[Path, tuple[int, int, int]] = {}
        give_up_s = time.monotonic() + patience_s
        while True:
            parts = self._read_more()
            if parts:
                self.dataset = self._joined(parts)
                return
            if time.monotonic() > give_up_s:
                names = ", ".join(map(str, self._data))
                raise LogError(f"no episode was finished in {names} for {patience_s:.0f} s")
            time.sleep(_POLL_S)

    def grow(self) -> Dataset:
        """Return `dataset` after reading the episodes that ended since the last call."""
        parts = self._read_more()
        if parts:
            self.dataset = self._joined([self.dataset, *parts])
        return self.dataset

    def _joined(self, parts: list[Dataset]) -> Dataset:
        joined = Dataset.concatenate(parts)
        joined.origin = Origin(tuple(dict.fromkeys(joined.sources)), grow=self.grow)
        return joined

    def _read_more(self) -> list[Dataset]:
        try:
            paths = find_logs(self._data)
        except LogError:
            return []
        parts = []
        for path in paths:
            # Inode, size and mtime change when a log grows or is compacted.
            facts = path.stat()
            state = facts.st_ino, facts.st_size, facts.st_mtime_ns
            if state == self._states.get(path):
                continue
            self._states[path] = state
            part = self._read_from(path)
            if part is not None:
                self._counts[path] = self._counts.get(path, 0) + len(part.episodes)
                self._ends_ns[path] = part.episodes[-1].summary.end_time_ns
                parts.append(part)
        return parts

    def _read_from(self, path: Path) -> Dataset | None:
        """Read the new episodes of a log; return None if there are none."""
        first = self._counts.get(path, 0)
        with warnings.catch_warnings():
            # The warning that a log is still being written is expected here.
            warnings.simplefilter("ignore", UserWarning)
            try:
                whole = open_logs(path, columns=[]).episodes
                if first and (
                    len(whole) < first
                    or whole[first - 1].summary.end_time_ns != self._ends_ns[path]
                ):
                    raise LogError(
                        f"{path} was replaced by another log during the training: train again"
                    )
                return self._read(path, episodes=slice(first, None)) if len(whole) > first else None
            except NoStepsError:
                return None
