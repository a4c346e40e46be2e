"""Tests of the scene of the lane sim."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mcaprl.sims import make_sim
from mcaprl.sims.lane.env import LaneKeepingEnv
from tests.support.sim_shapes import rotated


@pytest.fixture
def sim() -> LaneKeepingEnv:
    """Return a sim with the car in the middle of the second leg, which leads toward -y."""
    made = make_sim("lane").unwrapped
    assert isinstance(made, LaneKeepingEnv)
    made.reset(options={"pose": (131.0, -60.0, -math.pi / 2, 6.0)})
    return made


def test_the_moving_shapes_keep_their_names_and_stay_few(sim: LaneKeepingEnv) -> None:
    first = [shape.name for shape in sim.scene()]
    for _ in range(60):
        sim.step(4)
    assert [shape.name for shape in sim.scene()] == first
    assert sum(len(shape.points) for shape in sim.scene()) < 60


def test_the_trail_ends_at_the_car(sim: LaneKeepingEnv) -> None:
    assert sim.trail == [(131.0, -60.0)]
    sim.step(1)
    trail = next(shape for shape in sim.scene() if shape.name == "trail")
    place = sim.telemetry()
    assert trail.points[0, :2].tolist() == [131.0, -60.0]
    assert trail.points[-1, :2].tolist() == [place["x_m"], place["y_m"]]


def test_the_offset_is_drawn_to_the_nearest_path_point(sim: LaneKeepingEnv) -> None:
    link = next(shape for shape in sim.scene() if shape.name == "offset")
    np.testing.assert_allclose(link.points[:, :2], [[131.0, -60.0], [130.0, -60.0]], atol=1e-9)
    assert sim.telemetry()["lateral_offset_m"] == pytest.approx(1.0)


def test_the_cars_frame_points_where_the_car_does(sim: LaneKeepingEnv) -> None:
    (frame,) = sim.frames()
    assert (frame.name, frame.parent, frame.position) == ("car", "map", (131.0, -60.0, 0.0))
    np.testing.assert_allclose(rotated(frame, (1, 0, 0)), [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(rotated(frame, (0, 1, 0)), [1, 0, 0], atol=1e-12)


def test_the_camera_has_optical_axes(sim: LaneKeepingEnv) -> None:
    (frame,) = sim.static_frames()
    assert (frame.name, frame.parent, frame.position) == ("camera", "car", (0.4, 0.0, 1.4))
    np.testing.assert_allclose(rotated(frame, (0, 0, 1)), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rotated(frame, (1, 0, 0)), [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(rotated(frame, (0, 1, 0)), [0, 0, -1], atol=1e-12)


def test_the_wheels_touch_the_ground(sim: LaneKeepingEnv) -> None:
    wheels = [shape for shape in sim.static_scene() if shape.name.startswith("car_wheel")]
    assert len(wheels) == 4
    for wheel in wheels:
        assert wheel.points[:, 2].min() == pytest.approx(0.0, abs=1e-9)
    assert {shape.frame for shape in sim.static_scene() if "car" in shape.name} == {"car"}


def test_the_lane_borders_are_half_a_meter_inside_the_rails(sim: LaneKeepingEnv) -> None:
    shapes = {shape.name: shape for shape in sim.static_scene()}
    borders, road = shapes["lane_borders"].points, shapes["road"].points
    np.testing.assert_allclose(borders[:, :2].max(axis=0), road[:, :2].max(axis=0) - 0.5)
    assert sum(name.startswith("rail") for name in shapes) >= 12
    assert sum(name.startswith("building") for name in shapes) >= 50
