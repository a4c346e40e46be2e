"""Buffers for the open episodes of a vector environment.

The message records are in one array of shape (environments, capacity). One indexed assignment
writes a field for all environments, and each episode is contiguous in memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.format.episode_summary import EpisodeSummary, add_up_rows
from mcaprl.recorder.format.rows import StepRows, TopicRows

# Limits of the initial capacity: number of steps, and number of bytes per environment. The capacity
# doubles when an episode needs more.
_FIRST_CAPACITY = 64
_FIRST_BYTES = 2**20

Rows = TypeVar("Rows", bound=TopicRows)


class OpenRows(Generic[Rows]):
    """Message records of one topic for all open episodes."""

    def __init__(self, chunk: Rows, environments: int) -> None:
        """Allocate the array; `chunk` contains blank rows whose constant fields are set."""
        self._chunk = chunk
        first = max(1, min(_FIRST_CAPACITY, _FIRST_BYTES // chunk.itemsize))
        self._rows = chunk.blank(environments, first)

    @property
    def capacity(self) -> int:
        """Number of steps that fit into the array."""
        return len(self._rows)

    @property
    def per_chunk(self) -> int:
        """Maximum number of rows of a chunk."""
        return len(self._chunk)

    def make_room(self, step: int) -> None:
        """Grow the array if `step` does not fit."""
        if step >= self.capacity:
            self._rows = self._rows.grown(max(2 * self.capacity, step + 1))

    def put(self, field: str, environments: Any, steps: Any, values: Any) -> None:
        """Set a field in the rows of these environments and steps.

        Args:
            field: Name of the message field.
            environments: (K,) indexes of environments, or one index.
            steps: (K,) step of each environment, or one step.
            values: (K, *shape) values, or one scalar for all.
        """
        self._rows.put(field, (environments, steps), values)

    def write(
        self, environments: Sequence[int], counts: NDArray[np.int64], starts_ns: Any, step_ns: int
    ) -> None:
        """Write the first rows of environments, one environment after the other.

        Args:
            environments: K indexes of environments.
            counts: (K,) numbers of rows.
            starts_ns: (K,) log_time of each environment's row 0.
            step_ns: Time between two rows, nanoseconds.
        """
        starts = np.asarray(starts_ns)
        for which, steps in self._chunks(environments, counts):
            self._chunk.write(slice(len(steps)), starts[which] + steps * step_ns)

    def _chunks(
        self, environments: Sequence[int], counts: NDArray[np.int64]
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Copy the first rows of environments to `_chunk`, one full chunk after the other.

        Yields:
            For each row of a chunk, its position in `environments` and its step.
        """
        stops = np.cumsum(counts)
        firsts = stops - counts
        which = np.repeat(np.arange(len(stops)), counts)
        steps = np.arange(len(which)) - firsts[which]
        for start in range(0, len(which), self.per_chunk):
            stop = min(start + self.per_chunk, len(which))
            for place in range(which[start], which[stop - 1] + 1):
                low, high = max(start, int(firsts[place])), min(stop, int(stops[place]))
                rows = slice(low - int(firsts[place]), high - int(firsts[place]))
                where = slice(low - start, high - start)
                self._chunk.copy(where, self._rows, (environments[place], rows))
            yield which[start:stop], steps[start:stop]


class OpenSteps(OpenRows[StepRows]):
    """Rows of `/rl/step` of all open episodes."""

    def end(
        self, environments: Sequence[int], summaries: Sequence[EpisodeSummary], step_ns: int
    ) -> None:
        """Set the numbers and end flags in the rows of ended episodes, and write the rows."""
        numbers, lengths, starts, terminated, truncated = (
            np.array([getattr(summary, name) for summary in summaries])
            for name in ("episode", "length", "start_time_ns", "terminated", "truncated")
        )
        chunk = self._chunk
        for which, steps in self._chunks(environments, lengths + 1):
            left = lengths[which] - steps
            last, where = np.flatnonzero(left == 1), slice(len(steps))
            chunk.number(where, numbers[which], steps)
            chunk.put("terminated", last, terminated[which[last]])
            chunk.put("truncated", last, truncated[which[last]])
            chunk.finish(np.flatnonzero(left == 0))
            chunk.write(where, starts[which] + steps * step_ns)

    def total_rewards(self, environments: Sequence[int], counts: NDArray[np.int64]) -> list[float]:
        """Return the sums of environments' rewards, each added up in the order of the steps.

        Args:
            environments: K indexes of environments.
            counts: (K,) numbers of rewards, 1 or more.
        """
        rewards = self._rows.fields["reward"][list(environments), : counts.max()]
        return add_up_rows(rewards, counts)
