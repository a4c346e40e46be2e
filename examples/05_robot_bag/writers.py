"""Writers of messages: ROS 2 bags by rosbags, protobuf and JSON logs by foxglove-sdk."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
from google.protobuf import descriptor_pb2, json_format, message_factory
from robot import TYPES
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

Field = descriptor_pb2.FieldDescriptorProto
Write = Callable[[str, int, dict[str, Any]], None]
"""Function called with the topic, the time in nanoseconds and the content of a message."""

_STORE = get_typestore(Stores.ROS2_HUMBLE)
_KINDS = {
    "bool": Field.TYPE_BOOL,
    "byte": Field.TYPE_UINT32,
    "float32": Field.TYPE_FLOAT,
    "float64": Field.TYPE_DOUBLE,
    "int32": Field.TYPE_INT32,
    "string": Field.TYPE_STRING,
    "uint8": Field.TYPE_UINT32,
    "uint32": Field.TYPE_UINT32,
}


@contextmanager
def ros2_bag(folder: Path) -> Iterator[Write]:
    """Write a ROS 2 bag in MCAP, with compressed chunks."""
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=_STORE)
            for topic, kind in TYPES.items()
        }

        def write(topic: str, time_ns: int, content: dict[str, Any]) -> None:
            message = _ros_message(TYPES[topic], content)
            writer.write(connections[topic], time_ns, _STORE.serialize_cdr(message, TYPES[topic]))

        yield write


@contextmanager
def json_log(path: Path) -> Iterator[Write]:
    """Write an MCAP file of JSON messages without schemas; bytes are base64."""
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        channels = {
            topic: foxglove.Channel(topic, message_encoding="json", context=context)
            for topic in TYPES
        }

        def write(topic: str, time_ns: int, content: dict[str, Any]) -> None:
            text = json.dumps(content, default=_base64)
            channels[topic].log(text.encode(), log_time=time_ns)

        yield write


@contextmanager
def protobuf_log(path: Path) -> Iterator[Write]:
    """Write an MCAP file of protobuf messages, with the fields of the ROS types."""
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        descriptors, kinds = _protobuf_types()
        channels = {}
        for topic, kind in kinds.items():
            name = kind.DESCRIPTOR.full_name
            schema = foxglove.Schema(name=name, encoding="protobuf", data=descriptors)
            channels[topic] = foxglove.Channel(
                topic, schema=schema, message_encoding="protobuf", context=context
            )

        def write(topic: str, time_ns: int, content: dict[str, Any]) -> None:
            plain = json.loads(json.dumps(content, default=_base64))
            message = json_format.ParseDict(plain, kinds[topic]())
            channels[topic].log(message.SerializeToString(), log_time=time_ns)

        yield write


WRITERS: dict[str, Callable[[Path], AbstractContextManager[Write]]] = {
    "ros2": ros2_bag,
    "protobuf": protobuf_log,
    "json": json_log,
}


def _base64(value: bytes) -> str:
    return base64.b64encode(value).decode()


def _ros_message(kind: str, content: dict[str, Any]) -> Any:
    """Return a message of rosbags; fields that are not in `content` are zero."""
    _, fields = _STORE.fielddefs[kind]
    values = {name: _ros_value(node, content.get(name)) for name, node in fields}
    return _STORE.types[kind](**values)


def _ros_value(node: Any, value: Any) -> Any:
    sort, what = node
    if sort == Nodetype.NAME:
        return _ros_message(what, value or {})
    if sort == Nodetype.BASE:
        empty = "" if what[0] == "string" else 0
        return empty if value is None else value
    (item_sort, item), length = what
    if item_sort == Nodetype.NAME:
        return [_ros_message(item, part) for part in value or []]
    if item[0] == "string":
        return list(value or [])
    if isinstance(value, bytes):
        return np.frombuffer(value, item[0])
    return np.zeros(length, item[0]) if value is None else np.array(value, item[0])


def _protobuf_types() -> tuple[bytes, dict[str, Any]]:
    """Return the serialized descriptors of all types, and the message class of each topic."""
    file = descriptor_pb2.FileDescriptorProto(name="robot.proto", package="robot", syntax="proto3")
    for kind in TYPES.values():
        _describe(file, kind)
    files = descriptor_pb2.FileDescriptorSet(file=[file])
    found = message_factory.GetMessages([file])
    classes = {topic: found[f"robot.{_short(kind)}"] for topic, kind in TYPES.items()}
    return files.SerializeToString(), classes


def _describe(file: descriptor_pb2.FileDescriptorProto, kind: str) -> None:
    """Add a ROS type and the types of its fields to a protobuf file."""
    if any(message.name == _short(kind) for message in file.message_type):
        return
    message = file.message_type.add(name=_short(kind))
    for number, (name, (sort, what)) in enumerate(_STORE.fielddefs[kind][1], 1):
        field = message.field.add(name=name, number=number, label=Field.LABEL_OPTIONAL)
        if sort in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            (sort, what), _ = what
            if what[0] != "uint8":
                field.label = Field.LABEL_REPEATED
                field.type = Field.TYPE_MESSAGE if sort == Nodetype.NAME else _KINDS[what[0]]
            else:
                field.type = Field.TYPE_BYTES
        elif sort == Nodetype.BASE:
            field.type = _KINDS[what[0]]
        if sort == Nodetype.NAME:
            field.type, field.type_name = Field.TYPE_MESSAGE, f".robot.{_short(what)}"
            _describe(file, what)


def _short(kind: str) -> str:
    return kind.rpartition("/")[2]
