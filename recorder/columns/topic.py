"""Messages of a topic as columns: one array for each wanted field, in the order of log_time.

Messages of equal length in a chunk are read as one array, even if other records lie between them.
All other messages are decoded one by one; their values are the same as in an array.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Collection, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError, UnknownNameError
from mcaprl.recorder.columns.chunks import Scratch
from mcaprl.recorder.columns.decoder import Columns, Decoder, Rows, Target
from mcaprl.recorder.columns.message_rows import MessageRange
from mcaprl.recorder.columns.reader import McapReader, end_of

LOG_TIME = "log_time"
# Largest number of chunks that a thread reads one after the other.
_BLOCK_CHUNKS = 16


class _Selected(NamedTuple):
    """Selected messages of a chunk, with their decoder and their rows in the columns."""

    decoder: Decoder
    messages: MessageRange
    rows: Rows


class Topic:
    """Topic of a file: types and positions of its messages.

    Attributes:
        name: Name of the topic.
    """

    def __init__(self, reader: McapReader, name: str) -> None:
        """Find the messages without reading chunks that have an index."""
        self.name = name
        self._reader = reader
        found = [(channel, reader.message_ranges(channel)) for channel in reader.channels_of(name)]
        # A channel without messages may have any type.
        self._ranges = [(Decoder(reader, channel), ranges) for channel, ranges in found if ranges]
        self._decoders = [decoder for decoder, _ in self._ranges]
        counts = [ranges.counts for _, ranges in self._ranges]
        self._stops = np.cumsum(np.concatenate(counts)) if counts else np.empty(0, np.int64)
        # The scratch memory keeps the last chunk, because the next call may read other columns of
        # it.
        self._scratch, self._reading = Scratch(), threading.Lock()

    def __len__(self) -> int:
        """Return the number of messages."""
        return int(self._stops[-1]) if len(self._stops) else 0

    @cached_property
    def parts(self) -> list[tuple[Decoder, MessageRange]]:
        """Message ranges with their decoders, channel by channel, in file order."""
        return [(decoder, part) for decoder, ranges in self._ranges for part in ranges]

    def _part(self, number: int) -> tuple[Decoder, MessageRange]:
        """Return an item of `parts` without creating the others."""
        for decoder, ranges in self._ranges:
            if number < len(ranges):
                return decoder, ranges[number]
            number -= len(ranges)
        raise IndexError(number)

    @cached_property
    def times(self) -> NDArray[np.int64]:
        """(N,) log_time of each message, in the order of `parts`."""
        times = np.empty(len(self), np.int64)
        self._fetch_indexes()
        for (_, part), stop in zip(self.parts, self._stops.tolist(), strict=True):
            times[stop - len(part) : stop] = part.index["log_time"]
        if (times < 0).any():
            raise CorruptLogError(
                f"{self._reader.path}: {self.name} has a log_time after the year 2262"
            )
        return times

    @property
    def channels(self) -> int:
        """Number of channels with messages."""
        return len(self._decoders)

    @property
    def channel_ids(self) -> NDArray[np.uint16]:
        """(N,) channel of each message, in the order of `parts`."""
        ids = np.array([decoder.channel.id for decoder in self._decoders], np.uint16)
        return np.repeat(ids, [int(ranges.counts.sum()) for _, ranges in self._ranges])

    @cached_property
    def chunks_rise(self) -> bool:
        """Whether all messages are in one channel, and in chunks that do not overlap in time."""
        if self.channels != 1:
            return False
        numbers = self._ranges[0][1].chunks
        return bool((numbers >= 0).all()) and self._reader.chunks.follow_in_time(numbers)

    @cached_property
    def fields(self) -> dict[str, np.dtype[Any]]:
        """Dtypes of the top-level fields.

        The dtype is `object` for all fields except numbers, arrays of numbers, and times.
        """
        dtypes = [decoder.type.dtypes for decoder in self._decoders]
        if any(other != dtypes[0] for other in dtypes[1:]):
            raise LogError(
                f"{self._reader.path}: the channels of {self.name} have messages of different types"
            )
        return dtypes[0] if dtypes else {}

    @cached_property
    def kinds(self) -> dict[str, str]:
        """Kinds of the leaf fields by dotted path; empty if the channels have different types."""
        found = [decoder.type.kinds for decoder in self._decoders]
        return found[0] if found and all(each == found[0] for each in found) else {}

    def read(
        self, wanted: Collection[str], order: NDArray[np.int64] | None = None, *, threads: int = 1
    ) -> Columns:
        """Read columns: `log_time` and the wanted fields.

        A time or duration is an int64 in nanoseconds. Arrays of strings and of messages are lists.
        """
        self._check(wanted)
        if self._reader.is_remote:
            self._reader.fetch_chunks(self._needed(order))
        selected = self._all() if order is None else self._select(order)
        first = next(selected, None)
        if first is None:
            return {LOG_TIME: np.empty(0, np.int64), **{name: np.empty(0) for name in wanted}}
        local = threading.local()
        local.scratch = self._scratch
        count = len(self) if order is None else len(order)
        times = self.times if order is None else np.empty(count, np.int64)

        def fill(parts: Iterable[_Selected]) -> None:
            if not hasattr(local, "scratch"):
                local.scratch = Scratch()
            for part in parts:
                records = self._reader.records_of(part.messages, local.scratch)
                part.decoder.fill(target, records, part.messages.index, part.rows)
                if order is not None:
                    times[part.rows] = part.messages.index["log_time"]

        with self._reading:
            target = Target(
                first.decoder.empty_columns(wanted, count, first.messages, self._scratch)
            )
            every = itertools.chain([first], selected)
            if threads <= 1:
                fill(every)
            else:
                with ThreadPoolExecutor(threads) as pool:
                    try:
                        for _ in pool.map(fill, _blocks(list(every), threads)):
                            pass
                    except BaseException:
                        pool.shutdown(cancel_futures=True)
                        raise
        return {LOG_TIME: times, **target.columns}

    def _check(self, wanted: Collection[str]) -> None:
        """Check that all channels have the wanted fields, with equal dtypes."""
        types = [decoder.type for decoder in self._decoders]
        for one in types:
            for name in wanted:
                if name in one.unreadable:
                    raise LogError(f"{self._reader.path}: {self.name}: {one.unreadable[name]}")
                if name not in one.kinds:
                    raise UnknownNameError(f"field of {self.name}", name, one.kinds)
                if one is not types[0] and one.leaf_dtypes[name] != types[0].leaf_dtypes[name]:
                    raise LogError(
                        f"{self._reader.path}: the channels of {self.name} have values of"
                        f" different types in {name}"
                    )

    def _needed(self, order: NDArray[np.int64] | None) -> Iterator[MessageRange]:
        """Yield the parts that contain the messages at these positions."""
        numbers = range(len(self._stops))
        if order is not None:
            numbers = np.unique(np.searchsorted(self._stops, order, side="right")).tolist()
        return (self._part(number)[1] for number in numbers)

    def _fetch_indexes(self) -> None:
        """Fetch the message indexes of a remote file in parallel."""
        if self._reader.is_remote:
            chunks = [part.chunk for _, part in self.parts if part.chunk is not None]
            stops = [end_of(chunk) for chunk in chunks]
            lengths = [chunk.message_index_length for chunk in chunks]
            self._reader.fetch([(b - n, b) for b, n in zip(stops, lengths, strict=True)])

    def _all(self) -> Iterator[_Selected]:
        for (decoder, part), stop in zip(self.parts, self._stops.tolist(), strict=True):
            yield _Selected(decoder, part, slice(stop - len(part), stop))

    def _select(self, order: NDArray[np.int64]) -> Iterator[_Selected]:
        """Yield the selected messages chunk by chunk."""
        is_rising = len(order) < 2 or bool((order[1:] > order[:-1]).all())
        by_place = None if is_rising else np.argsort(order, kind="stable")
        places = order if by_place is None else order[by_place]
        highs = np.searchsorted(places, self._stops)
        lows = np.concatenate([[0], highs[:-1]])
        for number in np.flatnonzero(highs > lows).tolist():
            decoder, part = self._part(number)
            low, high = int(lows[number]), int(highs[number])
            if high - low < len(part):
                index = part.index[places[low:high] - (self._stops[number] - len(part))]
                part = MessageRange.of_index(part.chunk, index)
            rows = slice(low, high) if by_place is None else by_place[low:high]
            yield _Selected(decoder, part, rows)


def _blocks(parts: Sequence[_Selected], threads: int) -> Iterator[Sequence[_Selected]]:
    """Divide parts into blocks, each of which one thread reads.

    Threads that read neighboring chunks would write to new memory in the same large page at the
    same time, and each of them would clear this page.
    """
    size = min(-(-len(parts) // threads), _BLOCK_CHUNKS)
    return (parts[start : start + size] for start in range(0, len(parts), size))
