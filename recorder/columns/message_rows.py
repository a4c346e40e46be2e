"""Message records and message indexes as NumPy structured arrays.

In an MCAP chunk each message is a record: opcode 0x05, record length, channel, sequence number,
log_time, publish_time, payload. Consecutive messages with equal payload lengths form a structured
array of `record_dtype(payload)`; the entries of a MessageIndex form an array of `INDEX_ENTRY`.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property, lru_cache
from typing import Any, Generic, Self, TypeVar

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError

try:
    from mcaprl.recorder.columns._native import copy_fields as copy_fields
except ImportError:
    # The package was installed without a C compiler. NumPy does the same in more time.
    copy_fields = None  # type: ignore[assignment]

Item = TypeVar("Item")
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
# Size of the opcode and the length field. The length field does not count these bytes.
RECORD_HEADER_BYTES = 9
INDEX_ENTRY = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
# Fields that precede the entries of a MessageIndex record.
_INDEX_START = struct.Struct("<BQHI")
# The first fields of a Message record, equal for all records of one channel and length.
_HEAD = struct.Struct("<BQH")
_MESSAGE = struct.Struct("<BQHIQQ")


@lru_cache(maxsize=64)
def record_dtype(payload: np.dtype[Any]) -> np.dtype[Any]:
    """Return the dtype of a message record: the fields of its header, then `payload`."""
    return np.dtype(
        [*((n, MESSAGE_HEADER[n]) for n in MESSAGE_HEADER.names or ()), ("payload", payload)]
    )


def message_rows(capacity: int, payload: np.dtype[Any], channel_id: int) -> NDArray[Any]:
    """Preallocate message records and set opcode, length and channel."""
    dtype = record_dtype(payload)
    rows = np.zeros(capacity, dtype)
    rows["opcode"] = Opcode.MESSAGE
    rows["length"] = dtype.itemsize - RECORD_HEADER_BYTES
    rows["channel_id"] = channel_id
    return rows


def message_record(channel_id: int, sequence: int, time_ns: int, data: bytes) -> bytes:
    """Return a Message record whose log_time and publish_time are `time_ns`."""
    length = _MESSAGE.size - RECORD_HEADER_BYTES + len(data)
    head = _MESSAGE.pack(Opcode.MESSAGE, length, channel_id, sequence, time_ns, time_ns)
    return head + data


class FieldCopy:
    """Compiled check of messages of one size, and copy of their fields to columns.

    Without the compiled module, calls return False.
    """

    def __init__(
        self,
        channel_id: int,
        size: int,
        constants: Iterable[tuple[int, bytes]] = (),
        columns: Iterable[tuple[int, NDArray[Any]]] = (),
    ) -> None:
        """Store what is expected and copied.

        Args:
            channel_id: Channel of the messages.
            size: Number of bytes of each record.
            constants: Offsets in the payload, with the bytes that must be there.
            columns: Offsets in the payload, with the contiguous column for the field there.
        """
        payload = MESSAGE_HEADER.itemsize
        self._size = size
        self._expected = [(0, _head(channel_id, size))]
        self._expected += [(payload + offset, value) for offset, value in constants]
        self._targets = [(payload + offset, column) for offset, column in columns]

    def __call__(self, records: memoryview, index: NDArray[Any], row: int = 0) -> bool:
        """Check and copy messages, in one pass.

        Returns:
            Whether all messages are in the chunk and have the times of the index, the channel, the
            size and the constants; if not, the contents of the rows are undefined.
        """
        if copy_fields is None:
            return False
        return copy_fields(records, index, self._size, self._expected, self._targets, row)


def _head(channel_id: int, size: int) -> bytes:
    """Return the first bytes of a channel's Message records of `size` bytes."""
    head: bytes = _HEAD.pack(Opcode.MESSAGE, size - RECORD_HEADER_BYTES, channel_id)
    return head


def are_messages(rows: NDArray[Any], channel_id: int) -> bool:
    """Return whether all rows are messages of this channel and have the length of the dtype."""
    size = rows.dtype.itemsize
    head = _head(channel_id, size)
    words, expected = rows.view(_words(size)), np.frombuffer(head, _words(_HEAD.size))[0]
    return all(bool((words[name] == expected[name]).all()) for name in ("front", "back"))


@lru_cache(maxsize=64)
def _words(size: int) -> np.dtype[Any]:
    """Return a dtype that reads the start of a record as two words, for faster comparisons."""
    formats, offsets = ["<u8", "<u8"], [0, _HEAD.size - 8]
    return np.dtype(
        {"names": ["front", "back"], "formats": formats, "offsets": offsets, "itemsize": size}
    )


def message_index_head(channel_id: int, entries_bytes: int) -> bytes:
    """Return the bytes of a MessageIndex record that precede its entries."""
    length = _INDEX_START.size - RECORD_HEADER_BYTES + entries_bytes
    head: bytes = _INDEX_START.pack(Opcode.MESSAGE_INDEX, length, channel_id, entries_bytes)
    return head


def message_index(file: memoryview, offset: int, channel_id: int) -> NDArray[Any]:
    """Return the entries of the MessageIndex record at `offset`, an array of `INDEX_ENTRY`."""
    try:
        opcode, _, channel, entries_bytes = _INDEX_START.unpack_from(file, offset)
    # Offsets of 2**63 and above overflow.
    except (struct.error, OverflowError):
        opcode = None
    if opcode == Opcode.MESSAGE_INDEX and channel == channel_id:
        start = offset + _INDEX_START.size
        entries = file[start : start + entries_bytes]
        if len(entries) == entries_bytes and entries_bytes % INDEX_ENTRY.itemsize == 0:
            return np.frombuffer(entries, INDEX_ENTRY)
    raise CorruptLogError(f"no message index of channel {channel_id} at byte {offset}")


class MessageRange:
    """Messages of one channel, in one chunk or outside of chunks. `len()` returns their number.

    Attributes:
        chunk: Chunk with the messages; None for unchunked messages.
    """

    def __init__(
        self, chunk: ChunkIndex | None, count: int, read: Callable[[MessageRange], NDArray[Any]]
    ) -> None:
        """Store the number of messages, and the function that reads the index of a range."""
        self.chunk, self._count, self._read = chunk, count, read

    @classmethod
    def of_index(cls, chunk: ChunkIndex | None, index: NDArray[Any]) -> Self:
        """Create a range from index entries that are already in memory."""
        return cls(chunk, len(index), lambda _: index)

    @cached_property
    def index(self) -> NDArray[Any]:
        """Array of `INDEX_ENTRY`, one entry for each message.

        It is read from the file at first use.
        """
        return self._read(self)

    def __len__(self) -> int:
        """Return the number of messages."""
        return self._count


class LazySequence(ABC, Generic[Item]):
    """Sequence whose items are created when they are first used."""

    def __init__(self, count: int, made: dict[int, Item]) -> None:
        """Store the number of items, and the items that exist already, by their position."""
        self._count, self._made = count, made

    @abstractmethod
    def _create(self, number: int) -> Item:
        """Create an item."""

    def __len__(self) -> int:
        """Return the number of items."""
        return self._count

    def __getitem__(self, number: int) -> Item:
        """Return an item."""
        number = range(self._count)[number]
        found = self._made.get(number)
        if found is None:
            found = self._made[number] = self._create(number)
        return found

    def __iter__(self) -> Iterator[Item]:
        """Yield the items."""
        return map(self.__getitem__, range(self._count))


class MessageRanges(LazySequence[MessageRange]):
    """Message ranges of one channel, in file order.

    Attributes:
        counts: (P,) number of messages of each range.
        chunks: (P,) number of the chunk of each range; -1 for unchunked messages.
    """

    def __init__(
        self,
        counts: NDArray[np.int64],
        chunks: NDArray[np.int64],
        range_of: Callable[[int, int], MessageRange],
        made: dict[int, MessageRange],
    ) -> None:
        """Leave out the ranges without messages."""
        kept = np.flatnonzero(counts)
        if made and len(kept) < len(counts):
            made = {new: made[old] for new, old in enumerate(kept.tolist()) if old in made}
        super().__init__(len(kept), made)
        self.counts, self.chunks = counts[kept], chunks[kept]
        self._range_of = range_of

    def _create(self, number: int) -> MessageRange:
        return self._range_of(int(self.chunks[number]), int(self.counts[number]))


def as_items(column: NDArray[Any]) -> NDArray[Any]:
    """Return a view of vectors (K, n) as (K,) items; other columns are returned unchanged.

    Copying whole vectors as items is faster than copying their numbers one by one.
    """
    if column.ndim != 2 or not column.size:
        return column
    return column.view(np.dtype((np.void, column.shape[1] * column.itemsize)))[:, 0]


def gather(records: memoryview, index: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the messages at the entries of `index` as one structured array.

    Adjacent messages are not copied. Other messages are copied by fancy indexing of void items, at
    the speed of memcpy; fancy indexing of structured items takes twenty times as long.
    """
    offsets, size = index["offset"], dtype.itemsize
    if len(offsets) == 0:
        return np.empty(0, dtype)
    if are_adjacent(offsets, size, len(records)):
        return np.frombuffer(records, dtype, len(offsets), int(offsets[0]))
    # Subtract instead of adding: a sum above 2**64 would wrap around.
    if len(records) < size or offsets.max() > len(records) - size:
        raise CorruptLogError("a message index points outside its chunk")
    return windows(records, offsets, dtype)


def windows(data: memoryview, offsets: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return copies of the `dtype` items at these byte offsets; all must be within the data."""
    size = dtype.itemsize
    first = np.frombuffer(data, np.dtype((np.void, size)), 1)
    every = np.lib.stride_tricks.as_strided(first, (len(data) - size + 1,), (1,))
    return every[offsets.astype(np.intp)].view(dtype)


def are_adjacent(offsets: NDArray[Any], size: int, end: int) -> bool:
    """Return whether messages of one size follow each other without gaps and end before `end`."""
    first, last = int(offsets[0]), int(offsets[-1])
    if last - first != size * (len(offsets) - 1) or last + size > end:
        return False
    return bool((offsets == adjacent_offsets(first, last, size)).all())


@lru_cache(maxsize=2)
def adjacent_offsets(first: int, last: int, size: int) -> NDArray[np.uint64]:
    """Return the offsets of adjacent messages.

    They are cached, because full chunks have equal offsets.
    """
    return np.arange(first, last + 1, size, dtype=np.uint64)
