"""Writer of MCAP files, chunk by chunk.

Each call writes one complete chunk with its CRC and the MessageIndex of each channel, and passes it
to the operating system, so that the chunk survives the process. Schemas, channels, metadata and
attachments are top-level records before the chunks that need them, so that a truncated file is
readable from its start. Closing a file merges its small chunks.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment, Channel, ChunkIndex, Header, Metadata, Schema
from numpy.typing import NDArray

from mcaprl._version import __version__
from mcaprl.errors import LogError, UnknownNameError
from mcaprl.files import remove_leftover
from mcaprl.recorder.columns.chunks import (
    LONG_MESSAGE_BYTES,
    RARE_MESSAGE_BYTES,
    TEXT_BYTES,
    Compressors,
)
from mcaprl.recorder.columns.output import (
    SMALL_CHUNK_BYTES,
    HoldSignals,
    OutputFile,
    compact,
    copy_start,
    create,
    release,
    reopen,
    replaced,
)
from mcaprl.recorder.columns.records import INDEX_ENTRY, MAGIC, adjacent_offsets, message_record
from mcaprl.recorder.columns.summary import Summary, TopLevelRecord, WrittenState, written_state

COMPRESSIONS = ("zstd", "lz4", "none")


class McapWriter(OutputFile):
    """Writer of one MCAP file of CDR messages, or of several files one after another.

    Attributes:
        path: Path of the current file.
        position: Length of the file so far. While appending, the old summary is not counted.
        untouched: Whether the file existed before and nothing has been written to it yet.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        compression: str = "zstd",
        overwrite: bool = False,
        append: bool = False,
        source: Path | None = None,
        profile: str = "ros2",
    ) -> None:
        """Create the file, or open it to append."""
        if compression not in COMPRESSIONS:
            raise UnknownNameError("compression", compression, COMPRESSIONS)
        self._compressors, self._profile = Compressors(compression), profile
        # Top-level records at the start of every file, in the order of this list.
        self._top_level: list[TopLevelRecord] = []
        if append and Path(path).exists():
            self._continue(Path(path))
        elif source is not None:
            self._copy(source, Path(path), overwrite)
        else:
            self._begin(Path(path), overwrite)

    @property
    def closed(self) -> bool:
        """Whether the file is closed."""
        return self._file.closed

    @property
    def schemas(self) -> Mapping[int, Schema]:
        """Schemas of the file by id."""
        return self._summary.schemas

    @property
    def channels(self) -> Mapping[int, Channel]:
        """Channels of the file by id."""
        return self._summary.channels

    @property
    def end_time_ns(self) -> int:
        """Largest log_time in the file; -1 if there are no messages."""
        return max((chunk.message_end_time for chunk in self._summary.chunks), default=-1)

    def add_channel(
        self, topic: str, schema_name: str, schema_text: str, metadata: dict[str, str] | None = None
    ) -> int:
        """Return the channel id of a topic of `ros2msg` messages, and write a new channel."""
        wanted = ("ros2msg", schema_name, schema_text.encode())
        schema_id = self._schema_ids().get(wanted)
        for channel in self._summary.channels.values():
            if channel.topic == topic and channel.schema_id == schema_id:
                return channel.id
            if channel.topic == topic:
                raise LogError(
                    f"{self.path} has messages of another type on {topic}: record to another file"
                )
        return self.add_topic(topic, "cdr", wanted, metadata)

    def metadata(self, name: str) -> dict[str, str] | None:
        """Return the metadata record with this name; None if there is none."""
        found = [r for r in self._top_level if isinstance(r, Metadata) and r.name == name]
        return found[0].metadata if found else None

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Write a metadata record if the file has no metadata record with this name."""
        if self.metadata(name) is None:
            self.announce(Metadata(name, metadata))

    def add_attachment(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Write an attachment created at `time_ns` if the file has no attachment with this name."""
        if all(record.name != name for record in self._summary.attachments):
            self.announce(Attachment(time_ns, time_ns, name, media_type, data))

    def announce(self, record: TopLevelRecord) -> None:
        """Write a top-level record to this file and to all later files."""
        self._write_top_level(record)
        self._top_level.append(record)

    def start_next(self, path: Path) -> None:
        """Close the file and start another with the same channels, metadata and attachments."""
        self.close()
        self._begin(path, overwrite=False)
        for record in self._top_level:
            self._write_top_level(record)

    def write_rows(self, rows: NDArray[Any]) -> None:
        """Write messages of one channel and length as a chunk."""
        # Set sequence numbers and publish times.
        if len(rows) == 0:
            return
        channel_id, size = int(rows["channel_id"][0]), rows.itemsize
        first = self._summary.counts[channel_id]
        rows["sequence"] = np.arange(first, first + len(rows)).astype(np.uint32)
        rows["publish_time"] = rows["log_time"]
        index = np.empty(len(rows), INDEX_ENTRY)
        times = index["log_time"]
        times[:] = rows["log_time"]
        index["offset"] = adjacent_offsets(0, size * (len(rows) - 1), size)
        self._store(
            rows.view(np.uint8).data,
            {channel_id: index.view(np.uint8).data},
            (int(times.min()), int(times.max())),
            self._compressors.long if size > LONG_MESSAGE_BYTES else self._compressors.short,
        )

    def add_topic(
        self,
        topic: str,
        encoding: str,
        schema: tuple[str, str, bytes],
        metadata: dict[str, str] | None = None,
    ) -> int:
        """Write a new channel, and return its id; `schema` has encoding (if any), name and data."""
        schema_encoding, name, data = schema
        schema_id = self._schema_ids().get(schema, 0) if schema_encoding else 0
        if schema_encoding and not schema_id:
            schema_id = max(self._summary.schemas, default=0) + 1
            self.announce(Schema(schema_id, data, schema_encoding, name))
        channel_id = max(self._summary.channels, default=0) + 1
        self.announce(Channel(channel_id, topic, encoding, metadata or {}, schema_id))
        return channel_id

    def _schema_ids(self) -> dict[tuple[str, str, bytes], int]:
        found = reversed(self._summary.schemas.values())
        return {(one.encoding, one.name, one.data): one.id for one in found}

    def write_messages(
        self, messages: Sequence[tuple[int, int, bytes]], publish_ns: Sequence[int] = ()
    ) -> None:
        """Write messages (channel id, log_time, data) as one chunk."""
        # Publish_time is log_time if None.
        if not messages:
            return
        records = bytearray()
        entries: dict[int, list[int]] = {}
        counts = self._summary.counts
        published = publish_ns or [time_ns for _, time_ns, _ in messages]
        for (channel_id, time_ns, data), publish_time in zip(messages, published, strict=True):
            pairs = entries.setdefault(channel_id, [])
            sequence = (counts[channel_id] + len(pairs) // 2) % 2**32
            pairs += (time_ns, len(records))
            records += message_record(channel_id, sequence, time_ns, data, publish_time)
        times = [time_ns for _, time_ns, _ in messages]
        compress = self._compressors.mixed
        if len(records) > RARE_MESSAGE_BYTES * len(messages):
            compress = self._compressors.rare
        elif len(records) < SMALL_CHUNK_BYTES or len(records) < TEXT_BYTES * len(messages):
            compress = self._compressors.few
        self._store(
            memoryview(records),
            # For a small number of entries, `struct` is faster than an array.
            {id_: struct.pack(f"<{len(pairs)}Q", *pairs) for id_, pairs in entries.items()},
            (min(times), max(times)),
            compress,
        )

    def write_records(self, records: memoryview, indexes: Mapping[int, NDArray[Any]]) -> None:
        """Write a chunk of complete records."""
        starts = [int(index["log_time"].min()) for index in indexes.values()]
        ends = [int(index["log_time"].max()) for index in indexes.values()]
        self._store(
            records,
            {channel_id: index.view(np.uint8).data for channel_id, index in indexes.items()},
            (min(starts), max(ends)),
            self._compressors.of(records, sum(map(len, indexes.values()))),
        )

    def copy_chunk(self, view: memoryview, chunk: ChunkIndex, counts: Mapping[int, int]) -> None:
        """Copy a chunk and its message indexes from another file without decompressing it."""
        with HoldSignals():
            self._copy_chunk(view, chunk)
            for channel_id, count in counts.items():
                self._summary.counts[channel_id] += count

    def close(self) -> None:
        """Write the summary, merge small chunks, and close the file. Closing twice is harmless."""
        if self.closed:
            return
        try:
            if not self.untouched:
                self._finish()
                compact(self.path, self._file, self._summary, self._data_end, self._compressors)
        finally:
            release(self._file)

    def _begin(self, path: Path, overwrite: bool) -> None:
        # `compact` needs the work folder at the end, so a foreign file at its path is an error now.
        remove_leftover(path)
        self._file, self.untouched = create(path, overwrite=overwrite), False
        self.path, self.position, self._crc, self._summary = path, 0, 0, Summary()
        self._write(MAGIC)
        self._write_record(Header(self._profile, f"mcaprl {__version__}"))

    def _continue(self, path: Path) -> None:
        """Open a file to append; the file stays unchanged until the first write."""
        self._file, self.path, self.untouched = reopen(path), path, True
        try:
            remove_leftover(path.resolve())
            self._set_state(written_state(path))
        except BaseException:
            release(self._file)
            raise

    def _copy(self, source: Path, path: Path, overwrite: bool) -> None:
        """Create a file, and copy the records of `source` to it."""
        written = written_state(source)
        self._file, self.path, self.untouched = create(path, overwrite=overwrite), path, False
        try:
            with FileIO(source) as original:
                copy_start(original, self._file, written.end)
        except OSError as error:
            self.position = 0
            self._give_up(error)
        self._set_state(written)

    def _set_state(self, written: WrittenState) -> None:
        self._summary, self._top_level = written.summary, written.top_level
        self.position, self._crc = written.end, written.crc

    def _replace_summary(self) -> None:
        """Replace the file with a copy without summary; readers may have mapped the old one."""
        try:
            self._file = replaced(self.path, self._file, self.position)
        except OSError as error:
            release(self._file)
            raise LogError(f"cannot write {self.path}: {error.strerror or error}") from error
        self.untouched = False

    def _store(
        self,
        records: memoryview,
        indexes: Mapping[int, bytes | memoryview],
        times: tuple[int, int],
        compress: Callable[[Any], bytes],
    ) -> None:
        data = compress(records)
        # After an interruption, the file is closed, so the counts must match the chunks.
        with HoldSignals():
            self._write_chunk(records, indexes, times, data, self._compressors.chunk_name)
            for channel_id, entries in indexes.items():
                self._summary.counts[channel_id] += len(entries) // INDEX_ENTRY.itemsize

    def _write_top_level(self, record: TopLevelRecord) -> None:
        offset = self.position
        self._write_record(record)
        self._summary.add(record, offset, self.position - offset)

    def _write(self, *parts: bytes | memoryview) -> None:
        with HoldSignals():
            if self.untouched:
                self._replace_summary()
            super()._write(*parts)
