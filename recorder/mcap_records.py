"""The records of an MCAP file, one by one: opcode, length, content."""

from __future__ import annotations

import io
import itertools
import mmap
import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

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
from mcaprl.recorder.chunks import INDEX_ENTRY, MESSAGE_HEADER, RECORD_HEADER_BYTES

RECORD_HEADER = struct.Struct("<BQ")
# Of a message behind its record header: channel, sequence number, log_time.
MESSAGE_START = struct.Struct("<HIQ")
_CHUNK_INDEX_START, _CHUNK_INDEX_END = struct.Struct("<QQQQI"), struct.Struct("<QQ")
_MESSAGE_INDEX_OFFSET = struct.Struct("<HQ")
_PARSERS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
    Opcode.DATA_END: DataEnd,
    Opcode.STATISTICS: Statistics,
}


def map_file(path: Path) -> memoryview:
    """The bytes of a file, mapped into memory.

    Raises:
        NotMcapError: it is empty.
        LogError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            if not file.seek(0, io.SEEK_END):
                raise NotMcapError(f"{path} is no MCAP file: it is empty")
            return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror}") from error


def records_of(
    view: memoryview, start: int, stop: int | None = None
) -> Iterator[tuple[int, int, memoryview]]:
    """Yield offset, opcode and content of each record from `start` on.

    Ends before a record that reaches beyond `stop`, or the end of the view.
    """
    offset, stop = start, len(view) if stop is None else stop
    while offset + RECORD_HEADER.size <= stop:
        opcode, length = RECORD_HEADER.unpack_from(view, offset)
        content = offset + RECORD_HEADER.size
        if opcode == 0 or length > stop - content:
            return
        yield offset, opcode, view[content : content + length]
        offset = content + length


def parse_record(opcode: int, content: memoryview) -> Any:
    """A record of the `mcap` library from its content.

    Raises:
        CorruptLogError: the content is no such record.
    """
    try:
        if opcode == Opcode.CHUNK_INDEX:
            return _chunk_index(content)
        return _PARSERS[opcode].read(ReadDataStream(io.BytesIO(content)))
    # The library raises whatever its parsing meets; none of it is more than "damaged".
    except Exception as error:
        raise CorruptLogError(f"the {Opcode(opcode).name.lower()} record is damaged") from error


class Span:
    """Messages of one channel that stand together; its length is how many.

    Attributes:
        chunk: in which they are; None for messages outside of all chunks.
    """

    def __init__(self, chunk: ChunkIndex | None, entries: memoryview | NDArray[Any]) -> None:
        """Take entries of `chunks.INDEX_ENTRY`, or their bytes as they stand in the file."""
        self.chunk = chunk
        self._entries = entries
        is_array = isinstance(entries, np.ndarray)
        self._count = len(entries) if is_array else len(entries) // INDEX_ENTRY.itemsize

    @cached_property
    def index(self) -> NDArray[Any]:
        """Their log_time and offset: `chunks.INDEX_ENTRY`, one for each."""
        if isinstance(self._entries, np.ndarray):
            return self._entries
        return np.frombuffer(self._entries, INDEX_ENTRY)

    def __len__(self) -> int:
        """Messages."""
        return self._count


@dataclass
class LooseMessages:
    """Messages that were found without an index, by channel id, in the order of the file."""

    _times: dict[int, array[int]] = field(default_factory=dict)
    _offsets: dict[int, array[int]] = field(default_factory=dict)

    def add(self, offset: int, content: memoryview) -> None:
        """Note the Message record at `offset`.

        Raises:
            CorruptLogError: it is shorter than its header.
        """
        if len(content) < MESSAGE_HEADER.itemsize - RECORD_HEADER_BYTES:
            raise CorruptLogError(f"the message at byte {offset} is shorter than its header")
        channel_id, _, log_time = MESSAGE_START.unpack_from(content)
        self._times.setdefault(channel_id, array("Q")).append(log_time)
        self._offsets.setdefault(channel_id, array("Q")).append(offset)

    def indexes(self) -> dict[int, NDArray[Any]]:
        """What a MessageIndex would tell, by channel id: arrays of `chunks.INDEX_ENTRY`."""
        found = {}
        for channel_id, times in self._times.items():
            index = np.empty(len(times), INDEX_ENTRY)
            index["log_time"], index["offset"] = times, self._offsets[channel_id]
            found[channel_id] = index
        return found


@dataclass
class ChunkContents:
    """What stands in a chunk: schemas and channels, and indexes of its messages by channel id."""

    topics: list[Schema | Channel]
    indexes: dict[int, NDArray[Any]]


def contents_of(chunk: memoryview) -> ChunkContents:
    """Go through the records of a chunk, for one whose index is missing or not enough.

    Raises:
        CorruptLogError: a record is damaged, or reaches beyond the chunk.
    """
    uniform = uniform_indexes(chunk)
    if uniform is not None:
        return ChunkContents([], uniform)
    topics, loose, end = [], LooseMessages(), 0
    for offset, opcode, content in records_of(chunk, 0):
        if opcode == Opcode.MESSAGE:
            loose.add(offset, content)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            topics.append(parse_record(opcode, content))
        end = offset + RECORD_HEADER_BYTES + len(content)
    if end != len(chunk):
        raise CorruptLogError("a record reaches beyond its chunk")
    return ChunkContents(topics, loose.indexes())


def uniform_indexes(chunk: memoryview) -> dict[int, NDArray[Any]] | None:
    """Indexes of a chunk of nothing but messages of one length; None if it is another."""
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


def chunk_index_record(chunk: ChunkIndex) -> bytes:
    """A ChunkIndex record; twenty times faster than the library's own."""
    offsets, name = chunk.message_index_offsets, chunk.compression.encode()
    start = _CHUNK_INDEX_START.pack(
        chunk.message_start_time,
        chunk.message_end_time,
        chunk.chunk_start_offset,
        chunk.chunk_length,
        len(offsets) * _MESSAGE_INDEX_OFFSET.size,
    )
    pairs = b"".join(itertools.starmap(_MESSAGE_INDEX_OFFSET.pack, offsets.items()))
    middle = struct.pack("<QI", chunk.message_index_length, len(name))
    end = _CHUNK_INDEX_END.pack(chunk.compressed_size, chunk.uncompressed_size)
    content = b"".join((start, pairs, middle, name, end))
    return RECORD_HEADER.pack(Opcode.CHUNK_INDEX, len(content)) + content


def _chunk_index(content: memoryview) -> ChunkIndex:
    """Ten times faster than the library's own; a log of short episodes has many."""
    map_end = _CHUNK_INDEX_START.size + int.from_bytes(content[32:36], "little")
    if map_end > len(content):
        raise CorruptLogError("the map of a chunk_index record reaches beyond it")
    name_bytes = int.from_bytes(content[map_end + 8 : map_end + 12], "little")
    layout = _chunk_index_layout(map_end - _CHUNK_INDEX_START.size, name_bytes)
    start_time, end_time, offset, length, _, *pairs, index_bytes, _, name, compressed, raw = (
        layout.unpack_from(content)
    )
    return ChunkIndex(
        chunk_length=length,
        chunk_start_offset=offset,
        compression=name.decode(),
        compressed_size=compressed,
        message_end_time=end_time,
        message_index_length=index_bytes,
        message_index_offsets=dict(zip(pairs[::2], pairs[1::2], strict=True)),
        message_start_time=start_time,
        uncompressed_size=raw,
    )


@lru_cache(maxsize=64)
def _chunk_index_layout(map_bytes: int, name_bytes: int) -> struct.Struct:
    """A whole ChunkIndex record with so long a map and name."""
    pairs, rest = divmod(map_bytes, _MESSAGE_INDEX_OFFSET.size)
    if rest:
        raise CorruptLogError("the map of a chunk_index record has half an entry")
    return struct.Struct(f"<QQQQI{'HQ' * pairs}QI{name_bytes}sQQ")
