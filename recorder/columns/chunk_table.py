"""What a file's summary tells of its chunks, in columns: a long log has very many.

One ChunkIndex record after the other would take as long as reading some ten thousand messages of a
long log, to look up a single episode in it. So they are parsed together, and what is asked of all
of them is asked of arrays; the `mcap` library's objects are made of those chunks that are used.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Self

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns.message_rows import windows
from mcaprl.recorder.columns.records import RECORD_HEADER

_START, _PAIR, _END = struct.Struct("<QQQQI"), struct.Struct("<HQ"), struct.Struct("<QQ")
# The content of a record: this, the map, this, the name of the compression, this.
_BEFORE_MAP = np.dtype(
    [
        ("start_time", "<u8"),
        ("end_time", "<u8"),
        ("offset", "<u8"),
        ("length", "<u8"),
        ("map_bytes", "<u4"),
    ]
)
_BEHIND_MAP = np.dtype([("index_bytes", "<u8"), ("name_bytes", "<u4")])
_BEHIND_NAME = np.dtype([("compressed_bytes", "<u8"), ("raw_bytes", "<u8")])
_MAP_ENTRY = np.dtype([("channel_id", "<u2"), ("offset", "<u8")])
_FIXED_BYTES = _BEFORE_MAP.itemsize + _BEHIND_MAP.itemsize + _BEHIND_NAME.itemsize
# One of all 65,536 channels is shorter.
_MOST_BYTES = 2**20
# So few are sooner made all at once than again and again some of them.
_FEW_CHUNKS = 32
_PARTS = (_BEFORE_MAP, _BEHIND_MAP, _BEHIND_NAME)
_ROW = np.dtype(
    [(name, "<u8") for part in _PARTS for name in part.names or () if part[name].itemsize == 8]
)


def chunk_index_record(chunk: ChunkIndex) -> bytes:
    """A ChunkIndex record; twenty times faster than the library's own."""
    offsets, name = chunk.message_index_offsets, chunk.compression.encode()
    start = _START.pack(
        chunk.message_start_time,
        chunk.message_end_time,
        chunk.chunk_start_offset,
        chunk.chunk_length,
        len(offsets) * _MAP_ENTRY.itemsize,
    )
    pairs = b"".join(itertools.starmap(_PAIR.pack, offsets.items()))
    middle = struct.pack("<QI", chunk.message_index_length, len(name))
    end = _END.pack(chunk.compressed_size, chunk.uncompressed_size)
    content = b"".join((start, pairs, middle, name, end))
    return RECORD_HEADER.pack(Opcode.CHUNK_INDEX, len(content)) + content


Indexes = tuple[NDArray[np.int64], NDArray[np.uint64]]
"""Of a channel: numbers of chunks, and the bytes at which their indexes of it begin."""


class ChunkTable:
    """K chunks, in the order of the file.

    Attributes:
        rows: (K,) of each its smallest and largest log_time (`start_time`, `end_time`), the byte at
            which its record begins and the length of that (`offset`, `length`), and how many bytes
            the indexes behind it take (`index_bytes`), and its records in the file
            (`compressed_bytes`) and out of it (`raw_bytes`).
        map_sizes: (K,) int64, of how many channels there are indexes of it.
    """

    def __init__(self, map_sizes: NDArray[np.int64]) -> None:
        """Make room; use `read` or `of`."""
        self.rows, self.map_sizes = np.empty(len(map_sizes), _ROW), map_sizes
        self._compression = np.empty(len(map_sizes), object)
        self._map_stops = np.cumsum(map_sizes)
        entries = int(map_sizes.sum())
        self._channel_ids = np.empty(entries, np.uint16)
        self._index_offsets = np.empty(entries, np.uint64)

    @classmethod
    def read(cls, view: memoryview, runs: NDArray[np.int64]) -> Self:
        """Read ChunkIndex records, all at once.

        Args:
            view: where they are.
            runs: (R, 3) of records of one length that follow each other: the first byte of the
                first one's content, the length of their contents, and how many they are.

        Raises:
            CorruptLogError: a record is damaged.
        """
        counts = runs[:, 2]
        firsts, lengths = np.repeat(runs[:, :2], counts, axis=0).T
        starts = firsts + _within(counts) * (lengths + RECORD_HEADER.size)
        if (lengths < _FIXED_BYTES).any() or (lengths > _MOST_BYTES).any():
            raise CorruptLogError("a chunk_index record is too short or too long")
        before_map = windows(view, starts, _BEFORE_MAP)
        map_bytes = before_map["map_bytes"].astype(np.int64)
        if (map_bytes > lengths - _FIXED_BYTES).any() or (map_bytes % _MAP_ENTRY.itemsize).any():
            raise CorruptLogError("the map of a chunk_index record does not fit it")
        maps = starts + _BEFORE_MAP.itemsize
        behind_map = windows(view, maps + map_bytes, _BEHIND_MAP)
        name_bytes = behind_map["name_bytes"].astype(np.int64)
        # A later version of MCAP may have more fields behind these.
        if (name_bytes > lengths - _FIXED_BYTES - map_bytes).any():
            raise CorruptLogError("the name of a chunk_index record does not fit it")
        names = maps + map_bytes + _BEHIND_MAP.itemsize
        table = cls(map_bytes // _MAP_ENTRY.itemsize)
        for part in (before_map, behind_map, windows(view, names + name_bytes, _BEHIND_NAME)):
            for name in set(part.dtype.names or ()) & set(_ROW.names or ()):
                table.rows[name] = part[name]
        table._compression[:] = _texts(view, names, name_bytes)
        if len(table._channel_ids):
            places = np.repeat(maps, table.map_sizes)
            places += _within(table.map_sizes) * _MAP_ENTRY.itemsize
            entries = windows(view, places, _MAP_ENTRY)
            table._channel_ids[:] = entries["channel_id"]
            table._index_offsets[:] = entries["offset"]
        offsets = table.rows["offset"]
        if (offsets[1:] < offsets[:-1]).any():
            return cls.of(sorted(table.chunks, key=lambda chunk: chunk.chunk_start_offset))
        return table

    @classmethod
    def of(cls, chunks: Sequence[ChunkIndex]) -> Self:
        """Of chunks that were found otherwise, in the order of the file."""
        maps = [chunk.message_index_offsets for chunk in chunks]
        table = cls(np.array(list(map(len, maps)), np.int64))
        table.rows[:] = [
            (
                chunk.message_start_time,
                chunk.message_end_time,
                chunk.chunk_start_offset,
                chunk.chunk_length,
                chunk.message_index_length,
                chunk.compressed_size,
                chunk.uncompressed_size,
            )
            for chunk in chunks
        ]
        table._compression[:] = [chunk.compression for chunk in chunks]
        table._channel_ids[:] = [channel_id for map_ in maps for channel_id in map_]
        table._index_offsets[:] = [offset for map_ in maps for offset in map_.values()]
        return table

    def __len__(self) -> int:
        """Chunks."""
        return len(self.rows)

    @cached_property
    def chunks(self) -> list[ChunkIndex]:
        """All of them."""
        return list(self._made(np.arange(len(self))))

    def stops(self, file_bytes: int) -> NDArray[np.uint64]:
        """(K,) uint64 where the MessageIndex records behind each chunk end.

        Raises:
            CorruptLogError: beyond a file of so many bytes.
        """
        # Each by itself, so that no sum can wrap around.
        parts = [self.rows[name] for name in ("offset", "length", "index_bytes")]
        is_beyond = np.logical_or.reduce([part > file_bytes for part in parts])
        if is_beyond.any():
            start = self.rows["offset"][int(np.argmax(is_beyond))]
            raise CorruptLogError(f"the chunk at byte {start} would end beyond the file")
        stops: NDArray[np.uint64] = np.add.reduce(parts)
        return stops

    @property
    def channel_ids(self) -> set[int]:
        """Channels that have an index of a chunk."""
        return set(self._channel_ids.tolist())

    def some(self, numbers: NDArray[np.int64]) -> Iterator[ChunkIndex]:
        """Those of these numbers."""
        if len(self) <= _FEW_CHUNKS:
            return map(self.chunks.__getitem__, numbers.tolist())
        return self._made(numbers)

    def _made(self, numbers: NDArray[np.int64]) -> Iterator[ChunkIndex]:
        rows = self.rows[numbers]
        # In the order of the class's fields: by name takes twice as long.
        return map(
            ChunkIndex,
            rows["length"].tolist(),
            rows["offset"].tolist(),
            self._compression[numbers].tolist(),
            rows["compressed_bytes"].tolist(),
            rows["end_time"].tolist(),
            rows["index_bytes"].tolist(),
            self._maps(numbers),
            rows["start_time"].tolist(),
            rows["raw_bytes"].tolist(),
        )

    def _maps(self, numbers: NDArray[np.int64]) -> Iterator[dict[int, int]]:
        stops = self._map_stops[numbers]
        starts = stops - self.map_sizes[numbers]
        first, last = int(starts.min(initial=len(self._channel_ids))), int(stops.max(initial=0))
        ids = self._channel_ids[first:last].tolist()
        offsets = self._index_offsets[first:last].tolist()
        for start, stop in zip((starts - first).tolist(), (stops - first).tolist(), strict=True):
            yield dict(zip(ids[start:stop], offsets[start:stop], strict=True))

    @cached_property
    def bare(self) -> NDArray[np.int64]:
        """The numbers of the chunks that have no index."""
        return np.flatnonzero(self.map_sizes == 0)

    def unsure(self, *, is_complete: bool) -> NDArray[np.int64]:
        """The numbers of the chunks whose indexes may not be there, or not all of them.

        Args:
            is_complete: whether the writer came to its end; one that was killed may have written
                some of the last chunk's indexes.
        """
        return self.bare if is_complete else np.union1d(self.bare, np.arange(len(self))[-1:])

    def places_of_indexes(self, numbers: slice) -> tuple[NDArray[np.uint16], NDArray[np.uint64]]:
        """Of what channel, and at what byte, the indexes of chunks are that follow each other."""
        stops = self._map_stops[numbers]
        entries = slice(int(stops[0] - self.map_sizes[numbers.start]), int(stops[-1]))
        return self._channel_ids[entries], self._index_offsets[entries]

    def indexes_of(self, channel_id: int) -> Indexes:
        """The numbers of the chunks that have an index of a channel, and where those indexes are.

        Raises:
            CorruptLogError: a chunk has several.
        """
        found = np.flatnonzero(self._channel_ids == channel_id)
        numbers = np.searchsorted(self._map_stops, found, side="right")
        if (numbers[1:] == numbers[:-1]).any():
            raise CorruptLogError(f"a chunk_index record tells of channel {channel_id} twice")
        return numbers, self._index_offsets[found]


def _within(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """0, 1, 2 ... for each count, one behind the other."""
    stops = np.cumsum(counts)
    return np.arange(int(counts.sum())) - np.repeat(stops - counts, counts)


def _texts(view: memoryview, starts: NDArray[np.int64], lengths: NDArray[np.int64]) -> list[str]:
    """The texts that stand there.

    Raises:
        CorruptLogError: one is no text.
    """
    places = zip(starts.tolist(), lengths.tolist(), strict=True)
    found = [bytes(view[start : start + length]) for start, length in places]
    try:
        known = {name: name.decode() for name in set(found)}
    except UnicodeDecodeError as error:
        raise CorruptLogError("the name of a chunk's compression is no text") from error
    return [known[name] for name in found]
