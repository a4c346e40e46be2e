"""Tests of the lane sim's barriers, which close the streets that the route does not follow."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mcaprl.sims import CarCamera, make_sim
from mcaprl.sims.geometry import moving, point_at
from mcaprl.sims.lane.camera import lane_mesh
from mcaprl.sims.lane.course import BARRIER_HEIGHT_M, COURSE, SECOND_SQUARE_M, barriers
from mcaprl.sims.lane.env import LaneKeepingEnv
from mcaprl.sims.lane.rays import ray_length, world_at
from mcaprl.sims.lane.rules import Car, located

NORTH, SOUTH = math.pi / 2, -math.pi / 2


def car_at(along_m: float) -> Car:
    """Return a car on the path."""
    x_m, y_m = point_at(COURSE, along_m)
    leg = int(np.searchsorted(COURSE.along_m, along_m % COURSE.length_m, side="right")) - 1
    return located(moving(x_m, y_m, COURSE.yaw_rad[leg], 5.0), 0.0, along_m, 0.0)


@pytest.mark.parametrize("x_m", [0.0, 130.0])
@pytest.mark.parametrize(
    ("along_m", "closed_rad", "open_rad"), [(100.0, NORTH, SOUTH), (620.0, SOUTH, NORTH)]
)
def test_one_street_of_each_crossing_is_closed(
    x_m: float, along_m: float, closed_rad: float, open_rad: float
) -> None:
    """A barrier is in line with the rails, 4 m from the center line, which is at y = 1."""
    world = world_at(along_m)
    assert ray_length(x_m, 1.0, closed_rad, world) == pytest.approx(4.0)
    assert ray_length(x_m, 1.0, open_rad, world) == 100.0
    assert ray_length(x_m, 1.0, closed_rad) == 100.0, "without barriers"


def test_the_route_is_never_closed() -> None:
    for along_m in np.arange(0.0, COURSE.length_m, 0.25):
        x_m, y_m = point_at(COURSE, along_m)
        for box in barriers()[world_at(along_m) - 1]:
            outside_m = max(abs(x_m - box.x_m) - box.length_m / 2, abs(y_m - box.y_m))
            assert outside_m > 3.9


def test_the_second_square_begins_at_the_crossing() -> None:
    assert tuple(point_at(COURSE, SECOND_SQUARE_M)) == pytest.approx((0.0, 1.0))
    near = [SECOND_SQUARE_M - 1e-6, SECOND_SQUARE_M, COURSE.length_m - 1e-6, COURSE.length_m]
    assert [world_at(along_m) for along_m in [-1e-6, *near]] == [2, 1, 2, 2, 1]


def test_the_camera_distinguishes_the_two_passes_of_the_shared_leg() -> None:
    camera, classic = CarCamera(), CarCamera(has_barriers=False)
    for ahead_m in (20.0, 10.0):
        first, second = (car_at(start_m + 130.0 - ahead_m) for start_m in (0.0, SECOND_SQUARE_M))
        assert first[:3] == pytest.approx(second[:3])
        np.testing.assert_array_equal(classic.image_m(first), classic.image_m(second))
        nearer = camera.image_m(first) < classic.image_m(first) - 0.5
        other = camera.image_m(second) < classic.image_m(second) - 0.5
        # The left street is closed on the first square, and the right one on the second.
        assert nearer[:, :42].sum() > 10 > nearer[:, 46:].sum()
        assert other[:, 42:].sum() > 10 > other[:, :38].sum()


def test_the_classic_world_has_no_barriers() -> None:
    counts = [len(lane_mesh(world)) for world in ((), *barriers())]
    assert counts[1] == counts[2] > counts[0]
    images = [
        make_sim("lane", observation="depth", rules=rules).reset(options={"pose": (115, 1, 0)})[0]
        for rules in ("classic", "classic-code")
    ]
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize("rules", ["default", "classic"])
def test_the_scene_shows_what_the_camera_sees(rules: str) -> None:
    sim: Any = make_sim("lane", rules=rules).unwrapped
    assert isinstance(sim, LaneKeepingEnv)
    sim.reset(seed=0, options={"pose": (100.0, 1.0, 0.0)})
    shown = {shape.name: shape for shape in sim.scene() if shape.name.startswith("barrier")}
    if rules == "classic":
        assert shown == {}
        return
    for number, box in enumerate(barriers()[0]):
        shape = shown[f"barrier_{number}"]
        assert shape.position == (box.x_m, box.y_m, BARRIER_HEIGHT_M / 2)
        assert shape.size == (box.length_m, box.width_m, BARRIER_HEIGHT_M)
