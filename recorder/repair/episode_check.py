"""Checks of a log's messages: schema and metadata, order of steps, episode summaries, images."""

from __future__ import annotations

import math
import warnings
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, NoEpisodesError, NoStepsError
from mcaprl.problem import LISTED, Problem, Shortlist
from mcaprl.recorder.dataset.episode import Episode
from mcaprl.recorder.dataset.episodes import (
    COUNTERS,
    EpisodeTopic,
    episode_lengths,
    summaries,
    summaries_of_records,
)
from mcaprl.recorder.dataset.log_reader import LogReader, described
from mcaprl.recorder.format.episode_summary import EpisodeSummary, add_up
from mcaprl.recorder.format.reading import (
    LOG_TIME,
    Columns,
    Decoder,
    McapReader,
    MessageRange,
    Topic,
)
from mcaprl.recorder.format.schema import step_schema
from mcaprl.recorder.format.spaces import Leaf, observation_leaves, outside
from mcaprl.recorder.format.topics import EPISODE_TOPIC, STEP_TOPIC

_FIELDS = ("action", "reward", "terminated", "truncated", *COUNTERS)
IMPOSSIBLE_ACTION = "leave the episode out of training"
"""Advice for an action outside of the action space; the file itself is not damaged."""
_IMAGE_FIELDS = ("height", "width", "encoding", "step", "data")
# A decoder, a message range, and the destination of its values. The destination is the rows of the
# step columns, or the image leaf of the observation space.
_Place = tuple[Decoder, MessageRange, slice | Leaf]


class EpisodeCheck:
    """Checker of a log. It collects values of each chunk, and validates the episodes at the end."""

    def __init__(self, reader: McapReader) -> None:
        """Find the topics."""
        self._reader = reader
        self._steps = Topic(reader, STEP_TOPIC)
        if not reader.channels_of(STEP_TOPIC):
            raise NoStepsError(f"no transitions, because there is no topic {STEP_TOPIC}")
        if not len(self._steps):
            raise NoEpisodesError("no finished episode")
        self._metadata = described(reader)
        self._images = [
            (leaf, Topic(reader, leaf.topic))
            for leaf in (
                observation_leaves(self._metadata.observation_space) if self._metadata else ()
            )
            if leaf.encoding is not None
        ]
        # If other software wrote the log in another form, `LogReader` validates it.
        self._has_our_form = self._metadata is not None and self._schema_fits()
        self._columns: Columns = {}
        self._problems = Shortlist[Problem]()
        self._places: dict[int, list[_Place]] = defaultdict(list)
        if self._has_our_form:
            self._prepare()

    def take(self, chunk: ChunkIndex, records: memoryview) -> None:
        """Check the messages of one chunk."""
        for decoder, messages, where in self._places.get(chunk.chunk_start_offset, ()):
            if isinstance(where, slice):
                self._take_steps(decoder.alike(records, messages.index, _FIELDS), where)
            else:
                self._take_images(decoder.alike(records, messages.index, _IMAGE_FIELDS), where)

    def finish(self) -> Iterator[Problem]:
        """Yield the problems of the log."""
        if not self._has_our_form:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                dataset = LogReader(self._reader.path).read()
            yield from (found for e in dataset.episodes for found in _check_return(e))
            return
        yield from self._problems
        columns, path = self._columns, str(self._reader.path)
        lengths = episode_lengths(columns, path)
        frames = int(lengths.sum()) + len(lengths)
        if frames < len(self._steps):
            yield Problem(
                f"{len(self._steps) - frames} records of an unfinished episode",
                f"the end of {STEP_TOPIC}",
            )
        if not len(lengths):
            return
        times = columns[LOG_TIME]
        if (np.diff(times) <= 0).any():
            row = int(np.argmax(np.diff(times) <= 0)) + 1
            yield Problem("log_times do not increase", f"record {row} of {STEP_TOPIC}")
        yield from self._check_summaries(lengths)
        for leaf, topic in self._images:
            missing = int((~np.isin(times[:frames], topic.times)).sum())
            if missing or len(topic) != len(self._steps):
                yield Problem(
                    f"{len(topic)} images for {len(self._steps)} records; {missing} records have no"
                    " image",
                    leaf.topic,
                )

    def _schema_fits(self) -> bool:
        """Return whether `/rl/step` has one channel, with a schema that matches the metadata."""
        channels = self._reader.channels_of(STEP_TOPIC)
        assert self._metadata is not None
        spaces = (self._metadata.observation_space, self._metadata.action_space)
        schema = self._reader.schema_of(channels[0])
        # Schemas of older logs do not name the actions.
        possible = [step_schema(*spaces, names) for names in (self._metadata.action_names(), None)]
        fits = (schema.name, schema.data.decode(errors="replace")) in possible
        if schema.name.startswith("mcaprl_msgs/msg/Step") and not fits:
            raise CorruptLogError(f"schema {schema.name} does not match the metadata's spaces")
        return fits and len(channels) == 1

    def _prepare(self) -> None:
        """Assign to each chunk its message ranges and the destinations of their values."""
        start = 0
        for decoder, messages in self._steps.parts:
            stop = start + len(messages)
            self._place(decoder, messages, slice(start, stop))
            start = stop
        for leaf, topic in self._images:
            for decoder, messages in topic.parts:
                self._place(decoder, messages, leaf)
        self._columns = {
            name: np.empty(start, self._steps.fields[name]) for name in _FIELDS[1:]
        } | {LOG_TIME: self._steps.times}

    def _place(self, decoder: Decoder, messages: MessageRange, where: slice | Leaf) -> None:
        if messages.chunk is None:
            self._has_our_form = False
        else:
            self._places[messages.chunk.chunk_start_offset].append((decoder, messages, where))

    def _take_steps(self, found: NDArray[Any] | None, rows: slice) -> None:
        if found is None:
            raise CorruptLogError(f"messages of {STEP_TOPIC} do not match their schema")
        for name in _FIELDS[1:]:
            self._columns[name][rows] = found[name]
        assert self._metadata is not None
        space = self._metadata.action_space
        actions = found["action"].reshape(-1, *(space.shape or ()))
        wrong = outside(space, actions) & ~found["final"].astype(bool)
        for row in np.flatnonzero(wrong)[:LISTED].tolist():
            self._problems.append(
                Problem(
                    f"action {found['action'][row]} is outside of {space}",
                    f"episode {found['episode'][row]} step {found['step'][row]}",
                    next=IMPOSSIBLE_ACTION,
                )
            )

    def _take_images(self, found: NDArray[Any] | None, leaf: Leaf) -> None:
        if found is None or not _is_image(found, leaf):
            raise CorruptLogError(f"images on {leaf.topic} do not match the metadata's space")

    def _check_summaries(self, lengths: NDArray[np.int64]) -> Iterator[Problem]:
        """Compare `/rl/episode` with the records."""
        columns = self._columns
        finals = np.cumsum(lengths + 1) - 1
        topic = Topic(self._reader, EPISODE_TOPIC)
        listed = EpisodeTopic(topic).summaries(columns[LOG_TIME][finals])
        if len(listed) not in (0, len(lengths)):
            what = f"{len(listed)} of {len(lengths)} episodes have a summary"
            yield Problem(what, EPISODE_TOPIC)
        whole = summaries(self._reader.path, columns, lengths, listed)
        actual = summaries_of_records(columns, finals, lengths)
        for number, summary_and_actual in enumerate(zip(whole, actual, strict=True)):
            yield from _check_summary(number, *summary_and_actual)


def _check_summary(
    number: int, listed: EpisodeSummary, actual: EpisodeSummary
) -> Iterator[Problem]:
    pairs = [
        ("return", listed.total_reward, actual.total_reward),
        ("start", listed.start_time_ns, actual.start_time_ns),
        ("terminated", listed.terminated, actual.terminated),
        ("truncated", listed.truncated, actual.truncated),
    ]
    for name, claim, fact in pairs:
        if claim != fact and not math.isnan(fact):
            yield Problem(
                f"{EPISODE_TOPIC} has {name} {claim}, but the records have {fact}",
                f"episode {number}",
            )


def _check_return(episode: Episode) -> Iterator[Problem]:
    total = add_up(episode.rewards)
    if total != episode.total_reward and not np.isnan(total):
        yield Problem(
            f"{EPISODE_TOPIC} has return {episode.total_reward}, but the records have {total}",
            f"episode {episode.index}",
        )


def _is_image(found: NDArray[Any], leaf: Leaf) -> bool:
    if not set(_IMAGE_FIELDS) <= set(found.dtype.names or ()):
        return False
    height, width = leaf.shape[:2]
    encoding = (leaf.encoding or "").encode()
    expected = (height, width, encoding, leaf.size // height)
    heads = zip(_IMAGE_FIELDS, expected, strict=False)
    return found["data"].shape[1:] == (leaf.size,) and all(
        (found[name] == value).all() for name, value in heads
    )
