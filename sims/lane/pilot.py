"""Pilot of the lane sim: pure pursuit that brakes before corners.

If pure pursuit would end the episode, the pilot searches for a better action.
"""

from __future__ import annotations

import math

from mcaprl.compiled import compiled
from mcaprl.sims.geometry.bicycle import steering_of
from mcaprl.sims.geometry.paths import in_body_frame, leg_at, point_at
from mcaprl.sims.lane.course import COURSE
from mcaprl.sims.lane.env import LaneKeepingEnv
from mcaprl.sims.lane.rules import (
    ACTION_COMMANDS,
    BRAKE,
    DRIVING,
    SUBSTEP_S,
    SUBSTEPS,
    WHEELBASE_M,
    Car,
    drive,
    end_of,
    reward_of,
    wheel_angle,
)
from mcaprl.sims.vehicle.env import ScriptedPilot

PURSUIT_M = 8.0
PURSUIT_S = 0.4
"""Lookahead distance along the path: 8 m plus 0.4 s times the speed."""
CORNER_SPEED_M_S = 7.0
CORNER_BRAKE_M_S2 = 1.5
CORNER_EARLY_M = 2.0
"""The pilot brakes with 1.5 m/s^2, so that the car reaches the corner speed 2 m before the
corner."""
HORIZON = 12
"""Number of decisions in a plan (3 s by default). The episode must not end during a plan."""


@compiled
def pursue(car: Car) -> int:
    """Choose an action by pure pursuit; brake for the next corner if necessary.

    Let a point ahead be at distance d from the car, and l meters to the left of its heading. The
    circle through this point that is tangent to the heading has the radius d^2 / (2 l). Coulter,
    "Implementation of the pure pursuit path tracking algorithm", CMU-RI-TR-92-01, 1992.
    """
    leg = leg_at(COURSE, car.along_m)
    corner_m = COURSE.along_m[leg + 1] - car.along_m % COURSE.length_m
    slowing_m = max(0.0, corner_m - CORNER_EARLY_M)
    if car.speed_m_s > math.sqrt(CORNER_SPEED_M_S**2 + 2.0 * CORNER_BRAKE_M_S2 * slowing_m):
        return BRAKE
    ahead_m = PURSUIT_M + PURSUIT_S * car.speed_m_s
    x_m, y_m = point_at(COURSE, car.along_m + ahead_m)
    forward_m, left_m = in_body_frame(
        x_m - car.x_m, y_m - car.y_m, math.cos(car.yaw_rad), math.sin(car.yaw_rad)
    )
    slip_sine = WHEELBASE_M * left_m / (forward_m**2 + left_m**2)
    wanted_rad = steering_of(min(max(slip_sine, -1.0), 1.0))
    best, smallest_rad = BRAKE, math.inf
    for action in range(BRAKE + 1, len(ACTION_COMMANDS)):
        error_rad = abs(wheel_angle(ACTION_COMMANDS[action].steering, car.speed_m_s) - wanted_rad)
        if error_rad < smallest_rad:
            best, smallest_rad = action, error_rad
    return best


@compiled
def pursuit_value(car: Car, substeps: int = SUBSTEPS) -> float:
    """Return the number of decisions until pursuit fails, plus 0.1 times the total reward."""
    total = 0.0
    for survived in range(HORIZON):
        after = drive(car, ACTION_COMMANDS[pursue(car)], substeps)
        if end_of(after) != DRIVING:
            return survived + 0.1 * total
        total += reward_of(car, after)
        car = after
    return HORIZON + 0.1 * total


@compiled
def choose(car: Car, substeps: int = SUBSTEPS) -> int:
    """Choose the pursuit action if `HORIZON` decisions of pursuit are safe. Otherwise, search.

    The search tries all pairs of two actions, each followed by pursuit. The result is the first
    action of the best pair.
    """
    if pursuit_value(car, substeps) >= HORIZON:
        return pursue(car)
    best, most = BRAKE, -math.inf
    for first in range(len(ACTION_COMMANDS)):
        middle = drive(car, ACTION_COMMANDS[first], substeps)
        if end_of(middle) != DRIVING:
            continue
        for second in range(len(ACTION_COMMANDS)):
            after = drive(middle, ACTION_COMMANDS[second], substeps)
            value = pursuit_value(after, substeps) if end_of(after) == DRIVING else -1.0
            if value > most:
                best, most = first, value
    return best


class LanePilot(ScriptedPilot[LaneKeepingEnv]):
    """Scripted driver of the lane sim's car."""

    def choose(self) -> int:
        """Choose the action for the current state of the car."""
        return choose(self.sim.car, round(self.sim.step_duration_s / SUBSTEP_S))
