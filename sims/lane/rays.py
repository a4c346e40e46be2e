"""Ray observation of the lane sim: distances to obstacles, and a path point ahead."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled
from mcaprl.sims.geometry.paths import in_body_frame, point_at
from mcaprl.sims.geometry.ray_code import log_code, ray_name
from mcaprl.sims.lane.course import COURSE
from mcaprl.sims.lane.obstacles import NO_BARRIERS, ray_length, world_at
from mcaprl.sims.lane.rules import MAX_SPEED_M_S, Car, car_at

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
