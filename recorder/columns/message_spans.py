"""Where messages of a channel stand together, and the entries of the index that lead to each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property, partial
from operator import le
from typing import Any, Self

import numpy as np
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from mcaprl.recorder.columns.chunk_table import ChunkTable, Indexes
from mcaprl.recorder.columns.message_rows import INDEX_ENTRY, INDEX_HEAD, index_bounds, parts_of

# The indexes of smaller chunks stand so close that they are sooner read all at once.
_LARGE_CHUNK_BYTES = 2**16


class Span:
    """Messages of one channel that stand together; its length is how many.

    Attributes:
        chunk: in which they are; None for messages outside of all chunks.
    """

    def __init__(
        self, chunk: ChunkIndex | None, count: int, read: Callable[[], memoryview]
    ) -> None:
        """Note how many there are, and what reads the entries of their index."""
        self.chunk, self._count, self._read = chunk, count, read

    @classmethod
    def of_entries(cls, chunk: ChunkIndex | None, entries: memoryview) -> Self:
        """Of entries that are at hand: `message_records.INDEX_ENTRY`, as bytes."""
        return cls(chunk, len(entries) // INDEX_ENTRY.itemsize, lambda: entries)

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
        return self._read()

    @cached_property
    def index(self) -> NDArray[Any]:
        """The entries as an array."""
        return np.frombuffer(self.entries, INDEX_ENTRY)

    def __len__(self) -> int:
        """Messages."""
        return self._count


def joined_index(entries: Iterable[memoryview]) -> NDArray[Any]:
    """A copy of the entries of several spans: `message_records.INDEX_ENTRY`."""
    # As bytes: to NumPy each array of structures is a negotiation about their fields.
    return np.frombuffer(bytearray().join(entries), INDEX_ENTRY)


class Spans(Iterable[Span]):
    """Where all messages of a channel are; each span is made when it is asked for.

    Attributes:
        counts: (S,) int64 messages in each.
        are_in_order: whether all are in chunks, and none of these begins before the one in front
            of it ends.
        some: makes the spans of these numbers.
        entries: gives those of all spans, which are not made for that.
    """

    def __init__(
        self,
        counts: NDArray[np.int64],
        some: Callable[[NDArray[np.int64]], Iterator[Span]],
        entries: Callable[[], Iterator[memoryview]],
        *,
        are_in_order: bool,
    ) -> None:
        """Note how they are made."""
        self.counts, self.some, self.entries = counts, some, entries
        self.are_in_order = are_in_order

    @classmethod
    def of(cls, spans: Sequence[Span]) -> Self:
        """Of spans that are there."""
        chunks = [span.chunk for span in spans if span.chunk is not None]
        ends = [chunk.message_end_time for chunk in chunks[:-1]]
        starts = [chunk.message_start_time for chunk in chunks[1:]]
        return cls(
            np.array(list(map(len, spans)), np.int64),
            lambda numbers: (spans[number] for number in numbers.tolist()),
            lambda: (span.entries for span in spans),
            are_in_order=len(chunks) == len(spans) and all(map(le, ends, starts)),
        )

    def __iter__(self) -> Iterator[Span]:
        """All of them."""
        return self.some(np.arange(len(self)))

    def __len__(self) -> int:
        """Spans."""
        return len(self.counts)


def joined_spans(parts: Sequence[Spans]) -> Spans:
    """Those of several channels, one behind the other."""
    return parts[0] if len(parts) == 1 else Spans.of([span for spans in parts for span in spans])


def told_spans(
    table: ChunkTable, indexes: Indexes, index_at: Callable[[int, int], memoryview]
) -> Spans | None:
    """A channel's messages by the summary alone, if it has large chunks to itself; else None.

    No index is read before it must: who looks for one episode in a large file does not touch it all
    over then.

    Args:
        table: the file's chunks.
        indexes: those of the channel.
        index_at: reads the entries of the channel's index at a byte, which must be so many.
    """
    numbers, offsets = indexes
    rows, head_bytes = table.rows[numbers], np.uint64(INDEX_HEAD.itemsize)
    if not len(numbers) or rows["length"].min() < _LARGE_CHUNK_BYTES:
        return None
    if (table.map_sizes[numbers] > 1).any():
        return None
    entries_bytes = np.maximum(rows["index_bytes"], head_bytes) - head_bytes
    counts = (entries_bytes // np.uint64(INDEX_ENTRY.itemsize)).astype(np.int64)

    def some(of: NDArray[np.int64]) -> Iterator[Span]:
        places = zip(offsets[of].tolist(), counts[of].tolist(), strict=True)
        for chunk, (offset, count) in zip(table.some(numbers[of]), places, strict=True):
            yield Span(chunk, count, partial(index_at, offset, count))

    def entries() -> Iterator[memoryview]:
        return map(index_at, offsets.tolist(), counts.tolist())

    return Spans(counts, some, entries, are_in_order=_are_in_order(rows))


def indexed_spans(
    view: memoryview,
    table: ChunkTable,
    indexes: Indexes,
    unsure: NDArray[np.int64],
    channel_id: int,
) -> tuple[NDArray[np.int64], Spans]:
    """A channel's messages by the indexes that the file has of them; the numbers of the chunks.

    Args:
        view: of the file.
        table: its chunks.
        indexes: those of the channel.
        unsure: numbers of chunks whose indexes are not looked at.
        channel_id: of the channel.

    Raises:
        CorruptLogError: an index is damaged.
    """
    numbers, offsets = indexes
    if len(unsure):
        is_sure = ~np.isin(numbers, unsure)
        numbers, offsets = numbers[is_sure], offsets[is_sure]
    bounds = index_bounds(view, offsets.tolist(), [channel_id] * len(offsets))

    def some(of: NDArray[np.int64]) -> Iterator[Span]:
        return map(Span.of_entries, table.some(numbers[of]), parts_of(view, bounds[of]))

    counts = (bounds[:, 1] - bounds[:, 0]) // INDEX_ENTRY.itemsize
    is_ordered = _are_in_order(table.rows[numbers])
    return numbers, Spans(counts, some, partial(parts_of, view, bounds), are_in_order=is_ordered)


def _are_in_order(rows: NDArray[Any]) -> bool:
    """Whether no chunk begins before the one in front of it ends."""
    return bool((rows["end_time"][:-1] <= rows["start_time"][1:]).all())
