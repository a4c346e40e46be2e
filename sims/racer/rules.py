"""Default and classic rules of the racer sim: motion, rewards, episode ends and observations.

Coordinates are those of the image: y points down, so angles are clockwise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled, inlined
from mcaprl.sims.geometry import log_code, project, wrap_angle
from mcaprl.sims.racer.course import (
    CAR_LENGTH_PX,
    CAR_WIDTH_PX,
    IMAGE_HEIGHT_PX,
    METERS_PER_PX,
    Car,
    Track,
    car_at,
    corner_at,
    store_car,
)
from mcaprl.sims.racer.rays import (
    BLOCK_SIZE,
    LENGTH,
    RAY_NAMES,
    RAYS,
    classic_code,
    crossing,
    floored_distance,
    measure,
)

ACTION_MEANINGS = (
    "none",
    "forward",
    "left",
    "right",
    "back",
    "back right",
    "back left",
    "forward left",
    "forward right",
)


class Command(NamedTuple):
    """Command of a step."""

    acceleration: float
    """Change of speed, in units of 2 pixels per step."""
    turn: float
    """Turn, in units of 15 degrees, left positive."""


ACTION_COMMANDS = (
    Command(0.0, 0.0),
    Command(1.0, 0.0),
    Command(0.0, 1.0),
    Command(0.0, -1.0),
    Command(-1.0, 0.0),
    Command(-1.0, -1.0),
    Command(-1.0, 1.0),
    Command(1.0, 1.0),
    Command(1.0, -1.0),
)
COMMAND_UNITS = ("2 px/step backward | 2 px/step forward", "15 degrees right | 15 degrees left")

STEP_S = 0.1
TURN_RAD = math.radians(15.0)
SPEED_CHANGE_PX = 2.0
MAX_SPEED_PX = 10.0
MAX_SPEED_M_S = MAX_SPEED_PX * METERS_PER_PX / STEP_S
DRIFT_RAD = math.radians(10.0)
"""Approximate maximum turn per step of a drifting car's direction of travel at top speed. At lower
speeds, the maximum is larger."""

BACK_M, AHEAD_M = 4.0, 8.0
"""Search window for the nearest path point: distances before and after the last nearest point."""

CORNER_PX_2 = 0.25 * (CAR_LENGTH_PX**2 + CAR_WIDTH_PX**2)
"""Squared distance of a corner from the car's center."""
LOOK_PX, NEAR_GATE_PX = 50.0, 20.0
"""Classic rules: length of the ray that must hit a gate, and maximum distance of the hit."""
MAX_IDLE_STEPS = 100
MAX_STEPS = 1_000
MAX_STEPS_CLASSIC = 10_000
DRIVING, CRASH, NO_GATE, TIME_LIMIT = 0, 1, 2, 3
REASONS = ("", "crash", "no_gate", "time_limit")
TRUNCATES = (False, False, True, True)


OBSERVATION_NAMES = (*RAY_NAMES, "speed")


@compiled
def walls_hit(track: Track, car: Car) -> int:
    """Return the number of walls that intersect an edge of the car."""
    # This loop has no branches, so that the compiler can vectorize it. Most cars end here.
    near = 0
    for wall in range(len(track.walls_px)):
        near += 1 if is_near(track.walls_px[wall], car) else 0
    return edges_hit(track, car) if near > 0 else 0


@compiled
def edges_hit(track: Track, car: Car) -> int:
    """Return the same as `walls_hit`, without looking first whether any wall is near."""
    count = 0
    front = corner_at(car, 1.0, -1.0), corner_at(car, 1.0, 1.0)
    corners = (*front, corner_at(car, -1.0, 1.0), corner_at(car, -1.0, -1.0))
    for wall in track.walls_px:
        if not is_near(wall, car):
            continue
        for i in range(4):
            (x, y), (end_x, end_y) = corners[i], corners[(i + 1) % 4]
            share, along_wall = crossing(x, y, end_x - x, end_y - y, wall)
            if 0.0 < share < 1.0 and 0.0 < along_wall < 1.0:
                count += 1
                break
    return count


@inlined
def is_near(wall: NDArray[np.float64], car: Car) -> bool:
    """Return whether a wall (4,) may touch a car, by its distance from the car's center."""
    along_x, along_y = wall[2] - wall[0], wall[3] - wall[1]
    x, y = car.x_px - wall[0], car.y_px - wall[1]
    square = along_x * along_x + along_y * along_y
    away, along = x * along_y - y * along_x, x * along_x + y * along_y
    beyond = max(max(along - square, -along), 0.0)
    reach = CORNER_PX_2 * square
    return bool((away * away <= reach) & (beyond * beyond <= reach))


@compiled
def drive(track: Track, car: Car, command: Command, classic: bool, drift: bool) -> Car:
    """Return the car after one command, with passed gates; classic rules swap forward and back."""
    # A subtraction from 0 returns 0 for 0, but a negation returns -0.
    throttle = 0.0 - command.acceleration if classic else command.acceleration
    speed_px = min(max(car.speed_px + SPEED_CHANGE_PX * throttle, -MAX_SPEED_PX), MAX_SPEED_PX)
    heading_rad = wrap_angle(car.heading_rad + (0.0 - TURN_RAD * command.turn))
    course_rad = heading_rad
    if drift:
        limit_rad = DRIFT_RAD * MAX_SPEED_PX / (abs(car.speed_px) + 1.0)
        turn_rad = wrap_angle(heading_rad - car.course_rad)
        course_rad = wrap_angle(car.course_rad + min(max(turn_rad, -limit_rad), limit_rad))
    x_px = car.x_px + speed_px * math.cos(course_rad)
    y_px = car.y_px + speed_px * math.sin(course_rad)
    x_m, y_m = METERS_PER_PX * x_px, METERS_PER_PX * (IMAGE_HEIGHT_PX - y_px)
    place = project(track.path, x_m, y_m, car.along_m - BACK_M, car.along_m + AHEAD_M)
    motion = (x_px, y_px, heading_rad, course_rad, speed_px)
    counts = (car.next_gate, car.gates, car.idle_steps + 1.0, car.steps + 1.0)
    error_rad = wrap_angle(-heading_rad - place.yaw_rad)
    moved = Car(*motion, *counts, place.along_m, place.offset_m, error_rad)
    gate = track.gates_px[int(car.next_gate)]
    passed = sees_gate(moved, gate) if classic else crosses_gate(car, moved, gate)
    if not passed:
        return moved
    next_gate = (car.next_gate + 1.0) % len(track.gates_px)
    return Car(*moved[:5], next_gate, car.gates + 1.0, 0.0, *moved[8:])


@compiled
def crosses_gate(before: Car, after: Car, gate: NDArray[np.float64]) -> bool:
    """Return whether the car's center crossed a gate (4,) in a step."""
    dx, dy = after.x_px - before.x_px, after.y_px - before.y_px
    share, along_gate = crossing(before.x_px, before.y_px, dx, dy, gate)
    return 0.0 < share <= 1.0 and 0.0 <= along_gate <= 1.0


@compiled
def sees_gate(car: Car, gate: NDArray[np.float64]) -> bool:
    """Return whether a gate (4,) is less than 20 pixels ahead, which passes it in classic rules."""
    dx, dy = LOOK_PX * math.cos(car.course_rad), LOOK_PX * math.sin(car.course_rad)
    share, along_gate = crossing(car.x_px, car.y_px, dx, dy, gate)
    if not (0.0 < share < 1.0 and 0.0 < along_gate < 1.0):
        return False
    return floored_distance(car, gate, along_gate) < NEAR_GATE_PX


@compiled
def outcome_of(track: Track, before: Car, after: Car, classic: bool) -> tuple[float, int]:
    """Return a step's reward (1 for a gate, -1 for a crash, if classic per wall), and its end."""
    return outcome_with(walls_hit(track, after), before, after, classic)


@inlined
def outcome_with(hits: int, before: Car, after: Car, classic: bool) -> tuple[float, int]:
    """Return the same as `outcome_of`, from the number of walls that the car hits."""
    reward = after.gates - before.gates
    if hits > 0:
        return reward - (hits if classic else 1), CRASH
    if after.idle_steps >= MAX_IDLE_STEPS:
        return reward, NO_GATE
    if after.steps >= (MAX_STEPS_CLASSIC if classic else MAX_STEPS):
        return reward, TIME_LIMIT
    return reward, DRIVING


@compiled
def observe(track: Track, car: Car, classic: bool, observation: NDArray[np.float32]) -> None:
    """Write the 19 observed numbers; see "Observation Space" of `RacerEnv`."""
    observe_with(track, car, classic, np.empty(BLOCK_SIZE), observation)


@compiled
def observe_with(
    track: Track,
    car: Car,
    classic: bool,
    block: NDArray[np.float64],
    observation: NDArray[np.float32],
) -> None:
    """Write the observed numbers like `observe`, and the car's rays and lengths into a block."""
    measure(track.walls_px, car, classic, block)
    if classic:
        for ray in range(RAYS):
            block[LENGTH + ray] = classic_code(block[LENGTH + ray])
    else:
        # This also encodes the slots beyond the last ray, so that the vectorized loop has no
        # remainder. A constant number of turns would be unrolled instead.
        for slot in range(LENGTH, len(block)):
            block[slot] = log_code(METERS_PER_PX * block[slot])
    for ray in range(RAYS):
        observation[ray] = block[LENGTH + ray]
    observation[RAYS] = (-car.speed_px if classic else car.speed_px) / MAX_SPEED_PX


@inlined
def advance(
    track: Track, row: NDArray[np.float64], command: Command, classic: bool, drift: bool
) -> tuple[Car, float, int]:
    """Advance the car in a row of `block.step_cars`; return the car, its reward and its end."""
    before = car_at(row)
    after = drive(track, before, command, classic, drift)
    store_car(after, row)
    reward, end = outcome_of(track, before, after, classic)
    return after, reward, end


@compiled
def speed_of(car: Car) -> float:
    """Return a car's speed in m/s. It is negative when the car drives backward."""
    return car.speed_px * METERS_PER_PX / STEP_S
