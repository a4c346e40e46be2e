"""Leaves out of a log whatever is not of a whole episode.

A run is as many records of `/rl/step` as follow each other without a gap. One that begins with
step 0 and ends with a final record is a whole episode. One that only begins so was not finished, or
its end was lost; it can be ended where it stops. Of any other run the beginning is lost.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np
from mcap.records import Channel, Metadata, Schema
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.dataset.log_reader import described
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.episode_summary import INTERRUPTED, EpisodeSummary, add_up
from mcaprl.recorder.format.metadata import METADATA_NAME
from mcaprl.recorder.format.reading import (
    LOG_TIME,
    MESSAGE_HEADER,
    Columns,
    McapReader,
    Topic,
    contents_of,
    only,
)
from mcaprl.recorder.format.rows import make_final
from mcaprl.recorder.format.schema import message_dtype
from mcaprl.recorder.format.spaces import observation_leaves
from mcaprl.recorder.format.topics import EPISODE_TOPIC, STEP_TOPIC
from mcaprl.recorder.format.writing import McapWriter, what_is_written

_FIELDS = ("reward", "episode", "step", "terminated", "truncated", "final")
# Topics that tell of episodes; the others are kept as they are.
_OF_EPISODES = "/rl/"

Place = tuple[int, int]
"""Where messages stand together: offset of their chunk, id of their channel."""


class Fate(IntEnum):
    """What becomes of a record of `/rl/step`."""

    DROP = 0
    KEEP = 1
    # Ends an episode whose own end is missing: a transition, and the observation behind it.
    TRUNCATE = 2
    MAKE_FINAL = 3


@dataclass(frozen=True)
class DroppedEpisode:
    """What was there of an episode that is not kept.

    Attributes:
        number: its own, in its log.
        records: of `/rl/step` that were read.
        can_end: whether it could be kept up to its last whole transition.
        why: it is not kept.
    """

    number: int
    records: int
    can_end: bool
    why: str

    def __str__(self) -> str:
        """One phrase."""
        return f"episode {self.number}, of which {self.records} records are there: {self.why}"


@dataclass
class EpisodePlan:
    """What of a log is kept.

    Attributes:
        fates: of the records of `/rl/step`, by their place, in the order of the file.
        spans: (E, 2) first and last log_time of the kept episodes, rising.
        dropped: episodes that are not kept.
        ended: how many are kept without their end.
        told_anew: what is told of those, and of others that nothing tells of any more.
        strays: messages of other topics that belong to no kept episode.
        is_in_order: whether the records are in the order of their times.
    """

    fates: dict[Place, NDArray[np.uint8]] = field(default_factory=dict)
    spans: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 2), np.int64))
    dropped: list[DroppedEpisode] = field(default_factory=list)
    ended: int = 0
    told_anew: list[EpisodeSummary] = field(default_factory=list)
    strays: int = 0
    is_in_order: bool = True

    @property
    def episodes(self) -> int:
        """How many are kept."""
        return len(self.spans)

    @property
    def changes_anything(self) -> bool:
        """Whether the log is not as it should be already."""
        return bool(self.dropped or self.told_anew or self.strays) or not self.is_in_order


def plan_episodes(reader: McapReader, *, keep_unfinished: bool) -> EpisodePlan | None:
    """Find the whole episodes of a log.

    Args:
        reader: of a file that is whole as an MCAP, with all messages in chunks.
        keep_unfinished: keep episodes without their end, if they have a whole transition.

    Returns:
        None if the file has no `/rl/step` of known form, for it is no log then.

    Raises:
        LogError: it is a log, but what says so contradicts the rest.
    """
    steps = Topic(reader, STEP_TOPIC)
    if not len(steps):
        return EpisodePlan() if _is_log(reader) else None
    missing = [name for name in _FIELDS if name not in steps.fields]
    if missing and METADATA_NAME in reader.metadata:
        raise CorruptLogError(f"{STEP_TOPIC} has no field {', '.join(missing)}")
    if missing:
        return None
    order = np.lexsort((steps.times, steps.channel_ids))
    columns = steps.read(_FIELDS, order)
    plan, fates = EpisodePlan(), np.zeros(len(steps), np.uint8)
    plan.is_in_order = bool((np.diff(order) > 0).all())
    told, spans = _told_ends(reader), []
    for run in _runs(reader, columns, steps.channel_ids[order]):
        can_end = run.can_end and all(map(_form, _schemas(reader)))
        if not run.is_whole and not (can_end and keep_unfinished):
            plan.dropped.append(run.dropped(columns, can_end))
            continue
        fates[order[run.start : run.last + 1]] = Fate.KEEP
        if not run.is_whole:
            fates[order[run.last - 1]], fates[order[run.last]] = Fate.TRUNCATE, Fate.MAKE_FINAL
            plan.ended += 1
        spans.append(columns[LOG_TIME][[run.start, run.last]])
        if int(spans[-1][1]) not in told:
            plan.told_anew.append(run.summary(columns))
    plan.spans = np.array(sorted(map(tuple, spans)), np.int64).reshape(-1, 2)
    plan.fates = dict(_by_place(steps, fates))
    plan.strays = _count_strays(reader, plan)
    return plan


def write_planned(reader: McapReader, writer: McapWriter, plan: EpisodePlan) -> None:
    """Write what is kept to another file."""
    standing = what_is_written(reader.path).standing
    for record in sorted(standing, key=lambda record: not isinstance(record, Metadata)):
        writer.announce(record)
    for chunk in sorted(reader.chunks, key=lambda chunk: chunk.message_start_time):
        records = reader.chunk_records(chunk)
        indexes = contents_of(records).indexes
        fates = {
            id_: _fates(plan, (chunk.chunk_start_offset, id_), reader.channels[id_], index)
            for id_, index in indexes.items()
        }
        if all((fate == Fate.KEEP).all() for fate in fates.values()):
            writer.write_records(records, indexes)
        else:
            _write_some(reader, writer, records, indexes, fates)
    if plan.told_anew:
        channel_id = writer.add_channel(
            EPISODE_TOPIC, messages.EPISODE_TYPE, messages.definition(messages.EPISODE_TYPE)
        )
        told = [(s.end_time_ns, s.to_message()) for s in plan.told_anew]
        writer.write_messages([(channel_id, time_ns, data) for time_ns, data in told])


@dataclass(frozen=True)
class _Run:
    """Records that follow each other.

    Attributes:
        start: of the first one.
        last: of the last one that has all its pictures.
        records: how many there are, with pictures or without.
        begins: whether the first one is an episode's.
        is_whole: whether it is an episode, from its first to its final record.
    """

    start: int
    last: int
    records: int
    begins: bool
    is_whole: bool

    @property
    def can_end(self) -> bool:
        """Whether it could be an episode that was broken off behind its last whole transition."""
        return self.begins and not self.is_whole and self.last > self.start

    def dropped(self, columns: Columns, can_end: bool) -> DroppedEpisode:
        """It is not kept."""
        why = "its end is lost, or never was" if self.begins else "its beginning is lost"
        number = int(columns["episode"][self.start])
        return DroppedEpisode(number, self.records, can_end, why)

    def summary(self, columns: Columns) -> EpisodeSummary:
        """As much of the episode as its records tell."""
        start, last = self.start, self.last
        return EpisodeSummary(
            episode=int(columns["episode"][start]),
            length=last - start,
            total_reward=add_up(columns["reward"][start:last].astype(np.float64)),
            terminated=bool(columns["terminated"][last - 1]),
            truncated=bool(columns["truncated"][last - 1]) or not self.is_whole,
            start_time_ns=int(columns[LOG_TIME][start]),
            end_time_ns=int(columns[LOG_TIME][last]),
            reason="" if self.is_whole else INTERRUPTED,
        )


def _runs(reader: McapReader, columns: Columns, channel_ids: NDArray[Any]) -> Iterator[_Run]:
    """Records that follow each other, in the order of channels and times."""
    steps, episodes, times = columns["step"], columns["episode"], columns[LOG_TIME]
    follows = (
        (steps[1:] == steps[:-1] + 1)
        & (episodes[1:] == episodes[:-1])
        & (channel_ids[1:] == channel_ids[:-1])
        & (times[1:] > times[:-1])
        & ~columns["final"][:-1].astype(bool)
    )
    shown = _with_images(reader, times)
    starts = [0, *(np.flatnonzero(~follows) + 1).tolist()]
    for start, stop in zip(starts, [*starts[1:], len(steps)], strict=True):
        length = int(np.argmin(np.append(shown[start:stop], False)))
        begins, last = bool(steps[start] == 0), start + length - 1
        is_whole = begins and stop - start == length > 1 and bool(columns["final"][last])
        yield _Run(start, last, stop - start, begins, is_whole)


def _is_log(reader: McapReader) -> bool:
    """Whether a file is, or was, a log: its metadata may be lost, and names of topics, too."""
    ours = (STEP_TOPIC, EPISODE_TOPIC, "/rl/observation/")
    return (
        METADATA_NAME in reader.metadata
        or any(channel.topic.startswith(ours) for channel in reader.channels.values())
        or any(schema.name.startswith("mcaprl_msgs/") for schema in reader.schemas.values())
    )


def _schemas(reader: McapReader) -> list[Schema]:
    return [reader.schema_of(channel) for channel in reader.channels_of(STEP_TOPIC)]


def _form(schema: Schema) -> np.dtype[Any] | None:
    return message_dtype(schema.data.decode(errors="replace"))


def _with_images(reader: McapReader, times: NDArray[np.int64]) -> NDArray[np.bool_]:
    """For which records there is a picture on each topic of image observations."""
    metadata, shown = described(reader), np.ones(len(times), np.bool_)
    for leaf in observation_leaves(metadata.observation_space) if metadata else ():
        if leaf.encoding is not None:
            found, counts = np.unique(Topic(reader, leaf.topic).times, return_counts=True)
            shown &= np.isin(times, found[counts == 1])
    return shown


def _told_ends(reader: McapReader) -> set[int]:
    """Last log_times of the episodes that `/rl/episode` tells of."""
    topic, name = Topic(reader, EPISODE_TOPIC), "end_time_ns"
    return set(topic.read([name])[name].tolist()) if name in topic.fields else set()


def _count_strays(reader: McapReader, plan: EpisodePlan) -> int:
    return sum(
        int((~_is_inside(plan, span.index["log_time"])).sum())
        for channel in reader.channels.values()
        if channel.topic.startswith(_OF_EPISODES) and channel.topic != STEP_TOPIC
        for span in reader.spans(channel)
    )


def _by_place(steps: Topic, fates: NDArray[np.uint8]) -> Iterator[tuple[Place, NDArray[np.uint8]]]:
    start = 0
    for decoder, span in steps.parts:
        stop = start + len(span)
        assert span.chunk is not None, "all messages are in chunks"
        yield (span.chunk.chunk_start_offset, decoder.channel.id), fates[start:stop]
        start = stop


def _fates(
    plan: EpisodePlan, place: Place, channel: Channel, index: NDArray[Any]
) -> NDArray[np.uint8]:
    """What becomes of the messages of one channel in one chunk."""
    if place in plan.fates:
        return plan.fates[place]
    if not channel.topic.startswith(_OF_EPISODES):
        return np.full(len(index), Fate.KEEP, np.uint8)
    inside = _is_inside(plan, index["log_time"])
    return np.where(inside, np.uint8(Fate.KEEP), np.uint8(Fate.DROP))


def _is_inside(plan: EpisodePlan, log_times: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Which times are those of an episode that is kept."""
    if not plan.episodes:
        return np.zeros(len(log_times), np.bool_)
    times = log_times.astype(np.int64)
    span = np.searchsorted(plan.spans[:, 0], times, side="right") - 1
    is_inside: NDArray[np.bool_] = (span >= 0) & (times <= plan.spans[np.maximum(span, 0), 1])
    return is_inside


def _write_some(
    reader: McapReader,
    writer: McapWriter,
    records: memoryview,
    indexes: dict[int, NDArray[Any]],
    fates: dict[int, NDArray[np.uint8]],
) -> None:
    """Write those messages of a chunk that are not dropped."""
    left = {channel_id: fate[fate != Fate.DROP] for channel_id, fate in fates.items()}
    kept, new_indexes = only(
        records,
        {id_: index[fates[id_] != Fate.DROP] for id_, index in indexes.items() if len(left[id_])},
    )
    for channel_id, index in new_indexes.items():
        for row in np.flatnonzero(left[channel_id] != Fate.KEEP).tolist():
            record = kept[int(index["offset"][row]) :]
            _end_at(record, reader, reader.channels[channel_id], Fate(left[channel_id][row]))
    if new_indexes:
        writer.write_records(kept, new_indexes)


def _end_at(record: memoryview, reader: McapReader, channel: Channel, fate: Fate) -> None:
    """Change a message so that its episode ends there."""
    form = _form(reader.schema_of(channel))
    assert form is not None, "episodes of other forms are not ended"
    message = np.frombuffer(record, form, 1, MESSAGE_HEADER.itemsize)
    if fate == Fate.TRUNCATE:
        message["truncated"] = True
        return
    make_final(message)
