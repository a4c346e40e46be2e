"""Conversion of a simulator's scene into ROS messages.

A simulator provides a scene by implementing one or more of the protocols below on its unwrapped
environment. Shapes and frames are any objects with the attributes of `Shape` and `Frame`, so a
simulator does not need to import this module. Axes follow REP 103: right-handed, z up, meters.

A message of `/tf` at the log_time of a step contains the poses of the frames until the end of the
step, each with its own stamp: a viewer interpolates between two poses, so it needs the pose after
the current time, too. `/scene/tracks` shows the tracks of a vehicle in the episodes so far, and
`/scene/map` its route, its track in this episode, and its place.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.format import messages
from mcaprl.recorder.format.schema import IMAGE_FRAME

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
_NO_POINTS = np.empty((0, 3))
# Fields of a marker: id, type and action; then pose, scale, color, lifetime, frame_locked and the
# number of points.
_KIND, _POSE_TO_COUNT = struct.Struct("<3i"), struct.Struct("<10d4fiI?3xI")
_TRANSFORM = struct.Struct("<7d")
_FLOAT32_BYTES, _FLOAT64_BYTES = 4, 8
# Fields that are empty in all markers. An empty string consists of its length, 1, and a NUL. First
# from `colors` to `uv_coordinates`, then from `mesh_resource` to `mesh_use_embedded_materials`.
_EMPTY, _NONE = b"\1\0\0\0\0\0\0\0", bytes(4)
_COLORS_TO_TEXTURE = _NONE + _EMPTY + bytes(8) + _EMPTY + _EMPTY + _NONE + _NONE
_MESH = _EMPTY + _EMPTY + _NONE + b"\0"
_COLORS_TO_MESH = _COLORS_TO_TEXTURE + _EMPTY + _MESH
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
        """Return the shapes that stay the same in an episode. Their coordinate frames may move.

        If this is the same tuple as in the previous episode, its shapes must not have changed.
        """

    def scene(self) -> Sequence[Shape]:
        """Return the current shapes that change from step to step."""

    def static_frames(self) -> Sequence[Frame]:
        """Return the coordinate frames that are fixed in their parents."""

    def frames(self) -> Sequence[Frame]:
        """Return the moving coordinate frames with their current poses."""


@runtime_checkable
class MapSource(Protocol):
    """An environment with shapes for the view from above, such as a route."""

    def map_scene(self) -> Sequence[Shape]:
        """Return shapes that stay the same in an episode, large enough to see the whole world."""


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
    """Encode shapes as one `visualization_msgs/msg/MarkerArray`."""
    # The first marker deletes all earlier ones, so that a viewer that seeks shows only these.
    # Stamps of 0 refer to the latest transform, and make equal shapes equal messages.
    shapes = list(shapes)
    message = messages.CdrWriter()
    message.add_count(1 + len(shapes))
    _add_marker(message, action=_DELETE_ALL)
    for shape in shapes:
        _add_shape(message, shape)
    return message.to_bytes()


def transforms(frames: Iterable[Frame], time_ns: int) -> bytes:
    """Encode coordinate frames as one `tf2_msgs/msg/TFMessage`."""
    return timed_transforms([(time_ns, frame) for frame in frames])


def timed_transforms(frames: Sequence[tuple[int, Frame]]) -> bytes:
    """Encode coordinate frames, each with its time in nanoseconds, like `transforms`."""
    message = messages.CdrWriter()
    message.add_count(len(frames))
    for time_ns, frame in frames:
        message.add_header(time_ns, frame.parent)
        message.add_text(frame.name)
        translation = _rounded(frame.position, _POSITIONS_PER_M)
        rotation = _rounded(frame.rotation, _ROTATIONS_PER_ONE)
        message.add(_TRANSFORM.pack(*translation, *rotation), _FLOAT64_BYTES)
    return message.to_bytes()


def camera_info(focal_px: tuple[float, float], shape: tuple[int, ...]) -> bytes:
    """Encode a pinhole camera as `sensor_msgs/msg/CameraInfo`, without distortion."""
    # The axis passes through the middle; (0, 0) is the middle of the first pixel.
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


def _add_shape(message: messages.CdrWriter, shape: Shape) -> None:
    half = shape.yaw_rad / 2
    _add_marker(
        message,
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


def _add_marker(
    message: messages.CdrWriter,
    *,
    action: int = _ADD,
    frame: str = "map",
    name: str = "",
    kind: int = 0,
    position: Vector = (0.0, 0.0, 0.0),
    rotation: Quad = (0.0, 0.0, 0.0, 1.0),
    size: Vector = (0.0, 0.0, 0.0),
    color: Quad = (0.0, 0.0, 0.0, 0.0),
    points: NDArray[np.float64] = _NO_POINTS,
    text: str = "",
) -> None:
    """Add a `visualization_msgs/msg/Marker`."""
    message.add(_header_to_action(frame, name, kind, action), _FLOAT32_BYTES)
    # A lifetime of 0 means that a marker never expires. With `frame_locked`, a marker moves with
    # its frame, so static bodies are sent only once.
    pose = *position, *rotation
    data = _POSE_TO_COUNT.pack(*pose, *size, *color, 0, 0, True, len(points))
    message.add(data, _FLOAT64_BYTES)
    if len(points):
        points = np.rint(np.multiply(points, _POINTS_PER_M)) / _POINTS_PER_M
        message.add(points.astype("<f8", copy=False).tobytes(), _FLOAT64_BYTES)
    if not text:
        message.add(_COLORS_TO_MESH, _FLOAT32_BYTES)
        return
    message.add(_COLORS_TO_TEXTURE, _FLOAT32_BYTES)
    message.add_text(text)
    message.add(_MESH, _FLOAT32_BYTES)


@lru_cache(maxsize=1024)
def _header_to_action(frame: str, name: str, kind: int, action: int) -> bytes:
    """Encode the first fields of a marker, which are often equal to those of an earlier marker."""
    fields = messages.CdrWriter()
    fields.add_header(0, frame)
    fields.add_text(name)
    fields.add(_KIND.pack(0, kind, action), _FLOAT32_BYTES)
    return fields.fields()


def _rounded(numbers: Iterable[float], per_one: int) -> list[float]:
    """Round numbers to multiples of 1 / `per_one`."""
    return [round(number * per_one) / per_one for number in numbers]


Moment = tuple[int, Sequence[Frame]]
"""log_time in nanoseconds, and the moving coordinate frames at that time."""

_TOLERANCE_M = 0.04
_TOLERANCE_ROTATION = 0.01
"""Maximum error of a quaternion component. For small angles, it is a rotation of 0.02 rad."""


def motion_transforms(moments: Sequence[Moment], *, thins: bool = True) -> bytes:
    """Encode the moments of a step as one `tf2_msgs/msg/TFMessage`, in order of time."""
    # `thins` omits poses that interpolation reproduces within 0.04 m and 0.02 rad.
    times = np.array([time_ns for time_ns, _ in moments], np.float64) - moments[0][0]
    kept = []
    for number in range(len(moments[0][1])):
        frames = [each[number] for _, each in moments]
        every = range(len(moments))
        for k in knots(times, _scaled(frames)) if thins and len(moments) > 1 else every:
            kept.append((moments[k][0], number, frames[k]))
    kept.sort(key=lambda each: each[:2])
    return timed_transforms([(time_ns, frame) for time_ns, _, frame in kept])


def knots(times: NDArray[np.float64], values: NDArray[np.float64]) -> list[int]:
    """Select rows (N,) from which linear interpolation reproduces the others within 1.

    >>> times = np.arange(5.0)
    >>> knots(times, times[:, None] * 7), knots(times, np.array([[0.0], [0], [0], [4], [8]]))
    ([0, 4], [0, 2, 4])
    """
    if len(times) == 2:
        return [0, 1]
    share = ((times - times[0]) / (times[-1] - times[0]))[:, None]
    missed = np.abs(values - values[0] - share * (values[-1] - values[0])).max(axis=1)
    worst = int(missed.argmax())
    if missed[worst] <= 1.0:
        return [0, len(times) - 1]
    after = knots(times[worst:], values[worst:])
    return knots(times[: worst + 1], values[: worst + 1]) + [worst + k for k in after[1:]]


def _scaled(frames: Sequence[Frame]) -> NDArray[np.float64]:
    """Return (N, 7) positions and quaternions in units of their tolerances."""
    positions = np.array([frame.position for frame in frames]) / _TOLERANCE_M
    rotations = np.array([frame.rotation for frame in frames])
    # A quaternion and its negative are the same rotation.
    rotations *= np.where(rotations @ rotations[0] < 0.0, -1.0, 1.0)[:, None]
    return np.column_stack([positions, rotations / _TOLERANCE_ROTATION])


_MAX_TRACKS = 32
_MAX_POINTS = 64
_LEAST_NEW = 4
_VEHICLE_SHARE = 0.05
_RAISED_M = 0.2
_MIN_WIDTH_M = 0.05
# A track is 1/250 of the world's size wide, so that it is visible in a view of the whole world. A
# mark is five times as wide as a track.
_WIDTHS_PER_WORLD, _WIDTHS_PER_MARK = 250, 5
_LOW_RETURN, _HIGH_RETURN = np.array([0.30, 0.25, 0.80]), np.array([0.98, 0.85, 0.25])
_FAILED: Quad = (0.90, 0.10, 0.10, 1.0)
_SO_FAR: Quad = (0.20, 0.62, 0.95, 1.0)


class TrackShape(NamedTuple):
    """A track, or a mark at the end of a failed track. For the attributes, see `scene.Shape`."""

    name: str
    kind: str
    color: Quad
    points: NDArray[np.float64]
    size: Vector
    position: Vector = (0.0, 0.0, 0.0)
    yaw_rad: float = 0.0
    frame: str = "map"
    text: str = ""


def map_shapes(source: object, frame: str, world_m: float, tracks: Tracks) -> list[Shape]:
    """Return the shapes for a view from above: the route, this episode's track, and the vehicle."""
    shapes: list[Shape] = [*source.map_scene()] if isinstance(source, MapSource) else []
    shapes += tracks.so_far(world_m / _WIDTHS_PER_WORLD)
    if frame:
        half = _VEHICLE_SHARE * world_m / 2
        ends, size = np.array([[-half, 0.0, 0.0], [half, 0.0, 0.0]]), (0.7 * half, 1.6 * half, half)
        shapes.append(TrackShape("vehicle", "arrow", _FAILED, ends, size, frame=frame))
    return shapes


class _Track(NamedTuple):
    episode: int
    points_m: NDArray[np.float64]
    total_reward: float
    failed: bool


class Tracks:
    """Tracks of the last 32 episodes, colored by return from blue (lowest) to yellow (highest)."""

    def __init__(self) -> None:
        """Start without tracks."""
        self._tracks: deque[_Track] = deque(maxlen=_MAX_TRACKS)
        self.begin()

    def begin(self) -> None:
        """Begin an episode."""
        self._points_m: list[Vector] = []
        self._due = 1

    def add(self, position_m: Vector) -> bool:
        """Add a position (x, y, z), meters."""
        # Return whether to show the track: if a sixteenth longer.
        self._points_m.append(position_m)
        count = len(self._points_m)
        is_due = count >= self._due
        if is_due:
            self._due = count + max(_LEAST_NEW, count // 16)
        return is_due

    def so_far(self, width_m: float) -> list[TrackShape]:
        """Return a line through the positions of this episode, at most every 64th of them."""
        count, stride = len(self._points_m), 1
        if count < 2:
            return []
        # A stride that doubles leaves most points as they were, which compresses well.
        while count > stride * _MAX_POINTS:
            stride *= 2
        kept_m = np.array(self._points_m[::stride], np.float64)
        kept_m[:, 2] += _RAISED_M
        return [TrackShape("track", "line", _SO_FAR, kept_m, (width_m, 0.0, 0.0))]

    def end(self, episode: int, total_reward: float, *, failed: bool) -> None:
        """Keep the episode's track, reduced to at most 64 evenly spaced positions."""
        points_m = np.array(self._points_m, np.float64).reshape(-1, 3)
        if len(points_m) < 2:
            return
        kept = np.linspace(0, len(points_m) - 1, min(len(points_m), _MAX_POINTS)).round()
        raised = points_m[kept.astype(int)] + [0.0, 0.0, _RAISED_M]
        self._tracks.append(_Track(episode, raised, total_reward, failed))

    def shapes(self) -> list[TrackShape]:
        """Return a line for each track, and a red sphere at the end of each failed one."""
        if not self._tracks:
            return []
        width_m = self._width_m()
        shapes = [
            TrackShape(f"track_{track.episode}", "line", color, track.points_m, (width_m, 0.0, 0.0))
            for track, color in zip(self._tracks, self._colors(), strict=True)
        ]
        mark_m = _WIDTHS_PER_MARK * width_m
        for track in self._tracks:
            if track.failed:
                x_m, y_m, z_m = track.points_m[-1].tolist()
                size, nothing = (mark_m, mark_m, mark_m), np.empty((0, 3))
                name, at = f"failed_{track.episode}", (x_m, y_m, z_m)
                shapes.append(TrackShape(name, "sphere", _FAILED, nothing, size, at))
        return shapes

    def _width_m(self) -> float:
        points_m = np.concatenate([track.points_m for track in self._tracks])
        world_m = float(np.ptp(points_m, axis=0).max())
        return max(_MIN_WIDTH_M, world_m / _WIDTHS_PER_WORLD)

    def _colors(self) -> list[Quad]:
        # Infinite returns and NaN have no color, so finite numbers replace them.
        returns = np.nan_to_num([track.total_reward for track in self._tracks])
        low, high = returns.min(), returns.max()
        shares = np.ones(len(returns))
        if high > low:
            shares = returns / (high - low) - low / (high - low)
        colors = _LOW_RETURN + shares[:, None] * (_HIGH_RETURN - _LOW_RETURN)
        return [(red, green, blue, 1.0) for red, green, blue in colors.tolist()]
