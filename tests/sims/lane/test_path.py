"""Tests that the branch-free functions of the course equal the general ones bit for bit."""

from __future__ import annotations

import math

from hypothesis import example, given
from hypothesis import strategies as st

from mcaprl.sims.geometry import further, point_of, project, spot_at
from mcaprl.sims.lane.course import (
    COURSE,
    LONGEST_LOOK_M,
    Leg,
    course_point_ahead,
    course_project,
    course_spot_at,
)
from mcaprl.sims.lane.rules import AHEAD_M, BACK_M, LOOKAHEADS_M

# Subnormal numbers are excluded: rounding moves such a distance across the start.
along = st.one_of(
    st.floats(-20, 5000, allow_subnormal=False), st.sampled_from(COURSE.along_m.tolist())
)


def leg_of(k: int) -> Leg:
    length_m = float(COURSE.along_m[k + 1] - COURSE.along_m[k])
    (x_m, y_m), (cos, sin) = COURSE.points_m[k].tolist(), COURSE.forward[k].tolist()
    return Leg(x_m, y_m, float(COURSE.yaw_rad[k]), cos, sin, length_m)


def test_no_lookahead_exceeds_the_shortest_leg() -> None:
    assert LONGEST_LOOK_M == 126.0
    assert max(*LOOKAHEADS_M, BACK_M + AHEAD_M) < LONGEST_LOOK_M


@given(along)
@example(-1e-17)
@example(1026.0)
def test_a_place_on_the_course(along_m: float) -> None:
    rest_m, leg, after = course_spot_at(along_m)
    spot = spot_at(COURSE, along_m)
    assert rest_m == spot.rest_m
    assert leg == leg_of(spot.leg)
    assert after == leg_of((spot.leg + 1) % 8)


@given(along, st.sampled_from(LOOKAHEADS_M))
def test_a_point_ahead(along_m: float, ahead_m: float) -> None:
    found = course_point_ahead(course_spot_at(along_m), ahead_m)
    assert found == point_of(COURSE, further(COURSE, spot_at(COURSE, along_m), ahead_m))


@given(along, st.floats(-9, 9), st.floats(-math.pi, math.pi), st.floats(0, 9))
def test_the_nearest_point(along_m: float, away_m: float, angle: float, lag_m: float) -> None:
    x_m, y_m = point_of(COURSE, spot_at(COURSE, along_m))
    x_m, y_m = x_m + away_m * math.cos(angle), y_m + away_m * math.sin(angle)
    window = (along_m - lag_m - BACK_M, along_m - lag_m + AHEAD_M)
    assert course_project(x_m, y_m, *window) == project(COURSE, x_m, y_m, *window)
