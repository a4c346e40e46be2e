"""Viewer-independent description of what is visible in a sim.

A sim describes its world with two frozen types, `Shape` and `Frame`. Axes are those of ROS
(REP 103): right-handed, z up; in a body's frame, x forward and y left. Units are meters and
radians.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Color = tuple[float, float, float, float]
"""Red, green, blue and opacity, each 0 to 1."""

Kind = Literal[
    "box",
    "sphere",
    "cylinder",
    "line",
    "segments",
    "points",
    "spheres",
    "triangles",
    "arrow",
    "text",
]
"""Kind of a shape, which decides the meaning of its `points` and `size`; see `Shape`."""

_COARSE_PER_M = 8


def no_points() -> NDArray[np.float64]:
    """Return an empty (0, 3) array, for a shape that has no points."""
    return np.empty((0, 3))


@dataclass(frozen=True, eq=False)
class Shape:
    """Element of a scene.

    A `box`, `sphere`, `cylinder` (axis along z) or `text` has its center at `position` and edge
    lengths `size`, and is rotated by `yaw_rad`. The other kinds are defined by `points`, which
    are rotated by `yaw_rad` and then translated by `position`.
    """

    name: str
    """Name, unique in the scene."""
    kind: Kind
    color: Color
    points: NDArray[np.float64] = field(default_factory=no_points)
    """(N, 3) meters. `line`: corners in order; `segments`: pairs of ends; `triangles`: triples of
    corners; `arrow`: start and end; `points` and `spheres`: centers; other kinds: empty."""
    size: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Three lengths in meters. `line`, `segments` and `points`: the first length is the width;
    `spheres`: diameters; `arrow`: shaft diameter, head diameter, head length; `text`: the last
    length is the height."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position in `frame`, meters."""
    yaw_rad: float = 0.0
    """Rotation about z, counter-clockwise seen from above."""
    frame: str = "map"
    """Frame that the shape is fixed to."""
    text: str = ""


@dataclass(frozen=True)
class Frame:
    """Position and rotation of one coordinate frame in another."""

    name: str
    position: tuple[float, float, float]
    """Position of the origin in `parent`, meters."""
    rotation: tuple[float, float, float, float]
    """Unit quaternion (x, y, z, w) that transforms vectors of this frame to `parent`."""
    parent: str = "map"


def yaw_rotation(yaw_rad: float) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w) of a rotation about z.

    >>> yaw_rotation(0.0)
    (0.0, 0.0, 0.0, 1.0)
    """
    return (0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))


def path(points: Sequence[tuple[float, ...]]) -> NDArray[np.float64]:
    """Return the `points` of a line through positions; a single position is duplicated."""
    return np.array(points if len(points) > 1 else [*points, *points])


def raised(points_m: NDArray[np.float64], z_m: float) -> NDArray[np.float64]:
    """Add a height to points (..., 2); return (N, 3) points."""
    flat = points_m.reshape(-1, 2)
    points = np.empty((len(flat), 3))
    points[:, :2], points[:, 2] = flat, z_m
    return points


def coarse(points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round points to 1/8 m, so that points that change at each step compress well in logs."""
    rounded: NDArray[np.float64] = np.rint(points_m * _COARSE_PER_M) / _COARSE_PER_M
    return rounded


def cut(segments_m: NDArray[np.float64], longest_m: float) -> NDArray[np.float64]:
    """Cut segments into pieces of `longest_m` or less: (2 M, K) alternating starts and ends.

    >>> cut(np.array([[0.0, 0.0], [5.0, 0.0]]), 2.0)[:, 0].tolist()
    [0.0, 2.0, 2.0, 4.0, 4.0, 5.0]
    """
    # Viewers do not draw a line that begins behind the camera, even if the rest is in front.
    cuts = []
    for start, end in segments_m.reshape(-1, 2, segments_m.shape[-1]):
        length_m = float(np.linalg.norm(end - start))
        shares = np.append(np.arange(0.0, length_m, longest_m) / length_m, 1.0)
        points = start + shares[:, np.newaxis] * (end - start)
        cuts.append(np.stack([points[:-1], points[1:]], axis=1).reshape(-1, points.shape[-1]))
    return np.concatenate(cuts)
