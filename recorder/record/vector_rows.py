"""Buffers for the open episodes of a vector environment.

Each field has one array with a row for each step of the vector environment, so that a step writes
one contiguous row. The array is a ring buffer: row r is at position r modulo its length. When an
episode ends, its values in the rows since its first observation are copied to message records.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.format.episode_summary import EpisodeSummary, add_up_rows
from mcaprl.recorder.format.rows import StepRows, TopicRows

# Limits of the initial capacity: number of rows, and number of bytes per environment. The capacity
# doubles when an episode needs more.
_FIRST_CAPACITY = 256
_FIRST_BYTES = 2**20

Rows = TypeVar("Rows", bound=TopicRows)


class OpenRows(Generic[Rows]):
    """Values of one topic for all open episodes.

    Attributes:
        capacity: Number of rows in the arrays, a power of 2.
    """

    def __init__(self, chunk: Rows, environments: int, fields: Sequence[str]) -> None:
        """Allocate the arrays.

        Args:
            chunk: Message records of one chunk; their constant fields are set.
            environments: Number of environments.
            fields: Names of the fields that `put` sets.
        """
        self._chunk, self._environments = chunk, environments
        first = max(2, min(_FIRST_CAPACITY, _FIRST_BYTES // chunk.itemsize))
        self.capacity = 2 ** (first.bit_length() - 1)
        self._columns: dict[str, NDArray[Any]] = {}
        for name in fields:
            column = chunk.fields[name]
            shape = (self.capacity, environments, *column.shape[1:])
            self._columns[name] = np.empty(shape, column.dtype)

    @property
    def per_chunk(self) -> int:
        """Maximum number of rows of a chunk."""
        return len(self._chunk)

    def make_room(self, count: int, row: int) -> None:
        """Grow the arrays until `count` rows fit.

        The rows up to `row` are kept.
        """
        kept = np.arange(max(row - self.capacity + 1, 0), row + 1)
        old = kept % self.capacity
        while self.capacity < count:
            self.capacity *= 2
        for name, column in self._columns.items():
            grown = np.empty((self.capacity, *column.shape[1:]), column.dtype)
            grown[kept % self.capacity] = column[old]
            self._columns[name] = grown

    def put(self, field: str, row: int, values: Any, environments: Any = ...) -> None:
        """Set a field in one row.

        Args:
            field: Name of the message field.
            row: Number of the row.
            values: (K, *shape) values, or one scalar for all.
            environments: Index of K environments, by default all.
        """
        column = self._columns[field]
        if column.ndim > 2:
            values = np.reshape(values, (-1, column.shape[-1]))
        column[row % self.capacity, environments] = values

    def write(
        self,
        environments: Sequence[int],
        firsts: NDArray[np.int64],
        counts: NDArray[np.int64],
        starts_ns: Any,
        step_ns: int,
    ) -> None:
        """Write rows of environments, one environment after the other.

        Args:
            environments: K indexes of environments.
            firsts: (K,) first row of each environment.
            counts: (K,) numbers of rows.
            starts_ns: (K,) log_time of each environment's first row.
            step_ns: Time between two rows, nanoseconds.
        """
        starts = np.asarray(starts_ns)
        for which, steps in self._chunks(environments, firsts, counts):
            self._chunk.write(slice(len(steps)), starts[which] + steps * step_ns)

    def _chunks(
        self, environments: Sequence[int], firsts: NDArray[np.int64], counts: NDArray[np.int64]
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Copy rows of environments to `_chunk`, one full chunk after the other.

        Yields:
            For each row of a chunk, its position in `environments` and its step.
        """
        which = np.repeat(np.arange(len(counts)), counts)
        steps = np.arange(len(which)) - (np.cumsum(counts) - counts)[which]
        places = (firsts[which] + steps) % self.capacity * self._environments
        places += np.asarray(environments)[which]
        for start in range(0, len(which), self.per_chunk):
            part = slice(start, start + self.per_chunk)
            for name, column in self._columns.items():
                self._chunk.take(name, column.reshape(-1, *column.shape[2:]), places[part])
            yield which[part], steps[part]


class OpenSteps(OpenRows[StepRows]):
    """Rows of `/rl/step` of all open episodes."""

    def end(
        self,
        environments: Sequence[int],
        firsts: NDArray[np.int64],
        summaries: Sequence[EpisodeSummary],
        step_ns: int,
    ) -> None:
        """Set the numbers and end flags in the rows of ended episodes, and write the rows."""
        numbers, lengths, starts, terminated, truncated = (
            np.array([getattr(summary, name) for summary in summaries])
            for name in ("episode", "length", "start_time_ns", "terminated", "truncated")
        )
        chunk = self._chunk
        for which, steps in self._chunks(environments, firsts, lengths + 1):
            left = lengths[which] - steps
            last, where = np.flatnonzero(left == 1), slice(len(steps))
            chunk.number(where, numbers[which], steps)
            chunk.put("terminated", last, terminated[which[last]])
            chunk.put("truncated", last, truncated[which[last]])
            chunk.finish(np.flatnonzero(left == 0))
            chunk.write(where, starts[which] + steps * step_ns)

    def total_rewards(
        self, environments: Sequence[int], firsts: NDArray[np.int64], counts: NDArray[np.int64]
    ) -> list[float]:
        """Return the sums of environments' rewards, each added up in the order of the steps.

        Args:
            environments: K indexes of environments.
            firsts: (K,) first row of each environment.
            counts: (K,) numbers of rewards, 1 or more.
        """
        rows = (firsts[:, None] + np.arange(counts.max())) % self.capacity
        rewards = self._columns["reward"][rows, np.asarray(environments)[:, None]]
        return add_up_rows(rewards, counts)
