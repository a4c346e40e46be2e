"""Summary section of an MCAP file, collected while the file is written."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

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

from mcaprl.recorder.columns.checksum import crc32
from mcaprl.recorder.columns.chunk_indexes import chunk_index_record
from mcaprl.recorder.columns.records import MAGIC


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
