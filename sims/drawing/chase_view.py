"""Perspective view of a scene from behind a body, drawn from back to front.

Faces that lie flat on the ground are drawn first, the lowest first. Then all other faces are drawn,
the farthest first. The order is based on the distances to the middles of the faces. It can be wrong
for a large face next to a small face. For depth images, see `sims.drawing.camera`.

The faces are drawn over each other in a given order, with two samples per pixel in each direction,
for smooth edges. A sample stores a color as 0xRRGGBB. For depth images, see `sims.drawing.camera`.

Camera axes are those of a ROS optical frame (REP 103): x right, y down, z into the image.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled
from mcaprl.sims.drawing.camera import clip_near, project
from mcaprl.sims.drawing.scene import Color, Frame, Shape
from mcaprl.sims.drawing.top_view import Canvas
from mcaprl.sims.geometry import box_faces

Floats = NDArray[np.float64]
Samples = NDArray[np.uint32]

SMOOTH = 2  # Number of samples per pixel in each direction
NEAR_M = 0.3  # Distance of the near plane
FAR_M = 400.0
"""Maximum distance at which faces are drawn, for the faces that the argument `far` counts."""
_WIDEST_PX = 24.0
"""Maximum width of a stroke; a wide stroke close to the camera would hide everything."""
_SUN = (0.36, 0.28, 0.89)
_FLAT_M, _LEVEL_M = 0.15, 0.01
_GROUND_KEY = -1e9  # Key of a face on the ground at z = 0; all other faces are nearer than 1e9 m
RIM = np.array([(math.cos(a), math.sin(a)) for a in np.arange(12) * math.pi / 6]) / 2
"""(12, 2) points on a circle of diameter 1."""


class Faces(NamedTuple):
    """Polygons, and strokes between two points."""

    corners_m: Floats  # (N, 3) corners of all faces
    starts: NDArray[np.int64]
    """(F + 1,) face k has the corners from `starts[k]` up to, but not including, `starts[k + 1]`.
    A stroke has two corners, a polygon is convex and has up to 12."""
    colors: Floats  # (F, 3) red, green and blue, each 0 to 1
    widths_m: Floats  # (F,) widths of strokes; 0 for a polygon


class Eye(NamedTuple):
    """Camera of an image."""

    at_m: Floats  # (3,) position in the map
    axes: Floats  # (3, 3) axes of the camera as columns, in the map's coordinates
    focal_px: float  # Focal length; the optical axis meets the middle of the image


def joined(parts: Sequence[Faces]) -> Faces:
    """Return the faces of all parts, of which there is at least one, in the given order."""
    before = np.cumsum([0, *(len(part.corners_m) for part in parts)])
    starts = [part.starts[:-1] + count for part, count in zip(parts, before[:-1], strict=True)]
    return Faces(
        np.concatenate([part.corners_m for part in parts]),
        np.append(np.concatenate(starts), before[-1]),
        np.concatenate([part.colors for part in parts]),
        np.concatenate([part.widths_m for part in parts]),
    )


class Painter:
    """Painter of images of one size."""

    def __init__(self, size_px: tuple[int, int]) -> None:
        """Prepare the samples of an image of this width and height."""
        width_px, height_px = size_px
        self._samples = np.empty((SMOOTH * height_px, SMOOTH * width_px), np.uint32)

    def draw(self, faces: Faces, far: int, eye: Eye, sky: Sequence[float]) -> NDArray[np.uint8]:
        """Render one image, (height, width, 3)."""
        rows, columns = self._samples.shape
        order_by = np.empty(len(faces.widths_m))
        keys(faces, far, eye, columns // SMOOTH, rows // SMOOTH, order_by)
        order = np.argsort(order_by, kind="stable")[: np.count_nonzero(order_by < math.inf)]
        self._samples[:] = packed(*sky[:3])
        paint(faces, order, eye, self._samples)
        image = np.empty((rows // SMOOTH, columns // SMOOTH, 3), np.uint8)
        shrink(self._samples, image)
        return image


@compiled
def packed(red: float, green: float, blue: float) -> int:
    """Return a color, with parts of 0 to 1, as 0xRRGGBB."""
    return (round(255 * red) << 16) + (round(255 * green) << 8) + round(255 * blue)


@compiled
def keys(faces: Faces, far: int, eye: Eye, width_px: int, height_px: int, order_by: Floats) -> None:
    """Compute sort keys (F,) of faces: first those flat on the ground, then the farthest."""
    # Outside the image, they are infinite. The first `far` faces are drawn only within `FAR_M`.
    wide, high = 0.5 * width_px / eye.focal_px, 0.5 * height_px / eye.focal_px
    wide_reach, high_reach = math.hypot(1.0, wide), math.hypot(1.0, high)
    for face in range(len(order_by)):
        first, stop = faces.starts[face], faces.starts[face + 1]
        x = y = z = 0.0
        low, top = math.inf, -math.inf
        for i in range(first, stop):
            x += faces.corners_m[i, 0]
            y += faces.corners_m[i, 1]
            z += faces.corners_m[i, 2]
            low, top = min(low, faces.corners_m[i, 2]), max(top, faces.corners_m[i, 2])
        x, y, z = x / (stop - first), y / (stop - first), z / (stop - first)
        reach_m = 0.0
        for i in range(first, stop):
            dx, dy = faces.corners_m[i, 0] - x, faces.corners_m[i, 1] - y
            dz = faces.corners_m[i, 2] - z
            reach_m = max(reach_m, math.sqrt(dx * dx + dy * dy + dz * dz))
        reach_m += faces.widths_m[face]
        dx, dy, dz = x - eye.at_m[0], y - eye.at_m[1], z - eye.at_m[2]
        right = dx * eye.axes[0, 0] + dy * eye.axes[1, 0] + dz * eye.axes[2, 0]
        down = dx * eye.axes[0, 1] + dy * eye.axes[1, 1] + dz * eye.axes[2, 1]
        ahead = dx * eye.axes[0, 2] + dy * eye.axes[1, 2] + dz * eye.axes[2, 2]
        seen = ahead + reach_m > NEAR_M
        seen &= abs(right) - wide * ahead <= wide_reach * reach_m
        seen &= abs(down) - high * ahead <= high_reach * reach_m
        seen &= face >= far or math.hypot(dx, dy) < FAR_M
        if not seen:
            order_by[face] = math.inf
        elif top <= _FLAT_M and top - low < _LEVEL_M:
            order_by[face] = _GROUND_KEY + faces.corners_m[first, 2]
        else:
            order_by[face] = -math.sqrt(dx * dx + dy * dy + dz * dz)


@compiled
def paint(faces: Faces, order: NDArray[np.int64], eye: Eye, samples: Samples) -> None:
    """Draw faces over the samples of an image."""
    # The near plane adds at most one corner to a convex polygon.
    corners, clipped, flat = np.empty((12, 3)), np.empty((13, 3)), np.empty((13, 2))
    lefts, rights = np.empty(samples.shape[0]), np.empty(samples.shape[0])
    for k in range(len(order)):
        face = order[k]
        first, count = faces.starts[face], faces.starts[face + 1] - faces.starts[face]
        for i in range(count):
            dx = faces.corners_m[first + i, 0] - eye.at_m[0]
            dy = faces.corners_m[first + i, 1] - eye.at_m[1]
            dz = faces.corners_m[first + i, 2] - eye.at_m[2]
            for axis in range(3):
                corners[i, axis] = (
                    dx * eye.axes[0, axis] + dy * eye.axes[1, axis] + dz * eye.axes[2, axis]
                )
        width_m, light = faces.widths_m[face], 1.0
        count = clip_near(corners, count, NEAR_M, width_m == 0.0, clipped)
        project(clipped, count, SMOOTH * eye.focal_px, samples.shape, flat)
        if width_m > 0.0:
            if count < 2:
                continue
            count = _stroke(clipped, SMOOTH * eye.focal_px * width_m, flat)
        else:
            light = _light(faces.corners_m[first : first + 3])
        if count < 3:
            continue
        red, green, blue = faces.colors[face]
        color = np.uint32(packed(red * light, green * light, blue * light))
        top, stop = _spans(flat, count, lefts, rights)
        for row in range(top, stop):
            left = max(0, math.floor(max(lefts[row], 0.0)))
            right = math.floor(min(rights[row], samples.shape[1] - 1.0))
            if left <= right:
                samples[row, left : right + 1] = color


@compiled
def _stroke(ends: Floats, scale: float, flat: Floats) -> int:
    """Replace the ends of a stroke in `flat` by the corners of its polygon; return their number."""
    # A short stroke becomes a dot. `scale` is its width at a distance of one meter, in samples.
    x, y = flat[0, 0], flat[0, 1]
    along_x, along_y = flat[1, 0] - x, flat[1, 1] - y
    length = math.hypot(along_x, along_y)
    half = 0.5 * min(max(scale / ends[0, 2], 1.0 * SMOOTH), _WIDEST_PX * SMOOTH)
    half_end = 0.5 * min(max(scale / ends[1, 2], 1.0 * SMOOTH), _WIDEST_PX * SMOOTH)
    if length < half / 2:
        for i in range(len(RIM)):
            flat[i, 0], flat[i, 1] = x + 2 * half * RIM[i, 0], y + 2 * half * RIM[i, 1]
        return len(RIM)
    across_x, across_y = -along_y / length, along_x / length
    end_x, end_y = x + along_x, y + along_y
    flat[0, 0], flat[0, 1] = x + across_x * half, y + across_y * half
    flat[1, 0], flat[1, 1] = end_x + across_x * half_end, end_y + across_y * half_end
    flat[2, 0], flat[2, 1] = end_x - across_x * half_end, end_y - across_y * half_end
    flat[3, 0], flat[3, 1] = x - across_x * half, y - across_y * half
    return 4


@compiled
def _light(corners_m: Floats) -> float:
    """Return the brightness of a polygon, which depends on its angle to the sun."""
    ax, ay = corners_m[1, 0] - corners_m[0, 0], corners_m[1, 1] - corners_m[0, 1]
    bx, by = corners_m[2, 0] - corners_m[0, 0], corners_m[2, 1] - corners_m[0, 1]
    az, bz = corners_m[1, 2] - corners_m[0, 2], corners_m[2, 2] - corners_m[0, 2]
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return 1.0
    light: float = 0.62 + 0.38 * abs(x * _SUN[0] + y * _SUN[1] + z * _SUN[2]) / length
    return light


@compiled
def _spans(flat: Floats, count: int, lefts: Floats, rights: Floats) -> tuple[int, int]:
    """Compute the left and right end of a convex polygon per row."""
    # Return the first and the end row. All rows and columns that it touches count: thin faces stay
    # visible, neighbors have no gap.
    rows = float(len(lefts))
    high, low = math.inf, -math.inf
    for i in range(count):
        high, low = min(high, flat[i, 1]), max(low, flat[i, 1])
    first = math.floor(min(max(high, 0.0), rows))
    stop = math.floor(max(min(low, rows - 1.0), -1.0)) + 1
    for row in range(first, stop):
        lefts[row], rights[row] = math.inf, -math.inf
    for i in range(count):
        j = (i + 1) % count
        a, b = (i, j) if flat[i, 1] <= flat[j, 1] else (j, i)
        x, y, end_x, end_y = flat[a, 0], flat[a, 1], flat[b, 0], flat[b, 1]
        gradient = (end_x - x) / (end_y - y) if end_y > y else 0.0
        # A steep edge has one sample per row, in whose middle it is looked up.
        inset = 0.5 if abs(end_x - x) <= end_y - y else 0.0
        begin = max(first, math.floor(min(max(y, 0.0), rows)))
        end = min(stop, math.floor(max(min(end_y, rows - 1.0), -1.0)) + 1)
        for row in range(begin, end):
            enters = min(max(y, row + inset), end_y)
            leaves = max(min(end_y, row + 1.0 - inset), y)
            at = x + (enters - y) * gradient
            # The condition includes horizontal edges.
            to = end_x if leaves >= end_y else x + (leaves - y) * gradient
            lefts[row] = min(lefts[row], at, to)
            rights[row] = max(rights[row], at, to)
    return first, stop


@compiled
def shrink(samples: Samples, image: NDArray[np.uint8]) -> None:
    """Average the samples of each pixel."""
    # With rows as contiguous 1-D arrays, the compiler can vectorize the loop over columns.
    lines = image.reshape(image.shape[0], 3 * image.shape[1])
    outer_mask, green_mask = np.uint32(0xFF00FF), np.uint32(0xFF00)
    for row in range(image.shape[0]):
        even, odd, line = samples[2 * row], samples[2 * row + 1], lines[row]
        for column in range(image.shape[1]):
            a, b = even[2 * column], even[2 * column + 1]
            c, d = odd[2 * column], odd[2 * column + 1]
            # Red and blue are summed at the same time: a sum of four bytes has ten bits.
            outer = (a & outer_mask) + (b & outer_mask) + (c & outer_mask) + (d & outer_mask)
            green = (a & green_mask) + (b & green_mask) + (c & green_mask) + (d & green_mask)
            line[3 * column] = np.uint8(outer >> np.uint32(18))
            line[3 * column + 1] = np.uint8(green >> np.uint32(10))
            line[3 * column + 2] = np.uint8(outer >> np.uint32(2))


HEIGHT_PX = 540
"""Default height of an image. The width is 16/9 of the height, rounded to an even number."""
BACK_M, ABOVE_M, AHEAD_M = 15.0, 6.5, 7.0
"""The camera is `BACK_M` behind the body and `ABOVE_M` above it. The camera looks at the point
`AHEAD_M` in front of the body."""
_FOCAL = 0.9  # Focal length divided by the width of an image
_SKY: Color = (0.55, 0.68, 0.80, 1.0)
_INK, _PLATE = (255, 255, 255), (20, 22, 26)
_BAR, _MARK, _BAR_PX = (70, 78, 90), (78, 152, 226), 160
_DOT = np.array([[0.0, 0.0, -1e-3], [0.0, 0.0, 1e-3]])
"""Two ends that are almost the same point. A stroke between them is drawn as a dot."""
_AT_ORIGIN = (np.eye(3), np.zeros(3))


class Pose(NamedTuple):
    """Pose of a coordinate frame in the map."""

    axes: Floats  # (3, 3) axes of the frame as columns
    at_m: Floats  # (3,) position


class Dial(NamedTuple):
    """A number drawn as a mark on a bar, with the numbers at the bar's two ends."""

    name: str
    value: float
    left: float
    right: float


class _Text(NamedTuple):
    """Text at a position in a frame."""

    at_m: Floats  # (3,) position
    text: str


class _Prepared(NamedTuple):
    """Faces and texts of a list of shapes, by frame, in the coordinates of the frame."""

    shapes: Sequence[Shape] | None  # The list
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
    """Return outlines in the shape's axes, and a line width: 0 for polygons (K, 3)."""
    # Strokes are (2, 3).
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
