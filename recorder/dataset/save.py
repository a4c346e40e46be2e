"""Writer of a dataset as one log."""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError
from mcaprl.files import replacing
from mcaprl.recorder.dataset.arrays import with_fresh_times
from mcaprl.recorder.dataset.images import Frames
from mcaprl.recorder.dataset.packets import Packets
from mcaprl.recorder.dataset.transitions import Transitions, ranges
from mcaprl.recorder.format.log_writer import InfoTopics, LogWriter, Message, info_array
from mcaprl.recorder.format.metadata import NO_TIMES, LogMetadata
from mcaprl.recorder.format.schema import (
    BYTES_PER_CHUNK,
    LOG_TOPIC,
    RETURN_SO_FAR,
    STEPS_PER_CHUNK,
    TELEMETRY_TOPIC,
    TopicRows,
    shortened,
    telemetry_schema,
)
from mcaprl.recorder.format.spaces import Leaf, observation_leaves
from mcaprl.recorder.format.video_messages import VIDEO_TEXT, VIDEO_TYPE, video_message
from mcaprl.recorder.format.writing import McapWriter


def save_log(
    path: str | Path,
    columns: Transitions,
    metadata: LogMetadata,
    *,
    compression: str = "zstd",
    overwrite: bool = False,
    add_topics: Callable[[McapWriter], None] | None = None,
    telemetry: tuple[NDArray[np.int64], Mapping[str, NDArray[np.float32]]] | None = None,
) -> None:
    """Write columns as a log; `add_topics` writes other topics beside them.

    `telemetry` has log_times, and the columns of `/telemetry` at these times, which are written
    where they are those of frames.

    If the data has no times, or if they do not increase from frame to frame, they are replaced by
    times that start at the current time. Episodes are numbered from 0.
    """
    if not columns.episodes:
        raise LogError(f"nothing to write to {path}: the dataset has no episodes")
    frames_ns = columns.log_time_ns
    if metadata.times == NO_TIMES or (np.diff(columns.log_time_ns) <= 0).any():
        if add_topics is not None:
            raise LogError(
                f"{path}: the topics of the bag cannot be kept, because the episodes are in another"
                " order: keep none, or sort the episodes"
            )
        columns = with_fresh_times(columns, time.time_ns(), metadata.step_duration_ns)
        metadata = dataclasses.replace(metadata, times="")
    if columns.log_time_ns[0] < 0:
        raise LogError(
            f"{path}: the first time is {columns.log_time_ns[0]} ns; a log cannot have times before"
            " 1970: correct the times, or use another `time` in the mapping"
        )
    path = Path(path)
    # The old log is replaced at the end, because images of the dataset may be read from it.
    with replacing(path, LogError, overwrite=overwrite) as unfinished:
        log = LogWriter(unfinished, metadata, compression=compression)
        try:
            if add_topics is not None:
                add_topics(log.mcap)
            log.adds_lines = LOG_TOPIC not in {each.topic for each in log.mcap.channels.values()}
            _write_images(path, log, columns)
            _write_infos(path, log, columns)
            summaries = [e._replace(episode=k) for k, e in enumerate(columns.episodes)]
            log.write_episodes(summaries, log_lines=True)
            _write_steps(log, columns)
            if telemetry is not None:
                _write_telemetry(log, columns, frames_ns, *telemetry)
            log.close()
        finally:
            log.mcap.abandon()


def _write_images(path: Path, log: LogWriter, columns: Transitions) -> None:
    for k, (leaf, frames) in enumerate(_leaves(log, columns)):
        packets = columns.packets.get(k)
        if packets is not None and packets.in_logs and _copied(path, log, columns, leaf, packets):
            continue
        if leaf.encoding is not None:
            rows = log.image_rows(leaf.topic, leaf.shape, leaf.encoding)
            rows.write_columns(columns.log_time_ns, {"data": frames})


def _copied(path: Path, log: LogWriter, columns: Transitions, leaf: Leaf, packets: Packets) -> bool:
    """Write the packets of a video instead of images; warn if they cannot be copied."""
    firsts, stops = columns.first_frames, columns.first_frames + columns.lengths + 1
    # A last observation that repeats the one before it has no packet.
    stops = stops - (packets.places[stops - 1] == packets.places[stops - 2]).all(axis=1)
    codec, lack = packets.codec([slice(*ends) for ends in np.stack([firsts, stops], 1).tolist()])
    if not codec:
        warnings.warn(
            f"{path}: {leaf.topic} has images, not the packets of their video: {lack}",
            stacklevel=5,
        )
        return False
    channel = log.sink.add_channel(leaf.topic, VIDEO_TYPE, VIDEO_TEXT)
    frames = ranges(firsts, stops - firsts)
    messages, size = list[Message](), 0
    times = columns.log_time_ns[frames].tolist()
    for time_ns, (kind, data) in zip(times, packets.read(frames), strict=True):
        messages.append((channel, time_ns, video_message(time_ns, kind, data)))
        size += len(data)
        if size > BYTES_PER_CHUNK:
            log.sink.write_messages(messages)
            messages, size = [], 0
    log.sink.write_messages(messages)
    return True


def _write_infos(path: Path, log: LogWriter, columns: Transitions) -> None:
    """Write the infos in parts, each of which is one chunk."""
    topics = InfoTopics(log)
    for first in range(0, len(columns.log_time_ns) if columns.infos else 0, STEPS_PER_CHUNK):
        rows = slice(first, first + STEPS_PER_CHUNK)
        part = {}
        for name, info in columns.infos.items():
            mask = np.ma.getmaskarray(info[rows]).reshape(len(info[rows]), -1)
            present = ~mask.any(axis=1)
            values = info_array(np.ma.getdata(info[rows])[present])
            if values is None or (mask.any(axis=1) != mask.all(axis=1)).any():
                what = f"{info.dtype} of shape {info.shape[1:]}"
                what += ", with rows that are partly masked" if values is not None else ""
                raise SpaceError(f"{path}: a log cannot store the info '{name}': {what}")
            if len(values):
                part[name] = (columns.log_time_ns[rows][present].tolist(), values)
        topics.write(part)


def _write_steps(log: LogWriter, columns: Transitions) -> None:
    """Write the rows of `/rl/step` chunk by chunk."""
    count = len(columns.log_time_ns)
    firsts, finals = columns.first_frames, columns.first_frames + columns.lengths
    transitions = {
        "action": columns.actions,
        "reward": columns.rewards,
        log.behavior.name: columns.behavior,
        "terminated": columns.terminated,
        "truncated": columns.truncated,
    }
    vectors = [(leaf.name, part) for leaf, part in _leaves(log, columns) if leaf.encoding is None]
    rows = log.step_rows()
    for start in range(0, count, len(rows)):
        frames = slice(start, min(start + len(rows), count))
        # The episodes from `low` to `high` have frames in this chunk.
        low, high = int(np.searchsorted(finals, start)), int(np.searchsorted(firsts, frames.stop))
        stops = np.minimum(finals[low:high] + 1, frames.stop)
        episode = np.repeat(np.arange(low, high), stops - np.maximum(firsts[low:high], start))
        where = slice(frames.stop - start)
        rows.number(where, episode, np.arange(start, frames.stop) - firsts[episode])
        for name, values in vectors:
            rows.put(name, where, values[frames])
        ends = finals[low:high][finals[low:high] < frames.stop] - start
        # With a mask, NumPy copies whole runs of rows.
        has_transition = np.arange(len(rows)) < where.stop
        has_transition[ends] = False
        # Each episode before `low` has one frame more than it has transitions.
        steps = slice(start - low, frames.stop - low - len(ends))
        for name, values in transitions.items():
            rows.put(name, has_transition, values[steps])
        rows.finish(ends)
        rows.write(where, columns.log_time_ns[frames])


def _write_telemetry(
    log: LogWriter,
    columns: Transitions,
    frames_ns: NDArray[np.int64],
    times_ns: NDArray[np.int64],
    found: Mapping[str, NDArray[np.float32]],
) -> None:
    """Write numbers to plot, and the return so far, at the frames with these times."""
    rows = np.minimum(np.searchsorted(times_ns, frames_ns), len(times_ns) - 1)
    frames = np.flatnonzero(times_ns[rows] == frames_ns)
    topics = {channel.topic for channel in log.mcap.channels.values()}
    if not len(frames) or TELEMETRY_TOPIC in topics:
        return
    parts = np.split(columns.rewards, columns.first_steps[1:])
    returns = np.concatenate([np.append(0.0, np.cumsum(part)) for part in parts])
    name, text = telemetry_schema([RETURN_SO_FAR, *found])
    channel = log.sink.add_channel(TELEMETRY_TOPIC, name, text)
    shown = {RETURN_SO_FAR: returns[frames]}
    shown |= {name: column[rows[frames]] for name, column in found.items()}
    TopicRows.of_text(text, channel, STEPS_PER_CHUNK, log.sink.write_rows).write_columns(
        columns.log_time_ns[frames], {name: shortened(each) for name, each in shown.items()}
    )


def _leaves(log: LogWriter, columns: Transitions) -> Iterable[tuple[Leaf, Frames]]:
    return zip(observation_leaves(log.metadata.observation_space), columns.frames, strict=True)
