"""Default rules of the lane sim: motion, rewards, episode ends and observations of a car."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled, inlined
from mcaprl.sims.geometry import (
    Heading,
    Motion,
    heading_of,
    in_body_frame,
    moving,
    roll,
    slip_of,
    steering_of,
    wrap_angle,
)
from mcaprl.sims.lane.course import (
    LANE_HALF_WIDTH_M,
    CourseSpot,
    course_point_ahead,
    course_project,
    course_spot_at,
)

ACTION_MEANINGS = ("brake", "straight", "right", "left", "slightly right", "slightly left")
BRAKE = 0


class Command(NamedTuple):
    """Command of a decision."""

    pedal: float
    """Fraction of the full throttle, or if negative, of the full brake; 0 lets the car roll."""
    steering: float
    """Fraction of the maximum steering angle, left positive; NaN keeps the last one."""


ACTION_COMMANDS = (
    Command(-1.0, math.nan),
    Command(1.0, 0.0),
    Command(1.0, -0.5),
    Command(1.0, 0.5),
    Command(1.0, -0.25),
    Command(1.0, 0.25),
)
COMMAND_UNITS = ("full brake | full throttle", "full right | full left")
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
STEERING_CURVE = (0.9, 0.8, 0.7)
"""Knots of the piecewise linear maximum steering angle: speeds, and fractions of 40 degrees."""
_FALL_1 = (1.0 - STEERING_CURVE[0]) / STEERING_CURVE_M_S[0]
_FALL_2 = (STEERING_CURVE[0] - STEERING_CURVE[1]) / (STEERING_CURVE_M_S[1] - STEERING_CURVE_M_S[0])
_FALL_3 = (STEERING_CURVE[1] - STEERING_CURVE[2]) / (STEERING_CURVE_M_S[2] - STEERING_CURVE_M_S[1])
"""Decrease of the maximum steering fraction per m/s, in the interval before each knot."""

BACK_M = 4.0
AHEAD_M = 8.0  # Search window for the nearest path point: distances before and after the last one

STALL_SPEED_M_S = 1.0
STALL_TIME_S = 3.0
FAILURE_REWARD = -5.0
DRIVING, OFF_LANE, STALL, LOW_REWARD, SLOW, COLLISION = range(6)
REASONS = ("", "off_lane", "stall", "low_reward", "slow", "collision")
"""`info["reason"]` of each end; the last three occur in the classic rules only."""

LOOKAHEADS_M = (5.0, 10.0, 20.0, 40.0)
OBSERVATION_NAMES = (
    "lateral_offset",
    "heading_error",
    "speed",
    "steering",
    *(f"ahead_{ahead:.0f}m_{axis}" for ahead in LOOKAHEADS_M for axis in ("forward", "left")),
)
OBSERVATION_LIMIT = np.array([4, 2, 1, 2] + [4] * 8, dtype=np.float32)
# Numba treats a tuple, but not an array, as a compile-time constant.
_LIMITS: tuple[float, ...] = tuple(OBSERVATION_LIMIT.tolist())


class Car(NamedTuple):
    """State of one car on the course. Fleets store it as 9 numbers in a row of an array."""

    x_m: float
    y_m: float
    yaw_rad: float  # Yaw counter-clockwise from x, in [-pi, pi)
    speed_m_s: float
    steering: float  # Last steering command as a fraction of the maximum angle, left positive
    along_m: float  # Distance of the nearest path point along the path, counted over all laps
    offset_m: float  # Distance from the path, left positive
    heading_error_rad: float  # Yaw relative to the path, left positive, in [-pi, pi)
    slow_s: float  # Time for which the car has been slower than the stall speed


ALONG, STARTED_AT = Car._fields.index("along_m"), len(Car._fields)
"""Indices of two values in a car's row: its distance along the path, now and at the start of the
episode."""


@compiled
def car_at(row: NDArray[np.float64]) -> Car:
    """Read a car from a row of 9 floats."""
    return Car(row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8])


@compiled
def store_car(car: Car, row: NDArray[np.float64]) -> None:
    """Write a car into a row of 9 floats."""
    for i, value in enumerate(car):
        row[i] = value


@inlined
def steering_share(speed_m_s: float) -> float:
    """Return the maximum steering angle at a speed, as a fraction of 40 degrees."""
    # 40 degrees at rest, 36 at 20 km/h, 32 at 60 km/h and 28 at 120 km/h.
    # The curve is convex and consists of straight lines, so it is the maximum of these lines.
    return max(
        max(
            1.0 - _FALL_1 * speed_m_s,
            STEERING_CURVE[0] - _FALL_2 * (speed_m_s - STEERING_CURVE_M_S[0]),
        ),
        STEERING_CURVE[1] - _FALL_3 * (speed_m_s - STEERING_CURVE_M_S[1]),
    )


@inlined
def slip(steering: float, speed_m_s: float) -> float:
    """Return the sine of the slip angle, with a lateral acceleration of at most 9 m/s^2."""
    steering_rad = steering * MAX_STEERING_RAD * steering_share(speed_m_s)
    return slip_of(steering_rad, speed_m_s, MAX_LATERAL_M_S2, WHEELBASE_M)


@compiled
def wheel_angle(steering: float, speed_m_s: float) -> float:
    """Return the front wheels' angle, radians, for a steering command at a speed; see `slip`."""
    return steering_of(slip(steering, speed_m_s))


@inlined
def located(motion: Motion, steering: float, near_m: float, slow_s: float) -> Car:
    """Return the car after a motion; search its position along the path near `near_m`."""
    place = course_project(motion.x_m, motion.y_m, near_m - BACK_M, near_m + AHEAD_M)
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


@inlined
def driven(motion: Motion, steering: float, pedal: float) -> Motion:
    """Advance a motion by 0.05 s, without branches, so that loops over cars are vectorized."""
    slip_sine = slip(steering, motion.speed_m_s)
    acceleration_m_s2 = acceleration(motion.speed_m_s, pedal)
    return roll(motion, slip_sine, acceleration_m_s2, WHEELBASE_M, SUBSTEP_S)


@inlined
def acceleration(speed_m_s: float, pedal: float) -> float:
    """Return the acceleration of a substep, m/s^2. A braking car stops, but does not reverse."""
    throttle_m_s2 = pedal * THROTTLE_M_S2 * (1.0 - speed_m_s * (1.0 / MAX_SPEED_M_S))
    brake_m_s2 = -min(-pedal * BRAKE_M_S2, speed_m_s * (1.0 / SUBSTEP_S))
    return brake_m_s2 if pedal < 0.0 else throttle_m_s2


@inlined
def steering_for(steering: float, last: float) -> float:
    """Return the steering of a command, or `last` if the command keeps it."""
    return last if math.isnan(steering) else steering


@compiled
def drive(car: Car, command: Command, substeps: int = SUBSTEPS) -> Car:
    """Return the car after a command that lasts `substeps` times 0.05 s."""
    motion = moving(car.x_m, car.y_m, car.yaw_rad, car.speed_m_s)
    steering = steering_for(command.steering, car.steering)
    for _ in range(substeps):
        motion = driven(motion, steering, command.pedal)
    return arrived(car, motion, steering, substeps)


@inlined
def arrived(before: Car, motion: Motion, steering: float, substeps: int) -> Car:
    """Return the car after `substeps` substeps; `motion` is its new pose and speed."""
    slow_s = before.slow_s + substeps * SUBSTEP_S if motion.speed_m_s < STALL_SPEED_M_S else 0.0
    return located(motion, steering, before.along_m, slow_s)


@inlined
def end_of(car: Car) -> int:
    """Return the outcome of a decision: DRIVING, OFF_LANE or STALL."""
    stalled = STALL if car.slow_s >= STALL_TIME_S else DRIVING
    return OFF_LANE if abs(car.offset_m) > LANE_HALF_WIDTH_M else stalled


@inlined
def reward_of(before: Car, after: Car) -> float:
    """Return the reward ds / 7.5 m (1 - (d / 3.5 m)^2 / 2), or -5 for a failure."""
    # ds is the progress along the path, 7.5 m that at 30 m/s, and d the distance from the path.
    progress = (after.along_m - before.along_m) / (MAX_SPEED_M_S * DECISION_S)
    paid = progress * (1.0 - 0.5 * (after.offset_m / LANE_HALF_WIDTH_M) ** 2)
    return paid if end_of(after) == DRIVING else FAILURE_REWARD


@compiled
def observe(car: Car, observation: NDArray[np.float32]) -> None:
    """Write the 12 observed numbers; see "Observation Space" of `LaneKeepingEnv`."""
    for i, number in enumerate(seen_from(car)):
        observation[i] = number


Numbers = tuple[float, float, float, float, float, float, float, float, float, float, float, float]


@inlined
def seen_from(car: Car) -> Numbers:
    """Return the 12 observed numbers, clipped to their limits."""
    here = course_spot_at(car.along_m)
    heading = heading_of(car.yaw_rad)
    near_x, near_y = _ahead(car, heading, here, LOOKAHEADS_M[0])
    mid_x, mid_y = _ahead(car, heading, here, LOOKAHEADS_M[1])
    far_x, far_y = _ahead(car, heading, here, LOOKAHEADS_M[2])
    last_x, last_y = _ahead(car, heading, here, LOOKAHEADS_M[3])
    return (
        _within(car.offset_m * (1.0 / LANE_HALF_WIDTH_M), _LIMITS[0]),
        _within(car.heading_error_rad * (2.0 / math.pi), _LIMITS[1]),
        _within(car.speed_m_s * (1.0 / MAX_SPEED_M_S), _LIMITS[2]),
        _within(2.0 * car.steering, _LIMITS[3]),
        near_x,
        near_y,
        mid_x,
        mid_y,
        far_x,
        far_y,
        last_x,
        last_y,
    )


@inlined
def _ahead(car: Car, heading: Heading, here: CourseSpot, lookahead_m: float) -> tuple[float, float]:
    """Return a path point ahead as (forward, left) of the car, divided by `lookahead_m`."""
    x_m, y_m = course_point_ahead(here, lookahead_m)
    forward_m, left_m = in_body_frame(x_m - car.x_m, y_m - car.y_m, heading.cos, heading.sin)
    forward, left = forward_m * (1.0 / lookahead_m), left_m * (1.0 / lookahead_m)
    return _within(forward, _LIMITS[4]), _within(left, _LIMITS[4])


@inlined
def _within(number: float, limit: float) -> float:
    return min(max(number, -limit), limit)
