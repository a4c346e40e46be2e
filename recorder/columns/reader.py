"""Reader of MCAP files: summary, channels, and positions of messages.

The file is mapped into memory, and only the chunks of requested topics are read. The reader checks
each chunk against its CRC and each message against its index entry.

Files of any writer are supported. The reader searches for records that the summary does not list:
chunks and messages between the listed chunks, and schemas, channels and messages inside chunks. A
file without a summary is scanned from the start; its writer was killed or is still running.
"""

from __future__ import annotations

import hashlib
import os
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    ChunkIndex,
    Footer,
    McapRecord,
    Metadata,
    Schema,
    Statistics,
)
from numpy.typing import NDArray

from mcaprl.errors import BAG_HINT, CorruptLogError, LogError, NotMcapError
from mcaprl.recorder.columns.chunks import (
    ChunkIndexes,
    Scratch,
    chunk_header,
    chunk_records,
    indexes_of_one,
    parse_chunk_index,
)
from mcaprl.recorder.columns.records import (
    INDEX_ENTRY,
    MAGIC,
    MESSAGE_HEADER,
    MESSAGE_START,
    RECORD_HEADER,
    RECORD_HEADER_BYTES,
    ChunkContents,
    MessageRange,
    MessageRanges,
    UnindexedMessages,
    contents_of,
    crc32,
    footer_of,
    is_intact_attachment,
    map_unchanged,
    message_index,
    parse_record,
    records_of,
    release,
    start_of_summary,
)
from mcaprl.storage.remote import RemotePath, as_path

_RELEASED_BYTES = 1 << 28
"""Size of the chunks after which the memory of a file's pages is given back."""
# Number of bytes at the start and at the end of a remote file that are fetched when it is opened.
_HEAD_BYTES, _TAIL_BYTES = 2**16, 2**18
_OTHER_FILES = {
    b"#ROSBAG V": f"is a ROS 1 bag; {BAG_HINT}",
    b"SQLite format 3": f"is an SQLite database, as of rosbag2; {BAG_HINT}",
    b"\x28\xb5\x2f\xfd": "is compressed with zstd",
}
"""Descriptions of files that are often given instead of MCAP files, by their first bytes."""
_SUMMARY = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS)
_CHANNEL_ID = struct.Struct("<H")
_TOP_LEVEL = (Opcode.METADATA, Opcode.SCHEMA, Opcode.CHANNEL)


class McapReader:
    """MCAP file that is open for reading."""

    def __init__(self, path: str | Path) -> None:
        """Map the file, read its summary, and search for records that it does not list."""
        self.path = as_path(path)
        self._remote = self.path.remote if isinstance(self.path, RemotePath) else None
        self._view, self._state = map_unchanged(self.path)
        size = len(self._view)
        self.fetch([(0, _HEAD_BYTES), (size - _TAIL_BYTES, size)])
        if bytes(self._view[: len(MAGIC)]) != MAGIC:
            start = bytes(self._view[:16])
            kinds = (kind for magic, kind in _OTHER_FILES.items() if start.startswith(magic))
            raise NotMcapError(
                f"{self.path} is not an MCAP file: it {next(kinds, 'has no magic bytes')}"
            )
        self._named = _Named(self.path)
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        # Metadata records by name. If several have the same name, the first one is kept.
        self.metadata: dict[str, dict[str, str]] = {}
        self.data_end = 0  # First byte after the last record that was read from the data section
        self._counts: dict[int, int] = {}
        unchunked = UnindexedMessages()
        # Offset and records of the latest chunk, kept because callers usually read all messages of
        # a chunk one after another.
        self._last_chunk = (-1, memoryview(b""))
        self._touched_bytes = 0
        self._contents: dict[int, ChunkContents] = {}
        with self._named:
            footer = self._footer()
        # Whether the file ends with a footer; if not, it was cut off or is being written.
        self.complete = footer is not None
        # First byte of the summary; 0 if there is none.
        self.summary_start = footer.summary_start if footer is not None else 0
        if not self.summary_start:
            # Without a summary, all records are read.
            self.fetch([(0, size)])
        self.chunks = self._read_summary()  # Indexes of all chunks, in file order
        self._summary_has_topics = bool(self.channels)
        self._read_between_chunks(unchunked)
        self._unchunked = unchunked.indexes()
        if self._unchunked:
            self._check_data_crc()
        self._find_topics_in_chunks()

    @property
    def view(self) -> memoryview:
        """Bytes of the file; a remote file is fetched completely."""
        self.fetch([(0, len(self._view))])
        return self._view

    @property
    def is_remote(self) -> bool:
        """Whether the file is on another machine."""
        return self._remote is not None

    @property
    def checksum(self) -> str:
        """SHA-256 of the offsets, sizes and CRCs of the chunks; without CRCs, also of the mtime."""
        digest = hashlib.sha256(str(len(self.view)).encode())
        has_crcs = bool(self.chunks)
        for chunk in self.chunks:
            header = chunk_header(self.view, chunk.chunk_start_offset)
            digest.update(f"{header.data.start} {header.uncompressed_bytes} {header.crc} ".encode())
            has_crcs &= header.crc != 0
        if not has_crcs:
            digest.update(str(self.path.stat().st_mtime_ns).encode())
        return digest.hexdigest()

    def fetch(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Fetch ranges of bytes of a remote file. Do nothing for a local file."""
        if self._remote is not None:
            self._remote.fetch(ranges)

    def fetch_chunks(self, parts: Iterable[MessageRange]) -> None:
        """Fetch chunks and indexes of message ranges in parallel. Do nothing for a local file."""
        if self._remote is not None:
            chunks = [part.chunk for part in parts]
            if None in chunks:
                self.fetch([(0, len(self._view))])
            self.fetch([(one.chunk_start_offset, end_of(one)) for one in chunks if one is not None])

    def _footer(self) -> Footer | None:
        """Return the footer; None if the file does not end with one."""
        if self._remote is not None:
            start = start_of_summary(self._view)
            self.fetch([(start, len(self._view))] if start else [])
        return footer_of(self._view)

    def check_unchanged(self) -> None:
        """Check that the file was not changed in place since it was opened."""
        # Reading beyond the end of a truncated file would kill the process. Our writers replace
        # finished files, and readers keep the old content. An unfinished file may grow.
        if self._remote is not None:
            # The local copy of a remote file changes whenever parts are fetched, so it is not
            # checked.
            return
        try:
            now, before = os.stat(self.path), self._state
        except OSError:
            # The file was removed from its path, but its content remains mapped.
            return
        if not os.path.samestat(now, before):
            return
        is_same = (now.st_size, now.st_mtime_ns) == (before.st_size, before.st_mtime_ns)
        if not is_same and (self.complete or now.st_size < before.st_size):
            raise LogError(
                f"{self.path} was changed by another program while it was open: reopen it"
            )

    def channels_of(self, topic: str) -> list[Channel]:
        """Return the channels of a topic, sorted by id; each writer may have its own channel."""
        found = [channel for channel in self.channels.values() if channel.topic == topic]
        return sorted(found, key=lambda channel: channel.id)

    def channel_of(self, topic: str) -> Channel | None:
        """Return the channel of a topic; None if the file does not have the topic."""
        found = self.channels_of(topic)
        if len(found) > 1:
            raise LogError(
                f"{self.path}: {len(found)} channels have the topic {topic}; expected one"
            )
        return found[0] if found else None

    def type_of(self, channel: Channel) -> str:
        """Return the name of the type of a channel's messages; empty if it has no schema."""
        schema = self.schemas.get(channel.schema_id)
        return schema.name if schema is not None else ""

    def schema_of(self, channel: Channel) -> Schema:
        """Return the schema of a channel."""
        schema = self.schemas.get(channel.schema_id)
        if schema is None:
            raise CorruptLogError(f"{self.path}: {channel.topic} has no schema")
        return schema

    def message_ranges(self, channel: Channel) -> MessageRanges:
        """Return the positions of the messages of a channel, in file order."""
        # Only chunks without an index are decompressed. The index of a chunk of one channel is read
        # at first use, if its length agrees with the summary, so that a few rows need few indexes.
        if self._remote is not None:
            # Fetch the indexes of all chunks with several channels in one call, not with one
            # request for each chunk.
            others = [self.chunks[k] for k in np.flatnonzero(self.chunks.channels < 0).tolist()]
            places = [one for one in others if one.message_index_offsets]
            starts = [one.chunk_start_offset + one.chunk_length for one in places]
            self.fetch(zip(starts, map(end_of, places), strict=True))
        # The ranges refer to this reader, so the reader does not store them: a file stays open
        # until its reader is deleted, and a cycle of references would delay that.
        count, ranges = self._counts.get(channel.id), self._find_ranges(channel.id, lazily=True)
        found = int(ranges.counts.sum())
        if found != count:
            ranges = self._find_ranges(channel.id, lazily=False)
            found = int(ranges.counts.sum())
        if count not in (None, found):
            raise CorruptLogError(
                f"{self.path}: the summary counts {count} messages of {channel.topic}, but the"
                f" message indexes have {found}"
            )
        return ranges

    def _find_ranges(self, channel_id: int, *, lazily: bool) -> MessageRanges:
        def read(part: MessageRange) -> NDArray[Any]:
            assert part.chunk is not None
            offset = part.chunk.message_index_offsets[channel_id]
            return self._index_at(channel_id, offset, len(part))

        def range_of(number: int, count: int) -> MessageRange:
            return MessageRange(self.chunks[number], count, read)

        chunks = self.chunks
        is_alone = chunks.channels == channel_id
        may_have = is_alone | (chunks.channels < 0)
        is_alone[self._certain :], may_have[self._certain :] = False, True
        numbers = np.flatnonzero(may_have)
        counts, made = chunks.counts[numbers], dict[int, MessageRange]()
        for place in np.flatnonzero(~is_alone[numbers]).tolist() if lazily else range(len(numbers)):
            number = int(numbers[place])
            index = self._index_in(channel_id, number)
            made[place] = MessageRange.of_index(chunks[number], index)
            counts[place] = len(index)
        if channel_id in self._unchunked:
            index = self._unchunked[channel_id]
            made[len(counts)] = MessageRange.of_index(None, index)
            counts, numbers = np.append(counts, len(index)), np.append(numbers, -1)
        # A writer may store empty indexes, for example of all channels in each chunk.
        return MessageRanges(counts, numbers, range_of, made)

    @property
    def _certain(self) -> int:
        """Number of chunks before the first one that may lack some of its indexes."""
        # A writer that was killed may have written only some indexes of the last chunk.
        return len(self.chunks) if self.complete else max(len(self.chunks) - 1, 0)

    def _index_in(self, channel_id: int, number: int) -> NDArray[Any]:
        """Return the index of the messages of a channel in a chunk; it may be empty."""
        chunk = self.chunks[number]
        offsets = chunk.message_index_offsets
        if not offsets or number >= self._certain:
            found = self._contents_of(chunk).indexes.get(channel_id)
            return np.empty(0, INDEX_ENTRY) if found is None else found
        if channel_id in offsets:
            return self._index_at(channel_id, offsets[channel_id])
        return np.empty(0, INDEX_ENTRY)

    def records_of(self, messages: MessageRange, scratch: Scratch | None = None) -> memoryview:
        """Return the bytes with these messages: the records of a chunk, or the whole file."""
        if messages.chunk is not None:
            return self.chunk_records(messages.chunk, scratch)
        self.check_unchanged()
        return self.view

    def chunk_records(self, chunk: ChunkIndex, scratch: Scratch | None = None) -> memoryview:
        """Return a chunk's checked records, valid until `scratch` is used again; one per file."""
        start = chunk.chunk_start_offset
        last, kept = self._last_chunk if scratch is None else scratch.kept
        if last == start:
            return kept
        self.check_unchanged()
        self.fetch([(start, end_of(chunk))])
        # The pages of a mapped file count as memory of the process until they are given back.
        self._touched_bytes += end_of(chunk) - start
        if self._touched_bytes > _RELEASED_BYTES:
            self._touched_bytes = 0
            release(self._view)
        with self._named:
            records = chunk_records(self._view, start, scratch)
        if scratch is None:
            self._last_chunk = start, records
        else:
            scratch.kept = start, records
        return records

    def messages(self, channel: Channel) -> Iterator[tuple[int, bytes]]:
        """Yield log_time and bytes of each message of a channel."""
        for part in self.message_ranges(channel):
            records = self.records_of(part)
            for time_ns, offset in part.index.tolist():
                yield time_ns, self.message(records, channel, time_ns, offset)

    def message(self, records: memoryview, channel: Channel, time_ns: int, offset: int) -> bytes:
        """Return the payload of a message, given the time and offset in its index entry."""
        start = offset + MESSAGE_HEADER.itemsize
        if start <= len(records):
            opcode, length = RECORD_HEADER.unpack_from(records, offset)
            found_id, _, found_ns = MESSAGE_START.unpack_from(records, offset + RECORD_HEADER.size)
            end = offset + RECORD_HEADER.size + length
            found = (opcode, found_id, found_ns)
            if found == (Opcode.MESSAGE, channel.id, time_ns) and start <= end <= len(records):
                return bytes(records[start:end])
        raise CorruptLogError(
            f"{self.path}: the message of {channel.topic} at byte {offset} of its chunk does not"
            " match its index entry"
        )

    def attachment(self, name: str) -> bytes | None:
        """Return the data of the last attachment with this name; None if there is none."""
        self.check_unchanged()
        found = None
        with self._named:
            for offset, opcode, content in self.records(len(MAGIC)):
                if opcode == Opcode.DATA_END:
                    break
                if opcode == Opcode.ATTACHMENT:
                    attachment: Attachment = parse_record(opcode, content)
                    if attachment.name == name:
                        if not is_intact_attachment(content):
                            raise CorruptLogError(
                                f"the attachment {name} at byte {offset} is damaged"
                            )
                        found = bytes(attachment.data)
        return found

    def records(self, start: int) -> Iterator[tuple[int, int, memoryview]]:
        """Yield offset, opcode and content of each whole record from `start` on."""
        return records_of(self.view, start)

    def _index_at(self, channel_id: int, offset: int, count: int | None = None) -> NDArray[Any]:
        self.check_unchanged()
        if self._remote is not None:
            self.fetch([(offset, offset + RECORD_HEADER_BYTES)])
            _, length = RECORD_HEADER.unpack_from(self._view, offset)
            self.fetch([(offset, offset + RECORD_HEADER_BYTES + length)])
        with self._named:
            entries = message_index(self._view, offset, channel_id)
            if count not in (None, len(entries)):
                raise CorruptLogError(
                    f"the message index at byte {offset} has {len(entries)} entries, but the"
                    f" summary counts {count}"
                )
            return entries

    def _contents_of(self, chunk: ChunkIndex) -> ChunkContents:
        start = chunk.chunk_start_offset
        if start not in self._contents:
            records = self.chunk_records(chunk)
            with _Named(self.path, f" (chunk at byte {start})"):
                self._contents[start] = contents_of(records)
        return self._contents[start]

    def _read_summary(self) -> ChunkIndexes:
        """Read the summary if there is one; return the chunk indexes in it."""
        view, end = self._view, self.summary_start or len(self._view)
        rows, others = None, list[ChunkIndex]()
        with self._named:
            while (record := next(records_of(view, end), None)) is not None:
                offset, opcode, content = record
                end = offset + RECORD_HEADER_BYTES + len(content)
                if opcode == Opcode.CHUNK_INDEX and rows is None:
                    # In most logs, all chunk indexes can be parsed together.
                    rows = indexes_of_one(view[offset:])
                    end = offset + rows.nbytes
                elif opcode == Opcode.CHUNK_INDEX:
                    others.append(parse_chunk_index(content))
                elif opcode in _SUMMARY:
                    self._parse(opcode, content, offset)
        return ChunkIndexes(indexes_of_one(view[:0]) if rows is None else rows, others)

    def _read_between_chunks(self, unchunked: UnindexedMessages) -> None:
        """Read the records that the summary does not list. Without a summary, read all records."""
        chunks, starts, ends = self.chunks, self.chunks.starts, self.chunks.ends
        if ends.max(initial=0) > len(self._view):
            start = chunks[int(ends.argmax())].chunk_start_offset
            raise CorruptLogError(
                f"{self.path}: the chunk at byte {start} extends beyond the end of the file"
            )
        lows = [len(MAGIC), *ends.tolist()]
        highs = [*starts.tolist(), None]
        # Most chunks follow each other without a gap. The last gap is always read.
        gaps = [number for number, low in enumerate(lows) if low != highs[number]]
        if self._remote is not None and self.summary_start:
            bounds = [(lows[number], highs[number] or self.summary_start) for number in gaps]
            self.fetch([(low, high) for low, high in bounds if low < high])
        found, has_changed = [], False
        for number in gaps:
            before = chunks[number - 1] if number else None
            indexes = 0 if before is None else len(before.message_index_offsets)
            found += self._read_records(lows[number], highs[number], before, unchunked)
            has_changed |= before is not None and len(before.message_index_offsets) != indexes
        if found or has_changed:
            self.chunks = chunks.plus(found)

    def _read_records(
        self, start: int, stop: int | None, chunk: ChunkIndex | None, unchunked: UnindexedMessages
    ) -> list[ChunkIndex]:
        """Read the records from `start` to `stop` (or the end), and return the chunks found."""
        # Message indexes before the first of these chunks belong to `chunk`, which ends at `start`.
        # Messages outside of chunks are added to `unchunked`.
        self.data_end, found = start, []
        for offset, opcode, content in records_of(self._view, start, stop):
            if opcode == Opcode.CHUNK:
                with self._named:
                    chunk = chunk_header(self._view, offset).to_index(offset, len(content))
                found.append(chunk)
            elif opcode == Opcode.MESSAGE_INDEX and chunk is not None:
                if len(content) < _CHANNEL_ID.size:
                    raise CorruptLogError(
                        f"{self.path}: the message index at byte {offset} is damaged"
                    )
                chunk.message_index_offsets[_CHANNEL_ID.unpack_from(content)[0]] = offset
            elif opcode == Opcode.MESSAGE:
                unchunked.add(offset, content)
            elif opcode == Opcode.DATA_END:
                return found
            elif opcode in _TOP_LEVEL and not self._is_listed(opcode, content):
                self._parse(opcode, content, offset)
            self.data_end = offset + RECORD_HEADER_BYTES + len(content)
        if self.complete and self.data_end != stop:
            raise CorruptLogError(f"{self.path}: there is no valid record at byte {self.data_end}")
        return found

    def _check_data_crc(self) -> None:
        """Check the CRC of the data section, the only one that covers unchunked messages."""
        offset, opcode, content = next(self.records(self.data_end), (0, 0, memoryview(b"")))
        if opcode == Opcode.DATA_END:
            # The first field of the record is the CRC.
            crc = int.from_bytes(content[:4], "little")
            if len(content) < 4 or (crc and crc32(self.view[:offset]) != crc):
                raise CorruptLogError(f"{self.path}: the data section does not match its CRC")

    def _find_topics_in_chunks(self) -> None:
        """Search chunks for schemas and channels that are stored nowhere else."""
        described = self._described_channels()
        # A chunk of the channel -1 may contain any channel.
        others = [one for one in set(self.chunks.channels.tolist()) if one not in described]
        numbers = np.flatnonzero(np.isin(self.chunks.channels, others)).tolist() if others else ()
        for number in numbers:
            chunk = self.chunks[number]
            indexed = chunk.message_index_offsets.keys()
            if indexed:
                is_known = indexed <= described
            else:
                # A chunk without message indexes may contain any channel.
                is_known = self._summary_has_topics and self.channels.keys() <= described
            if not is_known:
                for topic in self._contents_of(chunk).topics:
                    self._keep(topic)
                described = self._described_channels()

    def _described_channels(self) -> set[int]:
        """Return the ids of the channels in `channels` whose schema is in `schemas`."""
        # The schema id 0 means no schema.
        schemas = {0, *self.schemas}
        return {number for number, one in self.channels.items() if one.schema_id in schemas}

    def _is_listed(self, opcode: int, content: memoryview) -> bool:
        """Return whether the summary has this schema or channel. Both records begin with an id."""
        number = int.from_bytes(content[:2], "little")
        return (opcode == Opcode.SCHEMA and number in self.schemas) or (
            opcode == Opcode.CHANNEL and number in self.channels
        )

    def _parse(self, opcode: int, content: memoryview, offset: int) -> None:
        with _Named(self.path, f" (byte {offset})"):
            self._keep(parse_record(opcode, content))

    def _keep(self, record: McapRecord) -> None:
        """Store a record if no earlier record has the same id or name."""
        match record:
            case Schema():
                self.schemas.setdefault(record.id, record)
            case Channel():
                self.channels.setdefault(record.id, record)
            case Metadata():
                self.metadata.setdefault(record.name, record.metadata)
            case Statistics():
                self._counts = record.channel_message_counts


class _Named:
    """Context that adds the path of a file, and `where`, to the message of a CorruptLogError."""

    def __init__(self, path: Path, where: str = "") -> None:
        self._path, self._where = path, where

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if isinstance(error, CorruptLogError) and not str(error).startswith(f"{self._path}: "):
            raise CorruptLogError(f"{self._path}: {error}{self._where}") from error


def end_of(chunk: ChunkIndex) -> int:
    """Return the offset of the first byte after a chunk and its message indexes."""
    return chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length
