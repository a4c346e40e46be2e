"""Bags in all formats with the same messages, written by other libraries."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START_NS = 1_700_000_000 * 10**9
STEP_NS = 100_000_000
STEPS = 12
IMAGE_SHAPE = (4, 6)

STORE1, STORE2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"
STORE1.register(get_types_from_msg(_TRANSFORMS, "tf2_msgs/msg/TFMessage"))


def speed(step: int) -> float:
    """Return the speed in the odometry of a step."""
    return 0.5 * step


def turn(step: int) -> float:
    """Return the angular velocity of the command of a step."""
    return (-1.0) ** step


def messages(store: Any) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, time and message of odometry, commands, scans, images and transforms."""
    types = store.types
    is_ros1 = store is STORE1
    extra = {"seq": 7} if is_ros1 else {}

    def header(time_ns: int, frame: str) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](time_ns // 10**9, time_ns % 10**9)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **extra)

    def vector(x: float, y: float, z: float) -> Any:
        return types["geometry_msgs/msg/Vector3"](x, y, z)

    for step in range(STEPS):
        time_ns = START_NS + step * STEP_NS
        yaw = 0.1 * step
        rotation = types["geometry_msgs/msg/Quaternion"](
            0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)
        )
        place = types["geometry_msgs/msg/Point"](float(step), -1.0, 0.0)
        pose = types["geometry_msgs/msg/Pose"](place, rotation)
        zeros = np.zeros(36)
        twist = types["geometry_msgs/msg/Twist"](
            vector(speed(step), 0.0, 0.0), vector(0.0, 0.0, 0.1)
        )
        yield (
            "/odom",
            time_ns,
            types["nav_msgs/msg/Odometry"](
                header=header(time_ns - 1000, "odom"),
                child_frame_id="base",
                pose=types["geometry_msgs/msg/PoseWithCovariance"](pose, zeros + step),
                twist=types["geometry_msgs/msg/TwistWithCovariance"](twist, zeros),
            ),
        )
        transform = types["geometry_msgs/msg/Transform"](vector(float(step), -1.0, 0.0), rotation)
        stamped = types["geometry_msgs/msg/TransformStamped"](
            header(time_ns, "odom"), "base", transform
        )
        yield "/tf", time_ns, types["tf2_msgs/msg/TFMessage"]([stamped])
        command = types["geometry_msgs/msg/Twist"](
            vector(1.0, 0.0, 0.0), vector(0.0, 0.0, turn(step))
        )
        yield "/cmd_vel", time_ns + 10_000_000, command
        depth = np.full(IMAGE_SHAPE, 1000 + step, np.uint16)
        yield (
            "/camera/depth",
            time_ns,
            types["sensor_msgs/msg/Image"](
                header=header(time_ns, "camera"),
                height=IMAGE_SHAPE[0],
                width=IMAGE_SHAPE[1],
                encoding="16UC1",
                is_bigendian=0,
                step=2 * IMAGE_SHAPE[1],
                data=depth.view(np.uint8).ravel(),
            ),
        )
        yield (
            "/joints",
            time_ns,
            types["sensor_msgs/msg/JointState"](
                header=header(time_ns, ""),
                name=["hip", "knee"],
                position=np.array([0.1 * step, 2.0]),
                velocity=np.empty(0),
                effort=np.arange(float(step % 3)),
            ),
        )


def write_rosbag2(
    folder: Path, storage: str = "mcap", compression: str = "", parts: int = 1
) -> Path:
    """Write a rosbag2 folder; if there are several parts, write one such folder for each."""
    paths = [folder] if parts == 1 else [folder / f"part_{k}" for k in range(parts)]
    every = list(messages(STORE2))
    share = math.ceil(len(every) / parts)
    for number, path in enumerate(paths):
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
        if compression:
            writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
        with writer:
            connections: dict[str, Any] = {}
            for topic, time_ns, message in every[number * share : (number + 1) * share]:
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=STORE2)
                writer.write(connections[topic], time_ns, STORE2.serialize_cdr(message, kind))
    return folder


def write_rosbag1(path: Path) -> Path:
    """Write a ROS 1 bag."""
    with Writer1(path) as writer:
        connections: dict[str, Any] = {}
        for topic, time_ns, message in messages(STORE1):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE1)
            writer.write(connections[topic], time_ns, STORE1.serialize_ros1(message, kind))
    return path


class Channel(NamedTuple):
    """A channel: topic, type, definition, and its messages as times in seconds and CDR payloads."""

    topic: str
    kind: str
    text: str
    messages: list[tuple[float, bytes]]


def write_channels(path: Path, channels: list[Channel], start_ns: int = START_NS) -> Path:
    """Write an MCAP file with the messages of all channels in the order of time."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        rows = []
        for topic, kind, text, messages in channels:
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            channel = writer.register_channel(topic, "cdr", schema)
            rows += [(start_ns + round(time_s * 1e9), channel, data) for time_s, data in messages]
        for time_ns, channel, data in sorted(rows, key=lambda row: row[0]):
            writer.add_message(channel, time_ns, b"\0\1\0\0" + data, time_ns)
        writer.finish()
    return path


def number(value: float) -> bytes:
    """Return the payload of a Float64."""
    return struct.pack("<d", value)


def integer(value: int) -> bytes:
    """Return the payload of an Int32."""
    return struct.pack("<i", value)


def numbers(topic: str, values: Sequence[tuple[float, float]]) -> Channel:
    """Return a channel of Float64 messages, given as times in seconds and values."""
    messages = [(time_s, number(value)) for time_s, value in values]
    return Channel(topic, "std_msgs/msg/Float64", "float64 data", messages)


def integers(topic: str, values: Sequence[tuple[float, int]]) -> Channel:
    """Return a channel of Int32 messages, given as times in seconds and values."""
    messages = [(time_s, integer(value)) for time_s, value in values]
    return Channel(topic, "std_msgs/msg/Int32", "int32 data", messages)
