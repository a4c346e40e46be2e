"""What the camera of the lane sim's car can see: the ground, the rails and the buildings."""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.camera import lens
from mcaprl.sims.drawing.depth import DepthCamera
from mcaprl.sims.geometry.mesh import box_mesh, ground_mesh
from mcaprl.sims.lane.course import GROUND_HALF_SIDE_M, Box, buildings, rails

LENS = lens(256, 144, math.pi / 2)
IMAGE_SHAPE = (84, 84)
"""The whole picture, squashed: a small pixel is 3.05 pixels wide and 1.71 high."""


def _solid(box: Box) -> NDArray[np.float64]:
    middle_m = (box.x_m, box.y_m, box.height_m / 2)
    return box_mesh(middle_m, (box.length_m, box.width_m, box.height_m))


@functools.cache
def lane_mesh() -> NDArray[np.float64]:
    """Give the course's surfaces as (T, 3, 3) triangles, metres; treat them as read-only."""
    solids = [_solid(box) for box in (*rails(), *buildings())]
    return np.concatenate([ground_mesh(GROUND_HALF_SIDE_M), *solids])


def lane_camera() -> DepthCamera:
    """Make the front camera: 256 x 144 pixels, 90 degrees wide, averaged down to 84 x 84."""
    return DepthCamera(lane_mesh(), LENS, IMAGE_SHAPE)
