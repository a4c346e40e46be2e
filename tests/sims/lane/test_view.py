"""Tests of the top view of the lane sim, and of the projection of shapes to patches."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcaprl.sims.drawing.scene import Color, Kind, Shape
from mcaprl.sims.drawing.top_view import patches, placed
from mcaprl.sims.lane.scene import GRASS, PAINT
from tests.support.sims import image_of, near

RED: Color = (1.0, 0.0, 0.0, 1.0)


def test_the_car_is_in_the_middle_of_the_image() -> None:
    image = image_of("lane", (50.0, 1.0, 0.0))
    assert image.shape == (600, 600, 3)
    rows, columns = np.nonzero(near(image, PAINT))
    assert abs(rows.mean() - 300) < 12
    assert abs(columns.mean() - 300) < 12


def test_the_car_points_where_it_is_heading() -> None:
    """If the car heads along x, its image is wider than high; along y, it is higher than wide."""
    for yaw_rad, wide in ((0.0, True), (math.pi / 2, False)):
        rows, columns = np.nonzero(near(image_of("lane", (50.0, 1.0, yaw_rad)), PAINT))
        assert (np.ptp(columns) > 1.5 * np.ptp(rows)) == wide


def test_north_is_up_and_east_is_right() -> None:
    """The car is 10 m west of the corner at (130, 1), where a road leads north."""
    grass = near(image_of("lane", (120.0, 1.0, 0.0)), GRASS)
    ten_meters_px = round(10 * 600 / 55)
    assert grass[300 - ten_meters_px // 2, 250]
    assert not grass[300, 300 + ten_meters_px]
    assert not grass[300 - ten_meters_px, 300 + ten_meters_px]


def test_patches_lie_in_the_order_of_their_heights() -> None:
    tower = Shape("tower", "box", RED, size=(2.0, 4.0, 10.0), position=(1.0, 2.0, 5.0))
    road = Shape("road", "triangles", RED, np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]))
    low, high = patches([tower, road])
    assert (low.top_m, high.top_m) == (0.0, 10.0)
    assert high.corners_m.tolist() == [[0, 0], [2, 0], [2, 4], [0, 4]]


@pytest.mark.parametrize(
    ("kind", "expected"),
    [("box", 1), ("sphere", 1), ("cylinder", 1), ("text", 0)],
)
def test_solids_become_one_patch_and_text_none(kind: Kind, expected: int) -> None:
    assert len(patches([Shape("it", kind, RED)])) == expected


@pytest.mark.parametrize(
    ("kind", "expected"),
    [("line", 5), ("arrow", 5), ("segments", 3), ("points", 6), ("triangles", 2)],
)
def test_points_become_patches_by_kind(kind: Kind, expected: int) -> None:
    assert len(patches([Shape("it", kind, RED, np.eye(6, 3))])) == expected


def test_a_stroke_is_as_wide_as_it_says() -> None:
    ends = np.array([[0.0, 0.0, 1.0], [10.0, 0.0, 1.0]])
    (stroke,) = patches([Shape("it", "line", RED, ends, size=(0.5, 0.0, 0.0))])
    np.testing.assert_allclose(stroke.corners_m.min(axis=0), [-0.25, -0.25], atol=1e-12)
    np.testing.assert_allclose(stroke.corners_m.max(axis=0), [10.25, 0.25], atol=1e-12)


def test_a_quarter_turn_by_hand() -> None:
    np.testing.assert_allclose(placed(np.array([[2.0, 1.0]]), 10.0, 20.0, math.pi / 2), [[9, 22]])


@given(st.floats(-9, 9), st.floats(-50, 50), st.floats(-50, 50))
def test_placing_keeps_distances(yaw_rad: float, x_m: float, y_m: float) -> None:
    corners = np.array([[0.0, 0.0], [3.0, 4.0]])
    first, second = placed(corners, x_m, y_m, yaw_rad)
    np.testing.assert_allclose(first, [x_m, y_m])
    assert np.hypot(*(second - first)) == pytest.approx(5.0)
