"""Nested fields, times and strings of common ROS messages, read as columns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore

from mcaprl.errors import UnknownNameError
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.topic import Topic

pytestmark = pytest.mark.usefixtures("each_copy")
STORE = get_typestore(Stores.ROS2_HUMBLE)
START_NS = 1_700_000_000 * 10**9
COUNT = 40
FIELDS = {
    "nav_msgs/msg/Odometry": (
        "header.stamp",
        "header.stamp.nanosec",
        "header.frame_id",
        "child_frame_id",
        "pose.pose.position.x",
        "pose.covariance",
        "twist.twist.angular.z",
    ),
    "sensor_msgs/msg/Imu": ("header.stamp", "orientation.w", "linear_acceleration.y"),
    "geometry_msgs/msg/Twist": ("linear.x", "angular.z"),
    "sensor_msgs/msg/JointState": ("header.stamp", "name", "position"),
    "sensor_msgs/msg/LaserScan": ("angle_min", "ranges", "header.frame_id"),
}


def random_value(random: np.random.Generator, description: Any, path: str) -> Any:
    kind, what = description
    name = kind.name
    if name == "BASE":
        if what[0] == "string":
            # Some strings have another length, so that the layouts of messages differ.
            return "frame" if random.random() < 0.9 else "another frame"
        return random_number(random, what[0])
    if name == "NAME":
        return random_message(random, what, path)
    element, count = what
    count = 6 if name == "SEQUENCE" else count
    if element[1][0] == "string":
        return [f"joint {k}" for k in range(count)]
    return np.array([random_number(random, element[1][0]) for _ in range(count)], element[1][0])


def random_number(random: np.random.Generator, kind: str) -> Any:
    if kind.startswith("float"):
        return float(np.float32(random.normal()))
    return int(random.integers(0, 100))


def random_message(random: np.random.Generator, kind: str, path: str = "") -> Any:
    fields = {
        name: random_value(random, description, f"{path}.{name}")
        for name, description in STORE.fielddefs[kind][1]
    }
    return STORE.types[kind](**fields)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("nested") / "robot.mcap"
    random = np.random.default_rng(1)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=4000)
        writer.start(profile="ros2")
        channels = {}
        for kind in FIELDS:
            text, _ = STORE.generate_msgdef(kind, ros_version=2)
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            channels[kind] = writer.register_channel(topic_of(kind), "cdr", schema)
        for step in range(COUNT):
            for kind, channel in channels.items():
                data = bytes(STORE.serialize_cdr(random_message(random, kind), kind))
                writer.add_message(channel, START_NS + step, data, START_NS)
        writer.finish()
    return path


def topic_of(kind: str) -> str:
    return f"/{kind.rpartition('/')[2].lower()}"


def field(message: Any, path: str) -> Any:
    for name in path.split("."):
        message = getattr(message, name)
    return message


@pytest.mark.parametrize("kind", FIELDS)
def test_columns_equal_the_messages_of_another_reader(kind: str, log: Path) -> None:
    columns = Topic(McapReader(log), topic_of(kind)).read(FIELDS[kind])
    with log.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        messages = [each[3] for each in reader.iter_decoded_messages(topics=[topic_of(kind)])]
    assert len(messages) == COUNT
    for path in FIELDS[kind]:
        for row, message in enumerate(messages):
            expected = field(message, path)
            if path == "header.stamp":
                expected = expected.sec * 10**9 + expected.nanosec
            np.testing.assert_array_equal(columns[path][row], expected, err_msg=path)


def test_leaves_of_a_nested_type(log: Path) -> None:
    kinds = Topic(McapReader(log), "/odometry").kinds
    assert kinds["header.stamp"] == "time"
    assert kinds["header.stamp.sec"] == "int32"
    assert kinds["pose.pose.position.x"] == "float64"
    assert kinds["pose.covariance"] == "float64[36]"
    assert kinds["child_frame_id"] == "string"
    assert "pose" not in kinds


def test_a_whole_message_is_not_a_column(log: Path) -> None:
    with pytest.raises(UnknownNameError, match="unknown field of /odometry 'pose'"):
        Topic(McapReader(log), "/odometry").read(["pose"])


def test_unknown_fields_name_the_nearest(log: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"did you mean pose\.pose\.position\.x"):
        Topic(McapReader(log), "/odometry").read(["pose.pose.positio.x"])


def test_selected_rows_of_nested_fields(log: Path) -> None:
    topic = Topic(McapReader(log), "/twist")
    every = topic.read(["linear.x"])["linear.x"]
    rows = np.array([30, 3, 17])
    np.testing.assert_array_equal(topic.read(["linear.x"], rows)["linear.x"], every[rows])
