"""Tests of whole depth images of both worlds against Intel's ray tracer, Embree.

Embree computes in single precision which triangle each ray hits. The distance to the triangle's
plane is then computed in double precision. A pixel is at an edge if the rays around it do not all
hit the same triangle.
"""

from __future__ import annotations

import importlib.util
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mcaprl.sims.drawing.camera import Lens, level_axes
from mcaprl.sims.drawing.depth import DepthCamera, encode_depth
from mcaprl.sims.geometry import Quaternion, Vector, point_at
from mcaprl.sims.lane.camera import IMAGE_SHAPE, lane_mesh
from mcaprl.sims.lane.camera import LENS as LANE_LENS
from mcaprl.sims.lane.course import COURSE
from mcaprl.sims.powerline.camera import LENS as DRONE_LENS
from mcaprl.sims.powerline.camera import DroneCamera, world_mesh
from mcaprl.sims.powerline.course import LENGTH_M, point_on_line
from mcaprl.sims.powerline.quadrotor import Drone, cruising
from mcaprl.sims.powerline.rules import collides
from tests.conftest import need

Floats = NDArray[np.float64]
Codes = NDArray[np.uint8]

POSES = 40
MOST_DIFFERING = 1e-5
"""Maximum share of pixels, all at edges, that differ because of Embree's single precision."""


class RayTracer:
    """Ray tracer that renders a mesh with Embree."""

    def __init__(self, mesh: Floats, view: Lens) -> None:
        need(importlib.util.find_spec("embreex") is not None, "pip install embreex")
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._mesh = mesh
        self._scene: Any = EmbreeScene()
        self._triangles = TriangleMesh(self._scene, mesh.astype(np.float32))
        rows, columns = np.mgrid[0 : view.height_px, 0 : view.width_px] + 0.5
        x = (columns - view.width_px / 2) / view.focal_px
        y = (rows - view.height_px / 2) / view.focal_px
        self._rays = np.stack([x, y, np.ones_like(x)], axis=-1)

    def look(self, eye_m: Floats, axes: Floats) -> tuple[Codes, NDArray[np.bool_]]:
        """Return the codes of the image, and a mask of the pixels at edges."""
        rays = self._rays @ axes
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        flat = rays.reshape(-1, 3)
        origins = np.broadcast_to(eye_m, flat.shape).astype(np.float32)
        hit = self._scene.run(origins, flat.astype(np.float32)).reshape(rays.shape[:2])
        a, b, c = self._mesh[hit].transpose(2, 0, 1, 3)
        normals = np.cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth_m = np.sum((a - eye_m) * normals, axis=-1) / np.sum(rays * normals, axis=-1)
        padded = np.pad(hit, 1, mode="edge")
        around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
        at_edge = np.any(around != hit[:, :, None, None], axis=(2, 3))
        return encode_depth(np.where(hit < 0, np.inf, depth_m)), at_edge


def check(drawn: Floats, expected: Codes, at_edge: NDArray[np.bool_]) -> int:
    """Check that inverse depths are exact except at edges; return the number of wrong pixels."""
    with np.errstate(divide="ignore"):
        differs = encode_depth(1.0 / drawn) != expected
    assert not np.any(differs & ~at_edge)
    return int(differs.sum())


def test_the_streets_are_exact_except_at_edges() -> None:
    """The images are taken at 40 random places and directions in the lane."""
    random = np.random.default_rng(11)
    camera = DepthCamera(lane_mesh(), LANE_LENS, IMAGE_SHAPE)
    tracer = RayTracer(lane_mesh(), LANE_LENS)
    differing = 0
    for _ in range(POSES):
        x_m, y_m = point_at(COURSE, random.uniform(0, COURSE.length_m))
        eye = (x_m + random.uniform(-3, 3), y_m + random.uniform(-3, 3), random.uniform(0.9, 2.0))
        axes = level_axes(random.uniform(-math.pi, math.pi))
        differing += check(camera.inverse_distance(eye, axes), *tracer.look(np.array(eye), axes))
    assert differing <= MOST_DIFFERING * POSES * LANE_LENS.width_px * LANE_LENS.height_px


def random_drone(random: np.random.Generator) -> Drone:
    """Return a drone near the line, tilted by up to half a radian, without a collision."""
    while True:
        point = point_on_line(random.uniform(0.0, LENGTH_M))
        spot = Vector(*(np.array(point) + random.uniform(-5, 5, 3)).tolist())
        turn = np.array([1.0, *random.uniform(-0.25, 0.25, 3)])
        if not collides(spot):
            attitude = Quaternion(*(turn / np.linalg.norm(turn)).tolist())
            return cruising(spot, Vector(0.0, 0.0, 0.0))._replace(attitude=attitude)


@pytest.mark.parametrize("view", ["down", "front"])
def test_terrain_and_towers_are_exact_except_at_edges(view: str) -> None:
    random = np.random.default_rng(12)
    camera, tracer = DroneCamera(view), RayTracer(world_mesh(), DRONE_LENS)
    differing = 0
    for _ in range(POSES):
        drone = random_drone(random)
        eye, axes = camera.pose(drone)
        differing += check(camera.without_wires(drone), *tracer.look(np.array(eye), axes))
    assert differing <= MOST_DIFFERING * POSES * DRONE_LENS.width_px * DRONE_LENS.height_px
