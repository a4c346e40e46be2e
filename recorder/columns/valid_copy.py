"""Copy of the valid records of a damaged MCAP file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Metadata, Schema
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns.chunks import Scratch, chunk_header, chunk_records
from mcaprl.recorder.columns.message_rows import RECORD_HEADER_BYTES
from mcaprl.recorder.columns.records import contents_of, crc32, map_file, only, parse_record
from mcaprl.recorder.columns.salvage import Damage, ValidRecord, intact_summary, valid_records
from mcaprl.recorder.columns.writer import COMPRESSIONS, McapWriter
from mcaprl.texts import counted

# Messages outside of chunks are written in chunks of this number of bytes.
_UNCHUNKED_BYTES = 2**20

RestoreMetadata = Callable[[list[Metadata], Iterable[Channel]], list[Metadata]]
"""Function that corrects the metadata records of a damaged file, given its channels."""


def recover_file(
    source: Path, target: Path, damages: list[Damage], restore: RestoreMetadata
) -> None:
    """Write the valid records of a damaged file in chunks with new indexes and CRCs."""
    view = map_file(source)
    records = list(valid_records(view, damages))
    with writer_like(view, records, target) as writer:
        topics = _Topics(view, records, damages)
        for metadata in restore(topics.metadata, topics.channels.values()):
            writer.announce(metadata)
        copy = _Copy(view, writer, topics, damages)
        for offset, opcode, content in records:
            copy.take(offset, opcode, content)
        copy.flush()
        # Also write the channels that have no messages.
        for channel_id in topics.channels:
            topics.announce(channel_id, writer)


@contextmanager
def writer_like(
    view: memoryview, records: Iterable[ValidRecord], target: Path
) -> Iterator[McapWriter]:
    """Open a writer with the profile of a file and the compression of its first chunk."""
    profile, compression = "ros2", "zstd"
    for offset, opcode, content in records:
        if opcode == Opcode.HEADER:
            profile = parse_record(opcode, content).profile
        if opcode == Opcode.CHUNK:
            compression = chunk_header(view, offset).compression or "none"
            break
    if compression not in COMPRESSIONS:
        compression = "zstd"
    writer = McapWriter(target, compression=compression, overwrite=True, profile=profile)
    try:
        yield writer
        writer.close()
    finally:
        writer.abandon()


class _Topics:
    """Schemas, channels and metadata of the damaged file, each from its most reliable copy."""

    def __init__(
        self, view: memoryview, records: Sequence[ValidRecord], damages: list[Damage]
    ) -> None:
        self._damages = damages
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        # The copies in the summary are the most reliable, since the summary has a separate CRC.
        for record in intact_summary(view):
            if not isinstance(record, ChunkIndex):
                self.take(record, 0)
        self.metadata: list[Metadata] = []
        for offset, opcode, content in records:
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.take(parse_record(opcode, content), offset)
            elif opcode == Opcode.METADATA:
                self.metadata.append(parse_record(opcode, content))

    def take(self, record: Schema | Channel, offset: int) -> None:
        """Add a schema or channel; report a second definition of an id as damage."""
        known: dict[int, Any] = self.schemas if isinstance(record, Schema) else self.channels
        if known.setdefault(record.id, record) != record:
            what = f"{type(record).__name__.lower()} {record.id} has two definitions"
            self._damages.append(Damage(offset, 0, what))

    def announce(self, channel_id: int, writer: McapWriter) -> bool:
        """Write a channel and its schema once; return False if either is missing."""
        channel = self.channels.get(channel_id)
        if channel is None or (channel.schema_id and channel.schema_id not in self.schemas):
            return False
        if channel_id not in writer.channels:
            if channel.schema_id and channel.schema_id not in writer.schemas:
                writer.announce(self.schemas[channel.schema_id])
            writer.announce(channel)
        return True


class _Copy:
    """Writer of valid records that leaves out repeated chunks and unknown channels."""

    def __init__(
        self, view: memoryview, writer: McapWriter, topics: _Topics, damages: list[Damage]
    ) -> None:
        self._view, self._writer, self._topics, self._damages = view, writer, topics, damages
        # Offsets of the chunks read so far, by the CRC and length of their records. A second chunk
        # with equal records is dropped as a repetition, unless an intact summary lists it.
        self._seen: dict[tuple[int, int], list[int]] = {}
        self._listed = {
            record.chunk_start_offset
            for record in intact_summary(view)
            if isinstance(record, ChunkIndex)
        }
        self._unchunked, self._scratch = bytearray(), Scratch()

    def take(self, offset: int, opcode: int, content: memoryview) -> None:
        """Write a chunk or attachment; collect an unchunked message; ignore all other records."""
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
        """Write the collected unchunked messages as one chunk."""
        if self._unchunked:
            self._write(memoryview(bytes(self._unchunked)), 0, len(self._unchunked))
            self._unchunked = bytearray()

    def _take_chunk(self, offset: int, size: int) -> None:
        try:
            records = chunk_records(self._view, offset, self._scratch)
        except CorruptLogError as error:
            self._damages.append(Damage(offset, size, str(error)))
            return
        earlier = self._seen.setdefault((crc32(records), len(records)), [])
        if offset not in self._listed and any(
            bytes(chunk_records(self._view, one)) == records for one in earlier
        ):
            self._damages.append(Damage(offset, size, "a repeated chunk"))
            return
        earlier.append(offset)
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
                messages = counted(len(index), "message")
                what = f"{messages} of channel {channel_id}, which has no definition"
                self._damages.append(Damage(offset, 0, what))
        if len(known) < len(contents.indexes):
            records, known = only(records, known)
        if known:
            self._writer.write_records(records, known)
