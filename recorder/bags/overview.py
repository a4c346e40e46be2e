"""Overview of a bag: its recordings, and the rate and the longest gap of each topic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.bags.bag import Bag, TopicInfo

NS_PER_S = 1e9


@dataclass(frozen=True)
class TopicOverview:
    """A topic and the times of its messages.

    Attributes:
        info: Description of the topic.
        times_ns: (N,) log_time of each message, in the order of recording.
        recordings: (N,) index of the recording of each message, not descending.
    """

    info: TopicInfo
    times_ns: NDArray[np.int64]
    recordings: NDArray[np.int64]

    @cached_property
    def _intervals_ns(self) -> NDArray[np.int64]:
        """Times between successive messages of a recording, without steps back."""
        intervals_ns = np.diff(self.times_ns)[np.diff(self.recordings) == 0]
        found: NDArray[np.int64] = intervals_ns[intervals_ns > 0]
        return found

    @property
    def rate_hz(self) -> float:
        """Messages per second by the median interval, so that pauses do not count; 0 if unknown."""
        intervals_ns = self._intervals_ns
        return float(NS_PER_S / np.median(intervals_ns)) if len(intervals_ns) else 0.0

    @property
    def largest_gap_s(self) -> float:
        """Longest time between two successive messages of a recording, seconds; 0 if unknown."""
        return float(self._intervals_ns.max(initial=0) / NS_PER_S)

    @property
    def why_unusable(self) -> str:
        """Reason why the topic cannot be a quantity at different times; empty if it can."""
        info = self.info
        if info.problem:
            return info.problem
        if info.count < 2:
            return "has one message only" if info.count else "has no messages"
        return "all messages have the same time" if info.first_ns == info.last_ns else ""

    def __str__(self) -> str:
        """Return type, number of messages and rate."""
        info = self.info
        rate = f", {self.rate_hz:.3g} Hz" if self.rate_hz else ""
        count = f"{info.count} message{'' if info.count == 1 else 's'}"
        return f"{info.type_name or info.encoding}, {count}{rate}"


@dataclass(frozen=True)
class Recording:
    """A recording of a bag.

    Attributes:
        paths: Files of the recording.
        messages: Number of messages.
        first_ns: log_time of the first message; 0 if there are no messages.
        last_ns: log_time of the last message; 0 if there are no messages.
    """

    paths: tuple[Path, ...]
    messages: int
    first_ns: int
    last_ns: int


def instants_of(times_ns: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Return instants at which the topics of a bag are compared: times of their messages.

    Each topic has the same number of them at most, so that a fast topic does not outweigh others.
    Pauses of all topics have none.
    """
    parts = [np.sort(each) for each in times_ns if len(each)]
    chosen = [
        each[np.linspace(0, len(each) - 1, min(len(each), 1000)).astype(int)] for each in parts
    ]
    return np.concatenate([np.empty(0, np.int64), *chosen])


def is_fresh(
    times_ns: NDArray[np.int64], instants_ns: NDArray[np.int64], gap_s: float
) -> NDArray[np.bool_]:
    """Return (N,) whether the last message before each instant is at most `gap_s` old."""
    if not len(times_ns):
        return np.zeros(len(instants_ns), bool)
    times_ns = np.sort(times_ns)
    rows = np.searchsorted(times_ns, instants_ns, side="right") - 1
    ages_s = (instants_ns - times_ns[np.maximum(rows, 0)]) / NS_PER_S
    found: NDArray[np.bool_] = (rows >= 0) & (ages_s <= gap_s)
    return found


def recordings_of(bag: Bag) -> NDArray[np.int64]:
    """Return the index of the recording of each file."""
    return np.array(getattr(bag, "recordings", range(len(bag.paths))), np.int64)


def topics_of(bag: Bag) -> list[TopicOverview]:
    """Return an overview of each topic, by name."""
    numbers = recordings_of(bag)
    return [
        TopicOverview(info, bag.times(name), numbers[bag.places(name)[:, 0]])
        for name, info in bag.topics.items()
    ]


def recordings_in(bag: Bag, topics: list[TopicOverview]) -> list[Recording]:
    """Return the recordings of a bag, whose topics are `topics`."""
    numbers, found = recordings_of(bag), []
    for number in range(int(numbers.max(initial=-1)) + 1):
        paths = tuple(path for path, one in zip(bag.paths, numbers, strict=True) if one == number)
        mine = [each.times_ns[each.recordings == number] for each in topics]
        times_ns = [each for each in mine if len(each)]
        found.append(
            Recording(
                paths=paths,
                messages=sum(map(len, times_ns)),
                first_ns=min((int(each.min()) for each in times_ns), default=0),
                last_ns=max((int(each.max()) for each in times_ns), default=0),
            )
        )
    return found
