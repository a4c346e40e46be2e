"""Checks a chunk against its indexes, and the summary against all of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Statistics
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.chunks import chunk_header
from mcaprl.recorder.mcap_reader import McapReader
from mcaprl.recorder.mcap_records import (
    contents_of,
    parse_record,
    uniform_indexes,
)
from mcaprl.recorder.message_records import (
    FEW,
    INDEX_ENTRY,
    MESSAGE_HEADER,
    RECORD_HEADER_BYTES,
    gather,
    message_index,
)


@dataclass(frozen=True)
class Contradiction:
    """Two things in a file that cannot both be right.

    Attributes:
        what: is wrong.
        where: in the file.
    """

    what: str
    where: str


def place(reader: McapReader, chunk: ChunkIndex) -> str:
    """Where a chunk is, what is in it, and of when."""
    known = (reader.channels.get(channel_id) for channel_id in chunk.message_index_offsets)
    topics = ", ".join(sorted(channel.topic for channel in known if channel)) or "unknown topics"
    times = f"log_time {chunk.message_start_time} to {chunk.message_end_time}"
    return f"chunk at byte {chunk.chunk_start_offset}, {topics}, {times}"


def check_chunk(reader: McapReader, chunk: ChunkIndex, records: memoryview) -> list[Contradiction]:
    """Compare a chunk with its own header, its message indexes, and what the summary tells of it.

    Args:
        reader: of the file.
        chunk: as the summary, or a scan, tells of it.
        records: of the chunk.

    Raises:
        CorruptLogError: an index or a record is damaged.
    """
    found, view = [], reader.view
    header = chunk_header(view, chunk.chunk_start_offset)
    told = (chunk.message_start_time, chunk.message_end_time, chunk.uncompressed_size)
    if told != (header.start_time, header.end_time, header.uncompressed_bytes):
        found.append("the summary does not tell what the chunk is")
    indexes = {
        channel_id: np.frombuffer(message_index(view, offset, channel_id), INDEX_ENTRY)
        for channel_id, offset in chunk.message_index_offsets.items()
    }
    if not _is_complete(records, indexes):
        found += _wrong_indexes(reader, indexes, contents_of(records).indexes)
    times = [index["log_time"] for index in indexes.values() if len(index)]
    if times:
        first, last = min(int(t.min()) for t in times), max(int(t.max()) for t in times)
        if (first, last) != (header.start_time, header.end_time):
            found.append("the times of the chunk are not those in it")
    return [Contradiction(what, place(reader, chunk)) for what in found]


def check_statistics(reader: McapReader) -> list[Contradiction]:
    """Compare the summary's counts with what is there."""
    found = []
    if not reader.summary_start:
        return []
    for _, opcode, content in reader.records(reader.summary_start):
        if opcode != Opcode.STATISTICS:
            continue
        told: Statistics = parse_record(opcode, content)
        counts = {
            channel_id: sum(len(span) for span in reader.spans(channel))
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
            Contradiction(f"the summary tells of {told_} {name}, there are {count}", "the summary")
            for name, told_, count in pairs
            if told_ != count
        ]
    return found


def _is_complete(records: memoryview, indexes: dict[int, NDArray[Any]]) -> bool:
    """Whether the indexes tell of every byte of a chunk: messages that touch each other."""
    if not indexes or not len(records):
        return False
    are_few = sum(map(len, indexes.values())) < FEW
    found = contents_of(records).indexes if are_few else uniform_indexes(records)
    if found is not None:
        return found.keys() == indexes.keys() and all(
            np.array_equal(index.view("<u8"), found[channel_id].view("<u8"))
            for channel_id, index in indexes.items()
        )
    entries = np.concatenate(list(indexes.values()))
    ids = np.repeat(np.array(list(indexes), np.uint16), [len(index) for index in indexes.values()])
    if len(indexes) > 1 or (np.diff(entries["offset"].astype(np.int64)) < 0).any():
        order = np.argsort(entries["offset"], kind="stable")
        entries, ids = entries[order], ids[order]
    try:
        heads = gather(records, entries, MESSAGE_HEADER)
    except CorruptLogError:
        return False
    ends = entries["offset"] + heads["length"] + np.uint64(RECORD_HEADER_BYTES)
    return bool(
        len(entries)
        and entries["offset"][0] == 0
        and ends[-1] == len(records)
        and (ends[:-1] == entries["offset"][1:]).all()
        and (heads["opcode"] == Opcode.MESSAGE).all()
        and (heads["channel_id"] == ids).all()
        and (heads["log_time"] == entries["log_time"]).all()
    )


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
