"""ROS bags of every format, written by rosbags, are read as the same columns."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from mcaprl.errors import LogError, UnknownNameError
from mcaprl.recorder.bags.bag import open_bag
from tests.support.bags import (
    IMAGE_SHAPE,
    START_NS,
    STEP_NS,
    STEPS,
    STORE1,
    STORE2,
    speed,
    turn,
    write_rosbag1,
    write_rosbag2,
)

FORMS: dict[str, Callable[[Path], Path]] = {
    "mcap folder": lambda path: write_rosbag2(path / "bag"),
    "mcap file": lambda path: next(write_rosbag2(path / "bag").glob("*.mcap")),
    "mcap without metadata": lambda path: without_metadata(write_rosbag2(path / "bag")),
    "sqlite3 folder": lambda path: write_rosbag2(path / "bag", "sqlite3"),
    "sqlite3 file": lambda path: next(write_rosbag2(path / "bag", "sqlite3").glob("*.db3")),
    "compressed file": lambda path: write_rosbag2(path / "bag", "sqlite3", "FILE"),
    "compressed mcap": lambda path: write_rosbag2(path / "bag", "mcap", "FILE"),
    "compressed messages": lambda path: write_rosbag2(path / "bag", "sqlite3", "MESSAGE"),
    "ROS 1": lambda path: write_rosbag1(path / "one.bag"),
    "odd name": lambda path: write_rosbag2(path / "a bag (1) #2"),
}


def without_metadata(folder: Path) -> Path:
    (folder / "metadata.yaml").unlink()
    return folder


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_same_columns(form: str, tmp_path: Path) -> None:
    with closing(open_bag(FORMS[form](tmp_path))) as bag:
        assert set(bag.topics) == {"/odom", "/tf", "/cmd_vel", "/camera/depth", "/joints"}
        assert all(not topic.problem for topic in bag.topics.values())
        info = bag.topics["/odom"]
        assert (info.type_name, info.count) == ("nav_msgs/msg/Odometry", STEPS)
        assert (info.first_ns, info.last_ns) == (START_NS, START_NS + (STEPS - 1) * STEP_NS)
        assert info.fields["twist.twist.linear.x"] == "float64"
        assert info.fields["pose.covariance"] == "float64[36]"
        assert info.fields["header.stamp"] == "time"
        times = START_NS + STEP_NS * np.arange(STEPS)
        np.testing.assert_array_equal(bag.times("/odom"), times)
        fields = ["twist.twist.linear.x", "header.stamp", "pose.covariance", "child_frame_id"]
        fields += ["header.stamp.nanosec", "publish_time"]
        found = bag.read("/odom", fields)
        np.testing.assert_array_equal(found.log_time_ns, times)
        columns = found.columns
        assert columns["twist.twist.linear.x"].tolist() == [speed(k) for k in range(STEPS)]
        np.testing.assert_array_equal(columns["header.stamp"], times - 1000)
        np.testing.assert_array_equal(columns["header.stamp.nanosec"], (times - 1000) % 10**9)
        np.testing.assert_array_equal(columns["publish_time"], times)
        assert columns["pose.covariance"].shape == (STEPS, 36)
        assert columns["pose.covariance"][3].tolist() == [3.0] * 36
        assert columns["child_frame_id"].tolist() == ["base"] * STEPS
        joints = bag.read("/joints", ["name", "position", "velocity", "effort"]).columns
        assert joints["position"].shape == (STEPS, 2)
        assert list(joints["name"][5]) == ["hip", "knee"]
        assert [len(each) for each in joints["effort"]] == [k % 3 for k in range(STEPS)]


@pytest.mark.parametrize("form", ["mcap file", "sqlite3 file", "ROS 1"])
def test_rows_are_read_in_the_given_order(form: str, tmp_path: Path) -> None:
    with closing(open_bag(FORMS[form](tmp_path))) as bag:
        rows = np.array([7, 2, 2, 11])
        found = bag.read("/cmd_vel", ["angular.z"], rows)
        assert found.columns["angular.z"].tolist() == [turn(k) for k in rows.tolist()]
        expected = START_NS + STEP_NS * rows + 10_000_000
        np.testing.assert_array_equal(found.log_time_ns, expected)
        for first in (0, 5, 3):
            block = np.arange(first, first + 4)
            images = bag.read("/camera/depth", ["data", "encoding"], block).columns
            depths = [np.frombuffer(data, np.uint16) for data in images["data"]]
            assert [depth[0] for depth in depths] == [1000 + k for k in block.tolist()]
            assert {depth.size for depth in depths} == {IMAGE_SHAPE[0] * IMAGE_SHAPE[1]}
            assert set(images["encoding"]) == {"16UC1"}


@pytest.mark.parametrize("form", ["ros2.mcap", "ros2.db3", "ros1.bag"])
def test_messages_are_read_in_the_order_of_recording(form: str, tmp_path: Path) -> None:
    is_ros1 = form == "ros1.bag"
    store, kind = STORE1 if is_ros1 else STORE2, "std_msgs/msg/Float64"
    plugin = StoragePlugin.MCAP if form == "ros2.mcap" else StoragePlugin.SQLITE3
    path = tmp_path / form
    writer: Any = Writer1(path) if is_ros1 else Writer2(path, version=9, storage_plugin=plugin)
    # The clock is reset after the third message. In ROS 1, each publisher has a connection.
    rows = [(0, 1, 10.0), (1, 2, 11.0), (0, 3, 12.0), (1, 1, 20.0), (0, 2, 21.0)]
    serialize = store.serialize_ros1 if is_ros1 else store.serialize_cdr
    with writer:
        publishers = [{"callerid": "/a"}, {"callerid": "/b"}] if is_ros1 else [{}]
        connections = [
            writer.add_connection("/x", kind, typestore=store, **each) for each in publishers
        ]
        for publisher, time_ns, value in rows:
            connection = connections[publisher if is_ros1 else 0]
            writer.write(connection, time_ns, serialize(store.types[kind](value), kind))
    with closing(open_bag(path)) as bag:
        assert bag.times("/x").tolist() == [1, 2, 3, 1, 2]
        assert bag.read("/x", ["data"]).columns["data"].tolist() == [10, 11, 12, 20, 21]
        assert bag.read("/x", ["data"], np.array([3, 0])).columns["data"].tolist() == [20, 10]


def test_split_bags_are_joined_in_the_order_of_time(tmp_path: Path) -> None:
    parts = write_rosbag2(tmp_path / "split", parts=3)
    folders = sorted(parts.iterdir(), reverse=True)
    with closing(open_bag(folders)) as bag:
        speeds = bag.read("/odom", ["twist.twist.linear.x"]).columns["twist.twist.linear.x"]
        assert speeds.tolist() == [speed(k) for k in range(STEPS)]
        assert len(bag.paths) == 3


def test_a_missing_file_of_a_split_bag_is_an_error(tmp_path: Path) -> None:
    parts = write_rosbag2(tmp_path / "split", parts=3)
    whole = tmp_path / "whole"
    whole.mkdir()
    files = [file for folder in sorted(parts.iterdir()) for file in folder.glob("*.mcap")]
    for number, file in enumerate(files):
        shutil.copyfile(file, whole / f"part_{number}.mcap")
    names = "".join(f"    - part_{number}.mcap\n" for number in range(3))
    (whole / "metadata.yaml").write_text(
        f"rosbag2_bagfile_information:\n  relative_file_paths:\n{names}"
    )
    with closing(open_bag(whole)) as bag:
        assert len(bag.paths) == 3
    (whole / "part_1.mcap").unlink()
    with pytest.raises(LogError, match=r"part_1.mcap is listed in metadata.yaml, but is missing"):
        open_bag(whole)


def test_missing_files_topics_and_types_are_clear_errors(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no such file, folder or match"):
        open_bag(tmp_path / "none.mcap")
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match=r"empty has no .mcap, .db3, .bag files"):
        open_bag(tmp_path / "empty")
    (tmp_path / "wrong.bag").write_bytes(b"not a bag")
    with pytest.raises(LogError, match="cannot be read as a bag"):
        open_bag(tmp_path / "wrong.bag")
    with (
        closing(open_bag(write_rosbag2(tmp_path / "bag"))) as bag,
        pytest.raises(UnknownNameError, match=r"unknown topic '/odo'.*did you mean /odom"),
    ):
        bag.read("/odo", ["x"])
    with (
        closing(open_bag(tmp_path / "bag")) as bag,
        pytest.raises(UnknownNameError, match="unknown field of /odom"),
    ):
        bag.read("/odom", ["twist.twist.linear.w"])
