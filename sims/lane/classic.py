"""Published rules of the lane sim, including the faults that `LaneKeepingEnv` lists.

The published text and code differ. In the text, an episode ends if the car is too slow. In the
code, it ends if the car hits an obstacle.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled
from mcaprl.sims.lane.course import COURSE
from mcaprl.sims.lane.rays import touches
from mcaprl.sims.lane.rules import (
    COLLISION,
    DRIVING,
    LOW_REWARD,
    OFF_LANE,
    SLOW,
    SUBSTEP_S,
    Car,
    Command,
    car_at,
    drive,
    observe,
    store_car,
)

CLASSIC_DECISION_S = 1.0
CLASSIC_SUBSTEPS = round(CLASSIC_DECISION_S / SUBSTEP_S)
CLASSIC_LANE_M = 3.5
CLASSIC_OFF_LANE_REWARD = -3.0
LOWEST_REWARD = -1.0
NEARNESS_PER_M = 3.0
LOW_SPEED_M_S, TOP_SPEED_M_S = 10.0, 300.0
SLOWEST_M_S = 5.0
STRAIGHT = 1


@compiled
def classic_distance(x_m: float, y_m: float) -> float:
    """Return the distance to the nearest leg, meters; each leg counts as an infinite line."""
    nearest_m = math.inf
    for leg in range(len(COURSE.yaw_rad)):
        dx, dy = x_m - COURSE.points_m[leg, 0], y_m - COURSE.points_m[leg, 1]
        nearest_m = min(nearest_m, abs(COURSE.forward[leg, 0] * dy - COURSE.forward[leg, 1] * dx))
    return nearest_m


@compiled
def classic_reward(distance_m: float, speed_m_s: float) -> float:
    """Return -3 beyond 3.5 m, else (exp(-3 d) - 0.5) + ((v - 10) / (300 - 10) - 0.5)."""
    if distance_m > CLASSIC_LANE_M:
        return CLASSIC_OFF_LANE_REWARD
    nearness = math.exp(-NEARNESS_PER_M * distance_m) - 0.5
    return nearness + (speed_m_s - LOW_SPEED_M_S) / (TOP_SPEED_M_S - LOW_SPEED_M_S) - 0.5


@compiled
def classic_end(
    distance_m: float, speed_m_s: float, command: Command, hit: bool, by_code: bool
) -> int:
    """Return the outcome of a step: DRIVING, OFF_LANE, LOW_REWARD, SLOW or COLLISION."""
    if distance_m > CLASSIC_LANE_M:
        return OFF_LANE
    if classic_reward(distance_m, speed_m_s) < LOWEST_REWARD:
        return LOW_REWARD
    if by_code:
        return COLLISION if hit and command.pedal > 0.0 and command.steering == 0.0 else DRIVING
    return SLOW if speed_m_s <= SLOWEST_M_S and command.pedal > 0.0 else DRIVING


@compiled
def classic_decide(car: Car, command: Command) -> tuple[Car, bool]:
    """Drive for one second; return the state, and whether the body met an obstacle."""
    hit = False
    for _ in range(CLASSIC_SUBSTEPS):
        car = drive(car, command, 1)
        hit = hit or touches(car)
    return car, hit


@compiled
def step_classic(
    cars: NDArray[np.float64],
    commands: NDArray[np.float64],
    rewards: NDArray[np.float64],
    ends: NDArray[np.int64],
    observations: NDArray[np.float32],
    by_code: bool,
) -> None:
    """Advance N cars by one decision each, in place; arguments as in `step_cars`."""
    for i in range(len(cars)):
        command = Command(commands[i, 0], commands[i, 1])
        after, hit = classic_decide(car_at(cars[i]), command)
        distance_m = classic_distance(after.x_m, after.y_m)
        rewards[i] = classic_reward(distance_m, after.speed_m_s)
        ends[i] = classic_end(distance_m, after.speed_m_s, command, hit, by_code)
        observe(after, observations[i])
        store_car(after, cars[i])
