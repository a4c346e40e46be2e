"""Paths of fields in a bag, such as `/scan.ranges[0:360:10]`."""

from __future__ import annotations

import difflib
import re
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.bags.bag import Bag

_SUFFIX = re.compile(r"(.*?)\[(-?\d*)(?:(:)(-?\d*)(?::(-?\d*))?)?\]")


class FieldPath(NamedTuple):
    """Path of a field of a topic, with an optional index or slice.

    Attributes:
        topic: Name of the topic.
        field: Dotted path of the field in the message; empty for the message as a whole.
        elements: Index or slice of an array; None for the whole field.
    """

    topic: str
    field: str
    elements: int | slice | None

    def select(self, column: NDArray[Any]) -> NDArray[Any]:
        """Select elements of a column (N, K); without an index or slice, return the whole column.

        Raises:
            UsageError: The field is not an array, has no elements, or is shorter than the index.
        """
        if not len(column):
            return column
        found = self._selected(column)
        if not found.size:
            raise UsageError(f"{self}: no elements; the field has {column.shape[1]} elements")
        return found

    def _selected(self, column: NDArray[Any]) -> NDArray[Any]:
        if self.elements is None:
            return column
        if column.ndim != 2:
            raise UsageError(f"{self}: the field is not an array of equal length in all messages")
        if isinstance(self.elements, int) and not -column.shape[1] <= self.elements < len(column.T):
            raise UsageError(f"{self}: the field has {column.shape[1]} elements; index 0 is first")
        return column[:, self.elements]

    def __str__(self) -> str:
        """Return the path as it is written in a mapping."""
        found = self.elements
        if isinstance(found, slice):
            parts = [found.start, found.stop, *([found.step] if found.step else [])]
            return (
                f"{self.topic}.{self.field}[{':'.join('' if p is None else str(p) for p in parts)}]"
            )
        return f"{self.topic}.{self.field}" + ("" if found is None else f"[{found}]")


def topic_of(bag: Bag, name: str) -> str:
    """Return `name` if it is a readable topic of the bag.

    Raises:
        UsageError: There is no such topic, or its messages cannot be read.
    """
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
    match = _SUFFIX.fullmatch(text)
    name = match[1] if match else text
    elements = None if match is None else _elements(match)
    topics = [topic for topic in bag.topics if name == topic or name.startswith(f"{topic}.")]
    topic = topic_of(bag, max(topics, key=len) if topics else name.split(".")[0])
    field = name[len(topic) + 1 :]
    info = bag.topics[topic]
    if field in info.unreadable:
        raise UsageError(f"{topic}: {info.unreadable[field]}")
    known = {} if info.is_open else info.fields
    if known and field not in known and not any(each.startswith(f"{field}.") for each in known):
        near = difflib.get_close_matches(field, known, n=3, cutoff=0.4) or list(known)[:8]
        raise UsageError(
            f"{topic} ({info.type_name}) has no field '{field}'; nearest: {', '.join(near)}"
        )
    return FieldPath(topic, field, elements)


def _elements(match: re.Match[str]) -> int | slice:
    first, colon, stop, step = match[2], match[3], match[4], match[5]
    if not colon:
        if not first:
            raise UsageError(f"{match[0]}: an index or slice is missing between the brackets")
        return int(first)
    numbers = [int(part) if part else None for part in (first, stop or "", step or "")]
    if numbers[2] == 0:
        raise UsageError(f"{match[0]}: the step of a slice cannot be 0")
    return slice(*numbers)


def as_numbers(column: NDArray[Any], name: str) -> NDArray[np.float64]:
    """Return a column as float64 numbers (N,) or (N, K); bytes are numbers from 0 to 255.

    Raises:
        UsageError: The column has strings, or arrays of different lengths.
    """
    if column.dtype.kind in "biuf":
        return column.astype(np.float64)
    try:
        return np.array([_number(value) for value in column], np.float64)
    except (TypeError, ValueError) as error:
        raise UsageError(
            f"{name} is not a number, or an array of the same length in all messages"
        ) from error


def _number(value: Any) -> Any:
    if value is None:
        return np.nan
    if isinstance(value, bytes):
        return np.frombuffer(value, np.uint8)
    if isinstance(value, str):
        # NumPy would parse the text.
        raise TypeError
    return value
