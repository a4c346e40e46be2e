"""Reads logs of format version 1 into a Dataset: file -> chunks -> columns -> transitions."""

from __future__ import annotations

import glob
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError, NoStepsError, SpaceError
from mcaprl.recorder import messages
from mcaprl.recorder.dataset import Dataset
from mcaprl.recorder.log_writer import EPISODE_TOPIC, STEP_TOPIC, EpisodeSummary
from mcaprl.recorder.mcap_reader import McapReader
from mcaprl.recorder.metadata import METADATA_NAME, LogMetadata
from mcaprl.recorder.rows import add_up
from mcaprl.recorder.schema import image_dtype, is_intact, message_dtype
from mcaprl.recorder.spaces import Leaf, action_leaf, observation_leaves
from mcaprl.recorder.transitions import Transitions

REQUIRED_FIELDS = (
    "reward",
    "action",
    "behavior_prob",
    "episode",
    "step",
    "terminated",
    "truncated",
    "final",
)


def open_logs(data: str | Path | Sequence[str | Path]) -> Dataset:
    """Read logs into memory.

    All chunks read are checked against their CRCs. A log that was cut off, or is still being
    written, gives its finished episodes and a warning.

    Args:
        data: a file, a folder of `.mcap` files, a glob, or a sequence of these. Logs of one call
            must have the same spaces; their episodes follow each other in the order of the files.

    Raises:
        LogError: a file is missing, no MCAP, damaged, or has no finished episode.
        SpaceError: the logs' spaces differ.
    """
    return Dataset.concatenate([read_log(path) for path in find_logs(data)])


def find_logs(data: str | Path | Sequence[str | Path]) -> list[Path]:
    """The files that `data` means: see `open_logs`; sorted within a folder or glob.

    Raises:
        LogError: there are none.
    """
    if not isinstance(data, str | Path):
        every = [path for part in data for path in find_logs(part)]
        # A file that is meant twice counts once.
        return list({path.resolve(): path for path in every}.values())
    path = Path(data)
    if path.is_dir():
        found = sorted(path.glob("*.mcap"))
        if not found:
            raise LogError(f"{path} has no .mcap files")
        return found
    if path.exists():
        return [path]
    found = sorted(Path(name) for name in glob.glob(str(data)))
    if not found:
        raise LogError(f"{data}: no such file, folder or match")
    return found


def read_log(path: Path) -> Dataset:
    """Read one file. Raises as `open_logs` does."""
    reader = McapReader(path)
    metadata, steps = describe(reader)
    columns = _step_columns(reader, steps)
    lengths = _episode_lengths(columns, path)
    if not len(lengths):
        raise NoStepsError(f"{path} has no finished episode")
    frames = int(lengths.sum()) + len(lengths)
    if frames < len(columns["final"]) or not reader.complete:
        warnings.warn(
            f"{path} was cut off or is still being written: {len(lengths)} finished episodes are"
            f" read, {len(columns['final']) - frames} records behind them are not",
            stacklevel=3,
        )
    columns = {name: column[:frames] for name, column in columns.items()}
    transitions = _transitions(reader, metadata, columns, lengths)
    return Dataset(transitions, metadata, sources=(path,))


def describe(reader: McapReader) -> tuple[LogMetadata, Channel]:
    """The metadata of a log and the channel of its steps.

    Raises:
        NoStepsError: the file has none.
        LogError: its metadata is of a later version, or damaged.
    """
    steps = reader.channel_of(STEP_TOPIC)
    if steps is None:
        topics = ", ".join(sorted(channel.topic for channel in reader.channels.values())) or "none"
        raise NoStepsError(
            f"{reader.path} has no topic {STEP_TOPIC}, so no transitions (topics: {topics})"
        )
    # The channel's copy stands in the summary, too, under its CRC.
    copy = steps.metadata if "format_version" in steps.metadata else {}
    strings = copy or reader.metadata.get(METADATA_NAME, {})
    if reader.metadata.get(METADATA_NAME, strings) != strings:
        raise CorruptLogError(
            f"{reader.path}: the metadata record and the metadata of {STEP_TOPIC} differ"
        )
    try:
        return LogMetadata.from_strings(strings), steps
    except (LogError, SpaceError) as error:
        raise LogError(f"{reader.path}: {error}") from error


def _step_columns(reader: McapReader, channel: Channel) -> dict[str, NDArray[Any]]:
    """All records of `/rl/step`, one array per field, and `log_time`."""
    schema = reader.schema_of(channel)
    if not is_intact(schema.name, schema.data):
        raise CorruptLogError(f"{reader.path}: the schema of {channel.topic} is damaged")
    payload = message_dtype(schema.data.decode(errors="replace"))
    if payload is None:
        raise LogError(f"{reader.path}: messages of {channel.topic} have no fixed length")
    missing = [name for name in REQUIRED_FIELDS if name not in (payload.names or ())]
    if missing:
        raise LogError(f"{reader.path}: {channel.topic} has no field {', '.join(missing)}")
    count = reader.count(channel)
    columns = {
        name: np.empty((count, *payload[name].shape), payload[name].base)
        for name in payload.names or ()
    }
    columns["log_time"] = np.empty(count, np.int64)
    start = 0
    for rows in reader.rows(channel, payload):
        stop = start + len(rows)
        for name in payload.names or ():
            columns[name][start:stop] = rows["payload"][name]
        columns["log_time"][start:stop] = rows["log_time"]
        start = stop
    return columns


def _episode_lengths(columns: dict[str, NDArray[Any]], path: Path) -> NDArray[np.int64]:
    """Transitions of each finished episode.

    Raises:
        CorruptLogError: records are missing, doubled or out of order.
    """
    finals = np.flatnonzero(columns["final"])
    if not len(finals):
        return np.empty(0, np.int64)
    frames = np.diff(finals, prepend=-1)
    starts = finals - frames + 1
    read = int(finals[-1]) + 1
    in_order = columns["step"][:read] == np.arange(read) - np.repeat(starts, frames)
    in_order &= columns["episode"][:read] == np.repeat(columns["episode"][starts], frames)
    in_order[1:] &= np.diff(columns["log_time"][:read]) > 0
    # An end is the last transition's, which stands before the final record.
    ends = (columns["terminated"][:read] | columns["truncated"][:read]).astype(bool)
    in_order[:-1] &= ~ends[:-1] | columns["final"][1:read].astype(bool)
    if not in_order.all():
        row = int(np.argmin(in_order))
        raise CorruptLogError(
            f"{path}: record {row} of {STEP_TOPIC} (episode {columns['episode'][row]}, step"
            f" {columns['step'][row]}) is out of order:"
            " records are missing or doubled, or an episode goes on after its end"
        )
    return frames - 1


def _transitions(
    reader: McapReader,
    metadata: LogMetadata,
    columns: dict[str, NDArray[Any]],
    lengths: NDArray[np.int64],
) -> Transitions:
    actual = ~columns["final"].astype(bool)
    times = columns["log_time"]
    action = action_leaf(metadata.action_space)
    leaves = observation_leaves(metadata.observation_space)
    try:
        frames = tuple(
            _images(reader, leaf, times) if leaf.encoding else _as_leaf(columns[leaf.name], leaf)
            for leaf in leaves
        )
        return Transitions(
            frames=frames,
            log_time_ns=times,
            actions=_as_leaf(columns["action"][actual], action),
            rewards=columns["reward"][actual],
            terminated=columns["terminated"][actual].astype(bool),
            truncated=columns["truncated"][actual].astype(bool),
            behavior_probs=columns["behavior_prob"][actual],
            episodes=_episodes(reader, columns, lengths),
        )
    except (KeyError, ValueError) as error:
        raise CorruptLogError(
            f"{reader.path}: {STEP_TOPIC} does not fit the spaces in the metadata ({error})"
        ) from error


def _as_leaf(column: NDArray[Any], leaf: Leaf) -> NDArray[Any]:
    """A field's column with the shape and dtype of its leaf."""
    return column.reshape(len(column), *leaf.shape).astype(leaf.dtype, copy=False)


def _images(reader: McapReader, leaf: Leaf, times: NDArray[np.int64]) -> NDArray[Any]:
    """(F, *shape) pictures of an image leaf, one for each of `times`.

    Raises:
        CorruptLogError: one is missing, or is of another size or encoding.
    """
    channel = reader.channel_of(leaf.topic)
    first = next(reader.messages(channel), None) if channel is not None else None
    if channel is None or first is None:
        raise CorruptLogError(f"{reader.path}: no images on {leaf.topic}")
    example = messages.decode(first[1], "sensor_msgs/msg/Image")
    height, width, channels = (*leaf.shape, 1)[:3]
    if (example.height, example.width, example.encoding) != (height, width, leaf.encoding):
        raise CorruptLogError(
            f"{reader.path}: images on {leaf.topic} are {example.height}x{example.width}"
            f" {example.encoding}; the space says {height}x{width} {leaf.encoding}"
        )
    payload = image_dtype(height, width, channels, example.encoding, example.header.frame_id)
    pictures = np.empty((len(times), *leaf.shape), np.uint8)
    start = 0
    for rows in reader.rows(channel, payload):
        rows = rows[: len(times) - start]
        stop = start + len(rows)
        sizes = rows["payload"]["height"], rows["payload"]["width"], rows["payload"]["data_length"]
        regular = all(
            (a == b).all() for a, b in zip(sizes, (height, width, leaf.size), strict=True)
        )
        if not regular or (rows["log_time"].astype(np.int64) != times[start:stop]).any():
            raise CorruptLogError(
                f"{reader.path}: the images on {leaf.topic} and the records of {STEP_TOPIC}"
                " do not have the same times or sizes"
            )
        pictures[start:stop] = rows["payload"]["data"].reshape(-1, *leaf.shape)
        start = stop
    if start < len(times):
        raise CorruptLogError(f"{reader.path}: {len(times) - start} images of {leaf.topic} missing")
    return pictures


def _episodes(
    reader: McapReader, columns: dict[str, NDArray[Any]], lengths: NDArray[np.int64]
) -> tuple[EpisodeSummary, ...]:
    """What is told of each episode; one that `/rl/episode` leaves out is told by its records."""
    # By the time of their last record: appended recordings count from 0 again.
    told: dict[int, EpisodeSummary] = {}
    channel = reader.channel_of(EPISODE_TOPIC)
    if channel is not None:
        for _, data in reader.messages(channel):
            summary = EpisodeSummary.from_message(messages.decode(data, messages.EPISODE_TYPE))
            told[summary.end_time_ns] = summary
    finals = np.flatnonzero(columns["final"])
    episodes = []
    for final, length in zip(finals.tolist(), lengths.tolist(), strict=True):
        number = int(columns["episode"][final])
        found = told.get(int(columns["log_time"][final]))
        if found is None:
            found = _summary_of_records(columns, final, length)
        elif found.length != length:
            raise CorruptLogError(
                f"{reader.path}: {EPISODE_TOPIC} gives episode {number} {found.length} steps,"
                f" {STEP_TOPIC} has {length}"
            )
        episodes.append(found)
    return tuple(episodes)


def _summary_of_records(
    columns: dict[str, NDArray[Any]], final: int, length: int
) -> EpisodeSummary:
    first = final - length
    last = max(final - 1, first)
    return EpisodeSummary(
        episode=int(columns["episode"][final]),
        length=length,
        total_reward=add_up(columns["reward"][first:final]),
        terminated=bool(columns["terminated"][last]),
        truncated=bool(columns["truncated"][last]),
        start_time_ns=int(columns["log_time"][first]),
        end_time_ns=int(columns["log_time"][final]),
    )
