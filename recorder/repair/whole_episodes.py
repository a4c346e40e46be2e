"""Copy of a log without incomplete episodes.

A run is a gapless series of records of `/rl/step`. A whole episode is a run from step 0 to a final
record. If an episode is unfinished or its end is lost, its run begins at step 0 but has no final
record. Such a run can be kept: its last record becomes the final record. All other runs have no
beginning and are dropped.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, ChunkIndex, Metadata, Schema
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.problem import Shortlist
from mcaprl.recorder.dataset.log_reader import described
from mcaprl.recorder.format.episode_summary import INTERRUPTED, EpisodeSummary, add_up
from mcaprl.recorder.format.metadata import METADATA_NAME
from mcaprl.recorder.format.reading import (
    LOG_TIME,
    Columns,
    McapReader,
    Topic,
)
from mcaprl.recorder.format.rows import Part, Shorten
from mcaprl.recorder.format.schema import message_dtype
from mcaprl.recorder.format.selected_copy import Copied, Source, copy_selected, within
from mcaprl.recorder.format.spaces import observation_leaves
from mcaprl.recorder.format.topics import EPISODE_TOPIC, STEP_TOPIC
from mcaprl.recorder.format.writing import finished_state

_FIELDS = ("reward", "episode", "step", "terminated", "truncated", "final")
# Prefix of topics whose messages belong to episodes; other topics are copied unchanged.
_EPISODE_TOPICS = "/rl/"
# If the gap between two episode numbers is larger than this, a new recording is assumed to start.
_MAX_GAP = 10**6

Place = tuple[int, int]
"""Offset of a chunk and id of a channel, which identify a message index."""


@dataclass(frozen=True)
class DroppedEpisode:
    """An episode that is not kept.

    Attributes:
        number: Number of the episode in its log.
        records: Number of the episode's records of `/rl/step` that were read.
        can_end: Whether the episode could be kept up to its last whole transition.
        why: Reason why the episode is dropped.
    """

    number: int
    records: int
    can_end: bool
    why: str

    @property
    def what(self) -> str:
        """Description of the dropped episode: its number and the reason."""
        return f"episode {self.number}: {self.why}{', but it can be kept' if self.can_end else ''}"


@dataclass
class EpisodePlan:
    """Selection of the records to keep.

    Attributes:
        kept: Mask of the records of `/rl/step` in file order, by `Place`.
        spans: (E, 2) first and last log_time of the kept episodes, increasing.
        dropped: Episodes that are not kept.
        ended: Parts of kept episodes whose end is missing, up to their last whole transition.
        new_summaries: Summaries of kept episodes that `/rl/episode` does not contain.
        strays: Number of messages on other `/rl/` topics that do not belong to a kept episode.
        is_in_order: Whether the records are in time order.
    """

    kept: dict[Place, NDArray[np.bool_]] = field(default_factory=dict)
    spans: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 2), np.int64))
    dropped: Shortlist[DroppedEpisode] = field(default_factory=Shortlist)
    ended: list[Part] = field(default_factory=list)
    new_summaries: list[EpisodeSummary] = field(default_factory=list)
    strays: int = 0
    is_in_order: bool = True

    @property
    def episodes(self) -> int:
        """Number of kept episodes."""
        return len(self.spans)

    @property
    def changes_anything(self) -> bool:
        """Whether the copy is different from the log."""
        return bool(self.dropped or self.new_summaries or self.strays) or not self.is_in_order

    def keeps(self, chunk: ChunkIndex, channel: Channel, index: NDArray[Any]) -> NDArray[np.bool_]:
        """Return a mask of the messages of a channel in a chunk that are kept."""
        place = (chunk.chunk_start_offset, channel.id)
        if place in self.kept:
            return self.kept[place]
        if not channel.topic.startswith(_EPISODE_TOPICS):
            return np.ones(len(index), np.bool_)
        return within(self.spans, index["log_time"].astype(np.int64))


def plan_episodes(reader: McapReader, *, keep_unfinished: bool) -> EpisodePlan | None:
    """Find the whole episodes of a log.

    Returns:
        Plan; None if the file is not a log because `/rl/step` or its required fields are missing.
    """
    steps = Topic(reader, STEP_TOPIC)
    if not len(steps):
        return EpisodePlan() if _is_log(reader) else None
    missing = [name for name in _FIELDS if name not in steps.fields]
    if missing and METADATA_NAME in reader.metadata:
        raise CorruptLogError(f"{STEP_TOPIC} has no field {', '.join(missing)}")
    if missing:
        return None
    channels = reader.channels_of(STEP_TOPIC)
    can_change = all(_message_dtype(reader.schema_of(one)) is not None for one in channels)
    order = np.lexsort((steps.times, steps.channel_ids))
    columns = steps.read(_FIELDS, order)
    plan, kept = EpisodePlan(), np.zeros(len(steps), np.bool_)
    plan.is_in_order = bool((np.diff(order) > 0).all())
    listed, spans = _listed_episodes(reader), []
    for run in _runs(reader, columns, steps.channel_ids[order]):
        can_end = run.can_end and can_change
        if not run.is_whole and not (can_end and keep_unfinished):
            plan.dropped.append(run.dropped(columns, can_end))
            continue
        kept[order[run.start : run.last + 1]] = True
        if not run.is_whole:
            start_ns, end_ns = columns[LOG_TIME][[run.last - 1, run.last]].tolist()
            plan.ended.append(Part(start_ns, end_ns, 0, run.last - run.start, is_cut=True))
        spans.append(columns[LOG_TIME][[run.start, run.last]])
        if int(spans[-1][1]) not in listed:
            plan.new_summaries.append(run.summary(columns))
    plan.dropped.extend(_missing(columns, listed.values()))
    plan.spans = np.array(sorted(map(tuple, spans)), np.int64).reshape(-1, 2)
    plan.kept = dict(_by_place(steps, kept))
    plan.strays = _count_strays(reader, plan)
    return plan


def write_planned(reader: McapReader, target: Path, plan: EpisodePlan) -> Copied:
    """Write the records that a plan keeps to another file."""
    source = Source(reader, {id_: id_ for id_ in reader.channels}, choice=plan.keeps)
    if plan.ended:
        dtypes = {
            one.id: _message_dtype(reader.schema_of(one)) for one in reader.channels_of(STEP_TOPIC)
        }
        change = Shorten(plan.ended, {id_: one for id_, one in dtypes.items() if one is not None})
        source.change, source.changed = change, dict.fromkeys(dtypes, change.spans)
    top_level = finished_state(reader).top_level
    top_level = sorted(top_level, key=lambda record: not isinstance(record, Metadata))
    return copy_selected([source], target, top_level, plan.new_summaries)


@dataclass(frozen=True)
class _Run:
    """A gapless series of records of one episode.

    Attributes:
        start: Row of the first record.
        last: Row before the first record that lacks an image; if there is none, the last row.
        records: Number of records, including records without their images.
        begins: Whether the run begins with step 0.
        is_whole: Whether the run is a whole episode.
    """

    start: int
    last: int
    records: int
    begins: bool
    is_whole: bool

    @property
    def can_end(self) -> bool:
        """Whether the run can be kept as an episode that ends with its last whole transition."""
        return self.begins and not self.is_whole and self.last > self.start

    def dropped(self, columns: Columns, can_end: bool) -> DroppedEpisode:
        """Describe the run as a dropped episode."""
        why = "its end is missing" if self.begins else "its beginning is missing"
        number = int(columns["episode"][self.start])
        return DroppedEpisode(number, self.records, can_end, why)

    def summary(self, columns: Columns) -> EpisodeSummary:
        """Compute the episode summary from the records."""
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
    """Yield the runs; the records in `columns` are sorted by channel and time."""
    steps, episodes, times = columns["step"], columns["episode"], columns[LOG_TIME]
    follows = (
        (steps[1:] == steps[:-1] + 1)
        & (episodes[1:] == episodes[:-1])
        & (channel_ids[1:] == channel_ids[:-1])
        & (times[1:] > times[:-1])
        & ~columns["final"][:-1].astype(bool)
    )
    complete = _with_images(reader, times)
    starts = [0, *(np.flatnonzero(~follows) + 1).tolist()]
    for start, stop in zip(starts, [*starts[1:], len(steps)], strict=True):
        length = int(np.argmin(np.append(complete[start:stop], False)))
        begins, last = bool(steps[start] == 0), start + length - 1
        is_whole = begins and stop - start == length > 1 and bool(columns["final"][last])
        yield _Run(start, last, stop - start, begins, is_whole)


def _is_log(reader: McapReader) -> bool:
    """Return whether a file is a log, possibly with damaged metadata or topic names."""
    topics = (STEP_TOPIC, EPISODE_TOPIC, "/rl/observation/")
    return (
        METADATA_NAME in reader.metadata
        or any(channel.topic.startswith(topics) for channel in reader.channels.values())
        or any(schema.name.startswith("mcaprl_msgs/") for schema in reader.schemas.values())
    )


def _message_dtype(schema: Schema) -> np.dtype[Any] | None:
    return message_dtype(schema.data.decode(errors="replace"))


def _with_images(reader: McapReader, times: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask of the records that have exactly one image on each image topic."""
    metadata, complete = described(reader), np.ones(len(times), np.bool_)
    for leaf in observation_leaves(metadata.observation_space) if metadata else ():
        if leaf.encoding is not None:
            found, counts = np.unique(Topic(reader, leaf.topic).times, return_counts=True)
            complete &= np.isin(times, found[counts == 1])
    return complete


def _listed_episodes(reader: McapReader) -> dict[int, int]:
    """Return the episodes on `/rl/episode`: a dict from the end time, in ns, to the number."""
    topic, names = Topic(reader, EPISODE_TOPIC), ("end_time_ns", "episode")
    if not set(names) <= set(topic.fields):
        return {}
    found = topic.read(names)
    return dict(zip(found["end_time_ns"].tolist(), found["episode"].tolist(), strict=True))


def _missing(columns: Columns, listed: Iterable[int]) -> Iterator[DroppedEpisode]:
    """Yield the episodes without records.

    The number of such an episode is in `listed`, or is missing between two numbers in the log.
    """
    known = np.unique(columns["episode"]).astype(np.int64)
    gaps = np.diff(known)
    between = [
        np.arange(number + 1, number + gap)
        for number, gap in zip(known[:-1], gaps, strict=True)
        if 1 < gap < _MAX_GAP
    ]
    expected = np.concatenate([np.array(list(listed), np.int64), *between])
    for number in np.setdiff1d(expected, known).tolist():
        yield DroppedEpisode(number, 0, False, "all of its records are missing")


def _count_strays(reader: McapReader, plan: EpisodePlan) -> int:
    return sum(
        int((~within(plan.spans, part.index["log_time"].astype(np.int64))).sum())
        for channel in reader.channels.values()
        if channel.topic.startswith(_EPISODE_TOPICS) and channel.topic != STEP_TOPIC
        for part in reader.message_ranges(channel)
    )


def _by_place(steps: Topic, kept: NDArray[np.bool_]) -> Iterator[tuple[Place, NDArray[np.bool_]]]:
    start = 0
    for decoder, part in steps.parts:
        stop = start + len(part)
        assert part.chunk is not None, "all messages are in chunks"
        yield (part.chunk.chunk_start_offset, decoder.channel.id), kept[start:stop]
        start = stop
