"""Messages of the topics that a mapping uses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.limits import MAX_TIME_NS
from mcaprl.recorder.bags.bag import Bag, Failure, Stream
from mcaprl.recorder.mapping.config import Stamp, TimeSource
from mcaprl.recorder.mapping.paths import FieldPath, field_path

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
