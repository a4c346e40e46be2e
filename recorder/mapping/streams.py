"""Messages of the topics that a mapping uses, in time order."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.bags.bag import Bag
from mcaprl.recorder.mapping.align import time_order
from mcaprl.recorder.mapping.config import TimeSource

_PUBLISH_TIME, _STAMP = "publish_time", "header.stamp"


class Run(NamedTuple):
    """Messages of a topic between two resets of the clock, in the order of time.

    Attributes:
        times_ns: (M,) times, not descending.
        rows: (M,) positions of the messages in the topic.
    """

    times_ns: NDArray[np.int64]
    rows: NDArray[np.int64]


class TopicStream:
    """Messages of one topic: times, and the fields that a mapping uses.

    If the clock goes back by more than `gap_s`, it was reset, as in a simulation that restarts; the
    messages before and after the reset are separate runs. If it goes back by less, the cause is
    jitter, and the messages are sorted by time.
    """

    def __init__(
        self, bag: Bag, topic: str, fields: Iterable[str], time: TimeSource, gap_s: float
    ) -> None:
        """Select the fields; nothing is read yet."""
        self._bag, self._topic, self._time, self._gap_ns = bag, topic, time, gap_s * 1e9
        self._fields = sorted(set(fields))

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        """Columns of the fields, in file order."""
        return self._bag.read(self._topic, self._fields).columns if self._fields else {}

    @cached_property
    def times_ns(self) -> NDArray[np.int64]:
        """(M,) times of the messages, in file order.

        Raises:
            UsageError: The mapping uses times of headers, but the messages have no header.
        """
        if self._time == "log_time":
            return self._bag.times(self._topic)
        field = _PUBLISH_TIME if self._time == "publish_time" else _STAMP
        if field == _STAMP and _STAMP not in self._bag.topics[self._topic].fields:
            raise UsageError(
                f"{self._topic} ({self._bag.topics[self._topic].type_name}) has no header.stamp:"
                " use `time: log_time`"
            )
        return self._bag.read(self._topic, [field]).columns[field].astype(np.int64)

    @cached_property
    def runs(self) -> list[Run]:
        """Runs of messages between resets of the clock.

        If there are no messages, there is one empty run.
        """
        times_ns = self.times_ns
        resets = np.flatnonzero(np.diff(times_ns) < -self._gap_ns) + 1
        found = []
        for rows in np.split(np.arange(len(times_ns)), resets):
            order = time_order(times_ns[rows])
            found.append(Run(times_ns[rows][order], rows[order]))
        return found


def run_count(streams: dict[str, TopicStream]) -> int:
    """Return the number of runs, which is the same for all topics with messages.

    Raises:
        UsageError: The clocks of two topics were reset different numbers of times.
    """
    counts = {name: len(stream.runs) for name, stream in streams.items() if len(stream.times_ns)}
    if len(set(counts.values())) > 1:
        most, least = max(counts, key=counts.__getitem__), min(counts, key=counts.__getitem__)
        raise UsageError(
            f"the clock of {most} goes back {counts[most] - 1} times, that of {least}"
            f" {counts[least] - 1} times: use another `time`, or split the bag there"
        )
    return max(counts.values(), default=1)
