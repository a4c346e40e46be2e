"""Chunk and ChunkIndex records: compression, CRCs, parsing and serialization."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.limits import MAX_CHUNK_BYTES
from mcaprl.recorder.columns.records import INDEX_ENTRY, RECORD_HEADER_BYTES, LazySequence, crc32

_CHUNK_START = struct.Struct("<BQQQQII")
_ZSTD = zstandard.ZstdCompressionParameters.from_level
# Settings for short records of numbers. Each record is most similar to the records just before it.
# A small hash table is therefore faster than the large table of zstd level 1, and it finds more
# matches. The low bits of floats are random; zstd stores them uncompressed if a target length is
# set. Compared with level 1, files are 2 to 9 % larger, are written in 20 to 50 % less time, and
# are read in 33 to 50 % less time.
SHORT_RECORDS = _ZSTD(1, hash_log=10, target_length=1)
# Settings for images. An image is similar to images much earlier in the chunk, so it needs the
# large hash table of level 1. Its bytes are not random, so no target length is needed.
LONG_RECORDS = _ZSTD(1)
# Settings for messages of different lengths. Most of these are display messages, whose contents
# repeat: a slower search halves their size.
MIXED_RECORDS = _ZSTD(12)
# Settings for a few messages and for short texts. If a file has many chunks of a few messages, they
# are merged and compressed again when it is closed; otherwise, their size does not matter. A slower
# search takes ten times as long and makes texts only a tenth smaller.
FEW_RECORDS = _ZSTD(1)
# Settings for long messages that are rare, such as a static scene. The higher level takes 0.1 s and
# reduces the size by a fifth.
RARE_RECORDS = _ZSTD(16)
# Messages of one length that are longer than this are mostly images, and use `LONG_RECORDS`.
LONG_MESSAGE_BYTES = 2**11
# Messages of different lengths use `RARE_RECORDS` if their mean size is larger than this.
RARE_MESSAGE_BYTES = 2**14
# Messages of different lengths use `FEW_RECORDS` if their mean size is smaller than this. Messages
# of episodes and log lines have about 100 bytes, display messages about 1,000.
TEXT_BYTES = 2**8


def _compressor(
    compression: str, records: zstandard.ZstdCompressionParameters
) -> Callable[[Any], bytes]:
    match compression:
        case "zstd":
            return zstandard.ZstdCompressor(compression_params=records).compress
        case "lz4":
            return lambda data: bytes(lz4.frame.compress(data))
        case _:
            return bytes


class Compressors:
    """Compression functions for chunk records. They share memory, so they are not thread-safe."""

    def __init__(self, compression: str) -> None:
        """Create the compressors for `zstd`, `lz4` or `none`."""
        # Name of the compression in Chunk records.
        self.chunk_name = "" if compression == "none" else compression
        # Compressor for short messages of one length.
        self.short = _compressor(compression, SHORT_RECORDS)
        self.long = _compressor(compression, LONG_RECORDS)
        # Compressor for messages of different lengths.
        self.mixed = _compressor(compression, MIXED_RECORDS)
        # Compressor for a few such messages, or for short texts.
        self.few = _compressor(compression, FEW_RECORDS)
        # Compressor for rare long messages that are not images.
        self.rare = _compressor(compression, RARE_RECORDS)

    def of(self, records: memoryview, count: int) -> Callable[[Any], bytes]:
        """Return the compressor for a chunk of `count` messages."""
        if len(records) > LONG_MESSAGE_BYTES * count:
            return self.long
        first_bytes = RECORD_HEADER_BYTES + int.from_bytes(records[1:RECORD_HEADER_BYTES], "little")
        if len(records) == first_bytes * count:
            return self.short
        return self.few if len(records) < TEXT_BYTES * count else self.mixed


class ChunkHeader(NamedTuple):
    """Header of a Chunk record."""

    start_time: int  # Smallest log_time of the messages, nanoseconds
    end_time: int  # Largest log_time of the messages, nanoseconds
    uncompressed_bytes: int  # Uncompressed length of the records
    crc: int  # CRC-32 of the records; 0 if there is none
    compression: str  # `zstd`, `lz4` or empty
    data: slice  # Position of the compressed records in the file

    def to_record(self) -> bytes:
        """Return the bytes of the Chunk record that precede its data."""
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
        """Return a ChunkIndex, without message indexes, for the Chunk record at `offset`."""
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
    """Parse the header of the Chunk record at `offset`."""
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
        raise CorruptLogError(f"no complete chunk at byte {offset}")
    if size > MAX_CHUNK_BYTES:
        raise CorruptLogError(
            f"the chunk at byte {offset} declares {size} bytes; the limit is {MAX_CHUNK_BYTES}"
        )
    return ChunkHeader(start, end, size, crc, name, slice(data_start, data_start + data_bytes))


_NOTHING = (-1, memoryview(b""))
# Decompressors that no thread uses now. Each of them has at most `_IDLE_BYTES` of memory.
_IDLE: list[zstandard.ZstdDecompressor] = []
_IDLE_BYTES = 2**20


class Scratch:
    """Memory that one thread reuses, as first access costs as much as decompression."""

    def __init__(self) -> None:
        """Create empty scratch memory."""
        self._memory = np.empty(0, np.uint8)
        # Offset and records of the last decompressed chunk; the caller sets them.
        self.kept = _NOTHING

    def take(self, size: int) -> memoryview:
        """Return `size` bytes of memory, which the next call reuses."""
        self.kept = _NOTHING
        if len(self._memory) < size:
            # Release the old memory before the new memory is allocated, to limit the peak memory.
            self._memory = np.empty(0, np.uint8)
            self._memory = np.empty(size, np.uint8)
        return self._memory.data[:size]


def chunk_records(file: memoryview, offset: int, scratch: Scratch | None = None) -> memoryview:
    """Return the records of the chunk at `offset`, decompressed and checked against their CRC."""
    # The records are valid until the next use of `scratch`; without it, they get new memory.
    header = chunk_header(file, offset)
    records = _decompress(file[header.data], header, offset, scratch or Scratch())
    if len(records) != header.uncompressed_bytes:
        raise CorruptLogError(
            f"the chunk at byte {offset} has {len(records)} bytes of records,"
            f" but its header declares {header.uncompressed_bytes}"
        )
    if header.crc and crc32(records) != header.crc:
        raise CorruptLogError(f"the chunk at byte {offset} does not match its CRC")
    return records


def _decompress(data: memoryview, header: ChunkHeader, offset: int, scratch: Scratch) -> memoryview:
    """Decompress a chunk up to one byte beyond its declared size, to stop compression bombs."""
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
        " supported: zstd, lz4, none"
    )


def _inflate_zstd(data: memoryview, scratch: Scratch, limit: int) -> memoryview:
    """Decompress at most `limit` bytes."""
    memory, count = scratch.take(limit), 0
    try:
        # Creating a decompressor takes a tenth as long as decompressing a chunk.
        decompressor = _IDLE.pop()
    except IndexError:
        decompressor = zstandard.ZstdDecompressor()
    with decompressor.stream_reader(data) as reader:
        while count < limit:
            inflated = reader.readinto(memory[count:])
            if not inflated:
                break
            count += inflated
    # Frames without a size need memory for their window, up to 128 MiB.
    if decompressor.memory_size() <= _IDLE_BYTES:
        _IDLE.append(decompressor)
    return memory[:count]


# A ChunkIndex record consists of the start, the map entries, the middle, the name of the
# compression, and the end.
_INDEX_START, _INDEX_MAP_ENTRY = struct.Struct("<QQQQI"), struct.Struct("<HQ")
_INDEX_MIDDLE, _INDEX_END = struct.Struct("<QI"), struct.Struct("<QQ")
# A whole ChunkIndex record of a chunk with one channel and zstd compression.
_INDEX_OF_ONE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("start_time", "<u8"),
        ("end_time", "<u8"),
        ("offset", "<u8"),
        ("chunk_bytes", "<u8"),
        ("map_bytes", "<u4"),
        ("channel", "<u2"),
        ("place", "<u8"),
        ("index_bytes", "<u8"),
        ("name_bytes", "<u4"),
        ("name", "<u4"),
        ("compressed_bytes", "<u8"),
        ("raw_bytes", "<u8"),
    ]
)
# The fields of these records that are always equal.
_ZSTD_NAME = int.from_bytes(b"zstd", "little")
_EQUAL = {
    "opcode": int(Opcode.CHUNK_INDEX),
    "length": _INDEX_OF_ONE.itemsize - RECORD_HEADER_BYTES,
    "map_bytes": _INDEX_MAP_ENTRY.size,
    "name_bytes": 4,
    "name": _ZSTD_NAME,
}
# Number of bytes in a MessageIndex record before its entries.
_INDEX_HEAD_BYTES = RECORD_HEADER_BYTES + 6
# Offsets and lengths above this are not in any file. Sums of a few of them do not overflow.
_MAX_BYTES = 2**60


def chunk_index_record(chunk: ChunkIndex) -> bytes:
    """Serialize a ChunkIndex record. The `mcap` library takes twenty times as long."""
    offsets, name = chunk.message_index_offsets, chunk.compression.encode()
    start = _INDEX_START.pack(
        chunk.message_start_time,
        chunk.message_end_time,
        chunk.chunk_start_offset,
        chunk.chunk_length,
        len(offsets) * _INDEX_MAP_ENTRY.size,
    )
    pairs = b"".join(itertools.starmap(_INDEX_MAP_ENTRY.pack, offsets.items()))
    middle = _INDEX_MIDDLE.pack(chunk.message_index_length, len(name))
    end = _INDEX_END.pack(chunk.compressed_size, chunk.uncompressed_size)
    content = b"".join((start, pairs, middle, name, end))
    return struct.pack("<BQ", Opcode.CHUNK_INDEX, len(content)) + content


def parse_chunk_index(content: memoryview) -> ChunkIndex:
    """Parse the content of a ChunkIndex record."""
    try:
        start_time, end_time, offset, length, map_bytes = _INDEX_START.unpack_from(content)
        middle = _INDEX_START.size + map_bytes
        offsets = dict(_INDEX_MAP_ENTRY.iter_unpack(content[_INDEX_START.size : middle]))
        index_bytes, name_bytes = _INDEX_MIDDLE.unpack_from(content, middle)
        name = middle + _INDEX_MIDDLE.size
        compression = str(content[name : name + name_bytes], "utf-8")
        compressed_bytes, raw_bytes = _INDEX_END.unpack_from(content, name + name_bytes)
    except (struct.error, UnicodeDecodeError) as error:
        raise CorruptLogError("a chunk_index record is damaged") from error
    if len(offsets) * _INDEX_MAP_ENTRY.size < map_bytes:
        raise CorruptLogError("a chunk_index record has several indexes of one channel")
    # The arguments are positional, because keyword arguments take twice as long.
    return ChunkIndex(
        length,
        offset,
        compression,
        compressed_bytes,
        end_time,
        index_bytes,
        offsets,
        start_time,
        raw_bytes,
    )


def indexes_of_one(summary: memoryview) -> NDArray[Any]:
    """Return a copy of the leading ChunkIndex records of zstd chunks with one channel."""
    # Parsing many records takes a hundredth of the time of `parse_chunk_index`.
    size = _INDEX_OF_ONE.itemsize
    rows = np.frombuffer(summary, _INDEX_OF_ONE, len(summary) // size)
    are_such = np.ones(len(rows) + 1, bool)
    are_such[-1] = False
    for name, value in _EQUAL.items():
        are_such[:-1] &= rows[name] == value
    count = int(are_such.argmin())
    # Copying bytes takes a tenth of the time of copying rows.
    return np.frombuffer(bytes(summary[: count * size]), _INDEX_OF_ONE, count)


class ChunkIndexes(LazySequence[ChunkIndex]):
    """Indexes of chunks in file order, parsed on demand: a long log has many thousands."""

    def __init__(self, rows: NDArray[Any], others: Sequence[ChunkIndex] = ()) -> None:
        """Sort indexes by the offset of their chunk."""
        made = dict(enumerate(others, len(rows)))
        if others:
            rows = np.append(rows, np.array(list(map(_row_of, others)), _INDEX_OF_ONE))
        offsets = rows["offset"]
        if (offsets[1:] < offsets[:-1]).any():
            order = np.argsort(offsets, kind="stable")
            rows, places = rows[order], enumerate(order.tolist())
            made = {new: made[old] for new, old in places if old in made}
        super().__init__(len(rows), made)
        self._rows = rows

    def _create(self, number: int) -> ChunkIndex:
        row = self._rows[number].item()
        _, _, start, end, offset, length, _, channel, place, indexes, _, _, packed, raw = row
        return ChunkIndex(
            length, offset, "zstd", packed, end, indexes, {channel: place}, start, raw
        )

    def plus(self, found: Sequence[ChunkIndex]) -> ChunkIndexes:
        """Return these indexes, as they are now, together with others."""
        return ChunkIndexes(self._rows[:0], [*self, *found])

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """(K,) offset of each chunk."""
        return self._bytes("offset")

    @property
    def ends(self) -> NDArray[np.int64]:
        """(K,) offset of the first byte after each chunk and its message indexes."""
        found: NDArray[np.int64] = self.starts + self._bytes("chunk_bytes")
        found += self._bytes("index_bytes")
        return found

    @cached_property
    def channels(self) -> NDArray[np.int64]:
        """(K,) id of each chunk's channel; -1 if it has several channels, or no message index."""
        has_one = self._rows["map_bytes"] == _INDEX_MAP_ENTRY.size
        return np.where(has_one, self._rows["channel"].astype(np.int64), -1)

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """(K,) number of messages of each chunk with one channel, by the length of its index."""
        entries_bytes = np.maximum(self._bytes("index_bytes") - _INDEX_HEAD_BYTES, 0)
        found: NDArray[np.int64] = entries_bytes // INDEX_ENTRY.itemsize
        return found

    def follow_in_time(self, numbers: NDArray[np.int64]) -> bool:
        """Return whether chunks follow each other without overlap in time."""
        starts, ends = self._rows["start_time"][numbers], self._rows["end_time"][numbers]
        return bool((ends[:-1] <= starts[1:]).all())

    def _bytes(self, name: str) -> NDArray[np.int64]:
        found: NDArray[np.uint64] = np.minimum(self._rows[name], np.uint64(_MAX_BYTES))
        return found.astype(np.int64)


def _row_of(chunk: ChunkIndex) -> tuple[int, ...]:
    """Return the values of `_INDEX_OF_ONE` for an index of any kind."""
    offsets = chunk.message_index_offsets
    channel, place = next(iter(offsets.items()), (0, 0))
    return (
        _EQUAL["opcode"],
        _EQUAL["length"],
        chunk.message_start_time,
        chunk.message_end_time,
        chunk.chunk_start_offset,
        chunk.chunk_length,
        len(offsets) * _INDEX_MAP_ENTRY.size,
        channel,
        place,
        chunk.message_index_length,
        _EQUAL["name_bytes"],
        _EQUAL["name"],
        chunk.compressed_size,
        chunk.uncompressed_size,
    )
