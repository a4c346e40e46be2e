"""The lane sim from above, drawn with pygame: the car stays in the middle, north is up."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.canvas import Canvas
from mcaprl.sims.lane_rules import DECISION_S, Car
from mcaprl.sims.lane_scene import moving_shapes, static_shapes
from mcaprl.sims.top_view import Patch, patches, placed

SIDE_PX = 600
VIEW_M = 55.0
_INK = (255, 255, 255)
_PLATE = (20, 22, 26)


class LaneView:
    """Draws one picture for each step, and shows it in a window in mode `human`."""

    def __init__(self, render_mode: Literal["human", "rgb_array"]) -> None:
        """Prepare the parts of the picture that never change.

        Raises:
            MissingExtraError: pygame is not installed.
        """
        self._canvas = Canvas(render_mode, (SIDE_PX, SIDE_PX), "mcaprl lane", round(1 / DECISION_S))
        self._static = patches(static_shapes())

    def draw(self, car: Car, trail_m: NDArray[np.float64], reward: float) -> NDArray[np.uint8]:
        """Draw the car where it is, and give the picture, (600, 600, 3).

        Args:
            car: the car now.
            trail_m: (K, 2) its last positions, K >= 1.
            reward: of the last step.
        """
        moving = patches(moving_shapes(car, [(float(x), float(y)) for x, y in trail_m]))
        for patch in sorted([*self._static, *moving], key=lambda each: each.top_m):
            self._fill(patch, car)
        self._canvas.flatten()
        self._write(car, reward)
        return self._canvas.finish()

    def close(self) -> None:
        """Close the window."""
        self._canvas.close()

    def _fill(self, patch: Patch, car: Car) -> None:
        corners_m = patch.corners_m
        if patch.frame == "car":
            corners_m = placed(corners_m, car.x_m, car.y_m, car.yaw_rad)
        away_m = corners_m - [car.x_m, car.y_m]
        if _outside(away_m):
            return
        scale_px = SIDE_PX / VIEW_M
        self._canvas.polygon(SIDE_PX / 2 + away_m * [scale_px, -scale_px], patch.color)

    def _write(self, car: Car, reward: float) -> None:
        text = (
            f"{car.speed_m_s:4.1f} m/s   offset {car.offset_m:+.2f} m   "
            f"at {car.along_m:.0f} m   reward {reward:+.2f}"
        )
        self._canvas.rectangle((0, SIDE_PX - 34, SIDE_PX, 34), _PLATE)
        self._canvas.text(text, (12, SIDE_PX - 26), 26, _INK)


def _outside(away_m: NDArray[np.float64]) -> bool:
    """Say whether all of a polygon is beyond one side of the picture."""
    half_m = VIEW_M / 2
    return bool(np.any(away_m.min(axis=0) > half_m) or np.any(away_m.max(axis=0) < -half_m))
