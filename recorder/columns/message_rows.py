"""The hot path: a chunk's messages of one length are one NumPy array.

In an MCAP chunk each message is a record: opcode 0x05, the record's length, channel, sequence
number, two times, then the payload. Where payloads have one length, a run of messages is a
structured array of `record_dtype(payload)`; the rows of a MessageIndex are one of `INDEX_ENTRY`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
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
# What a MessageIndex record has before its entries.
INDEX_HEAD = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel_id", "<u2"), ("entries_bytes", "<u4")]
)
# So few of something are sooner looked at one by one than as an array.
FEW = 8
_INDEX_START = struct.Struct("<BQHI")
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
    # The latter from 2**63 on.
    except (struct.error, OverflowError):
        opcode = None
    if opcode == Opcode.MESSAGE_INDEX and channel == channel_id:
        start = offset + _INDEX_START.size
        entries = file[start : start + entries_bytes]
        if len(entries) == entries_bytes and entries_bytes % INDEX_ENTRY.itemsize == 0:
            return entries
    raise CorruptLogError(f"no message index of channel {channel_id} at byte {offset}")


def index_bounds(
    file: memoryview, offsets: Sequence[int], channel_ids: Sequence[int]
) -> NDArray[np.int64]:
    """Where the entries of MessageIndex records at several offsets begin and end.

    Args:
        file: the bytes of the file.
        offsets: N of them.
        channel_ids: whose each must be.

    Returns:
        (N, 2).

    Raises:
        CorruptLogError: there is no such record.
    """
    if len(offsets) < FEW or max(offsets) > len(file) - INDEX_HEAD.itemsize:
        found = []
        for offset, channel_id in zip(offsets, channel_ids, strict=True):
            start = offset + INDEX_HEAD.itemsize
            found.append((start, start + len(message_index(file, offset, channel_id))))
        return np.array(found, np.int64).reshape(-1, 2)
    starts = np.array(offsets, np.int64)
    heads = windows(file, starts, INDEX_HEAD)
    starts += INDEX_HEAD.itemsize
    stops = starts + heads["entries_bytes"]
    is_wrong = (heads["opcode"] != Opcode.MESSAGE_INDEX) | (heads["channel_id"] != channel_ids)
    is_wrong |= (heads["entries_bytes"] % INDEX_ENTRY.itemsize != 0) | (stops > len(file))
    if is_wrong.any():
        wrong = int(np.argmax(is_wrong))
        # Says what is wrong.
        message_index(file, offsets[wrong], channel_ids[wrong])
    return np.stack([starts, stops], axis=1)


def parts_of(file: memoryview, bounds: NDArray[np.int64]) -> Iterator[memoryview]:
    """The bytes between bounds (N, 2)."""
    return (file[start:stop] for start, stop in bounds.tolist())


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
    return windows(records, offsets, dtype)


def windows(data: memoryview, offsets: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Copies of structures that begin at offsets, each of them wholly inside the data."""
    size = dtype.itemsize
    first = np.frombuffer(data, np.dtype((np.void, size)), 1)
    every = np.lib.stride_tricks.as_strided(first, (len(data) - size + 1,), (1,))
    return every[offsets.astype(np.intp)].view(dtype)


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
