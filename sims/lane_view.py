"""The lane sim from above, drawn with pygame: the car stays in the middle, north is up."""

from __future__ import annotations

import os
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import import_extra
from mcaprl.sims.lane_rules import DECISION_S, Car
from mcaprl.sims.lane_scene import moving_shapes, static_shapes
from mcaprl.sims.scene import Color
from mcaprl.sims.top_view import Patch, patches, placed

SIDE_PX = 600
VIEW_M = 55.0
_SMOOTH = 2
"""Each pixel is the mean of this many squared, so that edges are not jagged."""
_INK = (255, 255, 255)
_PLATE = (20, 22, 26)


class LaneView:
    """Draws one picture for each step, and shows it in a window in mode `human`."""

    def __init__(self, render_mode: Literal["human", "rgb_array"]) -> None:
        """Prepare the parts of the picture that never change.

        Raises:
            MissingExtraError: pygame is not installed.
        """
        # Programs that print results on stdout must not find a greeting there.
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        self._pygame = import_extra("pygame", "sims")
        self._pygame.font.init()
        self._font = self._pygame.font.Font(None, 26)
        self._canvas = self._pygame.Surface((_SMOOTH * SIDE_PX, _SMOOTH * SIDE_PX))
        self._static = patches(static_shapes())
        self._window: Any = None
        if render_mode == "human":
            self._pygame.display.init()
            self._window = self._pygame.display.set_mode((SIDE_PX, SIDE_PX))
            self._pygame.display.set_caption("mcaprl lane")
            self._clock = self._pygame.time.Clock()

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
        picture = self._pygame.transform.smoothscale(self._canvas, (SIDE_PX, SIDE_PX))
        self._write(picture, car, reward)
        if self._window is not None:
            self._show(picture)
        pixels = self._pygame.surfarray.array3d(picture)
        return np.ascontiguousarray(pixels.transpose(1, 0, 2))

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._pygame.display.quit()
            self._window = None

    def _fill(self, patch: Patch, car: Car) -> None:
        corners_m = patch.corners_m
        if patch.frame == "car":
            corners_m = placed(corners_m, car.x_m, car.y_m, car.yaw_rad)
        away_m = corners_m - [car.x_m, car.y_m]
        if _outside(away_m):
            return
        scale_px = _SMOOTH * SIDE_PX / VIEW_M
        corners_px = _SMOOTH * SIDE_PX / 2 + away_m * [scale_px, -scale_px]
        self._pygame.draw.polygon(self._canvas, _rgb(patch.color), corners_px.tolist())

    def _write(self, picture: Any, car: Car, reward: float) -> None:
        text = (
            f"{car.speed_m_s:4.1f} m/s   offset {car.offset_m:+.2f} m   "
            f"at {car.along_m:.0f} m   reward {reward:+.2f}"
        )
        self._pygame.draw.rect(picture, _PLATE, (0, SIDE_PX - 34, SIDE_PX, 34))
        picture.blit(self._font.render(text, True, _INK), (12, SIDE_PX - 26))

    def _show(self, picture: Any) -> None:
        self._window.blit(picture, (0, 0))
        self._pygame.event.pump()
        self._pygame.display.flip()
        self._clock.tick(round(1.0 / DECISION_S))


def _outside(away_m: NDArray[np.float64]) -> bool:
    """Say whether all of a polygon is beyond one side of the picture."""
    half_m = VIEW_M / 2
    return bool(np.any(away_m.min(axis=0) > half_m) or np.any(away_m.max(axis=0) < -half_m))


def _rgb(color: Color) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in color[:3])
    return red, green, blue
