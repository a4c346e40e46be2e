"""ChunkIndex records: parsing, serialization, and the indexes of all chunks of a file."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns.message_rows import INDEX_ENTRY, RECORD_HEADER_BYTES, LazySequence

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
_ZSTD = int.from_bytes(b"zstd", "little")
_EQUAL = {
    "opcode": int(Opcode.CHUNK_INDEX),
    "length": _INDEX_OF_ONE.itemsize - RECORD_HEADER_BYTES,
    "map_bytes": _INDEX_MAP_ENTRY.size,
    "name_bytes": 4,
    "name": _ZSTD,
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
    """Parse the content of a ChunkIndex record.

    Raises:
        CorruptLogError: The record is damaged.
    """
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
    """Return the leading ChunkIndex records of chunks with one channel and zstd compression.

    Args:
        summary: Records of the summary. The result ends before the first record of another kind.

    Returns:
        Copy of the records, an array of `_INDEX_OF_ONE`. Parsing many records takes a hundredth of
        the time of `parse_chunk_index`.
    """
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
    """Indexes of chunks, in file order.

    A log of 100 million transitions has 24,000 chunks, and reading an episode needs two of them.
    """

    def __init__(self, rows: NDArray[Any], others: Sequence[ChunkIndex] = ()) -> None:
        """Sort indexes by the offset of their chunk.

        Args:
            rows: Result of `indexes_of_one`.
            others: Other indexes.
        """
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
