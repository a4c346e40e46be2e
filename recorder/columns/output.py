"""MCAP file that is being written: its lock, delayed signals, and compaction at the end.

A writer that flushes often leaves many small chunks. A reader needs as much time for a small chunk
as for hundreds of messages, so compaction merges them. The compacted file is written beside the
original, and replaces it only when it is complete and on disk: until then, the original is a valid
file with all messages.

Only chunks of the same kind are merged; channels that share a chunk are of the same kind. All other
bytes are copied unchanged, so that the messages of each kind keep their order.

Readers need no lock, since a file only grows by whole records or is replaced as a whole: a writer
never changes or cuts off bytes that a reader may have mapped.
"""

from __future__ import annotations

import contextlib
import errno
import inspect
import os
import signal
import stat
import threading
from collections.abc import Iterable, Mapping
from dataclasses import replace
from io import FileIO
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, ClassVar, NoReturn

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, DataEnd, McapRecord

from mcaprl.errors import CorruptLogError, LogError
from mcaprl.files import check_regular, check_target, hold, is_at, taken, try_lock, work_folder
from mcaprl.limits import MAX_CHUNK_BYTES
from mcaprl.recorder.columns.chunks import ChunkHeader, Compressors, Scratch, chunk_records
from mcaprl.recorder.columns.reader import end_of
from mcaprl.recorder.columns.records import (
    MAGIC,
    contents_of,
    crc32,
    map_file,
    message_index_head,
    records_of,
)
from mcaprl.recorder.columns.summary import Summary
from mcaprl.system import STOPS, unlock_descriptor

try:
    # These functions return plain numbers. Their wrappers in `signal` convert the numbers to enums,
    # which takes ten times as long.
    from _signal import getsignal  # type: ignore[import-not-found]
    from _signal import signal as set_handler
except ImportError:
    from signal import getsignal
    from signal import signal as set_handler


class HoldSignals:
    """Context that delays signals to its end, in the main thread alone; nested, it does nothing."""

    _is_held: ClassVar[bool] = False

    def __enter__(self) -> None:
        """Start to delay signals."""
        self._holds = not self._is_held and (threading.current_thread() is threading.main_thread())
        if not self._holds:
            return
        self._handlers: dict[int, Any] = {}
        self._waiting: list[int] = []
        try:
            HoldSignals._is_held = True
            for number in STOPS:
                handler = getsignal(number)
                # A handler that was not installed from Python (None) cannot be restored.
                if handler is not None:
                    self._handlers[number] = handler
                    set_handler(number, self._note)
        except BaseException:
            self._restore()
            raise

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Handle the delayed signals."""
        if not self._holds:
            return
        self._restore()
        for number in self._waiting:
            handler = self._handlers[number]
            if callable(handler):
                handler(number, inspect.currentframe())
            elif handler == signal.SIG_DFL:
                signal.raise_signal(number)

    def _note(self, number: int, frame: FrameType | None) -> None:
        # The frame is not stored: it would keep its local variables alive.
        self._waiting.append(number)

    def _restore(self) -> None:
        HoldSignals._is_held = False
        for number, handler in self._handlers.items():
            set_handler(number, handler)


_COPIED_BYTES = 2**20


def create(path: Path, *, overwrite: bool) -> FileIO:
    """Create and lock a file and the missing folders of its path."""
    # If a file is overwritten, processes that have it open still read the old contents.
    check_target(path, overwrite=overwrite)
    try:
        if path.exists():
            return replaced(path, reopen(path), 0)
        path.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            file = _locked(FileIO(path, "x"), path)
            if is_at(file.fileno(), path):
                return file
            release(file)
    except OSError as error:
        raise LogError(f"cannot write {path}: {error.strerror or error}") from error
    # Another process has created or replaced the file in the meantime.
    raise taken(path)


def reopen(path: Path) -> FileIO:
    """Open and lock an existing file."""
    try:
        while True:
            check_regular(path)
            file = _locked(FileIO(path, "r+"), path)
            if is_at(file.fileno(), path):
                return file
            release(file)
    except OSError as error:
        raise LogError(f"cannot write {path}: {error.strerror or error}") from error


def release(file: FileIO) -> None:
    """Unlock and close a file, even if a child process still has it open."""
    if not file.closed:
        unlock_descriptor(file.fileno())
    file.close()


def replaced(path: Path, locked: FileIO, length: int) -> FileIO:
    """Replace a file with a locked copy of its first bytes. Current readers keep the old file."""
    # The old file is released once the copy is in place; an error leaves it unchanged.
    path = path.resolve()
    with work_folder(path) as folder:
        unfinished = folder / path.name
        file = _locked(FileIO(unfinished, "x+"), path)
        try:
            copy_start(locked, file, length)
            os.chmod(unfinished, stat.S_IMODE(os.fstat(locked.fileno()).st_mode))
            os.replace(unfinished, path)
        except BaseException:
            release(file)
            raise
    release(locked)
    return file


def copy_start(source: FileIO, target: FileIO, length: int) -> None:
    """Copy the first bytes of a file."""
    source.seek(0)
    while length:
        part = memoryview(source.read(min(length, _COPIED_BYTES)))
        if not part:
            raise OSError(errno.EIO, "the file became shorter while it was copied")
        length -= len(part)
        while part:
            part = part[target.write(part) :]


def _locked(file: FileIO, path: Path) -> FileIO:
    if not try_lock(file.fileno()):
        error = taken(path, file.fileno())
        file.close()
        raise error
    hold(file, records=True)
    return file


# Up to this total size, joining the parts is faster than one system call for each part.
_JOINED_BYTES = 2**16


class OutputFile:
    """Locked file to which whole records are written."""

    def __init__(self, path: Path, file: FileIO) -> None:
        """Start at the beginning of an empty file."""
        self.path, self._file = path, file
        # Length of the file so far.
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
        """Write a chunk and its message indexes; `times` are its smallest and largest log_time."""
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


SMALL_CHUNK_BYTES = 2**16  # Chunks with fewer bytes of uncompressed records than this are merged
_MERGED_BYTES = 2**20
# Compaction must remove at least this many chunks to be worth the time.
_MIN_CHUNKS_SAVED = 8
# For each chunk that it removes, compaction copies at most this number of bytes. Copying more bytes
# would take longer than the time that readers save.
_MAX_BYTES_PER_CHUNK = 2**20
# Opcodes of records that cannot be between two chunks that the summary lists. If there is such a
# record, the summary is incomplete.
_CHUNK_RECORDS = (Opcode.CHUNK, Opcode.MESSAGE, Opcode.MESSAGE_INDEX)


def compact(
    path: Path, file: FileIO, summary: Summary, data_end: int, compressors: Compressors
) -> None:
    """Rewrite a finished file of many small chunks with larger ones."""
    # An error leaves it unchanged.
    groups = groups_of(summary.chunks)
    saved = len(summary.chunks) - len(groups)
    if saved < _MIN_CHUNKS_SAVED or data_end > saved * _MAX_BYTES_PER_CHUNK:
        return
    if not is_at(file.fileno(), path):
        return
    target = path.resolve()
    # The log is complete without compaction, so an error such as a full disk is ignored.
    with contextlib.suppress(OSError, LogError), work_folder(target) as folder:
        unfinished = folder / target.name
        out = _CompactedFile(unfinished, create(unfinished, overwrite=False))
        try:
            out.copy(map_file(target), summary, data_end, groups, compressors)
            out.replace(target, stat.S_IMODE(target.stat().st_mode))
        finally:
            out.abandon()


def groups_of(chunks: Iterable[ChunkIndex]) -> list[list[ChunkIndex]]:
    """Group the source chunks, so that each group becomes one chunk of the compacted file."""
    # A merged chunk takes the place of its last source chunk. Thus all top-level records that it
    # needs come before it.
    chunks = list(chunks)
    kinds = _kinds(chunks)
    groups: list[list[ChunkIndex]] = []
    # For each kind: its last group, and the uncompressed size of this group in bytes.
    current: dict[int, tuple[list[ChunkIndex], int]] = {}
    for chunk in chunks:
        size = chunk.uncompressed_size
        kind = kinds[next(iter(chunk.message_index_offsets))] if chunk.message_index_offsets else -1
        group, group_bytes = current.get(kind, ([], 0))
        if kind < 0 or size >= SMALL_CHUNK_BYTES:
            current.pop(kind, None)
            groups.append([chunk])
            continue
        if not group or group_bytes + size > _MERGED_BYTES:
            group, group_bytes = [], 0
            groups.append(group)
        group.append(chunk)
        current[kind] = group, group_bytes + size
    return sorted(groups, key=lambda group: group[-1].chunk_start_offset)


def _kinds(chunks: Iterable[ChunkIndex]) -> dict[int, int]:
    """Return a kind number for each channel. Channels that share a chunk get the same number."""
    kinds: dict[int, int] = {}
    for ids in {tuple(chunk.message_index_offsets) for chunk in chunks}:
        connected = {kinds.get(channel_id, channel_id) for channel_id in ids}
        for channel_id in {*ids, *(id_ for id_, kind in kinds.items() if kind in connected)}:
            kinds[channel_id] = min(connected)
    return kinds


class _CompactedFile(OutputFile):
    """Compacted copy of a file."""

    def copy(
        self,
        view: memoryview,
        summary: Summary,
        data_end: int,
        groups: list[list[ChunkIndex]],
        compressors: Compressors,
    ) -> None:
        """Write the whole copy."""
        scratch = Scratch()
        self._summary.schemas, self._summary.channels = summary.schemas, summary.channels
        self._summary.counts = summary.counts
        by_last = {group[-1].chunk_start_offset: group for group in groups}
        end = 0
        for chunk in summary.chunks:
            self._copy_top_level(view, slice(end, chunk.chunk_start_offset), summary)
            group, end = by_last.get(chunk.chunk_start_offset, []), end_of(chunk)
            if len(group) == 1:
                self._copy_chunk(view, chunk)
            elif group:
                self._merge(view, group, compressors, scratch)
        self._copy_top_level(view, slice(end, data_end), summary)
        self._finish()

    def replace(self, target: Path, mode: int) -> None:
        """Replace the original with the finished copy."""
        self._file.flush()
        os.fsync(self._file.fileno())
        os.chmod(self.path, mode)
        os.replace(self.path, target)

    def _copy_top_level(self, view: memoryview, part: slice, summary: Summary) -> None:
        """Copy the bytes between two chunks; usually there are none."""
        if part.start == part.stop:
            return
        first_record = part.start or len(MAGIC)
        if any(op in _CHUNK_RECORDS for _, op, _ in records_of(view, first_record, part.stop)):
            raise CorruptLogError("the summary does not list all chunks and indexes")
        shift = self.position - part.start
        for kind in ("metadata", "attachments"):
            getattr(self._summary, kind).extend(
                replace(index, offset=index.offset + shift)
                for index in getattr(summary, kind)
                if part.start <= index.offset < part.stop
            )
        self._write(view[part])

    def _merge(
        self, view: memoryview, group: list[ChunkIndex], compressors: Compressors, scratch: Scratch
    ) -> None:
        """Write the messages of several chunks as one chunk."""
        joined = bytearray()
        for chunk in group:
            joined += chunk_records(view, chunk.chunk_start_offset, scratch)
        records = memoryview(joined)
        indexes = contents_of(records).indexes
        count = sum(map(len, indexes.values()))
        starts = [chunk.message_start_time for chunk in group]
        ends = [chunk.message_end_time for chunk in group]
        self._write_chunk(
            records,
            {id_: index.tobytes() for id_, index in indexes.items()},
            (min(starts), max(ends)),
            compressors.of(records, count)(records),
            compressors.chunk_name,
        )
