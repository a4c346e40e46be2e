"""The scripted driver of the highway-lane sim: pursue a point ahead, on the lane that is free."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.highway.course import Course
from mcaprl.sims.highway.env import STEERING_RAD, HighwayLaneEnv
from mcaprl.sims.vehicle.arguments import check_one

PURSUIT_M = 10.0
ROOM_M = 30.0
"""With less of it ahead, a lane with more is taken."""
BESIDE_M = 9.0
"""A car up to this far behind blocks its lane, too."""


class HighwayPilot:
    """Drives the car of one environment, whose state it reads."""

    name: ClassVar[str] = "pilot"

    def __init__(self, sim: HighwayLaneEnv) -> None:
        """Take the wheel of `sim`."""
        self._sim = sim

    def act(self, observations: NDArray[np.generic]) -> NDArray[np.int64]:
        """Give the action, shape (1,), for the car as it is now.

        The circle through the car, along its heading, and a point at distance d and l to its left
        has radius d^2 / (2 l). Coulter, "Implementation of the pure pursuit path tracking
        algorithm", CMU-RI-TR-92-01, 1992.

        Raises:
            ValueError: there are observations of more than one environment.
        """
        check_one(observations)
        car, course = self._sim.car, self._free_course()
        along_m = course.nearest(car.x_m, car.y_m).along_m
        forward_m, left_m = car.sees(course.point(along_m + PURSUIT_M))
        # Their cars' axles are a car's length apart.
        slip_sine = car.length_m * left_m / (forward_m**2 + left_m**2)
        wanted_rad = math.atan(2.0 * math.tan(math.asin(min(max(slip_sine, -1.0), 1.0))))
        return np.array([np.argmin(np.abs(STEERING_RAD - wanted_rad))], dtype=np.int64)

    def _free_course(self) -> Course:
        """Stay on the lane while there is room, else choose the one with most of it."""
        own = self._sim.course
        if self._room_m(own) >= ROOM_M:
            return own
        return max(self._sim.courses, key=self._room_m)

    def _room_m(self, course: Course) -> float:
        """Give the way along a lane to the nearest car on it."""
        car = self._sim.car
        here_m = course.nearest(car.x_m, car.y_m).along_m
        room_m = math.inf
        for other in self._sim.others:
            place = course.nearest(other.x_m, other.y_m)
            ahead_m = place.along_m - here_m
            if course.is_closed:
                ahead_m = (ahead_m + BESIDE_M) % course.length_m - BESIDE_M
            if abs(place.offset_m) < course.half_width_m and ahead_m > -BESIDE_M:
                room_m = min(room_m, ahead_m)
        return room_m
