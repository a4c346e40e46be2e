"""Compaction of a finished MCAP file: small chunks are merged into larger ones.

A writer that flushes often leaves many small chunks. A reader needs as much time for a small chunk
as for hundreds of messages. The compacted file is written beside the original, and replaces it only
when it is complete and on disk: until then, the original is a valid file with all messages.

Only chunks of the same kind are merged; channels that share a chunk are of the same kind. All other
bytes are copied unchanged, so that the messages of each kind keep their order.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterable
from dataclasses import replace
from io import FileIO
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from mcaprl.errors import CorruptLogError, LogError
from mcaprl.files import is_at, work_folder
from mcaprl.recorder.columns.chunks import Compressors, Scratch, chunk_records
from mcaprl.recorder.columns.file_lock import create
from mcaprl.recorder.columns.output import OutputFile
from mcaprl.recorder.columns.reader import end_of
from mcaprl.recorder.columns.records import MAGIC, contents_of, map_file, records_of
from mcaprl.recorder.columns.summary import Summary

SMALL_CHUNK_BYTES = 2**16
"""Chunks with fewer bytes of uncompressed records than this are merged."""
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
    """Rewrite a finished file with larger chunks if it has many small chunks.

    An error while writing leaves the original unchanged.

    Args:
        path: Path of the file.
        file: The file, locked by the caller. Its lock keeps out other writers until the new file
            is in place.
        summary: Summary of the file.
        data_end: First byte of the DataEnd record.
        compressors: Compression of the merged chunks.
    """
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
    """Group the source chunks, so that each group becomes one chunk of the compacted file.

    Groups are in file order. A merged chunk takes the place of its last source chunk. Thus all
    top-level records that the merged chunk needs come before it.
    """
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
        """Write the whole copy.

        Raises:
            CorruptLogError: The file is damaged, or has chunks that its summary does not list.
            LogError: The copy cannot be written.
        """
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
