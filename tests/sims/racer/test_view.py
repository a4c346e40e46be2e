"""Tests of the scene and the top view of the racer sim."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

import mcaprl.sims
from mcaprl.sims.drawing.scene import Color
from mcaprl.sims.racer.env import RacerEnv
from mcaprl.sims.racer.scene import ASPHALT, GRASS, INK, KEY_PX, NEXT_GATE, PAINT, PANEL_PX, PRESSED
from tests.support.sim_shapes import rotated

ENV_ID = mcaprl.sims.SIMS["racer"]
START = (5.0, 30.0, -math.pi / 2)

Image = NDArray[np.uint8]


@pytest.fixture(autouse=True)
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def image_after(actions: list[int]) -> Image:
    """Return the image of a car after actions from the start line."""
    env = gym.make(ENV_ID, render_mode="rgb_array")
    env.reset(options={"pose": START})
    for action in actions:
        env.step(action)
    image = env.render()
    env.close()
    assert isinstance(image, np.ndarray)
    return image


def near(image: Image, color: Color) -> NDArray[np.bool_]:
    """Return which pixels have a color, up to rounding."""
    wanted = np.round(255 * np.array(color[:3]))
    return np.asarray(np.all(np.abs(image - wanted) <= 2, axis=-1))


def test_the_image_has_the_pixels_of_the_rules() -> None:
    """The rules and the image use the same pixels, such as (50, 300) for the car at the start."""
    image = image_after([])
    assert image.shape == (600, 1000, 3)
    assert image.dtype == np.uint8
    rows, columns = np.nonzero(near(image, PAINT))
    assert abs(rows.mean() - 300) < 8
    assert abs(columns.mean() - 50) < 3
    assert near(image, GRASS)[300, 300]
    assert near(image, ASPHALT)[:, 65].sum() > 50
    rows, columns = np.nonzero(near(image, NEXT_GATE))
    assert abs(rows.mean() - 333) < 8


@pytest.mark.parametrize(
    ("action", "pressed"),
    [(0, []), (1, [(1, 0)]), (2, [(0, 1)]), (3, [(2, 1)]), (4, [(1, 1)]), (8, [(1, 0), (2, 1)])],
)
def test_the_keys_light_up(action: int, pressed: list[tuple[int, int]]) -> None:
    image = image_after([1, action])
    for key in ((1, 0), (0, 1), (1, 1), (2, 1)):
        column = PANEL_PX[0] + 115 + key[0] * (KEY_PX + 5) + 4
        row = PANEL_PX[1] + key[1] * (KEY_PX + 5) + 4
        assert (tuple(image[row, column]) == PRESSED) == (key in pressed)
        middle = image[row + KEY_PX // 2 - 4, column + KEY_PX // 2 - 4]
        assert tuple(middle) == INK, "an arrow on each key"


def test_score_speed_and_step_are_written() -> None:
    ink = [np.all(image_after([1] * count) == INK, axis=-1) for count in (0, 5)]
    left, top = PANEL_PX
    for line in range(3):
        text = [each[top + 26 * line : top + 26 * (line + 1), left : left + 112] for each in ink]
        assert text[0].any()
        # After five steps, the car has passed no gate, but speed and step have changed.
        assert np.array_equal(text[0], text[1]) == (line == 0)


def test_a_window_shows_each_step() -> None:
    env = gym.make(ENV_ID, render_mode="human")
    env.reset(seed=0)
    env.step(1)
    assert env.render() is None
    env.close()


def test_rendering_needs_a_mode() -> None:
    env = gym.make(ENV_ID).unwrapped
    env.reset(seed=0)
    assert env.render() is None


def test_the_scene_is_in_meters_where_the_car_is() -> None:
    sim = gym.make(ENV_ID).unwrapped
    assert isinstance(sim, RacerEnv)
    sim.reset(options={"pose": START})
    (frame,) = sim.frames()
    assert (frame.name, frame.parent, frame.position) == ("car", "map", (5.0, 30.0, 0.0))
    np.testing.assert_allclose(rotated(frame, (1, 0, 0)), [0, -1, 0], atol=1e-12)
    shapes = {shape.name: shape for shape in [*sim.static_scene(), *sim.scene()]}
    assert sum(name.startswith("wall_") for name in shapes) == 48
    assert (shapes["rays"].frame, shapes["rays"].points[0, :2].tolist()) == ("car", [0.0, 0.0])
    assert shapes["speed"].text == "0.0 m/s"
    assert shapes["trail"].points[-1, :2].tolist() == [5.0, 30.0]
    for name, shape in shapes.items():
        if name.startswith("car_wheel"):
            assert shape.points[:, 2].min() == pytest.approx(0.0, abs=1e-9)


def test_the_hits_are_on_walls() -> None:
    sim = gym.make(ENV_ID).unwrapped
    assert isinstance(sim, RacerEnv)
    sim.reset(seed=3)
    shapes = {shape.name: shape for shape in sim.scene()}
    np.testing.assert_array_equal(shapes["hits"].points, shapes["rays"].points)
    # Every second point is the start of a ray. The car's frame is rotated by its yaw.
    hits, yaw_rad = shapes["hits"].points[1::2, :2], sim.telemetry()["yaw_rad"]
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    hits = hits @ np.array([[cos, sin], [-sin, cos]]) + np.array(sim.place)
    starts, ends = np.split(sim.track.walls_px, 2, axis=1)
    flip, lift = np.array([0.1, -0.1]), np.array([0.0, 60.0])
    starts, ends = starts * flip + lift, ends * flip + lift
    along = ends - starts
    for hit in hits:
        share = np.clip(np.sum((hit - starts) * along, 1) / np.sum(along**2, 1), 0, 1)
        nearest = starts + share[:, None] * along
        # Each coordinate is rounded to 1/8 m; the error is at most hypot(1/16, 1/16) = 0.088 m.
        assert np.hypot(*(hit - nearest).T).min() < 0.09
