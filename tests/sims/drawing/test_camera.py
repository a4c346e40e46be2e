"""Tests of the depth camera against independent ray casters, and of the depth encoding."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from mcaprl.sims.drawing.camera import Faces, draw, faces_of, fronts, lens, level_axes, ray_lengths
from mcaprl.sims.drawing.depth import (
    FARTHEST_M,
    NEAREST_M,
    DepthCamera,
    decode_depth,
    downsampling,
    encode_depth,
    overlaps,
    shrink,
)
from mcaprl.sims.geometry import box_mesh, ground_mesh, point_at
from mcaprl.sims.lane.camera import IMAGE_SHAPE, LENS, lane_mesh
from mcaprl.sims.lane.course import COURSE, GROUND_HALF_SIDE_M, buildings, rails

Floats = NDArray[np.float64]

ALL_CODES = np.arange(256, dtype=np.uint8)


def draw_mesh(mesh: Floats, eye_m: Floats, axes: Floats, focal_px: float, image: Floats) -> None:
    draw(faces_of(mesh), eye_m, axes, focal_px, image)


def unit_rays(columns: NDArray[np.int64], rows: NDArray[np.int64], yaw_rad: float) -> Floats:
    """Return the directions (N, 3), in the map, of the rays through the middles of pixels."""
    right = (columns + 0.5 - LENS.width_px / 2) / LENS.focal_px
    down = (rows + 0.5 - LENS.height_px / 2) / LENS.focal_px
    forward = np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])
    rightward = np.array([math.sin(yaw_rad), -math.cos(yaw_rad), 0.0])
    rays = forward + right[:, None] * rightward + down[:, None] * np.array([0.0, 0.0, -1.0])
    unit: Floats = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit


def cast_on_course(eye_m: Floats, rays: Floats) -> Floats:
    """Return the distances (N,) to the boxes of the course and its ground, by the slab method."""
    boxes = [*rails(), *buildings()]
    low = np.array([[b.x_m - b.length_m / 2, b.y_m - b.width_m / 2, 0.0] for b in boxes])
    high = np.array([[b.x_m + b.length_m / 2, b.y_m + b.width_m / 2, b.height_m] for b in boxes])
    with np.errstate(divide="ignore"):
        inverse = 1.0 / rays[:, None, :]
        to_low, to_high = (low - eye_m) * inverse, (high - eye_m) * inverse
        to_ground = np.where(rays[:, 2] < 0, -eye_m[2] / rays[:, 2], np.inf)
    enter = np.minimum(to_low, to_high).max(axis=2)
    leave = np.maximum(to_low, to_high).min(axis=2)
    to_boxes = np.where((enter <= leave) & (enter > 0), enter, np.inf).min(axis=1)
    landing = eye_m + np.where(np.isfinite(to_ground), to_ground, 0.0)[:, None] * rays
    on_ground = np.all(np.abs(landing[:, :2]) <= GROUND_HALF_SIDE_M, axis=1)
    return np.asarray(np.minimum(to_boxes, np.where(on_ground, to_ground, np.inf)))


def test_the_course_matches_ray_casting() -> None:
    """Of 4000 random pixels at each of 60 random poses, at most 24 differ in total."""
    random = np.random.default_rng(3)
    camera = DepthCamera(lane_mesh(), LENS, IMAGE_SHAPE)
    differing = 0
    for _ in range(60):
        x_m, y_m = point_at(COURSE, random.uniform(0, COURSE.length_m))
        eye = (x_m + random.uniform(-3, 3), y_m + random.uniform(-3, 3), random.uniform(0.9, 2.0))
        yaw_rad = random.uniform(-math.pi, math.pi)
        columns, rows = random.integers(256, size=4000), random.integers(144, size=4000)
        expected = cast_on_course(np.array(eye), unit_rays(columns, rows, yaw_rad))
        with np.errstate(divide="ignore"):
            drawn = 1.0 / camera.inverse_distance(eye, level_axes(yaw_rad))[rows, columns]
        differing += int(np.sum(encode_depth(drawn) != encode_depth(expected)))
    assert differing <= 24


def nearest_front(triangles: Floats, ray: Floats) -> float:
    """Return 1/z of the nearest front face that a ray from the origin hits, or 0.

    Moeller and Trumbore, "Fast, minimum storage ray-triangle intersection", 1997.
    """
    best = 0.0
    for a, b, c in triangles:
        across = np.cross(ray, c - a)
        determinant = (b - a) @ across
        # The normal of a front face points against the ray.
        if determinant <= 0.0:
            continue
        u, turned = -a @ across / determinant, np.cross(-a, b - a)
        v, distance = ray @ turned / determinant, (c - a) @ turned / determinant
        if u >= 0 and v >= 0 and u + v <= 1 and distance > 0.1:
            best = max(best, 1.0 / distance)
    return best


def test_planes_tell_fronts_from_backs() -> None:
    # The triangle is in the plane z = 2. Seen from above, its corners run counter-clockwise, so its
    # front faces up.
    flat = np.array([[[0.0, 0, 2], [1, 0, 2], [0, 1, 2]]])
    np.testing.assert_allclose(fronts(flat), [[0, 0, 1, 2]])
    np.testing.assert_allclose(fronts(flat[:, ::-1]), [[0, 0, -1, -2]])


def test_halves_of_quadrilaterals_are_merged() -> None:
    box = box_mesh((0.0, 0.0, 0.0), (2.0, 4.0, 6.0))
    faces = faces_of(box)
    assert faces.counts.tolist() == [4] * 6
    np.testing.assert_array_equal(faces.corners[0, :3], box[0])
    np.testing.assert_array_equal(faces.corners[0, 3], box[1, 2])
    # The halves of a rectangle, whichever corners they begin with.
    a, b, c, d = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
    for first in ([a, b, c], [b, c, a], [c, a, b]):
        for second in ([a, c, d], [c, d, a], [d, a, c]):
            merged = faces_of(np.array([first, second]))
            assert merged.counts.tolist() == [4]
            around = merged.corners[0].tolist()
            start = around.index(a.tolist())
            assert around[start:] + around[:start] == [each.tolist() for each in (a, b, c, d)]
    # Three triangles are a quadrilateral and a triangle.
    assert faces_of(np.array([[a, b, c], [a, c, d], [a, b, c]])).counts.tolist() == [4, 3]


def test_other_triangles_are_not_merged() -> None:
    a, b, c, d = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
    above, beyond = np.array([[0.0, 1, 1e-3], [3, -0.2, 0]])
    pairs = {
        "bent": [[a, b, c], [a, c, above]],
        "concave": [[a, b, d], [d, b, beyond]],
        "apart": [[a, b, c], [a + 5, c + 5, d + 5]],
        "seen from the other side": [[a, b, c], [c, a, d]],
    }
    for name, pair in pairs.items():
        assert faces_of(np.array(pair)).counts.tolist() == [3, 3], name


def test_merged_triangles_look_like_single_ones() -> None:
    mesh, axes = lane_mesh(), level_axes(0.3)
    single = Faces(np.insert(mesh, 3, 0.0, axis=1), np.full(len(mesh), 3), fronts(mesh))
    merged = faces_of(mesh)
    assert len(merged.counts) == len(mesh) // 2
    images = np.empty((2, 144, 256))
    for x_m, y_m in ((5.0, 0.5), (64.0, 2.0), (130.0, -60.0)):
        for faces, image in zip((single, merged), images, strict=True):
            draw(faces, np.array([x_m, y_m, 1.4]), axes, LENS.focal_px, image)
        np.testing.assert_allclose(images[0], images[1], rtol=1e-12)


def test_random_triangles_match_ray_casting() -> None:
    random = np.random.default_rng(4)
    image = np.empty((12, 16))
    for _ in range(40):
        triangles = random.uniform([-4, -4, -3], [4, 4, 9], size=(6, 3, 3))
        draw_mesh(triangles, np.zeros(3), np.eye(3), 8.0, image)
        for row, column in random.integers([12, 16], size=(25, 2)):
            ray = np.array([(column + 0.5 - 8) / 8.0, (row + 0.5 - 6) / 8.0, 1.0])
            assert image[row, column] == pytest.approx(nearest_front(triangles, ray), abs=1e-9)


def test_a_wall_straight_ahead_has_its_distance() -> None:
    """For a wall 10 m ahead, z is 10 m in each pixel, but the rays to the corners are longer."""
    wall = box_mesh((15.0, 0.0, 0.0), (10.0, 100.0, 100.0))
    image = np.empty((144, 256))
    draw_mesh(wall, np.zeros(3), level_axes(0.0), LENS.focal_px, image)
    np.testing.assert_allclose(1.0 / image, 10.0, rtol=1e-12)
    lengths = ray_lengths(LENS)
    assert lengths[0, 0] == pytest.approx(math.sqrt(1 + (127.5 / 128) ** 2 + (71.5 / 128) ** 2))


def test_level_ground_ends_at_the_middle_row() -> None:
    image = np.empty((144, 256))
    draw_mesh(ground_mesh(1e6), np.array([0.0, 0.0, 1.4]), level_axes(0.7), LENS.focal_px, image)
    assert np.all(image[:72] == 0.0)
    # The camera is 1.4 m high, the focal length is 128 pixels, and the middle of row 72 is half a
    # pixel below the horizon: z = 1.4 m x 128 / 0.5.
    np.testing.assert_allclose(1.0 / image[72], 1.4 * 128 / 0.5, rtol=1e-9)
    np.testing.assert_allclose(1.0 / image[143], 1.4 * 128 / 71.5, rtol=1e-9)


def test_left_of_the_car_is_left_in_the_image() -> None:
    """If the camera faces north (y), a box to the west (-x) is in the left half of the image."""
    west = box_mesh((-5.0, 10.0, 0.0), (2.0, 2.0, 2.0))
    image = np.empty((144, 256))
    draw_mesh(west, np.zeros(3), level_axes(math.pi / 2), LENS.focal_px, image)
    assert np.any(image[:, :128] > 0)
    assert np.all(image[:, 128:] == 0)


def test_surfaces_outside_the_view_are_not_visible() -> None:
    image = np.empty((144, 256))
    for mesh in (box_mesh((-5.0, 0.0, 0.0), (2.0, 2.0, 2.0)), box_mesh((0, 0, 0), (9.0, 9.0, 9.0))):
        draw_mesh(mesh, np.zeros(3), level_axes(0.0), LENS.focal_px, image)
        assert np.all(image == 0.0)


def test_neighboring_triangles_leave_no_gap_and_share_no_pixel() -> None:
    """A fan of thin triangles around the middle covers each pixel of a disc exactly once."""
    turns = np.linspace(0, 2 * math.pi, 38)
    rim = np.column_stack([5 * np.cos(turns), 5 * np.sin(turns), np.full(38, 5.0)])
    covered = np.zeros((64, 64))
    for i in range(37):
        image = np.empty((64, 64))
        # y points down in the image, which reverses the orientation.
        slice_of = np.array([[[0, 0, 5.0], rim[i + 1], rim[i]]])
        draw_mesh(slice_of, np.zeros(3), np.eye(3), 30.0, image)
        covered += image > 0
    v, u = np.mgrid[0:64, 0:64] + 0.5 - 32
    assert np.all(covered[np.hypot(u, v) < 29.5] == 1)
    assert covered.max() == 1


@given(st.floats(NEAREST_M, FARTHEST_M))
def test_one_code_is_a_fixed_share_of_the_distance(depth_m: float) -> None:
    back = decode_depth(encode_depth(np.array([depth_m])))[0]
    half_code = 0.5 * math.log(FARTHEST_M / NEAREST_M) / 255
    if np.isfinite(back):
        assert abs(math.log(back / depth_m)) <= half_code * 1.001
    else:
        assert depth_m > FARTHEST_M * math.exp(-half_code * 1.001)


def test_codes_by_hand() -> None:
    meters = np.array([0.1, 0.5, math.sqrt(50.0), 100.0, 1e4, np.inf])
    # sqrt(50) m is the geometric mean of the nearest and the farthest distance. Its code is 127.5,
    # which is rounded to the even number 128.
    assert encode_depth(meters).tolist() == [0, 0, 128, 255, 255, 255]
    assert decode_depth(np.array([0, 255], np.uint8)).tolist() == [0.5, np.inf]


def test_codes_of_float32_are_those_of_the_formula() -> None:
    """The last bits of the formula's logarithm in float32 shift a code by less than 1e-4."""
    edges_m = NEAREST_M * np.exp(np.arange(0.5, 255) / 255 * math.log(FARTHEST_M / NEAREST_M))
    random = np.random.default_rng(0)
    meters = np.concatenate([edges_m * (1 + part * 1e-6) for part in range(-30, 31)])
    meters = np.concatenate([meters, random.uniform(0.0, 120.0, 20_000)]).astype(np.float32)
    clipped = np.clip(meters.astype(float), NEAREST_M, FARTHEST_M)
    exact = 255 * np.log(clipped / NEAREST_M) / math.log(FARTHEST_M / NEAREST_M)
    assert np.abs(encode_depth(meters) - exact).max() <= 0.5001
    assert np.all(np.diff(encode_depth(np.sort(meters)).astype(int)) >= 0)
    outside = np.array([[-1.0, 0.0, 1e-40], [100.0, 1e30, np.inf]], np.float32)
    assert encode_depth(outside).tolist() == [[0, 0, 0], [255, 255, 255]]


def test_codes_survive_decoding() -> None:
    np.testing.assert_array_equal(encode_depth(decode_depth(ALL_CODES)), ALL_CODES)


def shrunk(inverse: Floats, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Downsample an image to a shape."""
    small = np.empty(shape, dtype=np.float32)
    height, width = inverse.shape
    shrink(inverse.copy(), np.ones((height, width)), downsampling((height, width), shape), small)
    return small


def test_shrinking_by_hand() -> None:
    """The mean of 1/2 and 1/4 is 3/8, and sky pixels are left out of a mean.

    If more than half of the pixels are sky, the result is sky.
    """
    inverse = np.array([[0.5, 0.25, 0.1, 0.0], [0.5, 0.25, 0.0, 0.1]])
    np.testing.assert_allclose(shrunk(inverse, (1, 2)), [[8 / 3, 10.0]], rtol=1e-6)
    inverse[1, 3] = 0.0
    assert shrunk(inverse, (1, 2))[0, 1] == np.inf


def test_rows_without_sky_are_averaged_like_other_rows() -> None:
    random = np.random.default_rng(1)
    inverse = random.uniform(0.01, 2.0, (144, 256))
    with_sky = inverse.copy()
    # A pixel of sky in each row makes no difference to the pixels that it does not overlap.
    with_sky[:, 255] = 0.0
    np.testing.assert_array_equal(
        shrunk(inverse, (84, 84))[:, :83], shrunk(with_sky, (84, 84))[:, :83]
    )
    mean = inverse.reshape(36, 4, 64, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(shrunk(inverse, (36, 64)), 1.0 / mean, rtol=1e-6)


@given(st.integers(1, 300), st.integers(1, 300))
def test_each_new_pixel_is_made_of_whole_shares(old: int, new: int) -> None:
    if new > old:
        return
    first, weights, _ = overlaps(old, new)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-9)
    used = np.zeros(old)
    for start, row in zip(first, weights, strict=True):
        used[start : start + len(row)] += row
    np.testing.assert_allclose(used, new / old, rtol=1e-9)


def test_a_plane_keeps_its_depth_when_shrunk() -> None:
    """Inverse depth is linear on the ground: a new row has the value at its middle, within 1 %."""
    image = np.empty((144, 256))
    draw_mesh(ground_mesh(1e6), np.array([0.0, 0.0, 1.4]), level_axes(0.0), LENS.focal_px, image)
    small = shrunk(image, (84, 84))
    middle_v = (np.arange(44, 84) + 0.5) * 144 / 84 - 72
    np.testing.assert_allclose(small[44:, 0], 1.4 * 128 / middle_v, rtol=0.01)
    assert np.all(np.isinf(small[:42]))


def test_lens_has_its_field_of_view() -> None:
    narrow = lens(100, 50, math.radians(60))
    assert math.degrees(2 * math.atan(50 / narrow.focal_px)) == pytest.approx(60)
