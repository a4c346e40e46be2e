"""Software painter of flat faces in perspective, on one CPU core.

The faces are drawn over each other in a given order, with two samples per pixel in each direction,
for smooth edges. A sample stores a color as 0xRRGGBB. For depth images, see `sims.drawing.camera`.

Camera axes are those of a ROS optical frame (REP 103): x right, y down, z into the image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled
from mcaprl.sims.drawing.camera import clip_near, project

Floats = NDArray[np.float64]
Samples = NDArray[np.uint32]

SMOOTH = 2
"""Number of samples per pixel in each direction."""
NEAR_M = 0.3
"""Distance of the near plane."""
FAR_M = 400.0
"""Maximum distance at which faces are drawn, for the faces that the argument `far` counts."""
_WIDEST_PX = 24.0
"""Maximum width of a stroke; a wide stroke close to the camera would hide everything."""
_SUN = (0.36, 0.28, 0.89)
_FLAT_M, _LEVEL_M = 0.15, 0.01
_GROUND_KEY = -1e9
"""Key of a face on the ground at z = 0; all other faces are nearer than 1e9 m."""
RIM = np.array([(math.cos(a), math.sin(a)) for a in np.arange(12) * math.pi / 6]) / 2
"""(12, 2) points on a circle of diameter 1."""


class Faces(NamedTuple):
    """Polygons, and strokes between two points."""

    corners_m: Floats
    """(N, 3) corners of all faces."""
    starts: NDArray[np.int64]
    """(F + 1,) face k has the corners from `starts[k]` up to, but not including, `starts[k + 1]`.
    A stroke has two corners, a polygon is convex and has up to 12."""
    colors: Floats
    """(F, 3) red, green and blue, each 0 to 1."""
    widths_m: Floats
    """(F,) widths of strokes; 0 for a polygon."""


class Eye(NamedTuple):
    """Camera of an image."""

    at_m: Floats
    """(3,) position in the map."""
    axes: Floats
    """(3, 3) axes of the camera as columns, in the map's coordinates."""
    focal_px: float
    """Focal length; the optical axis meets the middle of the image."""


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
    """Compute the keys by which the faces are sorted before they are drawn.

    Faces that lie flat on the ground come first, the lowest first; then all other faces, the
    farthest first. Faces outside the image have the key infinity.

    Args:
        faces: Faces in the map.
        far: Number of faces at the start of `faces` that are drawn only within `FAR_M`.
        eye: Camera.
        width_px: Width of the image.
        height_px: Height of the image.
        order_by: (F,) output.
    """
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
    """Replace the ends of a stroke in `flat` by the corners of its polygon.

    A short stroke becomes a dot.

    Args:
        ends: (2, 3) ends in camera coordinates.
        scale: Width of the stroke at a distance of one meter, in samples.
        flat: (2, 2) ends in the image; output: the corners.

    Returns:
        Number of corners.
    """
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
    """Compute the left and right end of a convex polygon on each row of samples.

    Each row and column of samples that the polygon touches counts, so that a face that is thinner
    than a sample remains visible, and neighbors have no gap between them.

    Args:
        flat: (K, 2) corners in samples.
        count: Number of corners.
        lefts: (rows,) output: left end on each row that the polygon touches.
        rights: (rows,) output: right end on each of these rows.

    Returns:
        First row that the polygon touches, and the row after the last one.
    """
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
