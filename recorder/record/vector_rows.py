"""Buffers for the open episodes of a vector environment.

Each topic has one array with the message fields of each environment, and a row for each step of the
vector environment, so that a step writes adjacent memory. The array is a ring buffer: row r is at
position r modulo its length. When an episode ends, its rows are copied to message records.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.format.messages import EpisodeSummary
from mcaprl.recorder.format.schema import StepRows, TopicRows, part_of

# Limits of the initial capacity: number of rows, and number of bytes per environment. The capacity
# doubles when an episode needs more.
_FIRST_CAPACITY = 512
_FIRST_BYTES = 2**20

Rows = TypeVar("Rows", bound=TopicRows)


class OpenRows(Generic[Rows]):
    """Values of one topic for all open episodes.

    Attributes:
        capacity: Number of rows in the array, a power of 2.
        row_bytes: Length of a message record.
    """

    def __init__(self, chunk: Rows, environments: int, fields: Sequence[str]) -> None:
        """Allocate the array."""
        self._chunk, self._fields, self.row_bytes = chunk, fields, chunk.itemsize
        self._records, dtype = chunk.from_field(fields)
        first = max(2, min(_FIRST_CAPACITY, _FIRST_BYTES // self.row_bytes))
        self._use(np.empty((2 ** (first.bit_length() - 1), environments), dtype))

    def make_room(self, count: int, row: int) -> None:
        """Grow the array until `count` rows fit.

        The rows up to `row` are kept.
        """
        kept = np.arange(max(row - self.capacity + 1, 0), row + 1)
        capacity = self.capacity
        while capacity < count:
            capacity *= 2
        old, old_places = self._rows, kept % self.capacity
        self._use(np.empty((capacity, *old.shape[1:]), old.dtype))
        self._items[kept % capacity] = self._items_of(old)[old_places]

    def put(self, field: str, row: int, values: Any, environments: Any = ...) -> None:
        """Set a field in one row.

        Args:
            field: Name of the message field.
            row: Number of the row.
            values: (K, *shape) values; for a field without a shape, also one scalar for all.
            environments: Index of K environments, by default all.
        """
        column = self._columns[field]
        if column.ndim > 2:
            values = values.reshape(-1, column.shape[-1])
        column[row % self.capacity, environments] = values

    def write(
        self,
        environments: Sequence[int],
        firsts: Sequence[int],
        counts: Sequence[int],
        starts_ns: NDArray[np.int64],
        step_ns: int,
    ) -> None:
        """Write rows of environments, one environment after the other.

        Args:
            environments: K indexes of environments.
            firsts: K first rows.
            counts: K numbers of rows.
            starts_ns: (K,) log_time of each environment's first row.
            step_ns: Time between two rows, nanoseconds.
        """
        for which, steps in self._chunks(environments, firsts, counts):
            self._chunk.write(slice(len(steps)), starts_ns[which] + steps * step_ns)

    def _use(self, rows: NDArray[Any]) -> None:
        """Use this array, (capacity, N)."""
        self._rows, self.capacity = rows, len(rows)
        self._columns = {name: rows[name] for name in self._fields}
        self._items = self._items_of(rows)

    def _items_of(self, rows: NDArray[Any]) -> NDArray[np.void]:
        """Return a view of the bytes that the message records have as well."""
        return part_of(rows, slice(0, self._records.itemsize))

    def _chunks(
        self, environments: Sequence[int], firsts: Sequence[int], counts: Sequence[int]
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Copy rows of environments to the message records of one chunk after the other.

        Environments share a chunk if all their rows fit.

        Yields:
            For each row of a chunk, its position in `environments` and its step.
        """
        parts: list[_Part] = []
        used, most = 0, len(self._chunk)
        for position, first in enumerate(firsts):
            step, count = 0, counts[position]
            if used + count > most and used:
                yield _rows_of(parts)
                parts, used = [], 0
            while step < count:
                place = (first + step) % self.capacity
                size = min(count - step, most - used, self.capacity - place)
                source = self._items[place : place + size, environments[position]]
                self._records[used : used + size] = source
                parts.append((position, step, size))
                step, used = step + size, used + size
                if used == most:
                    yield _rows_of(parts)
                    parts, used = [], 0
        if parts:
            yield _rows_of(parts)


class OpenSteps(OpenRows[StepRows]):
    """Rows of `/rl/step` of all open episodes."""

    def end(
        self,
        environments: Sequence[int],
        firsts: Sequence[int],
        summaries: Sequence[EpisodeSummary],
        step_ns: int,
    ) -> None:
        """Write the rows of ended episodes, with their numbers and end flags."""
        numbers, lengths, starts, terminated, truncated = (
            np.array([getattr(summary, name) for summary in summaries])
            for name in ("episode", "length", "start_time_ns", "terminated", "truncated")
        )
        chunk = self._chunk
        for which, steps in self._chunks(environments, firsts, (lengths + 1).tolist()):
            left = lengths[which] - steps
            last, where = np.flatnonzero(left == 1), slice(len(steps))
            chunk.number(where, numbers[which], steps)
            chunk.put("terminated", last, terminated[which[last]])
            chunk.put("truncated", last, truncated[which[last]])
            chunk.finish(np.flatnonzero(left == 0))
            chunk.write(where, starts[which] + steps * step_ns)


_Part = tuple[int, int, int]
"""Position of an environment, step of its first row in a chunk, and number of rows."""


def _rows_of(parts: list[_Part]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the position and the step of each row of a chunk."""
    positions, first_steps, sizes = np.array(parts, np.int64).T
    shift = first_steps - (np.cumsum(sizes) - sizes)
    return np.repeat(positions, sizes), np.arange(sizes.sum()) + np.repeat(shift, sizes)
