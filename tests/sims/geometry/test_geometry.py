"""Tests of closed paths, by hand and against a search over many points, and of the bicycle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from mcaprl.sims.geometry import (
    Heading,
    Projection,
    Spot,
    closed_path,
    cosine,
    further,
    heading_of,
    in_body_frame,
    leg_at,
    moving,
    point_at,
    project,
    roll,
    sine,
    slip_of,
    spot_at,
    steering_of,
    turned,
    wrap_angle,
)
from mcaprl.sims.lane.course import (
    COURSE,
    LANE_HALF_WIDTH_M,
    RAIL_OFFSET_M,
    buildings,
    pavement,
    rails,
    street_bounds,
    streets,
)

SQUARE = closed_path([(0, 0), (10, 0), (10, 10), (0, 10), (0, 0)])


def test_a_square_by_hand() -> None:
    assert SQUARE.length_m == 40.0
    assert SQUARE.along_m.tolist() == [0.0, 10.0, 20.0, 30.0, 40.0]
    np.testing.assert_allclose(SQUARE.yaw_rad, [0.0, math.pi / 2, math.pi, -math.pi / 2])
    assert point_at(SQUARE, 12.0) == (10.0, 2.0)
    assert point_at(SQUARE, 52.0) == (10.0, 2.0)
    assert point_at(SQUARE, -1.0) == (0.0, 1.0)
    assert [leg_at(SQUARE, at) for at in (0.0, 9.9, 10.0, 39.9, 40.0)] == [0, 0, 1, 3, 0]


def test_offsets_are_positive_to_the_left() -> None:
    """The square is driven counter-clockwise, so its inside is on the left."""
    assert project(SQUARE, 4.0, 1.0, 0.0, 10.0) == Projection(4.0, 1.0, 0.0)
    assert project(SQUARE, 4.0, -2.0, 0.0, 10.0) == Projection(4.0, -2.0, 0.0)
    assert project(SQUARE, 8.0, 5.0, 10.0, 20.0) == pytest.approx((15.0, 2.0, math.pi / 2))


def test_a_projection_stays_in_its_window_and_on_its_lap() -> None:
    assert project(SQUARE, 4.0, 1.0, 5.0, 9.0).along_m == 5.0
    assert project(SQUARE, 4.0, 1.0, 38.0, 48.0).along_m == 44.0
    assert project(SQUARE, 4.0, 1.0, -3.0, 8.0).along_m == 4.0
    assert project(SQUARE, 0.0, 2.0, -3.0, 8.0).along_m == -2.0


def test_outside_a_corner_the_corner_is_nearest() -> None:
    found = project(SQUARE, 13.0, -4.0, 6.0, 16.0)
    assert found.along_m == 10.0
    assert found.offset_m == -5.0


@given(st.floats(-20, 150), st.floats(-140, 140), st.floats(-500, 1500), st.floats(0.5, 40))
def test_no_sampled_point_is_nearer_than_the_projection(
    x_m: float, y_m: float, from_m: float, window_m: float
) -> None:
    found = project(COURSE, x_m, y_m, from_m, from_m + window_m)
    assert from_m - 1e-9 <= found.along_m <= from_m + window_m + 1e-9
    near = point_at(COURSE, found.along_m)
    assert math.hypot(x_m - near[0], y_m - near[1]) == pytest.approx(abs(found.offset_m), abs=1e-6)
    for along_m in np.linspace(from_m, from_m + window_m, 50):
        x, y = point_at(COURSE, along_m)
        assert math.hypot(x_m - x, y_m - y) >= abs(found.offset_m) - 1e-6


@given(st.floats(-100, 100))
def test_wrapping_keeps_the_direction(angle_rad: float) -> None:
    wrapped = wrap_angle(angle_rad)
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle_rad), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle_rad), abs=1e-9)


@given(st.floats(-math.pi / 4, math.pi / 4))
def test_the_series_is_the_sine_to_two_ulp(angle_rad: float) -> None:
    assert sine(angle_rad) == pytest.approx(math.sin(angle_rad), rel=4.5e-16, abs=0.0)


@given(st.floats(-10.0, 10.0), st.floats(-math.pi / 15, math.pi / 15))
def test_turning_adds_the_angles(yaw_rad: float, angle_rad: float) -> None:
    expected = heading_of(yaw_rad + angle_rad)
    assert turned(heading_of(yaw_rad), angle_rad) == pytest.approx(expected, abs=2e-15)
    cos, sin = turned(Heading(1.0, 0.0), angle_rad)
    assert sin == pytest.approx(math.sin(angle_rad), rel=1e-15, abs=0.0)
    assert cos == pytest.approx(math.cos(angle_rad), rel=1e-15)


def test_a_spot_further_on_by_hand() -> None:
    here = spot_at(SQUARE, 38.0)
    assert here == Spot(3, 8.0)
    assert further(SQUARE, here, 1.0) == Spot(3, 9.0)
    assert further(SQUARE, here, 2.0) == Spot(0, 0.0)
    assert further(SQUARE, here, 55.0) == Spot(1, 3.0)


def test_a_body_facing_north_has_west_on_its_left() -> None:
    forward_m, left_m = in_body_frame(-3.0, 2.0, 0.0, 1.0)
    assert (forward_m, left_m) == (2.0, 3.0)


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        ([(0, 0), (1, 0)], "at least"),
        ([(0, 0, 0), (1, 0, 0), (0, 0, 0)], "at least"),
        ([(0, 0), (1, 0), (1, 1)], "open"),
        ([(0, 0), (1, 0), (1, 0), (0, 0)], "same point"),
    ],
)
def test_a_bad_path_is_refused(corners: list[tuple[float, ...]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        closed_path(corners)


def test_the_course_is_as_published() -> None:
    """The legs are 130, 126, 130, 126, 130, 127, 130 and 127 m long."""
    assert np.diff(COURSE.along_m).tolist() == [130, 126, 130, 126, 130, 127, 130, 127]
    assert COURSE.length_m == 1026.0
    assert len(streets()) == 7


def test_buildings_are_beside_the_streets_and_apart() -> None:
    boxes = buildings()
    assert len(boxes) > 60
    low = np.array([(b.x_m - b.length_m / 2, b.y_m - b.width_m / 2) for b in boxes])
    high = np.array([(b.x_m + b.length_m / 2, b.y_m + b.width_m / 2) for b in boxes])
    for x0, y0, x1, y1 in street_bounds(RAIL_OFFSET_M + 2.0):
        apart = (high[:, 0] <= x0) | (low[:, 0] >= x1) | (high[:, 1] <= y0) | (low[:, 1] >= y1)
        assert np.all(apart)
    for i in range(len(boxes)):
        apart = np.any((high <= low[i]) | (low >= high[i]), axis=1)
        assert np.flatnonzero(~apart).tolist() == [i]


def test_rails_follow_the_road_but_never_cross_it() -> None:
    """No rail is nearer than 4 m to a point of the path."""
    for along_m in np.arange(0.0, COURSE.length_m, 1.7):
        x, y = point_at(COURSE, along_m)
        for box in rails():
            away_x = max(0.0, abs(x - box.x_m) - box.length_m / 2)
            away_y = max(0.0, abs(y - box.y_m) - box.width_m / 2)
            assert math.hypot(away_x, away_y) >= RAIL_OFFSET_M - 1e-9


def test_pavement_has_the_streets_area() -> None:
    """The area is that of seven streets, 7 m wide, without the overlaps at the six corners.

    The streets are 3 x 130 + 2 x 126 + 2 x 127 = 896 m long, and each extends 3.5 m beyond both
    ends. At the four outer corners, two streets overlap by 49 m^2. At the two inner corners, three
    streets overlap, so 49 m^2 must be subtracted twice.
    """
    x_m, y_m, paved = pavement(LANE_HALF_WIDTH_M)
    area = np.outer(np.diff(x_m), np.diff(y_m))[paved].sum()
    assert area == pytest.approx(7 * (896 + 7 * 7) - 4 * 49 - 2 * 2 * 49)


def free_slip_of(steering_rad: float) -> float:
    """Return the sine of the slip angle without a limit."""
    return slip_of(steering_rad, 0.0, 9.0, 2.7)


def test_straight_ahead_by_hand() -> None:
    moved = roll(moving(1.0, 2.0, math.pi / 2, 4.0), 0.0, 2.0, 2.7, 0.5)
    assert moved[:4] == pytest.approx((1.0, 4.0, math.pi / 2, 5.0))


def test_a_constant_steering_drives_a_circle() -> None:
    """The radius at the middle of the wheelbase is (wheelbase / 2) / sin(atan(tan(angle) / 2))."""
    angle_rad, wheelbase_m = 0.3, 2.7
    slip_rad = math.atan(math.tan(angle_rad) / 2)
    radius_m = wheelbase_m / 2 / math.sin(slip_rad)
    motion = moving(0.0, 0.0, 0.0, 5.0)
    points = []
    for _ in range(4000):
        motion = roll(motion, free_slip_of(angle_rad), 0.0, wheelbase_m, 0.001)
        points.append((motion.x_m, motion.y_m))
    center = (-radius_m * math.sin(slip_rad), radius_m * math.cos(slip_rad))
    np.testing.assert_allclose(
        np.linalg.norm(np.array(points) - center, axis=1), radius_m, rtol=1e-3
    )
    assert motion.yaw_rad == pytest.approx(4.0 * 5.0 / radius_m)


@given(st.sampled_from([-0.7, 0.7]), st.floats(8.0, 30.0), st.floats(0.5, 9.0))
def test_the_limit_of_the_slip_is_the_lateral_acceleration(
    steering_rad: float, speed_m_s: float, lateral_m_s2: float
) -> None:
    slip_sine = slip_of(steering_rad, speed_m_s, lateral_m_s2, 2.7)
    moved = roll(moving(0.0, 0.0, 0.0, speed_m_s), slip_sine, 0.0, 2.7, 1e-3)
    expected_m_s2 = math.copysign(lateral_m_s2, steering_rad)
    assert moved.yaw_rad / 1e-3 * speed_m_s == pytest.approx(expected_m_s2)


@given(st.floats(-math.pi / 4, math.pi / 4), st.floats(0.0, 40.0), st.floats(0.5, 9.0))
def test_the_slip_is_that_of_the_steering_or_that_of_the_limit(
    steering_rad: float, speed_m_s: float, lateral_m_s2: float
) -> None:
    free = math.sin(math.atan(math.tan(steering_rad) / 2))
    limit = 2.7 / 2 * lateral_m_s2 / max(speed_m_s**2, 1e-9)
    expected = min(max(free, -limit), limit)
    assert slip_of(steering_rad, speed_m_s, lateral_m_s2, 2.7) == pytest.approx(expected)


@given(st.floats(-math.pi / 4, math.pi / 4))
def test_slip_and_steering_are_inverse(steering_rad: float) -> None:
    assert steering_of(free_slip_of(steering_rad)) == pytest.approx(steering_rad)


@given(st.floats(-7, 7))
@example(math.pi)
@example(-math.pi)
@example(math.pi / 2)
@example(math.pi / 4)
@example(-math.pi / 4)
def test_a_heading_is_the_librarys(yaw_rad: float) -> None:
    expected = (math.cos(yaw_rad), math.sin(yaw_rad))
    assert heading_of(yaw_rad) == pytest.approx(expected, rel=0, abs=4e-16)


@given(st.floats(-math.pi / 4, math.pi / 4))
def test_a_cosine_is_the_librarys(angle_rad: float) -> None:
    assert cosine(angle_rad) == pytest.approx(math.cos(angle_rad), rel=3e-16)
