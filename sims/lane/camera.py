"""Depth camera of the lane sim's car, which renders the ground, rails, barriers and buildings."""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.camera import lens, level_axes
from mcaprl.sims.drawing.depth import DepthCamera
from mcaprl.sims.geometry import box_mesh, ground_mesh
from mcaprl.sims.lane.course import (
    CAMERA_FORWARD_M,
    CAMERA_HEIGHT_M,
    GROUND_HALF_SIDE_M,
    Box,
    barriers,
    buildings,
    rails,
)
from mcaprl.sims.lane.rays import NO_BARRIERS, world_at
from mcaprl.sims.lane.rules import Car

LENS = lens(256, 144, math.pi / 2)
IMAGE_SHAPE = (84, 84)
"""Size of the downsampled image; each pixel covers 3.05 x 1.71 rendered pixels."""


@functools.cache
def lane_mesh(closed: tuple[Box, ...] = ()) -> NDArray[np.float64]:
    """Return (T, 3, 3) triangles of all surfaces, meters, if `closed` with barriers."""
    # Callers must not modify them.
    solids = [
        box_mesh((box.x_m, box.y_m, box.height_m / 2), (box.length_m, box.width_m, box.height_m))
        for box in (*rails(), *buildings(), *closed)
    ]
    return np.concatenate([ground_mesh(GROUND_HALF_SIDE_M), *solids])


class CarCamera:
    """Level camera at the front of the car: 90 degrees wide, 84 x 84 pixels."""

    def __init__(self, *, has_barriers: bool = True) -> None:
        """Prepare the rendering of the course; only the default rules have barriers."""
        worlds = ((), *barriers()) if has_barriers else ((),)
        self._cameras = [DepthCamera(lane_mesh(world), LENS, IMAGE_SHAPE) for world in worlds]

    def image_m(self, car: Car) -> NDArray[np.float32]:
        """Return distances (84, 84) along the rays in meters, infinite where a ray hits nothing."""
        x_m = car.x_m + CAMERA_FORWARD_M * math.cos(car.yaw_rad)
        y_m = car.y_m + CAMERA_FORWARD_M * math.sin(car.yaw_rad)
        camera = self._cameras[world_at(car.along_m) if len(self._cameras) > 1 else NO_BARRIERS]
        return camera.image_m((x_m, y_m, CAMERA_HEIGHT_M), level_axes(car.yaw_rad))
