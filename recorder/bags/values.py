"""Values of fields in decoded messages, and their conversion to columns.

The path of a field is a sequence of steps: `twist.linear.x`, `points[0].positions`. A step is the
name of a field or the key of a map (`values[left]`, in quotes if it contains other characters:
`values["a.b"]`), an index of an array (`[3]`, `[-1]`), or a slice (`[0:12]`, `[::10]`, `[:]` or
`[]`). The steps after `slice.name` apply to each selected element: `motors[0:12].q` is the vector
of the `q` of twelve motors. An index directly after a slice selects one of the selected elements.
`PATH[@]` is the list of the names of the elements of `PATH`; see `values.names_of`.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError

Step = str | int | slice
"""Name of a field or key of a map, index, or slice."""

NAMES = "[@]"
"""Suffix of the path of the names of a field's elements."""
_MAX_STEPS = 64
# A name, or brackets with a quoted key or anything else.
_STEP = re.compile(r"""\.?([^.\[\]]+)|\[(?:"([^"]*)"|'([^']*)'|([^\[\]]*))\]""")
_SLICE = re.compile(r"(-?\d{0,18}):(-?\d{0,18})(?::(-?\d{0,18}))?")
_INDEX = re.compile(r"-?\d+")
_INDEX_DIGITS = 18


@lru_cache(maxsize=1024)
def steps_of(path: str) -> tuple[Step, ...]:
    """Parse the path of a field."""
    steps: list[Step] = []
    place = 0
    while place < len(path):
        match = _STEP.match(path, place)
        # A dot is between a step and a name, and nowhere else.
        if match is None or (match[1] is not None and (path[place] == ".") != bool(steps)):
            raise UsageError(f"'{path[:200]}' is not a path of a field, see '{path[place:][:20]}'")
        steps.append(_step(match))
        place = match.end()
    if len(steps) > _MAX_STEPS:
        raise UsageError(f"'{path[:40]}...' has {len(steps)} steps; at most {_MAX_STEPS}")
    return tuple(steps)


def _step(match: re.Match[str]) -> Step:
    name, quoted, other, text = match.groups()
    for key in (name, quoted, other):
        if key is not None:
            return str(key)
    if _INDEX.fullmatch(text):
        if len(text.lstrip("-")) > _INDEX_DIGITS:
            raise UsageError(f"the index [{text[:20]}...] has {len(text)} digits")
        return int(text)
    if not text:
        return slice(None)
    found = _SLICE.fullmatch(text)
    if found is None:
        return str(text)
    numbers = [int(part) if part else None for part in found.groups()]
    if numbers[2] == 0:
        raise UsageError(f"[{text}]: the step of a slice cannot be 0")
    return slice(*numbers)


def path_text(steps: Sequence[Step]) -> str:
    """Return the steps as a path; the inverse of `steps_of`."""
    found = ""
    for step in steps:
        if isinstance(step, slice):
            parts = [step.start, step.stop, *([step.step] if step.step else [])]
            found += f"[{':'.join('' if part is None else str(part) for part in parts)}]"
        elif isinstance(step, int):
            found += f"[{step}]"
        elif not step or re.search(r"[.\[\]]", step):
            quote = "'" if '"' in step else '"'
            found += f"[{quote}{step}{quote}]"
        else:
            found += f"{'.' if found else ''}{step}"
    return found


def is_mapped(steps: Sequence[Step], number: int) -> bool:
    """Return whether a step is a slice, and the steps after it apply to each element."""
    after = steps[number + 1 : number + 2]
    return isinstance(steps[number], slice) and bool(after) and isinstance(after[0], str)


def general_path(path: str) -> str:
    """Return a path as it is in `TopicInfo.fields`: `motors[].q` for `motors[3].q`."""
    steps = list(steps_of(path.removesuffix(NAMES)))
    while steps and not isinstance(steps[-1], str):
        steps.pop()
    found = ""
    for step in steps:
        found += f"{'.' if found else ''}{step}" if isinstance(step, str) else "[]"
    return found


def kind_at(fields: Mapping[str, str], path: str) -> str:
    """Return the kind of the values of a path by `TopicInfo.fields`; empty if unknown.

    The kind of a field in the elements of arrays has a `[]` for each of these arrays.
    """
    steps = steps_of(path)
    are_several = any(is_mapped(steps, number) for number in range(len(steps)))
    if path.endswith(NAMES) or are_several or not steps or not isinstance(steps[-1], str):
        return ""
    general = general_path(path)
    return fields.get(general, "").removesuffix("[]" * general.count("[]"))


NUMBERS = (
    "int",
    "uint",
    "float",
    "double",
    "bool",
    "byte",
    "char",
    "sint",
    "fixed",
    "sfixed",
    "enum",
)
"""Kinds of numbers, without their sizes."""

_NS_PER_S = 10**9
# Names of the parts of a time in ROS 2, protobuf, Foxglove's JSON, and JSON of ROS 1.
_TIMES = (("sec", "nanosec"), ("seconds", "nanos"), ("sec", "nsec"), ("secs", "nsecs"))
_INT64 = np.iinfo(np.int64)
_WHOLE, _MAX_DIGITS = re.compile(r"-?\d{1,19}"), 20
PARALLEL = ("name", "names", "joint_names", "joint_name", "interface_names")
"""Arrays of names beside an array of values, or in a message that contains it."""
_OWN = ("name", "joint_name", "interface_name", "child_frame_id", "key")
"""Fields with the name of an element of an array of messages."""
_ENTRY = ("key", "value")
"""Fields of an entry of a map that is recorded as an array."""


@dataclass(frozen=True)
class Lack:
    """Marker of a value that a message does not have.

    Attributes:
        reason: Why, as the end of a sentence about the field.
        length: Number of elements of the array that lacks an index; -1 if this is not the reason.
    """

    reason: str
    length: int = -1


ABSENT = Lack("the message has no such key")
"""Marker of a key that a message omits: the message is not an update of the field."""


def value_at(message: Any, path: str) -> Any:
    """Return a field of a decoded message by its path.

    Times and durations are converted to nanoseconds. Elements that a slice and a name select are an
    array with one axis for each slice, NaN where an element lacks the value.

    Returns:
        Value; None if it is missing, `ABSENT` if the message omits the key, or another `Lack` if an
        array has no such element.
    """
    if path.endswith(NAMES):
        return names_of(message, path.removesuffix(NAMES))
    return _walked(message, steps_of(path))


def _walked(value: Any, steps: Sequence[Step]) -> Any:
    for number, step in enumerate(steps):
        if isinstance(step, str):
            is_array = _is_array(value)
            if is_array and not _are_entries(value, step):
                return _joined([_walked(each, steps[number:]) for each in value])
            value = _entry_of(value, step) if is_array else _member(value, step)
        else:
            value = element_of(value, step)
            if is_mapped(steps, number) and not isinstance(value, Lack):
                return _joined([_walked(each, steps[number + 1 :]) for each in value])
        if value is None or isinstance(value, Lack):
            return value
    return _nanoseconds(value)


def _is_array(value: Any) -> bool:
    kind: Any = type(value)
    return _are_arrays(kind)


# Checks of abstract types take most of the time of reading a field.
@lru_cache(maxsize=1024)
def _are_arrays(kind: type) -> bool:
    is_plain = issubclass(kind, list | np.ndarray)
    return is_plain or (issubclass(kind, Sequence) and not issubclass(kind, str))


@lru_cache(maxsize=1024)
def _are_maps(kind: type) -> bool:
    return issubclass(kind, Mapping)


def _member(value: Any, name: str) -> Any:
    if isinstance(value, dict):
        return value.get(name, ABSENT)
    kind: Any = type(value)
    if _are_maps(kind):
        return _entry(value, name)
    return None if name.startswith("__") else getattr(value, name, None)


def _entry(value: Mapping[Any, Any], key: str | int) -> Any:
    """Return the value of a key of a map, which may be a number or a text."""
    for each in (key, *([int(key)] if isinstance(key, str) and _WHOLE.fullmatch(key) else [])):
        try:
            # Reading a key that a protobuf map of messages lacks would add it.
            if each in value:
                return value[each]
        # Keys of protobuf maps have one type.
        except (TypeError, ValueError, OverflowError):
            continue
    return ABSENT


def _are_entries(array: Any, name: str) -> bool:
    """Return whether the elements of an array are entries with a key and a value, as of a map."""
    if name in _ENTRY or not len(array) or _is_number(array[0]) or isinstance(array[0], str):
        return False
    return all(_is_present(_member(array[0], part)) for part in _ENTRY)


def _entry_of(array: Any, key: str) -> Any:
    """Return the value of the entry with a key."""
    for each in array:
        found = _member(each, "key")
        if found == key or (_is_number(found) and str(found) == key):
            return _member(each, "value")
    return ABSENT


def _is_present(value: Any) -> bool:
    return value is not None and not isinstance(value, Lack)


def element_of(value: Any, index: int | slice) -> Any:
    """Return an element, or several, of an array or map; a `Lack` if there is no such element."""
    if isinstance(index, slice):
        return value[index] if _is_array(value) else Lack("it is not an array")
    if isinstance(value, Mapping):
        found = _entry(value, index)
        return _entry(value, str(index)) if found is ABSENT else found
    if not _is_array(value):
        return Lack("it is not an array")
    count = len(value)
    if not -count <= index < count:
        return Lack("the array has no such element", count)
    return value[index]


def _joined(parts: list[Any]) -> Any:
    """Return the values of several elements as one array; texts, and what has no shape, as a list.

    Elements that have no value are NaN, or None among texts.
    """
    values = [None if isinstance(part, Lack) else part for part in parts]
    found = [value for value in values if value is not None]
    if not all(_is_number(value) or _is_array(value) for value in found):
        return values
    arrays = [as_array(value) for value in found]
    shapes = {array.shape for array in arrays if array is not None}
    if len(shapes) > 1 or any(array is None for array in arrays):
        return values
    joined = np.full((len(values), *next(iter(shapes), ())), np.nan)
    rows = [row for row, value in enumerate(values) if value is not None]
    if rows:
        joined[rows] = np.stack([array for array in arrays if array is not None])
    return joined


def as_array(value: Any) -> NDArray[np.float64] | None:
    """Return a number, an array of numbers, or bytes as float64; None for anything else."""
    if isinstance(value, bytes | bytearray | memoryview):
        return np.frombuffer(value, np.uint8).astype(np.float64)
    if isinstance(value, np.ndarray):
        return value.astype(np.float64) if value.dtype.kind in "biuf" else None
    if _is_number(value):
        return np.array(_float(value))
    if isinstance(value, str | Mapping) or not _is_array(value):
        return None
    elements = [math.nan if each is None else each for each in value]
    if not all(_is_number(each) for each in elements):
        return None
    try:
        return np.array(elements, np.float64)
    except OverflowError:
        return np.array([_float(each) for each in elements])


def _is_number(value: Any) -> bool:
    return isinstance(value, bool | int | float | np.number | np.bool_)


def _float(value: Any) -> float:
    """Return a number as float; an integer that is too large is infinite."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def names_of(message: Any, path: str) -> list[str] | None:
    """Return the names of the elements of a field in a message; None if they have none.

    An element that omits the field has the name ''.

    The names of the elements of an array are the strings of a parallel array, `name` or
    `joint_names` for example, in the message that contains the array or one that contains this
    message. If the elements are messages, they may contain their names themselves. The names of
    arrays in arrays are joined, as in `hip/position`.
    """
    return _names(message, steps_of(path), [])


def _names(value: Any, steps: Sequence[Step], parents: list[Any]) -> list[str] | None:
    """Return the names below `value`; `parents` are the messages that contain it, the last first.

    The parents end at the array whose elements a slice selects.
    """
    for number, step in enumerate(steps):
        if value is None or isinstance(value, Lack):
            return None
        after = steps[number + 1 :]
        if isinstance(step, str):
            if _is_array(value):
                return _names(value, (slice(None), *steps[number:]), parents)
            parents, value = [value, *parents], _member(value, step)
            continue
        if not _is_array(value):
            value = element_of(value, step) if isinstance(step, int) else None
            continue
        names = _element_names(value, parents)
        if isinstance(step, int):
            value = element_of(value, step)
            inner = _names(value, after, parents)
            if inner is not None or isinstance(value, Lack):
                return inner
            name = names[step]
            return None if name is None else [name]
        if not is_mapped(steps, number):
            if None not in names:
                return _names_within([str(name) for name in names[step]], after)
            value = value[step]
            continue
        return _combined(
            [
                ("" if _walked(each, after) is ABSENT else name, _names(each, after, []))
                for each, name in zip(value[step], names[step], strict=True)
            ]
        )
    if not _is_array(value):
        return None
    names = _element_names(value, parents)
    return None if None in names or not names else [str(name) for name in names]


def _names_within(names: list[str], steps: Sequence[Step]) -> list[str] | None:
    """Return the names that further indexes and slices select."""
    found = _walked(names, steps)
    if isinstance(found, str):
        return [found]
    return found if isinstance(found, list) else None


def _combined(parts: list[tuple[str | None, list[str] | None]]) -> list[str] | None:
    """Join the name of each element with the names in it."""
    found: list[str] = []
    for name, inner in parts:
        if inner is not None:
            found += inner if name is None else [f"{name}/{each}" for each in inner]
        elif name is not None:
            found.append(name)
        else:
            return None
    return found


def _element_names(array: Any, parents: list[Any]) -> list[str | None]:
    """Return the name of each element of an array; None where it has none."""
    names = _beside(array, parents)
    if names or not len(array):
        return names
    if _own(array[0]) is None:
        return [None] * len(array)
    return [_own(each) for each in array]


def _beside(array: Any, parents: list[Any]) -> list[str | None]:
    """Return the names in the nearest array of names that is parallel to an array, or nothing."""
    for parent in parents:
        for key in PARALLEL:
            names = texts_of(_member(parent, key))
            if names is not None and names and len(names) == len(array):
                return list(names)
    return []


def _own(element: Any) -> str | None:
    """Return the name that an element of an array contains; None if there is none."""
    if element is None or _is_number(element) or isinstance(element, str) or _is_array(element):
        return None
    for key in _OWN:
        name = _member(element, key)
        if isinstance(name, str):
            return name
    return None


def texts_of(value: Any) -> list[str] | None:
    """Return an array of strings as a list; None for anything else."""
    if not _is_array(value):
        return None
    found = list(value)
    return found if all(isinstance(each, str) for each in found) else None


def _nanoseconds(value: Any) -> Any:
    """Convert a time to nanoseconds; return any other value unchanged."""
    if isinstance(value, int | float | str | bytes | list | np.ndarray | np.generic):
        return value
    for second, rest in _TIMES:
        if isinstance(value, dict):
            if value.keys() == {second, rest}:
                return _sum_ns(value[second], value[rest])
        elif hasattr(value, second) and hasattr(value, rest):
            return _sum_ns(getattr(value, second), getattr(value, rest))
    return value


def _sum_ns(second: Any, rest: Any) -> Any:
    """Return seconds and nanoseconds in nanoseconds; a `Lack` if they are not an int64 number."""
    try:
        whole_ns = _whole(second, _NS_PER_S) + _whole(rest, 1)
    # An infinite number overflows.
    except (TypeError, ValueError, OverflowError):
        return Lack("it is not a time")
    return whole_ns if _INT64.min <= whole_ns <= _INT64.max else Lack("it is not a time")


def _whole(value: Any, factor: int) -> int:
    """Return the product of a number, or the digits of one as in the JSON form of protobuf."""
    if isinstance(value, str) and len(value) > _MAX_DIGITS:
        raise ValueError("too many digits")
    if isinstance(value, float):
        seconds = math.floor(value)
        return seconds * factor + round((value - seconds) * factor)
    return int(value) * factor


def are_bytes(kind: str) -> bool:
    """Return whether the values of a kind of field are bytes; see `bag.TopicInfo`."""
    return kind == "bytes" or kind.startswith(("uint8[", "byte[", "octet["))


def column_of(values: Sequence[Any], kind: str) -> NDArray[Any]:
    """Return the values of a field as a column; see `bag.Stream`.

    If all messages lack the field, and not just because they omit a key, the column contains the
    `Lack` objects. A time that a message lacks makes the column float64, with NaN.
    """
    values = [converted(value, kind) for value in values]
    plain = [None if isinstance(value, Lack) else value for value in values]
    if any(value is not None for value in plain):
        return _column(plain)
    is_lacking = any(isinstance(value, Lack) and value is not ABSENT for value in values)
    return _objects(values) if is_lacking else _column(plain)


def converted(value: Any, kind: str) -> Any:
    """Return a value as its kind of field needs it: bytes as bytes, and times as integers."""
    if are_bytes(kind):
        return _bytes_of(value)
    return _time_of(value) if kind == "time" else value


def _column(values: list[Any]) -> NDArray[Any]:
    if all(isinstance(value, bool | int | np.integer | np.bool_) for value in values):
        found = np.array(values) if values else np.empty(0)
        return found if found.dtype.kind in "biuf" else np.array([_float(each) for each in values])
    if all(value is None or _is_number(value) for value in values):
        return np.array([math.nan if value is None else _float(value) for value in values])
    if any(value is None or isinstance(value, str | bytes | Mapping) for value in values):
        return _objects(values)
    return _vectors(values)


def _vectors(values: Sequence[Any]) -> NDArray[Any]:
    """Return arrays of K numbers as one (N, K) array, and all other values as objects."""
    try:
        arrays = [np.asarray(value) for value in values]
    except (ValueError, TypeError):
        return _objects(values)
    shapes = {array.shape for array in arrays}
    # Arrays that slices select may have several axes. Lists of lists in messages are no vectors.
    are_vectors = all(
        each.dtype.kind in "biuf" and (each.ndim == 1 or isinstance(value, np.ndarray))
        for each, value in zip(arrays, values, strict=True)
    )
    if len(shapes) == 1 and arrays[0].ndim and are_vectors:
        return np.stack(arrays).reshape(len(arrays), -1)
    return _objects(values)


def _bytes_of(value: Any) -> Any:
    """Return bytes, of base64 text in JSON; a `Lack` if the value is something else."""
    if value is None or isinstance(value, Lack | bytes):
        return value
    try:
        if isinstance(value, str):
            return base64.b64decode("".join(value.split()), validate=True)
        if _is_array(value) or isinstance(value, bytearray | memoryview):
            return bytes(value)
    except (TypeError, ValueError):
        pass
    return Lack("it is not bytes")


def _time_of(value: Any) -> Any:
    if value is None or isinstance(value, Lack):
        return value
    is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return value if is_whole and _INT64.min <= value <= _INT64.max else Lack("it is not a time")


def without_lacks(values: Iterable[Any]) -> NDArray[Any]:
    """Return values as an object column, with None where a message lacks the value."""
    return _objects([None if isinstance(value, Lack) else value for value in values])


def _objects(values: Sequence[Any]) -> NDArray[Any]:
    # An assignment of arrays of equal length to a slice would be broadcast.
    return np.fromiter(values, object, len(values))
