"""Fields of a bag by their paths, and alignment of their messages with the times of the steps."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.limits import MAX_TIME_NS
from mcaprl.recorder.bags.bag import Bag, Failure, Stream
from mcaprl.recorder.bags.values import (
    ABSENT,
    Lack,
    Step,
    as_array,
    column_of,
    element_of,
    is_mapped,
    kind_at,
    path_text,
    steps_of,
    value_at,
    without_lacks,
)
from mcaprl.recorder.mapping.config import Stamp, TimeSource

Floats = NDArray[np.float64]


class FieldPath(NamedTuple):
    """Path of a field of a topic, with an optional index or slice.

    Attributes:
        topic: Name of the topic.
        field: Path of the field in the message, see `bags.values`; empty for the message as a
            whole.
        elements: Index or slice of the field's array; None for the whole field.
    """

    topic: str
    field: str
    elements: int | slice | None

    @property
    def steps(self) -> tuple[Step, ...]:
        """All steps of the path, with the index or slice."""
        return (*steps_of(self.field), *([] if self.elements is None else [self.elements]))

    @property
    def first(self) -> str:
        """Path of the first of several elements."""
        steps = self.steps
        mapped = [k for k in range(len(steps)) if is_mapped(steps, k)]
        if not mapped:
            return f"{self}[0]"
        one: list[Step] = [
            (step.start or 0) if isinstance(step, slice) and k in mapped else step
            for k, step in enumerate(steps)
        ]
        return _text(self.topic, one)

    @property
    def is_bounded(self) -> bool:
        """Whether a slice with an end selects the elements.

        If an array is shorter, it is clear which of the elements it lacks: the last ones.
        """
        slices = [step for step in self.steps if isinstance(step, slice)]
        if len(slices) != 1:
            return False
        (one,) = slices
        return (one.stop or 0) > 0 and (one.start or 0) >= 0 and (one.step or 1) > 0

    def select(self, column: NDArray[Any], *, optional: bool = False) -> NDArray[Any]:
        """Select elements of each value of a column; without an index or slice, return the column.

        Args:
            column: (N, K) numbers, or (N,) values; None where a message has no value.
            optional: Whether the array may be empty in all messages.

        Returns:
            (N, K) or (N,) column. An element that an array lacks is None.
        """
        if not len(column):
            return column
        if self.elements is not None:
            column = self._selected(column, self.elements, optional=optional)
        if column.dtype.kind != "O" and not column.size:
            raise self._none(column.shape[1])
        return column

    def _selected(
        self, column: NDArray[Any], elements: int | slice, *, optional: bool
    ) -> NDArray[Any]:
        if column.dtype.kind != "O":
            if column.ndim != 2:
                raise UsageError(f"{self}: the field is not an array")
            count = column.shape[1]
            if isinstance(elements, int) and not -count <= elements < count:
                raise UsageError(f"{self}: the field has {count} elements; index 0 is first")
            found = column[:, elements]
            if not found.size:
                raise self._none(count)
            return found
        values = [None if value is None else element_of(value, elements) for value in column]
        check_lacks(self, values, optional=optional)
        return without_lacks(values)

    def _none(self, count: int) -> UsageError:
        return UsageError(f"{self}: no elements; the field has {count} elements")

    def __str__(self) -> str:
        """Return the path as it is written in a mapping."""
        return _text(self.topic, self.steps)


def _text(topic: str, steps: Sequence[Step]) -> str:
    path = path_text(steps)
    return f"{topic}{'' if path.startswith('[') else '.'}{path}"


def topic_of(bag: Bag, name: str) -> str:
    """Return `name` if it is a readable topic of the bag."""
    if name not in bag.topics:
        near = difflib.get_close_matches(name, bag.topics, n=3, cutoff=0.4) or sorted(bag.topics)
        raise UsageError(f"no topic {name}; nearest: {', '.join(near[:8]) or 'the bag is empty'}")
    if bag.topics[name].problem:
        raise UsageError(f"topic {name} cannot be read: {bag.topics[name].problem}")
    return name


def field_path(bag: Bag, text: str) -> FieldPath:
    """Resolve the path of a field, whose topic is the longest name that the text begins with."""
    topics = [
        each for each in bag.topics if text == each or text.startswith((f"{each}.", f"{each}["))
    ]
    topic = topic_of(bag, max(topics, key=len) if topics else re.split(r"[.\[]", text)[0])
    rest = text[len(topic) :]
    if rest.endswith("[]"):
        raise UsageError(f"{text}: an index or slice is missing between the brackets")
    path = path_in(topic, rest.removeprefix("."))
    info = bag.topics[topic]
    if path.field in info.unreadable:
        raise UsageError(f"{topic}: {info.unreadable[path.field]}")
    is_parent = any(each.startswith(f"{path.field}.") for each in info.fields)
    if not info.may_have(path.field) and not is_parent:
        raise unknown_field(bag, path)
    return path


def path_in(topic: str, text: str) -> FieldPath:
    """Parse the path of a field in the messages of a topic."""
    steps = steps_of(text)
    # What follows a slice and a name selects within each element.
    if (
        not steps
        or isinstance(steps[-1], str)
        or any(is_mapped(steps, k) for k in range(len(steps)))
    ):
        return FieldPath(topic, path_text(steps), None)
    return FieldPath(topic, path_text(steps[:-1]), steps[-1])


def unknown_field(bag: Bag, path: FieldPath) -> UsageError:
    """Return the error that a type lacks a field, with the nearest fields."""
    info = bag.topics[path.topic]
    near = difflib.get_close_matches(path.field, info.fields, n=3, cutoff=0.4)
    return UsageError(
        f"{path.topic} ({info.type_name}) has no field '{path.field}'; nearest:"
        f" {', '.join(near or list(info.fields)[:8])}"
    )


def check_lacks(path: FieldPath, values: Sequence[Any], *, optional: bool) -> None:
    """Check that a field has a value in any message; `optional` permits arrays without elements."""
    lacks = [value for value in values if isinstance(value, Lack)]
    if not lacks or any(value is not None and not isinstance(value, Lack) for value in values):
        return
    longest = max(lacks, key=lambda lack: lack.length)
    if optional and longest.length == 0:
        return
    if longest.length < 0 or ABSENT in lacks:
        reason = ABSENT.reason if ABSENT in lacks else longest.reason
        raise UsageError(f"{path} has no value in any message: {reason}")
    raise UsageError(
        f"{path}: the longest array has {longest.length} elements; index 0 is the first"
    )


def as_numbers(column: NDArray[Any], name: str, *, is_filled: bool = False) -> Floats:
    """Return a column as float64 numbers (N,) or (N, K); bytes are numbers from 0 to 255."""
    if column.dtype.kind in "biuf":
        return column.astype(np.float64)
    rows = rows_of(column, name)
    shapes = {row.shape for row in rows if row is not None}
    if len(shapes) > 1:
        shapes -= {(0,)}
    if is_filled and len({shape[1:] for shape in shapes if shape}) == 1 and () not in shapes:
        shapes = {max(shapes)}
    elif len(shapes) > 1:
        raise _uneven(name, shapes)
    shape = next(iter(shapes), ())
    if not shape:
        return np.array([np.nan if row is None or not row.size else float(row) for row in rows])
    found = np.full((len(rows), *shape), np.nan)
    for out, row in zip(found, rows, strict=True):
        if row is not None:
            out[: len(row)] = row
    return found.reshape(len(rows), math.prod(shape))


def _uneven(name: str, shapes: set[tuple[int, ...]]) -> UsageError:
    if {len(shape) for shape in shapes} != {1}:
        return UsageError(
            f"{name} is not a number, or an array of the same length in all messages: shapes"
            f" {', '.join(map(str, sorted(shapes)[:4]))}"
        )
    few, many = min(shapes)[0], max(shapes)[0]
    return UsageError(
        f"{name} is not an array of the same length in all messages, but of {few} to {many}"
        f" elements: select elements that all have, such as [0:{few}], or set `pad`, or `pool`"
        " and `to`"
    )


def rows_of(column: NDArray[Any], name: str) -> list[Floats | None]:
    """Return the number or array of numbers of each message; None where it is missing."""
    rows = []
    for value in column:
        row = None if value is None else as_array(value)
        if row is None and value is not None:
            raise UsageError(f"{name} is not a number, {_kind(value)}")
        rows.append(row)
    return rows


def _kind(value: Any) -> str:
    """Return what a value is, and what to do."""
    if isinstance(value, str):
        return "but a text"
    if not isinstance(value, list | np.ndarray) or not len(value):
        return "but a message: choose one of its fields"
    if isinstance(value[0], str):
        return "but an array of texts"
    if isinstance(value[0], list | np.ndarray):
        return "but an array of arrays: choose one of them by an index, such as [0]"
    if value[0] is None or isinstance(value[0], bool | int | float):
        return "or an array of numbers"
    return "but an array of messages: choose a field of them, such as [0].FIELD or [:].FIELD"


def padded(rows: Sequence[Floats | None], count: int) -> Floats:
    """Return arrays cut to `count` elements, or filled with NaN, as (N, count)."""
    found = np.full((len(rows), count), np.nan)
    for out, row in zip(found, rows, strict=True):
        if row is not None:
            part = row.reshape(-1)[:count]
            out[: len(part)] = part
    return found


def pooled(rows: Sequence[Floats | None], kind: str, count: int) -> Floats:
    """Reduce arrays of any length M to `count` sectors, as (N, count).

    Sector k contains the elements from floor(k M / count) up to floor((k + 1) M / count), at least
    one. NaN is ignored. `min` and `max` are infinite if that is the smallest or largest element,
    and `mean` is that of the finite elements. A sector without numbers is NaN.
    """
    found = np.full((len(rows), count), np.nan)
    places: dict[int, list[int]] = {}
    for place, row in enumerate(rows):
        if row is not None and row.size:
            places.setdefault(row.size, []).append(place)
    for size, same in places.items():
        stacked = np.stack(
            [row.reshape(-1) for row in (rows[place] for place in same) if row is not None]
        )
        starts = np.arange(count) * size // count
        found[same] = _reduced(stacked, kind, starts)
    return found


def _reduced(values: Floats, kind: str, starts: NDArray[np.int64]) -> Floats:
    """Reduce the sectors of (N, M) values that begin at `starts` (K,), as (N, K)."""
    if kind != "mean":
        function = np.fmin if kind == "min" else np.fmax
        return np.asarray(function.reduceat(values, starts, axis=1))
    is_finite = np.isfinite(values)
    sums = np.add.reduceat(np.where(is_finite, values, 0.0), starts, axis=1)
    counts = np.add.reduceat(is_finite.astype(np.float64), starts, axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(sums / counts)


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

    Attributes:
        topic: Name of the topic.
        fields: Paths of the fields.
        time: Time of the messages.
    """

    def __init__(
        self, bag: Bag, topic: str, fields: Iterable[str], time: TimeSource | Stamp
    ) -> None:
        """Select the fields; nothing is read yet."""
        self.topic, self.time = topic, time
        self._bag, self._left_out = bag, np.empty(0, np.int64)
        self.fields = sorted(set(fields))
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
        if not self.fields and not stamp:
            times_ns = self._bag.times(self.topic)
            found = Stream(times_ns, {}, np.arange(len(times_ns)))
        else:
            found = self._bag.read(self.topic, sorted({*self.fields, *stamp}))
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
        return self._ns_of(self._stamp.select(found.columns[self._stamp.field]))

    def _ns_of(self, stamps: NDArray[Any]) -> NDArray[np.int64]:
        if stamps.dtype.kind in "iu":
            return stamps.astype(np.int64) * self._unit_ns
        return np.rint(stamps.astype(np.float64) * self._unit_ns).astype(np.int64)

    def time_of(self, message: Any, log_time_ns: int, publish_time_ns: int) -> int | None:
        """Return the time of a decoded message in nanoseconds; None if its stamp is not a time."""
        if self._stamp is None:
            return log_time_ns
        if self._stamp.field == _PUBLISH_TIME:
            return publish_time_ns
        path = path_text(self._stamp.steps)
        kinds = self._bag.topics[self.topic].fields
        stamp = column_of([value_at(message, path)], kind_at(kinds, path))
        is_usable = _is_time(stamp, self._unit_ns).all()
        return int(self._ns_of(stamp)[0]) if is_usable else None

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
