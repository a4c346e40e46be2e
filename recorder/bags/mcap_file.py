"""Topics of MCAP files that any program wrote."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.recorder.bags.source import Definition, RawMessage, TopicSource
from mcaprl.recorder.format.reading import (
    MESSAGE_HEADER,
    ROS_TO_NUMPY,
    McapReader,
    MessageRange,
    Topic,
    definitions_of,
    full_name,
)

_BYTES = ("uint8", "byte", "octet")


class McapFile:
    """One MCAP file.

    Attributes:
        path: Path of the file.
        topics: Sources of each topic by its name, one source for each channel.
        complete: Whether the file ends with a footer; if not, it was cut off or is being written.
    """

    def __init__(self, path: Path, *, distribution: str = "") -> None:
        """Open a file."""
        self.path = path
        reader = McapReader(path)
        self.complete = reader.complete
        self.topics: dict[str, list[TopicSource]] = {}
        for channel in reader.channels.values():
            sources = self.topics.setdefault(channel.topic, [])
            sources.append(_McapTopic(reader, channel, distribution))

    @property
    def first_ns(self) -> int:
        """Lowest log_time of all messages; 0 if there are none."""
        every = [each.times_ns for sources in self.topics.values() for each in sources]
        return min((int(times_ns.min()) for times_ns in every if len(times_ns)), default=0)

    def close(self) -> None:
        """Do nothing: a file that is mapped into memory need not be closed."""


class _McapTopic:
    """Messages of one channel."""

    def __init__(self, reader: McapReader, channel: Channel, distribution: str) -> None:
        self._reader, self._channel = reader, channel
        schema = reader.schemas.get(channel.schema_id)
        name, encoding, data = ("", "", b"")
        if schema is not None:
            name, encoding, data = schema.name, schema.encoding, schema.data
        self.definition = Definition(name, channel.message_encoding, encoding, data, distribution)

    @cached_property
    def _ranges(self) -> list[MessageRange]:
        return [part for part in self._reader.message_ranges(self._channel) if len(part)]

    @cached_property
    def times_ns(self) -> NDArray[np.int64]:
        parts = [part.index["log_time"] for part in self._ranges]
        # Unsigned times above the signed ones must not become negative.
        found = np.concatenate(parts) if parts else np.empty(0, np.uint64)
        return np.minimum(found, np.uint64(np.iinfo(np.int64).max)).astype(np.int64)

    @property
    def positions(self) -> NDArray[np.int64]:
        # Unchunked messages come after all chunks, as in `_ranges`. A chunk has fewer than 2^32
        # bytes.
        chunks = self._reader.chunks
        number = {chunk.chunk_start_offset: k for k, chunk in enumerate(chunks)}
        parts = [
            (number[part.chunk.chunk_start_offset] if part.chunk else len(chunks)) * 2**32
            + part.index["offset"].astype(np.int64)
            for part in self._ranges
        ]
        return np.concatenate(parts) if parts else np.empty(0, np.int64)

    def raw(self, rows: NDArray[np.int64]) -> Iterator[RawMessage]:
        stops = np.cumsum([len(part) for part in self._ranges])
        highs = np.searchsorted(rows, stops)
        low = 0
        for part, stop, high in zip(self._ranges, stops.tolist(), highs.tolist(), strict=True):
            if high > low:
                records = self._reader.records_of(part)
                for entry in part.index[rows[low:high] - (stop - len(part))]:
                    time_ns, offset = entry.tolist()
                    data = self._reader.message(records, self._channel, time_ns, offset)
                    head = np.frombuffer(records, MESSAGE_HEADER, 1, offset)
                    yield RawMessage(int(head["publish_time"][0]), data)
            low = high

    def columns(
        self, fields: Sequence[str], rows: NDArray[np.int64] | None
    ) -> dict[str, NDArray[Any]] | None:
        if not self._is_defined:
            return None
        topic = self._columnar
        if topic is None or not all(_is_column(topic.kinds.get(field, "")) for field in fields):
            return None
        try:
            return dict(topic.read(list(fields), rows))
        # Arrays of different lengths cannot form a column; they are decoded one by one.
        except LogError:
            return None

    @cached_property
    def _is_defined(self) -> bool:
        """Whether the file defines the type: the columnar reader knows no other definitions."""
        found = self.definition
        if found.encoding != "cdr" or found.schema_encoding not in ("ros2msg", "ros2idl"):
            return False
        text = found.schema.decode(errors="replace")
        try:
            return definitions_of(full_name(found.type_name), text, found.schema_encoding).is_own
        except LogError:
            return False

    @cached_property
    def _columnar(self) -> Topic | None:
        """Columnar reader of the topic; None if it cannot be used or there are several channels."""
        try:
            found = Topic(self._reader, self._channel.topic)
        except LogError:
            return None
        return found if found.channels == 1 else None


def _is_column(kind: str) -> bool:
    """Return whether a field is read as a column.

    Columns are numbers, strings, times, and arrays of numbers or strings. Messages with other
    fields, such as bytes and lists of messages, are decoded one by one.
    """
    element, bracket, _ = kind.partition("[")
    if bracket:
        return element == "string" or (element in ROS_TO_NUMPY and element not in _BYTES)
    return element in ROS_TO_NUMPY or element in ("string", "time")
