"""Bags in all formats with the same messages, which contain arrays of messages and of names."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

Message = dict[str, Any]

descriptor_pb2, descriptor_pool, message_factory = (
    importlib.import_module(f"google.protobuf.{name}")
    for name in ("descriptor_pb2", "descriptor_pool", "message_factory")
)

SECOND_NS = 10**9
TEXT = """\
demo_msgs/Motor[] motors
string[] joint_names
float64[] position
demo_msgs/Point[] points
float32[] ranges
float64 command
================================================================================
MSG: demo_msgs/Motor
string name
float64 q
float64[] pos
================================================================================
MSG: demo_msgs/Point
float64[] positions
"""
EMPTY: Message = {
    "motors": [],
    "joint_names": [],
    "position": [],
    "points": [],
    "ranges": [],
    "command": 0.0,
}


def motors(*values: tuple[str, float]) -> list[Message]:
    """Return motors with names and values; `pos` of each is the value and its negative."""
    return [{"name": name, "q": q, "pos": [q, -q]} for name, q in values]


def _whole(messages: Sequence[Message]) -> list[Message]:
    return [{**EMPTY, **message} for message in messages]


def _ros(path: Path, messages: Sequence[Message], *, kind: str) -> Path:
    store: Any = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(TEXT, "demo_msgs/msg/Low"))
    low, motor, point = (store.types[f"demo_msgs/msg/{name}"] for name in ("Low", "Motor", "Point"))
    plugin = StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP
    writer: Any = (
        Writer1(path) if kind == "ros1" else Writer2(path, version=9, storage_plugin=plugin)
    )
    serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    with writer:
        connection = writer.add_connection("/low", low.__msgtype__, typestore=store)
        for step, message in enumerate(_whole(messages)):
            found = low(
                motors=[
                    motor(each["name"], each["q"], np.array(each["pos"], np.float64))
                    for each in message["motors"]
                ],
                joint_names=message["joint_names"],
                position=np.array(message["position"], np.float64),
                points=[
                    point(np.array(each["positions"], np.float64)) for each in message["points"]
                ],
                ranges=np.array(message["ranges"], np.float32),
                command=message["command"],
            )
            writer.write(connection, step * SECOND_NS, serialize(found, low.__msgtype__))
    return path


def _field(message: Any, name: str, number: int, kind: str, *, repeated: bool = False) -> None:
    types = {"double": 1, "float": 2, "string": 9}
    field = message.field.add(name=name, number=number, label=3 if repeated else 1)
    if kind in types:
        field.type = types[kind]
    else:
        field.type, field.type_name = 11, f".demo.{kind}"


def _file_of_types() -> Any:
    file = descriptor_pb2.FileDescriptorProto(name="low.proto", package="demo", syntax="proto3")
    motor, point, low = (file.message_type.add(name=name) for name in ("Motor", "Point", "Low"))
    _field(motor, "name", 1, "string")
    _field(motor, "q", 2, "double")
    _field(motor, "pos", 3, "double", repeated=True)
    _field(point, "positions", 1, "double", repeated=True)
    _field(low, "motors", 1, "Motor", repeated=True)
    _field(low, "joint_names", 2, "string", repeated=True)
    _field(low, "position", 3, "double", repeated=True)
    _field(low, "points", 4, "Point", repeated=True)
    _field(low, "ranges", 5, "float", repeated=True)
    _field(low, "command", 6, "double")
    entry = low.nested_type.add(name="GainsEntry")
    entry.options.map_entry = True
    _field(entry, "key", 1, "string")
    _field(entry, "value", 2, "double")
    _field(low, "gains", 7, "Low.GainsEntry", repeated=True)
    return descriptor_pb2.FileDescriptorSet(file=[file])


def _written(
    path: Path, name: str, schema: tuple[str, bytes], encoding: str, rows: list[bytes]
) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        number = writer.register_schema(name, *schema) if schema[0] else 0
        channel = writer.register_channel("/low", encoding, number)
        for step, data in enumerate(rows):
            writer.add_message(channel, step * SECOND_NS, data, step * SECOND_NS)
        writer.finish()
    return path


def _protobuf(path: Path, messages: Sequence[Message]) -> Path:
    types = _file_of_types()
    pool = descriptor_pool.DescriptorPool()
    pool.Add(types.file[0])
    low = message_factory.GetMessageClass(pool.FindMessageTypeByName("demo.Low"))
    rows = [low(**message).SerializeToString() for message in messages]
    return _written(path, "demo.Low", ("protobuf", types.SerializeToString()), "protobuf", rows)


def write_json(path: Path, messages: Sequence[Message], schema: Message | None = None) -> Path:
    """Write messages as they are in JSON, with or without a schema."""
    rows = [json.dumps(message).encode() for message in messages]
    text = ("", b"") if schema is None else ("jsonschema", json.dumps(schema).encode())
    return _written(path, "Low", text, "json", rows)


_NUMBERS = {"type": "array", "items": {"type": "number"}}
SCHEMA: Message = {
    "type": "object",
    "properties": {
        "motors": {"type": "array", "items": {"type": "object"}},
        "joint_names": {"type": "array", "items": {"type": "string"}},
        "position": _NUMBERS,
        "points": {"type": "array", "items": {"type": "object"}},
        "ranges": _NUMBERS,
        "command": {"type": "number"},
    },
}

FORMATS: dict[str, Callable[[Path, Sequence[Message]], Path]] = {
    "ROS 2": lambda folder, messages: _ros(folder / "bag", messages, kind="mcap"),
    "sqlite3": lambda folder, messages: _ros(folder / "bag", messages, kind="sqlite3"),
    "ROS 1": lambda folder, messages: _ros(folder / "one.bag", messages, kind="ros1"),
    "protobuf": lambda folder, messages: _protobuf(folder / "low.mcap", messages),
    "JSON with schema": lambda folder, messages: write_json(
        folder / "low.mcap", _whole(messages), SCHEMA
    ),
    "JSON": lambda folder, messages: write_json(folder / "low.mcap", _whole(messages)),
}
"""Function that writes messages of `/low`, one each second, to a folder, by format."""
