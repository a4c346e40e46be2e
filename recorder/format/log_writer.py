"""Writes a log of format version 1, which is specified here, in `schema` and in `metadata`.

A log is an MCAP file with the header profile `ros2`; all channels are `cdr`, all schemas `ros2msg`.

    topic                  type                      a message for each
    /rl/step               mcaprl_msgs/msg/Step...   observation: what `schema` says
    /rl/observation/<key>  sensor_msgs/msg/Image     picture that is observed: mono8, rgb8 or rgba8
    /rl/episode            mcaprl_msgs/msg/Episode   episode, at its end: what `messages` says
    /rosout                rcl_interfaces/msg/Log    episode's start, and end, in words
    /rl/learner            mcaprl_msgs/msg/Learner   transition, if the policy told its version
    all others                                       what only viewers show: see `display`

Episodes. One of T transitions has T + 1 records of `/rl/step`, one behind the other: record k has
observation k, and the action taken there with what it brought; record T is `final` and has only the
last observation. `episode` counts from 0 in the recording, `step` from 0 in the episode. The last
transition is `terminated`, `truncated` or both. One that was broken off is truncated for the reason
`interrupted`. Episodes of many environments that ran side by side are written one after the other,
in the order of their ends.

Times. log_time is the start of the recording since the Unix epoch plus simulated time, in integer
nanoseconds; publish_time is the same. It rises from record to record of `/rl/step`, from episode to
episode too, and all that belongs to one observation has its log_time: that is the key which joins
topics. `/rl/episode` has that of the final record.

Chunks. Each holds one kind of topic, as the lines above divide them (but `/rosout` stands with
`/rl/episode`), and is compressed by zstd, lz4 or not at all, with its CRC, and a MessageIndex for
each channel in it. Schemas, channels, metadata and attachments are top-level records before the
chunks that need them. The summary repeats schemas and channels, and indexes all else. Every CRC
that MCAP has is there. When a log is closed, many chunks below 64 KiB are merged to chunks of about
1 MiB of the same kind; the messages of each channel stay in their order.

Order. First comes the metadata record `mcaprl.dataset`. Of an episode, `/rl/step` is written last:
a finished episode is one whose record `final` is in the file, and then all else of it is there too.
A file without a summary is one whose writer was killed, or is still at work; its finished episodes
are whole. With the first episode comes the attachment `foxglove-layout.json`.

Growth. What is appended goes on counting episodes, and begins later than the file ended; its
environment has the same id, arguments, spaces, names and step duration as the one before. A
recording may go on in more files, `NAME-00000.mcap`, `NAME-00001.mcap` and so on: each is a log of
whole episodes, and episodes and times go on from one to the next.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.recorder.columns.cdr import ENCAPSULATION
from mcaprl.recorder.columns.message_rows import message_rows
from mcaprl.recorder.columns.writer import McapWriter
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.episode_summary import EpisodeSummary
from mcaprl.recorder.format.metadata import METADATA_NAME, SAME_WHEN_APPENDED, LogMetadata
from mcaprl.recorder.format.schema import (
    LEARNER_TEXT,
    LEARNER_TYPE,
    fill_image_constants,
    image_dtype,
    message_dtype,
    step_schema,
)
from mcaprl.recorder.format.spaces import action_leaf, observation_leaves
from mcaprl.recorder.format.topics import (
    BYTES_PER_CHUNK,
    EPISODE_TOPIC,
    IMAGE_FRAME,
    IMAGES_PER_CHUNK,
    LEARNER_TOPIC,
    LOG_TOPIC,
    MIN_ROWS,
    STEP_TOPIC,
    STEPS_PER_CHUNK,
)


class LogWriter:
    """Writes one log of format version 1."""

    def __init__(
        self,
        path: str | Path,
        metadata: LogMetadata,
        *,
        compression: str = "zstd",
        overwrite: bool = False,
        append: bool = False,
    ) -> None:
        """Create the file, or open it to append, and announce its topics.

        Raises:
            SpaceError: a log cannot hold these spaces. No file is made then.
            OutputExistsError, LogError: the file cannot be created, or appended to; then it stays
                as it is.
        """
        self._prepare(metadata)
        strings = metadata.to_strings()
        self.mcap = McapWriter(path, compression=compression, overwrite=overwrite, append=append)
        if self.mcap.untouched:
            self._check_same(strings)
        self._announce(strings)

    def _prepare(self, metadata: LogMetadata) -> None:
        """Find what messages the spaces need."""
        leaves = observation_leaves(metadata.observation_space)
        self.metadata = metadata
        self.action = action_leaf(metadata.action_space)
        self.image_leaves = tuple(leaf for leaf in leaves if leaf.encoding is not None)
        self._step_type = step_schema(metadata.observation_space, metadata.action_space)
        dtype = message_dtype(self._step_type[1])
        assert dtype is not None, "/rl/step has a fixed length by construction"
        self._step_dtype = dtype

    def _announce(self, strings: dict[str, str]) -> None:
        """Tell what the log is of, and the topics that every log has."""
        self.mcap.add_metadata(METADATA_NAME, strings)
        self._step_channel = self.mcap.add_channel(STEP_TOPIC, *self._step_type, strings)
        self._episode_channel = self.add_channel(EPISODE_TOPIC, messages.EPISODE_TYPE)
        self._log_channel: int | None = None

    def _check_same(self, strings: dict[str, str]) -> None:
        """Make sure that a file that is appended to was recorded from such an environment."""
        found = self.mcap.metadata(METADATA_NAME) or {}
        for name in SAME_WHEN_APPENDED:
            here, there = strings[name], found.get(name, "not known")
            if here != there:
                self.mcap.abandon()
                raise LogError(
                    f"{self.mcap.path} cannot be appended to: its {name} is {there:.200}, the"
                    f" recording's {here:.200}; record to another file"
                )

    def add_channel(self, topic: str, type_name: str) -> int:
        """Announce a topic of a known ROS type; returns its channel id."""
        return self.mcap.add_channel(topic, type_name, messages.definition(type_name))

    def step_rows(self) -> NDArray[Any]:
        """Preallocate a chunk's rows of `/rl/step`: `record_dtype` around its fields."""
        count = _rows_per_chunk(STEPS_PER_CHUNK, self._step_dtype)
        rows = message_rows(count, self._step_dtype, self._step_channel)
        rows["payload"]["encapsulation"] = ENCAPSULATION
        rows["payload"]["behavior_prob"] = np.nan
        return rows

    def add_image_topic(self, topic: str, shape: tuple[int, ...], encoding: str) -> NDArray[Any]:
        """Announce a topic of images and preallocate a chunk of its rows.

        Args:
            topic: its name.
            shape: (height, width) or (height, width, channels).
            encoding: `mono8`, `rgb8`, `rgba8` or `16UC1`.

        Returns:
            Rows of `message_rows.record_dtype`; `payload.data` is the flat picture.
        """
        height, width, channels = (*shape, 1)[:3]
        item_bytes = 2 if encoding == "16UC1" else 1
        dtype = image_dtype(height, width, channels, encoding, IMAGE_FRAME, item_bytes)
        channel = self.add_channel(topic, "sensor_msgs/msg/Image")
        rows = message_rows(_rows_per_chunk(IMAGES_PER_CHUNK, dtype), dtype, channel)
        fill_image_constants(rows["payload"], height, width, encoding, IMAGE_FRAME)
        return rows

    def learner_rows(self) -> NDArray[Any]:
        """Announce `/rl/learner` and preallocate a chunk of its rows."""
        dtype = message_dtype(LEARNER_TEXT)
        assert dtype is not None
        channel = self.mcap.add_channel(LEARNER_TOPIC, LEARNER_TYPE, LEARNER_TEXT)
        rows = message_rows(_rows_per_chunk(STEPS_PER_CHUNK, dtype), dtype, channel)
        rows["payload"]["encapsulation"] = ENCAPSULATION
        return rows

    def write_steps(self, rows: NDArray[Any]) -> None:
        """Write rows of `/rl/step`, all fields and log_time set."""
        self.mcap.write_rows(rows)

    def write_images(self, rows: NDArray[Any]) -> None:
        """Write rows of an image topic; their stamps are set from log_time here."""
        sec, nanosec = np.divmod(rows["log_time"], np.uint64(10**9))
        rows["payload"]["sec"], rows["payload"]["nanosec"] = sec, nanosec
        self.mcap.write_rows(rows)

    def write_episodes(self, summaries: list[EpisodeSummary], *, log_lines: bool = False) -> None:
        """Write episodes to `/rl/episode`, each at its end's time.

        Args:
            summaries: of the episodes.
            log_lines: whether to tell of their starts and ends on `/rosout`, too.
        """
        told = [
            (self._episode_channel, summary.end_time_ns, summary.to_message())
            for summary in summaries
        ]
        self.mcap.write_messages(told + (self._lines(summaries) if log_lines else []))

    def write_log_lines(self, summaries: list[EpisodeSummary]) -> None:
        """Tell of episodes' starts and ends on `/rosout` alone."""
        self.mcap.write_messages(self._lines(summaries))

    def _lines(self, summaries: list[EpisodeSummary]) -> list[tuple[int, int, bytes]]:
        if self._log_channel is None:
            self._log_channel = self.add_channel(LOG_TOPIC, messages.LOG_TYPE)
        return [
            (self._log_channel, time_ns, messages.log_message(time_ns, text))
            for summary in summaries
            for time_ns, text in summary.log_lines()
        ]

    def close(self) -> None:
        """Write the summary section and close the file. Closing twice is harmless."""
        self.mcap.close()


def _rows_per_chunk(most: int, payload: np.dtype[Any]) -> int:
    return max(MIN_ROWS, min(most, BYTES_PER_CHUNK // payload.itemsize))
