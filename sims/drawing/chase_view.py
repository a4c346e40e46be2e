"""Perspective view of a scene from behind a body, drawn from back to front.

Faces that lie flat on the ground are drawn first, the lowest first. Then all other faces are drawn,
the farthest first. The order is based on the distances to the middles of the faces. It can be wrong
for a large face next to a small face. For depth images, see `sims.drawing.camera`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.painter import NEAR_M, RIM, Eye, Faces, Painter, joined
from mcaprl.sims.drawing.scene import Color, Frame, Shape
from mcaprl.sims.drawing.top_view import Canvas
from mcaprl.sims.geometry.mesh import box_faces

Floats = NDArray[np.float64]

HEIGHT_PX = 540
"""Default height of an image. The width is 16/9 of the height, rounded to an even number."""
BACK_M, ABOVE_M, AHEAD_M = 15.0, 6.5, 7.0
"""The camera is `BACK_M` behind the body and `ABOVE_M` above it. The camera looks at the point
`AHEAD_M` in front of the body."""
_FOCAL = 0.9
"""Focal length divided by the width of an image."""
_SKY: Color = (0.55, 0.68, 0.80, 1.0)
_INK, _PLATE = (255, 255, 255), (20, 22, 26)
_BAR, _MARK, _BAR_PX = (70, 78, 90), (78, 152, 226), 160
_DOT = np.array([[0.0, 0.0, -1e-3], [0.0, 0.0, 1e-3]])
"""Two ends that are almost the same point. A stroke between them is drawn as a dot."""
_AT_ORIGIN = (np.eye(3), np.zeros(3))


class Pose(NamedTuple):
    """Pose of a coordinate frame in the map."""

    axes: Floats
    """(3, 3) axes of the frame as columns."""
    at_m: Floats
    """(3,) position."""


class Dial(NamedTuple):
    """A number drawn as a mark on a bar, with the numbers at the bar's two ends."""

    name: str
    value: float
    left: float
    right: float


class _Text(NamedTuple):
    """Text at a position in a frame."""

    at_m: Floats
    """(3,) position."""
    text: str


class _Prepared(NamedTuple):
    """Faces and texts of a list of shapes, by frame, in the coordinates of the frame."""

    shapes: Sequence[Shape] | None
    """The list."""
    faces: dict[str, Faces]
    texts: dict[str, list[_Text]]


class ChaseView:
    """Renderer that prepares lists of shapes once and then draws any number of images."""

    def __init__(self, height_px: int = HEIGHT_PX) -> None:
        """Prepare an empty image of this height."""
        width_px = 2 * round(height_px * 8 / 9)
        self._center_px, self._focal_px = np.array([width_px, height_px]) / 2, _FOCAL * width_px
        self._canvas = Canvas("rgb_array", (width_px, height_px), "", 1)
        self._painter = Painter((width_px, height_px))
        self._static = self._moving = _Prepared(None, {}, {})

    def draw(
        self,
        static: Sequence[Shape],
        moving: Sequence[Shape],
        frames: Iterable[Frame],
        follow: str,
        lines: Sequence[str],
        dials: Sequence[Dial] = (),
    ) -> NDArray[np.uint8]:
        """Render one image, (height, width, 3), with lines and dials in its corner."""
        if self._static.shapes is not static:
            self._static = _prepared(static)
        if self._moving.shapes is not moving:
            self._moving = _prepared(moving)
        poses = poses_of(frames)
        body = chase_eye(poses.get(follow, Pose(*_AT_ORIGIN)))
        parts, far = [_NONE], 0
        if "map" in self._static.faces:
            parts.append(self._static.faces["map"])
            far = len(parts[-1].colors)
        for faces in (self._static.faces, self._moving.faces):
            fixed = faces is self._static.faces
            parts += [
                part._replace(corners_m=_placed(part.corners_m, poses.get(name)))
                for name, part in faces.items()
                if not (fixed and name == "map")
            ]
        eye = Eye(body.at_m, body.axes, self._focal_px)
        self._canvas.paste(self._painter.draw(joined(parts), far, eye, _SKY))
        for texts in (self._static.texts, self._moving.texts):
            self._write(texts, poses, body)
        self._write_lines(lines, dials)
        return self._canvas.finish()

    def close(self) -> None:
        """Release the canvas."""
        self._canvas.close()

    def _write(
        self, texts: Mapping[str, Iterable[_Text]], poses: Mapping[str, Pose], eye: Pose
    ) -> None:
        for name, here in texts.items():
            for at_m, text in here:
                x, y, z = (_placed(at_m, poses.get(name)) - eye.at_m) @ eye.axes
                if z > NEAR_M:
                    across, down = self._center_px + self._focal_px * np.array([x, y]) / z
                    # Pygame accepts no position that is far outside the image.
                    if abs(across) < 4000 and abs(down) < 4000:
                        at_px = (round(across) - 5 * len(text), round(down))
                        self._canvas.text(text, at_px, 24, _INK)

    def _write_lines(self, lines: Sequence[str], dials: Sequence[Dial]) -> None:
        if not lines and not dials:
            return
        bar_px = 24 + 9 * max((len(dial.name) for dial in dials), default=0)
        dials_px = bar_px + _BAR_PX + 12 if dials else 0
        wide_px = max(24 + 9 * max(map(len, lines), default=0), dials_px)
        self._canvas.rectangle((0, 0, wide_px, 12 + 24 * (len(lines) + len(dials))), _PLATE)
        for row, line in enumerate([*lines, *(dial.name for dial in dials)]):
            self._canvas.text(line, (12, 8 + 24 * row), 24, _INK)
        for row, dial in enumerate(dials, len(lines)):
            top_px = 10 + 24 * row
            self._canvas.rectangle((bar_px, top_px, _BAR_PX, 12), _BAR)
            if dial.left * dial.right < 0:
                self._canvas.rectangle((bar_px + _along(dial, 0.0), top_px, 1, 12), _INK)
            at_px = bar_px + _along(dial, dial.value)
            self._canvas.rectangle((at_px - 3, top_px - 2, 6, 16), _MARK)


def _along(dial: Dial, value: float) -> int:
    """Return the place of a value on the bar of a dial, in pixels."""
    share = (value - dial.left) / (dial.right - dial.left)
    return round(_BAR_PX * min(max(share, 0.0), 1.0))


def poses_of(frames: Iterable[Frame]) -> dict[str, Pose]:
    """Return the pose of each coordinate frame in the map, with its parents' poses applied.

    >>> car = Frame("car", (3.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    >>> lamp = Frame("lamp", (1.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0), parent="car")
    >>> poses_of([lamp, car])["lamp"].at_m.tolist()
    [4.0, 0.0, 2.0]
    """
    by_name = {frame.name: frame for frame in frames}
    found: dict[str, Pose] = {}

    def place(name: str) -> Pose:
        if name in found:
            return found[name]
        if name not in by_name:
            return Pose(np.eye(3), np.zeros(3))
        # Removing the frame ends the recursion if its parents form a cycle.
        frame = by_name.pop(name)
        parent = place(frame.parent)
        axes = parent.axes @ rotation_matrix(frame.rotation)
        found[name] = Pose(axes, parent.axes @ np.array(frame.position) + parent.at_m)
        return found[name]

    for name in list(by_name):
        place(name)
    return found


def rotation_matrix(xyzw: tuple[float, float, float, float]) -> Floats:
    """Return the (3, 3) rotation matrix of a quaternion."""
    x, y, z, w = np.array(xyzw) / math.hypot(*xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def chase_eye(body: Pose) -> Pose:
    """Return the pose of the camera behind a body; x is right and level, y down, z forward."""
    forward = body.axes[:, 0] * [1.0, 1.0, 0.0]
    length = float(np.linalg.norm(forward))
    forward = forward / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    at_m = body.at_m - BACK_M * forward + [0.0, 0.0, ABOVE_M]
    view = body.at_m + AHEAD_M * forward - at_m
    view /= np.linalg.norm(view)
    right = np.array([forward[1], -forward[0], 0.0])
    return Pose(np.column_stack([right, np.cross(view, right), view]), at_m)


def _placed(points_m: Floats, pose: Pose | None) -> Floats:
    """Transform points (..., 3) of a frame into the map; the map itself has no pose."""
    if pose is None:
        return points_m
    in_map: Floats = points_m @ pose.axes.T + pose.at_m
    return in_map


def _prepared(shapes: Sequence[Shape]) -> _Prepared:
    parts: dict[str, list[Faces]] = {}
    texts: dict[str, list[_Text]] = {}
    for shape in shapes:
        if shape.kind == "text":
            at = _Text(np.array(shape.position), shape.text)
            texts.setdefault(shape.frame, []).append(at)
        else:
            parts.setdefault(shape.frame, []).append(_faces(shape))
    return _Prepared(shapes, {name: joined(some) for name, some in parts.items()}, texts)


def _faces(shape: Shape) -> Faces:
    """Return the faces and strokes of a shape in its frame."""
    cos, sin = math.cos(shape.yaw_rad), math.sin(shape.yaw_rad)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    outlines, width_m = _outlines(shape)
    counts = [len(outline) for outline in outlines]
    corners_m = np.concatenate(outlines) if counts else np.empty((0, 3))
    return Faces(
        corners_m @ turn.T + np.array(shape.position),
        np.cumsum([0, *counts]),
        np.tile(np.array(shape.color[:3], np.float64), (len(counts), 1)),
        np.full(len(counts), float(width_m)),
    )


_NONE = Faces(np.empty((0, 3)), np.zeros(1, np.int64), np.empty((0, 3)), np.empty(0))


def _outlines(shape: Shape) -> tuple[Sequence[Floats] | Floats, float]:
    """Return outlines in the shape's own axes, and a line width.

    Polygons are (K, 3) with the width 0; strokes are (2, 3) with their width.
    """
    points, size = shape.points, shape.size
    match shape.kind:
        case "box":
            return box_faces((0.0, 0.0, 0.0), size), 0.0
        case "cylinder":
            return _cylinder(size), 0.0
        case "sphere":
            return [_DOT], size[0]
        case "triangles":
            return points.reshape(-1, 3, 3), 0.0
        case "points" | "spheres":
            return _DOT + points[:, np.newaxis], size[0]
        case "segments":
            return points.reshape(-1, 2, 3), size[0]
        case _:
            return np.stack([points[:-1], points[1:]], axis=1), size[0]


def _cylinder(size: tuple[float, float, float]) -> list[Floats]:
    rim = RIM * size[:2]
    low, high = (np.column_stack([rim, np.full(12, z * size[2])]) for z in (-0.5, 0.5))
    sides = [np.array([low[i - 1], low[i], high[i], high[i - 1]]) for i in range(12)]
    return [*sides, high, low[::-1]]
