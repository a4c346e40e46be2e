"""A topic's messages as columns: one array for each wanted field, in the order of log_time.

Messages of one length are gathered from a chunk at once, by their offsets, whatever stands between
them; the rest are decoded one by one. Which way a message went cannot be seen in the columns.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError
from mcaprl.recorder.columns.chunks import Scratch
from mcaprl.recorder.columns.decoder import Columns, Decoder
from mcaprl.recorder.columns.joined import Chosen, join, neighbors
from mcaprl.recorder.columns.message_spans import Span, joined_index, joined_spans
from mcaprl.recorder.columns.reader import McapReader

# Shorter indexes are joined to so much: each by itself costs as much as some hundred entries.
_BYTES_AT_ONCE = 2**16
LOG_TIME = "log_time"


class Topic:
    """A topic of a log: where its messages are, and of which types.

    Attributes:
        name: of the topic.
        spans: its messages, as they stand together in the file; one channel after the other.
    """

    def __init__(self, reader: McapReader, name: str) -> None:
        """Find the messages. Only indexes are read.

        Raises:
            CorruptLogError: an index is damaged.
            LogError: messages of the topic are encoded in a way that is not known.
        """
        self.name = name
        self._reader = reader
        found = [(channel, reader.spans(channel)) for channel in reader.channels_of(name)]
        # A channel without messages may be of any type.
        found = [(channel, spans) for channel, spans in found if len(spans)]
        self._decoders = [Decoder(reader, channel) for channel, _ in found]
        # Which of these each span is for.
        sizes = np.array([len(spans) for _, spans in found], np.int64)
        self._owners = np.repeat(np.arange(len(found)), sizes)
        self.spans = joined_spans([spans for _, spans in found])
        self._stops = np.cumsum(self.spans.counts)
        # Who asks for a column of a chunk may ask for another next.
        self._scratch, self._reading = Scratch(), threading.Lock()

    def __len__(self) -> int:
        """Messages."""
        return int(self._stops[-1]) if len(self._stops) else 0

    @cached_property
    def times(self) -> NDArray[np.int64]:
        """(N,) log_time of each message in the order of its channels and of the file."""
        times, start = np.empty(len(self), np.int64), 0
        for entries in _groups(self.spans.entries()):
            index = joined_index(entries)
            times[start : start + len(index)] = index["log_time"]
            start += len(index)
        if (times < 0).any():
            raise CorruptLogError(
                f"{self._reader.path}: {self.name} has a log_time beyond the year 2262"
            )
        return times

    @property
    def parts(self) -> Iterator[tuple[Decoder, Span]]:
        """Its spans, each with what decodes its messages."""
        decoders = [self._decoders[owner] for owner in self._owners.tolist()]
        return zip(decoders, self.spans, strict=True)

    @property
    def channels(self) -> int:
        """How many channels have messages of it."""
        return len(self._decoders)

    @property
    def channel_ids(self) -> NDArray[np.uint16]:
        """(N,) of each message, likewise."""
        ids = np.array([decoder.channel.id for decoder in self._decoders], np.uint16)
        return np.repeat(ids[self._owners], self.spans.counts)

    @property
    def chunks_rise(self) -> bool:
        """Whether it is one channel in chunks, none of which begins before its forerunner ends."""
        return self.channels == 1 and self.spans.are_in_order

    @cached_property
    def fields(self) -> dict[str, np.dtype[Any]]:
        """Fields of its messages, with their dtypes; `object` for texts.

        Raises:
            LogError: its channels do not agree on them.
        """
        dtypes = [decoder.type.dtypes for decoder in self._decoders]
        if any(other != dtypes[0] for other in dtypes[1:]):
            raise LogError(
                f"{self._reader.path}: the channels of {self.name} have messages of different types"
            )
        return dtypes[0] if dtypes else {}

    def read(
        self, wanted: Collection[str], order: NDArray[np.int64] | None = None, *, threads: int = 1
    ) -> Columns:
        """Read columns: `log_time`, and those of fields.

        Args:
            wanted: names of fields.
            order: which messages, by their place in `times`; default: all. Only chunks with one
                of them are read.
            threads: that decompress and copy at a time.

        Raises:
            CorruptLogError: a chunk is damaged, or a message does not fit its type.
            LogError: a field has not the same shape in all messages.
        """
        parts = self._all() if order is None else self._chosen(order)
        first = next(parts, None)
        if first is None:
            return {LOG_TIME: np.empty(0, np.int64), **{name: np.empty(0) for name in wanted}}
        local = threading.local()
        local.scratch = self._scratch
        count = len(self) if order is None else len(order)
        times = self.times if order is None else np.empty(count, np.int64)

        def fill(together: list[Chosen]) -> None:
            if not hasattr(local, "scratch"):
                local.scratch = Scratch()
            scratch, decoder = local.scratch, together[0].decoder
            joint = join(self._reader, together, scratch) if len(together) > 1 else None
            if joint is not None:
                records, index, rows = joint
                decoder.fill(columns, records, index, rows)
                return
            for one in together:
                records = self._reader.records_of(one.span, scratch)
                one.decoder.fill(columns, records, one.span.index, one.rows)

        def visit(together: list[Chosen]) -> None:
            fill(together)
            for one in together if order is not None else ():
                times[one.rows] = one.span.index["log_time"]

        with self._reading:
            columns = first.decoder.empty_columns(wanted, count, first.span, self._scratch)
            _for_each(visit, neighbors(itertools.chain([first], parts)), threads)
        return {LOG_TIME: times, **columns}

    def _all(self) -> Iterator[Chosen]:
        stops = self._stops.tolist()
        for (decoder, span), stop in zip(self.parts, stops, strict=True):
            yield Chosen(decoder, span, slice(stop - len(span), stop))

    def _chosen(self, order: NDArray[np.int64]) -> Iterator[Chosen]:
        """The spans with messages that are wanted, and where those go."""
        is_rising = len(order) < 2 or bool((order[1:] > order[:-1]).all())
        by_place = None if is_rising else np.argsort(order, kind="stable")
        places = order if by_place is None else order[by_place]
        highs = np.searchsorted(places, self._stops)
        lows = np.concatenate([[0], highs[:-1]])
        numbers = np.flatnonzero(highs > lows)
        for number, span in zip(numbers.tolist(), self.spans.some(numbers), strict=True):
            low, high = int(lows[number]), int(highs[number])
            if high - low < len(span):
                index = span.index[places[low:high] - (self._stops[number] - len(span))]
                span = Span.of_index(span.chunk, index)
            rows = slice(low, high) if by_place is None else by_place[low:high]
            yield Chosen(self._decoders[int(self._owners[number])], span, rows)


def _groups(indexes: Iterable[memoryview]) -> Iterator[list[memoryview]]:
    """Indexes that follow each other: one with many entries, or several."""
    group: list[memoryview] = []
    size = 0
    for entries in indexes:
        group.append(entries)
        size += len(entries)
        if size >= _BYTES_AT_ONCE:
            yield group
            group, size = [], 0
    if group:
        yield group


def _for_each(
    do: Callable[[list[Chosen]], None], parts: Iterable[list[Chosen]], threads: int
) -> None:
    """Call for each part, `threads` at a time; the first error ends it."""
    if threads <= 1:
        for part in parts:
            do(part)
        return
    with ThreadPoolExecutor(threads) as pool:
        try:
            for _ in pool.map(do, parts):
                pass
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
