"""Finished log from which messages are copied, and the log_times of its episodes."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from mcap.records import Attachment, Metadata
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError, NoStepsError
from mcaprl.recorder.dataset.log_reader import LogReader, Selection
from mcaprl.recorder.format.messages import EpisodeSummary
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.format.schema import PHASE_TOPIC, STEP_TOPIC
from mcaprl.recorder.format.selected_copy import Times, times_of
from mcaprl.recorder.format.writing import finished_state
from mcaprl.recorder.record.display import CAMERA_INFO, SCENE, SCENE_STATIC, TF, TF_STATIC
from mcaprl.storage.remote import as_path

# On these topics, a message is valid until the next message of the same topic.
_STATES = (SCENE, SCENE_STATIC, TF, TF_STATIC, CAMERA_INFO, PHASE_TOPIC)
_LAST_TIME = np.iinfo(np.int64).max


@dataclass(frozen=True)
class Edited:
    """Log that was made of parts of other logs.

    Attributes:
        out: Path of the log.
        episodes: Number of episodes.
        steps: Number of transitions.
        messages: Number of messages.
        whole_chunks: Number of chunks that were copied without decompressing them.
        rewritten_chunks: Number of chunks that were decompressed and written again.
    """

    out: Path
    episodes: int
    steps: int
    messages: int
    whole_chunks: int
    rewritten_chunks: int


class FinishedLog:
    """A finished log of whole episodes, or a finished MCAP file without `/rl/step`.

    Attributes:
        path: Path of the file.
        reader: Reader of the file.
        top_level: Metadata records, schemas, channels and attachments, in this order.
    """

    def __init__(self, path: str | Path) -> None:
        """Open the file; a remote file is first downloaded completely."""
        self.path = as_path(path, whole=True)
        self.reader = McapReader(self.path)
        try:
            top_level = finished_state(self.reader).top_level
        except CorruptLogError as error:
            what = str(error).removeprefix(f"{self.path}: ")
            raise self._unusable(what) from error
        self.top_level = [
            *(record for record in top_level if isinstance(record, Metadata)),
            *(record for record in top_level if not isinstance(record, Metadata | Attachment)),
            *(record for record in top_level if isinstance(record, Attachment)),
        ]
        self._log = LogReader(self.path) if self.reader.channels_of(STEP_TOPIC) else None

    @property
    def has_steps(self) -> bool:
        """Whether the file has the topic `/rl/step`."""
        return self._log is not None

    @cached_property
    def lengths(self) -> NDArray[np.int64]:
        """(E,) number of transitions of each episode. Without `/rl/step`, the array is empty."""
        if self._log is None:
            return np.empty(0, np.int64)
        with warnings.catch_warnings():
            # Suppress the warning about an unfinished last episode: `times` raises an error for it.
            warnings.simplefilter("ignore")
            return self._log.lengths

    @cached_property
    def times(self) -> Times:
        """(F,) log_time of each record of `/rl/step`, nanoseconds."""
        if self._log is None:
            return np.empty(0, np.int64)
        lengths, found = self.lengths, self._log.record_times()
        channels = self.reader.channels_of(STEP_TOPIC)
        records = sum(len(part) for one in channels for part in self.reader.message_ranges(one))
        if len(found) != records:
            raise self._unusable(f"it has {records - len(found)} records of an unfinished episode")
        if (np.diff(found) <= 0).any():
            raise LogError(
                f"{self.path}: the log_times of {STEP_TOPIC} do not increase throughout the"
                f" {len(lengths)} episodes; copy the log with mcaprl.open(...).save(...) first"
            )
        return found

    @property
    def firsts(self) -> NDArray[np.int64]:
        """(E,) index of the first record of each episode."""
        return np.cumsum(self.lengths + 1) - (self.lengths + 1)

    @property
    def spans(self) -> Times:
        """(E, 2) log_times of the first and last record of each episode, increasing."""
        firsts = self.firsts
        return np.stack([self.times[firsts], self.times[firsts + self.lengths]], axis=1)

    def need_steps(self) -> None:
        """Raise NoStepsError if the file has no `/rl/step`."""
        if self._log is None:
            raise NoStepsError(f"{self.path} has no topic {STEP_TOPIC} and thus no episodes")

    def summaries(self) -> list[EpisodeSummary]:
        """Return the summary of each episode."""
        self.need_steps()
        return LogReader(self.path, Selection(columns=())).episode_summaries()

    def span_of_messages(self) -> tuple[int, int]:
        """Return the smallest and largest log_time of all messages; (0, 0) if there are none."""
        chunks = [chunk for chunk in self.reader.chunks if chunk.message_index_length]
        starts = [chunk.message_start_time for chunk in chunks]
        ends = [chunk.message_end_time for chunk in chunks]
        return min(starts, default=0), max(ends, default=0)

    def spans_of(self, episodes: NDArray[np.int64]) -> Times:
        """Return the time ranges of the episodes' messages: (S, 2) first and last log_times.

        An episode has all messages from its first record until the next episode. Messages before
        the first episode belong to the first episode. The ranges of adjacent episodes are merged
        into one range.
        """
        starts = self.spans[:, 0].copy()
        starts[0] = 0
        stops = np.append(starts[1:] - 1, _LAST_TIME)
        begins = np.flatnonzero(np.diff(episodes, prepend=-2) != 1)
        ends = np.append(begins[1:] - 1, len(episodes) - 1)
        return np.stack([starts[episodes[begins]], stops[episodes[ends]]], axis=1)

    def states(self, spans: Times) -> dict[int, Times]:
        """Return the times of the messages that are still valid at the start of each time range.

        Display topics that are not repeated at each step, such as the static scene, have such
        messages. The topics that ROS calls latched or transient local also have such messages. On
        these topics, the last message before a range is still valid.

        Args:
            spans: (S, 2) first and last log_times of the S copied time ranges.

        Returns:
            Times by channel id.
        """
        found = {}
        for channel in self.reader.channels.values():
            if channel.topic in _STATES or _is_latched(channel.metadata):
                times = np.sort(times_of(self.reader, channel))
                latest = np.searchsorted(times, spans[:, 0], side="right") - 1
                before = times[latest[latest >= 0]]
                if len(before):
                    found[channel.id] = np.unique(before)
        return found

    def _unusable(self, what: str) -> LogError:
        return LogError(
            f"{self.path} cannot be copied: {what}; run `mcaprl recover {self.path} OUT` and use"
            " OUT"
        )


def _is_latched(metadata: dict[str, str]) -> bool:
    """Return whether ROS delivers the last message of a channel to later subscribers."""
    qos = metadata.get("offered_qos_profiles", "")
    return (
        metadata.get("latching") == "1"
        or "transient_local" in qos
        or any(line.strip(" -") == "durability: 1" for line in qos.splitlines())
    )
