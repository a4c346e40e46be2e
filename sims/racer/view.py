"""Top view of the racer sim, drawn with pygame: the whole track, the rays and the keys."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.canvas import Canvas, Rgb
from mcaprl.sims.drawing.top_view import Patch, patches, placed
from mcaprl.sims.racer.car import Car
from mcaprl.sims.racer.course import IMAGE_HEIGHT_PX, IMAGE_WIDTH_PX, METERS_PER_PX, Track
from mcaprl.sims.racer.rules import STEP_S, THROTTLE, TURN
from mcaprl.sims.racer.scene import car_frame, moving_shapes, static_shapes

INK: Rgb = (255, 255, 255)
PRESSED: Rgb = (64, 217, 107)
PANEL_PX = (765, 18)
KEY_PX = 32
_KEYS = {"forward": (1, 0), "left": (0, 1), "back": (1, 1), "right": (2, 1)}
"""Column and row of each key."""
_ARROWS = {"forward": (0, -1), "left": (-1, 0), "back": (0, 1), "right": (1, 0)}
"""Direction of the arrow on each key: components to the right and down."""


class RacerView:
    """Renderer of one image per step, shown in a window in mode `human`."""

    def __init__(self, render_mode: Literal["human", "rgb_array"], track: Track) -> None:
        """Prepare the shapes that never change.

        Raises:
            MissingExtraError: Pygame is not installed.
        """
        size_px = (IMAGE_WIDTH_PX, IMAGE_HEIGHT_PX)
        self._canvas = Canvas(render_mode, size_px, "mcaprl racer", round(1 / STEP_S))
        self._track = track
        self._static = patches(static_shapes(track))

    def draw(
        self, car: Car, trail_m: Sequence[tuple[float, ...]], action: int
    ) -> NDArray[np.uint8]:
        """Render the track, the car and its last action, (600, 1000, 3)."""
        moving = patches(moving_shapes(self._track, car, trail_m))
        for patch in sorted([*self._static, *moving], key=lambda each: each.top_m):
            self._fill(patch, car)
        self._canvas.flatten()
        self._write(car)
        self._draw_keys(action)
        return self._canvas.finish()

    def close(self) -> None:
        """Close the window."""
        self._canvas.close()

    def _fill(self, patch: Patch, car: Car) -> None:
        corners_m = patch.corners_m
        if patch.frame == "car":
            x_m, y_m, _ = car_frame(car).position
            corners_m = placed(corners_m, x_m, y_m, -car.heading_rad)
        corners_px = corners_m / METERS_PER_PX * [1.0, -1.0] + [0.0, IMAGE_HEIGHT_PX]
        self._canvas.polygon(corners_px, patch.color)

    def _write(self, car: Car) -> None:
        left, top = PANEL_PX
        self._canvas.text(f"score {int(car.gates)}", (left, top), 32, INK)
        self._canvas.text(f"speed {car.speed_px:.0f}", (left, top + 26), 32, INK)
        self._canvas.text(f"step {int(car.steps)}", (left, top + 52), 32, INK)

    def _draw_keys(self, action: int) -> None:
        pressed = {
            "forward": THROTTLE[action] > 0,
            "back": THROTTLE[action] < 0,
            "left": TURN[action] < 0,
            "right": TURN[action] > 0,
        }
        left, top = PANEL_PX[0] + 115, PANEL_PX[1]
        for name, (column, row) in _KEYS.items():
            box_px = (left + column * (KEY_PX + 5), top + row * (KEY_PX + 5), KEY_PX, KEY_PX)
            if pressed[name]:
                self._canvas.rectangle(box_px, PRESSED)
            self._canvas.rectangle(box_px, INK, edge_px=2)
            middle_px = (box_px[0] + KEY_PX // 2, box_px[1] + KEY_PX // 2)
            self._canvas.arrowhead(middle_px, _ARROWS[name], INK)
