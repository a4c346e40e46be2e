"""Small chunks side by side: visited as if they were one.

A visit to a chunk costs as much as some hundred messages in it. Recorders end a chunk with each
episode, so a log of short ones has many: those that follow each other are decompressed into one
piece of memory, and their messages are taken from there at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from typing import Any, NamedTuple, TypeVar

import numpy as np
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns.chunks import Scratch, joined_records
from mcaprl.recorder.columns.decoder import Decoder, Rows
from mcaprl.recorder.columns.message_rows import MESSAGE_HEADER, RECORD_HEADER_BYTES, gather
from mcaprl.recorder.columns.message_spans import Span, joined_index
from mcaprl.recorder.columns.reader import McapReader

# So large a piece stays in a processor's cache from one pass over it to the next.
_MOST_BYTES = 2**20

_T = TypeVar("_T")


class Chosen(NamedTuple):
    """Messages of a channel, what decodes them, and their rows in the columns."""

    decoder: Decoder
    span: Span
    rows: Rows

    @property
    def chunk_bytes(self) -> int:
        """Length of the chunk's records; more than can be joined if there is no such chunk."""
        chunk = self.span.chunk
        is_alone = chunk is None or not isinstance(self.rows, slice)
        return _MOST_BYTES if is_alone or chunk is None else chunk.uncompressed_size


def neighbors(chosen: Iterable[Chosen]) -> Iterator[list[Chosen]]:
    """Bring together what is of one channel, follows each other, and is small."""
    for _, of_one in groupby(chosen, key=lambda one: one.decoder):
        yield from packed(of_one, lambda one: one.chunk_bytes)


def packed(chunks: Iterable[_T], size_of: Callable[[_T], int]) -> Iterator[list[_T]]:
    """Bring together chunks that follow each other and are small; a large one stands alone.

    Args:
        chunks: what stands for each.
        size_of: tells how many bytes its records are.
    """
    together: list[_T] = []
    size = 0
    for one in chunks:
        more = size_of(one)
        if together and size + more > _MOST_BYTES:
            yield together
            together, size = [], 0
        together.append(one)
        size += more
    if together:
        yield together


def side_by_side(
    reader: McapReader, chunks: Sequence[ChunkIndex], scratch: Scratch
) -> tuple[memoryview, list[int]]:
    """The records of several chunks, one behind the other, and where those of each end.

    Raises:
        CorruptLogError: a chunk is damaged.
    """
    offsets = [chunk.chunk_start_offset for chunk in chunks]
    size = sum(chunk.uncompressed_size for chunk in chunks)
    try:
        return joined_records(reader.view, offsets, size, scratch)
    except CorruptLogError as error:
        raise CorruptLogError(f"{reader.path}: {error}") from error


def join(
    reader: McapReader, together: list[Chosen], scratch: Scratch
) -> tuple[memoryview, NDArray[Any], slice] | None:
    """Records of several chunks, with an index into all of them, and the rows that it fills.

    Returns:
        None if a message does not lie wholly in its own chunk; who reads them one by one sees why.

    Raises:
        CorruptLogError: a chunk is damaged.
    """
    spans = [one.span for one in together]
    chunks = [span.chunk for span in spans if span.chunk is not None]
    records, stops = side_by_side(reader, chunks, scratch)
    counts, index = list(map(len, spans)), joined_index(span.entries for span in spans)
    starts = np.repeat(np.array([0, *stops[:-1]], np.uint64), counts)
    room = np.repeat(np.array(stops, np.uint64), counts) - starts
    if (room < MESSAGE_HEADER.itemsize).any() or (
        index["offset"] > room - np.uint64(MESSAGE_HEADER.itemsize)
    ).any():
        return None
    room -= index["offset"] + np.uint64(RECORD_HEADER_BYTES)
    index["offset"] += starts
    try:
        lengths = gather(records, index, MESSAGE_HEADER)["length"]
    except CorruptLogError:
        return None
    if (lengths > room).any():
        return None
    first, last = together[0].rows, together[-1].rows
    assert isinstance(first, slice)
    assert isinstance(last, slice)
    return records, index, slice(first.start, last.stop)
