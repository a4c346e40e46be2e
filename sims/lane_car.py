"""How the lane sim's car answers its six actions, and where that puts it on the path."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mcaprl.sims.bicycle import Motion, roll, steering_for_lateral
from mcaprl.sims.compiled import compiled
from mcaprl.sims.geometry import Path, Projection, project

ACTION_MEANINGS = ("brake", "straight", "right 0.5", "left 0.5", "right 0.25", "left 0.25")
BRAKE = 0
STEERING = (0.0, 0.0, -0.5, 0.5, -0.25, 0.25)
"""Share of the full steering angle for each action, positive to the left; braking keeps the last."""
MAX_STEERING = 0.5

STEP_S = 0.25
SUBSTEPS = 5
WHEELBASE_M = 2.7
MAX_SPEED_M_S = 30.0
THROTTLE_M_S2 = 4.0
"""Acceleration from a stand; it falls linearly to zero at the top speed."""
BRAKE_M_S2 = 8.0
MAX_LATERAL_M_S2 = 9.0
FULL_STEERING_RAD = math.radians(40.0)
_CURVE_SPEED_M_S = np.array([0.0, 20.0, 60.0, 120.0]) / 3.6
_CURVE = np.array([1.0, 0.9, 0.8, 0.7])

_BEHIND_M = 4.0
_AHEAD_M = 8.0


class Car(NamedTuple):
    """All that the next step depends on, apart from the action."""

    motion: Motion
    steering: float
    """The last steering command, -0.5 (right) to 0.5 (left)."""
    nearest: Projection
    """The nearest path point; `along_m` counts on over the laps."""
    slow_s: float
    """How long the car has been slower than a walk."""


@compiled
def steering_angle(steering: float, speed_m_s: float) -> float:
    """Give the front wheels' angle, radians, for a steering command at a speed.

    The full angle of 40 degrees shrinks with speed by the curve that Unreal Engine 4 gives its
    wheeled vehicles (1, .9, .8, .7 at 0, 20, 60, 120 km/h), and never turns the car harder than
    9 m/s^2 sideways.
    """
    wanted_rad = steering * FULL_STEERING_RAD * np.interp(speed_m_s, _CURVE_SPEED_M_S, _CURVE)
    most_rad = steering_for_lateral(MAX_LATERAL_M_S2, speed_m_s, WHEELBASE_M)
    return min(max(wanted_rad, -most_rad), most_rad)


@compiled
def drive(path: Path, car: Car, action: int) -> Car:
    """Carry out one action for `STEP_S` seconds, without the stall timer.

    The nearest path point is searched from 4 m behind to 8 m ahead of the last one, because the
    path takes one street twice.
    """
    steering = car.steering if action == BRAKE else STEERING[action]
    duration_s = STEP_S / SUBSTEPS
    motion = car.motion
    for _ in range(SUBSTEPS):
        if action == BRAKE:
            acceleration_m_s2 = -min(BRAKE_M_S2, motion.speed_m_s / duration_s)
        else:
            acceleration_m_s2 = THROTTLE_M_S2 * (1.0 - motion.speed_m_s / MAX_SPEED_M_S)
        angle_rad = steering_angle(steering, motion.speed_m_s)
        motion = roll(motion, angle_rad, acceleration_m_s2, WHEELBASE_M, duration_s)
    last_m = car.nearest.along_m
    nearest = project(path, motion.x_m, motion.y_m, last_m - _BEHIND_M, last_m + _AHEAD_M)
    return Car(motion, steering, nearest, car.slow_s)
