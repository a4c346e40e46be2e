"""Tests of the scene and the top view of the racer sim."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mcaprl.sims.racer.scene import ASPHALT, GRASS, INK, KEY_PX, NEXT_GATE, PAINT, PANEL_PX, PRESSED
from tests.support.sims import image_of, near, unwrapped

START = (5.0, 30.0, -math.pi / 2)


def test_the_image_has_the_pixels_of_the_rules() -> None:
    """The rules and the image use the same pixels, such as (50, 300) for the car at the start."""
    image = image_of("racer", START)
    assert image.shape == (600, 1000, 3)
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
    image = image_of("racer", START, [1, action])
    for key in ((1, 0), (0, 1), (1, 1), (2, 1)):
        column = PANEL_PX[0] + 115 + key[0] * (KEY_PX + 5) + 4
        row = PANEL_PX[1] + key[1] * (KEY_PX + 5) + 4
        assert (tuple(image[row, column]) == PRESSED) == (key in pressed)
        middle = image[row + KEY_PX // 2 - 4, column + KEY_PX // 2 - 4]
        assert tuple(middle) == INK, "an arrow on each key"


def test_score_speed_and_step_are_written() -> None:
    ink = [np.all(image_of("racer", START, [1] * count) == INK, axis=-1) for count in (0, 5)]
    left, top = PANEL_PX
    for line in range(3):
        text = [each[top + 26 * line : top + 26 * (line + 1), left : left + 112] for each in ink]
        assert text[0].any()
        # After five steps, the car has passed no gate, but speed and step have changed.
        assert np.array_equal(text[0], text[1]) == (line == 0)


def test_the_scene_has_walls_rays_and_the_speed() -> None:
    sim = unwrapped("racer")
    sim.reset(options={"pose": START})
    shapes = {shape.name: shape for shape in [*sim.static_scene(), *sim.scene()]}
    assert sum(name.startswith("wall_") for name in shapes) == 48
    assert (shapes["rays"].frame, shapes["rays"].points[0, :2].tolist()) == ("car", [0.0, 0.0])
    assert shapes["speed"].text == "0.0 m/s"


def test_the_hits_are_on_walls() -> None:
    sim = unwrapped("racer")
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
