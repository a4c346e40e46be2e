"""Alignment of the messages that a mapping uses with the times of the steps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.limits import MAX_TIME_NS
from mcaprl.recorder.bags.bag import Bag, Failure, Stream
from mcaprl.recorder.mapping.config import Stamp, TimeSource
from mcaprl.recorder.mapping.paths import FieldPath, field_path

NONE = -1
"""Value in `Matches.rows` of a step without a message."""
NS_PER_S = 1e9


class Matches(NamedTuple):
    """The messages that match N steps.

    Attributes:
        rows: (N,) index of the message in the sorted messages; `NONE` for a step without a message.
        age_s: (N,) time of the step minus time of the message, seconds; NaN for a step without a
            message.
    """

    rows: NDArray[np.int64]
    age_s: NDArray[np.float64]


def time_order(times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indexes that sort messages by time; equal times keep their order."""
    return np.argsort(times_ns, kind="stable")


def last(
    times_ns: NDArray[np.int64], steps_ns: NDArray[np.int64], tolerance_s: float | None
) -> Matches:
    """Match each step with the last message up to its time.

    Args:
        times_ns: (M,) times of the messages, not descending.
        steps_ns: (N,) times of the steps.
        tolerance_s: Maximum age of a matching message in seconds; None for no limit.
    """
    rows = np.searchsorted(times_ns, steps_ns, side="right") - 1
    return _within(times_ns, steps_ns, rows, tolerance_s)


def nearest(
    times_ns: NDArray[np.int64],
    steps_ns: NDArray[np.int64],
    tolerance_s: float | None,
    gap_s: float = math.inf,
) -> Matches:
    """Match each step with the message nearest in time.

    Of two equally near messages, the earlier one matches. A message that comes more than `gap_s`
    after the step never matches, because it belongs to the data after a gap.
    """
    if not len(times_ns):
        return _within(times_ns, steps_ns, np.full(len(steps_ns), NONE), tolerance_s)
    after = np.searchsorted(times_ns, steps_ns, side="right")
    before = np.maximum(after - 1, 0)
    after = np.minimum(after, len(times_ns) - 1)
    wait_ns = times_ns[after] - steps_ns
    is_after = np.abs(wait_ns) < np.abs(steps_ns - times_ns[before])
    rows = np.where(is_after & (wait_ns <= gap_s * NS_PER_S), after, before)
    # All messages may come after the step, and more than `gap_s` after it.
    rows[times_ns[rows] - steps_ns > gap_s * NS_PER_S] = NONE
    return _within(times_ns, steps_ns, rows, tolerance_s)


def during(
    times_ns: NDArray[np.int64],
    steps_ns: NDArray[np.int64],
    ends_ns: NDArray[np.int64],
    tolerance_s: float | None,
) -> Matches:
    """Match each step with the last message before the end of the step.

    `ends_ns` contains the (N,) ends of the steps.
    """
    rows = np.searchsorted(times_ns, ends_ns, side="left") - 1
    return _within(times_ns, steps_ns, rows, tolerance_s)


def interpolated(
    times_ns: NDArray[np.int64],
    values: NDArray[np.float64],
    steps_ns: NDArray[np.int64],
    tolerance_s: float | None,
    gap_s: float = math.inf,
) -> tuple[NDArray[np.float64], Matches]:
    """Interpolate values (M,) or (M, K) linearly at the times of the steps.

    A step has no value before the first and after the last message, and between two messages that
    are more than `gap_s` apart.

    Returns:
        Values (N,) or (N, K), which are NaN where missing, and the matches. `rows` of the matches
        are the messages before the steps. `age_s` is the age of one of the two messages
        between which a value is interpolated: the message that is nearer in time.
    """
    low = np.searchsorted(times_ns, steps_ns, side="right") - 1
    exact = (low >= 0) & (times_ns[np.maximum(low, 0)] == steps_ns) if len(times_ns) else low >= 0
    high = np.where(exact, low, low + 1)
    has_both = (low >= 0) & (high < len(times_ns))
    low, high = np.where(has_both, low, 0), np.where(has_both, high, 0)
    found = np.full((len(steps_ns), *values.shape[1:]), np.nan)
    if len(times_ns):
        before_s, after_s = steps_ns - times_ns[low], times_ns[high] - steps_ns
        has_both &= times_ns[high] - times_ns[low] <= gap_s * NS_PER_S
        span = np.maximum(times_ns[high] - times_ns[low], 1)
        share = (before_s / span).reshape(-1, *[1] * (values.ndim - 1))
        found = values[low] + share * (values[high] - values[low])
        age_s = np.where(before_s <= after_s, before_s, -after_s) / NS_PER_S
        is_late = np.zeros(len(age_s), bool)
        if tolerance_s is not None:
            is_late = np.maximum(before_s, after_s) / NS_PER_S > tolerance_s
        has_both &= ~is_late
        found[~has_both] = np.nan
    else:
        age_s = np.full(len(steps_ns), np.nan)
    rows = np.where(has_both, low, NONE)
    return found, Matches(rows, np.where(has_both, age_s, np.nan))


def _within(
    times_ns: NDArray[np.int64],
    steps_ns: NDArray[np.int64],
    rows: NDArray[np.int64],
    tolerance_s: float | None,
) -> Matches:
    has_one = rows >= 0
    age_s = np.full(len(steps_ns), np.nan)
    if len(times_ns):
        age_s = np.where(has_one, (steps_ns - times_ns[np.maximum(rows, 0)]) / NS_PER_S, np.nan)
    if tolerance_s is not None:
        has_one = has_one & (np.abs(age_s) <= tolerance_s)
    return Matches(np.where(has_one, rows, NONE), np.where(has_one, age_s, np.nan))


_PUBLISH_TIME, _STAMP = "publish_time", "header.stamp"
_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}


class TopicStream:
    """Messages of one topic: times, and the fields that a mapping uses.

    Messages that cannot be decoded, or whose stamp is not a time, are left out.
    """

    def __init__(
        self, bag: Bag, topic: str, fields: Iterable[str], time: TimeSource | Stamp
    ) -> None:
        """Select the fields; nothing is read yet."""
        self.topic = topic
        self._bag, self._left_out = bag, np.empty(0, np.int64)
        self._fields = sorted(set(fields))
        self._stamp: FieldPath | None = None
        self._unit_ns = 1
        if time == "publish_time":
            self._stamp = FieldPath(topic, _PUBLISH_TIME, None)
        elif time != "log_time":
            self._stamp, self._unit_ns = _stamp_of(bag, topic, time)

    @cached_property
    def _read(self) -> Stream:
        """Columns of the messages that can be used, in the order of recording."""
        stamp = [] if self._stamp is None else [self._stamp.field]
        if not self._fields and not stamp:
            times_ns = self._bag.times(self.topic)
            found = Stream(times_ns, {}, np.arange(len(times_ns)))
        else:
            found = self._bag.read(self.topic, sorted({*self._fields, *stamp}))
        keep = ~np.isin(found.rows, self._left_out)
        if self._stamp is not None:
            keep &= _is_time(self._stamp.select(found.columns[self._stamp.field]), self._unit_ns)
            if len(keep) and not keep.any():
                raise UsageError(
                    f"{self.topic}: no message has a time in {self._stamp.field}: use"
                    " `time: log_time`"
                )
        if keep.all():
            return found
        columns, absent = (
            {name: column[keep] for name, column in part.items()}
            for part in (found.columns, found.absent)
        )
        return Stream(found.log_time_ns[keep], columns, found.rows[keep], found.failures, absent)

    def leave_out(self, rows: Iterable[int]) -> None:
        """Leave out more messages, such as those with damaged images, by their index."""
        self._left_out = np.union1d(self._left_out, list(rows)).astype(np.int64)
        self.__dict__.pop("_read", None)
        self.__dict__.pop("times_ns", None)

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """Columns of the fields, in the order of recording."""
        return self._read.columns

    @property
    def absent(self) -> Mapping[str, NDArray[np.bool_]]:
        """(M,) flags of the messages that omit a field; see `Stream.absent`."""
        return self._read.absent

    @property
    def rows(self) -> NDArray[np.int64]:
        """(M,) index of each message in the topic."""
        return self._read.rows

    @property
    def failures(self) -> tuple[Failure, ...]:
        """Messages that cannot be decoded."""
        return self._read.failures

    @property
    def bad_stamps(self) -> int:
        """Number of messages that were left out because their stamp is not a time."""
        count = len(self._bag.times(self.topic))
        return count - len(self.rows) - len(self.failures) - len(self._left_out)

    @cached_property
    def times_ns(self) -> NDArray[np.int64]:
        """(M,) times of the messages, in the order of recording."""
        found = self._read
        if self._stamp is None:
            return found.log_time_ns
        stamps = self._stamp.select(found.columns[self._stamp.field])
        if stamps.dtype.kind in "iu":
            return stamps.astype(np.int64) * self._unit_ns
        return np.rint(stamps.astype(np.float64) * self._unit_ns).astype(np.int64)

    @property
    def places(self) -> NDArray[np.int64]:
        """(M, 2) places of the messages; see `Bag.places`."""
        places = self._bag.places(self.topic)
        return places if len(places) == len(self.rows) else places[self.rows]


def _stamp_of(bag: Bag, topic: str, time: TimeSource | Stamp) -> tuple[FieldPath, int]:
    """Return the field that contains the times of a topic, and its unit in nanoseconds."""
    info = bag.topics[topic]
    if not isinstance(time, Stamp):
        if info.fields and _STAMP not in info.fields:
            raise UsageError(
                f"{topic} ({info.type_name}) has no header.stamp: use `time: log_time` for it"
            )
        return FieldPath(topic, _STAMP, None), 1
    text = time.field if time.field.startswith("/") else f"{topic}.{time.field}"
    path = field_path(bag, text)
    if path.topic != topic:
        raise UsageError(f"time is a field of {path.topic}, expected a field of {topic}")
    return path, 1 if info.fields.get(path.field) == "time" else _NS[time.unit]


def _is_time(stamps: NDArray[Any], unit_ns: int) -> NDArray[np.bool_]:
    """Return whether stamps are numbers that are times in nanoseconds."""
    if stamps.dtype.kind not in "iuf" or stamps.ndim != 1:
        return np.zeros(len(stamps), bool)
    found: NDArray[np.bool_] = np.abs(stamps.astype(np.float64)) * unit_ns < MAX_TIME_NS
    return found
