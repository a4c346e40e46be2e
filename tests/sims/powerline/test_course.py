"""Tests of the power line, its conductors and the ground."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcaprl.sims.geometry import Vector
from mcaprl.sims.powerline.camera import ground_triangles
from mcaprl.sims.powerline.course import (
    ALONG_M,
    BEAMS_M,
    BELOW_LINE_M,
    LEG_LENGTHS_M,
    LENGTH_M,
    POINTS_M,
    SAG,
    WIRES_M,
    catenary,
    distance_to_infinite_line,
    distance_to_segment,
    ground_height,
    nearest_on_line,
    point_on_line,
    to_ros,
    tower_distance,
    towers,
    trees,
    wire_distance,
)

ALONG = st.floats(0.0, LENGTH_M)


def test_the_legs_are_as_long_as_published() -> None:
    np.testing.assert_allclose(LEG_LENGTHS_M, [71, 146, 198, 206], atol=0.5)
    assert pytest.approx(ALONG_M[-1]) == LENGTH_M


@given(ALONG)
def test_a_point_of_the_line_is_its_own_nearest(along_m: float) -> None:
    place = nearest_on_line(point_on_line(along_m))
    assert place.along_m == pytest.approx(along_m, abs=1e-6)
    assert place.distance_m < 1e-6


@given(st.tuples(st.floats(-50, 600), st.floats(-150, 200), st.floats(-90, 0)))
def test_no_other_point_is_nearer_than_the_nearest(position: tuple[float, float, float]) -> None:
    place = nearest_on_line(Vector(*position))
    others = [point_on_line(along) for along in np.linspace(0, LENGTH_M, 400)]
    distances = np.linalg.norm(np.array(others) - position, axis=1)
    assert place.distance_m <= distances.min() + 1e-9


def test_beyond_the_end_the_infinite_line_is_nearer() -> None:
    """The point is 50 m beyond the end of the first leg, 3 m beside the leg's extension."""
    along = (POINTS_M[1] - POINTS_M[0]) / LEG_LENGTHS_M[0]
    beside = np.cross(along, [0, 0, 1.0])
    beside /= np.linalg.norm(beside)
    position = Vector(*(POINTS_M[1] + 50 * along + 3 * beside).tolist())
    assert distance_to_infinite_line(position, 0) == pytest.approx(3.0)
    assert nearest_on_line(position).distance_m > 20.0


def test_a_level_catenary_by_its_formula() -> None:
    """Check a wire of 100 m with a sag of 2 m, whose ends have the same height.

    The middle is 2 m lower than the ends. At a quarter of the width, the wire is within 0.01 m of
    the parabola through these three points, which is 1.5 m lower than the ends.
    """
    heights = catenary(100.0, 0.0, 2.0, np.array([0.0, 50.0, 100.0]))
    assert heights.tolist() == pytest.approx([0.0, -2.0, 0.0], abs=1e-9)
    parabola = catenary(100.0, 0.0, 2.0, np.array([25.0]))
    assert parabola[0] == pytest.approx(-1.5, abs=0.01)


@given(st.floats(50, 250), st.floats(-40, 40), st.floats(0.5, 6))
def test_a_catenary_meets_its_ends_and_its_sag(span_m: float, rise_m: float, sag_m: float) -> None:
    x_m = np.array([0.0, span_m / 2, span_m])
    heights = catenary(span_m, rise_m, sag_m, x_m)
    assert heights.tolist() == pytest.approx([0.0, rise_m / 2 - sag_m, rise_m], abs=1e-6)


def test_a_conductor_hangs_under_the_line_with_its_sag() -> None:
    for leg in range(4):
        middle_wire = WIRES_M[3 * leg + 1]
        np.testing.assert_allclose(middle_wire[0], POINTS_M[leg] + [0, 0, BELOW_LINE_M])
        line = (POINTS_M[leg] + POINTS_M[leg + 1]) / 2
        sag_m = middle_wire[8, 2] - line[2] - BELOW_LINE_M
        assert sag_m == pytest.approx(SAG * LEG_LENGTHS_M[leg], abs=1e-6)


@given(st.integers(0, 11), st.floats(0, 15.99), st.tuples(*[st.floats(-1.5, 1.5)] * 3))
def test_the_distance_to_wires_is_the_smallest_of_all_segments(
    wire: int, place: float, away: tuple[float, float, float]
) -> None:
    chord = int(place)
    start, end = WIRES_M[wire, chord], WIRES_M[wire, chord + 1]
    position = Vector(*(start + (place - chord) * (end - start) + away).tolist())
    pieces = [
        distance_to_segment(position, one[i], one[i + 1]) for one in WIRES_M for i in range(16)
    ]
    assert wire_distance(position) == min(pieces)


def test_the_distance_to_a_segment_by_hand() -> None:
    start, end = np.zeros(3), np.array([10.0, 0.0, 0.0])
    for position, distance_m in (((4, 3, 0), 3.0), ((-3, 0, 4), 5.0), ((13, 4, 0), 5.0)):
        assert distance_to_segment(Vector(*map(float, position)), start, end) == distance_m


def test_towers_are_on_the_ground_under_the_line() -> None:
    for tower, point in zip(towers(), POINTS_M, strict=True):
        assert (tower.x_m, tower.y_m) == (point[0], point[1])
        assert -tower.foot_z_m == pytest.approx(ground_height(tower.x_m, tower.y_m))
        assert tower_distance(Vector(tower.x_m, tower.y_m, tower.arm_z_m)) == 0.0
        assert math.hypot(*tower.right) == pytest.approx(1.0)
    assert BEAMS_M.shape == (10, 2, 3)


def test_arms_lie_across_the_line() -> None:
    """The first arm is perpendicular to the first leg; the second arm bisects the corner."""
    first, second = towers()[:2]
    legs = np.diff(POINTS_M, axis=0)[:, :2]
    units = legs / np.hypot(*legs.T)[:, None]
    assert np.dot(first.right, units[0]) == pytest.approx(0.0, abs=1e-12)
    assert np.dot(second.right, units[0]) == pytest.approx(-np.dot(second.right, units[1]))
    # The first leg leads to the north-west, so its right side is in the north-east: y is positive.
    assert first.right[1] > 0


def test_no_conductor_touches_the_ground_or_a_tree() -> None:
    for x, y, z in WIRES_M.reshape(-1, 3):
        assert -z - ground_height(x, y) > 15.0
    for tree in trees():
        foot_m = ground_height(tree.x_m, tree.y_m)
        assert wire_distance(Vector(tree.x_m, tree.y_m, -foot_m - tree.height_m)) > 5.0


def test_the_mesh_of_the_ground_is_near_the_ground() -> None:
    """All triangles face up; near the line, their middles are less than 1.5 m from the ground."""
    triangles = ground_triangles()
    up = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert np.all(up[:, 2] > 0)
    for x, y, z in to_ros(triangles.mean(axis=1)):
        if nearest_on_line(Vector(x, y, z)).distance_m < 60.0:
            assert abs(-z - ground_height(x, y)) < 1.5


def test_axes_of_ros_are_north_west_up() -> None:
    assert to_ros(np.array([1.0, 2.0, 3.0])).tolist() == [1.0, -2.0, -3.0]
