"""The hot path: a chunk's messages of one length are one NumPy array.

In an MCAP chunk each message is a record: opcode 0x05, the record's length, channel, sequence
number, two times, then the payload. Where payloads have one length, a run of messages is a
structured array of `record_dtype(payload)`; the rows of a MessageIndex are one of `INDEX_ENTRY`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.checksum import crc32

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
# What all records of one channel and length begin with: opcode, length, channel.
_HEAD = struct.Struct("<BQH")
_MESSAGE = struct.Struct("<BQHIQQ")


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


def message_record(channel_id: int, sequence: int, time_ns: int, data: bytes) -> bytes:
    """One Message record, logged and published at one time."""
    length = _MESSAGE.size - RECORD_HEADER_BYTES + len(data)
    head = _MESSAGE.pack(Opcode.MESSAGE, length, channel_id, sequence, time_ns, time_ns)
    return head + data


def are_messages(rows: NDArray[Any], channel_id: int) -> bool:
    """Whether all rows of a `record_dtype` begin as messages of that length and channel do."""
    size = rows.dtype.itemsize
    told = _HEAD.pack(Opcode.MESSAGE, size - RECORD_HEADER_BYTES, channel_id)
    words, expected = rows.view(_words(size)), np.frombuffer(told, _words(_HEAD.size))[0]
    return all(bool((words[name] == expected[name]).all()) for name in ("front", "back"))


@lru_cache(maxsize=64)
def _words(size: int) -> np.dtype[Any]:
    """A record's first bytes as two words that overlap: faster to compare than its fields."""
    formats, offsets = ["<u8", "<u8"], [0, _HEAD.size - 8]
    return np.dtype(
        {"names": ["front", "back"], "formats": formats, "offsets": offsets, "itemsize": size}
    )


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
        self.zstd = zstandard.ZstdDecompressor()

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


def message_index_head(channel_id: int, entries_bytes: int) -> bytes:
    """The MessageIndex record of a channel up to its entries, which follow it."""
    length = _INDEX_START.size - RECORD_HEADER_BYTES + entries_bytes
    head: bytes = _INDEX_START.pack(Opcode.MESSAGE_INDEX, length, channel_id, entries_bytes)
    return head


def message_index(file: memoryview, offset: int, channel_id: int) -> memoryview:
    """The entries of the MessageIndex record at `offset`, as bytes: see `INDEX_ENTRY`.

    Raises:
        CorruptLogError: there is none of that channel.
    """
    try:
        opcode, _, channel, entries_bytes = _INDEX_START.unpack_from(file, offset)
    except struct.error:
        opcode = None
    if opcode == Opcode.MESSAGE_INDEX and channel == channel_id:
        start = offset + _INDEX_START.size
        entries = file[start : start + entries_bytes]
        if len(entries) == entries_bytes and entries_bytes % INDEX_ENTRY.itemsize == 0:
            return entries
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
    if _touch_each_other(offsets, size, len(records)):
        return np.frombuffer(records, dtype, len(offsets), int(offsets[0]))
    # Compared without adding: an offset near 2**64 must not wrap around.
    if len(records) < size or offsets.max() > len(records) - size:
        raise CorruptLogError("a message index points outside its chunk")
    bytes_ = np.frombuffer(records, np.uint8)
    windows = np.lib.stride_tricks.as_strided(
        bytes_[:size].view(np.dtype((np.void, size))), (len(records) - size + 1,), (1,)
    )
    return windows[offsets.astype(np.intp)].view(dtype)


def _touch_each_other(offsets: NDArray[Any], size: int, end: int) -> bool:
    """Whether messages of one size lie one behind the other, and before `end`."""
    first, last = int(offsets[0]), int(offsets[-1])
    if last - first != size * (len(offsets) - 1) or last + size > end:
        return False
    # The ends are right, so only what is between them is looked at.
    return bool((offsets == touching_offsets(first, last, size)).all())


@lru_cache(maxsize=2)
def touching_offsets(first: int, last: int, size: int) -> NDArray[np.uint64]:
    """The offsets of messages that touch each other; all full chunks of a topic have the same."""
    return np.arange(first, last + 1, size, dtype=np.uint64)
