"""A depth camera: triangles in, distances out, on one CPU core and without a display.

The picture is drawn with a z-buffer of inverse depths. On a plane, 1/z is linear in the picture, so
one division per triangle does; and 0 is the natural value of a pixel that nothing hits.

Camera axes are those of a ROS optical frame (REP 103): x right, y down, z into the picture.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.geometry.compiled import compiled

Floats = NDArray[np.float64]

_NEAR_M = 0.1
"""What is nearer than this before the lens is not seen."""
_SURELY_M = 1e-6
"""Further behind a triangle than that, a camera sees its back, whatever the rounding."""


class Lens(NamedTuple):
    """A pinhole camera with square pixels."""

    width_px: int
    height_px: int
    focal_px: float
    """Distance of the image plane, in pixels: half the width over tan(half the field of view)."""


def lens(width_px: int, height_px: int, horizontal_fov_rad: float) -> Lens:
    """Make a lens from its picture's size and its field of view.

    >>> lens(256, 144, math.pi / 2).focal_px
    128.00000000000003
    """
    return Lens(width_px, height_px, width_px / 2 / math.tan(horizontal_fov_rad / 2))


def ray_lengths(view: Lens) -> Floats:
    """Give (height, width) lengths of the rays from the eye to the plane z = 1."""
    return lengths((view.height_px, view.width_px), view.focal_px, view.focal_px)


def lengths(shape: tuple[int, int], focal_x_px: float, focal_y_px: float) -> Floats:
    """Give (height, width) lengths of rays, for pixels that need not be square."""
    height_px, width_px = shape
    x = (np.arange(width_px) + 0.5 - width_px / 2) / focal_x_px
    y = (np.arange(height_px) + 0.5 - height_px / 2) / focal_y_px
    return np.sqrt(x**2 + y[:, None] ** 2 + 1.0)


def level_axes(yaw_rad: float) -> Floats:
    """Give the (3, 3) axes, as rows in the map, of a level camera that looks along a yaw."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[sin, -cos, 0.0], [0.0, 0.0, -1.0], [cos, sin, 0.0]])


def fronts(mesh: Floats) -> Floats:
    """Give the (T, 4) planes of triangles: unit vectors to the front, and their distance from 0."""
    ahead = np.cross(mesh[:, 1] - mesh[:, 0], mesh[:, 2] - mesh[:, 0])
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    return np.column_stack([ahead, (ahead * mesh[:, 0]).sum(axis=1)])


@compiled
def draw(
    mesh: Floats,
    planes: Floats,
    eye_m: Floats,
    axes: Floats,
    focal_px: float,
    inverse_z: Floats,
) -> None:
    """Fill `inverse_z`, (height, width) 1/m, with what a camera sees; 0 where it sees nothing.

    Args:
        mesh: (T, 3, 3) triangles; only the side whose corners run counter-clockwise is seen.
        planes: (T, 4) `fronts` of the mesh.
        eye_m: (3,) where the camera is.
        axes: (3, 3) the camera's x, y and z axes as rows, in the mesh's coordinates.
        focal_px: of the lens; its axis meets the middle of the picture.
        inverse_z: the picture to fill.
    """
    inverse_z[:] = 0.0
    corners, polygon = np.empty((3, 3)), np.empty((4, 3))
    middles, left_u, right_u = np.empty((3, inverse_z.shape[0]))
    for row in range(len(middles)):
        middles[row] = row + 0.5
    # How far the picture reaches to each side where z is 1; a corner on its border counts as in it.
    wide, high = 0.5 * inverse_z.shape[1] / focal_px, 0.5 * inverse_z.shape[0] / focal_px
    for face in range(len(mesh)):
        before_m = planes[face, 0] * eye_m[0] + planes[face, 1] * eye_m[1]
        before_m += planes[face, 2] * eye_m[2] - planes[face, 3]
        if before_m < -_SURELY_M:
            continue
        behind = right = left = below = above = True
        for i in range(3):
            dx = mesh[face, i, 0] - eye_m[0]
            dy = mesh[face, i, 1] - eye_m[1]
            dz = mesh[face, i, 2] - eye_m[2]
            x = axes[0, 0] * dx + axes[0, 1] * dy + axes[0, 2] * dz
            y = axes[1, 0] * dx + axes[1, 1] * dy + axes[1, 2] * dz
            z = axes[2, 0] * dx + axes[2, 1] * dy + axes[2, 2] * dz
            corners[i, 0], corners[i, 1], corners[i, 2] = x, y, z
            behind &= z < _NEAR_M
            right &= x > wide * z
            left &= x < -wide * z
            below &= y > high * z
            above &= y < -high * z
        # A triangle with all corners beyond the same border has nothing in the picture.
        if behind or right or left or below or above:
            continue
        plane = _plane(corners)
        if plane.offset < 0.0:
            count = _clip_near(corners, polygon)
            _project(polygon, count, focal_px, inverse_z)
            rows = _spans(polygon, count, middles, left_u, right_u)
            _fill(rows, left_u, right_u, plane, focal_px, inverse_z)


class _Plane(NamedTuple):
    """The points p with x p_x + y p_y + z p_z = offset; negative when the eye is at its front."""

    x: float
    y: float
    z: float
    offset: float


@compiled
def _plane(corners: Floats) -> _Plane:
    """Give the plane through a triangle of camera coordinates."""
    ux, uy, uz = _difference(corners, 1)
    vx, vy, vz = _difference(corners, 2)
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return _Plane(x, y, z, x * corners[0, 0] + y * corners[0, 1] + z * corners[0, 2])


@compiled
def _difference(corners: Floats, i: int) -> tuple[float, float, float]:
    """Give the vector from a triangle's first corner to another one."""
    return (
        corners[i, 0] - corners[0, 0],
        corners[i, 1] - corners[0, 1],
        corners[i, 2] - corners[0, 2],
    )


@compiled
def _clip_near(corners: Floats, polygon: Floats) -> int:
    """Copy the part of a triangle before the near plane into `polygon`; give its corner count."""
    count = 0
    for i in range(3):
        j = (i + 1) % 3
        here_z, there_z = corners[i, 2], corners[j, 2]
        if here_z >= _NEAR_M:
            for k in range(3):
                polygon[count, k] = corners[i, k]
            count += 1
        if (here_z >= _NEAR_M) != (there_z >= _NEAR_M):
            share = (_NEAR_M - here_z) / (there_z - here_z)
            for k in range(3):
                polygon[count, k] = corners[i, k] + share * (corners[j, k] - corners[i, k])
            count += 1
    return count


@compiled
def _project(polygon: Floats, count: int, focal_px: float, inverse_z: Floats) -> None:
    """Turn the x and y of a polygon's corners into the picture's u and v, pixels."""
    height, width = inverse_z.shape
    for i in range(count):
        scale = focal_px / polygon[i, 2]
        polygon[i, 0] = 0.5 * width + scale * polygon[i, 0]
        polygon[i, 1] = 0.5 * height + scale * polygon[i, 1]


@compiled
def _spans(
    polygon: Floats, count: int, middles: Floats, left_u: Floats, right_u: Floats
) -> tuple[int, int]:
    """Find the leftmost and rightmost u of a convex polygon on each row of the picture.

    Neighbours walk their common edge in opposite directions. Taken from above, it has the same u
    for both to the last bit. Edge by edge, the compiler can do several rows at once.

    Args:
        polygon: (4, 3) its corners' u and v.
        count: of them.
        middles: (height,) v of each row's middle.
        left_u: (height,) to be filled for the rows that it is on.
        right_u: likewise.

    Returns:
        The first row that it is on, and the first one that it is no longer on.
    """
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
        for row in range(start, end):
            u = above_u + (middles[row] - above_v) / height * width
            left_u[row], right_u[row] = min(left_u[row], u), max(right_u[row], u)
    return first, stop


@compiled
def _fill(
    rows: tuple[int, int],
    left_u: Floats,
    right_u: Floats,
    plane: _Plane,
    focal_px: float,
    inverse_z: Floats,
) -> None:
    """Draw a convex polygon that lies in a plane.

    A pixel belongs to it if its middle does; a middle on a border belongs to the side at the right
    or below, so that neighbours leave no gap. The points p = z (u/f, v/f, 1) of the plane have
    1/z = (x u/f + y v/f + z) / offset, with u and v from the middle of the picture.

    Args:
        rows: the first that it is on, and the first that it is no longer on.
        left_u: (height,) where it begins on each of them.
        right_u: (height,) where it ends.
        plane: of camera coordinates.
        focal_px: of the lens.
        inverse_z: the picture.
    """
    height, width = inverse_z.shape
    middle_u, middle_v = 0.5 * width, 0.5 * height
    step = plane.x / (plane.offset * focal_px)
    for row in range(rows[0], rows[1]):
        start = math.ceil(max(0.0, left_u[row] - 0.5))
        end = math.ceil(min(float(width), right_u[row] - 0.5))
        at_v = plane.y / focal_px * (row + 0.5 - middle_v) + plane.z
        at_zero = at_v / plane.offset + step * (0.5 - middle_u)
        for column in range(start, end):
            # Without a branch, so that the compiler can do several pixels at once.
            inverse_z[row, column] = max(inverse_z[row, column], at_zero + step * column)


@compiled
def draw_wires(
    wires: Floats,
    eye_m: Floats,
    axes: Floats,
    focal_x_px: float,
    focal_y_px: float,
    inverse_z: Floats,
) -> None:
    """Draw straight wires over `inverse_z`, (height, width) 1/m, where they are nearer.

    However thin or far a wire is, it is one pixel wide: it takes one pixel of each column that it
    crosses, or of each row if it is steeper than that.

    Args:
        wires: (S, 2, 3) their ends.
        eye_m: (3,) where the camera is.
        axes: (3, 3) as of `draw`.
        focal_x_px: of the lens, in widths of a pixel.
        focal_y_px: of the lens, in heights of a pixel.
        inverse_z: the picture to draw over.
    """
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
    """Keep the part of a wire before the near plane; say whether there is any."""
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
    """Draw a line between two points u, v, 1/z, one pixel for each step of its main direction.

    Args:
        ends: (2, 3)
        main: 0 to take steps in u, 1 in v.
        inverse_z: the picture, its second axis along the main direction.
    """
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
