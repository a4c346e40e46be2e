"""Logs that grow while one learns from them, because another process still records."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, NoStepsError
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.open import find_logs, open_logs

CHECK_INTERVAL = 500
"""Updates between two looks at the logs; a larger data set has to be packed anew."""
_POLL_S = 0.2


class GrowingLogs:
    """Reads each finished episode once, and none before it is finished.

    Attributes:
        dataset: all that was read so far, in the order of reading; a logged episode that is here
            keeps its number.
    """

    def __init__(self, data: Sequence[str | Path], *, patience_s: float = 60.0) -> None:
        """Wait for the first finished episode, and read what there is.

        Args:
            data: files, folders or globs; files that join them later are read, too.
            patience_s: how long to wait.

        Raises:
            LogError: no episode was finished in that time, or a log is damaged.
        """
        self._data = data
        self._counts: dict[Path, int] = {}
        self._states: dict[Path, tuple[int, int, int]] = {}
        give_up_s = time.monotonic() + patience_s
        while True:
            parts = self._read_more()
            if parts:
                self.dataset = Dataset.concatenate(parts)
                return
            if time.monotonic() > give_up_s:
                names = ", ".join(map(str, data))
                raise LogError(f"no episode was finished in {names} for {patience_s:.0f} s")
            time.sleep(_POLL_S)

    def grow(self) -> bool:
        """Read the episodes that were finished since the last call; whether there were any."""
        parts = self._read_more()
        if parts:
            self.dataset = Dataset.concatenate([self.dataset, *parts])
        return bool(parts)

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
            part = _read_from(path, self._counts.get(path, 0))
            if part is not None:
                self._counts[path] = self._counts.get(path, 0) + len(part.episodes)
                parts.append(part)
        return parts


def _state_of(path: Path) -> tuple[int, int, int]:
    """Return what changes when a log grows, or when its writer replaces it by a compacted file."""
    found = path.stat()
    return found.st_ino, found.st_size, found.st_mtime_ns


def with_more_data(learner: Learner, dataset: Dataset, never_drawn: NDArray[np.int64]) -> Learner:
    """The same learner at the same step, on a data set that has grown.

    Args:
        learner: that goes on.
        dataset: what it learned from, with more episodes behind.
        never_drawn: numbers of the episodes that are held out.
    """
    weights = np.ones(len(dataset.episodes))
    weights[never_drawn] = 0.0
    buffer = TransitionBuffer.from_dataset(
        dataset, learner.config.packing, encoder=learner.buffer.encoder, weights=weights
    ).to(learner.buffer.device)
    grown = type(learner)(learner.config, buffer, learner.seeds)
    for seed in learner.seeds:
        grown.load_state(seed, learner.state(seed), learner.step)
    return grown


def _read_from(path: Path, first: int) -> Dataset | None:
    """The episodes of a log from a number on; None if there are none."""
    with warnings.catch_warnings():
        # That a log is still being written is no news here.
        warnings.simplefilter("ignore", UserWarning)
        try:
            whole = open_logs(path, columns=[])
            if len(whole.episodes) <= first:
                return None
            return open_logs(path, episodes=slice(first, None))
        except NoStepsError:
            return None
