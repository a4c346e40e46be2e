"""Recovery of the valid part of a log that was cut off or damaged.

    valid records -> valid MCAP file with new indexes and CRCs -> whole episodes -> OUT
    (salvage)

Metadata, attachments and all topics are kept; only messages of `/rl/` topics that belong to a
dropped episode are omitted. All omissions are reported.

A run is a gapless series of records of `/rl/step`. A whole episode is a run from step 0 to a final
record. If an episode is unfinished or its end is lost, its run begins at step 0 but has no final
record. Such a run can be kept: its last record becomes the final record. All other runs have no
beginning and are dropped.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, ChunkIndex, Metadata, Schema
from numpy.typing import NDArray

from mcaprl.errors import (
    CorruptLogError,
    LogError,
    NoEpisodesError,
    NoStepsError,
    Problem,
    Shortlist,
    UsageError,
)
from mcaprl.files import locked_file, replacing
from mcaprl.recorder.dataset.log_reader import described
from mcaprl.recorder.dataset.log_video import LogVideo, is_video_leaf
from mcaprl.recorder.format.messages import INTERRUPTED, EpisodeSummary, add_up
from mcaprl.recorder.format.metadata import METADATA_NAME
from mcaprl.recorder.format.reading import LOG_TIME, Columns, McapReader, Topic
from mcaprl.recorder.format.schema import EPISODE_TOPIC, STEP_TOPIC, Part, Shorten, message_dtype
from mcaprl.recorder.format.selected_copy import Copied, Source, copy_selected, within
from mcaprl.recorder.format.spaces import observation_leaves
from mcaprl.recorder.format.writing import Damage, finished_state, recover_file
from mcaprl.recorder.repair.check import IMPOSSIBLE_ACTION, check_log
from mcaprl.storage.remote import as_path
from mcaprl.texts import counted

_FIELDS = ("reward", "episode", "step", "terminated", "truncated", "final")
# Prefix of topics whose messages belong to episodes; other topics are copied unchanged.
_EPISODE_TOPICS = "/rl/"
# If the gap between two episode numbers is larger than this, a new recording is assumed to start.
_MAX_GAP = 10**6

Place = tuple[int, int]  # Offset of a chunk and id of a channel, which identify a message index


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
    """Selection of the records to keep."""

    # Mask of the records of `/rl/step` in file order, by `Place`.
    kept: dict[Place, NDArray[np.bool_]] = field(default_factory=dict)
    # (E, 2) first and last log_time of the kept episodes, increasing.
    spans: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 2), np.int64))
    # Episodes that are not kept.
    dropped: Shortlist[DroppedEpisode] = field(default_factory=Shortlist)
    # Parts of kept episodes whose end is missing, up to their last whole transition.
    ended: list[Part] = field(default_factory=list)
    # Summaries of kept episodes that `/rl/episode` does not contain.
    new_summaries: list[EpisodeSummary] = field(default_factory=list)
    # Number of messages on other `/rl/` topics that do not belong to a kept episode.
    strays: int = 0
    is_in_order: bool = True  # Whether the records are in time order

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
    """Find the whole episodes of a log; None if `/rl/step` or its required fields are missing."""
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
    """A gapless series of records of one episode."""

    start: int  # Row of the first record
    last: int  # Row before the first record that lacks an image; if there is none, the last row
    records: int  # Number of records, including records without their images
    begins: bool  # Whether the run begins with step 0
    is_whole: bool  # Whether the run is a whole episode

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
    complete = _with_images(reader, times, columns["final"])
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


def _with_images(
    reader: McapReader, times: NDArray[np.int64], final: NDArray[Any]
) -> NDArray[np.bool_]:
    """Return a mask of the records that have exactly one image on each image topic."""
    metadata, complete = described(reader), np.ones(len(times), np.bool_)
    for leaf in observation_leaves(metadata.observation_space) if metadata else ():
        if leaf.encoding is not None and is_video_leaf(reader, leaf):
            complete &= LogVideo(reader, leaf).has_images(times, final)
        elif leaf.encoding is not None:
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
    """Yield the episodes without records: numbers in `listed`, or between two in the log."""
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


_LISTS = ("damages", "dropped")


@dataclass
class Recovery:
    """Result of a recovery.

    Attributes:
        source: Path of the damaged file.
        messages: Number of messages in the new file.
        episodes: Number of episodes in the new file; 0 if it has no `/rl/step`.
        damages: Byte ranges that could not be read.
        dropped: Episodes of the old file that are not in the new file.
        ended: Number of unfinished episodes that were kept up to their last whole transition.
        strays: Number of messages on `/rl/` topics that do not belong to a kept episode.
    """

    source: str
    messages: int = 0
    episodes: int = 0
    damages: Shortlist[Damage] = field(default_factory=Shortlist)
    dropped: Shortlist[DroppedEpisode] = field(default_factory=Shortlist)
    ended: int = 0
    strays: int = 0

    @property
    def has_losses(self) -> bool:
        """Whether the new file lacks anything that is in the old file."""
        return bool(self.damages or self.dropped or self.ended or self.strays)

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object that `recover --json` prints."""
        return {
            "ok": not self.has_losses,
            **{name: value for name, value in vars(self).items() if name not in _LISTS},
            **{name: [asdict(one) for one in getattr(self, name)] for name in _LISTS},
            "not_listed": [problem.what for problem in self.damages.rest() + self.dropped.rest()],
        }

    @property
    def problems(self) -> list[Problem]:
        """Lost messages: `damages`, then `dropped`, then `strays`."""
        found = [(one.what, f"byte {one.offset}, {one.bytes} bytes", "") for one in self.damages]
        found += [
            (f"episode {one.number}", f"{one.records} of its records were read", one.why)
            for one in self.dropped
        ]
        if self.strays:
            found.append(
                (counted(self.strays, "message"), "/rl/ topics", "part of dropped episodes")
            )
        problems = [
            Problem(f"lost: {what}", where, effect, file=self.source)
            for what, where, effect in found
        ]
        return problems + self.damages.rest() + self.dropped.rest()


def recover_log(
    source: str | Path,
    target: str | Path,
    *,
    keep_unfinished: bool = False,
    overwrite: bool = False,
) -> Recovery:
    """Write the valid part of `source` to `target` as a valid log."""
    source, target = as_path(source, whole=True), Path(target)
    if source.exists() and target.exists() and target.samefile(source):
        raise UsageError(f"{target} is the damaged file: recover to another path")
    recovery = Recovery(str(source))
    with locked_file(source), replacing(target, LogError, overwrite=overwrite) as result:
        copied = result.with_name("records.mcap" if result.name != "records.mcap" else "_")
        restore = partial(_restore_metadata, recovery.damages)
        recover_file(source, copied, recovery.damages, restore)
        _keep_whole_episodes(copied, result, recovery, keep_unfinished)
    return recovery


def _keep_whole_episodes(
    copied: Path, result: Path, recovery: Recovery, keep_unfinished: bool
) -> None:
    """Write `copied` to `result` without incomplete episodes, or with their whole transitions."""
    reader = McapReader(copied)
    recovery.messages = _count_messages(reader)
    if recovery.messages == 0:
        raise NoStepsError(f"{recovery.source} cannot be recovered: it has no readable message")
    plan = plan_episodes(reader, keep_unfinished=keep_unfinished)
    if plan is None and not recovery.damages and _is_complete(recovery.source):
        raise LogError(
            f"{recovery.source} is a valid MCAP file, but not an mcaprl log: there is nothing to"
            " recover"
        )
    if plan is None:
        os.replace(copied, result)
        return
    _add_plan(recovery, plan)
    if plan.changes_anything:
        recovery.messages = write_planned(reader, result, plan).messages
    else:
        os.replace(copied, result)
    problems = [one for one in check_log(result) if one.next != IMPOSSIBLE_ACTION]
    if problems:
        what, where = problems[0].what, problems[0].where
        raise LogError(f"{recovery.source} cannot be recovered: {what} ({where})")


def _is_complete(source: str) -> bool:
    try:
        return McapReader(source).complete
    except CorruptLogError:
        return False


def _restore_metadata(
    damages: Shortlist[Damage], metadata: list[Metadata], channels: Iterable[Channel]
) -> list[Metadata]:
    """Replace the metadata record by its copy in the channel of `/rl/step`, if there is a copy."""
    for channel in channels:
        if channel.topic == STEP_TOPIC and "format_version" in channel.metadata:
            records = [record for record in metadata if record.name == METADATA_NAME]
            if any(record.metadata != channel.metadata for record in records):
                damages.append(Damage(0, 0, "the metadata record and its copy differ"))
            others = [record for record in metadata if record.name != METADATA_NAME]
            return [Metadata(METADATA_NAME, channel.metadata), *others]
    return metadata


def _count_messages(reader: McapReader) -> int:
    channels = reader.channels.values()
    return sum(len(part) for channel in channels for part in reader.message_ranges(channel))


def _add_plan(recovery: Recovery, plan: EpisodePlan) -> None:
    """Copy the counts and dropped episodes of an `EpisodePlan` to the result of the recovery."""
    recovery.episodes, recovery.dropped = plan.episodes, plan.dropped
    recovery.ended, recovery.strays = len(plan.ended), plan.strays
    if plan.episodes == 0:
        can_end = any(dropped.can_end for dropped in plan.dropped)
        hint = "; pass `keep_unfinished=True` to keep unfinished episodes" if can_end else ""
        raise NoEpisodesError(f"{recovery.source} has no whole episode{hint}")
