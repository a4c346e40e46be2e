"""Conversion of a simulator's scene into ROS messages.

A simulator provides a scene by implementing one or more of the protocols below on its unwrapped
environment. Shapes and frames are any objects with the attributes of `Shape` and `Frame`, so a
simulator does not need to import this module. Axes follow REP 103: right-handed, z up, meters.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.format import messages
from mcaprl.recorder.format.topics import IMAGE_FRAME

Vector = tuple[float, float, float]
Quad = tuple[float, float, float, float]

# `type` of visualization_msgs/msg/Marker by kind of shape.
MARKER_TYPES = {
    "arrow": 0,
    "box": 1,
    "sphere": 2,
    "cylinder": 3,
    "line": 4,
    "segments": 5,
    "spheres": 7,
    "points": 8,
    "text": 9,
    "triangles": 11,
}
_ADD, _DELETE_ALL = 0, 3
# Values are rounded to binary fractions. This halves their size in a log without visible changes.
_POINTS_PER_M = 2**6
_POSITIONS_PER_M = 2**8
_ROTATIONS_PER_ONE = 2**12


class Shape(Protocol):
    """A shape to draw."""

    @property
    def name(self) -> str:
        """Name, unique in the scene."""

    @property
    def kind(self) -> str:
        """Key of MARKER_TYPES."""

    @property
    def color(self) -> Quad:
        """Red, green, blue, opacity, each 0 to 1."""

    @property
    def points(self) -> NDArray[np.float64]:
        """(N, 3) points in meters; unused by `box`, `sphere`, `cylinder` and `text`."""

    @property
    def size(self) -> Vector:
        """Edge lengths in meters; for lines, the first length is the width of the line."""

    @property
    def position(self) -> Vector:
        """Position of the shape in its frame, meters."""

    @property
    def yaw_rad(self) -> float:
        """Rotation about the z axis, radians."""

    @property
    def frame(self) -> str:
        """Name of the frame that the shape is fixed to."""

    @property
    def text(self) -> str:
        """Text of a shape of kind `text`."""


class Frame(Protocol):
    """A coordinate frame, relative to its parent."""

    @property
    def name(self) -> str:
        """Name of the frame."""

    @property
    def parent(self) -> str:
        """Name of the parent frame."""

    @property
    def position(self) -> Vector:
        """Position of the origin in the parent, meters."""

    @property
    def rotation(self) -> Quad:
        """Orientation in the parent, as a quaternion (x, y, z, w)."""


@runtime_checkable
class SceneSource(Protocol):
    """An environment that provides shapes and coordinate frames."""

    def static_scene(self) -> Sequence[Shape]:
        """Return the shapes that stay the same in an episode. Their coordinate frames may move."""

    def scene(self) -> Sequence[Shape]:
        """Return the current shapes that change from step to step."""

    def static_frames(self) -> Sequence[Frame]:
        """Return the coordinate frames that are fixed in their parents."""

    def frames(self) -> Sequence[Frame]:
        """Return the moving coordinate frames with their current poses."""


@runtime_checkable
class MotionSource(Protocol):
    """An environment that provides the poses of its moving coordinate frames within a step."""

    def motion(self) -> Sequence[tuple[float, Sequence[Frame]]]:
        """Return the moving coordinate frames at moments within the last step, in order of time.

        Each element is a pair: the number of seconds before the end of the step, which is more than
        0, and the frames at that moment. The sequence is empty after `reset`.
        """


@runtime_checkable
class TelemetrySource(Protocol):
    """An environment that provides numbers to plot."""

    def telemetry(self) -> Mapping[str, float]:
        """Return numbers by name. The names never change; they are ROS field names with units."""


@runtime_checkable
class DepthSource(Protocol):
    """An environment with a depth camera."""

    def depth_image_m(self) -> NDArray[np.float32]:
        """Return the distances (height, width) along the rays in meters.

        A distance is infinite if the ray hits nothing.
        """


@runtime_checkable
class PinholeSource(Protocol):
    """An environment whose depth camera is a pinhole camera with its axis in the image's middle."""

    def depth_focal_px(self) -> tuple[float, float]:
        """Return the focal lengths of the depth image, in pixel widths and pixel heights."""


def marker_array(shapes: Iterable[Shape]) -> bytes:
    """Encode shapes as one `visualization_msgs/msg/MarkerArray`.

    The first marker deletes all earlier markers, so that a viewer shows only these shapes after it
    seeks to this message. Stamps are 0, so that equal shapes encode to equal messages. A stamp of 0
    refers to the latest transform of the frame.
    """
    markers = [_marker(action=_DELETE_ALL), *map(_shape_marker, shapes)]
    return messages.encode(messages.new("visualization_msgs/msg/MarkerArray", markers=markers))


def transforms(frames: Iterable[Frame], time_ns: int) -> bytes:
    """Encode coordinate frames as one `tf2_msgs/msg/TFMessage`."""
    stamped = [stamped_transform(frame, time_ns) for frame in frames]
    return messages.encode(messages.new("tf2_msgs/msg/TFMessage", transforms=stamped))


def stamped_transform(frame: Frame, time_ns: int) -> Any:
    """Return a coordinate frame as `geometry_msgs/msg/TransformStamped`."""
    return messages.new(
        "geometry_msgs/msg/TransformStamped",
        header=messages.header(time_ns, frame.parent),
        child_frame_id=frame.name,
        transform=messages.new(
            "geometry_msgs/msg/Transform",
            translation=_vector(_rounded(frame.position, _POSITIONS_PER_M)),
            rotation=_quaternion(_rounded(frame.rotation, _ROTATIONS_PER_ONE)),
        ),
    )


def camera_info(focal_px: tuple[float, float], shape: tuple[int, ...]) -> bytes:
    """Encode a pinhole camera as `sensor_msgs/msg/CameraInfo`, without distortion.

    Args:
        focal_px: Focal lengths in pixel widths and pixel heights.
        shape: Height and width of the image, pixels. The optical axis passes through the middle of
            the image. Pixel coordinates are 0 in the middle of the first pixel.
    """
    height, width = shape[:2]
    matrix = np.array([[focal_px[0], 0, width / 2 - 0.5], [0, focal_px[1], height / 2 - 0.5]])
    matrix = np.vstack([matrix, [0.0, 0.0, 1.0]])
    whole = messages.new(
        "sensor_msgs/msg/RegionOfInterest",
        x_offset=0,
        y_offset=0,
        height=0,
        width=0,
        do_rectify=False,
    )
    info = messages.new(
        "sensor_msgs/msg/CameraInfo",
        header=messages.header(0, IMAGE_FRAME),
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.column_stack([matrix, np.zeros(3)]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=whole,
    )
    return messages.encode(info)


def depth_millimeters(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Convert depth to millimeters (16UC1); infinite depth and depth beyond 65.5 m become 0."""
    millimeters = np.rint(np.where(np.isfinite(depth_m), depth_m, 0.0) * 1000.0)
    return np.where(millimeters <= np.iinfo(np.uint16).max, millimeters, 0).astype("<u2")


def _shape_marker(shape: Shape) -> Any:
    half = shape.yaw_rad / 2
    return _marker(
        frame=shape.frame,
        name=shape.name,
        kind=MARKER_TYPES[shape.kind],
        position=shape.position,
        rotation=(0.0, 0.0, math.sin(half), math.cos(half)),
        size=shape.size,
        color=shape.color,
        points=shape.points,
        text=shape.text,
    )


def _marker(
    *,
    action: int = _ADD,
    frame: str = "map",
    name: str = "",
    kind: int = 0,
    position: Vector = (0.0, 0.0, 0.0),
    rotation: Quad = (0.0, 0.0, 0.0, 1.0),
    size: Vector = (0.0, 0.0, 0.0),
    color: Quad = (0.0, 0.0, 0.0, 0.0),
    points: NDArray[np.float64] | Sequence[Vector] = (),
    text: str = "",
) -> Any:
    red, green, blue, opacity = color
    new, point = messages.new, messages.typestore().types["geometry_msgs/msg/Point"]
    return new(
        "visualization_msgs/msg/Marker",
        header=_unstamped(frame),
        ns=name,
        id=0,
        type=kind,
        action=action,
        pose=new(
            "geometry_msgs/msg/Pose",
            position=_point(position),
            orientation=_quaternion(rotation),
        ),
        scale=_vector(size),
        color=new("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=opacity),
        # With this flag, a marker moves with its frame, so static bodies are sent only once.
        frame_locked=True,
        points=[point(x=x, y=y, z=z) for x, y, z in _rounded_points(points)],
        text=text,
        **_unused_fields(),
    )


@lru_cache
def _unstamped(frame: str) -> Any:
    return messages.header(0, frame)


@lru_cache(maxsize=1)
def _unused_fields() -> dict[str, Any]:
    """Return the marker fields that have the same value in all markers.

    A lifetime of 0 means that a marker never expires.
    """
    new, nothing = messages.new, np.empty(0, np.uint8)
    image = "sensor_msgs/msg/CompressedImage"
    return {
        "lifetime": new("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        "colors": [],
        "texture_resource": "",
        "texture": new(image, header=messages.header(0, ""), format="", data=nothing),
        "uv_coordinates": [],
        "mesh_resource": "",
        "mesh_file": new("visualization_msgs/msg/MeshFile", filename="", data=nothing),
        "mesh_use_embedded_materials": False,
    }


def _rounded_points(points: NDArray[np.float64] | Sequence[Vector]) -> Any:
    return (np.rint(np.multiply(points, _POINTS_PER_M)) / _POINTS_PER_M).tolist()


def _rounded(numbers: Iterable[float], per_one: int) -> list[float]:
    """Round numbers to multiples of 1 / `per_one`."""
    return [round(number * per_one) / per_one for number in numbers]


def _point(xyz: Iterable[float]) -> Any:
    x, y, z = map(float, xyz)
    return messages.new("geometry_msgs/msg/Point", x=x, y=y, z=z)


def _vector(xyz: Iterable[float]) -> Any:
    x, y, z = map(float, xyz)
    return messages.new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _quaternion(xyzw: Iterable[float]) -> Any:
    x, y, z, w = xyzw
    return messages.new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
