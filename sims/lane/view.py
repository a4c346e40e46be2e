"""The lane sim from above: the car stays in the middle, north is up."""

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
    """Draws one picture for each step, and shows it in a window in mode `human`."""

    def __init__(self, render_mode: Literal["human", "rgb_array"]) -> None:
        """Prepare the parts of the picture that never change.

        Raises:
            MissingExtraError: pygame is not installed.
        """
        frames_per_s = round(1.0 / DECISION_S)
        self._view = FollowView(render_mode, "lane", static_shapes(), VIEW_M, frames_per_s)

    def draw(self, car: Car, moving: Sequence[Shape], reward: float) -> NDArray[np.uint8]:
        """Draw the car where it is, and give the picture, (600, 600, 3).

        Args:
            car: the car now.
            moving: the shapes that change with each step.
            reward: of the last step.
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
