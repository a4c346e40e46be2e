"""A road of highway-env from above: the car stays in the middle, north is up."""

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
    """Draws one picture for each step, and shows it in a window in mode `human`."""

    def __init__(
        self,
        render_mode: Literal["human", "rgb_array"],
        static: Iterable[Shape],
        frames_per_s: int,
    ) -> None:
        """Prepare the parts of the picture that never change.

        Raises:
            MissingExtraError: pygame is not installed.
        """
        self._view = FollowView(render_mode, "highway-lane", static, VIEW_M, frames_per_s)

    def draw(
        self, car: Car, moving: Iterable[Shape], offset_m: float, reward: float
    ) -> NDArray[np.uint8]:
        """Draw the car where it is, and give the picture, (600, 600, 3).

        Args:
            car: that stays in the middle.
            moving: the shapes that change.
            offset_m: of the car from the middle of its lane.
            reward: of the last step.
        """
        text = f"{car.speed_m_s:4.1f} m/s   offset {offset_m:+.2f} m   reward {reward:+.2f}"
        self._view.draw(moving, Body("car", car.x_m, car.y_m, car.yaw_rad), text)
        return self._view.show()

    def close(self) -> None:
        """Close the window."""
        self._view.close()
