"""The equations of the racer sim: one step of a car between walls, for one car or many.

Pixels and angles are those of the picture: y points down, so angles grow clockwise.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.geometry.compiled import compiled
from mcaprl.sims.geometry.paths import project, wrap_angle
from mcaprl.sims.geometry.ray_code import log_code
from mcaprl.sims.racer.car import (
    CAR_LENGTH_PX,
    CAR_WIDTH_PX,
    Racer,
    corner_at,
    racer_at,
    store_racer,
)
from mcaprl.sims.racer.rays import (
    RAY_NAMES,
    RAYS,
    classic_code,
    crossing,
    floored_distance,
    measure,
)
from mcaprl.sims.racer.track import METRES_PER_PX, PICTURE_HEIGHT_PX, Track

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
THROTTLE = (0, 1, 0, 0, -1, -1, -1, 1, 1)
TURN = (0, 0, -1, 1, 0, 1, -1, -1, 1)
"""Right is positive."""

STEP_S = 0.1
TURN_RAD = math.radians(15.0)
SPEED_CHANGE_PX = 2.0
MAX_SPEED_PX = 10.0
MAX_SPEED_M_S = MAX_SPEED_PX * METRES_PER_PX / STEP_S
DRIFT_RAD = math.radians(10.0)
"""A drifting car's course turns by at most this at its top speed, and more when it is slower."""

BEHIND_M, AHEAD_M = 4.0, 8.0
"""How far behind and ahead of the last nearest path point the next one is looked for."""

CORNER_PX_2 = 0.25 * (CAR_LENGTH_PX**2 + CAR_WIDTH_PX**2)
"""Square of a corner's distance from the car's centre."""
LOOK_PX, NEAR_GATE_PX = 50.0, 20.0
"""Classic: a gate is passed when the car looks at it, so far at most, from nearer than this."""
MAX_IDLE_STEPS = 100
MAX_STEPS = 1_000
MAX_STEPS_CLASSIC = 10_000
DRIVING, CRASH, NO_GATE, TIME_LIMIT = 0, 1, 2, 3
REASONS = ("", "crash", "no_gate", "time_limit")
TRUNCATES = (False, False, True, True)


OBSERVATION_NAMES = (*RAY_NAMES, "speed")


@compiled
def walls_hit(track: Track, car: Racer) -> int:
    """Count the walls that cut an edge of the car."""
    count = 0
    corners = (
        corner_at(car, 1.0, -1.0),
        corner_at(car, 1.0, 1.0),
        corner_at(car, -1.0, 1.0),
        corner_at(car, -1.0, -1.0),
    )
    for wall in track.walls_px:
        along_x, along_y = wall[2] - wall[0], wall[3] - wall[1]
        away = (wall[0] - car.x_px) * along_y - (wall[1] - car.y_px) * along_x
        if away * away > CORNER_PX_2 * (along_x * along_x + along_y * along_y):
            # The whole line of the wall is farther than any corner.
            continue
        for i in range(4):
            (x, y), (end_x, end_y) = corners[i], corners[(i + 1) % 4]
            share, along_wall = crossing(x, y, end_x - x, end_y - y, wall)
            if 0.0 < share < 1.0 and 0.0 < along_wall < 1.0:
                count += 1
                break
    return count


@compiled
def drive(track: Track, car: Racer, action: int, classic: bool, drift: bool) -> Racer:
    """Carry out one action, and take note of a gate passed.

    In the classic rules forward is against the rays' own forward, and back along it.
    """
    throttle = -THROTTLE[action] if classic else THROTTLE[action]
    speed_px = min(max(car.speed_px + SPEED_CHANGE_PX * throttle, -MAX_SPEED_PX), MAX_SPEED_PX)
    heading_rad = wrap_angle(car.heading_rad + TURN_RAD * TURN[action])
    course_rad = heading_rad
    if drift:
        limit_rad = DRIFT_RAD * MAX_SPEED_PX / (abs(car.speed_px) + 1.0)
        turn_rad = wrap_angle(heading_rad - car.course_rad)
        course_rad = wrap_angle(car.course_rad + min(max(turn_rad, -limit_rad), limit_rad))
    x_px = car.x_px + speed_px * math.cos(course_rad)
    y_px = car.y_px + speed_px * math.sin(course_rad)
    x_m, y_m = METRES_PER_PX * x_px, METRES_PER_PX * (PICTURE_HEIGHT_PX - y_px)
    place = project(track.path, x_m, y_m, car.along_m - BEHIND_M, car.along_m + AHEAD_M)
    moved = Racer(
        x_px,
        y_px,
        heading_rad,
        course_rad,
        speed_px,
        car.next_gate,
        car.gates,
        car.idle_steps + 1.0,
        car.steps + 1.0,
        place.along_m,
        place.offset_m,
        wrap_angle(-heading_rad - place.yaw_rad),
    )
    return _with_gate(track, car, moved, classic)


@compiled
def _with_gate(track: Track, before: Racer, after: Racer, classic: bool) -> Racer:
    """Count the next gate, if the step has passed it."""
    gate = track.gates_px[int(after.next_gate)]
    passed = sees_gate(after, gate) if classic else crosses_gate(before, after, gate)
    if not passed:
        return after
    return Racer(
        after.x_px,
        after.y_px,
        after.heading_rad,
        after.course_rad,
        after.speed_px,
        (after.next_gate + 1.0) % len(track.gates_px),
        after.gates + 1.0,
        0.0,
        after.steps,
        after.along_m,
        after.offset_m,
        after.heading_error_rad,
    )


@compiled
def crosses_gate(before: Racer, after: Racer, gate: NDArray[np.float64]) -> bool:
    """Say whether the car's centre moved over a gate (4,)."""
    dx, dy = after.x_px - before.x_px, after.y_px - before.y_px
    share, along_gate = crossing(before.x_px, before.y_px, dx, dy, gate)
    return 0.0 < share <= 1.0 and 0.0 <= along_gate <= 1.0


@compiled
def sees_gate(car: Racer, gate: NDArray[np.float64]) -> bool:
    """Say whether the classic rules call a gate (4,) passed: it is ahead, and within 20 pixels."""
    dx, dy = LOOK_PX * math.cos(car.course_rad), LOOK_PX * math.sin(car.course_rad)
    share, along_gate = crossing(car.x_px, car.y_px, dx, dy, gate)
    if not (0.0 < share < 1.0 and 0.0 < along_gate < 1.0):
        return False
    return floored_distance(car, gate, along_gate) < NEAR_GATE_PX


@compiled
def judge(track: Track, before: Racer, after: Racer, classic: bool) -> tuple[float, int]:
    """Give a step's reward, and how the episode ends: DRIVING, CRASH, NO_GATE or TIME_LIMIT.

    +1 for a gate, -1 for a crash; in the classic rules -1 for each wall that is hit.
    """
    hits = walls_hit(track, after)
    reward = after.gates - before.gates
    if hits > 0:
        return reward - (hits if classic else 1), CRASH
    if after.idle_steps >= MAX_IDLE_STEPS:
        return reward, NO_GATE
    if after.steps >= (MAX_STEPS_CLASSIC if classic else MAX_STEPS):
        return reward, TIME_LIMIT
    return reward, DRIVING


@compiled
def observe(track: Track, car: Racer, classic: bool, observation: NDArray[np.float32]) -> None:
    """Write the 19 observed numbers; see the table of `RacerEnv`."""
    lengths_px = np.empty(RAYS)
    measure(track.walls_px, car, classic, lengths_px)
    for i in range(RAYS):
        length_px = lengths_px[i]
        code = classic_code(length_px) if classic else log_code(METRES_PER_PX * length_px)
        observation[i] = code
    observation[RAYS] = (-car.speed_px if classic else car.speed_px) / MAX_SPEED_PX


@compiled
def step_racers(
    track: Track,
    cars: NDArray[np.float64],
    actions: NDArray[np.int64],
    rewards: NDArray[np.float64],
    ends: NDArray[np.int64],
    observations: NDArray[np.float32],
    classic: bool,
    drift: bool,
) -> None:
    """Advance N cars by one step each, in place; they do not meet each other.

    Args:
        track: that all drive on.
        cars: (N, 13) rows that begin with `Racer`.
        actions: (N,) 0 to 8.
        rewards: (N,) to be filled.
        ends: (N,) to be filled with DRIVING, CRASH, NO_GATE or TIME_LIMIT.
        observations: (N, 19) to be filled.
        classic: play by the classic rules.
        drift: let the course lag behind the heading.
    """
    for i in range(len(cars)):
        before = racer_at(cars[i])
        after = drive(track, before, actions[i], classic, drift)
        rewards[i], ends[i] = judge(track, before, after, classic)
        observe(track, after, classic, observations[i])
        store_racer(after, cars[i])


Told = tuple[float, int, float, float, float, float, int]


@compiled
def step_only_racer(
    track: Track,
    cars: NDArray[np.float64],
    actions: NDArray[np.int64],
    rewards: NDArray[np.float64],
    ends: NDArray[np.int64],
    observations: NDArray[np.float32],
    classic: bool,
    drift: bool,
    action: int,
) -> Told:
    """Do as `step_racers` with a single car, and give back all that is told of it.

    Returns:
        Reward, end, offset, heading error, speed, progress, and gates passed.
    """
    actions[0] = action
    step_racers(track, cars, actions, rewards, ends, observations, classic, drift)
    car = racer_at(cars[0])
    told = (car.offset_m, car.heading_error_rad, speed_of(car), car.along_m - cars[0, -1])
    return rewards[0], ends[0], *told, int(car.gates)


@compiled
def tell_racers(cars: NDArray[np.float64], told: NDArray[np.float64]) -> None:
    """Put together what is told of N cars.

    Args:
        cars: (N, 13) rows that begin with `Racer`, and end with where the car started.
        told: (5, N) to be filled with offsets, heading errors, speeds, progress and gates.
    """
    for i in range(len(cars)):
        car = racer_at(cars[i])
        told[0, i], told[1, i], told[2, i] = car.offset_m, car.heading_error_rad, speed_of(car)
        told[3, i], told[4, i] = car.along_m - cars[i, -1], car.gates


@compiled
def speed_of(car: Racer) -> float:
    """Give a car's speed, m/s; negative backwards."""
    return car.speed_px * METRES_PER_PX / STEP_S
