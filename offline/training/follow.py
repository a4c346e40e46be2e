"""Training on logs that another process is still recording."""

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
"""Number of updates between two checks of the logs. After each check that finds new episodes, all
data are packed again."""
_POLL_S = 0.2


class GrowingLogs:
    """Reader of growing logs; each episode is read once, when it is finished.

    Attributes:
        dataset: Episodes read so far, in the order of reading; their numbers do not change.
    """

    def __init__(self, data: Sequence[str | Path], *, patience_s: float = 60.0) -> None:
        """Wait for the first finished episode, and read all finished ones.

        Args:
            data: Files, folders or globs; files that appear later are read as well.
            patience_s: Maximum time to wait in seconds.

        Raises:
            LogError: No episode was finished within `patience_s`, or a log is damaged.
        """
        self._data = data
        self._counts: dict[Path, int] = {}
        # End of the last episode that was read, nanoseconds.
        self._ends_ns: dict[Path, int] = {}
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
        """Read the episodes that ended since the last call; return whether there were any."""
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
                return open_logs(path, episodes=slice(first, None)) if len(whole) > first else None
            except NoStepsError:
                return None


def _state_of(path: Path) -> tuple[int, int, int]:
    """Return inode, size and mtime, which change when a log grows or is compacted."""
    found = path.stat()
    return found.st_ino, found.st_size, found.st_mtime_ns


def with_more_data(
    learner: Learner, dataset: Dataset, held_out_episodes: NDArray[np.int64]
) -> Learner:
    """Return a learner for the grown dataset, with the weights and state of `learner`.

    Args:
        learner: Learner to continue.
        dataset: Dataset of the learner, followed by new episodes.
        held_out_episodes: Numbers of the held-out episodes.
    """
    weights = np.ones(len(dataset.episodes))
    weights[held_out_episodes] = 0.0
    buffer = TransitionBuffer.from_dataset(
        dataset,
        learner.config.packing,
        encoder=learner.buffer.encoder,
        reward_scale=learner.buffer.reward_scale,
        weights=weights,
    ).to(learner.buffer.device)
    grown = type(learner)(learner.config, buffer, learner.seeds)
    for seed in learner.seeds:
        grown.load_state(seed, learner.state(seed), learner.step)
    return grown
