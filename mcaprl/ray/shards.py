"""Log that a worker records. If the worker is killed, another worker continues the log.

The log is moved to its final path when it is complete.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from mcaprl.errors import LogError, NoStepsError
from mcaprl.files import fresh_folder, locked_file
from mcaprl.recorder.dataset.log_reader import LogReader
from mcaprl.recorder.format.episode_summary import INTERRUPTED
from mcaprl.recorder.repair.recover import recover_log
from mcaprl.sims.evaluation.rollout import EpisodeResult

_UNFINISHED = ".unfinished"


class Shard:
    """A log in a folder. Until the log is complete, its content is stored in a hidden folder.

    Attributes:
        path: Path of the complete log.
        unfinished: Path of the log while it is recorded.
    """

    def __init__(self, path: Path) -> None:
        """Create the description of a shard; read and write no files."""
        self.path = path
        self.unfinished = path.parent / _UNFINISHED / path.name

    @property
    def is_complete(self) -> bool:
        """Whether the log is complete."""
        return self.path.exists()

    def resume(self) -> list[EpisodeResult]:
        """Repair the log of a killed worker, so that it can be continued; return its episodes.

        Raises:
            LogError: A worker is still recording the log, or the log cannot be written.
        """
        if not self.unfinished.exists():
            return []
        repaired = self.unfinished.with_suffix(".repaired")
        with locked_file(self.unfinished):
            pass
        try:
            recover_log(self.unfinished, repaired, overwrite=True)
            kept = episodes_of(repaired)
        except LogError:
            # The file has no finished episode.
            kept = []
        # A worker that was stopped instead of killed has closed the log with an interrupted
        # episode. Such a log is recorded again from its beginning.
        if kept and kept[-1].reason != INTERRUPTED:
            os.replace(repaired, self.unfinished)
            return kept
        repaired.unlink(missing_ok=True)
        self.unfinished.unlink()
        return []

    def publish(self) -> None:
        """Move the complete log to its path."""
        with self.unfinished.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(self.unfinished, self.path)


def unfinished_folder(folder: Path) -> Path:
    """Create a hidden folder for the unfinished logs of a recording, and return its path.

    Raises:
        OutputExistsError: Another program's folder, a file or a link is at this path.
    """
    return fresh_folder(folder / _UNFINISHED)


def episodes_of(path: Path) -> list[EpisodeResult]:
    """Return the result of each episode of a log, without positions.

    Raises:
        LogError: The log is damaged.
    """
    try:
        summaries = LogReader(path).episode_summaries()
    except NoStepsError:
        return []
    nowhere = np.empty((0, 2))
    return [
        EpisodeResult(one.seed or 0, one.total_reward, one.length, one.reason, nowhere)
        for one in summaries
    ]
