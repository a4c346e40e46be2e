"""Rows of the episodes that many environments have open at once.

Each environment has its own row in a block of message records, (environments, capacity). A field is
written for all environments by one fancy index; an episode that ends is one contiguous run.
"""

from __future__ import annotations

from typing import Any, Generic, TypeVar

import numpy as np

from mcaprl.recorder.format.episode_summary import EpisodeSummary, add_up
from mcaprl.recorder.format.rows import StepRows, TopicRows

# Number of steps that the block has room for at first, or fewer where they exceed this size. The
# block is doubled when an episode needs more.
_FIRST_CAPACITY = 64
_FIRST_BYTES = 2**20

Rows = TypeVar("Rows", bound=TopicRows)


class OpenRows(Generic[Rows]):
    """Message records of one topic for all open episodes."""

    def __init__(self, chunk: Rows, environments: int) -> None:
        """Make room for the first steps of each environment.

        Args:
            chunk: Preallocated rows of one chunk, with the constant fields set.
            environments: Number of environments.
        """
        self._per_chunk = len(chunk)
        first = max(1, min(_FIRST_CAPACITY, _FIRST_BYTES // chunk.itemsize))
        self._rows = chunk.blank(environments, first)

    @property
    def capacity(self) -> int:
        """The first step that has no row."""
        return len(self._rows)

    def make_room(self, step: int) -> None:
        """Make sure that `step` has a row."""
        if step >= self.capacity:
            self._rows = self._rows.grown(max(2 * self.capacity, step + 1))

    def put(self, field: str, environments: Any, steps: Any, values: Any) -> None:
        """Put values at steps of environments.

        Args:
            field: Name in the message.
            environments: (K,) indexes of environments, or one index.
            steps: (K,) step of each environment, or one step.
            values: (K, *shape), or one scalar for all.
        """
        self._rows.put(field, (environments, steps), values)

    def write(self, environment: int, count: int, start_ns: int, step_ns: int) -> None:
        """Write the first `count` rows of an environment, in chunks.

        Args:
            environment: Number of the environment.
            count: Number of rows.
            start_ns: log_time of the first row.
            step_ns: Time between two rows.
        """
        times = start_ns + np.arange(count) * step_ns
        for first in range(0, count, self._per_chunk):
            chunk = slice(first, min(first + self._per_chunk, count))
            self._rows.write((environment, chunk), times[chunk])


class OpenSteps(OpenRows[StepRows]):
    """Rows of `/rl/step` of all open episodes."""

    def end(self, environment: int, summary: EpisodeSummary, step_ns: int) -> None:
        """Number the rows of an episode, mark its end and write them."""
        rows, count, last = self._rows, summary.length + 1, summary.length - 1
        rows.number((environment, slice(count)), summary.episode, np.arange(count))
        rows.put("terminated", (environment, last), summary.terminated)
        rows.put("truncated", (environment, last), summary.truncated)
        rows.finish((environment, last + 1))
        self.write(environment, count, summary.start_time_ns, step_ns)

    def total_reward(self, environment: int, steps: int) -> float:
        """Return the sum of an environment's first rewards, added in order."""
        return add_up(self._rows.fields["reward"][environment, :steps])
