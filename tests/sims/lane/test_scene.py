"""Tests of the scene of the lane sim."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mcaprl.sims.lane.env import LaneKeepingEnv
from tests.support.sims import unwrapped


@pytest.fixture
def sim() -> LaneKeepingEnv:
    """Return a sim with the car in the middle of the second leg, which leads toward -y."""
    made: LaneKeepingEnv = unwrapped("lane")
    made.reset(options={"pose": (131.0, -60.0, -math.pi / 2, 6.0)})
    return made


def test_the_offset_is_drawn_to_the_nearest_path_point(sim: LaneKeepingEnv) -> None:
    link = next(shape for shape in sim.scene() if shape.name == "offset")
    np.testing.assert_allclose(link.points[:, :2], [[131.0, -60.0], [130.0, -60.0]], atol=1e-9)
    assert sim.telemetry()["lateral_offset_m"] == pytest.approx(1.0)


def test_the_lane_borders_are_half_a_meter_inside_the_rails(sim: LaneKeepingEnv) -> None:
    shapes = {shape.name: shape for shape in sim.static_scene()}
    borders, road = shapes["lane_borders"].points, shapes["road"].points
    np.testing.assert_allclose(borders[:, :2].max(axis=0), road[:, :2].max(axis=0) - 0.5)
    assert {shape.frame for name, shape in shapes.items() if "car" in name} == {"car"}
    assert sum(name.startswith("rail") for name in shapes) >= 12
    assert sum(name.startswith("building") for name in shapes) >= 50
