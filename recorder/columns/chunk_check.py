"""Checks chunks against their indexes, and the summary against all of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Statistics
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.problem import Problem
from mcaprl.recorder.columns.chunks import CHUNK_HEAD, Scratch, chunk_header
from mcaprl.recorder.columns.joined import side_by_side
from mcaprl.recorder.columns.message_rows import (
    INDEX_ENTRY,
    MESSAGE_HEADER,
    RECORD_HEADER_BYTES,
    are_messages,
    index_bounds,
    message_index,
    parts_of,
    record_dtype,
    windows,
)
from mcaprl.recorder.columns.message_spans import joined_index
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import contents_of, parse_record

# What the header of a chunk and the summary both tell.
_TOLD = ("start_time", "end_time", "raw_bytes")


@dataclass(frozen=True)
class Piece:
    """K chunks that follow each other, decompressed side by side.

    Attributes:
        numbers: theirs, in the order of the file.
        chunks: as the summary, or a scan, tells of them.
        records: of all of them.
        stops: where those of each end.
    """

    numbers: slice
    chunks: list[ChunkIndex]
    records: memoryview
    stops: list[int]

    @classmethod
    def read(cls, reader: McapReader, numbers: slice, scratch: Scratch) -> Piece:
        """Decompress them; the records are there until `scratch` is used again.

        Raises:
            CorruptLogError: a chunk is damaged.
        """
        chunks = reader.chunks[numbers]
        if len(chunks) > 1:
            return cls(numbers, chunks, *side_by_side(reader, chunks, scratch))
        records = reader.chunk_records(chunks[0], scratch)
        return cls(numbers, chunks, records, [len(records)])

    def alone(self) -> Iterator[Piece]:
        """Each chunk by itself."""
        bounds = pairwise([0, *self.stops])
        for place, (chunk, (start, stop)) in enumerate(zip(self.chunks, bounds, strict=True)):
            number = self.numbers.start + place
            records = self.records[start:stop]
            yield Piece(slice(number, number + 1), [chunk], records, [len(records)])

    @property
    def bounds(self) -> NDArray[np.uint64]:
        """(K + 1,) where the records of each chunk begin, and those of the last one end."""
        return np.array([0, *self.stops], np.uint64)


def place(reader: McapReader, chunk: ChunkIndex) -> str:
    """Where a chunk is, what is in it, and of when."""
    known = (reader.channels.get(channel_id) for channel_id in chunk.message_index_offsets)
    topics = ", ".join(sorted(channel.topic for channel in known if channel)) or "unknown topics"
    times = f"log_time {chunk.message_start_time} to {chunk.message_end_time}"
    return f"chunk at byte {chunk.chunk_start_offset}, {topics}, {times}"


def check_piece(reader: McapReader, piece: Piece) -> list[Problem]:
    """Compare chunks with their own headers, message indexes, and what the summary tells of them.

    Raises:
        CorruptLogError: an index or a record is damaged.
    """
    if _is_sound(reader, piece):
        return []
    if len(piece.chunks) > 1:
        return [found for one in piece.alone() for found in check_piece(reader, one)]
    return _check_chunk(reader, piece.chunks[0], piece.records)


def _is_sound(reader: McapReader, piece: Piece) -> bool:
    """Whether the chunks hold nothing but messages that touch each other, and all agrees on them.

    What is not so may be right as well, but must be looked at record by record.
    """
    index, bounds = _joint_index(reader, piece), piece.bounds
    if index is None or (bounds[1:] == bounds[:-1]).any():
        return False
    # None is shorter than its header, so no length below is beyond 2**64.
    sizes = np.diff(index.offsets, append=bounds[-1:])
    firsts = np.searchsorted(index.offsets, bounds[:-1])
    begin_alike = firsts[-1] < len(sizes) and (index.offsets[firsts] == bounds[:-1]).all()
    if not begin_alike or (sizes < MESSAGE_HEADER.itemsize).any():
        return False
    times, told = index.log_times, reader.table.rows[piece.numbers]
    headers = windows(reader.view, told["offset"], CHUNK_HEAD)
    return bool(
        _are_told(piece.records, index, sizes)
        and (headers["start_time"] == np.minimum.reduceat(times, firsts)).all()
        and (headers["end_time"] == np.maximum.reduceat(times, firsts)).all()
        and all((headers[name] == told[name]).all() for name in _TOLD)
    )


class _JointIndex(NamedTuple):
    """What the indexes of a piece tell of its N messages, in the order of the records.

    Attributes:
        offsets: (N,) uint64, where each begins in the piece.
        channel_ids: (N,) uint16.
        log_times: (N,) uint64.
    """

    offsets: NDArray[np.uint64]
    channel_ids: NDArray[np.uint16]
    log_times: NDArray[np.uint64]


def _joint_index(reader: McapReader, piece: Piece) -> _JointIndex | None:
    """All indexes of a piece as one; None if one is damaged, or points outside of its chunk."""
    ids, places = reader.table.places_of_indexes(piece.numbers)
    try:
        begin_end = index_bounds(reader.view, places.tolist(), ids.tolist())
    except CorruptLogError:
        return None
    entries = joined_index(parts_of(reader.view, begin_end))
    counts = (begin_end[:, 1] - begin_end[:, 0]) // INDEX_ENTRY.itemsize
    # In which chunk each index is; then, for each of its entries, where that begins and its length.
    chunks = np.arange(len(piece.chunks)).repeat(reader.table.map_sizes[piece.numbers])
    starts = piece.bounds[:-1][chunks].repeat(counts)
    room = np.diff(piece.bounds)[chunks].repeat(counts)
    if (entries["offset"] >= room).any():
        return None
    offsets, ids, times = entries["offset"] + starts, ids.repeat(counts), entries["log_time"]
    if (offsets[1:] < offsets[:-1]).any():
        order = np.argsort(offsets, kind="stable")
        offsets, ids, times = offsets[order], ids[order], times[order]
    return _JointIndex(offsets, ids, times)


def _are_told(records: memoryview, index: _JointIndex, sizes: NDArray[np.uint64]) -> bool:
    """Whether what is there are messages of these sizes, as the index tells of them."""
    ids, times, size = index.channel_ids, index.log_times, int(sizes[0])
    if (sizes == size).all() and (ids == ids[0]).all():
        payload = np.dtype((np.void, size - MESSAGE_HEADER.itemsize))
        heads = np.frombuffer(records, record_dtype(payload))
        return are_messages(heads, int(ids[0])) and bool((heads["log_time"] == times).all())
    heads = windows(records, index.offsets, MESSAGE_HEADER)
    return bool(
        (heads["length"] == sizes - np.uint64(RECORD_HEADER_BYTES)).all()
        and (heads["opcode"] == Opcode.MESSAGE).all()
        and (heads["channel_id"] == ids).all()
        and (heads["log_time"] == times).all()
    )


def _check_chunk(reader: McapReader, chunk: ChunkIndex, records: memoryview) -> list[Problem]:
    """Likewise, of one chunk, record by record."""
    found, view = [], reader.view
    header = chunk_header(view, chunk.chunk_start_offset)
    told = (chunk.message_start_time, chunk.message_end_time, chunk.uncompressed_size)
    if told != (header.start_time, header.end_time, header.uncompressed_bytes):
        found.append("the summary does not tell what the chunk is")
    indexes = {
        channel_id: np.frombuffer(message_index(view, offset, channel_id), INDEX_ENTRY)
        for channel_id, offset in chunk.message_index_offsets.items()
    }
    found += _wrong_indexes(reader, indexes, contents_of(records).indexes)
    times = [index["log_time"] for index in indexes.values() if len(index)]
    if times:
        first, last = min(int(t.min()) for t in times), max(int(t.max()) for t in times)
        if (first, last) != (header.start_time, header.end_time):
            found.append("the times of the chunk are not those in it")
    return [Problem(what, place(reader, chunk)) for what in found]


def check_statistics(reader: McapReader) -> list[Problem]:
    """Compare the summary's counts with what is there."""
    found = []
    if not reader.summary_start:
        return []
    for _, opcode, content in reader.records(reader.summary_start):
        if opcode != Opcode.STATISTICS:
            continue
        told: Statistics = parse_record(opcode, content)
        counts = {
            channel_id: int(reader.spans(channel).counts.sum())
            for channel_id, channel in reader.channels.items()
        }
        pairs = [
            ("messages", told.message_count, sum(counts.values())),
            ("chunks", told.chunk_count, len(reader.chunks)),
            ("channels", told.channel_count, len(reader.channels)),
        ]
        pairs += [
            (f"messages of {reader.channels[id_].topic}", count, counts[id_])
            for id_, count in told.channel_message_counts.items()
            if id_ in counts
        ]
        found += [
            Problem(f"the summary tells of {told_} {name}, there are {count}", "the summary")
            for name, told_, count in pairs
            if told_ != count
        ]
    return found


def _wrong_indexes(
    reader: McapReader, told: dict[int, NDArray[Any]], actual: dict[int, NDArray[Any]]
) -> list[str]:
    found, none = [], np.empty(0, INDEX_ENTRY)
    for channel_id in sorted(told.keys() | actual.keys()):
        known = reader.channels.get(channel_id)
        topic = known.topic if known else f"channel {channel_id}"
        here = np.sort(told.get(channel_id, none), order="offset")
        there = np.sort(actual.get(channel_id, none), order="offset")
        if channel_id not in told:
            found.append(f"{topic} is not in the message index")
        elif not np.array_equal(here, there):
            found.append(f"the message index of {topic} is wrong")
    return found
