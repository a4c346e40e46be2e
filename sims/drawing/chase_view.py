"""Perspective view of a scene from behind a body, drawn with pygame from back to front.

Faces that lie flat on the ground are drawn first, the lowest first. Then all other faces are drawn,
the farthest first. The order is based on the distances to the middles of the faces. It can be wrong
for a large face next to a small face. For depth images, see `sims.drawing.camera`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.canvas import Canvas
from mcaprl.sims.drawing.scene import Color, Frame, Shape
from mcaprl.sims.geometry.mesh import box_mesh

Floats = NDArray[np.float64]

SIZE_PX = (960, 540)
BACK_M, ABOVE_M, AHEAD_M = 15.0, 6.5, 7.0
"""The camera is `BACK_M` behind the body and `ABOVE_M` above it. The camera looks at the point
`AHEAD_M` in front of the body."""
FAR_M = 400.0
_FOCAL_PX = 0.9 * SIZE_PX[0]
_NEAR_M = 0.3
_WIDEST_PX = 24.0
"""Maximum width of a stroke; a wide stroke close to the camera would hide everything."""
_SKY: Color = (0.55, 0.68, 0.80, 1.0)
_SUN = (0.36, 0.28, 0.89)
_FLAT_M = 0.15
_INK, _PLATE = (255, 255, 255), (20, 22, 26)
_DOT = np.array([[0.0, 0.0, -1e-3], [0.0, 0.0, 1e-3]])
"""Two ends that are almost the same point. A stroke between them is drawn as a dot."""
_ROUND = np.array([(math.cos(a), math.sin(a)) for a in np.arange(12) * math.pi / 6]) / 2


class Pose(NamedTuple):
    """Pose of a coordinate frame in the map."""

    axes: Floats
    """(3, 3) axes of the frame as columns."""
    at_m: Floats
    """(3,) position."""


class _Piece(NamedTuple):
    """Polygon, stroke between two points, or text, in map coordinates."""

    corners_m: Floats
    """(K, 3) corners."""
    color: Color
    width_m: float = 0.0
    """Width of a stroke; 0 for a polygon."""
    text: str = ""


class ChaseView:
    """Renderer that prepares the static shapes once and then draws any number of images."""

    def __init__(self) -> None:
        """Prepare an empty image.

        Raises:
            MissingExtraError: Pygame is not installed.
        """
        self._canvas = Canvas("rgb_array", SIZE_PX, "", 1)
        self._prepared: tuple[Sequence[Shape], list[_Piece], Floats, Floats] | None = None

    def draw(
        self,
        static: Sequence[Shape],
        moving: Sequence[Shape],
        frames: Iterable[Frame],
        follow: str,
        lines: Sequence[str],
    ) -> NDArray[np.uint8]:
        """Render one image, (height, width, 3).

        Args:
            static: Static shapes. If this is the same list object as in the last call, the shapes
                in the frame `map` are not prepared again.
            moving: Shapes that change.
            frames: All frames.
            follow: Name of the frame that the camera follows; if empty, the map's origin.
            lines: Lines of text in the corner.
        """
        poses = poses_of(frames)
        eye = chase_eye(poses.get(follow, Pose(np.eye(3), np.zeros(3))))
        pieces = self._visible_in_map(static, eye)
        on_bodies = [shape for shape in static if shape.frame != "map"]
        for shape in (*on_bodies, *moving):
            pieces += _pieces(shape, poses)
        pieces.sort(key=lambda piece: _order(piece, eye.at_m))
        width_px, height_px = SIZE_PX
        self._canvas.polygon(np.array([(0, 0), (width_px, 0), SIZE_PX, (0, height_px)]), _SKY)
        texts = [piece for piece in pieces if piece.text]
        for piece in pieces:
            corners = None if piece.text else _seen(piece, eye)
            if corners is not None:
                self._canvas.polygon(corners, _lit(piece))
        self._canvas.flatten()
        self._write(texts, eye, lines)
        return self._canvas.finish()

    def close(self) -> None:
        """Release the canvas."""
        self._canvas.close()

    def _visible_in_map(self, static: Sequence[Shape], eye: Pose) -> list[_Piece]:
        """Return the static pieces in the frame `map` that are in view and closer than `FAR_M`."""
        if self._prepared is None or self._prepared[0] is not static:
            pieces = [p for s in static if s.frame == "map" for p in _pieces(s, {})]
            middles = np.array([p.corners_m.mean(axis=0) for p in pieces]).reshape(-1, 3)
            radii_m = [
                np.linalg.norm(piece.corners_m - middle, axis=1).max() + piece.width_m
                for piece, middle in zip(pieces, middles, strict=True)
            ]
            self._prepared = (static, pieces, middles, np.array(radii_m))
        _, pieces, middles, reach_m = self._prepared
        near = np.hypot(*(middles - eye.at_m)[:, :2].T) < FAR_M
        return [pieces[i] for i in np.flatnonzero(near & _in_view(middles, reach_m, eye))]

    def _write(self, texts: Iterable[_Piece], eye: Pose, lines: Sequence[str]) -> None:
        for piece in texts:
            at = (piece.corners_m - eye.at_m) @ eye.axes
            if at[0, 2] > _NEAR_M:
                x, y = _projected(at)[0]
                self._canvas.text(piece.text, (round(x) - 5 * len(piece.text), round(y)), 24, _INK)
        if lines:
            height_px = 12 + 24 * len(lines)
            wide_px = 24 + 9 * max(map(len, lines))
            self._canvas.rectangle((0, 0, wide_px, height_px), _PLATE)
            for row, line in enumerate(lines):
                self._canvas.text(line, (12, 8 + 24 * row), 24, _INK)


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


def _pieces(shape: Shape, poses: Mapping[str, Pose]) -> list[_Piece]:
    """Return the faces and strokes of a shape in the map."""
    cos, sin = math.cos(shape.yaw_rad), math.sin(shape.yaw_rad)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    pose = poses.get(shape.frame, Pose(np.eye(3), np.zeros(3)))

    def placed(points_m: Floats) -> Floats:
        in_frame = points_m @ turn.T + np.array(shape.position)
        in_map: Floats = in_frame @ pose.axes.T + pose.at_m
        return in_map

    if shape.kind == "text":
        return [_Piece(placed(np.zeros((1, 3))), shape.color, text=shape.text)]
    outlines, width_m = _outlines(shape)
    return [_Piece(placed(outline), shape.color, width_m) for outline in outlines]


def _outlines(shape: Shape) -> tuple[list[Floats], float]:
    """Return outlines in the shape's own axes, and a line width.

    Polygons are (K, 3) with the width 0; strokes are (2, 3) with their width.
    """
    points, size = shape.points, shape.size
    match shape.kind:
        case "box":
            faces = box_mesh((0.0, 0.0, 0.0), size).reshape(2, 6, 3, 3)
            return [np.vstack([a, b[2:]]) for a, b in zip(*faces, strict=True)], 0.0
        case "cylinder":
            return _cylinder(size), 0.0
        case "sphere":
            return [_DOT], size[0]
        case "triangles":
            return list(points.reshape(-1, 3, 3)), 0.0
        case "points" | "spheres":
            return [_DOT + point for point in points], size[0]
        case "segments":
            return list(points.reshape(-1, 2, 3)), size[0]
        case _:
            return [np.array(pair) for pair in pairwise(points)], size[0]


def _cylinder(size: tuple[float, float, float]) -> list[Floats]:
    rim = _ROUND * size[:2]
    low, high = (np.column_stack([rim, np.full(12, z * size[2])]) for z in (-0.5, 0.5))
    sides = [np.array([low[i - 1], low[i], high[i], high[i - 1]]) for i in range(12)]
    return [*sides, high, low[::-1]]


def _order(piece: _Piece, eye_m: Floats) -> tuple[int, float]:
    heights_m = piece.corners_m[:, 2]
    if heights_m.max() <= _FLAT_M and np.ptp(heights_m) < 0.01:
        return 0, float(heights_m[0])
    return 1, -float(np.linalg.norm(piece.corners_m.mean(axis=0) - eye_m))


def _in_view(middles_m: Floats, radii_m: Floats, eye: Pose) -> NDArray[np.bool_]:
    """Return a mask of the spheres that are at least partly inside the view of the camera."""
    x_m, y_m, z_m = ((middles_m - eye.at_m) @ eye.axes).T
    seen: NDArray[np.bool_] = z_m + radii_m > _NEAR_M
    for aside_m, size_px in ((x_m, SIZE_PX[0]), (y_m, SIZE_PX[1])):
        gradient = size_px / 2 / _FOCAL_PX
        seen &= np.abs(aside_m) - gradient * z_m <= math.hypot(1.0, gradient) * radii_m
    return seen


def _seen(piece: _Piece, eye: Pose) -> Floats | None:
    """Project a piece to a polygon in the image; return None if it is behind the camera."""
    corners = _before_eye((piece.corners_m - eye.at_m) @ eye.axes, closed=piece.width_m == 0)
    if len(corners) < 2:
        return None
    flat = _projected(corners)
    if piece.width_m == 0:
        return flat if len(flat) > 2 else None
    return _stroke(flat, _FOCAL_PX * piece.width_m / corners[:, 2])


def _before_eye(corners: Floats, *, closed: bool) -> Floats:
    """Clip a closed polygon or an open line at the near plane."""
    if (corners[:, 2] >= _NEAR_M).all():
        return corners
    kept: list[Floats] = []
    for i, here in enumerate(corners):
        if here[2] >= _NEAR_M:
            kept.append(here)
        if i + 1 == len(corners) and not closed:
            break
        there = corners[(i + 1) % len(corners)]
        if (here[2] >= _NEAR_M) != (there[2] >= _NEAR_M):
            kept.append(here + (_NEAR_M - here[2]) / (there[2] - here[2]) * (there - here))
    return np.array(kept).reshape(-1, 3)


def _projected(corners: Floats) -> Floats:
    middle = np.array(SIZE_PX) / 2
    flat: Floats = middle + _FOCAL_PX * corners[:, :2] / corners[:, 2:]
    return np.clip(flat, -4000, 4000)


def _stroke(ends: Floats, widths_px: Floats) -> Floats:
    """Return the polygon of a stroke with a width at each end; a short stroke becomes a dot."""
    along = ends[1] - ends[0]
    length = float(np.hypot(*along))
    half_px = np.clip(widths_px, 1.0, _WIDEST_PX)[:, None] / 2
    if length < half_px[0, 0] / 2:
        dot: Floats = ends[0] + 2 * half_px[0] * _ROUND
        return dot
    across = np.array([[-along[1], along[0]]]) / length * half_px
    return np.vstack([ends + across, (ends - across)[::-1]])


def _lit(piece: _Piece) -> Color:
    """Return the color of a piece; faces are shaded by their angle to the sun."""
    if piece.width_m:
        return piece.color
    corners = piece.corners_m
    (ax, ay, az), (bx, by, bz) = (corners[1:3] - corners[0]).tolist()
    # NumPy's cross product is slow for a single pair of vectors.
    normal = (ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)
    length = math.hypot(*normal)
    light = (
        0.62 + 0.38 * abs(sum(n * s for n, s in zip(normal, _SUN, strict=True))) / length
        if length
        else 1.0
    )
    red, green, blue, opacity = piece.color
    return red * light, green * light, blue * light, opacity
