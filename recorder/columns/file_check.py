"""Checks of a file: summary, CRCs, attachments, and chunks against their indexes."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Statistics
from numpy.typing import NDArray

from mcaprl.errors import Problem
from mcaprl.recorder.columns.chunks import chunk_header
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import (
    INDEX_ENTRY,
    MAGIC,
    MESSAGE_HEADER,
    RECORD_HEADER_BYTES,
    FieldCopy,
    are_adjacent,
    contents_of,
    crc32,
    is_intact_attachment,
    message_index,
    parse_record,
    windows,
)


def place(reader: McapReader, chunk: ChunkIndex) -> str:
    """Describe a chunk by its offset, topics and times."""
    known = (reader.channels.get(channel_id) for channel_id in chunk.message_index_offsets)
    topics = ", ".join(sorted(channel.topic for channel in known if channel)) or "unknown topics"
    times = f"log_time {chunk.message_start_time} to {chunk.message_end_time}"
    return f"chunk at byte {chunk.chunk_start_offset}, {topics}, {times}"


def check_chunk(reader: McapReader, chunk: ChunkIndex, records: memoryview) -> list[Problem]:
    """Compare the records of a chunk with its header, its indexes, and its entry in the summary."""
    found = []
    header = chunk_header(reader.view, chunk.chunk_start_offset)
    listed = (chunk.message_start_time, chunk.message_end_time, chunk.uncompressed_size)
    if listed != (header.start_time, header.end_time, header.uncompressed_bytes):
        found.append("the summary does not match the header of the chunk")
    indexes = {
        channel_id: message_index(reader.view, offset, channel_id)
        for channel_id, offset in chunk.message_index_offsets.items()
    }
    if not _has_only(records, indexes):
        found += _wrong_indexes(reader, indexes, contents_of(records).indexes)
    times = [index["log_time"] for index in indexes.values() if len(index)]
    if times:
        first, last = min(int(t.min()) for t in times), max(int(t.max()) for t in times)
        if (first, last) != (header.start_time, header.end_time):
            found.append("the times of the chunk do not match its messages")
    return [Problem(what, place(reader, chunk)) for what in found]


def _has_only(records: memoryview, indexes: dict[int, NDArray[Any]]) -> bool:
    """Return whether a chunk contains exactly the messages that its indexes list.

    A chunk that also contains other records can be valid. If this function returns False, the
    caller therefore compares each message with the indexes.
    """
    if _has_alike(records, indexes):
        return True
    ids = np.repeat(list(indexes), [len(index) for index in indexes.values()])
    if not len(ids):
        return False
    index = np.concatenate(list(indexes.values()))
    if (index["offset"][1:] < index["offset"][:-1]).any():
        order = np.argsort(index["offset"], kind="stable")
        ids, index = ids[order], index[order]
    offsets = index["offset"]
    if offsets[0] or offsets[-1] >= len(records):
        return False
    # Reject records that are shorter than a header: the subtraction below would wrap around.
    sizes = np.diff(offsets, append=np.uint64(len(records)))
    if (sizes < MESSAGE_HEADER.itemsize).any():
        return False
    if (sizes == sizes[0]).all():
        heads = np.ndarray(len(sizes), MESSAGE_HEADER, records, strides=(int(sizes[0]),))
    else:
        heads = windows(records, offsets, MESSAGE_HEADER)
    return bool(
        (heads["length"] == sizes - np.uint64(RECORD_HEADER_BYTES)).all()
        and (heads["opcode"] == Opcode.MESSAGE).all()
        and (heads["channel_id"] == ids).all()
        and (heads["log_time"] == index["log_time"]).all()
    )


def _has_alike(records: memoryview, indexes: dict[int, NDArray[Any]]) -> bool:
    """Return whether a chunk contains exactly the messages of one index, all of one size.

    Return False if the compiled module was not built.
    """
    if len(indexes) != 1:
        return False
    ((channel_id, index),) = indexes.items()
    size, rest = divmod(len(records), max(len(index), 1))
    return (
        len(index) > 0
        and rest == 0
        and size >= MESSAGE_HEADER.itemsize
        and index["offset"][0] == 0
        and are_adjacent(index["offset"], size, len(records))
        and FieldCopy(channel_id, size)(records, index)
    )


def check_statistics(reader: McapReader) -> list[Problem]:
    """Compare the counts in the summary with the numbers of records in the file."""
    records = reader.records(reader.summary_start) if reader.summary_start else ()
    triples: list[tuple[str, int, int]] = []
    for content in (content for _, opcode, content in records if opcode == Opcode.STATISTICS):
        listed: Statistics = parse_record(Opcode.STATISTICS, content)
        counts = {
            channel_id: sum(map(len, reader.message_ranges(channel)))
            for channel_id, channel in reader.channels.items()
        }
        triples += [
            ("messages", listed.message_count, sum(counts.values())),
            ("chunks", listed.chunk_count, len(reader.chunks)),
            ("channels", listed.channel_count, len(reader.channels)),
        ]
        triples += [
            (f"messages of {reader.channels[id_].topic}", count, counts[id_])
            for id_, count in listed.channel_message_counts.items()
            if id_ in counts
        ]
    return [
        Problem(f"the summary counts {wrong} {name}, but the file has {count}", "the summary")
        for name, wrong, count in triples
        if wrong != count
    ]


def _wrong_indexes(
    reader: McapReader, listed: dict[int, NDArray[Any]], actual: dict[int, NDArray[Any]]
) -> list[str]:
    found, none = [], np.empty(0, INDEX_ENTRY)
    for channel_id in sorted(listed.keys() | actual.keys()):
        known = reader.channels.get(channel_id)
        topic = known.topic if known else f"channel {channel_id}"
        here = np.sort(listed.get(channel_id, none), order="offset")
        there = np.sort(actual.get(channel_id, none), order="offset")
        if channel_id not in listed:
            found.append(f"{topic} is not in the message index")
        elif not np.array_equal(here, there):
            found.append(f"the message index of {topic} is wrong")
    return found


def check_file(reader: McapReader) -> list[Problem]:
    """Check the presence of a summary and the CRCs of the data section and attachments."""
    found = []
    if not reader.complete:
        what = (
            "the file has no summary, so viewers cannot open it: its writer was killed or is still"
            " running"
        )
        found.append(Problem(what, f"after byte {reader.data_end}"))
    end = None
    for offset, opcode, content in reader.records(len(MAGIC)):
        if opcode == Opcode.ATTACHMENT and not is_intact_attachment(content):
            found.append(Problem("an attachment does not match its CRC", f"byte {offset}"))
        if opcode == Opcode.DATA_END:
            end = offset
            found += _check_data_end(reader, offset, content)
            break
    if reader.complete and end is None:
        where = "the records between header and summary"
        found.append(Problem("the data section has no DataEnd record", where))
    return found


def _check_data_end(reader: McapReader, offset: int, content: memoryview) -> list[Problem]:
    record_end = offset + RECORD_HEADER_BYTES + len(content)
    if len(content) < 4 or (reader.summary_start and record_end != reader.summary_start):
        return [Problem("the data section's end is damaged", f"byte {offset}")]
    (crc,) = struct.unpack_from("<I", content)
    if crc and crc32(reader.view[:offset]) != crc:
        where = f"bytes 0 to {offset}"
        return [Problem("the data section does not match its CRC", where)]
    return []
