"""Tests of the scene and the top view of the powerline sim."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mcaprl.sims.powerline.course import POINTS_M, point_on_line, to_ros
from mcaprl.sims.powerline.env import PowerlineEnv
from mcaprl.sims.powerline.scene import PAINT, ROUTE
from tests.support.sims import image_of, near, rotated, unwrapped

EAST = 1


def flying(**kwargs: Any) -> PowerlineEnv:
    """Return a sim with the drone 150 m along the line."""
    sim: PowerlineEnv = unwrapped("powerline", **kwargs)
    sim.reset(options={"pose": (*point_on_line(150.0), 3.0, 0.0, 0.0)})
    return sim


def test_the_scene_has_z_up() -> None:
    shapes = {shape.name: shape for shape in flying().static_scene()}
    legs = shapes["route"].points.reshape(-1, 2, 3)
    lengths_m = np.linalg.norm(legs[:, 1] - legs[:, 0], axis=1)
    assert lengths_m.max() <= 12.0 + 1e-9
    assert lengths_m.sum() == pytest.approx(np.linalg.norm(np.diff(POINTS_M, axis=0), axis=1).sum())
    np.testing.assert_allclose(legs[[0, -1], [0, 1]], to_ros(POINTS_M)[[0, -1]])
    assert shapes["conductors"].points[:, 2].min() > 10.0
    assert {f"tower_{i}" for i in range(5)} <= shapes.keys()
    for i, point in enumerate(to_ros(POINTS_M)):
        tower = shapes[f"tower_{i}"].points
        assert np.all(np.abs(tower[:, :2] - point[:2]) <= 1.5 + 1e-9)
        assert tower[:, 2].max() == pytest.approx(point[2] - 7.0)


def test_the_drones_frame_has_its_position_and_tilt() -> None:
    """If the drone accelerates to the east, which is -y, its upward axis tilts to -y."""
    sim = flying()
    sim.step(EAST)
    level, body = sim.frames()
    reported = sim.telemetry()
    assert (level.name, level.parent) == ("base_stabilized", "map")
    assert level.position == (reported["x_m"], reported["y_m"], reported["z_m"])
    assert (body.name, body.parent) == ("drone", "base_stabilized")
    up = rotated(body, (0, 0, 1))
    assert up[1] < -0.01
    assert math.acos(up[2]) == pytest.approx(reported["tilt_rad"], abs=1e-6)


def test_the_offset_is_drawn_to_the_nearest_point() -> None:
    sim = flying()
    sim.step(EAST)
    link = next(shape for shape in sim.scene() if shape.name == "offset").points
    distance_m = float(np.linalg.norm(link[1] - link[0]))
    # Each coordinate is rounded to 1/8 m.
    assert distance_m == pytest.approx(sim.telemetry()["line_distance_m"], abs=0.11)


@pytest.mark.parametrize("along_m", [5.0, 60.0, 300.0, 600.0])
def test_the_drone_is_in_the_middle_and_in_the_strip(along_m: float) -> None:
    """Hills never cover the drone, no matter whether the line is low or high."""
    image = image_of("powerline", tuple(point_on_line(along_m)))
    assert image.shape == (600, 600, 3)
    rows, columns = np.nonzero(near(image, PAINT, 3))
    above, strip = rows < 430, rows >= 430
    assert abs(rows[above].mean() - 300) < 12
    assert abs(columns[above].mean() - 300) < 12
    assert abs(rows[strip].mean() - 475) < 3
    assert abs(columns[strip].mean() - 300) < 3


def test_north_is_right_and_west_is_up() -> None:
    """The last leg leads north-east, so the route runs from upper left to lower right."""
    route = near(image_of("powerline", tuple(point_on_line(500.0)))[:430], ROUTE, 3)
    rows, columns = np.nonzero(route)
    assert np.corrcoef(rows, columns)[0, 1] > 0.9
