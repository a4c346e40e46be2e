"""Messages of the topics that a mapping uses, in time order."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.bags.bag import Bag
from mcaprl.recorder.mapping.align import NS_PER_S, time_order
from mcaprl.recorder.mapping.config import TimeSource

_PUBLISH_TIME, _STAMP = "publish_time", "header.stamp"


class Recorded(Protocol):
    """Messages in the order of recording: those of a topic, or of a coordinate frame."""

    @property
    def times_ns(self) -> NDArray[np.int64]:
        """(M,) times of the messages."""

    @property
    def places(self) -> NDArray[np.int64]:
        """(M, 2) places of the messages; see `Bag.places`."""


class Run(NamedTuple):
    """Messages of a stream between two resets of the clock, in the order of time.

    Attributes:
        times_ns: (M,) times, not descending.
        rows: (M,) positions of the messages in the stream.
    """

    times_ns: NDArray[np.int64]
    rows: NDArray[np.int64]

    def without(self, rows: NDArray[np.int64]) -> Run:
        """Return the run without the messages at these positions in the stream."""
        keep = ~np.isin(self.rows, rows)
        return Run(self.times_ns[keep], self.rows[keep])


class TopicStream:
    """Messages of one topic: times, and the fields that a mapping uses."""

    def __init__(self, bag: Bag, topic: str, fields: Iterable[str], time: TimeSource) -> None:
        """Select the fields; nothing is read yet."""
        self._bag, self._topic, self._time = bag, topic, time
        self._fields = sorted(set(fields))

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        """Columns of the fields, in the order of recording."""
        return self._bag.read(self._topic, self._fields).columns if self._fields else {}

    @cached_property
    def times_ns(self) -> NDArray[np.int64]:
        """(M,) times of the messages, in the order of recording.

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

    @property
    def places(self) -> NDArray[np.int64]:
        """(M, 2) places of the messages; see `Bag.places`."""
        return self._bag.places(self._topic)


class _Clock(NamedTuple):
    """Where the clock of a stream goes back.

    Attributes:
        times_ns: (M,) times of the messages, in the order of recording.
        places: (M, 2) file and position of each message.
        is_reset: (M,) whether the clock was reset since the message before, which is in the same
            file.
        is_new: (M,) whether the clock goes back from the end of an earlier file.
    """

    times_ns: NDArray[np.int64]
    places: NDArray[np.int64]
    is_reset: NDArray[np.bool_]
    is_new: NDArray[np.bool_]

    @classmethod
    def of(cls, stream: Recorded, gap_s: float) -> _Clock:
        times_ns, places = stream.times_ns, stream.places
        back_ns = -np.diff(times_ns, prepend=times_ns[:1])
        is_first = np.diff(places[:, 0], prepend=places[:1, 0]) > 0
        is_reset = ~is_first & (back_ns > gap_s * NS_PER_S)
        return cls(times_ns, places, is_reset, is_first & (back_ns > 0))

    def within(self, file: int) -> _Clock:
        """Return the messages of one file."""
        first, last = np.searchsorted(self.places[:, 0], [file, file + 1])
        part = slice(first, last)
        return _Clock(
            self.times_ns[part], self.places[part], self.is_reset[part], self.is_new[part]
        )


def runs_of(
    streams: Mapping[str, Recorded], gap_s: float, paths: Sequence[Path]
) -> list[dict[str, Run]]:
    """Divide the messages of all streams into runs, between which the clock was reset.

    If the clock of a file goes back by more than `gap_s`, it was reset, as in a simulation that
    restarts. If it goes back by less, the cause is jitter, and the messages are sorted by time. A
    file with a stream that goes back from the end of an earlier file is another recording, such as
    that of another robot, and begins a new run.

    Args:
        streams: Messages by the name of the stream.
        gap_s: Longest jitter in seconds.
        paths: Files of the bag, for error messages.

    Returns:
        Messages of each run by the name of the stream; a stream without messages is empty.

    Raises:
        UsageError: The clocks of two streams were not reset together.
    """
    clocks = {name: _Clock.of(stream, gap_s) for name, stream in streams.items()}
    starts, resets = np.zeros(len(paths), np.int64), np.zeros(len(paths), np.int64)
    for clock in clocks.values():
        starts[clock.places[clock.is_new, 0]] = 1
    for file, path in enumerate(paths):
        parts = {name: clock.within(file) for name, clock in clocks.items()}
        resets[file] = _resets(
            {name: part for name, part in parts.items() if len(part.times_ns)}, gap_s, path
        )
    first = np.cumsum(starts) + np.cumsum(resets) - resets
    runs: list[dict[str, Run]] = [{} for _ in range(int(first[-1] + resets[-1]) + 1)]
    for name, clock in clocks.items():
        files, passed = clock.places[:, 0], np.cumsum(clock.is_reset)
        number = first[files] + passed - passed[np.searchsorted(files, files)]
        bounds = np.searchsorted(number, np.arange(len(runs) + 1)).tolist()
        for run, (start, stop) in zip(runs, itertools.pairwise(bounds), strict=True):
            rows = np.arange(start, stop)
            order = time_order(clock.times_ns[rows])
            run[name] = Run(clock.times_ns[rows][order], rows[order])
    return runs


def last_file(streams: Mapping[str, Recorded], run: Mapping[str, Run]) -> int:
    """Return the index of the last file with messages of a run; 0 if there are none."""
    found = [streams[name].places[part.rows, 0] for name, part in run.items()]
    return max((int(files.max()) for files in found if len(files)), default=0)


def _resets(clocks: Mapping[str, _Clock], gap_s: float, path: Path) -> int:
    """Return how often the clock of a file was reset.

    Raises:
        UsageError: The clocks of two streams were not reset together.
    """
    counts = {name: int(clock.is_reset.sum()) for name, clock in clocks.items()}
    if len(set(counts.values())) > 1:
        most, least = max(counts, key=counts.__getitem__), min(counts, key=counts.__getitem__)
        raise UsageError(
            f"{path}: the clock of {most} goes back {counts[most]} times, that of {least}"
            f" {counts[least]} times: use another `time`, or split the bag there"
        )
    count = max(counts.values(), default=0)
    found = {name: np.flatnonzero(clock.is_reset).tolist() for name, clock in clocks.items()}
    for k in range(count):
        # Each stream has a first message after the reset. The earliest of them in the file is the
        # latest place at which the reset can be.
        rows = {name: resets[k] for name, resets in found.items()}
        place, earliest = min((clocks[name].places[row, 1], name) for name, row in rows.items())
        for name, row in rows.items():
            clock = clocks[name]
            late = int(np.searchsorted(clock.places[:, 1], place))
            if late < row and clock.times_ns[row - 1] - clock.times_ns[late] > gap_s * NS_PER_S:
                raise UsageError(
                    f"{path}: the clocks of {earliest} and {name} go back at different places: use"
                    " another `time`, or split the bag there"
                )
    return count
