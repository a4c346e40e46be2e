"""Copy of the valid records of a damaged MCAP file into a new, valid one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.format.metadata import METADATA_NAME
from mcaprl.recorder.format.reading import (
    RECORD_HEADER_BYTES,
    Damage,
    Scratch,
    ValidRecord,
    chunk_records,
    contents_of,
    crc32,
    intact_summary,
    only,
    parse_record,
)
from mcaprl.recorder.format.topics import STEP_TOPIC
from mcaprl.recorder.format.writing import McapWriter

# Unchunked messages are written in chunks of this size.
_UNCHUNKED_BYTES = 2**20


def copy_records(
    view: memoryview, records: Sequence[ValidRecord], writer: McapWriter, damages: list[Damage]
) -> None:
    """Write the records in chunks with new indexes and CRCs.

    Args:
        view: Content of the damaged file.
        records: Valid records of that file.
        writer: Writer of the new file.
        damages: List to which records that cannot be copied are added.
    """
    topics = _Topics(view, records, damages)
    copy = _Copy(view, writer, topics, damages)
    for metadata in topics.metadata:
        writer.announce(metadata)
    for offset, opcode, content in records:
        copy.take(offset, opcode, content)
    copy.flush()
    topics.announce_rest(writer)


class _Topics:
    """Schemas, channels and metadata of the damaged file, each from its most reliable copy."""

    def __init__(
        self,
        view: memoryview,
        records: Sequence[ValidRecord],
        damages: list[Damage],
    ) -> None:
        self._damages = damages
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        # Records of the summary have a CRC; those of the data section share one with all others.
        for record in intact_summary(view):
            self.take(record, 0)
        self.metadata: list[Metadata] = []
        for offset, opcode, content in records:
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.take(parse_record(opcode, content), offset)
            elif opcode == Opcode.METADATA:
                self.metadata.append(parse_record(opcode, content))
        self._restore_description()

    def take(self, record: Schema | Channel, offset: int) -> None:
        """Add a schema or channel; of two with one id, the first is kept."""
        known: dict[int, Any] = self.schemas if isinstance(record, Schema) else self.channels
        if known.setdefault(record.id, record) != record:
            what = f"{type(record).__name__.lower()} {record.id} has two definitions"
            self._damages.append(Damage(offset, 0, what))

    def announce(self, channel_id: int, writer: McapWriter) -> bool:
        """Write a channel and its schema unless they are written; return whether they are known."""
        channel = self.channels.get(channel_id)
        if channel is None or (channel.schema_id and channel.schema_id not in self.schemas):
            return False
        if channel_id not in writer.channels:
            if channel.schema_id and channel.schema_id not in writer.schemas:
                writer.announce(self.schemas[channel.schema_id])
            writer.announce(channel)
        return True

    def announce_rest(self, writer: McapWriter) -> None:
        """Write the channels without messages."""
        for channel_id in self.channels:
            self.announce(channel_id, writer)

    def _restore_description(self) -> None:
        """Replace the metadata record with its copy in the channel of `/rl/step`."""
        copies = [
            channel.metadata
            for channel in self.channels.values()
            if channel.topic == STEP_TOPIC and "format_version" in channel.metadata
        ]
        if not copies:
            return
        records = [record for record in self.metadata if record.name == METADATA_NAME]
        if any(record.metadata != copies[0] for record in records):
            self._damages.append(Damage(0, 0, "the metadata record and its copy differ"))
        others = [record for record in self.metadata if record.name != METADATA_NAME]
        self.metadata = [Metadata(METADATA_NAME, copies[0]), *others]


class _Copy:
    """Writer of valid records that leaves out repeated chunks and unknown channels."""

    def __init__(
        self, view: memoryview, writer: McapWriter, topics: _Topics, damages: list[Damage]
    ) -> None:
        self._view, self._writer, self._topics, self._damages = view, writer, topics, damages
        self._seen: set[tuple[int, int]] = set()
        self._unchunked, self._scratch = bytearray(), Scratch()

    def take(self, offset: int, opcode: int, content: memoryview) -> None:
        """Write the content of a record."""
        if opcode == Opcode.CHUNK:
            self.flush()
            self._take_chunk(offset, len(content))
        elif opcode == Opcode.MESSAGE:
            self._unchunked += self._view[offset : offset + RECORD_HEADER_BYTES + len(content)]
            if len(self._unchunked) > _UNCHUNKED_BYTES:
                self.flush()
        elif opcode == Opcode.ATTACHMENT:
            self._writer.announce(parse_record(opcode, content))

    def flush(self) -> None:
        """Write the unchunked messages so far as a chunk."""
        if self._unchunked:
            self._write(memoryview(bytes(self._unchunked)), 0, len(self._unchunked))
            self._unchunked = bytearray()

    def _take_chunk(self, offset: int, size: int) -> None:
        try:
            records = chunk_records(self._view, offset, self._scratch)
        except CorruptLogError as error:
            self._damages.append(Damage(offset, size, str(error)))
            return
        key = (crc32(records), len(records))
        if key in self._seen:
            self._damages.append(Damage(offset, size, "a chunk that is in the file twice"))
            return
        self._seen.add(key)
        self._write(records, offset, size)

    def _write(self, records: memoryview, offset: int, size: int) -> None:
        try:
            contents = contents_of(records)
        except CorruptLogError as error:
            self._damages.append(Damage(offset, size, str(error)))
            return
        for topic in contents.topics:
            self._topics.take(topic, offset)
        known: dict[int, NDArray[Any]] = {}
        for channel_id, index in contents.indexes.items():
            if self._topics.announce(channel_id, self._writer):
                known[channel_id] = index
            else:
                what = f"{len(index)} messages of channel {channel_id}, which has no definition"
                self._damages.append(Damage(offset, 0, what))
        if len(known) < len(contents.indexes):
            records, known = only(records, known)
        if known:
            self._writer.write_records(records, known)
