"""Tests of the scene and the top view of the powerline sim."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

from mcaprl.sims import SIMS, make_sim
from mcaprl.sims.drawing.scene import Color, Frame
from mcaprl.sims.powerline.course import POINTS_M, point_on_line, to_ros
from mcaprl.sims.powerline.env import PowerlineEnv
from mcaprl.sims.powerline.scene import PAINT, ROUTE

DRAWN_BY_POINTS = {"line": 1, "segments": 2, "triangles": 3, "spheres": 1, "arrow": 2}
NORTH, EAST = 0, 1


def flying(**kwargs: Any) -> PowerlineEnv:
    """Return a sim with the drone 150 m along the line."""
    sim = make_sim("powerline", **kwargs).unwrapped
    assert isinstance(sim, PowerlineEnv)
    sim.reset(options={"pose": (*point_on_line(150.0), 3.0, 0.0, 0.0)})
    return sim


def rotated(frame: Frame, vector: tuple[float, float, float]) -> NDArray[np.float64]:
    """Transform a vector of a frame to its parent: v + 2 u x (u x v + w v)."""
    axis, w = np.array(frame.rotation[:3]), frame.rotation[3]
    cross = np.cross(axis, vector) + w * np.array(vector)
    turned: NDArray[np.float64] = np.array(vector) + 2 * np.cross(axis, cross)
    return turned


def test_every_shape_can_be_drawn() -> None:
    sim = flying()
    sim.step(NORTH)
    shapes = [*sim.static_scene(), *sim.scene()]
    for shape in shapes:
        assert all(0.0 <= part <= 1.0 for part in shape.color)
        assert np.isfinite(shape.points).all()
        assert shape.frame in ("map", "base_stabilized", "drone")
        if shape.kind in DRAWN_BY_POINTS:
            assert len(shape.points) > 0
            assert len(shape.points) % DRAWN_BY_POINTS[shape.kind] == 0
        else:
            assert len(shape.points) == 0
            assert min(shape.size) > 0.0
    assert len({shape.name for shape in shapes}) == len(shapes)


def test_the_moving_shapes_keep_their_names_and_stay_few() -> None:
    sim = flying()
    first = [shape.name for shape in sim.scene()]
    for _ in range(70):
        sim.step(6)
    assert [shape.name for shape in sim.scene()] == first
    assert sum(len(shape.points) for shape in sim.scene()) < 80


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


@pytest.mark.parametrize(
    ("camera", "view", "right"),
    [("front", (1, 0, 0), (0, -1, 0)), ("down", (0, 0, -1), (0, -1, 0))],
)
def test_the_camera_has_optical_axes(
    camera: str, view: tuple[int, int, int], right: tuple[int, int, int]
) -> None:
    (frame,) = flying(camera=camera).static_frames()
    assert (frame.name, frame.parent) == ("camera", "drone")
    np.testing.assert_allclose(rotated(frame, (0, 0, 1)), view, atol=1e-12)
    np.testing.assert_allclose(rotated(frame, (1, 0, 0)), right, atol=1e-12)


def test_the_offset_is_drawn_to_the_nearest_point() -> None:
    sim = flying()
    sim.step(EAST)
    link = next(shape for shape in sim.scene() if shape.name == "offset").points
    distance_m = float(np.linalg.norm(link[1] - link[0]))
    # Each coordinate is rounded to 1/8 m.
    assert distance_m == pytest.approx(sim.telemetry()["line_distance_m"], abs=0.11)


def image_at(along_m: float) -> NDArray[np.uint8]:
    env = gym.make(SIMS["powerline"], render_mode="rgb_array")
    env.reset(options={"pose": tuple(point_on_line(along_m))})
    image = env.render()
    env.close()
    assert isinstance(image, np.ndarray)
    return image


def near(image: NDArray[np.uint8], color: Color) -> NDArray[np.bool_]:
    """Return which pixels have a color, up to rounding."""
    wanted = np.round(255 * np.array(color[:3]))
    return np.asarray(np.all(np.abs(image - wanted) <= 3, axis=-1))


@pytest.mark.parametrize("along_m", [5.0, 60.0, 300.0, 600.0])
def test_the_drone_is_in_the_middle_and_in_the_strip(along_m: float) -> None:
    """Hills never cover the drone, no matter whether the line is low or high."""
    image = image_at(along_m)
    assert image.shape == (600, 600, 3)
    rows, columns = np.nonzero(near(image, PAINT))
    above, strip = rows < 430, rows >= 430
    assert abs(rows[above].mean() - 300) < 12
    assert abs(columns[above].mean() - 300) < 12
    assert abs(rows[strip].mean() - 475) < 3
    assert abs(columns[strip].mean() - 300) < 3


def test_north_is_right_and_west_is_up() -> None:
    """The last leg leads north-east, so the route runs from upper left to lower right."""
    route = near(image_at(500.0)[:430], ROUTE)
    rows, columns = np.nonzero(route)
    assert np.corrcoef(rows, columns)[0, 1] > 0.9


def test_a_window_shows_each_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make(SIMS["powerline"], render_mode="human")
    env.reset(seed=0)
    env.step(1)
    assert env.render() is None
    env.close()
