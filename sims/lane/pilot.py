"""Pilots of the lane sim: pure pursuit that brakes before corners.

If pure pursuit would end the episode, the pilot with discrete actions searches for a better action.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from mcaprl.compiled import compiled
from mcaprl.sims.geometry import in_body_frame, leg_at, point_at, steering_of
from mcaprl.sims.lane.course import COURSE
from mcaprl.sims.lane.env import LaneKeepingEnv
from mcaprl.sims.lane.rules import (
    ACTION_COMMANDS,
    BRAKE,
    BRAKE_M_S2,
    DECISION_S,
    DRIVING,
    MAX_STEERING_RAD,
    SUBSTEP_S,
    SUBSTEPS,
    WHEELBASE_M,
    Car,
    Command,
    acceleration,
    drive,
    end_of,
    reward_of,
    steering_share,
    wheel_angle,
)
from mcaprl.sims.vehicle.env import ScriptedPilot


class Gains(NamedTuple):
    """Constants of a pilot."""

    pursuit_m: float
    pursuit_s: float
    """The lookahead distance along the path is `pursuit_m` plus `pursuit_s` times the speed."""
    corner_speed_m_s: float
    corner_brake_m_s2: float
    corner_early_m: float
    """The pilot brakes so that the car reaches the corner speed this far before the corner."""


GAINS = Gains(8.0, 0.4, 7.0, 1.5, 2.0)
CONTINUOUS_GAINS = Gains(7.0, 0.4, 9.0, 6.0, 7.0)
HORIZON = 12
"""Number of decisions in a plan (3 s by default). The episode must not end during a plan."""


@compiled
def wanted_speed(car: Car, gains: Gains) -> float:
    """Return the speed, m/s, from which the car can still brake for the next corner."""
    leg = leg_at(COURSE, car.along_m)
    corner_m = COURSE.along_m[leg + 1] - car.along_m % COURSE.length_m
    slowing_m = max(0.0, corner_m - gains.corner_early_m)
    return math.sqrt(gains.corner_speed_m_s**2 + 2.0 * gains.corner_brake_m_s2 * slowing_m)


@compiled
def pursuit_angle(car: Car, gains: Gains) -> float:
    """Return the wheel angle, radians, of pure pursuit.

    Let a point ahead be at distance d from the car, and l meters to the left of its heading. The
    circle through this point that is tangent to the heading has the radius d^2 / (2 l). Coulter,
    "Implementation of the pure pursuit path tracking algorithm", CMU-RI-TR-92-01, 1992.
    """
    ahead_m = gains.pursuit_m + gains.pursuit_s * car.speed_m_s
    x_m, y_m = point_at(COURSE, car.along_m + ahead_m)
    forward_m, left_m = in_body_frame(
        x_m - car.x_m, y_m - car.y_m, math.cos(car.yaw_rad), math.sin(car.yaw_rad)
    )
    slip_sine = WHEELBASE_M * left_m / (forward_m**2 + left_m**2)
    return steering_of(min(max(slip_sine, -1.0), 1.0))


@compiled
def steer(car: Car, gains: Gains = CONTINUOUS_GAINS) -> Command:
    """Return the command of pure pursuit that reaches the wanted speed in one decision."""
    lacking_m_s2 = (wanted_speed(car, gains) - car.speed_m_s) / DECISION_S
    is_braking = lacking_m_s2 < 0.0
    full_m_s2 = BRAKE_M_S2 if is_braking else acceleration(car.speed_m_s, 1.0)
    pedal = lacking_m_s2 / max(full_m_s2, 1e-9)
    full_rad = MAX_STEERING_RAD * steering_share(car.speed_m_s)
    steering = pursuit_angle(car, gains) / full_rad
    return Command(min(max(pedal, -1.0), 1.0), min(max(steering, -1.0), 1.0))


@compiled
def pursue(car: Car) -> int:
    """Choose an action by pure pursuit; brake for the next corner if necessary."""
    if car.speed_m_s > wanted_speed(car, GAINS):
        return BRAKE
    wanted_rad = pursuit_angle(car, GAINS)
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
    """Choose pursuit if `HORIZON` decisions of it are safe, else the best pair's first action."""
    # The search tries all pairs of two actions, each followed by pursuit.
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

    def choose(self) -> int | Command:
        """Choose the action for the current state of the car."""
        if self.sim.controls.commands is None:
            return steer(self.sim.car)
        return choose(self.sim.car, round(self.sim.step_duration_s / SUBSTEP_S))
