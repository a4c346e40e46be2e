"""Protobuf and JSON logs that foxglove-sdk writes."""

from __future__ import annotations

import importlib.util
import math
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from mcaprl.recorder.bags.bag import open_bag
from mcaprl.recorder.bags.decoders import JsonDecoder, column_of, value_at
from tests.conftest import need

START_NS, STEP_NS, STEPS = 1_700_000_000 * 10**9, 50_000_000, 5


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write poses as protobuf, a state as JSON with a schema, and modes as JSON without schema."""
    need(importlib.util.find_spec("foxglove") is not None, "foxglove-sdk is not installed")
    import foxglove
    from foxglove.channels import LaserScanChannel, PoseInFrameChannel
    from foxglove.messages import LaserScan, Pose, PoseInFrame, Quaternion, Timestamp, Vector3

    path = tmp_path_factory.mktemp("foxglove") / "robot.mcap"
    context = foxglove.Context()
    poses = PoseInFrameChannel("/pose", context=context)
    scans = LaserScanChannel("/scan", context=context)
    number = {"type": "number"}
    schema = {
        "type": "object",
        "properties": {
            "speed": number,
            "at": {"type": "object", "properties": {"x": number, "y": number}},
            "ranges": {"type": "array", "items": number},
            "stamp": {
                "type": "object",
                "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
            },
        },
    }
    states = foxglove.Channel("/state", schema=schema, context=context)
    modes = foxglove.Channel("/mode", message_encoding="json", context=context)
    with foxglove.open_mcap(path, context=context):
        for step in range(STEPS):
            time_ns = START_NS + step * STEP_NS
            stamp = Timestamp(sec=time_ns // 10**9, nsec=time_ns % 10**9)
            turn = Quaternion(x=0.0, y=0.0, z=math.sin(step / 20), w=math.cos(step / 20))
            pose = Pose(position=Vector3(x=float(step), y=2.0, z=0.0), orientation=turn)
            poses.log(PoseInFrame(timestamp=stamp, frame_id="map", pose=pose), log_time=time_ns)
            scan = LaserScan(timestamp=stamp, ranges=[1.0, float(step)], start_angle=-0.5)
            scans.log(scan, log_time=time_ns)
            states.log(
                {
                    "speed": step / 2,
                    "at": {"x": step},
                    "ranges": [step, 1.5],
                    "stamp": {"sec": 1, "nsec": step},
                },
                log_time=time_ns,
            )
            modes.log({"name": "go" if step else "stop", "level": step}, log_time=time_ns)
    return path


def test_protobuf_fields(log: Path) -> None:
    with closing(open_bag(log)) as bag:
        info = bag.topics["/pose"]
        assert (info.encoding, info.type_name) == ("protobuf", "foxglove.PoseInFrame")
        assert info.fields == {
            "timestamp": "time",
            "frame_id": "string",
            **{f"pose.position.{axis}": "float64" for axis in "xyz"},
            **{f"pose.orientation.{axis}": "float64" for axis in "xyzw"},
        }
        fields = ["timestamp", "frame_id", "pose.position.x", "pose.orientation.z"]
        found = bag.read("/pose", fields).columns
        np.testing.assert_array_equal(found["timestamp"], START_NS + STEP_NS * np.arange(STEPS))
        assert found["frame_id"].tolist() == ["map"] * STEPS
        assert found["pose.position.x"].tolist() == [0, 1, 2, 3, 4]
        np.testing.assert_allclose(found["pose.orientation.z"], np.sin(np.arange(STEPS) / 20))
        scans = bag.read("/scan", ["ranges", "start_angle", "end_angle"]).columns
        assert scans["ranges"].tolist() == [[1.0, float(step)] for step in range(STEPS)]
        # A field that the writer did not set has protobuf's default value.
        assert scans["end_angle"].tolist() == [0.0] * STEPS


def test_json_fields_with_a_schema_and_without(log: Path) -> None:
    with closing(open_bag(log)) as bag:
        assert bag.topics["/state"].fields == {
            "speed": "float64",
            "at.x": "float64",
            "at.y": "float64",
            "ranges": "float64[]",
            "stamp": "time",
        }
        found = bag.read("/state", ["speed", "at.x", "at.y", "ranges", "stamp"]).columns
        assert found["speed"].tolist() == [0, 0.5, 1, 1.5, 2]
        assert found["at.x"].tolist() == [0, 1, 2, 3, 4]
        assert np.isnan(found["at.y"]).all()
        assert found["ranges"].tolist() == [[step, 1.5] for step in range(STEPS)]
        assert found["stamp"].tolist() == [10**9 + step for step in range(STEPS)]
        assert bag.topics["/mode"].fields == {}
        modes = bag.read("/mode", ["name", "level", "none"]).columns
        assert modes["name"].tolist() == ["stop", *["go"] * 4]
        assert modes["level"].tolist() == [0, 1, 2, 3, 4]
        assert np.isnan(modes["none"]).all()


def test_missing_json_keys_are_missing_values() -> None:
    decoder = JsonDecoder(b"")
    found = [decoder.decode(text) for text in (b'{"a": {"b": 1}}', b'{"a": null}', b"{}")]
    values = [value_at(message, "a.b") for message in found]
    np.testing.assert_array_equal(column_of(values, ""), [1.0, np.nan, np.nan])
    texts = column_of(["x", None], "string")
    assert texts.tolist() == ["x", None]
