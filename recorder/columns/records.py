"""Records of an MCAP file (opcode, length, content), their CRCs, and memory maps of files.

zlib-ng is at least three times as fast as zlib, and ten times for data in the processor's cache.
`pip install 'mcaprl[fast]'` installs it.

`mmap.mmap` keeps a copy of the descriptor, so a process could not have more files open than it may
have descriptors, which are usually 1024. The maps here keep no descriptor open.

In an MCAP chunk each message is a record: opcode 0x05, record length, channel, sequence number,
log_time, publish_time, payload. Consecutive messages with equal payload lengths form a structured
array of `record_dtype(payload)`; the entries of a MessageIndex form an array of `INDEX_ENTRY`.
"""

from __future__ import annotations

import ctypes
import io
import mmap
import os
import struct
from abc import ABC, abstractmethod
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    Schema,
    Statistics,
)
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError, NotMcapError
from mcaprl.files import open_at_once
from mcaprl.system import memory_maps

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


def message_record(
    channel_id: int, sequence: int, time_ns: int, data: bytes, publish_ns: int | None = None
) -> bytes:
    """Return a Message record; by default, its publish_time is its log_time."""
    length = _MESSAGE.size - RECORD_HEADER_BYTES + len(data)
    publish_ns = time_ns if publish_ns is None else publish_ns
    head = _MESSAGE.pack(Opcode.MESSAGE, length, channel_id, sequence, time_ns, publish_ns)
    return head + data


class FieldCopy:
    """Compiled check of messages of one size, and copy of their fields to columns."""

    # Without the compiled module, calls return False.

    def __init__(
        self,
        channel_id: int,
        size: int,
        constants: Iterable[tuple[int, bytes]] = (),
        columns: Iterable[tuple[int, NDArray[Any]]] = (),
    ) -> None:
        """Store what is expected and copied, by offsets in the payload."""
        payload = MESSAGE_HEADER.itemsize
        self._size = size
        self._expected = [(0, _head(channel_id, size))]
        self._expected += [(payload + offset, value) for offset, value in constants]
        self._targets = [(payload + offset, column) for offset, column in columns]

    def __call__(self, records: memoryview, index: NDArray[Any], row: int = 0) -> bool:
        """Check and copy messages in one pass; if it is False, the rows are undefined."""
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
    """Messages of one channel, in one chunk or outside of chunks. `len()` returns their number."""

    def __init__(
        self, chunk: ChunkIndex | None, count: int, read: Callable[[MessageRange], NDArray[Any]]
    ) -> None:
        """Store the number of messages, and the function that reads the index of a range."""
        # Chunk with the messages; None for unchunked messages.
        self.chunk, self._count, self._read = chunk, count, read

    @classmethod
    def of_index(cls, chunk: ChunkIndex | None, index: NDArray[Any]) -> Self:
        """Create a range from index entries that are already in memory."""
        return cls(chunk, len(index), lambda _: index)

    @cached_property
    def index(self) -> NDArray[Any]:
        """Array of `INDEX_ENTRY`, one per message; read from the file at first use."""
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
    """Message ranges of one channel, in file order."""

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
        # (P,) number of the chunk of each range; -1 for unchunked messages.
        # (P,) number of messages of each range.
        self.counts, self.chunks = counts[kept], chunks[kept]
        self._range_of = range_of

    def _create(self, number: int) -> MessageRange:
        return self._range_of(int(self.chunks[number]), int(self.counts[number]))


def as_items(column: NDArray[Any]) -> NDArray[Any]:
    """Return a view of vectors (K, n) as (K,) items, which are copied faster; others unchanged."""
    if column.ndim != 2 or not column.size:
        return column
    return column.view(np.dtype((np.void, column.shape[1] * column.itemsize)))[:, 0]


def gather(records: memoryview, index: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the messages at the entries of `index` as one structured array."""
    # Adjacent messages are not copied. Others are copied as void items, at the speed of memcpy;
    # fancy indexing of structured items takes twenty times as long.
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
    """Return the offsets of adjacent messages, cached, because full chunks have equal ones."""
    return np.arange(first, last + 1, size, dtype=np.uint64)


try:
    from zlib_ng.zlib_ng import crc32
except ImportError:
    from zlib import crc32

__all__ = ["crc32"]


_FAILED = ctypes.c_void_p(-1).value


def mapped(descriptor: int, size: int) -> memoryview:
    """Map the first `size` bytes of a file; the caller may close the descriptor."""
    if _LIBC is None:
        return memoryview(mmap.mmap(descriptor, size, access=mmap.ACCESS_READ))
    return np.asarray(_Map(descriptor, size)).data


def prefetch(view: memoryview, start: int, stop: int) -> None:
    """Let the system start to load the pages of a range of bytes of a mapped file from the disk."""
    owner = _owner(view)
    if owner is not None:
        owner.advise(start, stop, mmap.MADV_WILLNEED)


def release(view: memoryview) -> None:
    """Let the system take back the memory of a mapped file; it is read again when it is needed."""
    owner = _owner(view)
    if owner is not None:
        owner.advise(0, view.nbytes, mmap.MADV_DONTNEED)


def _owner(view: memoryview) -> _Map | None:
    owner = view.obj.base if isinstance(view.obj, np.ndarray) else view.obj
    return owner if isinstance(owner, _Map) else None


class _Map:
    """Mapped bytes, as an array that NumPy does not copy; unmapped when no array uses them."""

    def __init__(self, descriptor: int, size: int) -> None:
        assert _LIBC is not None
        self._size = 0
        address = _LIBC.mmap(None, size, mmap.PROT_READ, mmap.MAP_SHARED, descriptor, 0)
        if address == _FAILED:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))
        self._address, self._size = int(address), size
        self.__array_interface__ = {
            "data": (self._address, True),
            "shape": (size,),
            "typestr": "|u1",
            "version": 3,
        }

    def advise(self, start: int, stop: int, advice: int) -> None:
        assert _LIBC is not None
        first = start - start % mmap.PAGESIZE
        _LIBC.madvise(self._address + first, stop - first, advice)

    def __del__(self) -> None:
        if self._size and _LIBC is not None:
            _LIBC.munmap(self._address, self._size)


_LIBC = memory_maps()


MAGIC = b"\x89MCAP0\r\n"  # First and last bytes of an MCAP file
RECORD_HEADER = struct.Struct("<BQ")
# The first fields of a message: channel, sequence number, log_time.
MESSAGE_START = struct.Struct("<HIQ")
# The header of a record, then the first fields of a message.
_MESSAGE_HEAD = struct.Struct("<BQHIQ")
# An attachment consists of two timestamps, the lengths and bytes of the name, the media type and
# the data, and a CRC.
_ATTACHMENT_TIMES_BYTES = 16
_TEXT_LENGTH, _DATA_LENGTH, _CRC = struct.Struct("<I"), struct.Struct("<Q"), struct.Struct("<I")
_FOOTER_BYTES = RECORD_HEADER_BYTES + 20
_PARSERS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
    Opcode.DATA_END: DataEnd,
    Opcode.STATISTICS: Statistics,
}


def map_file(path: Path) -> memoryview:
    """Map a file into memory; see `map_unchanged`."""
    return map_unchanged(path)[0]


def map_unchanged(path: Path) -> tuple[memoryview, os.stat_result]:
    """Map a regular file into memory; return its bytes and its current `stat` result."""
    try:
        descriptor = open_at_once(path)
        try:
            state = os.fstat(descriptor)
            if not state.st_size:
                raise NotMcapError(f"{path} is not an MCAP file: it is empty")
            found = mapped(descriptor, state.st_size)
        finally:
            os.close(descriptor)
    # `mmap` raises ValueError if the file was truncated after `fstat`.
    except (OSError, ValueError) as error:
        raise LogError(
            f"cannot read {path}: {getattr(error, 'strerror', None) or error}"
        ) from error
    return found, state


def records_of(
    view: memoryview, start: int, stop: int | None = None
) -> Iterator[tuple[int, int, memoryview]]:
    """Yield offset, opcode and content of records from `start` on, all that end by `stop`."""
    offset, stop = start, len(view) if stop is None else stop
    while offset + RECORD_HEADER.size <= stop:
        opcode, length = RECORD_HEADER.unpack_from(view, offset)
        content = offset + RECORD_HEADER.size
        if opcode == 0 or length > stop - content:
            return
        yield offset, opcode, view[content : content + length]
        offset = content + length


def parse_record(opcode: int, content: memoryview) -> Any:
    """Parse the content of a record with the `mcap` library."""
    try:
        return _PARSERS[opcode].read(ReadDataStream(io.BytesIO(content)))
    # The `mcap` library raises errors of many types when a record is damaged.
    except Exception as error:
        raise CorruptLogError(f"the {Opcode(opcode).name.lower()} record is damaged") from error


def is_intact_attachment(content: memoryview) -> bool:
    """Return whether an Attachment record matches its CRC, if any; later bytes are ignored."""
    end = _ATTACHMENT_TIMES_BYTES
    try:
        for length in (_TEXT_LENGTH, _TEXT_LENGTH, _DATA_LENGTH):
            end += length.size + length.unpack_from(content, end)[0]
        (crc,) = _CRC.unpack_from(content, end)
    except (struct.error, OverflowError):
        return False
    return not crc or crc32(content[:end]) == crc


@dataclass
class UnindexedMessages:
    """Times and offsets of the messages that a scan found, by channel id and in file order."""

    _times: dict[int, array[int]] = field(default_factory=dict)
    _offsets: dict[int, array[int]] = field(default_factory=dict)

    def add(self, offset: int, content: memoryview) -> None:
        """Add the Message record at `offset`."""
        if len(content) < MESSAGE_HEADER.itemsize - RECORD_HEADER_BYTES:
            raise CorruptLogError(f"the message at byte {offset} is shorter than its header")
        channel_id, _, log_time = MESSAGE_START.unpack_from(content)
        self._times.setdefault(channel_id, array("Q")).append(log_time)
        self._offsets.setdefault(channel_id, array("Q")).append(offset)

    def indexes(self) -> dict[int, NDArray[Any]]:
        """Return an index, an array of `INDEX_ENTRY`, for each channel id."""
        found = {}
        for channel_id, times in self._times.items():
            index = np.empty(len(times), INDEX_ENTRY)
            index["log_time"], index["offset"] = times, self._offsets[channel_id]
            found[channel_id] = index
        return found


@dataclass
class ChunkContents:
    """Contents of a chunk."""

    topics: list[Schema | Channel]  # Schemas and channels
    indexes: dict[int, NDArray[Any]]  # Arrays of `INDEX_ENTRY` by channel id


def contents_of(chunk: memoryview) -> ChunkContents:
    """Scan the records of a chunk."""
    indexes = _uniform_indexes(chunk) or _message_indexes(chunk)
    if indexes is not None:
        return ChunkContents([], indexes)
    topics, messages, end = [], UnindexedMessages(), 0
    for offset, opcode, content in records_of(chunk, 0):
        if opcode == Opcode.MESSAGE:
            messages.add(offset, content)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            topics.append(parse_record(opcode, content))
        end = offset + RECORD_HEADER_BYTES + len(content)
    if end != len(chunk):
        raise CorruptLogError("a record extends beyond the end of its chunk")
    return ChunkContents(topics, messages.indexes())


def only(
    records: memoryview, indexes: Mapping[int, NDArray[Any]]
) -> tuple[memoryview, dict[int, NDArray[Any]]]:
    """Copy the records that the indexes point to; return the copies and new indexes for them."""
    kept, new = bytearray(), {}
    for channel_id, index in indexes.items():
        entries = []
        for time_ns, offset in index.tolist():
            _, length = RECORD_HEADER.unpack_from(records, offset)
            entries.append((time_ns, len(kept)))
            kept += records[offset : offset + RECORD_HEADER_BYTES + length]
        new[channel_id] = np.array(entries, INDEX_ENTRY)
    return memoryview(kept), new


def _uniform_indexes(chunk: memoryview) -> dict[int, NDArray[Any]] | None:
    """Return the message indexes of a chunk; None if its records are not messages of one length."""
    if len(chunk) < MESSAGE_HEADER.itemsize or chunk[0] != Opcode.MESSAGE:
        return None
    size = RECORD_HEADER_BYTES + RECORD_HEADER.unpack_from(chunk)[1]
    if size < MESSAGE_HEADER.itemsize or len(chunk) % size:
        return None
    heads = np.ndarray(len(chunk) // size, MESSAGE_HEADER, chunk, strides=(size,))
    if (heads["opcode"] != Opcode.MESSAGE).any() or (heads["length"] != heads["length"][0]).any():
        return None
    entries = np.empty(len(heads), INDEX_ENTRY)
    entries["log_time"] = heads["log_time"]
    entries["offset"] = np.arange(len(heads), dtype=np.uint64) * np.uint64(size)
    ids = heads["channel_id"]
    if (ids == ids[0]).all():
        return {int(ids[0]): entries}
    return {int(channel_id): entries[ids == channel_id] for channel_id in np.unique(ids)}


def _message_indexes(chunk: memoryview) -> dict[int, NDArray[Any]] | None:
    """Return the message indexes of a chunk; None if it has other records or a damaged record."""
    ids, times, offsets = [], [], []
    message, least = int(Opcode.MESSAGE), MESSAGE_HEADER.itemsize - RECORD_HEADER_BYTES
    offset, last = 0, len(chunk) - MESSAGE_HEADER.itemsize
    while offset <= last:
        # Reading both headers at once is faster than reading one record at a time by `records_of`.
        opcode, length, channel_id, _, log_time = _MESSAGE_HEAD.unpack_from(chunk, offset)
        if opcode != message or length < least:
            return None
        ids.append(channel_id)
        times.append(log_time)
        offsets.append(offset)
        offset += RECORD_HEADER_BYTES + length
    if offset != len(chunk):
        return None
    entries, channel_ids = np.empty(len(ids), INDEX_ENTRY), np.array(ids, np.uint16)
    entries["log_time"], entries["offset"] = np.array(times, np.uint64), offsets
    return {channel_id: entries[channel_ids == channel_id] for channel_id in dict.fromkeys(ids)}


def start_of_summary(view: memoryview) -> int:
    """Return the offset of the summary section; 0 if the file has no summary or no footer."""
    start = len(view) - len(MAGIC) - _FOOTER_BYTES
    if start < len(MAGIC) or bytes(view[-len(MAGIC) :]) != MAGIC:
        return 0
    (found,) = struct.unpack_from("<Q", view, start + RECORD_HEADER_BYTES)
    return int(found) if found <= start else 0


def footer_of(view: memoryview) -> Footer | None:
    """Return the footer; None if the file does not end with one."""
    start = len(view) - len(MAGIC) - _FOOTER_BYTES
    if start < len(MAGIC) or bytes(view[-len(MAGIC) :]) != MAGIC:
        return None
    opcode, length = RECORD_HEADER.unpack_from(view, start)
    if opcode != Opcode.FOOTER or length != _FOOTER_BYTES - RECORD_HEADER_BYTES:
        return None
    footer: Footer = parse_record(opcode, view[start + RECORD_HEADER_BYTES :])
    if footer.summary_start == 0:
        return footer
    if not len(MAGIC) <= footer.summary_start <= start:
        raise CorruptLogError("the footer points outside the file")
    covered = view[footer.summary_start : start + _FOOTER_BYTES - 4]
    if footer.summary_crc and crc32(covered) != footer.summary_crc:
        raise CorruptLogError("the summary does not match its CRC")
    return footer
