"""Reading of logs that another process is still recording."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from mcaprl.errors import LogError, NoStepsError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.image_cache import Storage
from mcaprl.recorder.dataset.open import find_logs, open_logs
from mcaprl.recorder.dataset.origin import Origin

_POLL_S = 0.2


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
        """Wait for the first finished episode, and read all finished ones.

        Args:
            data: Files, folders or globs; files that appear later are read as well.
            patience_s: Maximum time to wait in seconds.
            images: Storage of images; see `open_logs`.
            threads: Number of threads that read chunks of a file.

        Raises:
            LogError: No episode was finished within `patience_s`, or a log is damaged.
        """
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
            state = _state_of(path)
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
        """Read the new episodes of a log; return None if there are none.

        Raises:
            LogError: The log is damaged, or does not contain the episodes that were read before.
        """
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


def _state_of(path: Path) -> tuple[int, int, int]:
    """Return inode, size and mtime, which change when a log grows or is compacted."""
    found = path.stat()
    return found.st_ino, found.st_size, found.st_mtime_ns
