"""Summary section of an MCAP file: its content, the state to append from, and checks of a file."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError, Problem
from mcaprl.recorder.columns.chunks import chunk_header, chunk_index_record
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


@dataclass
class Summary:
    """Summary of a file."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)  # Message counts by channel id
    chunks: list[ChunkIndex] = field(default_factory=list)  # Chunk indexes in file order
    metadata: list[MetadataIndex] = field(default_factory=list)  # Metadata indexes in file order
    # Attachment indexes in file order.
    attachments: list[AttachmentIndex] = field(default_factory=list)

    def add(self, record: McapRecord, offset: int, length: int) -> None:
        """Add a top-level record of `length` bytes at `offset`."""
        match record:
            case Schema():
                self.schemas[record.id] = record
            case Channel():
                self.channels[record.id] = record
                self.counts.setdefault(record.id, 0)
            case Metadata():
                self.metadata.append(MetadataIndex(offset, length, record.name))
            case Attachment():
                index = AttachmentIndex(
                    offset=offset,
                    length=length,
                    log_time=record.log_time,
                    create_time=record.create_time,
                    data_size=len(record.data),
                    name=record.name,
                    media_type=record.media_type,
                )
                self.attachments.append(index)

    def to_bytes(self, start: int) -> bytes:
        """Serialize the summary section and footer, which will be written at `start`."""
        builder = RecordBuilder()
        groups: list[SummaryOffset] = []
        every: list[tuple[Opcode, Iterable[McapRecord]]] = [
            (Opcode.SCHEMA, self.schemas.values()),
            (Opcode.CHANNEL, self.channels.values()),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self.chunks),
            (Opcode.ATTACHMENT_INDEX, self.attachments),
            (Opcode.METADATA_INDEX, self.metadata),
        ]
        for opcode, records in every:
            group_start = builder.count
            for record in records:
                # Most records are chunk indexes; `chunk_index_record` is faster than `write`.
                if isinstance(record, ChunkIndex):
                    builder.write(chunk_index_record(record))
                else:
                    record.write(builder)
            length = builder.count - group_start
            if length:
                groups.append(SummaryOffset(opcode, start + group_start, length))
        offsets_start = start + builder.count
        for group in groups:
            group.write(builder)
        summary = builder.end()
        Footer(start, offsets_start, 0).write(builder)
        footer = builder.end()
        crc = crc32(footer[:-4], crc32(summary))
        return bytes(summary + footer[:-4] + crc.to_bytes(4, "little") + MAGIC)

    def _statistics(self) -> Statistics:
        chunks = self.chunks
        return Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=self.counts,
            chunk_count=len(chunks),
            message_count=sum(self.counts.values()),
            message_end_time=max((chunk.message_end_time for chunk in chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in chunks), default=0),
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )


TopLevelRecord = Metadata | Schema | Channel | Attachment
"""Records that writers store outside of chunks."""
_DATA_END = struct.Struct("<BQI")


@dataclass
class WrittenState:
    """State in which a writer left a finished file."""

    summary: Summary
    end: int  # First byte after the data, where a writer can append
    crc: int
    top_level: list[TopLevelRecord]  # Top-level records in file order


def written_state(path: Path) -> WrittenState:
    """Open a finished file, and return the state that a writer needs to append to it."""
    try:
        return finished_state(McapReader(path))
    except CorruptLogError as error:
        what = str(error).removeprefix(f"{path}: ")
        raise LogError(
            f"{path} cannot be appended to: {what}; run `mcaprl recover {path} OUT` and"
            " append to OUT"
        ) from error


def finished_state(reader: McapReader) -> WrittenState:
    """Return the state of a finished file, from which a writer can append to it."""
    end = reader.summary_start - _DATA_END.size
    if end <= 0 or _DATA_END.unpack_from(reader.view, end)[:2] != (Opcode.DATA_END, 4):
        raise CorruptLogError("the file is not finished")
    (_, _, listed) = _DATA_END.unpack_from(reader.view, end)
    # Only this CRC covers metadata. A copy of damaged data would get valid CRCs.
    crc = crc32(reader.view[:end])
    if listed and crc != listed:
        raise CorruptLogError("the data section does not match its CRC")
    summary = Summary(chunks=list(reader.chunks))
    top_level: list[TopLevelRecord] = [*reader.schemas.values(), *reader.channels.values()]
    for topic in top_level:
        summary.add(topic, 0, 0)
    for channel in reader.channels.values():
        ranges = reader.message_ranges(channel)
        if any(messages.chunk is None for messages in ranges):
            raise CorruptLogError(f"{channel.topic} has messages outside of chunks")
        summary.counts[channel.id] = sum(map(len, ranges))
    for offset, opcode, content in reader.records(len(MAGIC)):
        if opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
            if opcode == Opcode.ATTACHMENT and not is_intact_attachment(content):
                raise CorruptLogError(f"the attachment at byte {offset} does not match its CRC")
            record: TopLevelRecord = parse_record(opcode, content)
            summary.add(record, offset, RECORD_HEADER_BYTES + len(content))
            top_level.append(record)
        elif opcode == Opcode.DATA_END:
            break
    return WrittenState(summary, end, crc, top_level)


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
    """Return whether a chunk contains exactly the messages that its indexes list."""
    # A chunk that also contains other records can be valid: the caller then compares each message.
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
    """Return whether a chunk has exactly one index's messages of one size."""
    # False if not compiled.
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
