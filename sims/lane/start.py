"""Starting states of the lane sim."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import Arrays, array_at, compiled
from mcaprl.errors import UsageError
from mcaprl.sims.geometry.bicycle import moving
from mcaprl.sims.geometry.paths import project, wrap_angle
from mcaprl.sims.lane.block import observe_cars
from mcaprl.sims.lane.classic import CLASSIC_SUBSTEPS, STRAIGHT
from mcaprl.sims.lane.course import COURSE, LANE_HALF_WIDTH_M
from mcaprl.sims.lane.rules import (
    DRIVING,
    MAX_SPEED_M_S,
    OBSERVATION_NAMES,
    STARTED_AT,
    Car,
    drive,
    located,
    observe,
    store_car,
)
from mcaprl.sims.vehicle.arguments import pose_from
from mcaprl.sims.vehicle.draws import draw, spread

SHARES = 4
"""Number of random numbers for a start; a start on the line uses the first two."""
LINE_M = 2.0
"""Distance of the start line along the path."""
AFTER_CORNER_M, BEFORE_CORNER_M = 2.0, 8.0
"""Minimum distances of random starts after and before corners, so that cars can turn in time."""
FASTEST_START_M_S = 10.0

_CLEAR_M: NDArray[np.float64] = np.concatenate(
    [[0.0], np.cumsum(np.diff(COURSE.along_m) - AFTER_CORNER_M - BEFORE_CORNER_M)]
)
"""(legs + 1,) length of the path up to each corner, counting only parts where random starts are
allowed."""


@compiled
def start_on_line(shares: NDArray[np.float64]) -> Car:
    """Return a car at rest near the start line.

    Two random numbers from 0 to 1 set its offset (up to 0.3 m) and heading error (up to 0.05 rad).
    """
    return beside(0, LINE_M, spread(shares[0], 0.3), spread(shares[1], 0.05), 0.0)


@compiled
def start_anywhere(shares: NDArray[np.float64]) -> Car:
    """Return a car near the path; four random numbers set position, offset, heading and speed."""
    clear_m = shares[0] * _CLEAR_M[-1]
    leg = 0
    while _CLEAR_M[leg + 1] <= clear_m:
        leg += 1
    rest_m = AFTER_CORNER_M + clear_m - _CLEAR_M[leg]
    offset_m, error_rad = spread(shares[1], 1.5), spread(shares[2], 0.2)
    return beside(leg, rest_m, offset_m, error_rad, FASTEST_START_M_S * shares[3])


@compiled
def beside(leg: int, rest_m: float, offset_m: float, error_rad: float, speed_m_s: float) -> Car:
    """Return a car beside a point of the path, with an offset and a heading error, left positive.

    Args:
        leg: Index of the leg with the point, which must be the path point nearest to the car.
        rest_m: Distance of the point from the start of the leg.
        offset_m: Distance of the car from the point.
        error_rad: Yaw of the car relative to the leg.
        speed_m_s: Speed of the car.
    """
    along_m = COURSE.along_m[leg] + rest_m
    cos, sin = COURSE.forward[leg]
    x_m = COURSE.points_m[leg, 0] + rest_m * cos - offset_m * sin
    y_m = COURSE.points_m[leg, 1] + rest_m * sin + offset_m * cos
    yaw_rad, error_rad = wrap_angle(COURSE.yaw_rad[leg] + error_rad), wrap_angle(error_rad)
    return Car(x_m, y_m, yaw_rad, speed_m_s, 0.0, along_m, offset_m, error_rad, 0.0)


@compiled
def start_at_random(shares: NDArray[np.float64], on_line: bool, classic: bool) -> Car:
    """Return a car at the start of an episode.

    Args:
        shares: (4,) random numbers from 0 to 1.
        on_line: Whether to start on the start line instead of anywhere.
        classic: Whether a car on the start line first drives straight ahead for a second.
    """
    if not on_line:
        return start_anywhere(shares)
    car = start_on_line(shares)
    return drive(car, STRAIGHT, CLASSIC_SUBSTEPS) if classic else car


@compiled
def start_only_car(arrays: Arrays, on_line: bool, classic: bool) -> tuple[float, float, float]:
    """Start a single car like `start_cars`; also return the values for its `info`.

    Args:
        arrays: Attribute `addresses` of `Generators`, and the outputs: row (10,) of the car, reward
            (1,), end (1,) and observation (12,).
        on_line: Whether to start on the start line instead of anywhere.
        classic: Whether a car on the start line first drives straight ahead for a second.

    Returns:
        Offset, heading error and speed.
    """
    shares = np.empty(SHARES)
    draw(array_at(arrays, 0, (1,), np.intp)[0], shares)
    car = start_at_random(shares, on_line, classic)
    row = array_at(arrays, 1, (STARTED_AT + 1,), np.float64)
    store_car(car, row)
    row[STARTED_AT] = car.along_m
    array_at(arrays, 2, (1,), np.float64)[0] = 0.0
    array_at(arrays, 3, (1,), np.int64)[0] = DRIVING
    observe(car, array_at(arrays, 4, (len(OBSERVATION_NAMES),), np.float32))
    return car.offset_m, car.heading_error_rad, car.speed_m_s


@compiled
def start_cars(
    addresses: NDArray[np.intp],
    on_line: bool,
    classic: bool,
    cars: NDArray[np.float64],
    rewards: NDArray[np.float64],
    ends: NDArray[np.int64],
    observations: NDArray[np.float32],
    chosen: NDArray[np.int64],
) -> None:
    """Start some of N cars.

    Args:
        addresses: Attribute of `Generators`.
        on_line: Whether to start on the start line instead of anywhere.
        classic: Whether a car on the start line first drives straight ahead for a second.
        cars: (N, 10) output: the fields of `Car`, then its distance along the path at the start.
        rewards: (N,) output; set to 0 for the chosen cars.
        ends: (N,) output; set to DRIVING for the chosen cars.
        observations: (N, 12) output.
        chosen: (K,) indices of the cars to start.
    """
    shares = np.empty(SHARES)
    for i in chosen:
        draw(addresses[i], shares)
        car = start_at_random(shares, on_line, classic)
        store_car(car, cars[i])
        cars[i, STARTED_AT] = car.along_m
        rewards[i], ends[i] = 0.0, DRIVING
    observe_cars(cars, observations, chosen)


def car_from(options: dict[str, Any]) -> Car:
    """Return the starting state in the options of `reset`.

    Raises:
        UsageError: An option is unknown, or the pose is malformed or not on the lane.
    """
    pose = pose_from(options, 0.0, MAX_SPEED_M_S)
    place = project(COURSE, pose.x_m, pose.y_m, 0.0, COURSE.length_m)
    if abs(place.offset_m) > LANE_HALF_WIDTH_M:
        raise UsageError(
            f"pose ({pose.x_m}, {pose.y_m}) is {abs(place.offset_m):.1f} m from the path:"
            f" the lane's edge is at {LANE_HALF_WIDTH_M} m"
        )
    return located(moving(*pose), 0.0, place.along_m, 0.0)
