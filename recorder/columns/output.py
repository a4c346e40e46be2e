"""MCAP file that is being written: bytes, CRCs, chunks and the summary."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import replace
from io import FileIO
from pathlib import Path
from typing import NoReturn

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex, DataEnd, McapRecord

from mcaprl.errors import LogError
from mcaprl.files import is_at
from mcaprl.limits import MAX_CHUNK_BYTES
from mcaprl.recorder.columns.checksum import crc32
from mcaprl.recorder.columns.chunks import ChunkHeader
from mcaprl.recorder.columns.file_lock import release
from mcaprl.recorder.columns.message_rows import message_index_head
from mcaprl.recorder.columns.signals import HoldSignals
from mcaprl.recorder.columns.summary import Summary

# Up to this total size, joining the parts is faster than one system call for each part.
_JOINED_BYTES = 2**16


class OutputFile:
    """Locked file to which whole records are written.

    Attributes:
        path: Path of the file.
        position: Length of the file so far.
    """

    def __init__(self, path: Path, file: FileIO) -> None:
        """Start at the beginning of an empty file."""
        self.path, self._file = path, file
        self.position, self._crc, self._summary, self._data_end = 0, 0, Summary(), 0

    def is_at(self, path: str | Path) -> bool:
        """Return whether `path` refers to the open file."""
        return is_at(self._file.fileno(), path)

    def abandon(self) -> None:
        """Close the file without a summary. Closing twice is harmless."""
        with contextlib.suppress(OSError):
            release(self._file)

    def _write_chunk(
        self,
        records: memoryview,
        indexes: Mapping[int, bytes | memoryview],
        times: tuple[int, int],
        data: bytes | memoryview,
        compression: str,
    ) -> None:
        """Write a chunk and its message indexes.

        Args:
            records: Records of the chunk.
            indexes: Entries of `message_rows.INDEX_ENTRY` as bytes, by channel id.
            times: Smallest and largest log_time, nanoseconds.
            data: Compressed records.
            compression: Name of the compression in the Chunk record.
        """
        assert len(records) <= MAX_CHUNK_BYTES, "readers refuse larger chunks"
        header = ChunkHeader(
            *times, len(records), crc32(records), compression, data=slice(0, len(data))
        )
        # `data` is not copied: a copy would take as long as the rest of this function.
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
                    compression=compression,
                    compressed_size=len(data),
                    uncompressed_size=len(records),
                    message_start_time=times[0],
                    message_end_time=times[1],
                    message_index_offsets=index_offsets,
                    message_index_length=index_bytes,
                )
            )

    def _copy_chunk(self, view: memoryview, chunk: ChunkIndex) -> None:
        """Copy the bytes of a chunk and its message indexes from another file."""
        shift = self.position - chunk.chunk_start_offset
        offsets = {id_: offset + shift for id_, offset in chunk.message_index_offsets.items()}
        stop = chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length
        with HoldSignals():
            self._write(view[chunk.chunk_start_offset : stop])
            self._summary.chunks.append(
                replace(
                    chunk,
                    chunk_start_offset=chunk.chunk_start_offset + shift,
                    message_index_offsets=offsets,
                )
            )

    def _finish(self) -> None:
        """Write the end of the data section and the summary."""
        self._data_end = self.position
        self._write_record(DataEnd(self._crc))
        self._write(self._summary.to_bytes(self.position))

    def _write_record(self, record: McapRecord) -> None:
        builder = RecordBuilder()
        record.write(builder)
        self._write(builder.end())

    def _write(self, *parts: bytes | memoryview) -> None:
        """Write all parts or none, so that the file is always a sequence of whole records."""
        try:
            with HoldSignals():
                if sum(map(len, parts)) <= _JOINED_BYTES:
                    parts = (b"".join(parts),)
                # Compute the CRC before writing: it loads the pages of a mapped source faster than
                # `write` does.
                crc = self._crc
                for part in parts:
                    crc = crc32(part, crc)
                for part in parts:
                    rest = memoryview(part)
                    while rest:
                        rest = rest[self._file.write(rest) :]
                self._crc = crc
                self.position += sum(map(len, parts))
        except OSError as error:
            self._give_up(error)
        except ValueError as error:
            # A process that was forked from the writer's has closed its copy of the file.
            raise LogError(
                f"{self.path} is closed, or was opened by another process: open it in this process"
            ) from error

    def _give_up(self, error: OSError) -> NoReturn:
        """Truncate the file after its last complete record, close it, and raise LogError."""
        with contextlib.suppress(OSError):
            self._file.truncate(self.position)
        self.abandon()
        raise LogError(
            f"cannot write {self.path}: {error.strerror}; everything written before is in the file"
        ) from error
