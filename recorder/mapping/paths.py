"""Paths of fields in a bag, such as `/scan.ranges[0:360:10]`, and their values as numbers."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.bags.bag import Bag
from mcaprl.recorder.bags.path_steps import Step, is_mapped, path_text, steps_of
from mcaprl.recorder.bags.values import ABSENT, Lack, as_array, element_of, without_lacks

Floats = NDArray[np.float64]


class FieldPath(NamedTuple):
    """Path of a field of a topic, with an optional index or slice.

    Attributes:
        topic: Name of the topic.
        field: Path of the field in the message, see `bags.path_steps`; empty for the message as a
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
    """Resolve the path of a field. Its topic is the longest topic name that the text begins with.

    Raises:
        UsageError: There is no such topic or field; the message names the nearest ones.
    """
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
