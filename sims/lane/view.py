"""Top view of the lane sim, with the car in the middle and north up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.follow_view import Body, FollowView
from mcaprl.sims.drawing.scene import Shape
from mcaprl.sims.lane.rules import DECISION_S, Car
from mcaprl.sims.lane.scene import static_shapes

VIEW_M = 55.0


class LaneView:
    """Renderer of one image for each step, which mode `human` shows in a window."""

    def __init__(self, render_mode: Literal["human", "rgb_array"]) -> None:
        """Prepare the shapes that never change.

        Raises:
            MissingExtraError: Pygame is not installed.
        """
        frames_per_s = round(1.0 / DECISION_S)
        self._view = FollowView(render_mode, "lane", static_shapes(), VIEW_M, frames_per_s)

    def draw(self, car: Car, moving: Sequence[Shape], reward: float) -> NDArray[np.uint8]:
        """Render the car and its surroundings, (600, 600, 3).

        Args:
            car: State of the car.
            moving: Shapes that change with each step.
            reward: Reward of the last step.
        """
        text = (
            f"{car.speed_m_s:4.1f} m/s   offset {car.offset_m:+.2f} m   "
            f"at {car.along_m:.0f} m   reward {reward:+.2f}"
        )
        body = Body("car", car.x_m, car.y_m, car.yaw_rad)
        self._view.draw(moving, body, text)
        return self._view.show()

    def close(self) -> None:
        """Close the window."""
        self._view.close()
