"""Search for the valid records of a damaged MCAP file, and their copy into a new one.

MCAP has no synchronization markers. After a damaged record, the search first skips the length that
this record declares. If no valid record follows, the search tries each byte over a limited
distance. Then it looks only for chunks, whose record length and data length must agree. A record is
valid if its lengths agree and if serializing its parsed content reproduces its bytes. The CRC of a
chunk is checked only when the chunk is decompressed.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Metadata, Schema
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns.chunks import Scratch, chunk_header, chunk_records, parse_chunk_index
from mcaprl.recorder.columns.records import (
    INDEX_ENTRY,
    MAGIC,
    MESSAGE_HEADER,
    RECORD_HEADER,
    RECORD_HEADER_BYTES,
    contents_of,
    crc32,
    footer_of,
    map_file,
    only,
    parse_record,
    records_of,
)
from mcaprl.recorder.columns.writer import COMPRESSIONS, McapWriter
from mcaprl.texts import counted

ValidRecord = tuple[int, int, memoryview]  # Offset, opcode and content of a valid record

# Records with content that cannot be recomputed from other records.
_REWRITTEN = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT)
_SEARCHED = (*_REWRITTEN, Opcode.CHUNK, Opcode.MESSAGE_INDEX)
_CHUNK_NAME = struct.Struct("<QQQII")
_KNOWN = frozenset(int(opcode) for opcode in Opcode)
# The search tries every byte over this distance; beyond it, the search looks only for chunks.
_NEAR_BYTES = 2**16
_BLOCK_BYTES = 2**22


@dataclass(frozen=True)
class Damage:
    """Part of a file that cannot be read.

    Attributes:
        offset: Offset of the first byte.
        bytes: Number of bytes; 0 if the position of the damage is unknown.
        what: Description of the damage.
    """

    offset: int
    bytes: int
    what: str


def valid_records(view: memoryview, damages: list[Damage]) -> Iterator[ValidRecord]:
    """Yield the valid records of the data section; add each damaged range to `damages`."""
    offset = len(MAGIC)
    if bytes(view[:offset]) != MAGIC:
        damages.append(Damage(0, min(offset, len(view)), "no magic bytes"))
    while offset < len(view):
        content = _valid_record(view, offset)
        if content is None:
            following = _next_record(view, offset)
            what = "the rest of the file is cut off or damaged"
            if following < len(view):
                what = "a damaged record"
            damages.append(Damage(offset, following - offset, what))
            offset = following
            continue
        opcode = view[offset]
        if opcode == Opcode.DATA_END:
            if _ends_data(view, offset, content):
                return
            damages.append(Damage(offset, 0, "the data section does not match its CRC"))
        yield offset, opcode, content
        offset += RECORD_HEADER_BYTES + len(content)
        # Compare lengths first; otherwise, `bytes` would copy the rest of the file for each record.
        if len(view) - offset == len(MAGIC) and bytes(view[offset:]) == MAGIC:
            return


def _ends_data(view: memoryview, offset: int, content: memoryview) -> bool:
    """Return whether a DataEnd record is the end: by its CRC, or else as no chunk follows."""
    (crc,) = struct.unpack("<I", content)
    if crc:
        return bool(crc32(view[:offset]) == crc)
    return _next_chunk(view, offset, len(view)) == len(view)


def _valid_record(view: memoryview, offset: int) -> memoryview | None:
    """Return the content of the record at `offset`; None if it is not valid."""
    if offset + RECORD_HEADER_BYTES > len(view):
        return None
    opcode, length = RECORD_HEADER.unpack_from(view, offset)
    start = offset + RECORD_HEADER_BYTES
    # Opcodes from 0x80 on are for private use.
    if (opcode not in _KNOWN and opcode < 0x80) or length > len(view) - start:
        return None
    content = view[start : start + length]
    return content if _is_valid(opcode, content) else None


def _is_valid(opcode: int, content: memoryview) -> bool:
    match opcode:
        case Opcode.CHUNK:
            return _is_chunk(content)
        case Opcode.MESSAGE_INDEX:
            if len(content) < 6:
                return False
            (entries,) = struct.unpack_from("<I", content, 2)
            return len(content) == 6 + int(entries) and entries % INDEX_ENTRY.itemsize == 0
        case Opcode.MESSAGE:
            return len(content) >= MESSAGE_HEADER.itemsize - RECORD_HEADER_BYTES
        case Opcode.DATA_END:
            return len(content) == 4
        case Opcode.FOOTER:
            return len(content) == 20
        case _ if opcode == Opcode.HEADER or opcode in _REWRITTEN:
            return _repeats(opcode, content)
    return True


def _repeats(opcode: int, content: memoryview) -> bool:
    """Return whether parsing and serializing a record returns the same bytes."""
    try:
        builder = RecordBuilder()
        parse_record(opcode, content).write(builder)
    except (CorruptLogError, struct.error):
        return False
    again, original = bytes(builder.end()[RECORD_HEADER_BYTES:]), bytes(content)
    # Writers may omit the CRC of an attachment.
    without_crc = opcode == Opcode.ATTACHMENT and original[-4:] == bytes(4)
    return again == original or (without_crc and again[:-4] == original[:-4])


def _is_chunk(content: memoryview) -> bool:
    try:
        *_, name_bytes = _CHUNK_NAME.unpack_from(content)
        (data_bytes,) = struct.unpack_from("<Q", content, _CHUNK_NAME.size + name_bytes)
    except struct.error:
        return False
    return bool(len(content) == _CHUNK_NAME.size + name_bytes + 8 + data_bytes)


def _next_record(view: memoryview, damaged: int) -> int:
    """Return the offset of the next valid record after a damaged one, or the length of the file."""
    if damaged + RECORD_HEADER_BYTES <= len(view):
        _, length = RECORD_HEADER.unpack_from(view, damaged)
        following = int(damaged + RECORD_HEADER_BYTES + length)
        is_valid = (
            following < len(view) and view[following] in _KNOWN and _valid_record(view, following)
        )
        # A wrong length can point beyond valid chunks; check that none would be skipped.
        if is_valid and _next_chunk(view, damaged + 1, following) == following:
            return following
    near = min(damaged + _NEAR_BYTES, len(view))
    for offset in range(damaged + 1, near):
        if view[offset] in _SEARCHED and _valid_record(view, offset) is not None:
            return offset
    return _next_chunk(view, near, len(view))


def _next_chunk(view: memoryview, start: int, stop: int) -> int:
    """Return the offset of the first valid chunk from `start` on; `stop` if there is none."""
    bytes_ = np.frombuffer(view, np.uint8)
    for block in range(start, stop, _BLOCK_BYTES):
        part = bytes_[block : min(block + _BLOCK_BYTES, stop)]
        found = block + np.flatnonzero(part == int(Opcode.CHUNK))
        found = found[found + RECORD_HEADER_BYTES <= len(bytes_)]
        # The lengths of chunks are below 2**40, so their three high bytes are 0.
        for high in (6, 7, 8):
            found = found[bytes_[found + high] == 0]
        for offset in found.tolist():
            if _valid_record(view, offset) is not None:
                return int(offset)
    return stop


def intact_summary(view: memoryview) -> list[Any]:
    """Return schemas, channels and chunk indexes of the summary; [] if the summary is damaged."""
    try:
        footer = footer_of(view)
    except CorruptLogError:
        return []
    if footer is None or not footer.summary_start or not footer.summary_crc:
        return []
    return [
        parse_chunk_index(content)
        if opcode == Opcode.CHUNK_INDEX
        else parse_record(opcode, content)
        for _, opcode, content in records_of(view, footer.summary_start)
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK_INDEX)
    ]


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
