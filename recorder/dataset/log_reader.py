"""Reader of one log of format version 1; it converts chunks to columns, and columns to episodes.

Logs of other writers have no metadata, so their spaces are inferred from `/rl/step`.

Such a log needs a topic `/rl/step` of CDR messages. The messages have the fields that `schema.py`
describes, in any order and with any numeric types. The fields `behavior_prob` and
`behavior_log_prob` are optional, and other fields are ignored. Vectors are in `observation`, or in
`observation_<key>` for each key of a Dict space; images are on topics `/rl/observation/<key>`, with
the log_times of the step records. The inferred spaces are unbounded Boxes; for integer actions, the
space is Discrete up to the largest action. If there are both `observation` and `observation_<key>`
fields, `observation` becomes the key `state`.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import (
    BAG_HINT,
    CorruptLogError,
    LogError,
    NoEpisodesError,
    NoStepsError,
    SpaceError,
)
from mcaprl.recorder.dataset.arrays import action_space_of, box_of
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.episodes import (
    COUNTERS,
    EpisodeTopic,
    episode_lengths,
    step_order,
    summaries,
)
from mcaprl.recorder.dataset.images import Frames, Storage, read_images
from mcaprl.recorder.dataset.log_video import is_video_leaf, packets_of_leaf
from mcaprl.recorder.dataset.transitions import Origin, Transitions, ranges
from mcaprl.recorder.format.behavior import FIELDS, behavior_field
from mcaprl.recorder.format.infos import read_infos
from mcaprl.recorder.format.messages import EpisodeSummary
from mcaprl.recorder.format.metadata import METADATA_NAME, LogMetadata
from mcaprl.recorder.format.reading import LOG_TIME, Columns, McapReader, Topic
from mcaprl.recorder.format.schema import EPISODE_TOPIC, STEP_TOPIC, is_intact, stored_dtype
from mcaprl.recorder.format.spaces import (
    IMAGE_ENCODINGS,
    Leaf,
    action_leaf,
    observation_leaves,
    restricted,
    select,
)

_OBSERVATION, _STATE, _IMAGE_TOPIC = "observation", "observation_state", "/rl/observation/"


def observation_fields(fields: Iterable[str]) -> list[str]:
    """Return the names of the observation fields."""
    return [name for name in fields if name == _OBSERVATION or name.startswith(f"{_OBSERVATION}_")]


def inferred_metadata(reader: McapReader, columns: Columns) -> LogMetadata:
    """Infer a log's metadata from its contents."""
    images = sorted(
        channel.topic
        for channel in reader.channels.values()
        if channel.topic.startswith(_IMAGE_TOPIC)
    )
    vectors = observation_fields(columns)
    if not vectors and not images:
        raise LogError(
            f"{reader.path}: {STEP_TOPIC} has no field {_OBSERVATION}, and there are no images on"
            f" {_IMAGE_TOPIC}<key>"
        )
    action = columns["action"].astype(np.int64 if columns["action"].dtype.kind in "iu" else None)
    if vectors == [_OBSERVATION] and not images:
        return LogMetadata(box_of(columns[_OBSERVATION]), action_space_of(action))
    if _OBSERVATION in vectors:
        columns.setdefault(_STATE, columns.pop(_OBSERVATION))
    parts: dict[str, spaces.Space[Any]] = {
        name.removeprefix(f"{_OBSERVATION}_"): box_of(columns[name])
        for name in observation_fields(columns)
    }
    parts |= {topic.removeprefix(_IMAGE_TOPIC): _image_space(reader, topic) for topic in images}
    metadata = LogMetadata(spaces.Dict(parts), action_space_of(action))
    # Leaves are later read by name, so there must be a field or topic with the name of each leaf.
    for leaf in observation_leaves(metadata.observation_space):
        if not (reader.channels_of(leaf.topic) if leaf.encoding else leaf.name in columns):
            raise LogError(
                f"{reader.path}: the observation '{leaf.path[0]}' must be named"
                f" {leaf.topic if leaf.encoding else leaf.name}; use lower-case letters, digits and"
                " single underscores"
            )
    return metadata


def _image_space(reader: McapReader, topic: str) -> spaces.Box:
    images = Topic(reader, topic)
    if not len(images):
        raise LogError(f"{reader.path}: no images on {topic}")
    first = images.read(("height", "width", "encoding"), np.zeros(1, np.int64))
    height, width, encoding = (first[name][0] for name in ("height", "width", "encoding"))
    channels = {name: count for count, name in IMAGE_ENCODINGS.items()}.get(encoding)
    if channels is None:
        raise LogError(
            f"{reader.path}: images on {topic} are {encoding};"
            f" supported encodings: {', '.join(IMAGE_ENCODINGS.values())}"
        )
    shape = (int(height), int(width)) if channels == 1 else (int(height), int(width), channels)
    return spaces.Box(0, 255, shape, np.uint8)


# If episodes have at least this many steps on average, `_without` moves rows in place.
_LONG_EPISODE = 100
REQUIRED_FIELDS = ("reward", "action", "terminated", "truncated", *COUNTERS)


@dataclass(frozen=True)
class Selection:
    """Options of reading a log: columns, image storage and threads; see `open_logs`."""

    columns: tuple[str, ...] | None = None
    images: Storage = "memory"
    threads: int = 1


class LogReader:
    """A log that is open for reading."""

    def __init__(self, path: Path, selection: Selection | None = None) -> None:
        """Open the file and read its summary section.

        Raises:
            LogError: The file is not an MCAP file, has no steps, or its metadata is damaged.
        """
        self.path = path
        self._selection = selection or Selection()
        self._reader = McapReader(path)
        self._steps = _steps_of(self._reader)
        self._metadata = described(self._reader)
        self._summaries = EpisodeTopic(Topic(self._reader, EPISODE_TOPIC))

    @cached_property
    def description(self) -> LogMetadata:
        """Metadata of the log.

        If another program wrote the log, the metadata is inferred from the first episode.

        Raises:
            LogError: The metadata must be inferred, and the first episode cannot be read.
        """
        return self._metadata or self.read(np.zeros(1, np.int64))._description

    @cached_property
    def lengths(self) -> NDArray[np.int64]:
        """(E,) number of transitions of each finished episode.

        Raises:
            CorruptLogError: Records are missing, duplicated or out of order.
            NoEpisodesError: The log has no finished episode.
        """
        # These lengths are from `/rl/episode`; `read` compares them with the records.
        listed = self._summaries.lengths if self._reader.complete else np.empty(0, np.int64)
        if self._steps.chunks_rise and int(listed.sum()) + len(listed) == len(self._steps):
            return listed
        self._check_fields(COUNTERS)
        return self._finished(episode_lengths(self._steps.read(COUNTERS, self._order), self.path))

    @property
    def checksum(self) -> str:
        """Hash of the log's chunks; see `McapReader`."""
        return self._reader.checksum

    def record_times(self) -> NDArray[np.int64]:
        """Return the log_time of each record of the finished episodes, episode by episode.

        Raises:
            LogError: Records are missing or out of order, or the log has no finished episode.
        """
        times, frames = self._steps.times, int(self.lengths.sum()) + len(self.lengths)
        return (times if self._order is None else times[self._order])[:frames]

    def episode_summaries(self) -> list[EpisodeSummary]:
        """Return the summary of each episode, read from `/rl/episode` if it lists all episodes.

        Raises:
            LogError: Chunks are damaged, or records or fields are missing.
        """
        lengths = self.lengths
        ends = self.record_times()[np.cumsum(lengths + 1) - 1]
        by_end = {one.end_time_ns: one for one in self._summaries.summaries(ends)}
        found = [by_end[end] for end in ends.tolist() if end in by_end]
        if [one.length for one in found] == lengths.tolist():
            return found
        return [episode.summary for episode in self.read().episodes]

    def read(self, episodes: NDArray[np.int64] | None = None) -> Dataset:
        """Read whole episodes.

        Args:
            episodes: Increasing indexes of the episodes; default: all.

        Raises:
            LogError: Chunks are damaged, or records or fields are missing.
        """
        wanted = self._wanted()
        self._check_fields(wanted)
        if episodes is None:
            columns = self._steps.read(wanted, self._order, threads=self._selection.threads)
            lengths = self._finished(episode_lengths(columns, self.path))
            frames = int(lengths.sum()) + len(lengths)
            columns = {name: column[:frames] for name, column in columns.items()}
        else:
            columns, lengths = self._read_some(episodes, wanted)
        metadata = self._metadata or inferred_metadata(self._reader, columns)
        return self._dataset(metadata, columns, lengths)

    @cached_property
    def _order(self) -> NDArray[np.int64] | None:
        return step_order(self._steps)

    def _read_some(
        self, episodes: NDArray[np.int64], wanted: Sequence[str]
    ) -> tuple[Columns, NDArray[np.int64]]:
        lengths = self.lengths
        firsts = np.cumsum(lengths + 1) - (lengths + 1)
        rows = ranges(firsts[episodes], lengths[episodes] + 1)
        if not self._steps.chunks_rise and self._order is not None:
            rows = self._order[rows]
        columns = self._steps.read(wanted, rows, threads=self._selection.threads)
        if not np.array_equal(episode_lengths(columns, self.path), lengths[episodes]):
            raise CorruptLogError(
                f"{self.path}: {EPISODE_TOPIC} and {STEP_TOPIC} contain different episodes"
            )
        return columns, lengths[episodes]

    def _wanted(self) -> list[str]:
        """Return the names of the fields to read from `/rl/step`."""
        fields = self._steps.fields
        wanted = [*REQUIRED_FIELDS, *(field.name for field in FIELDS if field.name in fields)]
        if self._metadata is None:
            return wanted + observation_fields(fields)
        return wanted + [leaf.name for leaf in self._leaves(self._metadata) if not leaf.encoding]

    def _leaves(self, metadata: LogMetadata) -> list[Leaf]:
        """Return the observation leaves to read."""
        return select(metadata.leaves, self._selection.columns)

    def _check_fields(self, wanted: Sequence[str]) -> None:
        if not len(self._steps):
            raise NoEpisodesError(f"{self.path} has no finished episode")
        fields = self._steps.fields
        missing = [name for name in wanted if name not in fields]
        if missing:
            raise LogError(f"{self.path}: {STEP_TOPIC} has no field {', '.join(missing)}")
        odd = [name for name in wanted if fields[name].kind == "O"]
        if odd:
            raise LogError(
                f"{self.path}: {STEP_TOPIC} has fields that are neither numbers nor arrays:"
                f" {', '.join(odd)}"
            )

    def _finished(self, lengths: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return `lengths` unchanged; warn about records after the last finished episode.

        Raises:
            NoEpisodesError: The log has no finished episode.
        """
        if not len(lengths):
            raise NoEpisodesError(f"{self.path} has no finished episode")
        extra = len(self._steps) - int(lengths.sum()) - len(lengths)
        if extra or not self._reader.complete:
            viewers = f"; to open it in a viewer, run `mcaprl recover {self.path} OUT`"
            warnings.warn(
                f"{self.path} was cut off or is still being written; finished episodes read:"
                f" {len(lengths)}, later records skipped: {extra}"
                + (viewers if not self._reader.complete else ""),
                stacklevel=4,
            )
        return lengths

    def _dataset(
        self, metadata: LogMetadata, columns: Columns, lengths: NDArray[np.int64]
    ) -> Dataset:
        """Return the dataset of the records of whole episodes."""
        leaves = self._leaves(metadata)
        finals = np.cumsum(lengths + 1) - 1
        recorded = self._summaries.summaries(columns[LOG_TIME][finals])
        episodes = summaries(self.path, columns, lengths, recorded)
        action = action_leaf(metadata.action_space)
        behavior = behavior_field(metadata.action_space).column(
            *(columns.get(field.name) for field in FIELDS)
        )
        if behavior is None:
            behavior = np.full(len(columns["final"]), np.nan, np.float32)
        transitions = Transitions(
            frames=tuple(self._frames(leaf, columns) for leaf in leaves),
            log_time_ns=columns[LOG_TIME],
            episodes=episodes,
            actions=_without(_as_leaf(self.path, columns, action), finals),
            rewards=_without(columns["reward"].astype(np.float64, copy=False), finals),
            terminated=_without(_flags(columns["terminated"]), finals),
            truncated=_without(_flags(columns["truncated"]), finals),
            behavior=_without(behavior, finals),
            infos=read_infos(self._reader, columns[LOG_TIME]),
            packets={
                k: packets_of_leaf(self._reader, leaf, columns[LOG_TIME])
                for k, leaf in enumerate(leaves)
                if leaf.encoding is not None and is_video_leaf(self._reader, leaf)
            },
        )
        if self._selection.columns is not None:
            metadata = replace(
                metadata, observation_space=restricted(metadata.observation_space, leaves)
            )
        return Dataset(transitions, metadata, origin=Origin((self.path,)))

    def _frames(self, leaf: Leaf, columns: Columns) -> Frames:
        if leaf.encoding is None:
            return _as_leaf(self.path, columns, leaf)
        return read_images(
            self._reader,
            leaf,
            columns[LOG_TIME],
            storage=self._selection.images,
            threads=self._selection.threads,
        )


def describe(reader: McapReader) -> LogMetadata:
    """Return the metadata of a log, or empty metadata if the log has none."""
    _steps_of(reader)
    return described(reader) or LogMetadata.from_strings({})


def described(reader: McapReader) -> LogMetadata | None:
    """Return the metadata of a log, or None if another program wrote the log."""
    record = reader.metadata.get(METADATA_NAME)
    copies = [
        # This copy of the metadata is in the summary section, whose CRC detects damage.
        channel.metadata
        for channel in reader.channels_of(STEP_TOPIC)
        if "format_version" in channel.metadata
    ]
    copies += [record] if record is not None else []
    if not copies:
        return None
    if any(copy != copies[0] for copy in copies):
        raise CorruptLogError(
            f"{reader.path}: the metadata record and the metadata of {STEP_TOPIC} differ"
        )
    try:
        return LogMetadata.from_strings(copies[0])
    except (LogError, SpaceError) as error:
        raise LogError(f"{reader.path}: {error}") from error


def _steps_of(reader: McapReader) -> Topic:
    channels = reader.channels_of(STEP_TOPIC)
    if not channels:
        topics = ", ".join(sorted(channel.topic for channel in reader.channels.values())) or "none"
        raise NoStepsError(
            f"{reader.path} has no topic {STEP_TOPIC} and thus no transitions (topics: {topics});"
            f" {BAG_HINT}"
        )
    for schema in map(reader.schema_of, channels):
        if not is_intact(schema.name, schema.data):
            raise CorruptLogError(f"{reader.path}: the schema of {STEP_TOPIC} is damaged")
    return Topic(reader, STEP_TOPIC)


def _as_leaf(path: Path, columns: Columns, leaf: Leaf) -> NDArray[Any]:
    """Convert a field's column to the shape and dtype of its leaf."""
    column = columns[leaf.name]
    if column[0].size == leaf.size:
        shaped = column.reshape(len(column), *leaf.shape)
        if column.dtype == stored_dtype(leaf.dtype):
            return shaped.astype(leaf.dtype, copy=False)
        with np.errstate(all="ignore"):
            cast = shaped.astype(leaf.dtype)
        is_float = cast.dtype.kind == shaped.dtype.kind == "f"
        if np.array_equal(cast, shaped, equal_nan=is_float):
            return cast
    raise CorruptLogError(
        f"{path}: {STEP_TOPIC} does not fit the spaces in the metadata: {leaf.name} is"
        f" {column.dtype} {column.shape[1:]}, expected {leaf.dtype} {leaf.shape}"
    )


def _flags(column: NDArray[Any]) -> NDArray[np.bool_]:
    """Convert a column of bytes to bools; every value other than 0 is true."""
    if column.dtype == np.uint8 and column.max(initial=0) <= 1:
        return column.view(np.bool_)
    return column.astype(np.bool_)


def _without(column: NDArray[Any], rows: NDArray[np.int64]) -> NDArray[Any]:
    """Return a column without the given rows; the input column may be overwritten."""
    if len(column) < _LONG_EPISODE * len(rows):
        return np.delete(column, rows, axis=0)
    # Moving long ranges of rows is cheaper than allocating another column.
    starts, stops = rows[:-1] + 1, rows[1:]
    for moved, (start, stop) in enumerate(zip(starts.tolist(), stops.tolist(), strict=True), 1):
        column[start - moved : stop - moved] = column[start:stop]
    return column[: len(column) - len(rows)]
