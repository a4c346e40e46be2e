"""Tests that shapes and frames are encoded to the same bytes as by rosbags."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcaprl.recorder.format import messages
from mcaprl.recorder.record.scene import (
    MARKER_TYPES,
    marker_array,
    timed_transforms,
    transforms,
)
from mcaprl.sims.drawing.scene import Frame, Kind, Shape

NUMBERS = st.floats(-1e6, 1e6)
SHARES = st.floats(0.0, 1.0, width=32)
TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)
TRIPLES = st.tuples(NUMBERS, NUMBERS, NUMBERS)
KINDS: list[Kind] = ["box", "line", "segments", "spheres", "text", "triangles"]
SHAPES = st.builds(
    Shape,
    name=TEXTS,
    kind=st.sampled_from(KINDS),
    color=st.tuples(SHARES, SHARES, SHARES, SHARES),
    points=st.lists(TRIPLES, max_size=4).map(lambda rows: np.reshape(rows, (-1, 3)).astype(float)),
    size=TRIPLES,
    position=TRIPLES,
    yaw_rad=st.floats(-7.0, 7.0),
    frame=TEXTS,
    text=TEXTS,
)
FRAMES = st.builds(
    Frame,
    name=TEXTS,
    position=TRIPLES,
    rotation=st.tuples(*4 * [st.floats(-1.0, 1.0)]),
    parent=TEXTS,
)


@given(st.lists(SHAPES, max_size=4))
def test_marker_arrays_equal_those_of_rosbags(shapes: list[Shape]) -> None:
    markers = [_marker(action=3), *map(_marker_of, shapes)]
    expected = messages.new("visualization_msgs/msg/MarkerArray", markers=markers)
    assert marker_array(shapes) == messages.encode(expected)


@given(st.lists(st.tuples(st.integers(0, 2**31 * 10**9 - 1), FRAMES), max_size=4))
def test_transforms_equal_those_of_rosbags(frames: list[tuple[int, Frame]]) -> None:
    stamped = [_transform(time_ns, frame) for time_ns, frame in frames]
    expected = messages.encode(messages.new("tf2_msgs/msg/TFMessage", transforms=stamped))
    assert timed_transforms(frames) == expected


def test_transforms_of_one_time_have_this_stamp() -> None:
    frames = [Frame(name, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)) for name in ("car", "wheel")]
    assert transforms(frames, 1_500_000_000) == timed_transforms(
        [(1_500_000_000, frame) for frame in frames]
    )


def test_points_and_poses_are_rounded_to_binary_fractions() -> None:
    shape = Shape("p", "points", (1.0, 1.0, 1.0, 1.0), np.array([[0.01, 0.02, -0.3]]))
    array = messages.decode(marker_array([shape]), "visualization_msgs/msg/MarkerArray")
    point = array.markers[1].points[0]
    assert (point.x, point.y, point.z) == (1 / 64, 1 / 64, -19 / 64)
    frame = Frame("car", (0.001, 0.003, 1.0), (0.0, 0.0, 0.0001, 1.0))
    found = messages.decode(transforms([frame], 0), "tf2_msgs/msg/TFMessage").transforms[0]
    assert found.transform.translation.y == 1 / 256
    assert found.transform.rotation.z == 0.0


@pytest.mark.parametrize("text", ["a\0b", "\ud800"])
def test_texts_that_ros_cannot_store_are_replaced(text: str) -> None:
    shape = Shape(text, "text", (1.0, 1.0, 1.0, 1.0), text=text)
    array = messages.decode(marker_array([shape]), "visualization_msgs/msg/MarkerArray")
    assert array.markers[1].text == array.markers[1].ns == {"a\0b": "a\ufffdb"}.get(text, "\\ud800")


def _marker_of(shape: Shape) -> Any:
    half = shape.yaw_rad / 2
    return _marker(
        frame=shape.frame,
        name=shape.name,
        kind=MARKER_TYPES[shape.kind],
        position=shape.position,
        rotation=(0.0, 0.0, math.sin(half), math.cos(half)),
        size=shape.size,
        color=shape.color,
        points=(np.rint(shape.points * 64) / 64).tolist(),
        text=shape.text,
    )


def _marker(
    *,
    action: int = 0,
    frame: str = "map",
    name: str = "",
    kind: int = 0,
    position: Sequence[float] = (0.0, 0.0, 0.0),
    rotation: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
    size: Sequence[float] = (0.0, 0.0, 0.0),
    color: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
    points: Sequence[Sequence[float]] = (),
    text: str = "",
) -> Any:
    new, nothing = messages.new, np.empty(0, np.uint8)
    image = "sensor_msgs/msg/CompressedImage"
    return new(
        "visualization_msgs/msg/Marker",
        header=messages.header(0, frame),
        ns=name,
        id=0,
        type=kind,
        action=action,
        pose=new(
            "geometry_msgs/msg/Pose",
            position=_xyz("Point", position),
            orientation=_quaternion(rotation),
        ),
        scale=_xyz("Vector3", size),
        color=new("std_msgs/msg/ColorRGBA", **dict(zip("rgba", color, strict=True))),
        lifetime=new("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        frame_locked=True,
        points=[_xyz("Point", xyz) for xyz in points],
        colors=[],
        texture_resource="",
        texture=new(image, header=messages.header(0, ""), format="", data=nothing),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=new("visualization_msgs/msg/MeshFile", filename="", data=nothing),
        mesh_use_embedded_materials=False,
    )


def _transform(time_ns: int, frame: Frame) -> Any:
    position = [round(number * 256) / 256 for number in frame.position]
    rotation = [round(number * 4096) / 4096 for number in frame.rotation]
    return messages.new(
        "geometry_msgs/msg/TransformStamped",
        header=messages.header(time_ns, frame.parent),
        child_frame_id=frame.name,
        transform=messages.new(
            "geometry_msgs/msg/Transform",
            translation=_xyz("Vector3", position),
            rotation=_quaternion(rotation),
        ),
    )


def _xyz(name: str, xyz: Sequence[float]) -> Any:
    return messages.new(f"geometry_msgs/msg/{name}", **dict(zip("xyz", xyz, strict=True)))


def _quaternion(xyzw: Sequence[float]) -> Any:
    fields = dict(zip("xyzw", xyzw, strict=True))
    return messages.new("geometry_msgs/msg/Quaternion", **fields)
