"""Tests of the courses of highway-env's roads."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from highway_env.road.lane import CircularLane, StraightLane
from highway_env.road.road import RoadNetwork
from hypothesis import given
from hypothesis import strategies as st

from mcaprl.sims import make_sim
from mcaprl.sims.highway.scene import Course, courses_of


def courses(road: str) -> tuple[Course, ...]:
    sim: Any = make_sim("highway-lane", road=road).unwrapped
    found: tuple[Course, ...] = sim.courses
    return found


def a_ring() -> Course:
    """Return a road of two half circles around the origin, with a radius of 20 m."""
    network = RoadNetwork()
    for start, end, phase in (("a", "b", 0.0), ("b", "a", math.pi)):
        lane = CircularLane([0, 0], 20.0, phase, phase + math.pi, clockwise=True, width=6)
        network.add_lane(start, end, lane)
    (ring,) = courses_of(network)
    return ring


def test_a_straight_road_by_hand() -> None:
    """3 m to the right is y = +3 in highway-env's axes and y = -3 in ROS axes."""
    network = RoadNetwork()
    network.add_lane("a", "b", StraightLane([0, 0], [30, 0], width=8))
    (road,) = courses_of(network)
    assert (road.length_m, road.half_width_m, road.is_closed) == (30.0, 4.0, False)
    assert road.nearest(12.5, -3.0) == pytest.approx((12.5, -3.0, 0.0))
    assert road.nearest(-4.0, 3.0) == pytest.approx((0.0, 5.0, 0.0))
    assert road.point(12.5) == (12.5, 0.0)
    assert road.point(34.0) == (34.0, 0.0)


def test_a_ring_by_hand() -> None:
    """A clockwise course turns right, both in images with y down and in ROS axes."""
    ring = a_ring()
    assert ring.is_closed
    assert ring.length_m == pytest.approx(2 * math.pi * 20.0, rel=1e-3)
    place = ring.nearest(0.0, -18.0)
    assert place.along_m == pytest.approx(0.25 * ring.length_m, abs=0.6)
    assert place.offset_m == pytest.approx(-2.0, abs=0.02)
    assert abs(place.yaw_rad) == pytest.approx(math.pi, abs=0.03)
    assert ring.point(ring.length_m + 5.0) == pytest.approx(ring.point(5.0))


@given(st.floats(0.0, 2 * math.pi), st.floats(15.0, 25.0))
def test_a_place_is_where_its_offset_says(angle_rad: float, radius_m: float) -> None:
    ring = a_ring()
    x_m, y_m = radius_m * math.cos(angle_rad), radius_m * math.sin(angle_rad)
    place = ring.nearest(x_m, y_m)
    assert abs(place.offset_m) == pytest.approx(abs(radius_m - 20.0), abs=0.01)
    assert math.dist(ring.point(place.along_m), (x_m, y_m)) == pytest.approx(abs(place.offset_m))


def test_lane_keeping_leads_from_the_straight_onto_the_wave() -> None:
    """Straights of 73.82 m and 22.71 m are followed by a sine wave of 5 m from x = 135 to 500."""
    (road,) = courses("lane-keeping-v0")
    x_m = np.linspace(135.0, 500.0, 100_001)
    wave_m = np.hypot(np.diff(x_m), np.diff(5 * np.sin(2 * math.pi / 100 * x_m))).sum()
    straight_m = math.hypot(65, 35) + math.hypot(20, 20 * 35 / 65)
    assert road.length_m == pytest.approx(straight_m + wave_m, abs=0.3)
    assert road.points_m[0].tolist() == [50.0, -50.0]
    assert road.points_m[-1] == pytest.approx([500.0, 0.0], abs=1e-9)


@pytest.mark.parametrize(("road", "lanes"), [("racetrack-v0", 2), ("racetrack-oval-v0", 3)])
def test_racetracks_are_closed_and_their_lanes_5_m_apart(road: str, lanes: int) -> None:
    found = courses(road)
    assert len(found) == lanes
    for course in found:
        assert course.is_closed
        np.testing.assert_array_equal(course.points_m[0], course.points_m[-1])
        assert 0.4 < np.diff(course.along_m).min() < np.diff(course.along_m).max() < 1.6
        # The ends of highway-env's lanes differ by some centimeters.
        turns = np.diff(np.unwrap(np.arctan2(*np.diff(course.points_m, axis=0).T[::-1])))
        assert np.abs(turns).max() < 0.25
    for inner, outer in itertools.pairwise(found):
        apart = [abs(inner.nearest(x_m, y_m).offset_m) for x_m, y_m in outer.points_m.tolist()]
        assert np.median(apart) == pytest.approx(5.0, abs=0.05)
