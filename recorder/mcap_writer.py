"""Writes an MCAP file chunk by chunk; knows MCAP and nothing of what the messages mean.

Each call writes one whole chunk, with its CRC and a MessageIndex for each channel in it, and hands
it to the operating system: what was written survives the process. Schemas, channels and metadata
stand outside the chunks, before what needs them, so that a cut file is still read from its start.
"""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Callable, Sequence
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from mcaprl._version import __version__
from mcaprl.errors import LogError, OutputExistsError, UnknownNameError
from mcaprl.recorder.chunks import INDEX_ENTRY, MAX_CHUNK_BYTES, compressor
from mcaprl.recorder.signals import HoldSignals

COMPRESSIONS = ("zstd", "lz4", "none")
# Rows are written while a simulator waits. Messages one by one are mostly for viewers: they repeat
# themselves so much that a slower search halves them.
_ROWS_LEVEL, _MESSAGES_LEVEL = 1, 6


class McapWriter:
    """Writes one MCAP file of profile `ros2` with CDR messages."""

    def __init__(
        self, path: str | Path, *, compression: str = "zstd", overwrite: bool = False
    ) -> None:
        """Create the file.

        Args:
            path: where to; folders above it are made.
            compression: of chunks: `zstd`, `lz4` or `none`.
            overwrite: replace a file that is there.

        Raises:
            OutputExistsError: there is a file, and `overwrite` is not set.
            LogError: it cannot be created.
        """
        if compression not in COMPRESSIONS:
            raise UnknownNameError("compression", compression, COMPRESSIONS)
        self.path = Path(path)
        self._compression = compression
        self._compress_rows = compressor(compression, _ROWS_LEVEL)
        self._compress_messages = compressor(compression, _MESSAGES_LEVEL)
        self._schema_ids: dict[tuple[str, str], int] = {}
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._sequences: list[int] = []
        self._chunk_indexes: list[ChunkIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._attachment_indexes: list[AttachmentIndex] = []
        self._position = 0
        self._crc = 0
        self._file = _create(self.path, overwrite)
        self._write(MCAP0_MAGIC)
        self._write_record(Header("ros2", f"mcaprl {__version__}"))

    @property
    def closed(self) -> bool:
        """Whether the file is finished."""
        return self._file.closed

    def add_channel(
        self, topic: str, schema_name: str, schema_text: str, metadata: dict[str, str] | None = None
    ) -> int:
        """Announce a topic of `ros2msg` messages; returns its channel id."""
        schema_id = self._schema_ids.get((schema_name, schema_text))
        if schema_id is None:
            schema_id = len(self._schemas) + 1
            schema = Schema(schema_id, schema_text.encode(), "ros2msg", schema_name)
            self._write_record(schema)
            self._schemas.append(schema)
            self._schema_ids[schema_name, schema_text] = schema_id
        channel = Channel(len(self._channels) + 1, topic, "cdr", metadata or {}, schema_id)
        self._write_record(channel)
        self._channels.append(channel)
        self._sequences.append(0)
        return channel.id

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Write a metadata record."""
        offset = self._position
        self._write_record(Metadata(name, metadata))
        self._metadata_indexes.append(MetadataIndex(offset, self._position - offset, name))

    def add_attachment(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Write an attachment; `time_ns` is when it was made."""
        offset = self._position
        self._write_record(Attachment(time_ns, time_ns, name, media_type, data))
        length = self._position - offset
        self._attachment_indexes.append(
            AttachmentIndex(offset, length, time_ns, time_ns, len(data), name, media_type)
        )

    def write_rows(self, rows: NDArray[Any]) -> None:
        """Write messages of one channel and length as one chunk.

        Args:
            rows: of `chunks.record_dtype`, with their log_time. Sequence numbers and publish times
                are filled in here.
        """
        if len(rows) == 0:
            return
        channel_id = int(rows["channel_id"][0])
        rows["sequence"] = self._next_sequences(channel_id, len(rows))
        rows["publish_time"] = rows["log_time"]
        index = np.empty(len(rows), INDEX_ENTRY)
        index["log_time"] = rows["log_time"]
        index["offset"] = np.arange(len(rows), dtype=np.uint64) * np.uint64(rows.itemsize)
        self._write_chunk(rows.view(np.uint8).data, {channel_id: index}, self._compress_rows)

    def write_messages(self, messages: Sequence[tuple[int, int, bytes]]) -> None:
        """Write messages of any channels and lengths as one chunk.

        Args:
            messages: of each channel id, log_time in nanoseconds, and CDR bytes.
        """
        if not messages:
            return
        builder = RecordBuilder()
        entries: dict[int, list[tuple[int, int]]] = {}
        for channel_id, time_ns, data in messages:
            entries.setdefault(channel_id, []).append((time_ns, builder.count))
            sequence = int(self._next_sequences(channel_id, 1)[0])
            Message(channel_id, time_ns, data, time_ns, sequence).write(builder)
        indexes = {id_: np.array(pairs, INDEX_ENTRY) for id_, pairs in entries.items()}
        self._write_chunk(memoryview(builder.end()), indexes, self._compress_messages)

    def close(self) -> None:
        """Write the summary and close the file. Closing twice is harmless."""
        if self.closed:
            return
        self._write_record(DataEnd(self._crc))
        start = self._position
        builder = RecordBuilder()
        groups: list[SummaryOffset] = []
        for opcode, records in self._summary_groups():
            group_start = builder.count
            for record in records:
                record.write(builder)
            if builder.count > group_start:
                length = builder.count - group_start
                groups.append(
                    SummaryOffset(
                        group_opcode=opcode, group_start=start + group_start, group_length=length
                    )
                )
        offsets_start = start + builder.count
        for group in groups:
            group.write(builder)
        summary = builder.end()
        Footer(start, offsets_start, 0).write(builder)
        footer = builder.end()
        crc = zlib.crc32(footer[:-4], zlib.crc32(summary))
        self._write(summary + footer[:-4] + crc.to_bytes(4, "little") + MCAP0_MAGIC)
        self._file.close()

    def _write_chunk(
        self,
        records: memoryview,
        indexes: dict[int, NDArray[Any]],
        compress: Callable[[Any], bytes],
    ) -> None:
        assert len(records) <= MAX_CHUNK_BYTES, "no reader of ours would take it"
        start_time = min(int(index["log_time"].min()) for index in indexes.values())
        end_time = max(int(index["log_time"].max()) for index in indexes.values())
        data = compress(records)
        name = "" if self._compression == "none" else self._compression
        builder = RecordBuilder()
        Chunk(
            compression=name,
            data=data,
            message_start_time=start_time,
            message_end_time=end_time,
            uncompressed_crc=zlib.crc32(records),
            uncompressed_size=len(records),
        ).write(builder)
        offset, chunk_bytes = self._position, builder.count
        index_offsets = {}
        for channel_id, index in indexes.items():
            index_offsets[channel_id] = offset + builder.count
            _write_message_index(builder, channel_id, index)
        index_bytes = builder.count - chunk_bytes
        with HoldSignals():
            self._write(builder.end())
            self._chunk_indexes.append(
                ChunkIndex(
                    chunk_start_offset=offset,
                    chunk_length=chunk_bytes,
                    compression=name,
                    compressed_size=len(data),
                    uncompressed_size=len(records),
                    message_start_time=start_time,
                    message_end_time=end_time,
                    message_index_offsets=index_offsets,
                    message_index_length=index_bytes,
                )
            )

    def _next_sequences(self, channel_id: int, count: int) -> NDArray[np.uint32]:
        first = self._sequences[channel_id - 1]
        self._sequences[channel_id - 1] += count
        return np.arange(first, first + count).astype(np.uint32)

    def _summary_groups(self) -> list[tuple[Opcode, Sequence[McapRecord]]]:
        return [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, self._attachment_indexes),
            (Opcode.METADATA_INDEX, self._metadata_indexes),
        ]

    def _statistics(self) -> Statistics:
        chunks = self._chunk_indexes
        counts = {c.id: n for c, n in zip(self._channels, self._sequences, strict=True)}
        return Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts=counts,
            chunk_count=len(chunks),
            message_count=sum(counts.values()),
            message_end_time=max((chunk.message_end_time for chunk in chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in chunks), default=0),
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )

    def _write_record(self, record: McapRecord) -> None:
        builder = RecordBuilder()
        record.write(builder)
        self._write(builder.end())

    def _write(self, data: bytes) -> None:
        """Write all of it or none: what stands in the file stays a whole number of records."""
        try:
            with HoldSignals():
                rest = memoryview(data)
                while rest:
                    rest = rest[self._file.write(rest) :]
                self._crc = zlib.crc32(data, self._crc)
                self._position += len(data)
        except OSError as error:
            self._give_up()
            raise LogError(
                f"cannot write {self.path}: {error.strerror};"
                " the episodes finished before are in the file"
            ) from error

    def abandon(self) -> None:
        """Close a file that was not finished; a finished one is left alone."""
        with contextlib.suppress(OSError):
            self._file.close()

    def _give_up(self) -> None:
        """Leave a file that readers can scan: cut off behind the last whole record, and closed."""
        with contextlib.suppress(OSError):
            self._file.truncate(self._position)
        self.abandon()


def _create(path: Path, overwrite: bool) -> FileIO:
    if path.exists() and not overwrite:
        raise OutputExistsError(f"{path} exists: choose another path, or pass --overwrite")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return FileIO(path, "w" if overwrite else "x")
    except OSError as error:
        raise LogError(f"cannot write {path}: {error.strerror}") from error


def _write_message_index(builder: RecordBuilder, channel_id: int, index: NDArray[Any]) -> None:
    """A MessageIndex record from an array; the library's own takes a list of tuples."""
    builder.start_record(Opcode.MESSAGE_INDEX)
    builder.write2(channel_id)
    builder.write4(index.nbytes)
    builder.write(index.tobytes())
    builder.finish_record()
