"""Tests of collisions and ray lengths of the lane sim's car, by hand and against an outline."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcaprl.sims import make_sim
from mcaprl.sims.geometry import moving
from mcaprl.sims.lane.course import buildings, rails
from mcaprl.sims.lane.env import LaneKeepingEnv
from mcaprl.sims.lane.rays import (
    BODY_LENGTH_M,
    BODY_WIDTH_M,
    RAYS_DEG,
    observe_rays,
    ray_length,
    touches,
)
from mcaprl.sims.lane.rules import Car, located

BOXES = (*rails(), *buildings())


def car_at(x_m: float, y_m: float, yaw_rad: float) -> Car:
    return located(moving(x_m, y_m, yaw_rad, 5.0), 0.0, 60.0, 0.0)


def lane() -> LaneKeepingEnv:
    sim = make_sim("lane", observation="rays").unwrapped
    assert isinstance(sim, LaneKeepingEnv)
    return sim


def in_a_box(x_m: float, y_m: float) -> bool:
    return any(
        abs(x_m - box.x_m) <= box.length_m / 2 and abs(y_m - box.y_m) <= box.width_m / 2
        for box in BOXES
    )


@pytest.mark.parametrize(
    ("angle_rad", "length_m"),
    [
        # On the first street (y = 1), the inner faces of the rails are 4 m to each side.
        (math.pi / 2, 4.0),
        (-math.pi / 2, 4.0),
        (math.pi / 4, 4.0 * math.sqrt(2.0)),
        (-math.pi / 4, 4.0 * math.sqrt(2.0)),
        # The rail after the first corner is ahead of the car, at x = 134. The rail behind the car
        # is at x = -4.
        (0.0, 74.0),
        (math.pi, 64.0),
        (math.radians(30.0), 8.0),
    ],
)
def test_rays_on_a_street_by_hand(angle_rad: float, length_m: float) -> None:
    assert ray_length(60.0, 1.0, angle_rad) == pytest.approx(length_m)


def test_a_ray_reaches_100_m() -> None:
    assert ray_length(20.0, 1.0, 0.0) == 100.0
    assert ray_length(34.01, 1.0, 0.0) == pytest.approx(99.99)


def test_a_ray_from_within_something_is_0() -> None:
    house = buildings()[0]
    assert ray_length(house.x_m, house.y_m, 1.0) == 0.0


@given(st.floats(-20.0, 150.0), st.floats(-150.0, 150.0), st.floats(-math.pi, math.pi))
def test_a_ray_ends_where_the_first_box_begins(x_m: float, y_m: float, angle_rad: float) -> None:
    """Points every 2 cm along a ray show no obstacle before its end, and an obstacle after it."""
    length_m = ray_length(x_m, y_m, angle_rad)
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    along_m = np.arange(0.0, length_m - 1e-6, 0.02)
    for box in BOXES:
        inside_x = np.abs(x_m + along_m * cos - box.x_m) <= box.length_m / 2
        inside_y = np.abs(y_m + along_m * sin - box.y_m) <= box.width_m / 2
        assert not (inside_x & inside_y).any()
    if 0.0 < length_m < 100.0:
        inside_m = length_m + 1e-9
        assert in_a_box(x_m + inside_m * cos, y_m + inside_m * sin) or in_a_box(
            x_m + length_m * cos, y_m + length_m * sin
        )


def test_observations_by_hand() -> None:
    sim = lane()
    observation, _ = sim.reset(options={"pose": (60.0, 2.0, 0.0, 15.0)})
    seen = dict(zip(sim.observation_names, observation.tolist(), strict=True))
    assert seen["left_90"] == pytest.approx(math.log(1 + 3.0) / math.log(101))
    assert seen["right_90"] == pytest.approx(math.log(1 + 5.0) / math.log(101))
    assert seen["right_30"] == pytest.approx(math.log(1 + 10.0) / math.log(101))
    assert seen["ahead"] == pytest.approx(math.log(1 + 74.0) / math.log(101))
    assert seen["behind"] == pytest.approx(math.log(1 + 64.0) / math.log(101))
    assert (seen["speed"], seen["steering"]) == (0.5, 0.0)
    assert (seen["way_20m_forward"], seen["way_20m_left"]) == pytest.approx((1.0, -0.05))
    turned = sim.step(2)[0]
    assert turned[17] == -1.0
    assert len(RAYS_DEG) == 16


def test_the_path_point_distinguishes_the_streets_of_a_crossing() -> None:
    """The shared leg ends with a right turn on one pass and with a left turn on the other."""
    observation = np.zeros(20, dtype=np.float32)
    way = []
    for near_m in (125.0, 637.0):
        car = located(moving(125.0, 1.0, 0.0, 5.0), 0.0, near_m, 0.0)
        observe_rays(car, observation, has_barriers=True)
        way.append(observation[18:].tolist())
    assert way == [[0.25, -0.75], [0.25, 0.75]]


@pytest.mark.parametrize(
    ("x_m", "y_m", "yaw_rad", "hit"),
    [
        (60.0, 1.0, 0.0, False),
        # The car's side is 0.875 m from its middle. The rail is 4 m from the street's middle.
        (60.0, 1.0 + 4.0 - 0.876, 0.0, False),
        (60.0, 1.0 + 4.0 - 0.874, 0.0, True),
        (60.0, 1.0 - 4.0 + 0.874, 0.0, True),
        # The nose is 2.2 m ahead of the middle of the wheelbase, and the tail is 2.1 m back.
        (134.0 - 2.201, 1.0, 0.0, False),
        (134.0 - 2.199, 1.0, 0.0, True),
        (134.0 - 2.101, 1.0, math.pi, False),
        (134.0 - 2.099, 1.0, math.pi, True),
        # Turned across the street, 2 m from the middle, the nose is at 2 m + 2.2 m: in the rail.
        (60.0, 1.0, math.pi / 2, False),
        (60.0, 3.0, math.pi / 2, True),
        # The car is beside the road, between the rails and the houses.
        (60.0, 7.0, 0.0, False),
    ],
)
def test_contacts_of_a_car_by_hand(x_m: float, y_m: float, yaw_rad: float, hit: bool) -> None:
    assert touches(car_at(x_m, y_m, yaw_rad)) is hit


@given(st.floats(-12.0, 145.0), st.floats(-20.0, 20.0), st.floats(-math.pi, math.pi))
def test_a_car_touches_what_has_a_point_in_its_body(x_m: float, y_m: float, yaw_rad: float) -> None:
    """The body is sampled every 5 cm, which is less than the thickness of a rail."""
    forward, left = np.meshgrid(
        np.linspace(-BODY_LENGTH_M / 2, BODY_LENGTH_M / 2, 87) + 0.05,
        np.linspace(-BODY_WIDTH_M / 2, BODY_WIDTH_M / 2, 36),
    )
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    body_x, body_y = x_m + forward * cos - left * sin, y_m + forward * sin + left * cos
    found, near = False, False
    for box in BOXES:
        outside_x = np.abs(body_x - box.x_m) - box.length_m / 2
        outside_y = np.abs(body_y - box.y_m) - box.width_m / 2
        distance_m = np.maximum(outside_x, outside_y).min()
        found |= bool(distance_m <= 0.0)
        near |= bool(distance_m <= 0.05)
    hit = touches(car_at(x_m, y_m, yaw_rad))
    assert hit or not found
    assert near or not hit


def test_the_scene_shows_the_rays_that_are_observed() -> None:
    sim = lane()
    sim.reset(options={"pose": (60.0, 1.0, 0.0)})
    shapes = {shape.name: shape for shape in sim.scene()}
    lines = shapes["rays"].points.reshape(16, 2, 3)
    lengths = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    assert lengths[0] == pytest.approx(74.0)
    np.testing.assert_array_equal(shapes["hits"].points, shapes["rays"].points)
    assert shapes["hits"].kind == "spheres"
    plain = make_sim("lane").unwrapped
    assert isinstance(plain, LaneKeepingEnv)
    plain.reset(seed=0)
    assert "rays" not in {shape.name for shape in plain.scene()}
