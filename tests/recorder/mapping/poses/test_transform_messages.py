"""Transforms of all message types and encodings are read alike."""

from __future__ import annotations

import importlib.util
import json
import math
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Writer1
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mcaprl.errors import UsageError
from mcaprl.recorder.bags.bag import open_bag
from mcaprl.recorder.mapping import transforms as transform_messages
from mcaprl.recorder.mapping.transforms import Transforms, transform_topic
from tests.conftest import need

STEPS, STEP_NS, STAMP_NS = 3, 10**8, 5 * 10**9
Names = list[tuple[str, str, float]]


def poses(step: int) -> Names:
    """Return parent, child and x of each transform of a message; y is 2, and the yaw 90 degrees."""
    return [("map", "base", float(step)), ("base", "arm", 0.5)]


def json_of_ros(frames: Names, time_ns: int) -> Any:
    stamp = {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}
    return {
        "transforms": [
            {
                "header": {"stamp": stamp, "frame_id": f"/{parent}"},
                "child_frame_id": child,
                "transform": place(x),
            }
            for parent, child, x in frames
        ]
    }


def place(x: float) -> dict[str, Any]:
    half = math.sqrt(0.5)
    return {
        "translation": {"x": x, "y": 2, "z": 0},
        "rotation": {"x": 0, "y": 0, "z": half, "w": half},
    }


def json_of_foxglove(frames: Names, time_ns: int) -> Any:
    found = [
        {
            "timestamp": {"sec": time_ns // 10**9, "nsec": time_ns % 10**9},
            "parent_frame_id": parent,
            "child_frame_id": child,
            **place(x),
        }
        for parent, child, x in frames
    ]
    return found[0] if len(found) == 1 else {"transforms": found}


def write_json(
    path: Path, kind: str, message: Callable[[Names, int], Any], *, is_single: bool = False
) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(kind, "jsonschema", b"{}")
        channel = writer.register_channel("/tf", "json", schema)
        for step in range(STEPS):
            time_ns = step * STEP_NS
            parts = [[each] for each in poses(step)] if is_single else [poses(step)]
            for part in parts:
                data = json.dumps(message(part, STAMP_NS + time_ns)).encode()
                writer.add_message(channel, time_ns, data, time_ns)
        writer.finish()
    return path


def write_foxglove(path: Path, *, is_single: bool = False) -> Path:
    need(importlib.util.find_spec("foxglove") is not None, "foxglove-sdk is not installed")
    import foxglove
    from foxglove import channels
    from foxglove.messages import (
        FrameTransform,
        FrameTransforms,
        Quaternion,
        Timestamp,
        Vector3,
    )

    context, half = foxglove.Context(), math.sqrt(0.5)
    kind: Any = channels.FrameTransformChannel if is_single else channels.FrameTransformsChannel
    channel = kind("/tf", context=context)
    with foxglove.open_mcap(path, context=context):
        for step in range(STEPS):
            stamp_ns = STAMP_NS + step * STEP_NS
            every = [
                FrameTransform(
                    timestamp=Timestamp(sec=stamp_ns // 10**9, nsec=stamp_ns % 10**9),
                    parent_frame_id=parent,
                    child_frame_id=child,
                    translation=Vector3(x=x, y=2.0, z=0.0),
                    rotation=Quaternion(x=0.0, y=0.0, z=half, w=half),
                )
                for parent, child, x in poses(step)
            ]
            for each in every if is_single else [FrameTransforms(transforms=every)]:
                channel.log(each, log_time=step * STEP_NS)
    return path


def write_ros1(path: Path) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    text = "geometry_msgs/TransformStamped[] transforms"
    store.register(get_types_from_msg(text, "tf/msg/tfMessage"))
    types, half = store.types, math.sqrt(0.5)
    vector, quaternion = (types[f"geometry_msgs/msg/{each}"] for each in ("Vector3", "Quaternion"))
    with Writer1(path) as writer:
        connection = writer.add_connection("/tf", "tf/msg/tfMessage", typestore=store)
        for step in range(STEPS):
            time_ns = STAMP_NS + step * STEP_NS
            stamp = types["builtin_interfaces/msg/Time"](time_ns // 10**9, time_ns % 10**9)
            every = [
                types["geometry_msgs/msg/TransformStamped"](
                    types["std_msgs/msg/Header"](0, stamp, f"/{parent}"),
                    f"/{child}",
                    types["geometry_msgs/msg/Transform"](
                        vector(x, 2.0, 0.0), quaternion(0.0, 0.0, half, half)
                    ),
                )
                for parent, child, x in poses(step)
            ]
            message = types["tf/msg/tfMessage"](every)
            data = store.serialize_ros1(message, "tf/msg/tfMessage")
            writer.write(connection, step * STEP_NS, data)
    return path


FORMS: dict[str, Callable[[Path], Path]] = {
    "JSON of ROS": lambda path: write_json(path / "bag.mcap", "tf2_msgs/TFMessage", json_of_ros),
    "JSON list": lambda path: write_json(
        path / "bag.mcap", "foxglove.FrameTransforms", json_of_foxglove
    ),
    "JSON": lambda path: write_json(
        path / "bag.mcap", "foxglove.FrameTransform", json_of_foxglove, is_single=True
    ),
    "protobuf list": lambda path: write_foxglove(path / "bag.mcap"),
    "protobuf": lambda path: write_foxglove(path / "bag.mcap", is_single=True),
    "ROS 1": lambda path: write_ros1(path / "one.bag"),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_has_the_same_poses(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transform_messages, "_BLOCK_MESSAGES", 2)
    with closing(open_bag(FORMS[form](tmp_path))) as bag:
        topic = transform_topic(bag, None)
        for time, start_ns in (("log_time", 0), ("publish_time", 0), ("header", STAMP_NS)):
            found = Transforms(bag, time, topic=topic, frames=["arm", "map"])  # type: ignore[arg-type]
            steps_ns = start_ns + np.arange(-1, STEPS) * STEP_NS
            pose, _ = found.pose("arm", "map", steps_ns, "last", 0.05)
            assert np.isnan(pose[0]).all()
            # The arm is 0.5 ahead of the base and 2 to its left, and the base looks along y.
            expected = [[step - 2, 2.5, math.pi] for step in range(STEPS)]
            np.testing.assert_allclose(np.abs(pose[1:]), np.abs(expected), atol=1e-12)


def test_a_transform_without_a_stamp_is_a_clear_error(tmp_path: Path) -> None:
    def without(frames: Names, time_ns: int) -> Any:
        return {"transforms": [{"parent_frame_id": "map", "child_frame_id": "base", **place(0)}]}

    path = write_json(tmp_path / "bag.mcap", "foxglove.FrameTransforms", without)
    with closing(open_bag(path)) as bag:
        assert Transforms(bag).streams("base", "map")
        with pytest.raises(UsageError, match="of frame 'base' has no timestamp: use `time: log_ti"):
            Transforms(bag, "header")
