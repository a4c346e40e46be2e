"""Rows of the episodes that many environments have open at once.

Each environment has a row of its own in a block of message records, (environments, capacity). All
put their values with one fancy index per field; an episode that ends is one contiguous run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.format.episode_summary import EpisodeSummary

# Steps for which there is room at first: as many, or as few as have this size. The room is doubled
# whenever an episode needs more.
_FIRST_CAPACITY = 64
_FIRST_BYTES = 2**20


class OpenRows:
    """Message records of one topic for all episodes that are open."""

    def __init__(
        self,
        template: NDArray[Any],
        environments: int,
        write: Callable[[NDArray[Any]], None],
    ) -> None:
        """Make room for each environment's first steps.

        Args:
            template: a chunk's preallocated rows, with what is the same in all of them.
            environments: how many.
            write: writes rows, at most as many as the template has.
        """
        self._blank = template[0].copy()
        self._per_chunk = len(template)
        self._write = write
        self._environments = environments
        first = max(1, min(_FIRST_CAPACITY, _FIRST_BYTES // template.itemsize))
        self._take(self._blank_rows(first))

    @property
    def capacity(self) -> int:
        """The first step for which there is no row."""
        return int(self._rows.shape[1])

    def make_room(self, step: int) -> None:
        """Make sure that there is a row for `step`."""
        capacity = self.capacity
        if step >= capacity:
            grown = self._blank_rows(max(2 * capacity, step + 1))
            grown[:, :capacity] = self._rows
            self._take(grown)

    def put(self, field: str, environments: Any, steps: Any, values: Any) -> None:
        """Put values at steps of environments.

        Args:
            field: of the message.
            environments: (K,) their numbers; or one.
            steps: (K,) where each one's value goes; or one.
            values: (K, *shape), or one for all.
        """
        column = self.fields[field]
        if column.ndim > 2:
            values = np.reshape(values, (*np.shape(environments), -1))
        column[environments, steps] = values

    def write(self, environment: int, count: int, start_ns: int, step_ns: int) -> None:
        """Write the first `count` rows of an environment, in chunks.

        Args:
            environment: its number.
            count: of rows.
            start_ns: log_time of the first one.
            step_ns: from one to the next.
        """
        rows = self._rows[environment, :count]
        rows["log_time"] = start_ns + np.arange(count) * step_ns
        for first in range(0, count, self._per_chunk):
            self._write(rows[first : first + self._per_chunk])

    def _take(self, rows: NDArray[Any]) -> None:
        payload = rows["payload"]
        self.fields = {name: payload[name] for name in payload.dtype.names or ()}
        self._rows = rows

    def _blank_rows(self, capacity: int) -> NDArray[Any]:
        rows = np.empty((self._environments, capacity), self._blank.dtype)
        rows[:] = self._blank
        return rows


class OpenSteps(OpenRows):
    """The rows of `/rl/step` of all episodes that are open."""

    def end(self, environment: int, summary: EpisodeSummary, step_ns: int) -> None:
        """Mark an episode's last transition and its final row, number all, and write them."""
        count, final, last = summary.length + 1, summary.length, summary.length - 1
        rows = {name: column[environment] for name, column in self.fields.items()}
        rows["episode"][:count], rows["step"][:count] = summary.episode, np.arange(count)
        rows["terminated"][last], rows["truncated"][last] = summary.terminated, summary.truncated
        rows["action"][final], rows["reward"][final] = 0, 0.0
        rows["behavior_prob"][final], rows["final"][final] = np.nan, True
        self.write(environment, count, summary.start_time_ns, step_ns)
        for name in ("terminated", "truncated", "final"):
            rows[name][:count] = False
