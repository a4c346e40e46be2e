"""Reads an MCAP file chunk by chunk; knows MCAP and nothing of what the messages mean.

The file is mapped into memory, and only the chunks that hold an asked-for topic are touched. Every
chunk read is checked against its CRC, every message against the index that led to it. A file
without a summary, because its writer was killed or is still at work, is scanned from the start.
"""

from __future__ import annotations

import io
import mmap
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    Schema,
)
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError, NotMcapError
from mcaprl.recorder.chunks import (
    RECORD_HEADER_BYTES,
    chunk_header,
    chunk_records,
    gather,
    message_index,
    record_dtype,
)

_RECORD_HEADER = struct.Struct("<BQ")
_FOOTER_BYTES = RECORD_HEADER_BYTES + 20
_PARSERS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
    Opcode.DATA_END: DataEnd,
}


_TOPICS = (Opcode.SCHEMA, Opcode.CHANNEL)


class McapReader:
    """One MCAP file, open for reading.

    Attributes:
        path: of the file.
        complete: whether the file has its summary; if not, it was cut off or is being written.
        summary_start: where it begins; 0 if there is none.
        data_end: where the records that precede it end, as far as they were read.
        schemas: by id.
        channels: by id.
        chunks: indexes of all chunks, in file order.
        metadata: metadata records, by name; of several with one name, the first.
    """

    def __init__(self, path: str | Path) -> None:
        """Map the file and read its summary, or scan it if there is none.

        Raises:
            NotMcapError: it is no MCAP file.
            CorruptLogError: its summary is damaged.
            LogError: it cannot be opened.
        """
        self.path = Path(path)
        self.view = _map(self.path)
        if bytes(self.view[: len(MCAP0_MAGIC)]) != MCAP0_MAGIC:
            raise NotMcapError(f"{self.path} is no MCAP file: it does not begin with MCAP's magic")
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.chunks: list[ChunkIndex] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self.data_end = 0
        footer = self._footer()
        self.complete = footer is not None
        self.summary_start = footer.summary_start if footer is not None else 0
        if footer is not None:
            self._read_summary(footer)
        # The summary has a CRC of its own and is believed; the data section's covers the whole
        # file and is left to `check`.
        self._topics_are_known = bool(self.channels)
        self._read_data_section(scan=footer is None)

    def channel_of(self, topic: str) -> Channel | None:
        """The channel of a topic; None if the file has no such topic.

        Raises:
            LogError: several channels have that topic.
        """
        found = [channel for channel in self.channels.values() if channel.topic == topic]
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

    def rows(self, channel: Channel, payload: np.dtype[Any]) -> Iterator[NDArray[Any]]:
        """Yield a topic's messages chunk by chunk, as arrays of `chunks.record_dtype(payload)`.

        Raises:
            CorruptLogError: a chunk is damaged, or a message is not what the index says.
        """
        dtype = record_dtype(payload)
        for chunk, index in self.indexed_chunks(channel):
            rows = gather(chunk, index, dtype)
            headers_fit = (
                (rows["opcode"] == Opcode.MESSAGE)
                & (rows["length"] == dtype.itemsize - RECORD_HEADER_BYTES)
                & (rows["channel_id"] == channel.id)
                & (rows["log_time"] == index["log_time"])
            )
            if not headers_fit.all():
                where = int(index["offset"][int(np.argmin(headers_fit))])
                raise CorruptLogError(
                    f"{self.path}: the message of {channel.topic} at byte {where} of its chunk"
                    " is not what the index says, or has not the length of its schema"
                )
            yield rows

    def messages(self, channel: Channel) -> Iterator[tuple[int, bytes]]:
        """Yield log_time and bytes of a topic's messages, one by one.

        Raises:
            CorruptLogError: a chunk is damaged, or a message is not what the index says.
        """
        head = struct.Struct("<BQHIQQ")
        for chunk, index in self.indexed_chunks(channel):
            for time_ns, offset in index.tolist():
                if offset > len(chunk) - head.size:
                    raise CorruptLogError(f"{self.path}: an index points outside its chunk")
                opcode, length, channel_id, _, log_time, _ = head.unpack_from(chunk, offset)
                end = offset + RECORD_HEADER_BYTES + length
                if (opcode, channel_id, log_time) != (Opcode.MESSAGE, channel.id, time_ns) or (
                    end > len(chunk)
                ):
                    raise CorruptLogError(
                        f"{self.path}: the message of {channel.topic} at byte {offset} of its"
                        " chunk is not what the index says"
                    )
                yield log_time, bytes(chunk[offset + head.size : end])

    def count(self, channel: Channel) -> int:
        """How many messages a topic has, from the indexes alone."""
        return sum(len(index) for _, index in self._indexes(channel))

    def indexed_chunks(self, channel: Channel) -> Iterator[tuple[memoryview, NDArray[Any]]]:
        """Yield the records of each chunk with messages of the channel, and their index."""
        for chunk, index in self._indexes(channel):
            try:
                yield chunk_records(self.view, chunk.chunk_start_offset), index
            except CorruptLogError as error:
                raise CorruptLogError(f"{self.path}: {error}") from error

    def attachment(self, name: str) -> bytes | None:
        """The first attachment of a name; None if there is none.

        Raises:
            CorruptLogError: it does not match its CRC.
        """
        for offset, opcode, content in self.records(len(MCAP0_MAGIC)):
            if opcode == Opcode.ATTACHMENT:
                attachment = self._parse(opcode, content, offset)
                if attachment.name == name:
                    (crc,) = struct.unpack("<I", content[-4:])
                    if crc and zlib.crc32(content[:-4]) != crc:
                        raise CorruptLogError(f"{self.path}: attachment {name} is damaged")
                    return bytes(attachment.data)
            if opcode == Opcode.DATA_END:
                break
        return None

    def records(self, start: int) -> Iterator[tuple[int, int, memoryview]]:
        """Yield offset, opcode and content of each record from `start` on.

        Ends before a record that reaches beyond the end of the file.
        """
        offset = start
        while offset + _RECORD_HEADER.size <= len(self.view):
            opcode, length = _RECORD_HEADER.unpack_from(self.view, offset)
            content = offset + _RECORD_HEADER.size
            if opcode == 0 or length > len(self.view) - content:
                return
            yield offset, opcode, self.view[content : content + length]
            offset = content + length

    def _indexes(self, channel: Channel) -> Iterator[tuple[ChunkIndex, NDArray[Any]]]:
        for number, chunk in enumerate(self.chunks):
            cut_off = not self.complete and number == len(self.chunks) - 1
            if not chunk.message_index_offsets and not cut_off:
                raise LogError(
                    f"{self.path}: the chunk at byte {chunk.chunk_start_offset} has no message"
                    " index; write the file anew with message indexes"
                )
            offset = chunk.message_index_offsets.get(channel.id)
            if offset is None:
                continue
            try:
                yield chunk, message_index(self.view, offset, channel.id)
            except CorruptLogError as error:
                raise CorruptLogError(f"{self.path}: {error}") from error

    def _footer(self) -> Footer | None:
        """The footer, if the file ends with one that tells of a summary."""
        start = len(self.view) - len(MCAP0_MAGIC) - _FOOTER_BYTES
        if start < len(MCAP0_MAGIC) or bytes(self.view[-len(MCAP0_MAGIC) :]) != MCAP0_MAGIC:
            return None
        opcode, length = _RECORD_HEADER.unpack_from(self.view, start)
        if opcode != Opcode.FOOTER or length != _FOOTER_BYTES - RECORD_HEADER_BYTES:
            return None
        footer: Footer = self._parse(opcode, self.view[start + RECORD_HEADER_BYTES :], start)
        if footer.summary_start == 0:
            return None
        if not len(MCAP0_MAGIC) <= footer.summary_start <= start:
            raise CorruptLogError(f"{self.path}: the footer points outside the file")
        covered = self.view[footer.summary_start : start + _FOOTER_BYTES - 4]
        if footer.summary_crc and zlib.crc32(covered) != footer.summary_crc:
            raise CorruptLogError(f"{self.path}: the summary does not match its CRC")
        return footer

    def _read_summary(self, footer: Footer) -> None:
        for offset, opcode, content in self.records(footer.summary_start):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK_INDEX):
                self._keep(self._parse(opcode, content, offset))

    def _read_data_section(self, *, scan: bool) -> None:
        """Read what stands in front of the first chunk; all of it if the summary is missing."""
        pending: ChunkIndex | None = None
        for offset, opcode, content in self.records(len(MCAP0_MAGIC)):
            if opcode == Opcode.CHUNK:
                if not scan:
                    break
                try:
                    pending = self._scanned_chunk(offset, len(content))
                except CorruptLogError as error:
                    raise CorruptLogError(f"{self.path}: {error}") from error
                self.chunks.append(pending)
            elif opcode == Opcode.MESSAGE_INDEX and pending is not None:
                (channel_id,) = struct.unpack_from("<H", content)
                pending.message_index_offsets[channel_id] = offset
            elif opcode == Opcode.DATA_END:
                break
            elif opcode == Opcode.METADATA or (opcode in _TOPICS and not self._topics_are_known):
                self._keep(self._parse(opcode, content, offset))
            self.data_end = offset + RECORD_HEADER_BYTES + len(content)

    def _scanned_chunk(self, offset: int, content_bytes: int) -> ChunkIndex:
        header = chunk_header(self.view, offset)
        return ChunkIndex(
            chunk_start_offset=offset,
            chunk_length=RECORD_HEADER_BYTES + content_bytes,
            compression=header.compression,
            compressed_size=header.data.stop - header.data.start,
            uncompressed_size=header.uncompressed_bytes,
            message_start_time=header.start_time,
            message_end_time=header.end_time,
            message_index_offsets={},
            message_index_length=0,
        )

    def _keep(self, record: McapRecord) -> None:
        match record:
            case Schema():
                self.schemas[record.id] = record
            case Channel():
                self.channels[record.id] = record
            case Metadata():
                self.metadata.setdefault(record.name, record.metadata)
            case ChunkIndex():
                self.chunks.append(record)

    def _parse(self, opcode: int, content: memoryview, offset: int) -> Any:
        try:
            return parse_record(opcode, content)
        except CorruptLogError as error:
            raise CorruptLogError(f"{self.path}: {error} (byte {offset})") from error


def parse_record(opcode: int, content: memoryview) -> Any:
    """A record of the `mcap` library from its content.

    Raises:
        CorruptLogError: the content is no such record.
    """
    try:
        return _PARSERS[opcode].read(_stream(content))
    # The library raises whatever its parsing meets; none of it is more than "damaged".
    except Exception as error:
        raise CorruptLogError(f"the {Opcode(opcode).name.lower()} record is damaged") from error


def _stream(content: memoryview) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))


def _map(path: Path) -> memoryview:
    try:
        with path.open("rb") as file:
            if not file.seek(0, io.SEEK_END):
                raise NotMcapError(f"{path} is no MCAP file: it is empty")
            return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror}") from error
