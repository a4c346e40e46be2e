"""The equations of the lane sim: one decision of a car that keeps its lane, for one car or many."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.bicycle import Motion, roll, slip_for_lateral, slip_of, steering_of
from mcaprl.sims.compiled import compiled
from mcaprl.sims.geometry import in_body_frame, point_at, project, wrap_angle
from mcaprl.sims.lane_course import COURSE, LANE_HALF_WIDTH_M

ACTION_MEANINGS = ("brake", "straight", "right", "left", "slightly right", "slightly left")
STEERING = (0.0, 0.0, -0.5, 0.5, -0.25, 0.25)
"""Of the largest steering angle, left positive; action 0 brakes and keeps the last one."""
BRAKE = 0

DECISION_S = 0.25
SUBSTEPS = 5
SUBSTEP_S = DECISION_S / SUBSTEPS
WHEELBASE_M = 2.7
THROTTLE_M_S2 = 4.0
BRAKE_M_S2 = 8.0
MAX_SPEED_M_S = 30.0
MAX_STEERING_RAD = math.radians(40.0)
MAX_LATERAL_M_S2 = 9.0
STEERING_CURVE_M_S = (20 / 3.6, 60 / 3.6, 120 / 3.6)
"""The steering angle falls linearly with speed, through these knots, to these shares."""
STEERING_CURVE = (0.9, 0.8, 0.7)

BEHIND_M = 4.0
AHEAD_M = 8.0
"""How far behind and ahead of the last nearest path point the next one is looked for."""

STALL_SPEED_M_S = 1.0
STALL_TIME_S = 3.0
FAILURE_REWARD = -5.0
DRIVING, OFF_LANE, STALL, LOW_REWARD, SLOW, COLLISION = range(6)
REASONS = ("", "off_lane", "stall", "low_reward", "slow", "collision")
"""The last three are the classic rules' own."""

LOOKAHEADS_M = (5.0, 10.0, 20.0, 40.0)
OBSERVATION_NAMES = (
    "lateral_offset",
    "heading_error",
    "speed",
    "steering",
    "ahead_5m_forward",
    "ahead_5m_left",
    "ahead_10m_forward",
    "ahead_10m_left",
    "ahead_20m_forward",
    "ahead_20m_left",
    "ahead_40m_forward",
    "ahead_40m_left",
)
OBSERVATION_LIMIT = np.array([4, 2, 1, 1] + [4] * 8, dtype=np.float32)


class Car(NamedTuple):
    """The whole state of one car on the course; a row of a (cars, 9) array holds the same."""

    x_m: float
    y_m: float
    yaw_rad: float
    """In [-pi, pi), counter-clockwise from x."""
    speed_m_s: float
    steering: float
    """Last steering command, a share of the largest angle, left positive."""
    along_m: float
    """Distance of the nearest path point along the path; grows beyond one lap."""
    offset_m: float
    """Distance from the path, left positive."""
    heading_error_rad: float
    """Yaw relative to the path, left positive, in [-pi, pi)."""
    slow_s: float
    """How long the car has been slower than the stall speed."""


@compiled
def car_at(row: NDArray[np.float64]) -> Car:
    """Read a car from a row of 9 floats."""
    return Car(row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8])


@compiled
def store_car(car: Car, row: NDArray[np.float64]) -> None:
    """Write a car into a row of 9 floats."""
    for i, value in enumerate(car):
        row[i] = value


@compiled
def slip(steering: float, speed_m_s: float) -> float:
    """Give the sine of the car's slip angle: that of the steering command, less at high speed.

    The command counts for 100 % at rest, 90 % at 20 km/h, 80 % at 60 km/h and 70 % at 120 km/h; and
    the car never turns so sharply that it would feel more than 9 m/s^2 sideways.
    """
    speeds, shares = STEERING_CURVE_M_S, STEERING_CURVE
    if speed_m_s < speeds[0]:
        share = 1.0 + (shares[0] - 1.0) * speed_m_s / speeds[0]
    elif speed_m_s < speeds[1]:
        slope = (shares[1] - shares[0]) / (speeds[1] - speeds[0])
        share = shares[0] + slope * (speed_m_s - speeds[0])
    else:
        slope = (shares[2] - shares[1]) / (speeds[2] - speeds[1])
        share = shares[1] + slope * (speed_m_s - speeds[1])
    limit = slip_for_lateral(MAX_LATERAL_M_S2, speed_m_s, WHEELBASE_M)
    return min(max(slip_of(steering * MAX_STEERING_RAD * share), -limit), limit)


@compiled
def wheel_angle(steering: float, speed_m_s: float) -> float:
    """Give the front wheels' angle, radians, for a steering command at a speed; see `slip`."""
    return steering_of(slip(steering, speed_m_s))


@compiled
def located(motion: Motion, steering: float, near_m: float, slow_s: float) -> Car:
    """Make a car from its motion, looking for its place on the path around `near_m`."""
    place = project(COURSE, motion.x_m, motion.y_m, near_m - BEHIND_M, near_m + AHEAD_M)
    return Car(
        motion.x_m,
        motion.y_m,
        wrap_angle(motion.yaw_rad),
        motion.speed_m_s,
        steering,
        place.along_m,
        place.offset_m,
        wrap_angle(motion.yaw_rad - place.yaw_rad),
        slow_s,
    )


@compiled
def drive(car: Car, action: int, substeps: int = SUBSTEPS) -> Car:
    """Carry out an action for so many sub-steps of 0.05 s."""
    motion = Motion(car.x_m, car.y_m, car.yaw_rad, car.speed_m_s)
    steering = car.steering if action == BRAKE else STEERING[action]
    for _ in range(substeps):
        speed_m_s = motion.speed_m_s
        if action == BRAKE:
            acceleration_m_s2 = -min(BRAKE_M_S2, speed_m_s / SUBSTEP_S)
        else:
            acceleration_m_s2 = THROTTLE_M_S2 * (1.0 - speed_m_s / MAX_SPEED_M_S)
        slip_sine = slip(steering, speed_m_s)
        motion = roll(motion, slip_sine, acceleration_m_s2, WHEELBASE_M, SUBSTEP_S)
    duration_s = substeps * SUBSTEP_S
    slow_s = car.slow_s + duration_s if motion.speed_m_s < STALL_SPEED_M_S else 0.0
    return located(motion, steering, car.along_m, slow_s)


@compiled
def end_of(car: Car) -> int:
    """Say whether a car has failed: DRIVING, OFF_LANE or STALL."""
    if abs(car.offset_m) > LANE_HALF_WIDTH_M:
        return OFF_LANE
    return STALL if car.slow_s >= STALL_TIME_S else DRIVING


@compiled
def reward_of(before: Car, after: Car) -> float:
    """Pay a decision: progress ds along the path, less for driving beside its middle.

    ds / (30 m/s 0.25 s) (1 - (d / 3.5 m)^2 / 2) at distance d from the path, and -5 for a failure.
    """
    if end_of(after) != DRIVING:
        return FAILURE_REWARD
    progress = (after.along_m - before.along_m) / (MAX_SPEED_M_S * DECISION_S)
    return progress * (1.0 - 0.5 * (after.offset_m / LANE_HALF_WIDTH_M) ** 2)


@compiled
def observe(car: Car, observation: NDArray[np.float32]) -> None:
    """Write the 12 observed numbers; see the table of `LaneKeepingEnv`."""
    observation[0] = car.offset_m / LANE_HALF_WIDTH_M
    observation[1] = car.heading_error_rad / (0.5 * math.pi)
    observation[2] = car.speed_m_s / MAX_SPEED_M_S
    observation[3] = 2.0 * car.steering
    cos, sin = math.cos(car.yaw_rad), math.sin(car.yaw_rad)
    for i in range(len(LOOKAHEADS_M)):
        x_m, y_m = point_at(COURSE, car.along_m + LOOKAHEADS_M[i])
        forward_m, left_m = in_body_frame(x_m - car.x_m, y_m - car.y_m, cos, sin)
        observation[4 + 2 * i] = forward_m / LOOKAHEADS_M[i]
        observation[5 + 2 * i] = left_m / LOOKAHEADS_M[i]
    for i in range(len(observation)):
        limit = OBSERVATION_LIMIT[i]
        observation[i] = min(max(observation[i], -limit), limit)


@compiled
def step_cars(
    cars: NDArray[np.float64],
    actions: NDArray[np.int64],
    rewards: NDArray[np.float64],
    ends: NDArray[np.int64],
    observations: NDArray[np.float32],
) -> None:
    """Advance N cars by one decision each, in place.

    Args:
        cars: (N, 9) rows of `Car`.
        actions: (N,) 0 to 5.
        rewards: (N,) to be filled.
        ends: (N,) to be filled with DRIVING, OFF_LANE or STALL.
        observations: (N, 12) to be filled.
    """
    for i in range(len(cars)):
        before = car_at(cars[i])
        after = drive(before, actions[i])
        rewards[i] = reward_of(before, after)
        ends[i] = end_of(after)
        observe(after, observations[i])
        store_car(after, cars[i])
