"""Pilot of the highway-lane sim: pure pursuit on the lane with the most free space."""

from __future__ import annotations

import math

import numpy as np

from mcaprl.sims.highway.course import Course
from mcaprl.sims.highway.env import STEERING_RAD, HighwayLaneEnv
from mcaprl.sims.vehicle.env import ScriptedPilot

PURSUIT_M, CONTINUOUS_PURSUIT_M = 10.0, 4.0
"""Lookahead distance along the lane for discrete and continuous actions."""
ROOM_M = 30.0
"""Free distance ahead below which the pilot changes to the lane with the most free distance."""
BESIDE_M = 9.0
"""A car that follows at less than this distance also blocks its lane."""


class HighwayPilot(ScriptedPilot[HighwayLaneEnv]):
    """Scripted driver of the highway-lane sim's car."""

    def choose(self) -> int | list[float]:
        """Choose the action for the current state of the car.

        Let a point ahead be at distance d from the car, and l meters to the left of its heading.
        The circle through this point that is tangent to the heading has the radius d^2 / (2 l).
        Coulter, "Implementation of the pure pursuit path tracking algorithm", CMU-RI-TR-92-01,
        1992.
        """
        car, course = self.sim.car, self._free_course()
        is_continuous = self.sim.controls.commands is None
        pursuit_m = CONTINUOUS_PURSUIT_M if is_continuous else PURSUIT_M
        along_m = course.nearest(car.x_m, car.y_m).along_m
        forward_m, left_m = car.to_body_frame(course.point(along_m + pursuit_m))
        # In highway-env, the wheelbase equals the car's length.
        slip_sine = car.length_m * left_m / (forward_m**2 + left_m**2)
        wanted_rad = math.atan(2.0 * math.tan(math.asin(min(max(slip_sine, -1.0), 1.0))))
        if is_continuous:
            return [min(max(wanted_rad / self.sim.steering_range_rad, -1.0), 1.0)]
        return int(np.argmin(np.abs(STEERING_RAD - wanted_rad)))

    def _free_course(self) -> Course:
        """Return the current lane if it is free for 30 m, else the lane with the most space."""
        own = self.sim.course
        if self._room_m(own) >= ROOM_M:
            return own
        return max(self.sim.courses, key=self._room_m)

    def _room_m(self, course: Course) -> float:
        """Return the distance along a lane to the next car on it."""
        car = self.sim.car
        here_m = course.nearest(car.x_m, car.y_m).along_m
        room_m = math.inf
        for other in self.sim.others:
            place = course.nearest(other.x_m, other.y_m)
            ahead_m = place.along_m - here_m
            if course.is_closed:
                ahead_m = (ahead_m + BESIDE_M) % course.length_m - BESIDE_M
            if abs(place.offset_m) < course.half_width_m and ahead_m > -BESIDE_M:
                room_m = min(room_m, ahead_m)
        return room_m
