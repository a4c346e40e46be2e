"""Software rasterizer for depth images of triangle meshes on one CPU core, without a display.

The z-buffer stores inverse depths. On a plane, 1/z is linear in image coordinates, so one division
per triangle suffices. Pixels that no triangle covers are 0.

Camera axes are those of a ROS optical frame (REP 103): x right, y down, z into the image.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled

Floats = NDArray[np.float64]

_NEAR_M = 0.1  # Distance of the near plane
_BACK_M = 1e-6  # Tolerance of back-face culling: the camera may be this far behind a face's plane
_FLAT_M = 1e-9
"""Tolerance for merging triangles: maximum distance of a corner from the other triangle's plane."""


class Lens(NamedTuple):
    """Pinhole camera with square pixels."""

    width_px: int
    height_px: int
    focal_px: float
    """Distance of the image plane, in pixels: half the width over tan(half the field of view)."""


def lens(width_px: int, height_px: int, horizontal_fov_rad: float) -> Lens:
    """Return the lens for an image size and a horizontal field of view.

    >>> lens(256, 144, math.pi / 2).focal_px
    128.00000000000003
    """
    return Lens(width_px, height_px, width_px / 2 / math.tan(horizontal_fov_rad / 2))


def focal_lengths(view: Lens, shape: tuple[int, int]) -> tuple[float, float]:
    """Return the focal lengths in x and y, in pixels, after the image is resized to `shape`.

    >>> focal_lengths(lens(256, 144, math.pi / 2), (72, 64))
    (32.00000000000001, 64.00000000000001)
    """
    height_px, width_px = shape
    return view.focal_px * width_px / view.width_px, view.focal_px * height_px / view.height_px


def ray_lengths(view: Lens) -> Floats:
    """Return (height, width) lengths of the rays from the camera to the plane z = 1."""
    return lengths((view.height_px, view.width_px), view.focal_px, view.focal_px)


def lengths(shape: tuple[int, int], focal_x_px: float, focal_y_px: float) -> Floats:
    """Return (height, width) lengths of the rays to the plane z = 1; pixels may be non-square."""
    height_px, width_px = shape
    x = (np.arange(width_px) + 0.5 - width_px / 2) / focal_x_px
    y = (np.arange(height_px) + 0.5 - height_px / 2) / focal_y_px
    return np.sqrt(x**2 + y[:, None] ** 2 + 1.0)


def level_axes(yaw_rad: float) -> Floats:
    """Return the (3, 3) axes, one per row, of a level camera that faces along a yaw angle."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[sin, -cos, 0.0], [0.0, 0.0, -1.0], [cos, sin, 0.0]])


def fronts(mesh: Floats) -> Floats:
    """Return planes (T, 4) of triangles: n, d of n . p = d with the unit normal n to the front."""
    ahead = np.cross(mesh[:, 1] - mesh[:, 0], mesh[:, 2] - mesh[:, 0])
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    return np.column_stack([ahead, (ahead * mesh[:, 0]).sum(axis=1)])


class Faces(NamedTuple):
    """Convex faces of a mesh with three or four corners each."""

    corners: Floats
    """(F, 4, 3) corners, counter-clockwise seen from the front; a triangle's fourth is unused."""
    counts: NDArray[np.int64]  # (F,) number of corners
    planes: Floats  # (F, 4) planes of the faces, see `fronts`


def faces_of(mesh: Floats) -> Faces:
    """Merge successive triangles (T, 3, 3) that are two halves of a convex quadrilateral."""
    corners = np.concatenate([mesh, mesh[:, :1]], axis=1)
    planes = fronts(mesh)
    has_partner, is_merged = np.zeros((2, len(mesh)), dtype=np.bool_)
    quads = [_quadrilaterals(mesh, planes, here, there) for here in range(3) for there in range(3)]
    for fits, quad in quads:
        corners[:-1][fits], has_partner[:-1][fits] = quad[fits], True
    for face in range(1, len(mesh)):
        is_merged[face] = has_partner[face - 1] and not is_merged[face - 1]
    counts = np.where(np.append(is_merged[1:], False), 4, 3)
    kept = ~is_merged
    return Faces(corners[kept], counts[kept], planes[kept])


def _quadrilaterals(
    mesh: Floats, planes: Floats, here: int, there: int
) -> tuple[NDArray[np.bool_], Floats]:
    """Merge each triangle but the last with the next one along one edge of each."""
    # Returns (T - 1,) whether the result is a flat convex quadrilateral, and (T - 1, 4, 3) these.
    first, second = mesh[:-1], mesh[1:]
    other = second[:, (there + 2) % 3]
    quads = np.insert(first, here + 1, other, axis=1)
    starts = (first[:, here] == second[:, (there + 1) % 3]).all(axis=1)
    ends = (first[:, (here + 1) % 3] == second[:, there]).all(axis=1)
    normals, offsets = planes[:-1, :3], planes[:-1, 3]
    is_flat = abs((normals * other).sum(axis=1) - offsets) <= _FLAT_M
    edges = np.roll(quads, -1, axis=1) - quads
    bends = (np.cross(edges, np.roll(edges, -1, axis=1)) * normals[:, None]).sum(axis=2)
    return starts & ends & is_flat & (bends > 0.0).all(axis=1), quads


@compiled
def draw(faces: Faces, eye_m: Floats, axes: Floats, focal_px: float, inverse_z: Floats) -> None:
    """Render a mesh into the image `inverse_z`."""
    inverse_z[:] = 0.0
    corners, polygon = np.empty((4, 3)), np.empty((5, 3))
    middles, left_u, right_u = np.empty((3, inverse_z.shape[0]))
    for row in range(len(middles)):
        middles[row] = row + 0.5
    columns = np.arange(0.0, inverse_z.shape[1])
    # Half the width and height of the view at z = 1. A corner on the border counts as inside.
    wide, high = 0.5 * inverse_z.shape[1] / focal_px, 0.5 * inverse_z.shape[0] / focal_px
    for face in range(len(faces.counts)):
        front, count = faces.planes[face], faces.counts[face]
        before_m = front[0] * eye_m[0] + front[1] * eye_m[1] + (front[2] * eye_m[2] - front[3])
        if before_m < -_BACK_M:
            continue
        too_near = right = left = below = above = True
        for i in range(count):
            dx = faces.corners[face, i, 0] - eye_m[0]
            dy = faces.corners[face, i, 1] - eye_m[1]
            dz = faces.corners[face, i, 2] - eye_m[2]
            x = axes[0, 0] * dx + axes[0, 1] * dy + axes[0, 2] * dz
            y = axes[1, 0] * dx + axes[1, 1] * dy + axes[1, 2] * dz
            z = axes[2, 0] * dx + axes[2, 1] * dy + axes[2, 2] * dz
            corners[i, 0], corners[i, 1], corners[i, 2] = x, y, z
            too_near &= z < _NEAR_M
            right &= x > wide * z
            left &= x < -wide * z
            below &= y > high * z
            above &= y < -high * z
        # A face with all corners beyond the same border is not in the image.
        if too_near or right or left or below or above:
            continue
        plane = _plane(corners)
        if plane.offset < 0.0:
            count = clip_near(corners, count, _NEAR_M, True, polygon)
            project(polygon, count, focal_px, inverse_z.shape, polygon)
            rows = _spans(polygon, count, middles, left_u, right_u)
            _fill(rows, left_u, right_u, columns, plane, focal_px, inverse_z)


class _Plane(NamedTuple):
    """Plane x p_x + y p_y + z p_z = offset, which is below 0 if the camera is in front."""

    x: float
    y: float
    z: float
    offset: float


@compiled
def _plane(corners: Floats) -> _Plane:
    """Return the plane through a face's first three corners, in camera coordinates."""
    ux, uy, uz = _difference(corners, 1)
    vx, vy, vz = _difference(corners, 2)
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return _Plane(x, y, z, x * corners[0, 0] + y * corners[0, 1] + z * corners[0, 2])


@compiled
def _difference(corners: Floats, i: int) -> tuple[float, float, float]:
    """Return the vector from a face's first corner to corner i."""
    return (
        corners[i, 0] - corners[0, 0],
        corners[i, 1] - corners[0, 1],
        corners[i, 2] - corners[0, 2],
    )


@compiled
def clip_near(corners: Floats, count: int, near_m: float, closed: bool, clipped: Floats) -> int:
    """Clip a polygon, or a line that is not closed, at a near plane; return the new length."""
    kept = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        here_m, there_m = corners[i, 2], corners[j, 2]
        if here_m >= near_m:
            for k in range(3):
                clipped[kept, k] = corners[i, k]
            kept += 1
        if (here_m >= near_m) != (there_m >= near_m) and (closed or j > 0):
            share = (near_m - here_m) / (there_m - here_m)
            for k in range(3):
                clipped[kept, k] = corners[i, k] + share * (corners[j, k] - corners[i, k])
            kept += 1
    return kept


@compiled
def project(
    corners: Floats, count: int, focal_px: float, shape: tuple[int, int], flat: Floats
) -> None:
    """Write the places of corners (K, 3) in an image to `flat`, pixels from its top left corner."""
    height, width = shape
    for i in range(count):
        scale = focal_px / corners[i, 2]
        flat[i, 0] = 0.5 * width + scale * corners[i, 0]
        flat[i, 1] = 0.5 * height + scale * corners[i, 1]


@compiled
def _spans(
    polygon: Floats, count: int, middles: Floats, left_u: Floats, right_u: Floats
) -> tuple[int, int]:
    """Compute the leftmost and rightmost u of a convex polygon per row."""
    # Return the first and end row. Each edge is evaluated from its upper end, so that adjacent
    # polygons get bit-identical results. The index of the inner loop is unsigned, so that the
    # compiler can vectorize it.
    top, bottom = math.inf, -math.inf
    for i in range(count):
        top, bottom = min(top, polygon[i, 1]), max(bottom, polygon[i, 1])
    first = max(0, math.ceil(max(top, 0.0) - 0.5))
    stop = math.ceil(min(float(len(middles)), bottom - 0.5))
    for row in range(first, stop):
        left_u[row], right_u[row] = math.inf, -math.inf
    for i in range(count):
        j = (i + 1) % count
        above, below = (i, j) if polygon[i, 1] <= polygon[j, 1] else (j, i)
        above_u, above_v = polygon[above, 0], polygon[above, 1]
        width, height = polygon[below, 0] - above_u, polygon[below, 1] - above_v
        start = max(first, math.ceil(max(above_v, 0.0) - 0.5))
        end = min(stop, math.ceil(min(float(len(middles)), polygon[below, 1] - 0.5)))
        for k in range(end - start):
            at = np.uint64(start + k)
            u = above_u + (middles[at] - above_v) / height * width
            left_u[at], right_u[at] = min(left_u[at], u), max(right_u[at], u)
    return first, stop


@compiled
def _fill(
    rows: tuple[int, int],
    left_u: Floats,
    right_u: Floats,
    columns: Floats,
    plane: _Plane,
    focal_px: float,
    inverse_z: Floats,
) -> None:
    """Fill a convex polygon in a plane."""
    # On an edge, pixels belong to the polygon right of or below it. At (u, v) from the middle of
    # the image, the inverse depth is (x u/f + y v/f + z) / offset, with the focal length f and the
    # fields of `plane`.
    height, width = inverse_z.shape
    middle_u, middle_v = 0.5 * width, 0.5 * height
    step = plane.x / (plane.offset * focal_px)
    for row in range(rows[0], rows[1]):
        start = math.ceil(max(0.0, left_u[row] - 0.5))
        end = math.ceil(min(float(width), right_u[row] - 0.5))
        at_v = plane.y / focal_px * (row + 0.5 - middle_v) + plane.z
        at_zero = at_v / plane.offset + step * (0.5 - middle_u)
        # The compiler can vectorize this loop: `max` needs no branch, an unsigned index needs no
        # comparison with 0, and `columns` needs no conversion to floats.
        line = np.uint64(row)
        for k in range(end - start):
            column = np.uint64(start + k)
            inverse_z[line, column] = max(inverse_z[line, column], at_zero + step * columns[column])


@compiled
def draw_wires(
    wires: Floats,
    eye_m: Floats,
    axes: Floats,
    focal_x_px: float,
    focal_y_px: float,
    inverse_z: Floats,
) -> None:
    """Draw wires (S, 2, 3) into the image `inverse_z`; nearer surfaces hide them."""
    # A wire is one pixel wide: in each column, or in each row if it is steeper than 45 degrees.
    ends = np.empty((2, 3))
    for wire in range(len(wires)):
        for i in range(2):
            for k in range(3):
                ends[i, k] = 0.0
                for m in range(3):
                    ends[i, k] += axes[k, m] * (wires[wire, i, m] - eye_m[m])
        if not _cut_near(ends):
            continue
        for i in range(2):
            ends[i, 2] = 1.0 / ends[i, 2]
            ends[i, 0] = 0.5 * inverse_z.shape[1] + focal_x_px * ends[i, 0] * ends[i, 2]
            ends[i, 1] = 0.5 * inverse_z.shape[0] + focal_y_px * ends[i, 1] * ends[i, 2]
        if abs(ends[1, 0] - ends[0, 0]) >= abs(ends[1, 1] - ends[0, 1]):
            _trace(ends, 0, inverse_z)
        else:
            _trace(ends, 1, inverse_z.T)


@compiled
def _cut_near(ends: Floats) -> bool:
    """Clip a wire at the near plane, in place; return whether any part is beyond the plane."""
    if ends[0, 2] < _NEAR_M and ends[1, 2] < _NEAR_M:
        return False
    for i in range(2):
        if ends[i, 2] < _NEAR_M:
            share = (_NEAR_M - ends[i, 2]) / (ends[1 - i, 2] - ends[i, 2])
            for k in range(3):
                ends[i, k] += share * (ends[1 - i, k] - ends[i, k])
    return True


@compiled
def _trace(ends: Floats, main: int, inverse_z: Floats) -> None:
    """Draw a line with one pixel per step along its main direction."""
    first, last = (0, 1) if ends[0, main] <= ends[1, main] else (1, 0)
    width, length = inverse_z.shape
    start, end = ends[first, main], ends[last, main]
    across, across_end = ends[first, 1 - main], ends[last, 1 - main]
    for step in range(math.ceil(max(0.0, start - 0.5)), math.ceil(min(float(length), end - 0.5))):
        share = (step + 0.5 - start) / (end - start)
        place = math.floor(across + share * (across_end - across))
        value = ends[first, 2] + share * (ends[last, 2] - ends[first, 2])
        if 0 <= place < width and value > inverse_z[place, step]:
            inverse_z[place, step] = value
