"""Synthetic robots of many kinds, and writers of their bags in several formats."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import Writer
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START_NS = 1_700_000_000 * 10**9


class Topic(NamedTuple):
    """A topic: type, and the messages as times in seconds and nested dicts of the set fields."""

    name: str
    kind: str
    messages: list[tuple[float, dict[str, Any]]]


@dataclass
class Robot:
    """Topics of a robot, and the definitions of types that only it has, by name."""

    topics: list[Topic]
    types: dict[str, str] = field(default_factory=dict)

    def add(
        self, name: str, kind: str, rate_hz: float, message: Callable[[float], Any], **span: float
    ) -> Robot:
        """Add a topic with `message(t)` at a fixed rate, from 0 to 20 s unless `span` differs."""
        first, last = span.get("first_s", 0.0), span.get("last_s", 20.0)
        times = np.arange(first, last, 1 / rate_hz) + span.get("shift_s", 0.0)
        messages = [(t, message(t)) for t in times.tolist()]
        known = next((topic for topic in self.topics if topic.name == name), None)
        if known is None:
            self.topics.append(Topic(name, kind, messages))
        else:
            known.messages.extend(messages)
        return self


def _store(robot: Robot, *, is_ros1: bool) -> Any:
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    found: dict[str, Any] = {}
    for kind, text in {
        "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
        **robot.types,
    }.items():
        found |= get_types_from_msg(text, kind)
    store.register({kind: each for kind, each in found.items() if kind not in store.types})
    return store


def built(store: Any, kind: str, values: dict[str, Any]) -> Any:
    """Return a message; fields that are not given are zeros or empty."""
    parts = {
        name: _part(store, description, values.get(name))
        for name, description in store.fielddefs[kind][1]
    }
    return store.types[kind](**parts)


def _part(store: Any, description: Any, value: Any) -> Any:
    node, what = description
    if node == Nodetype.BASE:
        default = {"string": "", "bool": False}.get(what[0], 0)
        return default if value is None else value
    if node == Nodetype.NAME:
        return built(store, what, value or {})
    element, count = what
    given = value if value is not None else [None] * (count if node == Nodetype.ARRAY else 0)
    parts = [_part(store, element, each) for each in given]
    if element[0] == Nodetype.BASE and element[1][0] != "string":
        return np.array(parts, element[1][0])
    return parts


def _rows(robot: Robot, store: Any) -> Iterator[tuple[int, Topic, Any]]:
    rows = [(t, topic, values) for topic in robot.topics for t, values in topic.messages]
    for t, topic, values in sorted(rows, key=lambda row: row[0]):
        yield START_NS + round(t * 1e9), topic, built(store, topic.kind, values)


def write_mcap(robot: Robot, path: Path, *, short: bool = False) -> Path:
    """Write an MCAP file with CDR; with `short`, the type names are `pkg/Type`."""
    store = _store(robot, is_ros1=False)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = {}
        for topic in robot.topics:
            text = store.generate_msgdef(topic.kind, ros_version=2)[0]
            name = topic.kind.replace("/msg/", "/") if short else topic.kind
            schema = writer.register_schema(name, "ros2msg", text.encode())
            channels[topic.name] = writer.register_channel(topic.name, "cdr", schema)
        for time_ns, topic, message in _rows(robot, store):
            data = bytes(store.serialize_cdr(message, topic.kind))
            writer.add_message(channels[topic.name], time_ns, data, time_ns)
        writer.finish()
    return path


def write_short(robot: Robot, path: Path) -> Path:
    return write_mcap(robot, path, short=True)


def write_ros1_mcap(robot: Robot, path: Path) -> Path:
    """Write an MCAP file with ROS 1 messages, as after a conversion of a ROS 1 bag."""
    store = _store(robot, is_ros1=True)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros1")
        channels = {}
        for topic in robot.topics:
            text = store.generate_msgdef(topic.kind, ros_version=1)[0]
            name = topic.kind.replace("/msg/", "/")
            schema = writer.register_schema(name, "ros1msg", text.encode())
            channels[topic.name] = writer.register_channel(topic.name, "ros1", schema)
        for time_ns, topic, message in _rows(robot, store):
            data = bytes(store.serialize_ros1(message, topic.kind))
            writer.add_message(channels[topic.name], time_ns, data, time_ns)
        writer.finish()
    return path


def write_sqlite(robot: Robot, path: Path) -> Path:
    """Write a rosbag2 folder with a database."""
    store = _store(robot, is_ros1=False)
    folder = path.with_suffix("")
    with Writer2(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        channels = {
            topic.name: writer.add_connection(topic.name, topic.kind, typestore=store)
            for topic in robot.topics
        }
        for time_ns, topic, message in _rows(robot, store):
            data = store.serialize_cdr(message, topic.kind)
            writer.write(channels[topic.name], time_ns, data)
    return folder


def write_bag(robot: Robot, path: Path) -> Path:
    """Write a ROS 1 bag."""
    store, path = _store(robot, is_ros1=True), path.with_suffix(".bag")
    with Writer1(path) as writer:
        channels = {
            topic.name: writer.add_connection(topic.name, topic.kind, typestore=store)
            for topic in robot.topics
        }
        for time_ns, topic, message in _rows(robot, store):
            data = store.serialize_ros1(message, topic.kind)
            writer.write(channels[topic.name], time_ns, data)
    return path


def write_json(robot: Robot, path: Path, *, schema: bool = True) -> Path:
    """Write an MCAP file with the given fields as JSON objects, with or without a schema."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        rows = []
        for topic in robot.topics:
            text = _json_schema(topic.messages[0][1]) if schema and topic.messages else None
            number = 0
            if text is not None:
                number = writer.register_schema(topic.kind, "jsonschema", json.dumps(text).encode())
            channel = writer.register_channel(topic.name, "json", number)
            rows += [(t, channel, values) for t, values in topic.messages]
        for t, channel, values in sorted(rows, key=lambda row: row[:2]):
            data = json.dumps(values, default=float).encode()
            time_ns = START_NS + round(t * 1e9)
            writer.add_message(channel, time_ns, data, time_ns)
        writer.finish()
    return path


def write_plain_json(robot: Robot, path: Path) -> Path:
    return write_json(robot, path, schema=False)


def _json_schema(value: Any) -> dict[str, Any]:
    if isinstance(value, dict):
        parts = {name: _json_schema(each) for name, each in value.items()}
        return {"type": "object", "properties": parts}
    if isinstance(value, list):
        return {"type": "array", "items": _json_schema(value[0]) if value else {}}
    names = {bool: "boolean", int: "integer", float: "number", str: "string"}
    return {"type": names.get(type(value), "number")}


FORMATS = {
    "mcap": write_mcap,
    "short names": write_short,
    "ros1 mcap": write_ros1_mcap,
    "sqlite3": write_sqlite,
    "bag": write_bag,
}


def vector(x: float, y: float = 0.0, z: float = 0.0) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def odometry(t: float) -> dict[str, Any]:
    """Return odometry on a circle."""
    turn = {"x": 0.0, "y": 0.0, "z": math.sin(t / 20), "w": math.cos(t / 20)}
    pose = {"position": vector(math.sin(t), 1 - math.cos(t)), "orientation": turn}
    twist = {"linear": vector(1 + 0.1 * math.sin(t)), "angular": vector(0, 0, math.cos(t))}
    return {"pose": {"pose": pose}, "twist": {"twist": twist}}


def twist(t: float) -> dict[str, Any]:
    return {
        "linear": vector(0.35 + 0.31 * math.sin(t)),
        "angular": vector(0, 0, 0.7 * math.cos(2 * t)),
    }


def transform(parent: str, child: str, t: float) -> dict[str, Any]:
    turn = {"x": 0.0, "y": 0.0, "z": math.sin(t / 9), "w": math.cos(t / 9)}
    pose = {"translation": vector(t, -t), "rotation": turn}
    return {"header": {"frame_id": parent}, "child_frame_id": child, "transform": pose}
