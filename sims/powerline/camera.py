"""Depth camera of the drone, which renders the ground, the firs, the towers and the conductors.

The mesh is in ROS axes, like the scene for viewers. Towers are rendered as solids without lattice.
Conductors are drawn one pixel wide at any distance, because a conductor with the real diameter of
3 cm is thinner than a pixel beyond 1.3 m.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.camera import lens
from mcaprl.sims.drawing.depth import DepthCamera
from mcaprl.sims.geometry import Vector, box_mesh, frustum_mesh, plus, rotate
from mcaprl.sims.powerline.course import (
    ARM_HALF_LENGTH_M,
    WIRES_M,
    Tower,
    Tree,
    ground_height,
    to_ros,
    towers,
    trees,
)
from mcaprl.sims.powerline.quadrotor import Drone

Floats = NDArray[np.float64]

LENS = lens(256, 144, math.pi / 2)
IMAGE_SHAPE = (84, 84)
"""Size of the downsampled image; each pixel covers 3.05 x 1.71 rendered pixels."""

CAMERAS = ("down", "front")
CAMERA_AT_M = {"down": Vector(0.0, 0.0, 0.1), "front": Vector(0.2, 0.0, 0.0)}
"""Positions in the body frame: x forward, y right, z down."""
CAMERA_AXES = {
    "down": (Vector(0.0, 1.0, 0.0), Vector(-1.0, 0.0, 0.0), Vector(0.0, 0.0, 1.0)),
    "front": (Vector(0.0, 1.0, 0.0), Vector(0.0, 0.0, 1.0), Vector(1.0, 0.0, 0.0)),
}
"""Optical axes (x right, y down, z along the view) in the body frame."""

GROUND_X_M = np.concatenate(
    [np.linspace(-180, -6, 7), np.linspace(0, 54, 10), np.linspace(60, 720, 31)]
)
GROUND_Y_M = np.linspace(-260, 345, 23)
"""NED grid of the ground mesh: densest on the steep hill; it ends about 200 m beyond the line."""
TREE_SIDE_M = 0.45  # Side of a fir's base as a fraction of its height
MAST_FOOT_M = 3.0
MAST_TOP_M = 0.9


@functools.cache
def ground_triangles() -> Floats:
    """Return the ground in ROS axes, (T, 3, 3) meters, facing up; do not modify it."""
    return grid_triangles(GROUND_X_M, GROUND_Y_M)


def grid_triangles(x_m: Floats, y_m: Floats) -> Floats:
    """Return two upward triangles per cell, (T, 3, 3) meters in ROS axes, of a grid in NED axes."""
    corners = np.array([[(x, y, -ground_height(x, y)) for y in y_m] for x in x_m])
    here, north = corners[:-1, :-1], corners[1:, :-1]
    east, both = corners[:-1, 1:], corners[1:, 1:]
    cells = np.stack([here, both, north, here, east, both], axis=2)
    return to_ros(cells.reshape(-1, 3, 3))


def tree_triangles(tree: Tree) -> Floats:
    """Return a fir as a pyramid in ROS axes, (4, 3, 3) meters."""
    foot = (tree.x_m, -tree.y_m, ground_height(tree.x_m, tree.y_m) - 0.5)
    return frustum_mesh(foot, TREE_SIDE_M * tree.height_m, 0.0, tree.height_m)


def _tower_triangles(tower: Tower) -> Floats:
    """Return the mast and the arm of a tower in ROS axes, (22, 3, 3) meters."""
    foot = (tower.x_m, -tower.y_m, -tower.foot_z_m)
    mast = frustum_mesh(foot, MAST_FOOT_M, MAST_TOP_M, tower.foot_z_m - tower.arm_z_m)
    arm = box_mesh((0.0, 0.0, 0.0), (0.5, 2 * ARM_HALF_LENGTH_M, 0.4))
    right_x, right_y = tower.right
    axes = np.array([[right_y, right_x, 0.0], [right_x, -right_y, 0.0], [0.0, 0.0, -1.0]])
    turned = arm @ axes + [tower.x_m, -tower.y_m, -tower.arm_z_m]
    return np.concatenate([mast, turned])


@functools.cache
def world_mesh() -> Floats:
    """Return all surfaces in ROS axes, (T, 3, 3) meters; do not modify them."""
    solids = [_tower_triangles(tower) for tower in towers()]
    solids += [tree_triangles(tree) for tree in trees()]
    return np.concatenate([ground_triangles(), *solids])


def world_wires() -> Floats:
    """Return the segments of the conductors in ROS axes, (S, 2, 3) meters."""
    pieces = np.stack([WIRES_M[:, :-1], WIRES_M[:, 1:]], axis=2)
    return to_ros(pieces.reshape(-1, 2, 3))


class DroneCamera:
    """Camera fixed to the drone's body."""

    def __init__(self, view: str) -> None:
        """Prepare the `down` or `front` camera: 90 degrees wide, 84 x 84 pixels."""
        self._view = view
        self._camera = DepthCamera(world_mesh(), LENS, IMAGE_SHAPE, world_wires())

    def image_m(self, drone: Drone) -> NDArray[np.float32]:
        """Return distances (84, 84) along the rays in meters, infinite where a ray hits nothing."""
        return self._camera.image_m(*self.pose(drone))

    def without_wires(self, drone: Drone) -> Floats:
        """Return the inverse distances without conductors, at full size (144, 256), in 1/m."""
        return self._camera.inverse_distance(*self.pose(drone))

    def pose(self, drone: Drone) -> tuple[tuple[float, float, float], Floats]:
        """Return the camera's position and its (3, 3) axes as rows, in ROS axes."""
        at = plus(drone.position_m, rotate(drone.attitude, CAMERA_AT_M[self._view]))
        axes = [rotate(drone.attitude, axis) for axis in CAMERA_AXES[self._view]]
        return (at.x, -at.y, -at.z), to_ros(np.array(axes))
