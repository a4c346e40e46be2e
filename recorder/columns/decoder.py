"""Decoder of one channel: messages with equal layouts become arrays, others are read one by one."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError
from mcaprl.recorder.columns.cdr import Layout, message_type
from mcaprl.recorder.columns.chunks import Scratch
from mcaprl.recorder.columns.definitions import TIME_TYPES
from mcaprl.recorder.columns.message_rows import (
    MESSAGE_HEADER,
    FieldCopy,
    MessageRange,
    are_messages,
    as_items,
    gather,
    record_dtype,
)
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import RECORD_HEADER

# If the messages of a chunk have more different lengths than this, they are decoded one by one.
_MAX_LENGTHS = 16
# Maximum number of layouts for each message length; the remaining messages are decoded one by one.
_MAX_LAYOUTS = 8

Columns = dict[str, NDArray[Any]]
"""Arrays of equal length by field name. Strings are `str`, and arrays of strings are lists."""
Rows = slice | NDArray[np.int64]
"""Selection of rows of a column."""


@dataclass
class Target:
    """Columns that are filled.

    Attributes:
        columns: Columns by field name.
        copies: Layout of the last messages with this channel and length, and their compiled copy;
            None if they have no layout, or cannot be copied by compiled code.
    """

    columns: Columns
    copies: dict[tuple[int, int], tuple[Layout | None, FieldCopy | None]] = field(
        default_factory=dict
    )


class Decoder:
    """Decoder of the messages of one channel to columns.

    Attributes:
        channel: Channel of the messages.
        type: Type of the messages.
    """

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
        """Return empty columns of `count` rows for the wanted fields.

        The first message determines the dtypes and shapes.
        """
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
    """Return the value of the field with this dotted path.

    Timestamps are converted to nanoseconds.
    """
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
