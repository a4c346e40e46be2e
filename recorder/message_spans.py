"""Where messages of a channel stand together, and the entries of the index that lead to each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import Any, Self

import numpy as np
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from mcaprl.recorder.message_records import INDEX_ENTRY, INDEX_HEAD

# The indexes of smaller chunks stand so close that they are sooner read all at once.
_LARGE_CHUNK_BYTES = 2**16


class Span:
    """Messages of one channel that stand together; its length is how many.

    Attributes:
        chunk: in which they are; None for messages outside of all chunks.
    """

    def __init__(
        self, chunk: ChunkIndex | None, count: int, read: Callable[[Span], memoryview]
    ) -> None:
        """Note how many there are, and what reads the entries of this span's index."""
        self.chunk, self._count, self._read = chunk, count, read

    @classmethod
    def of_entries(cls, chunk: ChunkIndex | None, entries: memoryview) -> Self:
        """Of entries that are at hand: `message_records.INDEX_ENTRY`, as bytes."""
        return cls(chunk, len(entries) // INDEX_ENTRY.itemsize, lambda _: entries)

    @classmethod
    def of_index(cls, chunk: ChunkIndex | None, index: NDArray[Any]) -> Self:
        """Likewise, of an array."""
        return cls.of_entries(chunk, np.ascontiguousarray(index).view(np.uint8).data)

    @cached_property
    def entries(self) -> memoryview:
        """Their log_time and offset, `message_records.INDEX_ENTRY`, as bytes; read when asked for.

        Raises:
            CorruptLogError: the index is damaged.
        """
        return self._read(self)

    @cached_property
    def index(self) -> NDArray[Any]:
        """The entries as an array."""
        return np.frombuffer(self.entries, INDEX_ENTRY)

    def __len__(self) -> int:
        """Messages."""
        return self._count


def joined_index(spans: Iterable[Span]) -> NDArray[Any]:
    """A copy of the entries of all spans: `message_records.INDEX_ENTRY`."""
    # As bytes: to NumPy each array of structures is a negotiation about their fields.
    return np.frombuffer(bytearray().join([span.entries for span in spans]), INDEX_ENTRY)


def told_spans(
    chunks: Sequence[ChunkIndex],
    channel_id: int,
    index_of: Callable[[ChunkIndex, int, int], memoryview],
) -> list[Span]:
    """A channel's messages by the summary alone, if it has large chunks to itself; else none.

    No index is read before it must: who looks for one episode in a large file does not touch it all
    over then.

    Args:
        chunks: of the file.
        channel_id: of the channel.
        index_of: reads the entries of a chunk's index of a channel, which must be so many.
    """
    mine = [chunk for chunk in chunks if channel_id in chunk.message_index_offsets]
    smallest = min((chunk.chunk_length for chunk in mine), default=0)
    if smallest < _LARGE_CHUNK_BYTES or any(len(c.message_index_offsets) > 1 for c in mine):
        return []

    def read(span: Span) -> memoryview:
        assert span.chunk is not None
        return index_of(span.chunk, channel_id, len(span))

    bytes_ = [chunk.message_index_length - INDEX_HEAD.itemsize for chunk in mine]
    counts = [max(0, count) // INDEX_ENTRY.itemsize for count in bytes_]
    return [Span(chunk, count, read) for chunk, count in zip(mine, counts, strict=True)]
