"""Summary section of an MCAP file, and the state from which a writer appends to a finished file."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

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

from mcaprl.errors import CorruptLogError, LogError
from mcaprl.recorder.columns.chunks import chunk_index_record
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import (
    MAGIC,
    RECORD_HEADER_BYTES,
    crc32,
    is_intact_attachment,
    parse_record,
)


@dataclass
class Summary:
    """Summary of a file.

    Attributes:
        schemas: Schemas by id.
        channels: Channels by id.
        counts: Message counts by channel id.
        chunks: Chunk indexes in file order.
        metadata: Metadata indexes in file order.
        attachments: Attachment indexes in file order.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
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
    """State in which a writer left a finished file.

    Attributes:
        summary: Summary of the file.
        end: First byte after the data, where a writer can append.
        crc: CRC-32 of the data.
        top_level: Top-level records in file order.
    """

    summary: Summary
    end: int
    crc: int
    top_level: list[TopLevelRecord]


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
