"""Messages of a topic as columns: one array for each wanted field, in the order of log_time.

Messages of equal length in a chunk are read as one array, even if other records lie between them.
All other messages are decoded one by one; their values are the same as in an array.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Collection, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError, UnknownNameError
from mcaprl.recorder.columns.cdr import Layout, message_type
from mcaprl.recorder.columns.chunks import Scratch
from mcaprl.recorder.columns.definitions import TIME_TYPES
from mcaprl.recorder.columns.reader import McapReader, end_of
from mcaprl.recorder.columns.records import (
    MESSAGE_HEADER,
    RECORD_HEADER,
    FieldCopy,
    MessageRange,
    are_messages,
    as_items,
    gather,
    record_dtype,
)

# If the messages of a chunk have more different lengths than this, they are decoded one by one.
_MAX_LENGTHS = 16
# Maximum number of layouts for each message length; the remaining messages are decoded one by one.
_MAX_LAYOUTS = 8

Columns = dict[str, NDArray[Any]]
"""Arrays of equal length by field name. Strings are `str`, and arrays of strings are lists."""
Rows = slice | NDArray[np.int64]  # Selection of rows of a column


@dataclass
class Target:
    """Columns that are filled."""

    columns: Columns  # Columns by field name
    # Layout of the last messages with this channel and length, and their compiled copy; None if
    # they have no layout, or cannot be copied by compiled code.
    copies: dict[tuple[int, int], tuple[Layout | None, FieldCopy | None]] = field(
        default_factory=dict
    )


class Decoder:
    """Decoder of the messages of one channel to columns."""

    def __init__(self, reader: McapReader, channel: Channel) -> None:
        """Parse the message type."""
        if channel.message_encoding != "cdr":
            raise LogError(
                f"{reader.path}: messages of {channel.topic} have encoding"
                f" {channel.message_encoding!r}, not 'cdr'"
            )
        self._reader, self.channel, schema = reader, channel, reader.schema_of(channel)
        try:
            self.type = message_type(schema)
        except LogError as error:
            raise LogError(f"{reader.path}: {channel.topic}: {error}") from error

    def empty_columns(
        self,
        wanted: Collection[str],
        count: int,
        messages: MessageRange,
        scratch: Scratch | None = None,
    ) -> Columns:
        """Return empty columns of `count` rows, as the first message has dtypes and shapes."""
        records = self._reader.records_of(messages, scratch)
        layout = self.type.layout(self._message(records, messages.index[0]), wanted)
        if layout is not None:
            shapes = {name: layout.dtype[name].shape for name in wanted}
        else:
            example = self._values(records, messages.index[0], wanted)
            shapes = {name: value.shape for name, value in example.items()}
        dtypes = self.type.leaf_dtypes
        return {name: np.empty((count, *shapes[name]), dtypes[name]) for name in wanted}

    def fill(self, target: Target, records: memoryview, index: NDArray[Any], rows: Rows) -> None:
        """Decode the messages that `index` lists, and store them in `rows` of the columns."""
        if self._copy(target, records, index, rows):
            return
        columns = target.columns
        if self._put_alike(columns, records, index, rows):
            return
        if isinstance(rows, slice):
            rows = np.arange(rows.start, rows.stop)
        index, rows = self._put_by_length(columns, records, index, rows)
        for entry, row in zip(index, rows.tolist(), strict=True):
            for name, value in self._values(records, entry, columns).items():
                column = columns[name]
                if value.shape != column.shape[1:]:
                    raise LogError(
                        f"{self._reader.path}: {name} of {self.channel.topic} has shape"
                        f" {value.shape} at log_time {entry['log_time']} and {column.shape[1:]}"
                        " elsewhere; all must be equal"
                    )
                # `[()]` turns a 0-d array into its element.
                column[row] = value[()]

    def _put_by_length(
        self, columns: Columns, records: memoryview, index: NDArray[Any], rows: NDArray[np.int64]
    ) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Copy messages of equal length at once; return `index` and `rows` of other messages."""
        if int(index["offset"].max()) > len(records) - MESSAGE_HEADER.itemsize:
            return index, rows
        lengths = gather(records, index, MESSAGE_HEADER)["length"]
        several = np.unique(lengths)
        for length in several if len(several) <= _MAX_LENGTHS else ():
            alike = lengths == length
            if self._put_alike(columns, records, index[alike], rows[alike]):
                index, rows, lengths = index[~alike], rows[~alike], lengths[~alike]
                continue
            # Layouts can differ at equal length, for example if two strings are swapped.
            for _ in range(_MAX_LAYOUTS):
                alike = self._like_first(records, index, lengths == length, columns)
                if not alike.any() or not self._put_alike(
                    columns, records, index[alike], rows[alike]
                ):
                    break
                index, rows, lengths = index[~alike], rows[~alike], lengths[~alike]
        return index, rows

    def _like_first(
        self,
        records: memoryview,
        index: NDArray[Any],
        among: NDArray[np.bool_],
        wanted: Collection[str],
    ) -> NDArray[np.bool_]:
        """Return a mask of the messages in `among` that have the same layout as the first one."""
        alike = np.zeros(len(index), bool)
        places = np.flatnonzero(among)
        if len(places):
            layout = self.type.layout(self._message(records, index[places[0]]), wanted)
            if layout is not None:
                rows = gather(records, index[places], record_dtype(layout.dtype))
                alike[places] = layout.matching(rows["payload"])
        return alike

    def _put_alike(
        self, columns: Columns, records: memoryview, index: NDArray[Any], rows: Rows
    ) -> bool:
        """If all messages share one layout, copy them and return True; else return False."""
        found = self.alike(records, index, columns)
        if found is None:
            return False
        if any(found[name].shape[1:] != column.shape[1:] for name, column in columns.items()):
            return False
        for name, column in columns.items():
            if found[name].dtype.kind == "S":
                column[rows] = self._texts(found[name])
            elif column.dtype.kind == "O":
                column[rows] = self._lists_of_texts(found[name])
            elif found[name].dtype.names:
                column[rows] = _nanoseconds(found[name])
            else:
                _put(column, rows, found[name])
        return True

    def _copy(self, target: Target, records: memoryview, index: NDArray[Any], rows: Rows) -> bool:
        """Check and copy the messages by one compiled call; return whether this was possible."""
        if not isinstance(rows, slice):
            return False
        length = self._length(records, index)
        layout = self.type.known_layout(length, target.columns)
        key = self.channel.id, length
        known, copy = target.copies.get(key, (None, None))
        if known is not layout:
            copy = None if layout is None else self._new_copy(layout, target.columns)
            target.copies[key] = layout, copy
        return copy is not None and copy(records, index, rows.start)

    def _new_copy(self, layout: Layout, columns: Columns) -> FieldCopy | None:
        places = layout.places_of(columns)
        if places is None:
            return None
        size = MESSAGE_HEADER.itemsize + layout.dtype.itemsize
        parts = zip(places, columns.values(), strict=True)
        return FieldCopy(self.channel.id, size, layout.constant_bytes, parts)

    def alike(
        self, records: memoryview, index: NDArray[Any], wanted: Collection[str]
    ) -> NDArray[Any] | None:
        """Return the messages as one structured array; None if their layouts differ."""
        # Try the layout of earlier messages first, because most messages have it.
        known = self.type.known_layout(self._length(records, index), wanted)
        found = None if known is None else self._laid_out(records, index, known)
        if found is not None:
            return found
        layout = self.type.layout(self._message(records, index[0]), wanted)
        if layout is None or layout is known:
            return None
        return self._laid_out(records, index, layout)

    def _length(self, records: memoryview, index: NDArray[Any]) -> int:
        """Return the length of the first message; -1 if there are no messages."""
        offset = int(index["offset"][0])
        if offset + MESSAGE_HEADER.itemsize > len(records):
            return -1
        _, length = RECORD_HEADER.unpack_from(records, offset)
        return int(length) + RECORD_HEADER.size - MESSAGE_HEADER.itemsize

    def _laid_out(
        self, records: memoryview, index: NDArray[Any], layout: Layout
    ) -> NDArray[Any] | None:
        dtype, id_ = record_dtype(layout.dtype), self.channel.id
        if FieldCopy(id_, dtype.itemsize, layout.constant_bytes)(records, index):
            found: NDArray[Any] = gather(records, index, dtype)["payload"]
            return found
        try:
            rows = gather(records, index, dtype)
        except CorruptLogError:
            # The layout may extend beyond the end of the chunk if the last messages are shorter.
            return None
        are_valid = are_messages(rows, id_) and bool((rows["log_time"] == index["log_time"]).all())
        payloads: NDArray[Any] = rows["payload"]
        return payloads if are_valid and layout.fits(payloads) else None

    def _message(self, records: memoryview, entry: Any) -> bytes:
        return self._reader.message(
            records, self.channel, int(entry["log_time"]), int(entry["offset"])
        )

    def _values(self, records: memoryview, entry: Any, wanted: Collection[str]) -> Columns:
        """Decode fields of one message."""
        data = self._message(records, entry)
        try:
            message = self.type.decode(data)
        except CorruptLogError as error:
            raise CorruptLogError(
                f"{self._reader.path}: {self.channel.topic} at log_time {entry['log_time']}:"
                f" {error}"
            ) from error
        dtypes = self.type.leaf_dtypes
        return {name: _as_array(_value_at(message, name), dtypes[name]) for name in wanted}

    def _lists_of_texts(self, values: NDArray[Any]) -> NDArray[Any]:
        """Convert structured values, which have one field for each string, to lists of strings."""
        texts = [self._texts(values[part]) for part in values.dtype.names or ()]
        lists = np.empty(len(values), object)
        lists[:] = [[text[row] for text in texts] for row in range(len(values))]
        return lists

    def _texts(self, values: NDArray[Any]) -> list[str]:
        try:
            # Often all strings are equal. In this case, only the first one is decoded.
            if (values == values[0]).all():
                return [bytes(values[0]).decode()] * len(values)
            return [text.decode() for text in values.tolist()]
        except UnicodeDecodeError as error:
            raise CorruptLogError(
                f"{self._reader.path}: {self.channel.topic} has a string that is not UTF-8"
            ) from error


def _nanoseconds(times: NDArray[Any]) -> NDArray[np.int64]:
    """Convert timestamps with the fields `sec` and `nanosec` to nanoseconds."""
    found: NDArray[np.int64] = times["sec"].astype(np.int64)
    found *= 10**9
    found += times["nanosec"]
    return found


def _value_at(message: Any, path: str) -> Any:
    """Return the value of the field with this dotted path; times become nanoseconds."""
    found = message
    for name in path.split("."):
        found = getattr(found, name)
    if getattr(found, "__msgtype__", "") in TIME_TYPES:
        return found.sec * 10**9 + found.nanosec
    return found


def _as_array(value: Any, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return a value as an array; wrap a list of strings or messages in a 0-d object array."""
    if not isinstance(value, list):
        return np.asarray(value, dtype)
    found = np.empty((), object)
    found[()] = value
    return found


def _put(column: NDArray[Any], rows: Rows, values: NDArray[Any]) -> None:
    """Set rows of a column; copy each vector as one item, not number by number."""
    if values.ndim == 2 and values.size and values.dtype == column.dtype:
        column, values = as_items(column), as_items(values)
    column[rows] = values


LOG_TIME = "log_time"
# Largest number of chunks that a thread reads one after the other.
_BLOCK_CHUNKS = 16


class _Selected(NamedTuple):
    """Selected messages of a chunk, with their decoder and their rows in the columns."""

    decoder: Decoder
    messages: MessageRange
    rows: Rows


class Topic:
    """Topic of a file: types and positions of its messages."""

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
        """Dtypes of the top-level fields; `object` but for numbers, their arrays, and times."""
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
        """Read columns: `log_time` and the wanted fields."""
        # Times and durations are int64 nanoseconds.
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
    """Divide parts into blocks, each of which one thread reads."""
    # Threads that read neighboring chunks would write to new memory in the same large page at the
    # same time, and each of them would clear this page.
    size = min(-(-len(parts) // threads), _BLOCK_CHUNKS)
    return (parts[start : start + size] for start in range(0, len(parts), size))
