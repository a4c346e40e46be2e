"""Writes an MCAP file chunk by chunk; knows MCAP and nothing of what the messages mean.

Each call writes one whole chunk, with its CRC and a MessageIndex for each channel in it, and hands
it to the operating system: what was written survives the process. Schemas, channels and metadata
stand outside the chunks, before what needs them, so that a cut file is still read from its start.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.records import (
    Attachment,
    Channel,
    ChunkIndex,
    DataEnd,
    Header,
    McapRecord,
    Metadata,
    Schema,
)
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from mcaprl._version import __version__
from mcaprl.errors import LogError, UnknownNameError
from mcaprl.recorder.columns.append import Standing, what_is_written
from mcaprl.recorder.columns.checksum import crc32
from mcaprl.recorder.columns.chunks import (
    LONG_RECORDS,
    MAX_CHUNK_BYTES,
    MIXED_RECORDS,
    SHORT_RECORDS,
    ChunkHeader,
    compressor,
)
from mcaprl.recorder.columns.file_lock import create, release, reopen
from mcaprl.recorder.columns.message_rows import (
    INDEX_ENTRY,
    RECORD_HEADER_BYTES,
    message_index_head,
    message_record,
    touching_offsets,
)
from mcaprl.recorder.columns.signals import HoldSignals
from mcaprl.recorder.columns.summary import Summary

COMPRESSIONS = ("zstd", "lz4", "none")
# Messages of more bytes than this are pictures rather than numbers.
_LONG_MESSAGE_BYTES = 2**11
# So few bytes are sooner copied than handed to the operating system piece by piece.
_JOINED_BYTES = 2**16


class McapWriter:
    """Writes one MCAP file of CDR messages, or several that follow each other.

    Attributes:
        path: of the file that is being written.
        position: its length so far; of one that is appended to, without its summary.
        untouched: whether it is one that was there before, and nothing has been written yet.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        compression: str = "zstd",
        overwrite: bool = False,
        append: bool = False,
        profile: str = "ros2",
    ) -> None:
        """Create the file, or open it to append.

        Args:
            path: where to; folders above it are made.
            compression: of chunks: `zstd`, `lz4` or `none`.
            overwrite: replace a file that is there.
            append: go on behind the last record of a file that is there.
            profile: of a new file.

        Raises:
            OutputExistsError: there is a file, and neither `overwrite` nor `append` is set.
            LogError: it cannot be written, another writer is at work on it, or it is not whole.
        """
        if compression not in COMPRESSIONS:
            raise UnknownNameError("compression", compression, COMPRESSIONS)
        self._compression, self._profile = compression, profile
        self._compress_short = compressor(compression, SHORT_RECORDS)
        self._compress_long = compressor(compression, LONG_RECORDS)
        self._compress_mixed = compressor(compression, MIXED_RECORDS)
        # What every file begins with, in this order.
        self._standing: list[Standing] = []
        if append and Path(path).exists():
            self._continue(Path(path))
        else:
            self._begin(Path(path), overwrite)

    @property
    def closed(self) -> bool:
        """Whether the file is finished."""
        return self._file.closed

    @property
    def schemas(self) -> Mapping[int, Schema]:
        """Those announced, by id."""
        return self._summary.schemas

    @property
    def channels(self) -> Mapping[int, Channel]:
        """Those announced, by id."""
        return self._summary.channels

    @property
    def end_time_ns(self) -> int:
        """The largest log_time in the file; -1 if it has no messages."""
        return max((chunk.message_end_time for chunk in self._summary.chunks), default=-1)

    def add_channel(
        self, topic: str, schema_name: str, schema_text: str, metadata: dict[str, str] | None = None
    ) -> int:
        """Announce a topic of `ros2msg` messages, or find it; returns its channel id.

        Raises:
            LogError: the file has messages of another type on that topic.
        """
        schemas, channels = self._summary.schemas, self._summary.channels
        wanted = ("ros2msg", schema_name, schema_text.encode())
        schema_id = next(
            (s.id for s in schemas.values() if (s.encoding, s.name, s.data) == wanted),
            None,
        )
        for channel in channels.values():
            if channel.topic == topic and channel.schema_id == schema_id:
                return channel.id
            if channel.topic == topic:
                raise LogError(
                    f"{self.path} has messages of another type on {topic}: record to another file"
                )
        if schema_id is None:
            schema_id = max(schemas, default=0) + 1
            self.announce(Schema(schema_id, schema_text.encode(), "ros2msg", schema_name))
        channel_id = max(channels, default=0) + 1
        self.announce(Channel(channel_id, topic, "cdr", metadata or {}, schema_id))
        return channel_id

    def metadata(self, name: str) -> dict[str, str] | None:
        """The metadata record of a name; None if the file has none."""
        found = [r for r in self._standing if isinstance(r, Metadata) and r.name == name]
        return found[0].metadata if found else None

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Write a metadata record, unless the file has one of that name."""
        if self.metadata(name) is None:
            self.announce(Metadata(name, metadata))

    def add_attachment(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Write an attachment made at `time_ns`, unless the file has one of that name."""
        if all(record.name != name for record in self._summary.attachments):
            self.announce(Attachment(time_ns, time_ns, name, media_type, data))

    def announce(self, record: Standing) -> None:
        """Write a record that stands outside of chunks, in this file and those that follow it."""
        self._write_standing(record)
        self._standing.append(record)

    def start_next(self, path: Path) -> None:
        """Finish the file and go on in another, with the same channels, metadata and attachments.

        Raises:
            OutputExistsError: there is a file.
            LogError: it cannot be written.
        """
        self.close()
        self._begin(path, overwrite=False)
        for record in self._standing:
            self._write_standing(record)

    def write_rows(self, rows: NDArray[Any]) -> None:
        """Write messages of one channel and length as one chunk.

        Args:
            rows: of `message_records.record_dtype`, with their log_time. Sequence numbers and
                publish times are filled in here.
        """
        if len(rows) == 0:
            return
        channel_id, size = int(rows["channel_id"][0]), rows.itemsize
        times = rows["log_time"].copy()
        rows["sequence"] = self._next_sequences(channel_id, len(rows))
        rows["publish_time"] = times
        index = np.empty(len(rows), INDEX_ENTRY)
        index["log_time"] = times
        index["offset"] = touching_offsets(0, size * (len(rows) - 1), size)
        self._write_chunk(
            rows.view(np.uint8).data,
            {channel_id: index.view(np.uint8).data},
            (int(times.min()), int(times.max())),
            self._compress_long if size > _LONG_MESSAGE_BYTES else self._compress_short,
        )

    def write_messages(self, messages: Sequence[tuple[int, int, bytes]]) -> None:
        """Write messages of any channels and lengths as one chunk.

        Args:
            messages: of each channel id, log_time in nanoseconds, and CDR bytes.
        """
        if not messages:
            return
        records = bytearray()
        entries: dict[int, list[int]] = {}
        for channel_id, time_ns, data in messages:
            entries.setdefault(channel_id, []).extend((time_ns, len(records)))
            records += message_record(channel_id, self._next_sequence(channel_id), time_ns, data)
        times = [time_ns for _, time_ns, _ in messages]
        self._write_chunk(
            memoryview(records),
            # Of so few, sooner packed by themselves than as an array.
            {id_: struct.pack(f"<{len(pairs)}Q", *pairs) for id_, pairs in entries.items()},
            (min(times), max(times)),
            self._compress_mixed,
        )

    def write_records(self, records: memoryview, indexes: Mapping[int, NDArray[Any]]) -> None:
        """Write a chunk's records as they are.

        Args:
            records: Message records of announced channels, their sequence numbers included.
            indexes: of `message_records.INDEX_ENTRY`, by channel id.
        """
        for channel_id, index in indexes.items():
            self._summary.counts[channel_id] += len(index)
        starts = [int(index["log_time"].min()) for index in indexes.values()]
        ends = [int(index["log_time"].max()) for index in indexes.values()]
        self._write_chunk(
            records,
            {channel_id: index.view(np.uint8).data for channel_id, index in indexes.items()},
            (min(starts), max(ends)),
            self._compressor_of(records, sum(map(len, indexes.values()))),
        )

    def close(self) -> None:
        """Write the summary and close the file. Closing twice is harmless."""
        if self.closed:
            return
        if self.untouched:
            release(self._file)
            return
        self._write_record(DataEnd(self._crc))
        self._write(self._summary.to_bytes(self.position))
        release(self._file)

    def abandon(self) -> None:
        """Close a file that was not finished; a finished one is left alone."""
        with contextlib.suppress(OSError):
            release(self._file)

    def _begin(self, path: Path, overwrite: bool) -> None:
        self._file, self.untouched = create(path, overwrite=overwrite), False
        self.path, self.position, self._crc, self._summary = path, 0, 0, Summary()
        self._write(MCAP0_MAGIC)
        self._write_record(Header(self._profile, f"mcaprl {__version__}"))

    def _continue(self, path: Path) -> None:
        """Take up a file behind its last record. It stays as it is until something is written."""
        self._file, self.path, self.untouched = reopen(path), path, True
        try:
            written = what_is_written(path)
        except BaseException:
            release(self._file)
            raise
        self._summary, self._standing = written.summary, written.standing
        self.position, self._crc = written.end, written.crc

    def _cut_off_summary(self) -> None:
        self._file.truncate(self.position)
        self._file.seek(self.position)
        self.untouched = False

    def _write_chunk(
        self,
        records: memoryview,
        indexes: Mapping[int, bytes | memoryview],
        span: tuple[int, int],
        compress: Callable[[Any], bytes],
    ) -> None:
        """Write a chunk, and the entries of its indexes; `span` has the first and last log_time."""
        assert len(records) <= MAX_CHUNK_BYTES, "no reader of ours would take it"
        (start_time, end_time), data = span, compress(records)
        name = "" if self._compression == "none" else self._compression
        header = ChunkHeader(
            start_time=start_time,
            end_time=end_time,
            uncompressed_bytes=len(records),
            crc=crc32(records),
            compression=name,
            data=slice(0, len(data)),
        )
        # The records go to the file as they are: a copy of them would cost as much as the rest.
        head = header.to_record()
        offset, chunk_bytes = self.position, len(head) + len(data)
        index_offsets, index_bytes = {}, 0
        index_parts: list[bytes | memoryview] = []
        for channel_id, entries in indexes.items():
            index_offsets[channel_id] = offset + chunk_bytes + index_bytes
            index_parts += [message_index_head(channel_id, len(entries)), entries]
            index_bytes += len(index_parts[-2]) + len(entries)
        with HoldSignals():
            self._write(head, data, *index_parts)
            self._summary.chunks.append(
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

    def _compressor_of(self, records: memoryview, count: int) -> Callable[[Any], bytes]:
        """For so many messages of which no more is known: by their lengths."""
        if len(records) > _LONG_MESSAGE_BYTES * count:
            return self._compress_long
        first_bytes = RECORD_HEADER_BYTES + int.from_bytes(records[1:RECORD_HEADER_BYTES], "little")
        is_uniform = len(records) == first_bytes * count
        return self._compress_short if is_uniform else self._compress_mixed

    def _next_sequence(self, channel_id: int) -> int:
        number = self._summary.counts[channel_id]
        self._summary.counts[channel_id] += 1
        return number % 2**32

    def _next_sequences(self, channel_id: int, count: int) -> NDArray[np.uint32]:
        first = self._summary.counts[channel_id]
        self._summary.counts[channel_id] += count
        return np.arange(first, first + count).astype(np.uint32)

    def _write_standing(self, record: McapRecord) -> None:
        offset = self.position
        self._write_record(record)
        self._summary.note(record, offset, self.position - offset)

    def _write_record(self, record: McapRecord) -> None:
        builder = RecordBuilder()
        record.write(builder)
        self._write(builder.end())

    def _write(self, *parts: bytes | memoryview) -> None:
        """Write all of it or none: what stands in the file stays a whole number of records."""
        try:
            with HoldSignals():
                if self.untouched:
                    self._cut_off_summary()
                if sum(map(len, parts)) <= _JOINED_BYTES:
                    parts = (b"".join(parts),)
                for part in parts:
                    rest = memoryview(part)
                    while rest:
                        rest = rest[self._file.write(rest) :]
                for part in parts:
                    self._crc = crc32(part, self._crc)
                self.position += sum(map(len, parts))
        except OSError as error:
            self._give_up()
            raise LogError(
                f"cannot write {self.path}: {error.strerror};"
                " the episodes finished before are in the file"
            ) from error

    def _give_up(self) -> None:
        """Leave a file that readers can scan: cut off behind the last whole record, and closed."""
        with contextlib.suppress(OSError):
            self._file.truncate(self.position)
        self.abandon()
