"""Checks of the shapes and frames that sims describe."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.scene import Frame, Shape

DRAWN_BY_POINTS = {"line": 1, "segments": 2, "triangles": 3, "points": 1, "spheres": 1, "arrow": 2}


def rotated(frame: Frame, vector: tuple[float, float, float]) -> NDArray[np.float64]:
    """Rotate a vector from a frame into its parent: v + 2 u x (u x v + w v)."""
    axis, w = np.array(frame.rotation[:3]), frame.rotation[3]
    cross = np.cross(axis, vector) + w * np.array(vector)
    turned: NDArray[np.float64] = np.array(vector) + 2 * np.cross(axis, cross)
    return turned


def check_shape(shape: Shape, frames: Collection[str]) -> None:
    """Check that a viewer can draw a shape."""
    assert all(0.0 <= part <= 1.0 for part in shape.color)
    assert shape.points.dtype == np.float64
    assert shape.points.shape == (len(shape.points), 3)
    assert np.isfinite(shape.points).all()
    assert shape.frame in frames
    if shape.kind in DRAWN_BY_POINTS:
        assert len(shape.points) > 0
        assert len(shape.points) % DRAWN_BY_POINTS[shape.kind] == 0
    else:
        assert len(shape.points) == 0
        assert min(shape.size) > 0.0
