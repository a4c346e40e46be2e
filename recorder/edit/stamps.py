"""Delay of the timestamps in messages, for logs whose log_times are delayed."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

from mcap.records import Channel
from rosbags.interfaces import Nodetype

from mcaprl.errors import CorruptLogError, LogError
from mcaprl.recorder.format.messages import EPISODE_TYPE
from mcaprl.recorder.format.reading import ROS_TO_NUMPY, McapReader, definitions_of, full_name

_NS_PER_S = 10**9
_TIME = "builtin_interfaces/msg/Time"
_HEAD_BYTES = 4
# Margin before and after the file's log_times, nanoseconds. If a time in a message is outside of
# this range, it belongs to another clock or is not set.
_MARGIN_NS = 10 * _NS_PER_S
# Byte offset of the start and end times in a message of `/rl/episode`. The CDR header and
# `total_reward` precede them.
_EPISODE_TIMES = 12
_SIZES = {name: int(code[-1]) for name, code in ROS_TO_NUMPY.items()}
_MAX_SECONDS = 2**31 - 1
Fields = Mapping[str, Any]


class Delay:
    """Callable that adds a delay to the timestamps in messages.

    It changes the timestamps in `/rl/episode` and the fields of type `builtin_interfaces/Time`. A
    field is changed only if its value is in the range of the file's log_times, extended by 10 s on
    each side.
    """

    def __init__(self, reader: McapReader, span: tuple[int, int], delay_ns: int) -> None:
        """Find the timestamps in the message types of all channels.

        Args:
            reader: Reader of the file.
            span: First and last log_time of the file, nanoseconds.
            delay_ns: Number of nanoseconds that is added.

        Raises:
            LogError: The messages of a channel are not CDR, or their type is not known.
        """
        self._reader, self._delay_ns = reader, delay_ns
        self._span = span[0] - _MARGIN_NS, span[1] + _MARGIN_NS
        self._changes: dict[int, Callable[[memoryview], None] | None] = {}
        for channel in reader.channels.values():
            if sum(map(len, reader.message_ranges(channel))):
                self._changes[channel.id] = self._change_of(channel)

    def __call__(self, channel: Channel, time_ns: int, payload: memoryview) -> None:
        """Change the timestamps of one message in place.

        Raises:
            CorruptLogError: The message does not fit its type.
        """
        change = self._changes[channel.id]
        if change is None:
            return
        try:
            change(payload)
        except (struct.error, IndexError, KeyError) as error:
            raise CorruptLogError(
                f"{self._reader.path}: the message of {channel.topic} at log_time {time_ns} does"
                " not fit its type"
            ) from error

    def _change_of(self, channel: Channel) -> Callable[[memoryview], None] | None:
        """Return the function that delays the timestamps in messages; None if they have none."""
        schema = self._reader.schemas.get(channel.schema_id)
        if (
            schema is None
            or channel.message_encoding != "cdr"
            or schema.encoding not in ("ros2msg", "ros2idl")
        ):
            raise LogError(
                f"{self._reader.path}: the times in the messages of {channel.topic} cannot"
                f" be delayed, because their encoding is {channel.message_encoding!r}, not 'cdr'"
            )
        name = full_name(schema.name)
        if name == EPISODE_TYPE:
            return self._move_episode
        text = schema.data.decode(errors="replace")
        found = definitions_of(name, text, schema.encoding)
        types = found.types
        for reason in found.unreadable.values():
            raise LogError(f"{self._reader.path}: {channel.topic}: {reason}")
        if _TIME not in types:
            return None
        return lambda payload: self._move(payload, name, types)

    def _move_episode(self, payload: memoryview) -> None:
        order = _order_of(payload)
        start, end = struct.unpack_from(f"{order}2q", payload, _EPISODE_TIMES)
        times = (start + self._delay_ns, end + self._delay_ns)
        struct.pack_into(f"{order}2q", payload, _EPISODE_TIMES, *times)

    def _move(self, payload: memoryview, name: str, types: Fields) -> None:
        walk = _Walk(payload, types)
        walk.skip((Nodetype.NAME, name))
        first, last = self._span
        for place in walk.times:
            seconds, nanoseconds = struct.unpack_from(f"{walk.order}iI", payload, place)
            stamp_ns = seconds * _NS_PER_S + nanoseconds
            if first <= stamp_ns <= last:
                new = divmod(stamp_ns + self._delay_ns, _NS_PER_S)
                if new[0] > _MAX_SECONDS:
                    raise LogError("the times would be after the year 2038: join fewer logs")
                struct.pack_into(f"{walk.order}iI", payload, place, *new)


class _Walk:
    """Cursor that moves through one CDR message and collects the offsets of its timestamps."""

    def __init__(self, data: memoryview, types: Fields) -> None:
        self.order, self.times = _order_of(data), list[int]()
        self._data, self._types, self._place = data, types, _HEAD_BYTES

    def skip(self, description: Any) -> None:
        """Move past a field."""
        kind, what = description
        if kind == Nodetype.BASE:
            self._skip_base(what[0], 1)
        elif kind == Nodetype.NAME:
            self._skip_messages(what, 1)
        else:
            (element, inner), count = what
            if kind == Nodetype.SEQUENCE:
                count = self._count()
            if element == Nodetype.BASE:
                self._skip_base(inner[0], count)
            else:
                self._skip_messages(inner, count)

    def _skip_base(self, name: str, count: int) -> None:
        if name != "string":
            self._advance(_SIZES[name], count)
            return
        for _ in range(count):
            self._advance(1, self._count())

    def _skip_messages(self, name: str, count: int) -> None:
        if name == _TIME:
            for _ in range(count):
                self._align(4)
                self.times.append(self._place)
                self._advance(4, 2)
            return
        fields = tuple(self._types[name][1])
        flat = _flat(tuple(description for _, description in fields))
        if flat is not None:
            self._advance(flat[0], flat[1] * count)
            return
        for _ in range(count):
            for _, description in fields:
                self.skip(description)

    def _count(self) -> int:
        self._align(4)
        (value,) = struct.unpack_from(f"{self.order}I", self._data, self._place)
        self._place += 4
        return int(value)

    def _align(self, size: int) -> None:
        self._place += -(self._place - _HEAD_BYTES) % size

    def _advance(self, size: int, count: int) -> None:
        # CDR has no alignment padding before the elements of an empty sequence.
        if count:
            self._align(size)
        self._place += size * count
        if self._place > len(self._data):
            raise IndexError


@lru_cache(maxsize=256)
def _flat(descriptions: tuple[Any, ...]) -> tuple[int, int] | None:
    """Return the size of one field in bytes, and the number of fields.

    Return None if not all fields are numbers of the same size.
    """
    names = {what[0] if kind == Nodetype.BASE else None for kind, what in descriptions}
    sizes = {_SIZES.get(name or "") for name in names}
    if len(sizes) != 1 or None in sizes:
        return None
    return int(sizes.pop() or 0), len(descriptions)


def _order_of(payload: memoryview) -> str:
    return "<" if payload[1] & 1 else ">"
