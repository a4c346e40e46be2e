"""Reads an MCAP file chunk by chunk; knows MCAP and nothing of what the messages mean.

The file is mapped into memory, and only the chunks that hold an asked-for topic are touched. Every
chunk read is checked against its CRC, every message against the index that led to it.

Files of any writer are read. What the summary leaves out is looked for: chunks and messages between
the chunks it tells of, and schemas, channels and messages inside of them. So a file without a
summary, because its writer was killed or is still at work, is scanned from the start.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, McapRecord, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError, NotMcapError
from mcaprl.recorder.columns.checksum import crc32
from mcaprl.recorder.columns.chunk_table import ChunkTable
from mcaprl.recorder.columns.chunks import Scratch, chunk_header, chunk_records
from mcaprl.recorder.columns.message_rows import (
    INDEX_ENTRY,
    MESSAGE_HEADER,
    RECORD_HEADER_BYTES,
    message_index,
)
from mcaprl.recorder.columns.message_spans import Span, Spans, indexed_spans, told_spans
from mcaprl.recorder.columns.records import (
    MESSAGE_START,
    RECORD_HEADER,
    ChunkContents,
    LooseMessages,
    attachment_of,
    contents_of,
    footer_of,
    map_file,
    parse_record,
    records_of,
    runs_of,
)

_SUMMARY = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS)
_STANDING = (Opcode.METADATA, Opcode.SCHEMA, Opcode.CHANNEL)


class McapReader:
    """One MCAP file, open for reading.

    Attributes:
        path: of the file.
        complete: whether the file ends as it should; if not, it was cut off or is being written.
        summary_start: where the summary begins; 0 if there is none.
        data_end: where the records that precede it end, as far as they were read.
        table: its chunks.
        schemas: by id.
        channels: by id.
        metadata: metadata records, by name; of several with one name, the first.
    """

    def __init__(self, path: str | Path) -> None:
        """Map the file, read its summary, and look for what that leaves out.

        Raises:
            NotMcapError: it is no MCAP file.
            CorruptLogError: its summary is damaged.
            LogError: it cannot be opened.
        """
        self.path = Path(path)
        self.view = map_file(self.path)
        if bytes(self.view[: len(MCAP0_MAGIC)]) != MCAP0_MAGIC:
            raise NotMcapError(f"{self.path} is no MCAP file: it does not begin with MCAP's magic")
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.table = ChunkTable(np.empty(0, np.int64))
        self.metadata: dict[str, dict[str, str]] = {}
        self.data_end = 0
        self._counts: dict[int, int] = {}
        self._loose = LooseMessages()
        # Who asks for a chunk's example asks for all of it next.
        self._last_chunk = (-1, memoryview(b""))
        self._contents: dict[int, ChunkContents] = {}
        self._spans: dict[int, Spans] = {}
        with self._named():
            footer = footer_of(self.view)
        self.complete = footer is not None
        self.summary_start = footer.summary_start if footer is not None else 0
        if self.summary_start:
            self._read_summary()
        self._summary_has_topics = bool(self.channels)
        self._read_between_chunks()
        self._loose_indexes = self._loose.indexes()
        if self._loose_indexes:
            self._check_data_crc()
        self._find_topics_in_chunks()

    @property
    def chunks(self) -> list[ChunkIndex]:
        """Indexes of all chunks, in file order."""
        return self.table.chunks

    def channels_of(self, topic: str) -> list[Channel]:
        """The channels of a topic, by id; more than one where several writers took part."""
        found = [channel for channel in self.channels.values() if channel.topic == topic]
        return sorted(found, key=lambda channel: channel.id)

    def channel_of(self, topic: str) -> Channel | None:
        """The channel of a topic; None if the file has no such topic.

        Raises:
            LogError: several channels have that topic.
        """
        found = self.channels_of(topic)
        if len(found) > 1:
            raise LogError(
                f"{self.path}: {len(found)} channels are called {topic}; one is expected"
            )
        return found[0] if found else None

    def schema_of(self, channel: Channel) -> Schema:
        """The schema of a channel.

        Raises:
            CorruptLogError: the file has none.
        """
        schema = self.schemas.get(channel.schema_id)
        if schema is None:
            raise CorruptLogError(f"{self.path}: {channel.topic} has no schema")
        return schema

    def spans(self, channel: Channel) -> Spans:
        """Where the messages of a channel are, in file order. No chunk is read that has an index.

        Raises:
            CorruptLogError: an index is damaged, or tells of fewer messages than the summary does.
        """
        if channel.id not in self._spans:
            self._spans[channel.id] = self._spans_of(channel)
        return self._spans[channel.id]

    def _spans_of(self, channel: Channel) -> Spans:
        told, table = self._counts.get(channel.id), self.table
        with self._named():
            indexes = table.indexes_of(channel.id)
            spans = told_spans(table, indexes, partial(self._index_at, channel.id))
            if spans is not None and int(spans.counts.sum()) == told:
                return spans
            unsure = table.unsure(is_complete=self.complete)
            numbers, spans = indexed_spans(self.view, table, indexes, unsure, channel.id)
        others = list(self._unindexed(channel.id, unsure))
        if others:
            every = sorted([*zip(numbers.tolist(), spans, strict=True), *others], key=itemgetter(0))
            spans = Spans.of([span for _, span in every])
        count = int(spans.counts.sum())
        if told not in (None, count):
            raise CorruptLogError(
                f"{self.path}: the summary tells of {told} messages of {channel.topic}, its indexes"
                f" of {count}"
            )
        return spans

    def _unindexed(self, channel_id: int, unsure: NDArray[np.int64]) -> Iterator[tuple[int, Span]]:
        """What is in chunks of these numbers, and behind that what is in none."""
        for number, chunk in zip(unsure.tolist(), self.table.some(unsure), strict=True):
            index = self._contents_of(chunk).indexes.get(channel_id)
            if index is not None:
                yield number, Span.of_index(chunk, index)
        loose = self._loose_indexes.get(channel_id)
        if loose is not None:
            yield len(self.table), Span.of_index(None, loose)

    def records_of(self, span: Span, scratch: Scratch | None = None) -> memoryview:
        """The bytes that the offsets of a span's index point into; see `chunk_records`.

        Raises:
            CorruptLogError: the chunk is damaged.
        """
        return self.view if span.chunk is None else self.chunk_records(span.chunk, scratch)

    def chunk_records(self, chunk: ChunkIndex, scratch: Scratch | None = None) -> memoryview:
        """The records of a chunk, decompressed and checked against their CRC.

        Args:
            chunk: one of `chunks`.
            scratch: where they may be decompressed to; then they are there until it is used again.
                It is for chunks of this file alone.

        Raises:
            CorruptLogError: the chunk is damaged.
        """
        start = chunk.chunk_start_offset
        last, kept = self._last_chunk if scratch is None else scratch.kept
        if last == start:
            return kept
        with self._named():
            records = chunk_records(self.view, start, scratch)
        if scratch is None:
            self._last_chunk = start, records
        else:
            scratch.kept = start, records
        return records

    def messages(self, channel: Channel) -> Iterator[tuple[int, bytes]]:
        """Yield log_time and bytes of a topic's messages, one by one.

        Raises:
            CorruptLogError: a chunk is damaged, or a message is not what the index says.
        """
        for span in self.spans(channel):
            records = self.records_of(span)
            for time_ns, offset in span.index.tolist():
                yield time_ns, self.message(records, channel, time_ns, offset)

    def message(self, records: memoryview, channel: Channel, time_ns: int, offset: int) -> bytes:
        """The bytes of the message that an index entry points at.

        Raises:
            CorruptLogError: it is not what the entry says.
        """
        start = offset + MESSAGE_HEADER.itemsize
        if start <= len(records):
            opcode, length = RECORD_HEADER.unpack_from(records, offset)
            found_id, _, found_ns = MESSAGE_START.unpack_from(records, offset + RECORD_HEADER.size)
            end = offset + RECORD_HEADER.size + length
            found = (opcode, found_id, found_ns)
            if found == (Opcode.MESSAGE, channel.id, time_ns) and start <= end <= len(records):
                return bytes(records[start:end])
        raise CorruptLogError(
            f"{self.path}: the message of {channel.topic} at byte {offset} of its chunk is not"
            " what the index says"
        )

    def attachment(self, name: str) -> bytes | None:
        """The last attachment of a name; None if there is none.

        Raises:
            CorruptLogError: it is damaged.
        """
        with self._named():
            return attachment_of(self.view, name)

    def records(self, start: int) -> Iterator[tuple[int, int, memoryview]]:
        """Yield offset, opcode and content of each record from `start` on.

        Ends before a record that reaches beyond the end of the file.
        """
        return records_of(self.view, start)

    def _index_at(self, channel_id: int, offset: int, count: int) -> memoryview:
        with self._named():
            entries = message_index(self.view, offset, channel_id)
            if len(entries) != count * INDEX_ENTRY.itemsize:
                raise CorruptLogError(
                    f"the message index at byte {offset} has not the {count} messages that the"
                    " summary tells of"
                )
            return entries

    def _contents_of(self, chunk: ChunkIndex) -> ChunkContents:
        start = chunk.chunk_start_offset
        if start not in self._contents:
            records = self.chunk_records(chunk)
            try:
                self._contents[start] = contents_of(records)
            except CorruptLogError as error:
                raise CorruptLogError(f"{self.path}: {error} (chunk at byte {start})") from error
        return self._contents[start]

    def _read_summary(self) -> None:
        runs = array("q")
        for offset, opcode, length, count in runs_of(self.view, self.summary_start):
            start, size = offset + RECORD_HEADER_BYTES, RECORD_HEADER_BYTES + length
            if opcode == Opcode.CHUNK_INDEX:
                runs.extend((start, length, count))
            elif opcode in _SUMMARY:
                for first in range(start, start + count * size, size):
                    self._keep(self._parse(opcode, self.view[first : first + length], first))
        if runs:
            with self._named():
                self.table = ChunkTable.read(self.view, np.array(runs, np.int64).reshape(-1, 3))

    def _read_between_chunks(self) -> None:
        """Read what the summary does not tell of: everything, if there is none."""
        table = self.table
        with self._named():
            stops = table.stops(len(self.view))
        starts = np.concatenate([np.array([len(MCAP0_MAGIC)], np.uint64), stops])
        offsets = table.rows["offset"]
        found: dict[int, ChunkIndex] = {}
        # Mostly they stand one behind the other.
        for number in np.flatnonzero(starts[:-1] != offsets).tolist():
            self._read_records(int(starts[number]), int(offsets[number]), found, number - 1)
        self._read_records(int(starts[-1]), None, found, len(table) - 1)
        if found:
            every = {chunk.chunk_start_offset: chunk for chunk in table.chunks} | found
            self.table = ChunkTable.of([every[offset] for offset in sorted(every)])

    def _read_records(
        self, start: int, stop: int | None, found: dict[int, ChunkIndex], before: int
    ) -> None:
        """Read the data section from `start` on, to `stop` or its end.

        Args:
            start: first byte.
            stop: where it ends; None for the end of the section.
            found: takes up chunks, by their first byte.
            before: the number of the known chunk in front of these records; -1 if there is none.

        Raises:
            CorruptLogError: there are no whole records in a file that has a summary.
        """
        self.data_end, chunk = start, None
        for offset, opcode, content in records_of(self.view, start, stop):
            if opcode == Opcode.CHUNK:
                with self._named():
                    header = chunk_header(self.view, offset)
                chunk = found[offset] = header.to_index(offset, len(content))
            elif opcode == Opcode.MESSAGE_INDEX and (chunk is not None or before >= 0):
                chunk = chunk or next(self.table.some(np.arange(before, before + 1)))
                (channel_id,) = struct.unpack_from("<H", content)
                chunk.message_index_offsets[channel_id] = offset
                found[chunk.chunk_start_offset] = chunk
            elif opcode == Opcode.MESSAGE:
                self._loose.add(offset, content)
            elif opcode == Opcode.DATA_END:
                return
            elif opcode in _STANDING and not self._is_told(opcode, content):
                self._keep(self._parse(opcode, content, offset))
            self.data_end = offset + RECORD_HEADER_BYTES + len(content)
        if self.complete and self.data_end != stop:
            raise CorruptLogError(f"{self.path}: damaged at byte {self.data_end}: no record there")

    def _check_data_crc(self) -> None:
        """The only one that covers messages outside of chunks."""
        for offset, opcode, content in records_of(self.view, self.data_end):
            if opcode == Opcode.DATA_END:
                (crc,) = struct.unpack_from("<I", content)
                if crc and crc32(self.view[:offset]) != crc:
                    raise CorruptLogError(f"{self.path}: the data section does not match its CRC")
            break

    def _find_topics_in_chunks(self) -> None:
        """Look into chunks for schemas and channels that stand nowhere else."""
        if all(map(self._is_known, self.table.channel_ids)) and not len(self.table.bare):
            return
        for chunk in self.chunks:
            ids = chunk.message_index_offsets
            if not all(map(self._is_known, ids)) or not (ids or self._summary_has_topics):
                for topic in self._contents_of(chunk).topics:
                    self._keep(topic)

    def _is_known(self, channel_id: int) -> bool:
        channel = self.channels.get(channel_id)
        return channel is not None and channel.schema_id in self.schemas

    def _is_told(self, opcode: int, content: memoryview) -> bool:
        """Whether the summary has this schema or channel; both records begin with an id."""
        number = int.from_bytes(content[:2], "little")
        return (opcode == Opcode.SCHEMA and number in self.schemas) or (
            opcode == Opcode.CHANNEL and number in self.channels
        )

    def _keep(self, record: McapRecord) -> None:
        """Note a record. What the summary says comes first: it has a CRC of its own."""
        match record:
            case Schema():
                self.schemas.setdefault(record.id, record)
            case Channel():
                self.channels.setdefault(record.id, record)
            case Metadata():
                self.metadata.setdefault(record.name, record.metadata)
            case Statistics():
                self._counts = record.channel_message_counts

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Say of which file it is what is damaged, if that is not said yet."""
        try:
            yield
        except CorruptLogError as error:
            if str(error).startswith(f"{self.path}: "):
                raise
            raise CorruptLogError(f"{self.path}: {error}") from error

    def _parse(self, opcode: int, content: memoryview, offset: int) -> Any:
        try:
            return parse_record(opcode, content)
        except CorruptLogError as error:
            raise CorruptLogError(f"{self.path}: {error} (byte {offset})") from error
