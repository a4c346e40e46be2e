"""Obstacles of the lane sim: collisions, and the observation of distances along rays."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled
from mcaprl.sims.geometry import FAR_M, in_body_frame, log_code, point_at, ray_name
from mcaprl.sims.lane.course import COURSE, SECOND_SQUARE_M, Box, barriers, buildings, rails
from mcaprl.sims.lane.rules import MAX_SPEED_M_S, Car, car_at

BODY_LENGTH_M, BODY_WIDTH_M = 4.3, 1.75
BODY_FORWARD_M = 0.05  # Distance of the body's center ahead of the middle of the wheelbase

_FAR_AWAY = Box(1e9, 1e9, 0.0, 0.0, 0.0)


def _boxes_m(*barriers: Box) -> list[tuple[float, ...]]:
    boxes = (*rails(), *buildings(), *barriers)
    return [(box.x_m, box.y_m, box.length_m / 2, box.width_m / 2) for box in boxes]


NO_BARRIERS = 0
WORLDS_M: NDArray[np.float64] = np.array(
    [_boxes_m(_FAR_AWAY, _FAR_AWAY), *(_boxes_m(*closed) for closed in barriers())]
)
"""(3, K, 4) three sets of K obstacles: x and y of the center, and half of the size along x and y.
Set 0 has no barriers. The course consists of two squares; set 1 has the barriers for a car on the
first square, and set 2 those for a car on the second square."""
_LENGTH_M = COURSE.length_m
_HUGE = 1e12  # Finite replacement for 1 / 0


@compiled
def world_at(along_m: float) -> int:
    """Return the index in `WORLDS_M` for a car at this distance along the path."""
    return 1 if along_m % _LENGTH_M < SECOND_SQUARE_M else 2


@compiled
def touches(car: Car) -> bool:
    """Return whether the car's body touches a rail or a house, by the separating axis theorem."""
    cos, sin = math.cos(car.yaw_rad), math.sin(car.yaw_rad)
    x_m, y_m = car.x_m + BODY_FORWARD_M * cos, car.y_m + BODY_FORWARD_M * sin
    ahead_m, aside_m = 0.5 * BODY_LENGTH_M, 0.5 * BODY_WIDTH_M
    cos_size, sin_size = abs(cos), abs(sin)
    boxes = WORLDS_M[NO_BARRIERS]
    for i in range(len(boxes)):
        box = boxes[i]
        dx, dy = box[0] - x_m, box[1] - y_m
        if (
            abs(dx) <= box[2] + ahead_m * cos_size + aside_m * sin_size
            and abs(dy) <= box[3] + ahead_m * sin_size + aside_m * cos_size
            and abs(dx * cos + dy * sin) <= ahead_m + box[2] * cos_size + box[3] * sin_size
            and abs(dy * cos - dx * sin) <= aside_m + box[2] * sin_size + box[3] * cos_size
        ):
            return True
    return False


@compiled
def ray_length(x_m: float, y_m: float, angle_rad: float, world: int = NO_BARRIERS) -> float:
    """Return the distance to the nearest obstacle in a direction, by slabs, at most 100 m."""
    boxes = WORLDS_M[world]
    per_x, per_y = _per_meter(math.cos(angle_rad)), _per_meter(math.sin(angle_rad))
    nearest_m = FAR_M
    for i in range(len(boxes)):
        box = boxes[i]
        to_x, half_x = (box[0] - x_m) * per_x, box[2] * abs(per_x)
        to_y, half_y = (box[1] - y_m) * per_y, box[3] * abs(per_y)
        enter_m = max(to_x - half_x, to_y - half_y, 0.0)
        if enter_m < nearest_m and enter_m <= min(to_x + half_x, to_y + half_y):
            nearest_m = enter_m
    return nearest_m


@compiled
def _per_meter(share: float) -> float:
    """Return 1 / share, with the absolute value limited to `_HUGE`."""
    return 1.0 / share if abs(share) * _HUGE > 1.0 else math.copysign(_HUGE, share)


RAYS_DEG = (0, 10, -10, 20, -20, 30, -30, 45, -45, 60, -60, 90, -90, 135, -135, 180)
"""Directions of the rays from the car's center; left is positive."""
RAYS_RAD = tuple(math.radians(angle) for angle in RAYS_DEG)
RAYS = len(RAYS_DEG)
WAY_M = 20.0
"""Distance of the observed path point, which indicates the street to take at a crossing."""
WAY_LIMIT = 4.0
RAY_OBSERVATION_NAMES = (
    *(ray_name(angle) for angle in RAYS_DEG),
    "speed",
    "steering",
    "way_20m_forward",
    "way_20m_left",
)
RAY_OBSERVATION_LIMIT = np.array([1] * (RAYS + 2) + [WAY_LIMIT] * 2, dtype=np.float32)


@compiled
def observe_rays(car: Car, observation: NDArray[np.float32], has_barriers: bool) -> None:
    """Write the 20 observed numbers, as listed in "Observation Space" of `LaneKeepingEnv`."""
    world = world_at(car.along_m) if has_barriers else NO_BARRIERS
    for i in range(RAYS):
        length_m = ray_length(car.x_m, car.y_m, car.yaw_rad + RAYS_RAD[i], world)
        observation[i] = log_code(length_m)
    observation[RAYS] = car.speed_m_s / MAX_SPEED_M_S
    observation[RAYS + 1] = 2.0 * car.steering
    x_m, y_m = point_at(COURSE, car.along_m + WAY_M)
    cos, sin = math.cos(car.yaw_rad), math.sin(car.yaw_rad)
    way_m = in_body_frame(x_m - car.x_m, y_m - car.y_m, cos, sin)
    for i in range(2):
        observation[RAYS + 2 + i] = min(max(way_m[i] / WAY_M, -WAY_LIMIT), WAY_LIMIT)


@compiled
def observe_all_rays(
    cars: NDArray[np.float64], observations: NDArray[np.float32], has_barriers: bool
) -> None:
    """Write observations (N, 20). Each row of `cars` (N, 10) begins with the values of a `Car`."""
    for i in range(len(cars)):
        observe_rays(car_at(cars[i]), observations[i], has_barriers)


def ray_lines(car: Car, has_barriers: bool) -> NDArray[np.float64]:
    """Return the rays as segments (16, 2, 2) from the car's center to their ends, meters."""
    world = world_at(car.along_m) if has_barriers else NO_BARRIERS
    lines = np.empty((RAYS, 2, 2))
    lines[:, 0] = car.x_m, car.y_m
    for line, turn_rad in zip(lines, RAYS_RAD, strict=True):
        angle_rad = car.yaw_rad + turn_rad
        length_m = ray_length(car.x_m, car.y_m, angle_rad, world)
        line[1] = line[0] + length_m * np.array([math.cos(angle_rad), math.sin(angle_rad)])
    return lines
