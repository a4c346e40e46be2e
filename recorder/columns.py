"""A topic's messages as columns: one array for each wanted field, in the order of log_time.

Messages of one length are gathered from a chunk at once, by their offsets, whatever stands between
them; the rest are decoded one by one. Which way a message went cannot be seen in the columns.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError
from mcaprl.recorder.cdr import Layout, MessageType, message_type
from mcaprl.recorder.chunks import Scratch
from mcaprl.recorder.joined import Chosen, Rows, join, neighbors
from mcaprl.recorder.mcap_reader import McapReader
from mcaprl.recorder.mcap_records import RECORD_HEADER
from mcaprl.recorder.message_records import MESSAGE_HEADER, are_messages, gather, record_dtype
from mcaprl.recorder.message_spans import Span, joined_index

# Messages of a chunk that are of more lengths than this are decoded one by one.
_MAX_LENGTHS = 16
# Indexes of fewer entries are joined to so many: each by itself costs as much as some hundred.
_ENTRIES_AT_ONCE = 2**12

Columns = dict[str, NDArray[Any]]
"""Arrays of one length, by field name; texts are arrays of `str` objects."""
LOG_TIME = "log_time"


class Topic:
    """A topic of a log: where its messages are, and of which types.

    Attributes:
        name: of the topic.
        parts: its messages, as they stand together in the file.
    """

    def __init__(self, reader: McapReader, name: str) -> None:
        """Find the messages. Only indexes are read.

        Raises:
            CorruptLogError: an index is damaged.
            LogError: messages of the topic are encoded in a way that is not known.
        """
        self.name = name
        self._reader = reader
        self.parts: list[Part] = []
        for channel in reader.channels_of(name):
            spans = reader.spans(channel)
            # A channel without messages may be of any type.
            if spans:
                type_ = _type_of(reader, channel)
                self.parts += [Part(reader, channel, type_, span) for span in spans]
        self._counts = [len(part.span) for part in self.parts]
        self._stops = np.cumsum(self._counts, dtype=np.int64)

    def __len__(self) -> int:
        """Messages."""
        return sum(self._counts)

    @cached_property
    def times(self) -> NDArray[np.int64]:
        """(N,) log_time of each message in the order of its channels and of the file."""
        times, start = np.empty(len(self), np.int64), 0
        for spans in _groups([part.span for part in self.parts]):
            index = spans[0].index if len(spans) == 1 else joined_index(spans)
            times[start : start + len(index)] = index["log_time"]
            start += len(index)
        if (times < 0).any():
            raise CorruptLogError(
                f"{self._reader.path}: {self.name} has a log_time beyond the year 2262"
            )
        return times

    @property
    def channels(self) -> int:
        """How many channels have messages of it."""
        return len({part.channel.id for part in self.parts})

    @property
    def channel_ids(self) -> NDArray[np.uint16]:
        """(N,) of each message, likewise."""
        ids = np.array([part.channel.id for part in self.parts], np.uint16)
        return np.repeat(ids, self._counts)

    @cached_property
    def chunks_rise(self) -> bool:
        """Whether it is one channel, and no chunk begins before the one before it has ended."""
        chunks = [part.span.chunk for part in self.parts]
        return self.channels == 1 and all(
            a is not None and b is not None and a.message_end_time <= b.message_start_time
            for a, b in pairwise(chunks)
        )

    @cached_property
    def fields(self) -> dict[str, np.dtype[Any]]:
        """Fields of its messages, with their dtypes; `object` for texts.

        Raises:
            LogError: its channels do not agree on them.
        """
        types = list({id(part.type): part.type for part in self.parts}.values())
        if any(other.dtypes != types[0].dtypes for other in types[1:]):
            raise LogError(
                f"{self._reader.path}: the channels of {self.name} have messages of different types"
            )
        return types[0].dtypes if types else {}

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
        parts = list(self._all() if order is None else self._chosen(order))
        if not parts:
            return {LOG_TIME: np.empty(0, np.int64), **{name: np.empty(0) for name in wanted}}
        local = threading.local()
        local.scratch = Scratch()
        count = len(self) if order is None else len(order)
        columns = parts[0].part.empty_columns(wanted, count, local.scratch)

        def fill(together: list[Chosen]) -> None:
            if not hasattr(local, "scratch"):
                local.scratch = Scratch()
            scratch, part = local.scratch, together[0].part
            joint = join(self._reader, together, scratch) if len(together) > 1 else None
            if joint is not None:
                records, index, rows = joint
                part.fill(columns, records, index, rows)
                return
            for one in together:
                records = self._reader.records_of(one.span, scratch)
                one.part.fill(columns, records, one.span.index, one.rows)

        _for_each(fill, list(neighbors(parts)), threads)
        return {LOG_TIME: self.times if order is None else _times_of(parts, len(order)), **columns}

    def _all(self) -> Iterator[Chosen]:
        for part, stop, count in zip(self.parts, self._stops.tolist(), self._counts, strict=True):
            yield Chosen(part, part.span, slice(stop - count, stop))

    def _chosen(self, order: NDArray[np.int64]) -> Iterator[Chosen]:
        """The parts with messages that are wanted, and where those go."""
        is_rising = len(order) < 2 or bool((order[1:] > order[:-1]).all())
        by_place = None if is_rising else np.argsort(order, kind="stable")
        places = order if by_place is None else order[by_place]
        bounds = np.searchsorted(places, [0, *self._stops.tolist()]).tolist()
        for part, stop, (low, high) in zip(self.parts, self._stops, pairwise(bounds), strict=True):
            if low == high:
                continue
            span = part.span
            if high - low < len(span):
                index = span.index[places[low:high] - (stop - len(span))]
                span = Span.of_index(span.chunk, index)
            yield Chosen(part, span, slice(low, high) if by_place is None else by_place[low:high])


class Part:
    """Messages of one channel that stand together.

    Attributes:
        span: where.
        channel: which.
        type: of the messages.
    """

    def __init__(
        self, reader: McapReader, channel: Channel, type_: MessageType, span: Span
    ) -> None:
        """Point at them; none is read."""
        self.span, self.channel, self.type = span, channel, type_
        self._reader = reader

    def empty_columns(
        self, wanted: Collection[str], count: int, scratch: Scratch | None = None
    ) -> Columns:
        """Columns with the dtypes and shapes of the first message."""
        records = self._reader.records_of(self.span, scratch)
        example = self._values(records, self.span.index[0], wanted)
        return {
            name: np.empty((count, *value.shape), value.dtype) for name, value in example.items()
        }

    def fill(self, columns: Columns, records: memoryview, index: NDArray[Any], rows: Rows) -> None:
        """Put copies of the messages that an index points at into rows of the columns."""
        if self._put_alike(columns, records, index, rows):
            return
        if isinstance(rows, slice):
            rows = np.arange(rows.start, rows.stop)
        index, rows = self._put_by_length(columns, records, index, rows)
        for entry, row in zip(index, rows.tolist(), strict=True):
            for name, value in self._values(records, entry, columns).items():
                self._check_shape(name, value, columns[name], entry)
                # A text out of its array: a column of objects would keep that.
                columns[name][row] = value[()]

    def _put_by_length(
        self, columns: Columns, records: memoryview, index: NDArray[Any], rows: NDArray[np.int64]
    ) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Put the messages of one length after the other; gives back those that are of no form."""
        if int(index["offset"].max()) > len(records) - MESSAGE_HEADER.itemsize:
            return index, rows
        lengths = gather(records, index, MESSAGE_HEADER)["length"]
        several = np.unique(lengths)
        for length in several if len(several) <= _MAX_LENGTHS else ():
            alike = lengths == length
            if self._put_alike(columns, records, index[alike], rows[alike]):
                index, rows, lengths = index[~alike], rows[~alike], lengths[~alike]
        return index, rows

    def _put_alike(
        self, columns: Columns, records: memoryview, index: NDArray[Any], rows: Rows
    ) -> bool:
        """Put messages that have the form of the first; does nothing if one has not."""
        found = self.alike(records, index, columns)
        if found is None:
            return False
        if any(found[name].shape[1:] != column.shape[1:] for name, column in columns.items()):
            return False
        for name, column in columns.items():
            if column.dtype.kind == "O":
                column[rows] = self._texts(found[name])
            else:
                _put(column, rows, found[name])
        return True

    def alike(
        self, records: memoryview, index: NDArray[Any], wanted: Collection[str]
    ) -> NDArray[Any] | None:
        """The messages as one structured array; None if they have not one form."""
        # Mostly they have the form of those before them.
        known = self.type.known_layout(self._length(records, index), wanted)
        found = None if known is None else self._laid_out(records, index, known)
        if found is not None:
            return found
        layout = self.type.layout(self._message(records, index[0]), wanted)
        if layout is None or layout is known:
            return None
        return self._laid_out(records, index, layout)

    def _length(self, records: memoryview, index: NDArray[Any]) -> int:
        """Bytes of the first message, as its record tells; -1 if there is none."""
        offset = int(index["offset"][0])
        if offset + MESSAGE_HEADER.itemsize > len(records):
            return -1
        _, length = RECORD_HEADER.unpack_from(records, offset)
        return int(length) + RECORD_HEADER.size - MESSAGE_HEADER.itemsize

    def _laid_out(
        self, records: memoryview, index: NDArray[Any], layout: Layout
    ) -> NDArray[Any] | None:
        dtype = record_dtype(layout.dtype)
        try:
            rows = gather(records, index, dtype)
        except CorruptLogError:
            # The last ones may be shorter than this form.
            return None
        are_told = are_messages(rows, self.channel.id) and bool(
            (rows["log_time"] == index["log_time"]).all()
        )
        payloads: NDArray[Any] = rows["payload"]
        return payloads if are_told and layout.fits(payloads) else None

    def _message(self, records: memoryview, entry: Any) -> bytes:
        return self._reader.message(
            records, self.channel, int(entry["log_time"]), int(entry["offset"])
        )

    def _values(self, records: memoryview, entry: Any, wanted: Collection[str]) -> Columns:
        """Fields of one message, decoded by itself."""
        data = self._message(records, entry)
        try:
            message = self.type.decode(data)
        except CorruptLogError as error:
            raise CorruptLogError(
                f"{self._reader.path}: {self.channel.topic} at log_time {entry['log_time']}:"
                f" {error}"
            ) from error
        return {name: np.asarray(getattr(message, name), self.type.dtypes[name]) for name in wanted}

    def _texts(self, values: NDArray[Any]) -> list[str]:
        try:
            # Often all are the same.
            if (values == values[0]).all():
                return [bytes(values[0]).decode()] * len(values)
            return [text.decode() for text in values.tolist()]
        except UnicodeDecodeError as error:
            raise CorruptLogError(
                f"{self._reader.path}: {self.channel.topic} has a text that is no UTF-8"
            ) from error

    def _check_shape(
        self, name: str, value: NDArray[Any], column: NDArray[Any], entry: Any
    ) -> None:
        if value.shape != column.shape[1:]:
            raise LogError(
                f"{self._reader.path}: {name} of {self.channel.topic} has shape {value.shape} at"
                f" log_time {entry['log_time']} and {column.shape[1:]} elsewhere; all must have one"
            )


def _groups(spans: list[Span]) -> Iterator[list[Span]]:
    """Spans that follow each other: one with many entries, or several."""
    group: list[Span] = []
    entries = 0
    for span in spans:
        group.append(span)
        entries += len(span)
        if entries >= _ENTRIES_AT_ONCE:
            yield group
            group, entries = [], 0
    if group:
        yield group


def _times_of(parts: list[Chosen], count: int) -> NDArray[np.int64]:
    times = np.empty(count, np.int64)
    for chosen in parts:
        times[chosen.rows] = chosen.span.index["log_time"]
    return times


def _put(column: NDArray[Any], rows: Rows, values: NDArray[Any]) -> None:
    """Set rows of a column. Vectors are moved as a whole, not number by number."""
    if values.ndim == 2 and values.size and values.dtype == column.dtype:
        row = np.dtype((np.void, values.shape[1] * values.itemsize))
        column, values = column.view(row)[:, 0], values.view(row)[:, 0]
    column[rows] = values


def _type_of(reader: McapReader, channel: Channel) -> MessageType:
    if channel.message_encoding != "cdr":
        raise LogError(
            f"{reader.path}: messages of {channel.topic} are {channel.message_encoding!r};"
            " known is 'cdr'"
        )
    schema = reader.schema_of(channel)
    try:
        return message_type(schema)
    except LogError as error:
        raise LogError(f"{reader.path}: {channel.topic}: {error}") from error


def _for_each(do: Callable[[list[Chosen]], None], parts: list[list[Chosen]], threads: int) -> None:
    """Call for each part, `threads` at a time; the first error ends it."""
    if threads <= 1 or len(parts) == 1:
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
