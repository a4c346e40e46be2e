"""Meshes of solids, as triangles for the depth camera or as faces for images of scenes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]

# The corners of a unit cube are numbered 4 x + 2 y + z. Each face lists its corners
# counter-clockwise as seen from outside; its diagonal splits it into two triangles.
_FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
_TRIANGLES = np.array([half for a, b, c, d in _FACES for half in ((a, b, c), (a, c, d))])
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


def box_faces(middle_m: Vector, size_m: Vector) -> NDArray[np.float64]:
    """Return the faces of an axis-aligned box, (6 faces, 4 corners, xyz), meters.

    Seen from outside, the corners of each face run counter-clockwise.
    """
    corners: NDArray[np.float64] = np.array(middle_m) + _CORNERS * np.array(size_m)
    faces: NDArray[np.float64] = corners[np.array(_FACES)]
    return faces


def box_mesh(middle_m: Vector, size_m: Vector) -> NDArray[np.float64]:
    """Return the triangles of an axis-aligned box, (12 triangles, 3 corners, xyz), meters.

    Seen from outside, the corners of each triangle run counter-clockwise.
    """
    corners: NDArray[np.float64] = np.array(middle_m) + _CORNERS * np.array(size_m)
    triangles: NDArray[np.float64] = corners[_TRIANGLES]
    return triangles


def ground_mesh(half_side_m: float) -> NDArray[np.float64]:
    """Return a square of ground at z = 0 around the origin, (2, 3, 3) meters, facing up."""
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    triangles: NDArray[np.float64] = half_side_m * corners[[[0, 1, 2], [0, 2, 3]]]
    return triangles


def frustum_mesh(
    foot_m: Vector, foot_side_m: float, top_side_m: float, height_m: float
) -> NDArray[np.float64]:
    """Return the triangles of an upright square frustum without base, (10, 3, 3) meters.

    With a top side of 0, the frustum is a pyramid with 4 triangles, (4, 3, 3).
    """
    height = _CORNERS[:, 2:] + 0.5
    level = _CORNERS[:, :2] * (foot_side_m + (top_side_m - foot_side_m) * height)
    corners: NDArray[np.float64] = np.array(foot_m) + np.hstack([level, height_m * height])
    triangles: NDArray[np.float64] = corners[_TRIANGLES]
    on_base = np.all(triangles[:, :, 2] == foot_m[2], axis=1)
    sides = triangles[:, 1:] - triangles[:, :1]
    flat = np.all(np.cross(sides[:, 0], sides[:, 1]) == 0.0, axis=1)
    seen: NDArray[np.float64] = triangles[~(on_base | flat)]
    return seen
