"""Checks of a whole log.

    file      summary, CRCs of the data section and attachments        (file_check)
    chunks    CRCs, message indexes, chunk indexes of the summary      (file_check)
    log       metadata, schema, episodes, order of steps, summaries, images
    bag       all messages, if the file is another robot's bag

Each chunk is decompressed once.
"""

from __future__ import annotations

import math
import warnings
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from mcaprl.errors import (
    LISTED,
    CorruptLogError,
    LogError,
    NoEpisodesError,
    NoStepsError,
    NotMcapError,
    Problem,
    Shortlist,
    SpaceError,
)
from mcaprl.recorder.bags.bag import Bag, open_bag
from mcaprl.recorder.bags.files import is_bag_file
from mcaprl.recorder.dataset.episodes import (
    COUNTERS,
    EpisodeTopic,
    episode_lengths,
    summaries,
    summaries_of_records,
)
from mcaprl.recorder.dataset.log_reader import LogReader, described
from mcaprl.recorder.dataset.log_video import LogVideo, is_video_leaf
from mcaprl.recorder.dataset.transitions import Episode
from mcaprl.recorder.format.behavior import FIELDS
from mcaprl.recorder.format.messages import EpisodeSummary, add_up
from mcaprl.recorder.format.metadata import METADATA_NAME, LogMetadata
from mcaprl.recorder.format.reading import (
    LOG_TIME,
    Columns,
    Decoder,
    McapReader,
    MessageRange,
    Scratch,
    Topic,
    check_chunk,
    check_file,
    check_statistics,
    place,
)
from mcaprl.recorder.format.schema import (
    EPISODE_TOPIC,
    STEP_TOPIC,
    earlier_step_schemas,
    step_schema,
)
from mcaprl.recorder.format.spaces import Leaf, observation_leaves, outside, part_names
from mcaprl.storage.remote import RemotePath, as_path
from mcaprl.texts import counted

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
        leaves = observation_leaves(self._metadata.observation_space) if self._metadata else []
        images = [leaf for leaf in leaves if leaf.encoding is not None]
        self._videos = [leaf for leaf in images if is_video_leaf(reader, leaf)]
        self._images = [
            (leaf, Topic(reader, leaf.topic)) for leaf in images if leaf not in self._videos
        ]
        # If other software wrote the log in another form, `LogReader` validates it.
        self._has_our_form = self._metadata is not None and self._schema_fits()
        # A schema of our form has one of these fields.
        self._behavior = next((f for f in FIELDS if f.name in self._steps.fields), FIELDS[0])
        self._columns: Columns = {}
        self._problems = Shortlist[Problem]()
        self._places: dict[int, list[_Place]] = defaultdict(list)
        if self._has_our_form:
            self._prepare()

    def take(self, chunk: ChunkIndex, records: memoryview) -> None:
        """Check the messages of one chunk."""
        for decoder, messages, where in self._places.get(chunk.chunk_start_offset, ()):
            if isinstance(where, slice):
                fields = (*_FIELDS, self._behavior.name)
                self._take_steps(decoder.alike(records, messages.index, fields), where)
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
        for leaf in self._videos:
            readable = LogVideo(self._reader, leaf).has_images(times[:frames], columns["final"])
            if not readable.all():
                what = f"{int((~readable).sum())} of {frames} records have no image"
                yield Problem(what, leaf.topic)

    def _schema_fits(self) -> bool:
        """Return whether `/rl/step` has one channel, with a schema that matches the metadata."""
        channels = self._reader.channels_of(STEP_TOPIC)
        assert self._metadata is not None
        spaces = (self._metadata.observation_space, self._metadata.action_space)
        schema = self._reader.schema_of(channels[0])
        labels = self._metadata.action_labels()
        current = step_schema(*spaces, self._metadata.action_names(), labels)
        possible = [current, *earlier_step_schemas(*spaces)]
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
        metadata = self._metadata
        assert metadata is not None
        space = metadata.action_space
        actions = found["action"].reshape(-1, *(space.shape or ()))
        behavior, values = self._behavior, found[self._behavior.name]
        is_final = found["final"].astype(bool)
        self._report(found, outside(space, actions) & ~is_final, partial(_outside, metadata))
        self._report(
            found,
            behavior.is_impossible(values) & ~is_final,
            lambda row: f"{behavior.name} is {row[behavior.name]:g}, expected {behavior.expected}",
        )

    def _report(
        self, found: NDArray[Any], wrong: NDArray[np.bool_], what: Callable[[Any], str]
    ) -> None:
        """Add a problem for each of the first wrong records."""
        for record in found[np.flatnonzero(wrong)[:LISTED]]:
            where = f"episode {record['episode']} step {record['step']}"
            self._problems.append(Problem(what(record), where, next=IMPOSSIBLE_ACTION))

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


def _outside(metadata: LogMetadata, record: Any) -> str:
    """Return what is wrong with an action; of a vector, name the first part that is wrong."""
    space = metadata.action_space
    if not isinstance(space, spaces.Box):
        return f"action {record['action']} is outside of {space}"
    parts, low, high = np.ravel(record["action"]), space.low.ravel(), space.high.ravel()
    first = int(np.argmin((parts >= low) & (parts <= high)))
    name = part_names(space, metadata.action_part_names)[first]
    return f"{name} {parts[first]:.6g} is outside of {low[first]:.4g} to {high[first]:.4g}"


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


_LISTED = 3  # Number of undecodable messages of a topic that are listed


def check_messages(path: Path) -> list[Problem]:
    """Decode all messages of a bag file or rosbag2 folder, one at a time."""
    # Return problems by topic. If the file can be opened, the last finding is a note that it is a
    # bag.
    try:
        with closing(open_bag(path)) as bag:
            found = Shortlist[Problem]()
            if not any(info.count for info in bag.topics.values()):
                found.append(Problem("the bag has no messages", "all topics", file=str(path)))
            for name in bag.topics:
                found.extend(_problems_of(bag, name, str(path)))
            return [*found, *found.rest(), _note(path)]
    except LogError as error:
        what = str(error).removeprefix(f"{path}: ").removeprefix(f"{path} ")
        return [Problem(what, "reading the bag", file=str(path))]


def _note(path: Path) -> Problem:
    return Problem(
        "this is another robot's bag, not a log: its messages were decoded",
        "no topic /rl/step",
        next="to check its transitions, pass `mapping=FILE`; `mcaprl convert --suggest BAG > FILE`"
        " drafts one",
        file=str(path),
        severity="note",
    )


def _problems_of(bag: Bag, name: str, file: str) -> Iterator[Problem]:
    info = bag.topics[name]
    if info.problem:
        effect = f"its {counted(info.count, 'message')} cannot be read"
        yield Problem(info.problem, name, effect=effect, file=file)
        return
    count = 0
    try:
        for failure in bag.failures(name):
            count += 1
            if count <= _LISTED:
                what = f"message {failure.row} at {failure.log_time_ns} ns: {failure.reason}"
                yield Problem(what, name, file=file)
    except LogError as error:
        yield Problem(str(error).removeprefix(f"{file}: "), name, file=file)
    if count > _LISTED:
        what = f"{count} of {counted(info.count, 'message')} cannot be decoded"
        yield Problem(what, name, file=file)


# Number of chunks that a thread decompresses before it hands them over. Handing over each one takes
# more time.
_BLOCK_CHUNKS = 4
_Read = memoryview | CorruptLogError  # Records of a chunk, or the error if the chunk is damaged


def check_log(path: str | Path, *, threads: int = 1) -> list[Problem]:
    """Check the structure, CRCs, indexes, episodes and metadata of one log, or a bag's messages."""
    path = as_path(path)
    is_other = path.is_dir() or (is_bag_file(path) and path.suffix != ".mcap")
    if is_other and not isinstance(path, RemotePath):
        return check_messages(path)
    try:
        reader = McapReader(path)
    except LogError as error:
        what, action = _without_path(error, path), "check the path and its permissions"
        if isinstance(error, NotMcapError):
            what = f"the file {what}"
            action = "restore a backup copy, or read another tool's dataset with `mcaprl info`"
        elif isinstance(error, CorruptLogError):
            action = _recover(path)
        return [Problem(what, "opening the file", next=action, file=str(path))]
    found, notes = Shortlist(check_file(reader)), list[Problem]()
    is_log = bool(reader.channels_of(STEP_TOPIC)) or METADATA_NAME in reader.metadata
    # Bags are read from local files only.
    is_bag = not is_log and not isinstance(path, RemotePath)
    try:
        _check_contents(reader, found, threads=threads)
    except (LogError, SpaceError) as error:
        if not is_bag:
            found.append(Problem(_without_path(error, path), STEP_TOPIC))
    if is_bag and not (found and reader.complete):
        notes = check_messages(path)
    problems = [*found, *found.rest()]
    named = [
        replace(found, next=found.next or _recover(path), file=str(path)) for found in problems
    ]
    return [*named, *notes]


def _check_contents(reader: McapReader, found: Shortlist[Problem], *, threads: int) -> None:
    """Check each chunk. If all chunks are valid, check the log."""
    log, refusal = None, None
    if not found:
        try:
            log = EpisodeCheck(reader)
        except (LogError, SpaceError) as error:
            # The chunks of any MCAP file can be checked, so they are checked before this error is
            # raised.
            refusal = error
    for chunk, records in _decompressed(reader, threads):
        try:
            if isinstance(records, CorruptLogError):
                raise records
            found.extend(check_chunk(reader, chunk, records))
        except CorruptLogError as error:
            found.append(Problem(_without_path(error, reader.path), place(reader, chunk)))
            continue
        if log is not None and not found:
            log.take(chunk, records)
    if refusal is not None:
        raise refusal
    if log is not None and not found:
        found.extend(check_statistics(reader))
        found.extend(log.finish())


def _decompressed(reader: McapReader, threads: int) -> Iterator[tuple[ChunkIndex, _Read]]:
    """Yield each chunk and its records, valid until the next, or the error if it is damaged."""
    chunks = iter(reader.chunks)
    if threads == 1:
        scratch = Scratch()
        yield from ((chunk, _records_of(reader, chunk, scratch)) for chunk in chunks)
        return

    def read(block: list[ChunkIndex], scratches: list[Scratch]) -> list[_Read]:
        return [_records_of(reader, *each) for each in zip(block, scratches, strict=False)]

    with ThreadPoolExecutor(threads) as pool:
        ahead = deque[tuple[list[ChunkIndex], Future[list[_Read]]]]()
        # Memory use is limited: there are buffers for a block for each thread, and for the caller.
        buffers = cycle([[Scratch() for _ in range(_BLOCK_CHUNKS)] for _ in range(threads + 1)])
        while True:
            while len(ahead) <= threads and (block := list(islice(chunks, _BLOCK_CHUNKS))):
                ahead.append((block, pool.submit(read, block, next(buffers))))
            if not ahead:
                return
            block, future = ahead.popleft()
            yield from zip(block, future.result(), strict=True)


def _records_of(reader: McapReader, chunk: ChunkIndex, scratch: Scratch) -> _Read:
    try:
        return reader.chunk_records(chunk, scratch)
    except CorruptLogError as error:
        return error


def _recover(path: Path) -> str:
    return f"run `mcaprl recover {path} OUT`"


def _without_path(error: Exception, path: str | Path) -> str:
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path} ")
