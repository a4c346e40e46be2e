"""The public face of bags: topics, times and columns."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

import mcaprl
from mcaprl.errors import LogError, UnknownNameError, UsageError
from tests.support.bags import (
    START_NS,
    STEP_NS,
    STEPS,
    numbers,
    speed,
    write_channels,
    write_rosbag1,
    write_rosbag2,
)


@pytest.mark.parametrize("form", ["mcap", "sqlite3", "ros1"])
def test_a_bag_is_read_as_columns(form: str, tmp_path: Path) -> None:
    is_ros1 = form == "ros1"
    path = write_rosbag1(tmp_path / "a.bag") if is_ros1 else write_rosbag2(tmp_path / "a", form)
    with mcaprl.open_bag(path) as bag:
        assert isinstance(bag, mcaprl.OpenBag)
        assert bag.topics["/odom"].count == STEPS
        times_ns = START_NS + STEP_NS * np.arange(STEPS)
        np.testing.assert_array_equal(bag.times("/odom"), times_ns)
        found = bag.read("/odom")
        np.testing.assert_array_equal(found.log_time_ns, times_ns)
        assert set(found.columns) == set(bag.topics["/odom"].fields)
        assert found.columns["twist.twist.linear.x"].tolist() == [speed(k) for k in range(STEPS)]
        assert found.columns["pose.covariance"].shape == (STEPS, 36)
        some = bag.read("/odom", ["publish_time", "header.frame_id"], np.arange(2, 5))
        assert some.columns["publish_time"].tolist() == times_ns[2:5].tolist()
        assert some.columns["header.frame_id"].tolist() == ["odom"] * 3
        with pytest.raises(UnknownNameError, match=r"unknown topic '/odo'.*did you mean /odom"):
            bag.read("/odo")
        assert repr(bag).splitlines()[:2] == [
            f"Bag {bag.paths[0]}: 5 topics",
            f"  /camera/depth: sensor_msgs/msg/Image, {STEPS} messages",
        ]


def test_texts_of_a_bag_are_short_and_harmless(tmp_path: Path) -> None:
    channels = [numbers(f"/x{k}\x1b[2J", [(0.0, 1.0)]) for k in range(20)]
    with mcaprl.open_bag(write_channels(tmp_path / "a.mcap", channels)) as bag:
        text = repr(bag)
    assert "\x1b" not in text
    assert len(text.splitlines()) == 10
    assert text.endswith("  and 12 more")


def test_topics_that_cannot_be_read_say_why(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/json", "json", 0)
        other = writer.register_channel("/cbor", "cbor", 0)
        for k in range(3):
            writer.add_message(channel, k, json.dumps({"a": k}).encode(), k)
            writer.add_message(other, k, b"x", k)
        writer.finish()
    with mcaprl.open_bag(path) as bag:
        assert bag.read("/json", ["a"]).columns["a"].tolist() == [0, 1, 2]
        if not bag.topics["/json"].fields:
            with pytest.raises(UsageError, match=r"the fields of /json are unknown, .* name them"):
                bag.read("/json")
        with pytest.raises(LogError, match="/cbor cannot be read: messages of encoding 'cbor'"):
            bag.read("/cbor")
        assert "/cbor: cbor, 3 messages, cannot be read: " in repr(bag)
