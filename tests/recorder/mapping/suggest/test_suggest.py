"""Suggested mappings, also of bags whose names are hostile."""

from __future__ import annotations

import json
import struct
from contextlib import closing
from pathlib import Path

import pytest
from mcap.writer import Writer

import mcaprl
from mcaprl.errors import LogError
from mcaprl.recorder.bags.bag import open_bag
from mcaprl.recorder.mapping.config import load_mapping
from mcaprl.recorder.mapping.draft import suggested
from tests.support.bags import numbers, write_channels

EVIL = "\x1b[2J\x9b1m\u202e\r"


def suggestion(path: Path) -> str:
    with closing(open_bag(path)) as bag:
        return suggested(bag)


def test_names_of_a_bag_stay_text(tmp_path: Path) -> None:
    kind = 'Odom\nmeta: {env_id: "evil_module:Env-v0"}\nstack: 3 #'
    topics = [f"/a b #1{EVIL}", '/quote"\\', "/line\nmeta: 1", "/1/2", "/Ünï: [x]", "/cmd #, {y}"]
    with (tmp_path / "evil.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        # Messages of JSON may have any type name. Those of CDR cannot be read with this name.
        number = json.dumps({"properties": {"data": {"type": "number"}}}).encode()
        schema = writer.register_schema(kind, "jsonschema", number)
        channels = [writer.register_channel(topic, "json", schema) for topic in topics]
        schema = writer.register_schema(kind, "ros2msg", b"float64 data")
        channels.append(writer.register_channel("/broken\nstack: 4", "cdr", schema))
        for k in range(10):
            for channel in channels:
                writer.add_message(channel, k * 10**8, b'{"data": 1}', k * 10**8)
        writer.finish()
    text = suggestion(tmp_path / "evil.mcap")
    assert all(character.isprintable() for character in text.replace("\n", ""))
    (tmp_path / "evil.yaml").write_text(text, encoding="utf-8")
    mapping, _ = load_mapping(tmp_path / "evil.yaml")
    assert {each.field for each in mapping.observation.values()} == {
        f"{topic}.data" for topic in topics[:-1]
    }
    assert mapping.action.fields == ["/cmd #, {y}.data"]
    assert (mapping.meta.env_id, mapping.stack) == ("", 1)


def test_the_rate_is_that_of_the_median_interval(tmp_path: Path) -> None:
    # 10 Hz with a pause of 50 s.
    values = [(k / 10 + 50 * (k > 20), k) for k in range(40)]
    path = write_channels(tmp_path / "pause.mcap", [numbers("/odom", values)])
    with pytest.warns(UserWarning, match="has no action yet: no topic looks like a command"):
        text = suggestion(path)
    assert "clock: {rate_hz: 10}" in text
    assert "std_msgs/msg/Float64, 40 messages, 10 Hz" in text


def test_a_log_needs_no_mapping(tmp_path: Path) -> None:
    mcaprl.record("lane", tmp_path / "lane.mcap", episodes=1)
    with pytest.raises(LogError, match=r"lane.mcap is a log already, with the topic /rl/step"):
        mcaprl.suggest_mapping(tmp_path / "lane.mcap")


def test_types_of_ros_1_in_mcap_are_known_without_msg_in_their_names(tmp_path: Path) -> None:
    image = "uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
    image += "uint8[] data"
    scan = bytes(4) + struct.pack("<I20f", 20, *range(20))
    joints = struct.pack("<I2dI", 2, 0.5, 1.5, 0)
    pixels = struct.pack("<II", 1, 2) + struct.pack("<I5s", 5, b"mono8")
    with (tmp_path / "ros1.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros1")
        for name, kind, text, data in (
            ("/camera", "sensor_msgs/Image", image, pixels + struct.pack("<BII", 0, 2, 2) + b"12"),
            ("/scan", "sensor_msgs/LaserScan", "float32 angle_min\nfloat32[] ranges", scan),
            ("/joints", "sensor_msgs/JointState", "float64[] position\nfloat64[] velocity", joints),
        ):
            schema = writer.register_schema(kind, "ros1msg", text.encode())
            channel = writer.register_channel(name, "ros1", schema)
            for k in range(10):
                writer.add_message(channel, k * 10**8, data, k * 10**8)
        writer.finish()
    with pytest.warns(UserWarning, match="no topic looks like a command"):
        text = suggestion(tmp_path / "ros1.mcap")
    assert "# camera: {image: /camera, resize: [84, 84]}  # sensor_msgs/Image, 10 messages" in text
    assert "{scan: /scan, clip: [0, 19]}" in text
    assert "{field: /joints.position}" in text
    assert "height" not in text
