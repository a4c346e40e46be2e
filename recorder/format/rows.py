"""Preallocated message records of one topic, addressed by field."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from mcaprl.recorder.columns.cdr import ENCAPSULATION, ENCAPSULATION_BYTES
from mcaprl.recorder.columns.message_rows import message_rows
from mcaprl.recorder.format.behavior import FIELDS
from mcaprl.recorder.format.schema import fill_image_constants, image_dtype, message_dtype
from mcaprl.recorder.format.topics import BYTES_PER_CHUNK, IMAGE_FRAME, MIN_ROWS

Write = Callable[[NDArray[Any]], None]
"""Function that writes message records of one channel as one chunk."""
# Values that all final records share. They set all fields except the observation, `episode` and
# `step`.
_FINAL = {
    "action": 0,
    "reward": 0.0,
    **{field.name: math.nan for field in FIELDS},
    "terminated": False,
    "truncated": False,
    "final": True,
}


class TopicRows:
    """Message records of one topic.

    Attributes:
        fields: Views of the fields of all rows, by field name.
    """

    def __init__(self, rows: NDArray[Any], write: Write) -> None:
        """Create views of `rows`. The caller has set the constant fields."""
        payload = rows["payload"]
        self.fields = {name: payload[name] for name in payload.dtype.names or ()}
        self._rows, self._write, self._log_time = rows, write, rows["log_time"]

    @classmethod
    def of_text(cls, text: str, channel_id: int, most: int, write: Write) -> Self:
        """Preallocate records for messages of the type that `text` defines; their size is fixed."""
        dtype = message_dtype(text)
        assert dtype is not None, "the message has a fixed length by construction"
        rows = message_rows(_count(most, dtype), dtype, channel_id)
        rows["payload"]["encapsulation"] = ENCAPSULATION
        return cls(rows, write)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self._rows)

    @property
    def channel_id(self) -> int:
        """Channel of the topic."""
        return int(self._rows["channel_id"].flat[0])

    @property
    def itemsize(self) -> int:
        """Number of bytes of one row."""
        return self._rows.itemsize

    def put(self, field: str, where: Any, values: Any) -> None:
        """Set values of a field.

        Args:
            field: Name in the message.
            where: Index of K rows.
            values: (K, *shape) values, or one scalar for all K rows.
        """
        column = self.fields[field]
        if column.ndim > 1:
            values = np.reshape(values, (-1, column.shape[-1]))
        column[where] = values

    def from_field(self, fields: Sequence[str]) -> tuple[NDArray[np.void], np.dtype[Any]]:
        """Describe the part of the rows from the first of these fields to the end of the message.

        Returns:
            A view of that part of each row as one item, (N,), and a dtype for buffers of these
            fields. An item of the dtype begins with the bytes of the part. Its fields are aligned.
        """
        payload = self._rows.dtype["payload"]
        assert payload.fields is not None, "messages have fields"
        offsets = {name: payload.fields[name][1] for name in fields}
        # CDR aligns each field relative to the end of the encapsulation header.
        first, largest = min(offsets.values()), 8
        first -= (first - ENCAPSULATION_BYTES) % largest
        size = payload.itemsize - first
        dtype = np.dtype(
            {
                "names": list(offsets),
                "formats": [payload[name] for name in offsets],
                "offsets": [offset - first for offset in offsets.values()],
                "itemsize": -(-size // largest) * largest,
            }
        )
        return part_of(self._rows, slice(self.itemsize - size, self.itemsize)), dtype

    def write(self, where: Any, times_ns: Any) -> None:
        """Set the log_time of consecutive rows, and write these rows as one chunk."""
        self._log_time[where] = times_ns
        self._write(self._rows[where])

    def write_columns(self, times_ns: NDArray[Any], columns: Mapping[str, Any]) -> None:
        """Write a message for each log_time, in chunks of at most `len(self)` messages.

        Args:
            times_ns: (K,) log_times.
            columns: (K, ...) values of each field that is not constant.
        """
        for first in range(0, len(times_ns), len(self)):
            chunk = slice(first, min(first + len(self), len(times_ns)))
            where = slice(chunk.stop - first)
            for name, column in columns.items():
                self.put(name, where, column[chunk])
            self.write(where, times_ns[chunk])


class StepRows(TopicRows):
    """Rows of `/rl/step`: the T transitions of an episode, then its final record.

    First, `number` sets the counters of consecutive rows and clears their end flags. Then `put`
    sets the other fields, `finish` turns the last rows into final records, and `write` adds the
    times.
    """

    def number(self, where: Any, episode: Any, steps: Any) -> None:
        """Set `episode` and `step` of consecutive rows, and clear their end flags.

        Args:
            where: Index of K rows.
            episode: Index of the episode in the log, or one index for each row, (K,).
            steps: (K,) index of each step in its episode.
        """
        fields = self.fields
        fields["episode"][where], fields["step"][where] = episode, steps
        for name in ("terminated", "truncated", "final"):
            fields[name][where] = False

    def finish(self, where: Any) -> None:
        """Turn rows into final records; their observation, episode and step stay unchanged."""
        for name, value in _FINAL.items():
            if name in self.fields:
                self.fields[name][where] = value


class ImageRows(TopicRows):
    """Rows of `sensor_msgs/msg/Image`, whose field `data` is the flat image as bytes."""

    @classmethod
    def of_shape(
        cls, shape: tuple[int, ...], encoding: str, channel_id: int, most: int, write: Write
    ) -> Self:
        """Preallocate rows for images of one shape; see `TopicRows.of_text` and `image_rows`."""
        height, width, channels = (*shape, 1)[:3]
        item_bytes = {"16UC1": 2, "32FC1": 4}.get(encoding, 1)
        dtype = image_dtype(height, width, channels, encoding, IMAGE_FRAME, item_bytes)
        rows = message_rows(_count(most, dtype), dtype, channel_id)
        fill_image_constants(rows["payload"], height, width, encoding, IMAGE_FRAME)
        return cls(rows, write)

    def write(self, where: Any, times_ns: Any) -> None:
        """Set log_time and header stamp of consecutive rows, and write these rows as one chunk."""
        seconds, self.fields["nanosec"][where] = np.divmod(times_ns, 10**9)
        self.fields["sec"][where] = seconds
        super().write(where, times_ns)


def part_of(rows: NDArray[Any], part: slice) -> NDArray[np.void]:
    """Return a view of these bytes of each structured item, as items.

    Copying items is twice as fast as copying rows of bytes.
    """
    item, itemsize = np.dtype((np.void, part.stop - part.start)), rows.itemsize
    layout = np.dtype(
        {"names": ["part"], "formats": [item], "offsets": [part.start], "itemsize": itemsize}
    )
    return rows.view(layout)["part"]


def make_final(message: NDArray[Any]) -> None:
    """Turn encoded transitions into final records, in place."""
    for name, value in _FINAL.items():
        if name in (message.dtype.names or ()):
            message[name] = value


class Part(NamedTuple):
    """Part of an episode that becomes an episode.

    Attributes:
        start_ns: log_time of the first record.
        end_ns: log_time of the last record.
        first_step: Step of the first record, which becomes step 0.
        length: Number of transitions.
        is_cut: Whether the episode went on after the part, or its end is missing.
    """

    start_ns: int
    end_ns: int
    first_step: int
    length: int
    is_cut: bool


class Shorten:
    """Callable that changes records of `/rl/step` of parts of episodes into those of episodes.

    Attributes:
        spans: (P, 2) first and last log_time of each part, increasing.
    """

    def __init__(self, parts: Sequence[Part], dtypes: Mapping[int, np.dtype[Any]]) -> None:
        """Store the parts, which do not overlap, and the dtype of the messages by channel id."""
        self._parts = sorted(parts, key=lambda part: part.end_ns)
        self._dtypes = dtypes
        found = [(part.start_ns, part.end_ns) for part in self._parts]
        self.spans = np.array(found, np.int64).reshape(-1, 2)

    def __call__(self, channel: Channel, time_ns: int, payload: memoryview) -> None:
        """Change one message in place: number its step, and end a part that is cut."""
        part = self._parts[int(np.searchsorted(self.spans[:, 1], time_ns))]
        row = np.frombuffer(payload, self._dtypes[channel.id], 1)
        row["step"] -= part.first_step
        if part.is_cut and row["step"] == part.length - 1:
            row["truncated"] = True
        elif part.is_cut and row["step"] == part.length:
            make_final(row)


def _count(most: int, payload: np.dtype[Any]) -> int:
    return min(most, max(MIN_ROWS, BYTES_PER_CHUNK // payload.itemsize))
