"""Top view of the powerline sim; a strip below it shows a side view along the line.

In the top view, x (north) points right and y (west) up, as in the ROS axes of the scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.canvas import rgb
from mcaprl.sims.drawing.follow_view import SIDE_PX, Body, FollowView
from mcaprl.sims.drawing.shapes import STEEL
from mcaprl.sims.geometry.vectors import norm
from mcaprl.sims.powerline import scene
from mcaprl.sims.powerline.course import (
    ALONG_M,
    CHORDS,
    LENGTH_M,
    PHASES_M,
    POINTS_M,
    WIRES_M,
    Place,
    ground_height,
    nearest_on_line,
    point_on_line,
    towers,
)
from mcaprl.sims.powerline.rules import DECISION_S, Flight

Floats = NDArray[np.float64]

VIEW_M = 50.0
STRIP_TOP_PX, STRIP_BOTTOM_PX = 430, SIDE_PX - 34
STRIP_M = 180.0
"""Length of the part of the line that the strip shows; heights have the same scale."""
DRONE_DOWN_PX = 45
"""Distance of the drone from the top of the strip."""
_SKY = (158, 188, 212)
_GROUND = (88, 112, 74)
_SAMPLE_M = 2.0


class PowerlineView:
    """Renderer of one image per step, shown in a window in mode `human`."""

    def __init__(self, render_mode: Literal["human", "rgb_array"]) -> None:
        """Prepare the shapes that never change.

        Raises:
            MissingExtraError: Pygame is not installed.
        """
        frames_per_s = round(1.0 / DECISION_S)
        floor = scene.ground_shapes()
        above = scene.static_shapes()[len(floor) :]
        self._view = FollowView(render_mode, "powerline", above, VIEW_M, frames_per_s, floor)

    def draw(
        self, flight: Flight, trail_m: Sequence[tuple[float, ...]], reward: float
    ) -> NDArray[np.uint8]:
        """Render the drone and its surroundings, (600, 600, 3)."""
        drone = flight.drone
        x_m, y_m, z_m = scene.ros(drone.position_m)
        place = nearest_on_line(drone.position_m)
        text = (
            f"{norm(drone.velocity_m_s):4.1f} m/s   {place.distance_m:.2f} m off the line   "
            f"at {place.along_m:.0f} m   reward {reward:+.2f}"
        )
        body = Body("drone", x_m, y_m, 0.0, z_m)
        self._view.draw(scene.moving_shapes(flight, trail_m), body, text)
        self._draw_strip(place, z_m)
        return self._view.show()

    def close(self) -> None:
        """Close the window."""
        self._view.close()

    def _draw_strip(self, place: Place, height_m: float) -> None:
        """Draw the side view of the line and the drone."""
        draw = self._view.canvas.pygame.draw
        box_px = (0, STRIP_TOP_PX, SIDE_PX, STRIP_BOTTOM_PX - STRIP_TOP_PX)
        strip = self._view.canvas.strip(box_px, _SKY)

        def pixels(along_m: Floats, heights_m: Floats) -> list[tuple[float, float]]:
            scale_px = SIDE_PX / STRIP_M
            across = SIDE_PX / 2 + scale_px * (along_m - place.along_m)
            down = DRONE_DOWN_PX - scale_px * (heights_m - height_m)
            return list(zip(across.tolist(), down.tolist(), strict=True))

        along_m = np.arange(0.0, LENGTH_M + _SAMPLE_M, _SAMPLE_M)
        ground = pixels(along_m, _ground_under(along_m))
        below = [(ground[-1][0], 10.0 * SIDE_PX), (ground[0][0], 10.0 * SIDE_PX)]
        draw.polygon(strip, _GROUND, [*ground, *below])
        for index, tower in enumerate(towers()):
            ends = pixels(ALONG_M[[index, index]], -np.array([tower.foot_z_m, tower.arm_z_m]))
            draw.line(strip, rgb(STEEL), *ends, 4)
        draw.aalines(strip, rgb(scene.COPPER), False, pixels(*_middle_wire()))
        draw.aalines(strip, rgb(scene.ROUTE), False, pixels(ALONG_M, -POINTS_M[:, 2]))
        here = pixels(np.array([place.along_m]), np.array([height_m]))[0]
        draw.circle(strip, rgb(scene.PAINT), here, 5)


def _ground_under(along_m: Floats) -> Floats:
    """Return the heights (N,) of the ground below points of the line."""
    points = [point_on_line(along) for along in along_m]
    return np.array([ground_height(point.x, point.y) for point in points])


def _middle_wire() -> tuple[Floats, Floats]:
    """Return distances along the line, and heights of the middle conductor at these distances."""
    shares = np.linspace(0.0, 1.0, CHORDS + 1)
    spans = WIRES_M[len(PHASES_M) // 2 :: len(PHASES_M)]
    along_m = ALONG_M[:-1, None] + shares * np.diff(ALONG_M)[:, None]
    return along_m.ravel(), -spans[:, :, 2].ravel()
