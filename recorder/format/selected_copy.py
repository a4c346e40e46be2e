"""Copies of selected messages of one or more finished MCAP files into a new one.

A chunk whose messages are all kept unchanged is copied without decompressing it. If only some
messages of a chunk are kept, or some are changed, the kept messages are written as a new chunk.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError
from mcaprl.recorder.columns.chunks import Scratch
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import (
    INDEX_ENTRY,
    MAGIC,
    MESSAGE_HEADER,
    RECORD_HEADER,
    RECORD_HEADER_BYTES,
    contents_of,
    message_index,
)
from mcaprl.recorder.columns.salvage import writer_like
from mcaprl.recorder.columns.summary import TopLevelRecord
from mcaprl.recorder.columns.writer import McapWriter
from mcaprl.recorder.format.messages import EPISODE_TEXT, EPISODE_TYPE, EpisodeSummary
from mcaprl.recorder.format.schema import EPISODE_TOPIC

Times = NDArray[np.int64]
Change = Callable[[Channel, int, memoryview], None]
"""Function that changes a message in place, given its channel, log_time and payload."""
Choice = Callable[[ChunkIndex, Channel, NDArray[Any]], NDArray[np.bool_]]
"""Function that returns a mask of messages, given their chunk, channel and message index."""
# Channel ids are 16-bit numbers.
_MAX_CHANNEL_ID = 2**16 - 1
_NO_TIMES: Times = np.empty(0, np.int64)
_LAST_TIME = np.iinfo(np.int64).max
ALL_TIMES: Times = np.array([[0, _LAST_TIME]], np.int64)  # Time range that contains all log_times
# A Message record up to its payload; see `MESSAGE_HEADER`.
_HEADER = struct.Struct("<BQHIQQ")


@dataclass
class Source:
    """File from which messages are copied. Times are log_times in nanoseconds."""

    reader: McapReader
    ids: Mapping[int, int]  # Channel id in the new file, by channel id in this file
    # (S, 2) first and last time of each kept time range, increasing.
    spans: Times = field(default_factory=lambda: ALL_TIMES)
    # Times of additional messages to keep, by channel id.
    also: Mapping[int, Times] = field(default_factory=dict)
    # Times of messages to drop, by channel id, even if `spans` or `also` contains these times.
    without: Mapping[int, Times] = field(default_factory=dict)
    # Function that selects the messages, in place of `spans`, `also` and `without`.
    choice: Choice | None = None
    # (S, 2) first and last time of each time range whose messages are passed to `change`, by
    # channel id. Messages that get other times or ids are always passed to it.
    changed: Mapping[int, Times] = field(default_factory=dict)
    change: Change | None = None  # Function that changes a message
    delay_ns: int = 0  # Number that is added to the log_time and publish_time of each message

    def keeps(self, chunk: ChunkIndex, channel_id: int, index: NDArray[Any]) -> NDArray[np.bool_]:
        """Return a mask of the messages of a channel that are kept, given their message index."""
        if self.choice is not None:
            return self.choice(chunk, self.reader.channels[channel_id], index)
        times = index["log_time"].astype(np.int64)
        kept = within(self.spans, times)
        if channel_id in self.also:
            kept |= np.isin(times, self.also[channel_id])
        if channel_id in self.without:
            kept &= ~np.isin(times, self.without[channel_id])
        return kept

    def changes(self, channel_id: int, start: int, end: int) -> bool:
        """Return whether messages of a channel between two times may need a change."""
        if self.delay_ns or self.ids[channel_id] != channel_id:
            return True
        spans = self.changed.get(channel_id, ALL_TIMES[:0])
        return bool(((spans[:, 0] <= end) & (start <= spans[:, 1])).any())


@dataclass
class Copied:
    """Numbers of chunks and messages of a copy."""

    whole: int = 0  # Number of chunks that were copied without decompressing them
    rewritten: int = 0  # Number of chunks whose kept messages were written as a new chunk
    messages: int = 0


class NewTopics:
    """Schemas and channels of the new file."""

    def __init__(self) -> None:
        """Start without topics."""
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}

    def add(
        self, reader: McapReader, metadata: Mapping[str, dict[str, str]] | None = None
    ) -> dict[int, int]:
        """Add the channels of a file; return the new id of each channel by its id in the file."""
        # An equal channel of an earlier file shares its id; others keep theirs if it is free.
        found: dict[int, int] = {}
        earlier = dict(self.channels)
        for channel in reader.channels.values():
            schema = reader.schemas.get(channel.schema_id)
            schema_id = 0 if schema is None else self._schema_id(schema)
            strings = (metadata or {}).get(channel.topic, channel.metadata)
            wanted = (channel.topic, channel.message_encoding, strings, schema_id)
            equal = [
                id_
                for id_, one in earlier.items()
                if (one.topic, one.message_encoding, one.metadata, one.schema_id) == wanted
                and id_ not in found.values()
            ]
            new = equal[0] if equal else _free_id(channel.id, self.channels, "channel")
            self.channels.setdefault(new, Channel(new, *wanted))
            found[channel.id] = new
        return found

    def records(self) -> list[TopLevelRecord]:
        """Return the records to write at the start of the file."""
        return [*self.schemas.values(), *self.channels.values()]

    def _schema_id(self, schema: Schema) -> int:
        wanted = (schema.encoding, schema.name, schema.data)
        for id_, one in self.schemas.items():
            if (one.encoding, one.name, one.data) == wanted:
                return id_
        new = _free_id(schema.id, self.schemas, "schema")
        self.schemas[new] = Schema(new, schema.data, schema.encoding, schema.name)
        return new


def _free_id(wanted: int, taken: Mapping[int, object], kind: str) -> int:
    new = wanted if wanted not in taken else max(taken) + 1
    if new > _MAX_CHANNEL_ID:
        new = next((id_ for id_ in range(1, _MAX_CHANNEL_ID + 1) if id_ not in taken), 0)
    if not new:
        raise LogError(f"the files have more than {_MAX_CHANNEL_ID} {kind}s: join fewer files")
    return new


def copy_selected(
    sources: Sequence[Source],
    target: Path,
    top_level: Sequence[TopLevelRecord],
    summaries: Sequence[EpisodeSummary] = (),
    *,
    like: McapReader | None = None,
) -> Copied:
    """Write the selected messages of files to a new file, with chunks by their start times."""
    like = like or sources[0].reader
    with writer_like(like.view, like.records(len(MAGIC)), target) as writer:
        for record in top_level:
            writer.announce(record)
        copy = _Copy(writer)
        for source, chunk in _in_time_order(sources):
            copy.take(source, chunk)
        if summaries:
            channel_id = writer.add_channel(EPISODE_TOPIC, EPISODE_TYPE, EPISODE_TEXT)
            writer.write_messages(
                [(channel_id, one.end_time_ns, one.to_message()) for one in summaries]
            )
        for source in sources:
            source.reader.check_unchanged()
        copy.copied.messages += len(summaries)
    return copy.copied


def within(spans: Times, times: Times) -> NDArray[np.bool_]:
    """Return a mask of the times that are in one of the time ranges `spans`, of shape (S, 2)."""
    if not len(spans):
        return np.zeros(len(times), np.bool_)
    span = np.searchsorted(spans[:, 0], times, side="right") - 1
    found: NDArray[np.bool_] = (span >= 0) & (times <= spans[np.maximum(span, 0), 1])
    return found


def times_of(reader: McapReader, channel: Channel) -> Times:
    """Return the log_times of the messages of a channel, in file order."""
    parts = [part.index["log_time"].astype(np.int64) for part in reader.message_ranges(channel)]
    return np.concatenate([_NO_TIMES, *parts])


def _in_time_order(sources: Sequence[Source]) -> Iterator[tuple[Source, ChunkIndex]]:
    """Yield the chunks of files by start time; the order of a file decides between equal ones."""
    pairs = [(source, chunk) for source in sources for chunk in source.reader.chunks]
    return iter(sorted(pairs, key=lambda pair: pair[1].message_start_time + pair[0].delay_ns))


class _Copy:
    """Writer that copies the kept messages of chunks."""

    def __init__(self, writer: McapWriter) -> None:
        self.copied = Copied()
        self._writer = writer
        # One `Scratch` per reader, because `Scratch.kept` identifies a chunk only by its offset.
        self._scratches: dict[int, Scratch] = {}
        self._embedding: dict[int, bool] = {}

    def take(self, source: Source, chunk: ChunkIndex) -> None:
        """Write the kept messages of a chunk."""
        start, end = chunk.message_start_time, chunk.message_end_time
        ids = chunk.message_index_offsets
        if not ids:
            indexes = contents_of(source.reader.chunk_records(chunk)).indexes
            if indexes:
                _check_times(source, chunk, indexes)
                self._rewrite(source, chunk, indexes)
            return
        view = source.reader.view
        indexes = {id_: message_index(view, offset, id_) for id_, offset in ids.items()}
        _check_times(source, chunk, indexes)
        kept_whole = self._is_inside(source, start, end) and not any(
            id_ in source.without for id_ in ids
        )
        if not kept_whole and self._is_outside(source, start, end, list(ids)):
            return
        masks = {}
        if not kept_whole:
            masks = {id_: source.keeps(chunk, id_, index) for id_, index in indexes.items()}
        if not kept_whole and not any(mask.any() for mask in masks.values()):
            return
        is_whole = all(mask.all() for mask in masks.values())
        is_changed = any(source.changes(id_, start, end) for id_ in ids)
        if is_whole and not is_changed and not self._embeds_topics(source):
            counts = {source.ids[id_]: len(index) for id_, index in indexes.items()}
            self._writer.copy_chunk(source.reader.view, chunk, counts)
            self.copied.whole += 1
            self.copied.messages += sum(counts.values())
        else:
            self._rewrite(source, chunk, indexes)

    def _is_inside(self, source: Source, start: int, end: int) -> bool:
        if source.choice is not None:
            return False
        spans = source.spans
        span = int(np.searchsorted(spans[:, 0], start, side="right")) - 1
        return span >= 0 and end <= int(spans[span, 1])

    def _is_outside(self, source: Source, start: int, end: int, ids: Sequence[int]) -> bool:
        """Return whether a chunk's time range shows that none of its messages is kept."""
        if source.choice is not None:
            return False
        spans = source.spans
        following = int(np.searchsorted(spans[:, 1], start))
        if following < len(spans) and int(spans[following, 0]) <= end:
            return False
        also = [source.also[id_] for id_ in ids if id_ in source.also]
        return not any(((start <= times) & (times <= end)).any() for times in also)

    def _embeds_topics(self, source: Source) -> bool:
        """Return whether chunks may contain Channel records whose id differs in the new file."""
        # Most other writers store each channel in the chunk of its first message.
        reader = source.reader
        key = id(reader)
        if key not in self._embedding:
            renumbered = any(old != new for old, new in source.ids.items())
            self._embedding[key] = renumbered and not _top_level_ids(reader) >= set(source.ids)
        return self._embedding[key]

    def _rewrite(
        self, source: Source, chunk: ChunkIndex, indexes: Mapping[int, NDArray[Any]]
    ) -> None:
        scratch = self._scratches.setdefault(id(source.reader), Scratch())
        records = source.reader.chunk_records(chunk, scratch)
        kept = {id_: index[source.keeps(chunk, id_, index)] for id_, index in indexes.items()}
        count = sum(map(len, kept.values()))
        if not count:
            return
        written, found = _taken(source, records, kept)
        self._writer.write_records(written, found)
        self.copied.rewritten += 1
        self.copied.messages += count


def _check_times(source: Source, chunk: ChunkIndex, indexes: Mapping[int, NDArray[Any]]) -> None:
    """Raise CorruptLogError if the log_times of a chunk do not match its messages."""
    times = [index["log_time"] for index in indexes.values() if len(index)]
    bounds = (
        [min(int(one.min()) for one in times), max(int(one.max()) for one in times)]
        if times
        else []
    )
    where = f"{source.reader.path}: the chunk at byte {chunk.chunk_start_offset}"
    if bounds and bounds != [chunk.message_start_time, chunk.message_end_time]:
        raise CorruptLogError(f"{where} has times that do not match its messages")
    if bounds and bounds[1] + source.delay_ns > _LAST_TIME:
        raise CorruptLogError(f"{where} has a log_time after the year 2262")


def _top_level_ids(reader: McapReader) -> set[int]:
    """Return the ids of the channels that are stored outside of chunks and summary."""
    found = set()
    for _, opcode, content in reader.records(len(MAGIC)):
        if opcode == Opcode.CHANNEL:
            found.add(int.from_bytes(content[:2], "little"))
        elif opcode == Opcode.DATA_END:
            break
    return found


def _taken(
    source: Source, records: memoryview, indexes: Mapping[int, NDArray[Any]]
) -> tuple[memoryview, dict[int, NDArray[Any]]]:
    """Return the messages in `indexes` for the new file, and their indexes by new channel id."""
    wanted = sorted(
        (offset, channel_id, time_ns)
        for channel_id, index in indexes.items()
        for time_ns, offset in index.tolist()
    )
    taken, entries = bytearray(), dict[int, list[tuple[int, int]]]()
    places = []
    for offset, channel_id, time_ns in wanted:
        _, length = RECORD_HEADER.unpack_from(records, offset)
        places.append((len(taken), channel_id, time_ns))
        entries.setdefault(source.ids[channel_id], []).append(
            (time_ns + source.delay_ns, len(taken))
        )
        taken += records[offset : offset + RECORD_HEADER_BYTES + length]
    view = memoryview(taken)
    for place, channel_id, time_ns in places:
        _renew(source, view, place, channel_id, time_ns)
    return view, {id_: np.array(pairs, INDEX_ENTRY) for id_, pairs in entries.items()}


def _renew(source: Source, view: memoryview, place: int, channel_id: int, time_ns: int) -> None:
    """Set channel id and times of the message at byte `place`; call `source.change` if needed."""
    if source.change is not None and source.changes(channel_id, time_ns, time_ns):
        _, length = RECORD_HEADER.unpack_from(view, place)
        payload = view[place + MESSAGE_HEADER.itemsize : place + RECORD_HEADER_BYTES + length]
        source.change(source.reader.channels[channel_id], time_ns, payload)
    opcode, length, _, sequence, log_time, publish_time = _HEADER.unpack_from(view, place)
    times = (log_time + source.delay_ns, (publish_time + source.delay_ns) % 2**64)
    _HEADER.pack_into(view, place, opcode, length, source.ids[channel_id], sequence, *times)
