"""Buffers for the open episodes of a vector environment.

The message records are in one array of shape (environments, capacity). One indexed assignment
writes a field for all environments, and each episode is contiguous in memory.
"""

from __future__ import annotations

from typing import Any, Generic, TypeVar

import numpy as np

from mcaprl.recorder.format.episode_summary import EpisodeSummary, add_up
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
        self._per_chunk = len(chunk)
        first = max(1, min(_FIRST_CAPACITY, _FIRST_BYTES // chunk.itemsize))
        self._rows = chunk.blank(environments, first)

    @property
    def capacity(self) -> int:
        """Number of steps that fit into the array."""
        return len(self._rows)

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

    def write(self, environment: int, count: int, start_ns: int, step_ns: int) -> None:
        """Write the first `count` rows of an environment in chunks; row 0 has time `start_ns`."""
        times = start_ns + np.arange(count) * step_ns
        for first in range(0, count, self._per_chunk):
            chunk = slice(first, min(first + self._per_chunk, count))
            self._rows.write((environment, chunk), times[chunk])


class OpenSteps(OpenRows[StepRows]):
    """Rows of `/rl/step` of all open episodes."""

    def end(self, environment: int, summary: EpisodeSummary, step_ns: int) -> None:
        """Set the numbers and the end flags in the rows of an episode, and write the rows."""
        rows, count, last = self._rows, summary.length + 1, summary.length - 1
        rows.number((environment, slice(count)), summary.episode, np.arange(count))
        rows.put("terminated", (environment, last), summary.terminated)
        rows.put("truncated", (environment, last), summary.truncated)
        rows.finish((environment, last + 1))
        self.write(environment, count, summary.start_time_ns, step_ns)

    def total_reward(self, environment: int, steps: int) -> float:
        """Return the sum of an environment's first `steps` rewards, in the order of the steps."""
        return add_up(self._rows.fields["reward"][environment, :steps])
