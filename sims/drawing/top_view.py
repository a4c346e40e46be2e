"""Projection of shapes to flat patches, seen from above and sorted by height."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.scene import Color, Shape

Floats = NDArray[np.float64]

_SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
_CIRCLE = 0.5 * np.array([[math.cos(a), math.sin(a)] for a in np.arange(16) * math.pi / 8])


class Patch(NamedTuple):
    """Convex polygon of one color."""

    top_m: float
    """Height of the shape's top."""
    color: Color
    corners_m: Floats
    """(K, 2) corners."""
    frame: str


def patches(shapes: Iterable[Shape]) -> list[Patch]:
    """Return the patches of all shapes except `text`, the lowest first."""
    flat = [
        Patch(_top(shape), shape.color, corners, shape.frame)
        for shape in shapes
        for corners in _outlines(shape)
    ]
    return sorted(flat, key=lambda patch: patch.top_m)


def placed(corners_m: Floats, x_m: float, y_m: float, yaw_rad: float) -> Floats:
    """Rotate points (..., 2) by a yaw, then translate them."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    moved: Floats = corners_m @ np.array([[cos, sin], [-sin, cos]]) + [x_m, y_m]
    return moved


def _top(shape: Shape) -> float:
    if len(shape.points):
        return float(shape.position[2] + shape.points[:, 2].max())
    return shape.position[2] + shape.size[2] / 2


def _outlines(shape: Shape) -> list[Floats]:
    """Return the polygons (K, 2) of a shape in its frame."""
    flat, width_m = shape.points[:, :2], shape.size[0]
    match shape.kind:
        case "box":
            outlines = [_SQUARE * shape.size[:2]]
        case "sphere" | "cylinder":
            outlines = [_CIRCLE * shape.size[:2]]
        case "points" | "spheres":
            outlines = [_CIRCLE * width_m + point for point in flat]
        case "triangles":
            outlines = list(flat.reshape(-1, 3, 2))
        case "segments":
            outlines = [_stroke(a, b, width_m) for a, b in flat.reshape(-1, 2, 2)]
        case "line" | "arrow":
            outlines = [_stroke(a, b, width_m) for a, b in pairwise(flat)]
        case "text":
            outlines = []
    x_m, y_m, _ = shape.position
    return [placed(outline, x_m, y_m, shape.yaw_rad) for outline in outlines]


def _stroke(start: Floats, end: Floats, width_m: float) -> Floats:
    """Return a rectangle (4, 2) for a line; it extends half a width beyond each end."""
    along = end - start
    length_m = float(np.hypot(along[0], along[1]))
    yaw_rad = math.atan2(along[1], along[0])
    middle = (start + end) / 2
    size = (length_m + width_m, width_m)
    return placed(_SQUARE * size, float(middle[0]), float(middle[1]), yaw_rad)
