"""What the lane sim shows to a 3D viewer."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mcaprl.sims import make_sim
from mcaprl.sims.lane import LaneKeepingEnv
from mcaprl.sims.scene import Frame, Shape

DRAWN_BY_POINTS = {"line": 1, "segments": 2, "triangles": 3, "points": 1, "arrow": 2}


@pytest.fixture
def sim() -> LaneKeepingEnv:
    """A car halfway along the second leg, which leads towards -y."""
    made = make_sim("lane").unwrapped
    assert isinstance(made, LaneKeepingEnv)
    made.reset(options={"pose": (131.0, -60.0, -math.pi / 2, 6.0)})
    return made


def rotated(frame: Frame, vector: tuple[float, float, float]) -> NDArray[np.float64]:
    """Turn a vector of a frame into its parent: v + 2 u x (u x v + w v)."""
    axis, w = np.array(frame.rotation[:3]), frame.rotation[3]
    cross = np.cross(axis, vector) + w * np.array(vector)
    turned: NDArray[np.float64] = np.array(vector) + 2 * np.cross(axis, cross)
    return turned


def check_shape(shape: Shape) -> None:
    assert all(0.0 <= part <= 1.0 for part in shape.color)
    assert shape.points.dtype == np.float64
    assert shape.points.shape == (len(shape.points), 3)
    assert np.isfinite(shape.points).all()
    assert shape.frame in ("map", "car")
    if shape.kind in DRAWN_BY_POINTS:
        assert len(shape.points) > 0
        assert len(shape.points) % DRAWN_BY_POINTS[shape.kind] == 0
    else:
        assert len(shape.points) == 0
        assert min(shape.size) > 0.0


def test_every_shape_can_be_drawn(sim: LaneKeepingEnv) -> None:
    sim.step(1)
    shapes = [*sim.static_scene(), *sim.scene()]
    for shape in shapes:
        check_shape(shape)
    assert len({shape.name for shape in shapes}) == len(shapes)


def test_the_moving_shapes_keep_their_names_and_stay_few(sim: LaneKeepingEnv) -> None:
    first = [shape.name for shape in sim.scene()]
    for _ in range(60):
        sim.step(4)
    assert [shape.name for shape in sim.scene()] == first
    assert sum(len(shape.points) for shape in sim.scene()) < 60


def test_the_trail_ends_at_the_car(sim: LaneKeepingEnv) -> None:
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


def test_the_car_stands_on_the_ground_on_its_wheels(sim: LaneKeepingEnv) -> None:
    wheels = [shape for shape in sim.static_scene() if shape.name.startswith("car_wheel")]
    assert len(wheels) == 4
    for wheel in wheels:
        assert wheel.points[:, 2].min() == pytest.approx(0.0, abs=1e-9)
    assert {shape.frame for shape in sim.static_scene() if "car" in shape.name} == {"car"}


def test_the_lane_borders_lie_half_a_metre_inside_the_rails(sim: LaneKeepingEnv) -> None:
    shapes = {shape.name: shape for shape in sim.static_scene()}
    borders, road = shapes["lane_borders"].points, shapes["road"].points
    np.testing.assert_allclose(borders[:, :2].max(axis=0), road[:, :2].max(axis=0) - 0.5)
    assert sum(name.startswith("rail") for name in shapes) >= 12
    assert sum(name.startswith("building") for name in shapes) >= 50
