"""The hot path: a chunk's messages of one length are one NumPy array.

In an MCAP chunk each message is a record: opcode 0x05, the record's length, channel, sequence
number, two times, then the payload. Where payloads have one length, a run of messages is a
structured array of `record_dtype(payload)`; the rows of a MessageIndex are one of `INDEX_ENTRY`.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError

MESSAGE_HEADER = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel_id", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
# A record's length counts what follows its opcode and length.
RECORD_HEADER_BYTES = 9
INDEX_ENTRY = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
# 32 KB of zstd can inflate to 1 GiB; no sane writer makes chunks of this size.
MAX_CHUNK_BYTES = 256 * 2**20

_CHUNK_START, _INDEX_START = struct.Struct("<BQQQQII"), struct.Struct("<BQHI")


@lru_cache(maxsize=64)
def record_dtype(payload: np.dtype[Any]) -> np.dtype[Any]:
    """A message record: its header's fields, then `payload`."""
    return np.dtype(
        [*((n, MESSAGE_HEADER[n]) for n in MESSAGE_HEADER.names or ()), ("payload", payload)]
    )


def message_rows(capacity: int, payload: np.dtype[Any], channel_id: int) -> NDArray[Any]:
    """Preallocate message records; what is the same in all of them is filled in."""
    dtype = record_dtype(payload)
    rows = np.zeros(capacity, dtype)
    rows["opcode"] = Opcode.MESSAGE
    rows["length"] = dtype.itemsize - RECORD_HEADER_BYTES
    rows["channel_id"] = channel_id
    return rows


def compressor(compression: str, zstd_level: int = 1) -> Callable[[Any], bytes]:
    """A function that compresses a chunk's records: `zstd`, `lz4`, or `none`.

    It keeps its memory between calls, so only one thread may call it.
    """
    match compression:
        case "zstd":
            return zstandard.ZstdCompressor(level=zstd_level).compress
        case "lz4":
            return lambda data: bytes(lz4.frame.compress(data))
        case _:
            return bytes


@dataclass(frozen=True)
class ChunkHeader:
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


def chunk_header(file: memoryview, offset: int) -> ChunkHeader:
    """Parse the Chunk record at `offset`.

    Raises:
        CorruptLogError: there is none, or its lengths do not fit.
    """
    try:
        opcode, length, start, end, size, crc, name_bytes = _CHUNK_START.unpack_from(file, offset)
        name_start = offset + _CHUNK_START.size
        data_start = name_start + name_bytes + 8
        name = bytes(file[name_start : name_start + min(name_bytes, 16)]).decode("ascii")
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


def chunk_records(file: memoryview, offset: int) -> memoryview:
    """The records of the chunk at `offset`, decompressed and checked against their CRC.

    Raises:
        CorruptLogError: the chunk is damaged, or inflates to another size than it claims.
    """
    header = chunk_header(file, offset)
    records = _decompress(file[header.data], header, offset)
    if len(records) != header.uncompressed_bytes:
        raise CorruptLogError(
            f"the chunk at byte {offset} has {len(records)} bytes of records,"
            f" not the {header.uncompressed_bytes} it claims"
        )
    if header.crc and zlib.crc32(records) != header.crc:
        raise CorruptLogError(f"the chunk at byte {offset} does not match its CRC")
    return memoryview(records)


def _decompress(data: memoryview, header: ChunkHeader, offset: int) -> bytes | memoryview:
    """Inflate to at most one byte more than claimed, so that a bomb is seen and not swallowed."""
    limit = header.uncompressed_bytes + 1
    try:
        match header.compression:
            case "zstd":
                if zstandard.frame_content_size(data) == header.uncompressed_bytes:
                    return zstandard.ZstdDecompressor().decompress(data)
                with zstandard.ZstdDecompressor().stream_reader(data) as reader:
                    return reader.read(limit)
            case "lz4":
                return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=limit))
            case "":
                return data
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise CorruptLogError(f"the chunk at byte {offset} cannot be decompressed") from error
    raise CorruptLogError(
        f"the chunk at byte {offset} is compressed with {header.compression!r};"
        " known are zstd, lz4 and none"
    )


def message_index(file: memoryview, offset: int, channel_id: int) -> NDArray[Any]:
    """The entries (`log_time`, `offset` in the chunk) of the MessageIndex record at `offset`.

    Raises:
        CorruptLogError: there is none of that channel.
    """
    try:
        opcode, _, channel, entries_bytes = _INDEX_START.unpack_from(file, offset)
        start = offset + _INDEX_START.size
        count, rest = divmod(entries_bytes, INDEX_ENTRY.itemsize)
        if opcode == Opcode.MESSAGE_INDEX and channel == channel_id and rest == 0:
            return np.frombuffer(file, INDEX_ENTRY, count, start)
    except (struct.error, ValueError):
        pass
    raise CorruptLogError(f"no message index of channel {channel_id} at byte {offset}")


def gather(records: memoryview, index: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """The messages that an index points at, as one structured array.

    Without copying where they lie one behind the other; else by one fancy index of void items,
    which is memcpy's speed (a structured one is twenty times slower).

    Args:
        records: a chunk's uncompressed records.
        index: entries of the MessageIndex.
        dtype: `record_dtype` of the channel's payload.

    Raises:
        CorruptLogError: an entry points outside the chunk.
    """
    offsets, size = index["offset"], dtype.itemsize
    if len(offsets) == 0:
        return np.empty(0, dtype)
    # Compared without adding: an offset near 2**64 must not wrap around.
    if len(records) < size or offsets.max() > len(records) - size:
        raise CorruptLogError("a message index points outside its chunk")
    first = int(offsets[0])
    if len(offsets) == 1 or (
        int(offsets[-1]) - first == size * (len(offsets) - 1)
        and bool(np.all(np.diff(offsets) == size))
    ):
        return np.frombuffer(records, dtype, len(offsets), first)
    bytes_ = np.frombuffer(records, np.uint8)
    windows = np.lib.stride_tricks.as_strided(
        bytes_[:size].view(np.dtype((np.void, size))), (len(records) - size + 1,), (1,)
    )
    return windows[offsets.astype(np.intp)].view(dtype)
