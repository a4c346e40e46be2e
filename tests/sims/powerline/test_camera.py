"""Tests of the drone's camera against ray casting and geometry by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mcaprl.sims.drawing.camera import draw_wires, lengths
from mcaprl.sims.drawing.depth import DepthCamera, encode_depth
from mcaprl.sims.geometry import Quaternion, Vector, frustum_mesh
from mcaprl.sims.powerline.camera import (
    CAMERA_AT_M,
    IMAGE_SHAPE,
    LENS,
    DroneCamera,
    world_mesh,
    world_wires,
)
from mcaprl.sims.powerline.course import (
    LENGTH_M,
    POINTS_M,
    WIRES_M,
    ground_height,
    point_on_line,
    towers,
)
from mcaprl.sims.powerline.quadrotor import Drone, cruising

Floats = NDArray[np.float64]
ZERO = Vector(0.0, 0.0, 0.0)


def level_at(x: float, y: float, z: float) -> Drone:
    return cruising(Vector(x, y, z), ZERO)


def cast(eye: Floats, ray: Floats) -> float:
    """Return 1/distance of the nearest front face of the world that a unit ray hits, or 0.

    Moeller and Trumbore, "Fast, minimum storage ray-triangle intersection", 1997.
    """
    a, b, c = world_mesh().transpose(1, 0, 2)
    across = np.cross(ray, c - a)
    determinant = np.einsum("ij,ij->i", b - a, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("ij,ij->i", eye - a, across) / determinant
        turned = np.cross(eye - a, b - a)
        v, far = (turned @ ray) / determinant, np.einsum("ij,ij->i", c - a, turned) / determinant
        hit = (determinant > 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (far > 0.1)
    return float(1.0 / far[hit].min()) if hit.any() else 0.0


@pytest.mark.parametrize("view", ["down", "front"])
def test_the_world_matches_ray_casting(view: str) -> None:
    """Compare 100 pixels at each of 30 random poses of a tilted drone.

    At most 3 of the 3,000 encoded depths may differ, where a ray passes close to an edge.
    """
    random = np.random.default_rng(5)
    camera = DroneCamera(view)
    differing = 0
    for _ in range(30):
        point = point_on_line(random.uniform(0.0, LENGTH_M))
        spot = Vector(*(np.array(point) + random.uniform(-4, 4, 3)).tolist())
        turn = np.array([1.0, *random.uniform(-0.2, 0.2, 3)])
        attitude = Quaternion(*(turn / np.linalg.norm(turn)).tolist())
        drone = cruising(spot, ZERO)._replace(attitude=attitude)
        eye, axes = camera.pose(drone)
        inverse = camera.without_wires(drone)
        for row, column in random.integers([LENS.height_px, LENS.width_px], size=(100, 2)):
            right = (column + 0.5 - LENS.width_px / 2) / LENS.focal_px
            down = (row + 0.5 - LENS.height_px / 2) / LENS.focal_px
            ray = np.array([right, down, 1.0]) @ axes
            expected = cast(np.array(eye), ray / np.linalg.norm(ray))
            with np.errstate(divide="ignore"):
                pair = encode_depth(1.0 / np.array([inverse[row, column], expected]))
            differing += int(pair[0] != pair[1])
    assert differing <= 3


def test_the_ground_is_straight_below() -> None:
    """Beside the wires, the depth in the middle of the image is the height above ground."""
    x, y = 250.0, 60.0
    drone = level_at(x, y, -ground_height(x, y) - 20.0)
    image = DroneCamera("down").image_m(drone)
    assert image[41:43, 41:43].mean() == pytest.approx(20.0 - CAMERA_AT_M["down"].z, abs=0.6)


def test_forward_is_up_in_the_lower_camera_and_right_is_right() -> None:
    """Look down from the north and from the east of a tower.

    From the north, the tower's arm is in the lower half of the image; from the east, in the left
    half.
    """
    tower = towers()[2]
    camera = DroneCamera("down")
    north = camera.image_m(level_at(tower.x_m + 4.0, tower.y_m, tower.arm_z_m - 5.0))
    rows, _ = np.nonzero(north < 8.0)
    assert rows.mean() > 52
    east = camera.image_m(level_at(tower.x_m, tower.y_m + 6.0, tower.arm_z_m - 5.0))
    _, columns = np.nonzero(east < 7.0)
    assert columns.mean() < 32


def test_a_level_front_camera_has_its_horizon_in_the_middle() -> None:
    """From a position above all hills, the upper half of the image is empty."""
    image = DroneCamera("front").image_m(level_at(100.0, -58.0, -75.0))
    assert np.all(np.isinf(image[:42]))
    assert np.isfinite(image[83]).all()


@pytest.mark.parametrize("view", ["down", "front"])
def test_conductors_are_seen_all_along_the_line(view: str) -> None:
    """In the middle of each leg, the wires hide parts of the rest of the world."""
    camera = DroneCamera(view)
    no_wires = DepthCamera(world_mesh(), LENS, IMAGE_SHAPE)
    for leg in range(4):
        drone = level_at(*((POINTS_M[leg] + POINTS_M[leg + 1]) / 2).tolist())
        with_wires, without = camera.image_m(drone), no_wires.image_m(*camera.pose(drone))
        assert np.sum(with_wires < without) > 60
        assert np.all(with_wires <= without)


def test_the_conductor_below_has_its_distance() -> None:
    middle = WIRES_M[7, 8]
    image = DroneCamera("down").image_m(level_at(*np.add(middle, [0.0, 0.0, -7.1]).tolist()))
    # The ray of the nearest pixel ends on the wire, or at most half a pixel beside it.
    assert image.min() == pytest.approx(7.0, abs=0.05)


def test_a_wire_takes_one_pixel_of_each_column() -> None:
    """Draw a wire 1 m below the camera's axis, at a distance of 10 m.

    The focal length is 8 pixels, and the axis is at 6 pixels. The wire is at 6 + 8 x 1 / 10 = 6.8
    pixels, which is row 6 in all 16 columns.
    """
    wire = np.array([[[-99.0, 1.0, 10.0], [99.0, 1.0, 10.0]]])
    image = np.zeros((12, 16))
    draw_wires(wire, np.zeros(3), np.eye(3), 8.0, 8.0, image)
    assert np.flatnonzero(image.any(axis=1)).tolist() == [6]
    np.testing.assert_allclose(image[6], 0.1, rtol=1e-12)


def test_a_steep_wire_takes_one_pixel_of_each_row() -> None:
    wire = np.array([[[1.0, -99.0, 10.0], [1.0, 99.0, 10.0]]])
    image = np.zeros((12, 16))
    draw_wires(wire, np.zeros(3), np.eye(3), 8.0, 8.0, image)
    assert np.flatnonzero(image.any(axis=0)).tolist() == [8]
    assert np.all(image[:, 8] > 0)


def test_a_wire_is_hidden_by_nearer_surfaces_and_clipped() -> None:
    wires = np.array([[[-9.0, 0.0, 10.0], [9.0, 0.0, 10.0]], [[-9.0, 0.0, -1.0], [9.0, 0.0, -1.0]]])
    image = np.full((12, 16), 0.5)
    draw_wires(wires, np.zeros(3), np.eye(3), 8.0, 8.0, image)
    assert np.all(image == 0.5)


def test_a_wire_that_passes_the_lens_is_cut_and_linear_in_1_over_z() -> None:
    """Draw a wire that is parallel to the camera's axis, 1 m to its right.

    A point at depth z has the horizontal pixel coordinate u = 8 + 8 / z, so 1 / z is (u - 8) / 8.
    """
    wire = np.array([[[1.0, 0.1, -5.0], [1.0, 0.1, 1000.0]]])
    image = np.zeros((12, 16))
    draw_wires(wire, np.zeros(3), np.eye(3), 8.0, 8.0, image)
    np.testing.assert_allclose(image.max(axis=0)[9:], (np.arange(9, 16) - 7.5) / 8, rtol=1e-9)


def test_rays_through_oblong_pixels() -> None:
    assert lengths((2, 2), 1.0, 2.0)[0, 0] == pytest.approx(math.sqrt(1 + 0.25 + 0.0625))


def test_a_pyramid_has_four_faces_and_a_block_ten_triangles() -> None:
    pyramid = frustum_mesh((1.0, 2.0, 3.0), 4.0, 0.0, 5.0)
    assert pyramid.shape == (4, 3, 3)
    assert pyramid.reshape(-1, 3).max(axis=0).tolist() == [3.0, 4.0, 8.0]
    assert frustum_mesh((0.0, 0.0, 0.0), 4.0, 2.0, 5.0).shape == (10, 3, 3)
    for solid in (pyramid, frustum_mesh((1.0, 2.0, 3.0), 4.0, 2.0, 5.0)):
        normals = np.cross(solid[:, 1] - solid[:, 0], solid[:, 2] - solid[:, 0])
        outward = solid.mean(axis=1) - [1.0, 2.0, 4.0]
        assert np.all(np.einsum("ij,ij->i", normals, outward) > 0)


def test_the_wires_are_those_of_the_world() -> None:
    assert world_wires().shape == (12 * 16, 2, 3)
