"""Chunks: how their records are compressed, and come out again, checked against their CRC."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns.checksum import crc32
from mcaprl.recorder.columns.message_rows import RECORD_HEADER_BYTES

# 32 KB of zstd can inflate to 1 GiB; no sane writer makes chunks of this size.
MAX_CHUNK_BYTES = 256 * 2**20

_CHUNK_START = struct.Struct("<BQQQQII")
# Likewise, of many at once.
CHUNK_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("content_bytes", "<u8"),
        ("start_time", "<u8"),
        ("end_time", "<u8"),
        ("raw_bytes", "<u8"),
    ]
)
_ZSTD = zstandard.ZstdCompressionParameters.from_level
# Of numbers, a record is most like those just before it, so a table that remembers little else is
# faster than that of zstd's level 1 and finds more. What it does not find is the noise of floats'
# last digits, and is stored as it is (to the fast strategy, a target length says so): that takes 2
# to 9 % more space, a fifth to a half less time to write, and a third to a half less to read.
SHORT_RECORDS = _ZSTD(1, hash_log=10, target_length=1)
# Pictures are like others further back, and their bytes are not noise.
LONG_RECORDS = _ZSTD(1)
# Messages one by one are mostly for viewers: they repeat themselves so much that a slower search
# halves them.
MIXED_RECORDS = _ZSTD(9)


def compressor(
    compression: str, records: zstandard.ZstdCompressionParameters
) -> Callable[[Any], bytes]:
    """A function that compresses a chunk's records: `zstd`, `lz4`, or `none`.

    It keeps its memory between calls, so only one thread may call it.

    Args:
        compression: one of these.
        records: what they are like, for zstd: `SHORT_RECORDS` and so on.
    """
    match compression:
        case "zstd":
            return zstandard.ZstdCompressor(compression_params=records).compress
        case "lz4":
            return lambda data: bytes(lz4.frame.compress(data))
        case _:
            return bytes


class ChunkHeader(NamedTuple):
    """What a Chunk record says of itself.

    Attributes:
        start_time: smallest log_time in it, nanoseconds.
        end_time: largest.
        uncompressed_bytes: length of its records.
        crc: CRC-32 of its records; 0 if the writer gave none.
        compression: `zstd`, `lz4` or empty.
        data: where the compressed records are in the file.
    """

    start_time: int
    end_time: int
    uncompressed_bytes: int
    crc: int
    compression: str
    data: slice

    def to_record(self) -> bytes:
        """The Chunk record up to its data, which follows it."""
        name, data_bytes = self.compression.encode(), int(self.data.stop - self.data.start)
        length = _CHUNK_START.size - RECORD_HEADER_BYTES + len(name) + 8 + data_bytes
        start: bytes = _CHUNK_START.pack(
            Opcode.CHUNK,
            length,
            self.start_time,
            self.end_time,
            self.uncompressed_bytes,
            self.crc,
            len(name),
        )
        return b"".join((start, name, data_bytes.to_bytes(8, "little")))

    def to_index(self, offset: int, content_bytes: int) -> ChunkIndex:
        """What a summary would tell, before anything is known of indexes of its messages.

        Args:
            offset: of the Chunk record.
            content_bytes: that record's length.
        """
        return ChunkIndex(
            chunk_start_offset=offset,
            chunk_length=RECORD_HEADER_BYTES + content_bytes,
            compression=self.compression,
            compressed_size=self.data.stop - self.data.start,
            uncompressed_size=self.uncompressed_bytes,
            message_start_time=self.start_time,
            message_end_time=self.end_time,
            message_index_offsets={},
            message_index_length=0,
        )


def chunk_header(file: memoryview, offset: int) -> ChunkHeader:
    """Parse the Chunk record at `offset`.

    Raises:
        CorruptLogError: there is none, or its lengths do not fit.
    """
    try:
        opcode, length, start, end, size, crc, name_bytes = _CHUNK_START.unpack_from(file, offset)
        name_start = offset + _CHUNK_START.size
        data_start = name_start + name_bytes + 8
        name = str(file[name_start : name_start + min(name_bytes, 16)], "ascii")
        (data_bytes,) = struct.unpack_from("<Q", file, data_start - 8)
    except (struct.error, UnicodeDecodeError) as error:
        raise CorruptLogError(f"no chunk at byte {offset}") from error
    record_end = offset + RECORD_HEADER_BYTES + length
    if opcode != Opcode.CHUNK or data_start + data_bytes > min(record_end, len(file)):
        raise CorruptLogError(f"no whole chunk at byte {offset}")
    if size > MAX_CHUNK_BYTES:
        raise CorruptLogError(
            f"the chunk at byte {offset} claims {size} bytes; at most {MAX_CHUNK_BYTES} are read"
        )
    return ChunkHeader(start, end, size, crc, name, slice(data_start, data_start + data_bytes))


_NOTHING = (-1, memoryview(b""))


class Scratch:
    """Memory into which one chunk after the other is decompressed, by one thread.

    Memory that is touched for the first time costs as much as what is then written to it, so the
    same is used for all chunks that are only passed through.

    Attributes:
        kept: where the chunk begins that was decompressed into it last, and its records, as its
            user noted them: who asks for an example of a chunk asks for all of it next.
    """

    def __init__(self) -> None:
        """Begin without memory."""
        self._memory = np.empty(0, np.uint8)
        self.kept = _NOTHING

    @cached_property
    def zstd(self) -> zstandard.ZstdDecompressor:
        """What decompresses zstd into it."""
        return zstandard.ZstdDecompressor()

    def take(self, size: int) -> memoryview:
        """So many bytes; what was taken before is overwritten."""
        self.kept = _NOTHING
        if len(self._memory) < size:
            # First let go of what is there.
            self._memory = np.empty(0, np.uint8)
            self._memory = np.empty(size, np.uint8)
        return self._memory.data[:size]


@dataclass(frozen=True)
class _Rest:
    """What is left of memory that several chunks share."""

    memory: memoryview
    zstd: zstandard.ZstdDecompressor

    def take(self, size: int) -> memoryview:
        if len(self.memory) < size:
            raise CorruptLogError(f"chunks are larger than the summary tells, by {size} bytes")
        return self.memory[:size]


def chunk_records(
    file: memoryview, offset: int, scratch: Scratch | _Rest | None = None
) -> memoryview:
    """The records of the chunk at `offset`, decompressed and checked against their CRC.

    Args:
        file: the bytes of the file.
        offset: of the Chunk record.
        scratch: where to; then the records are there until it is used again. Default: new memory.

    Raises:
        CorruptLogError: the chunk is damaged, or inflates to another size than it claims.
    """
    header = chunk_header(file, offset)
    records = _decompress(file[header.data], header, offset, scratch or Scratch())
    if len(records) != header.uncompressed_bytes:
        raise CorruptLogError(
            f"the chunk at byte {offset} has {len(records)} bytes of records,"
            f" not the {header.uncompressed_bytes} it claims"
        )
    if header.crc and crc32(records) != header.crc:
        raise CorruptLogError(f"the chunk at byte {offset} does not match its CRC")
    return records


def joined_records(
    file: memoryview, offsets: Sequence[int], size: int, scratch: Scratch
) -> tuple[memoryview, list[int]]:
    """The records of several chunks, one behind the other; likewise.

    Args:
        file: the bytes of the file.
        offsets: of the Chunk records.
        size: of all records together.
        scratch: where to; the records are there until it is used again.

    Returns:
        The records, and where those of each chunk end.

    Raises:
        CorruptLogError: a chunk is damaged, or they are larger than that.
    """
    memory, stops, end = scratch.take(size + 1), [], 0
    for offset in offsets:
        records = chunk_records(file, offset, _Rest(memory[end:], scratch.zstd))
        if records.obj is not memory.obj:
            _Rest(memory[end:], scratch.zstd).take(len(records))[:] = records
        end += len(records)
        stops.append(end)
    return memory[:end], stops


def _decompress(
    data: memoryview, header: ChunkHeader, offset: int, scratch: Scratch | _Rest
) -> memoryview:
    """Inflate to at most one byte more than claimed, so that a bomb is seen and not swallowed."""
    limit = header.uncompressed_bytes + 1
    try:
        match header.compression:
            case "zstd":
                return _inflate_zstd(data, scratch, limit)
            case "lz4":
                found = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=limit)
                return memoryview(found)
            case "":
                return data
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise CorruptLogError(f"the chunk at byte {offset} cannot be decompressed") from error
    raise CorruptLogError(
        f"the chunk at byte {offset} is compressed with {header.compression!r};"
        " known are zstd, lz4 and none"
    )


def _inflate_zstd(data: memoryview, scratch: Scratch | _Rest, limit: int) -> memoryview:
    """The first `limit` bytes. A frame that tells its size, if that fits, is inflated in one go."""
    memory, count = scratch.take(limit), 0
    with scratch.zstd.stream_reader(data) as reader:
        while count < limit:
            inflated = reader.readinto(memory[count:])
            if not inflated:
                break
            count += inflated
    return memory[:count]
