"""A log of numbered episodes, written by the recorders of single and vector environments.

Recorders that a program does not close finish their logs when Python exits.
"""

from __future__ import annotations

import atexit
import json
import os
import re
import time
import weakref
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mcaprl.errors import LogError, OutputExistsError, UsageError
from mcaprl.files import check_target, locked_file
from mcaprl.limits import MAX_TIME_NS
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.log_writer import LogWriter
from mcaprl.recorder.format.messages import EpisodeSummary
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.reading import McapReader, Topic
from mcaprl.recorder.format.schema import LOG_TOPIC, PHASE_TOPIC, STEP_TOPIC
from mcaprl.recorder.record.display import Display
from mcaprl.recorder.record.layout import LAYOUT_NAME, layout_bytes, layout_of
from mcaprl.texts import encodable

_END_OF_TIME_NS = 2**63
"""First time that an int64 in nanoseconds cannot represent, in the year 2262."""


@dataclass
class OpenEpisode:
    """An episode that is being recorded: its policy, `reset` arguments and number of steps."""

    policy: str
    epsilon: float
    seed: int | None = None
    options: dict[str, Any] | None = None
    steps: int = 0


class EpisodeLog:
    """A log of numbered episodes with increasing times."""

    def __init__(
        self,
        path: str | Path,
        description: LogMetadata,
        *,
        compression: str,
        overwrite: bool,
        append: bool,
        max_file_bytes: int | None,
        start_time_ns: int | None,
    ) -> None:
        """Create the file or open it to append. For the arguments, see `RecordMcap`."""
        self._description = description
        # Relative paths are resolved in this folder, even if the process later changes to another
        # folder.
        self._folder = os.getcwd()
        self.step_ns = description.step_duration_ns  # Simulated time between two observations
        if not isinstance(start_time_ns, int | np.integer | None):
            raise UsageError(f"start_time_ns is {start_time_ns}: it must be an integer")
        first_ns = time.time_ns() if start_time_ns is None else int(start_time_ns)
        if not (1 <= self.step_ns < _END_OF_TIME_NS and 0 <= first_ns < _END_OF_TIME_NS):
            raise UsageError(
                f"step of {self.step_ns} ns, start at {first_ns} ns: the step must be positive and"
                " the start between the years 1970 and 2262; set step_duration_s and start_time_ns"
            )
        if append and overwrite:
            raise UsageError("append and overwrite are mutually exclusive: pass only one")
        self._parts = None
        if max_file_bytes is not None:
            self._parts = _Parts(Path(path), max_file_bytes, overwrite=overwrite, append=append)
            path = self._parts.current
        # Writer of the file.
        self.log = LogWriter(
            path, description, compression=compression, overwrite=overwrite, append=append
        )
        try:
            if self._parts is not None:
                self._parts.remove_replaced()
            # Number of finished episodes, which is also the index of the next one.
            self.episodes = _episodes_in(self.log) if append else 0
            end_ns = self.log.mcap.end_time_ns
            if end_ns >= MAX_TIME_NS:
                raise LogError(f"{path} cannot be appended to: its last log_time is {end_ns} ns")
            if start_time_ns is not None and first_ns <= end_ns:
                raise UsageError(
                    f"{path} ends at {end_ns} ns: start_time_ns {first_ns} must be later"
                )
        except BaseException:
            self.log.mcap.abandon()
            raise
        self._has_layout = False
        # Index of the first episode in this file.
        self._first_in_file = 0
        follows = start_time_ns is None and end_ns >= 0
        # log_time of the next episode's first message.
        self.next_start_ns = max(first_ns, end_ns + self.step_ns) if follows else first_ns

    @property
    def closed(self) -> bool:
        """Whether the log is closed."""
        return self.log.mcap.closed

    @property
    def max_file_bytes(self) -> int | None:
        """Size at which the recording continues in another file; None if it is not divided."""
        return None if self._parts is None else self._parts.max_file_bytes

    def check_can_begin(self, seeds: Iterable[int | None]) -> None:
        """Check that episodes with these seeds can be recorded."""
        if self.closed:
            raise UsageError(f"{self.log.mcap.path} is closed; record to another file")
        for seed in seeds:
            if seed is not None and not 0 <= seed <= messages.MAX_SEED:
                raise UsageError(f"seed {seed}: a seed must be from 0 to 2**64 - 2")

    def begin(self, display: Display) -> None:
        """Begin the next episode, if necessary in a new file, and write its first messages."""
        mcap, start_ns, parts = self.log.mcap, self.next_start_ns, self._parts
        has_episodes = self.episodes > self._first_in_file
        if parts is not None and has_episodes and mcap.position >= parts.max_file_bytes:
            mcap.start_next(parts.next())
            display.resend_static()
            self._first_in_file = self.episodes
        display.begin(start_ns, self.step_ns)
        if not self._has_layout:
            topics, shown = (LOG_TOPIC, PHASE_TOPIC, *display.topics), display.shown
            layout = layout_of(self._description, topics, shown.telemetry_names, shown.follow_frame)
            mcap.add_attachment(LAYOUT_NAME, "application/json", layout_bytes(layout), start_ns)
            self._has_layout = True

    def close(self) -> None:
        """Finish the log, and remove the last numbered file if it contains no episode."""
        in_place = self._is_in_place()
        self.log.close()
        if not in_place:
            raise self._removed()
        if self.episodes == self._first_in_file > 0 and self._parts is not None:
            self.log.mcap.path.unlink()

    def summary(
        self,
        episode: OpenEpisode,
        *,
        total_reward: float,
        terminated: bool,
        truncated: bool,
        reason: str,
        after: EpisodeSummary | None = None,
    ) -> EpisodeSummary:
        """Return the summary of an episode that ends now, after `after` or the log's last."""
        number, start_ns = self.episodes, self.next_start_ns
        if after is not None:
            number, start_ns = after.episode + 1, after.end_time_ns + self.step_ns
        return EpisodeSummary(
            episode=number,
            length=episode.steps,
            total_reward=total_reward,
            terminated=terminated,
            truncated=truncated,
            start_time_ns=start_ns,
            end_time_ns=start_ns + episode.steps * self.step_ns,
            reason=reason,
            policy=episode.policy,
            epsilon=episode.epsilon,
            seed=episode.seed,
            options="" if episode.options is None else _json(episode.options),
        )

    def advance(self, last: EpisodeSummary) -> None:
        """Update the episode count and the next start time after `last` was written."""
        self.next_start_ns = last.end_time_ns + self.step_ns
        self.episodes = last.episode + 1
        if not self._is_in_place():
            self.log.close()
            raise self._removed()

    def _is_in_place(self) -> bool:
        # Joining strings takes half of the time of joining paths.
        return self.log.mcap.is_at(os.path.join(self._folder, self.log.mcap.path))

    def _removed(self) -> LogError:
        return LogError(f"{self.log.mcap.path} was removed or replaced while it was being recorded")


class _Parts:
    """The numbered files of a recording: `lane.mcap` becomes `lane-00000.mcap` and so on."""

    def __init__(self, family: Path, max_file_bytes: int, *, overwrite: bool, append: bool) -> None:
        if max_file_bytes < 1:
            raise UsageError(f"max_file_bytes is {max_file_bytes}, expected at least 1")
        self.max_file_bytes, self._family = max_file_bytes, family
        pattern = re.escape(family.stem) + r"-(\d{5})" + re.escape(family.suffix)
        old = [path for path in family.parent.glob("*") if re.fullmatch(pattern, path.name)]
        if old and not (overwrite or append):
            raise OutputExistsError(
                f"{min(old)} exists: choose another path, or pass `append=True` or `overwrite=True`"
            )
        for path in old if overwrite else ():
            check_target(path, overwrite=True)
        self._replaced = old if overwrite else []
        last = max((path.stem for path in old), default="0") if append else "0"
        self._number = int(last[-5:])

    @property
    def current(self) -> Path:
        """Path of the current file."""
        name = f"{self._family.stem}-{self._number:05d}{self._family.suffix}"
        return self._family.with_name(name)

    def next(self) -> Path:
        """Advance to the next file and return its path."""
        self._number += 1
        return self.current

    def remove_replaced(self) -> None:
        """Remove the old files of an overwritten recording, except the current file."""
        for path in self._replaced:
            if path != self.current:
                with locked_file(path):
                    path.unlink(missing_ok=True)


def _episodes_in(log: LogWriter) -> int:
    """Return the number of episodes in a log to append to."""
    path = log.mcap.path
    steps = Topic(McapReader(path), STEP_TOPIC)
    if not len(steps):
        return 0
    last = steps.read(("episode", "final"), np.array([np.argmax(steps.times)]))
    if not last["final"][0]:
        raise LogError(
            f"{path} cannot be appended to, since its last episode is not finished: run"
            f" `mcaprl recover {path} OUT` and append to OUT"
        )
    return int(last["episode"][0]) + 1


def reason_of(given: Any, terminated: bool) -> str:
    """Return why an episode ended: the environment's reason, `terminated` or `time_limit`."""
    if isinstance(given, str) and given:
        return encodable(given)
    return "terminated" if terminated else "time_limit"


def _json(options: dict[str, Any]) -> str:
    try:
        return json.dumps(options, default=_plain)
    except (TypeError, ValueError):
        return json.dumps(repr(options))


def _plain(value: Any) -> Any:
    """Convert NumPy numbers and arrays to Python objects, and any other object to its repr."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else repr(value)


_OPEN: weakref.WeakSet[FinishesAtExit] = weakref.WeakSet()


class FinishesAtExit(ABC):
    """Base class of recorders, whose log is finished when they are deleted or Python exits.

    A log that is not finished has no summary, so viewers cannot open it.
    """

    _process: int | None = None

    def _watch(self) -> None:
        """Finish the log at exit; call this at the end of the constructor."""
        self._process = os.getpid()
        _OPEN.add(self)

    @abstractmethod
    def _finish(self) -> None:
        """Finish the log, if this has not been done."""

    def _finish_own(self) -> None:
        """Finish the log, unless it belongs to the process from which this one was forked."""
        if self._process == os.getpid():
            self._finish()

    def __del__(self) -> None:
        """Finish the log, and call the environment's own `__del__`, if it has one."""
        if self._process is None:
            # The constructor raised an error, so the environment still belongs to the caller.
            return
        try:
            self._finish_own()
        finally:
            getattr(super(), "__del__", _nothing)()


def _nothing() -> None:
    """Do nothing."""


@atexit.register
def _finish_all() -> None:
    for recorder in list(_OPEN):
        recorder._finish_own()
