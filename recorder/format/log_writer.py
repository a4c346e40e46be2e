"""Writer of logs of format version 1, specified by this text, `schema` and `metadata`.

A log is an MCAP file with the header profile `ros2`. All channels have the encoding `cdr`, and all
schemas have the encoding `ros2msg`.

    topic                  type                      one message for each
    /rl/step               mcaprl_msgs/msg/Step...   observation; fields in `schema`
    /rl/observation/<key>  sensor_msgs/msg/Image     image observation: mono8, rgb8 or rgba8
    /rl/episode            mcaprl_msgs/msg/Episode   episode, at its end; fields in `messages`
    /rosout                rcl_interfaces/msg/Log    start and end of an episode, as text; an end is
                                                     a warning if the episode fails
    /rl/phase              std_msgs/msg/String       start and end of an episode: `running`, then
                                                     the reason of the end
    /rl/learner            mcaprl_msgs/msg/Learner   transition, if the policy version is known
    /rl/info/<name>        std_msgs/msg/Float64...   observation whose info has this name; see
                                                     `infos`; only if infos are recorded
    all others                                       display topics, see `record/display.py`

Episodes. An episode of T transitions has T + 1 consecutive records of `/rl/step`. Record k < T
contains observation k, the action taken at it, and the reward of that action; record T is `final`
and contains only the last observation. `episode` is the index in the recording, and `step` is the
index in the episode; both start at 0. The last transition is `terminated`, `truncated` or both. An
episode that the recorder ends is truncated with the reason `interrupted`. Episodes of a vector
environment are written one after the other, in the order of their ends.

Times. log_time and publish_time are the Unix time at the start of the recording plus the simulated
time, in integer nanoseconds. log_time increases strictly from record to record of `/rl/step`, also
across episodes. All messages of one observation have the same log_time, which joins the topics.
`/rl/episode` has the log_time of the final record.

Chunks. Each line of the table above is one kind of topic, and each chunk contains one kind of topic
only. Exceptions are `/rosout` and `/rl/phase`, which are in the chunks of `/rl/episode`. A chunk is
compressed by zstd, lz4 or not at all, and has a CRC and a MessageIndex for each of its channels.
Schemas, channels, metadata and attachments are top-level records before the chunks that need them.
The summary repeats schemas and channels, and indexes everything else. All CRCs that MCAP defines
are present. If a log has many chunks below 64 KiB when it is closed, chunks of the same kind are
merged into chunks of about 1 MiB; the messages of each channel keep their order.

Order. The metadata record `mcaprl.dataset` comes first. `/rl/step` is written last in each episode,
so a file that contains the `final` record contains the whole episode. A file without a summary is
still being written, or its writer was killed; its finished episodes are complete. The attachment
`foxglove-layout.json` comes with the first episode.

Appending. An appended recording continues the episode numbers and starts after the last log_time of
the file; its environment has the same id, arguments, spaces, names and step duration. A recording
can continue in further files, `NAME-00000.mcap`, `NAME-00001.mcap` and so on: each is a log of
whole episodes, and episode numbers and times continue from one file to the next.
"""

from __future__ import annotations

import json
import math
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Any, NoReturn, Protocol

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError
from mcaprl.recorder.columns.cdr import ENCAPSULATION
from mcaprl.recorder.columns.output import HoldSignals
from mcaprl.recorder.columns.writer import McapWriter
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.behavior import PROBABILITY, behavior_field
from mcaprl.recorder.format.infos import INFO_TOPICS, is_exact, shape_of
from mcaprl.recorder.format.messages import TEXT_TYPE, EpisodeSummary, begin_line, text_message
from mcaprl.recorder.format.metadata import METADATA_NAME, SAME_WHEN_APPENDED, LogMetadata, same_env
from mcaprl.recorder.format.schema import (
    EPISODE_TOPIC,
    IMAGES_PER_CHUNK,
    LEARNER_TEXT,
    LEARNER_TOPIC,
    LEARNER_TYPE,
    LOG_TOPIC,
    PHASE_TOPIC,
    RUNNING,
    STEP_TOPIC,
    STEPS_PER_CHUNK,
    ImageRows,
    StepRows,
    TopicRows,
    earlier_step_schemas,
    step_schema,
    values_schema,
)
from mcaprl.recorder.format.spaces import action_leaf, observation_leaves
from mcaprl.texts import encodable, shortened

Message = tuple[int, int, bytes]  # Channel id, log_time and data of a message


class MessageSink(Protocol):
    """Receiver of a log's topics and messages: a file, or viewers of a running environment."""

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Store the metadata of the log."""

    def add_channel(
        self, topic: str, schema_name: str, schema_text: str, metadata: dict[str, str] | None = None
    ) -> int:
        """Announce a topic and return its channel id."""

    def write_rows(self, rows: NDArray[Any]) -> None:
        """Write message records of one channel."""

    def write_messages(self, messages: Sequence[Message]) -> None:
        """Write messages, each with its channel id and log_time."""


class LogTopics:
    """Topics of a log, which are announced and written to a sink."""

    # Whether starts and ends of episodes are written to `/rosout`; not beside a robot's own lines.
    adds_lines = True

    def __init__(
        self, metadata: LogMetadata, sink: MessageSink, *, names_actions: bool = True
    ) -> None:
        """Announce the topics that every log has."""
        leaves = observation_leaves(metadata.observation_space)
        self.metadata, self.sink = metadata, sink
        self.action = action_leaf(metadata.action_space)  # Shape and dtype of an action
        # Meaning of the behavior column of `/rl/step`.
        self.behavior = behavior_field(metadata.action_space)
        self.image_leaves = tuple(leaf for leaf in leaves if leaf.encoding is not None)
        strings = metadata.to_strings()
        self._action_names = metadata.action_names() if names_actions else {}
        labels = metadata.action_labels() if names_actions else ()
        spaces = (metadata.observation_space, metadata.action_space)
        name, self._step_text = step_schema(*spaces, self._action_names, labels)
        sink.add_metadata(METADATA_NAME, strings)
        self._step_channel = sink.add_channel(STEP_TOPIC, name, self._step_text, strings)
        self._episode_channel = self.add_channel(EPISODE_TOPIC, messages.EPISODE_TYPE)
        self._line_channels: list[int | None] | None = None

    def add_channel(self, topic: str, type_name: str) -> int:
        """Announce a topic of a known ROS type and return its channel id."""
        return self.sink.add_channel(topic, type_name, messages.definition(type_name))

    def step_rows(self, most: int = STEPS_PER_CHUNK) -> StepRows:
        """Preallocate `most` rows of `/rl/step`, or as many as fit into one chunk."""
        return StepRows.of_text(self._step_text, self._step_channel, most, self.sink.write_rows)

    def learner_rows(self, most: int = STEPS_PER_CHUNK) -> TopicRows:
        """Announce `/rl/learner` and preallocate its rows."""
        channel = self.sink.add_channel(LEARNER_TOPIC, LEARNER_TYPE, LEARNER_TEXT)
        return TopicRows.of_text(LEARNER_TEXT, channel, most, self.sink.write_rows)

    def values_rows(self, topic: str, most: int = STEPS_PER_CHUNK) -> TopicRows:
        """Announce a topic with the message type of `values_schema`, and preallocate its rows."""
        name, text = values_schema(self.metadata.action_space, self._action_names)
        channel = self.sink.add_channel(topic, name, text)
        return TopicRows.of_text(text, channel, most, self.sink.write_rows)

    def image_rows(
        self, topic: str, shape: tuple[int, ...], encoding: str | None, most: int = IMAGES_PER_CHUNK
    ) -> ImageRows:
        """Announce a topic of images and preallocate its rows."""
        assert encoding is not None, f"{topic} has no images"
        channel = self.add_channel(topic, "sensor_msgs/msg/Image")
        return ImageRows.of_shape(shape, encoding, channel, most, self.sink.write_rows)

    def write_episodes(self, summaries: list[EpisodeSummary], *, log_lines: bool = False) -> None:
        """Write summaries to `/rl/episode`; the log_time of each is the end of its episode."""
        written = [
            (self._episode_channel, summary.end_time_ns, summary.to_message())
            for summary in summaries
        ]
        self.sink.write_messages(written + (self._lines(summaries) if log_lines else []))

    def write_log_lines(self, summaries: list[EpisodeSummary]) -> None:
        """Write starts and ends of episodes to `/rosout` and `/rl/phase`, but not `/rl/episode`."""
        self.sink.write_messages(self._lines(summaries))

    def begin_messages(self, episode: int, policy: str, time_ns: int) -> list[Message]:
        """Return the messages of `/rosout` and `/rl/phase` at an episode's start."""
        return self._line(time_ns, begin_line(episode, policy), RUNNING)

    def end_messages(self, summary: EpisodeSummary) -> list[Message]:
        """Return the messages of `/rosout` and `/rl/phase` at an episode's end."""
        level = messages.WARN if self.metadata.is_failure(summary.reason) else messages.INFO
        return self._line(summary.end_time_ns, summary.end_line(), summary.reason, level)

    def _lines(self, summaries: list[EpisodeSummary]) -> list[Message]:
        return [
            message
            for summary in summaries
            for message in (
                *self.begin_messages(summary.episode, summary.policy, summary.start_time_ns),
                *self.end_messages(summary),
            )
        ]

    def _line(
        self, time_ns: int, text: str, phase: str, level: int = messages.INFO
    ) -> list[Message]:
        if self._line_channels is None:
            log = self.add_channel(LOG_TOPIC, messages.LOG_TYPE) if self.adds_lines else None
            self._line_channels = [log, self.add_channel(PHASE_TOPIC, messages.TEXT_TYPE)]
        data = messages.log_message(time_ns, text, level), messages.text_message(phase)
        pairs = zip(self._line_channels, data, strict=True)
        return [(channel, time_ns, each) for channel, each in pairs if channel is not None]


class LogWriter(LogTopics):
    """Writer of one log of format version 1."""

    def __init__(
        self,
        path: str | Path,
        metadata: LogMetadata,
        *,
        compression: str = "zstd",
        overwrite: bool = False,
        append: bool = False,
        source: Path | None = None,
    ) -> None:
        """Create the file, or open it to append, and announce its topics."""
        strings = metadata.to_strings()
        # Raise SpaceError before a file is created.
        both = metadata.observation_space, metadata.action_space
        plain_name, other_name = (name for name, _ in earlier_step_schemas(*both))
        with ExitStack() as at_error:
            # An interruption must not leave a file without topics, which readers refuse. With
            # `source`, signals are not delayed, because copying it may take long.
            with HoldSignals() if source is None else nullcontext():
                # Writer of the file; the same object as `sink`.
                self.mcap = McapWriter(
                    path, compression=compression, overwrite=overwrite, append=append, source=source
                )
                at_error.callback(self.mcap.close)
                if self.mcap.untouched:
                    self._check_same(strings)
                # The schemas of older logs do not contain the action names. Such logs are continued
                # without these names.
                names = {schema.name for schema in self.mcap.schemas.values()}
                is_plain = plain_name in names
                if other_name in names and not is_plain:
                    self._refuse(f"an earlier version recorded its {PROBABILITY.name} of floats")
                super().__init__(metadata, self.mcap, names_actions=not is_plain)
            at_error.pop_all()

    def _check_same(self, strings: dict[str, str]) -> None:
        """Raise LogError if the existing log was recorded from another environment."""
        found = self.mcap.metadata(METADATA_NAME) or {}
        for name in SAME_WHEN_APPENDED:
            here, there = (one.get(name, "not known") for one in (strings, found))
            same = same_env(here, there) if name == "env_id" else here == there
            if not same:
                self._refuse(f"its {name} is {there:.200}, but the recording has {here:.200}")

    def _refuse(self, reason: str) -> NoReturn:
        self.mcap.abandon()
        raise LogError(f"{self.mcap.path} cannot be appended to: {reason}; record to another file")

    def close(self) -> None:
        """Write the summary section and close the file. Closing twice is harmless."""
        self.mcap.close()


_TYPES = {
    **{np.dtype(f"{u}int{bits}"): f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64)},
    np.dtype(np.float32): "float32",
    np.dtype(np.float64): "float64",
    np.dtype(np.bool_): "bool",
}
"""ROS type of each dtype."""
_DTYPES = {"string": np.dtype(np.str_), **{kind: dtype for dtype, kind in _TYPES.items()}}
_ENCAPSULATION = int(ENCAPSULATION).to_bytes(4, "little")
_CHUNK_BYTES = 2**20


def flat_infos(info: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the entries of an info dict and of its nested dicts, with dotted names."""
    for key, value in info.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from flat_infos(value, f"{name}.")
        else:
            yield name, value


def info_array(values: Sequence[Any] | NDArray[Any]) -> NDArray[Any] | None:
    """Return values of one info as an array (K, *shape); None if a log cannot store them."""
    try:
        found = np.array(values)
        found = found.astype(found.dtype.newbyteorder("="), copy=False)
        # If the types are mixed, NumPy would convert numbers to text, and bools to numbers.
        if len({(type(value), np.asarray(value).dtype) for value in values}) > 1 and not all(
            is_exact(np.asarray(one), np.asarray(value))
            for one, value in zip(found, values, strict=True)
        ):
            return None
    except (ValueError, OverflowError):
        return None
    if found.dtype.kind == "U":
        return found if found.ndim == 1 else None
    # ROS message definitions cannot have arrays of length 0.
    return found if found.dtype in _TYPES and (found.size or not len(found)) else None


class InfoTopics:
    """Writer of infos, whose topics are created with the first value, or are those of the log."""

    def __init__(self, log: LogWriter) -> None:
        """Find the infos that the log already has."""
        self._log = log
        self._channels = _channels_of(log)
        self._topics = {one.topic for one in log.mcap.channels.values()}
        # Names of the infos that were not written, with the reason.
        self.refused: dict[str, str] = {}
        self.warned: set[str] = set()  # Names of the infos for which a warning was given

    def write(self, infos: Mapping[str, tuple[Sequence[int], NDArray[Any]]]) -> None:
        """Write the log_times (K,) and values (K, *shape) of each info, given by name."""
        # Values of another type than the info's first one are not written, but noted in `refused`.
        messages: list[Message] = []
        for name, (times_ns, values) in infos.items():
            if name not in self._channels:
                self._announce(name, values)
            channel, dtype, shape = self._channels[name]
            if values.dtype.kind == "U" and dtype.kind == "U":
                data = [text_message(encodable(str(value))) for value in values]
            elif values.shape[1:] == shape and _fits(values, dtype):
                data = [_ENCAPSULATION + value.tobytes() for value in values.astype(dtype)]
            else:
                self.refused[name] = (
                    f"its values are {_described(values.dtype, values.shape[1:])}, but earlier"
                    f" values are {_described(dtype, shape)}"
                )
                continue
            messages += [(channel, time, each) for time, each in zip(times_ns, data, strict=True)]
        messages.sort(key=lambda message: message[1])
        self._write_chunks(messages)

    def _write_chunks(self, messages: Sequence[Message]) -> None:
        """Write messages in chunks of about 1 MiB, because the size of a chunk is limited."""
        chunk: list[Message] = []
        size = 0
        for message in messages:
            chunk.append(message)
            size += len(message[2])
            if size > _CHUNK_BYTES:
                self._log.sink.write_messages(chunk)
                chunk, size = [], 0
        self._log.sink.write_messages(chunk)

    def _announce(self, name: str, values: NDArray[Any]) -> None:
        dtype, shape = values.dtype, values.shape[1:]
        topic = INFO_TOPICS + re.sub(r"[^A-Za-z0-9_.]", "_", name).replace(".", "/")
        if not re.fullmatch(r"\w+(\.\w+)*", name, re.ASCII):
            # The CRC distinguishes names that differ only in characters replaced by `_`.
            topic += f"_{zlib.crc32(encodable(name).encode()):08x}"
        while topic in self._topics:
            topic += "_"
        self._topics.add(topic)
        metadata = {"info": encodable(name), "shape": json.dumps(shape)}
        type_name, text = _definition(dtype, shape)
        channel = self._log.sink.add_channel(topic, type_name, text, metadata)
        self._channels[name] = channel, dtype, shape


def _definition(dtype: np.dtype[Any], shape: tuple[int, ...]) -> tuple[str, str]:
    """Return the name and the definition of an info's message type."""
    if dtype.kind == "U":
        return TEXT_TYPE, "string data"
    kind = _TYPES[dtype]
    if not shape:
        name = {"uint": "UInt", "int": "Int", "float": "Float", "bool": "Bool"}
        word = kind.rstrip("0123456789")
        return f"std_msgs/msg/{name[word]}{kind.removeprefix(word)}", f"{kind} data"
    sizes = "".join(f"x{size}" for size in shape)
    return f"mcaprl_msgs/msg/Info{kind.capitalize()}{sizes}", f"{kind}[{math.prod(shape)}] data"


def _channels_of(log: LogWriter) -> dict[str, tuple[int, np.dtype[Any], tuple[int, ...]]]:
    """Return the channel, the dtype and the shape of each info that a log has, by name."""
    found = {}
    for channel in log.mcap.channels.values():
        if channel.topic.startswith(INFO_TOPICS) and "info" in channel.metadata:
            schema = log.mcap.schemas.get(channel.schema_id)
            text = schema.data.decode(errors="replace") if schema else ""
            kind = text.lstrip().partition(" ")[0].partition("[")[0]
            if kind not in _DTYPES:
                raise CorruptLogError(f"{channel.topic}: {shortened(kind, 40)!r} is not an info")
            shape = shape_of(channel.metadata.get("shape", "[]"), channel.topic)
            found[channel.metadata["info"]] = (channel.id, _DTYPES[kind], shape)
    return found


def _described(dtype: np.dtype[Any], shape: tuple[int, ...]) -> str:
    kind = "text" if dtype.kind == "U" else dtype.name
    return f"{kind} of shape {shape}" if shape else kind


def _fits(values: NDArray[Any], dtype: np.dtype[Any]) -> bool:
    """Return whether values can be stored in this dtype without changing them."""
    if "U" in (values.dtype.kind, dtype.kind):
        return False
    with np.errstate(all="ignore"):
        return is_exact(values.astype(dtype), values)
