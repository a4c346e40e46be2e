"""Writes a log: what the topics of format version 1 hold, in chunks of their own kinds.

    columns of steps      -> /rl/step             one chunk, fixed-size rows
    columns of images     -> /rl/observation/...  one chunk, fixed-size rows
    how the policy learns -> /rl/learner          one chunk, fixed-size rows; only if there is any
    one episode's summary -> /rl/episode          one chunk
    what viewers show     -> see `display`        one chunk

Callers write an episode's steps last: a finished episode is one whose record `final` is in the
file, and then all else of it is there too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.recorder import messages
from mcaprl.recorder.chunks import message_rows
from mcaprl.recorder.mcap_writer import McapWriter
from mcaprl.recorder.metadata import METADATA_NAME, SAME_WHEN_APPENDED, LogMetadata
from mcaprl.recorder.schema import (
    ENCAPSULATION,
    LEARNER_TEXT,
    LEARNER_TYPE,
    fill_image_constants,
    image_dtype,
    message_dtype,
    step_schema,
)
from mcaprl.recorder.spaces import action_leaf, observation_leaves

STEP_TOPIC = "/rl/step"
EPISODE_TOPIC = "/rl/episode"
LEARNER_TOPIC = "/rl/learner"
INTERRUPTED = "interrupted"
"""Why an episode ended that the recorder, not the environment, broke off."""
# Rows of /rl/step in a chunk, and images in one of theirs: as many, or as few as have this size.
STEPS_PER_CHUNK = 8192
IMAGES_PER_CHUNK = 100
BYTES_PER_CHUNK = 8 * 2**20
# A transition that stays behind, one that is new, and one more to make way.
MIN_ROWS = 3
IMAGE_FRAME = "camera"


@dataclass(frozen=True)
class EpisodeSummary:
    """What `/rl/episode` tells of one episode.

    Attributes:
        episode: counted from 0 in its log.
        length: transitions.
        total_reward: sum of rewards, in the order they came.
        terminated: whether the last transition ended in a terminal state.
        truncated: whether it was cut off.
        start_time_ns: log_time of the first record.
        end_time_ns: log_time of the final record.
        reason: why it ended.
        policy: who acted.
        epsilon: its exploration; NaN if unknown.
        seed: given to reset(); None if none was.
        options: reset()'s options as JSON; empty if none were given.
    """

    episode: int
    length: int
    total_reward: float
    terminated: bool
    truncated: bool
    start_time_ns: int
    end_time_ns: int
    reason: str = ""
    policy: str = ""
    epsilon: float = math.nan
    seed: int | None = None
    options: str = ""

    def to_message(self) -> Any:
        """As `mcaprl_msgs/msg/Episode`."""
        fields = {**vars(self), "seed": -1 if self.seed is None else self.seed}
        return messages.new(messages.EPISODE_TYPE, **fields)

    @classmethod
    def from_fields(cls, fields: Mapping[str, Any]) -> EpisodeSummary:
        """From the fields of a `mcaprl_msgs/msg/Episode`."""
        seed = fields.get("seed", -1)
        return cls(**{**fields, "seed": None if seed < 0 else seed})


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
        leaves = observation_leaves(metadata.observation_space)
        self.metadata = metadata
        self.action = action_leaf(metadata.action_space)
        self.image_leaves = tuple(leaf for leaf in leaves if leaf.encoding is not None)
        name, text = step_schema(metadata.observation_space, metadata.action_space)
        dtype = message_dtype(text)
        assert dtype is not None, "/rl/step has a fixed length by construction"
        self._step_dtype = dtype
        strings = metadata.to_strings()
        self.mcap = McapWriter(path, compression=compression, overwrite=overwrite, append=append)
        if self.mcap.untouched:
            self._check_same(strings)
        self.mcap.add_metadata(METADATA_NAME, strings)
        self._step_channel = self.mcap.add_channel(STEP_TOPIC, name, text, strings)
        self._episode_channel = self.add_channel(EPISODE_TOPIC, messages.EPISODE_TYPE)

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
        """Preallocate a chunk's rows of `/rl/step`: `chunks.record_dtype` around its fields."""
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
            Rows of `chunks.record_dtype`; `payload.data` is the flat picture.
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

    def write_episodes(self, summaries: list[EpisodeSummary]) -> None:
        """Write episodes to `/rl/episode`, each at its end's time."""
        self.mcap.write_messages(
            [
                (self._episode_channel, summary.end_time_ns, messages.encode(summary.to_message()))
                for summary in summaries
            ]
        )

    def close(self) -> None:
        """Write the summary section and close the file. Closing twice is harmless."""
        self.mcap.close()


def _rows_per_chunk(most: int, payload: np.dtype[Any]) -> int:
    return max(MIN_ROWS, min(most, BYTES_PER_CHUNK // payload.itemsize))
