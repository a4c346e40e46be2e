"""What there is to be seen of a sim, in terms that belong to no viewer.

A sim describes its world with two frozen types, `Shape` and `Frame`. Axes are those of ROS
(REP 103): right-handed, z up, x forward in a body's own frame, y to its left; metres and radians.
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
    "box", "sphere", "cylinder", "line", "segments", "points", "triangles", "arrow", "text"
]
"""How a shape's `points` and `size` are to be read; see `Shape`."""


def no_points() -> NDArray[np.float64]:
    """Give the `points` of a shape that has none: an array of shape (0, 3)."""
    return np.empty((0, 3))


@dataclass(frozen=True, eq=False)
class Shape:
    """One thing to draw.

    `box`, `sphere`, `cylinder` (axis along z) and `text` stand at `position`, turned by `yaw_rad`,
    with edges `size`. The others are drawn through `points`, which `position` and `yaw_rad` move.
    """

    name: str
    """Unique among the shapes of a scene."""
    kind: Kind
    color: Color
    points: NDArray[np.float64] = field(default_factory=no_points)
    """(N, 3) metres. `line`: a strip; `segments`: pairs; `triangles`: triples; `arrow`: start and
    end; empty for the others."""
    size: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Metres. `line`, `segments` and `points`: the width is the first; `arrow`: shaft diameter,
    head diameter, head length; `text`: the height is the last."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Metres, in `frame`."""
    yaw_rad: float = 0.0
    """Turn about z, counter-clockwise seen from above."""
    frame: str = "map"
    """The frame that the shape is fixed to."""
    text: str = ""


@dataclass(frozen=True)
class Frame:
    """Where one coordinate frame is in another."""

    name: str
    position: tuple[float, float, float]
    """Metres, of the origin in `parent`."""
    rotation: tuple[float, float, float, float]
    """Unit quaternion (x, y, z, w) that takes vectors of this frame to `parent`."""
    parent: str = "map"


def yaw_rotation(yaw_rad: float) -> tuple[float, float, float, float]:
    """Give the quaternion (x, y, z, w) of a turn about z.

    >>> yaw_rotation(0.0)
    (0.0, 0.0, 0.0, 1.0)
    """
    return (0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))


def path(points: Sequence[tuple[float, ...]]) -> NDArray[np.float64]:
    """Give places as the points of a line, which needs two: a single place comes twice."""
    return np.array(points if len(points) > 1 else [*points, *points])


def raised(points_m: NDArray[np.float64], z_m: float) -> NDArray[np.float64]:
    """Give points of shape (..., 2) as (N, 3) at one height."""
    flat = points_m.reshape(-1, 2)
    return np.column_stack([flat, np.full(len(flat), z_m)])
