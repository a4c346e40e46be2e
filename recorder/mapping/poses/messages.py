"""Transforms in the messages of ROS (TFMessage, TransformStamped) and Foxglove, in any encoding."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from mcaprl.errors import UsageError
from mcaprl.recorder.bags.bag import Bag, TopicInfo
from mcaprl.recorder.bags.decoders import value_at
from mcaprl.recorder.mapping.config import TimeSource

STATIC = "_static"
"""Suffix of the topic of static transforms."""
_TYPES = ("TFMessage", "tfMessage", "TransformStamped", "FrameTransform", "FrameTransforms")
_LIST, _CHILD = "transforms", "child_frame_id"
# Paths of parent, stamp, translation and rotation in a transform of ROS and of Foxglove.
_FORMS = (
    ("header.frame_id", "header.stamp", "transform.translation", "transform.rotation"),
    ("parent_frame_id", "timestamp", "translation", "rotation"),
)
_AXES = ("x", "y", "z", "w")
_BLOCK_MESSAGES = 4096
"""Number of messages that are decoded to objects at a time."""


class Transform(NamedTuple):
    """A transform of a message.

    Attributes:
        child: Name of the frame, without a leading `/`.
        parent: Name of its parent, without a leading `/`.
        time_ns: Time as the mapping wants it.
        place: Place of the message; see `Bag.places`.
        translation: Object or dict with x, y, z.
        rotation: Object or dict with x, y, z, w.
    """

    child: str
    parent: str
    time_ns: int
    place: Sequence[int]
    translation: Any
    rotation: Any

    def pose(self) -> list[float]:
        """Return position and quaternion x y z w; NaN for a number that is missing."""
        return [
            *(_number(self.translation, axis) for axis in _AXES[:3]),
            *(_number(self.rotation, axis) for axis in _AXES),
        ]


def are_transforms(info: TopicInfo) -> bool:
    """Return whether a topic has transforms, by the end of its name or by its type."""
    name = info.name.removesuffix(STATIC)
    return name.endswith("/tf") or info.type_name.replace(".", "/").rpartition("/")[2] in _TYPES


def transforms_of(bag: Bag, topic: str, time: TimeSource) -> Iterator[Transform]:
    """Yield the transforms of a topic in the order of recording.

    Transforms without a name of child or parent, and those of a frame in itself, are left out.
    """
    single, places = _fields_of_one(bag, topic), bag.places(topic)
    fields = [*(single or [_LIST]), *(["publish_time"] if time == "publish_time" else [])]
    for first in range(0, len(places), _BLOCK_MESSAGES):
        rows = np.arange(first, min(first + _BLOCK_MESSAGES, len(places)))
        stream = bag.read(topic, fields, rows)
        times_ns = stream.columns.get("publish_time", stream.log_time_ns)
        messages = _messages_of(stream.columns, single) if single else stream.columns[_LIST]
        for time_ns, place, message in zip(
            times_ns.tolist(), places[stream.rows].tolist(), messages, strict=True
        ):
            for each in message if isinstance(message, Iterable) else ():
                child = _field(each, _CHILD)
                form = _FORMS[0] if _field(each, "header") is not None else _FORMS[1]
                parent = value_at(each, form[0])
                if not (isinstance(child, str) and isinstance(parent, str)):
                    continue
                child, parent = child.removeprefix("/"), parent.removeprefix("/")
                if not child or not parent or child == parent:
                    continue
                own_ns = time_ns if time != "header" else _stamp(each, form[1], topic, child)
                parts = (value_at(each, path) for path in form[2:])
                yield Transform(child, parent, own_ns, place, *parts)


def _fields_of_one(bag: Bag, topic: str) -> list[str]:
    """Return the fields to read if each message is one transform; empty if it is a list of them."""
    known = list(bag.topics[topic].fields)
    if not known:
        # JSON without a schema.
        paths = [form[0] for form in _FORMS]
        first = bag.read(topic, [_CHILD, *paths], np.zeros(1, np.int64)).columns
        known = [name for name, column in first.items() if isinstance(column[0], str)]
    if _CHILD not in known:
        return []
    parent, stamp, translation, rotation = _FORMS[_FORMS[1][0] in known]
    axes = [f"{translation}.{axis}" for axis in _AXES[:3]]
    return [_CHILD, parent, stamp, *axes, *(f"{rotation}.{axis}" for axis in _AXES)]


def _messages_of(columns: dict[str, Any], fields: list[str]) -> Iterator[list[dict[str, Any]]]:
    """Yield messages of one transform each, as lists of nested dicts."""
    for values in zip(*(columns[name].tolist() for name in fields), strict=True):
        message: dict[str, Any] = {}
        for path, value in zip(fields, values, strict=True):
            *groups, name = path.split(".")
            inner = message
            for group in groups:
                inner = inner.setdefault(group, {})
            inner[name] = value
        yield [message]


def _field(message: Any, name: str) -> Any:
    return message.get(name) if isinstance(message, dict) else getattr(message, name, None)


def _stamp(message: Any, path: str, topic: str, child: str) -> int:
    found = value_at(message, path)
    if not isinstance(found, int):
        raise UsageError(
            f"{topic}: a transform of frame '{child}' has no {path}: use `time: log_time`"
        )
    return found


def _number(parts: Any, axis: str) -> float:
    try:
        return float(_field(parts, axis))
    except (TypeError, ValueError):
        return math.nan
