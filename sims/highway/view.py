"""Top view of the highway-lane sim, with the car in the middle and north up."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.follow_view import Body, FollowView
from mcaprl.sims.drawing.scene import Shape
from mcaprl.sims.highway.scene import Car

VIEW_M = 80.0


class HighwayView:
    """Renderer of one image for each step, which mode `human` shows in a window."""

    def __init__(
        self,
        render_mode: Literal["human", "rgb_array"],
        static: Iterable[Shape],
        frames_per_s: int,
    ) -> None:
        """Prepare the shapes that never change.

        Raises:
            MissingExtraError: Pygame is not installed.
        """
        self._view = FollowView(render_mode, "highway-lane", static, VIEW_M, frames_per_s)

    def draw(
        self, car: Car, moving: Iterable[Shape], offset_m: float, reward: float
    ) -> NDArray[np.uint8]:
        """Render the car and its surroundings, (600, 600, 3).

        Args:
            car: Car in the middle of the image.
            moving: Shapes that change with each step.
            offset_m: Distance of the car from the middle of its lane, left positive.
            reward: Reward of the last step.
        """
        text = f"{car.speed_m_s:4.1f} m/s   offset {offset_m:+.2f} m   reward {reward:+.2f}"
        self._view.draw(moving, Body("car", car.x_m, car.y_m, car.yaw_rad), text)
        return self._view.show()

    def close(self) -> None:
        """Close the window."""
        self._view.close()
