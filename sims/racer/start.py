"""Starting states of the racer sim."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled
from mcaprl.errors import UsageError
from mcaprl.sims.geometry.paths import leg_at, point_at
from mcaprl.sims.racer.car import STARTED_AT, Car, placed, store_car
from mcaprl.sims.racer.course import HALF_WIDTH_PX, IMAGE_HEIGHT_PX, METERS_PER_PX, Track
from mcaprl.sims.racer.rules import MAX_SPEED_M_S, STEP_S, observe, walls_hit
from mcaprl.sims.vehicle.arguments import pose_from
from mcaprl.sims.vehicle.draws import draw, spread

ANYWHERE, ON_LINE, EXACTLY = 4, 2, 0
"""Number of random numbers for each kind of start."""
SEARCH_M = 10.0
"""Search window for the nearest path point: maximum distance from the path point of the start."""


@compiled
def start_on_line(track: Track, shares: NDArray[np.float64]) -> Car:
    """Return a car at rest near the start line; two random numbers set its offset and heading."""
    x_px, y_px, heading_rad = track.start_px
    left_px, left_rad = spread(shares[0], 3.0), spread(shares[1], 0.05)
    x_px += left_px * math.sin(heading_rad)
    y_px -= left_px * math.cos(heading_rad)
    return placed(track, x_px, y_px, heading_rad - left_rad, 0.0, 0.0, SEARCH_M)


@compiled
def start_anywhere(track: Track, shares: NDArray[np.float64]) -> Car:
    """Return a car on the track; four random numbers set position, speed, offset and heading."""
    along_m, speed_px = track.path.length_m * shares[0], 6.0 * shares[1]
    left_px, left_rad = spread(shares[2], 12.0), spread(shares[3], 0.2)
    x_m, y_m = point_at(track.path, along_m)
    heading_rad = -track.path.yaw_rad[leg_at(track.path, along_m)]
    x_px = x_m / METERS_PER_PX + left_px * math.sin(heading_rad)
    y_px = IMAGE_HEIGHT_PX - y_m / METERS_PER_PX - left_px * math.cos(heading_rad)
    return placed(track, x_px, y_px, heading_rad - left_rad, speed_px, along_m, SEARCH_M)


@compiled
def start_cars(
    track: Track,
    classic: bool,
    kind: int,
    addresses: NDArray[np.intp],
    cars: NDArray[np.float64],
    observations: NDArray[np.float32],
    chosen: NDArray[np.int64],
) -> None:
    """Start some of N cars; write their states and observations.

    Args:
        track: Track of the cars.
        classic: Whether the classic rules apply.
        kind: ANYWHERE, ON_LINE or EXACTLY.
        addresses: Attribute of `Generators`.
        cars: (N, 13) output. A row contains the fields of a `Car`, then the distance along the path
            at which the car starts.
        observations: (N, 19) output.
        chosen: (K,) indices of the cars to start.
    """
    shares = np.empty(kind)
    for i in chosen:
        draw(addresses[i], shares)
        if kind == ANYWHERE:
            car = start_anywhere(track, shares)
        elif kind == ON_LINE:
            car = start_on_line(track, shares)
        else:
            car = placed(track, *track.start_px, 0.0, 0.0, SEARCH_M)
        store_car(car, cars[i])
        cars[i, STARTED_AT] = car.along_m
        observe(track, car, classic, observations[i])


def car_from(track: Track, options: dict[str, Any]) -> Car:
    """Return the starting state in the options of `reset`.

    Raises:
        UsageError: An option is unknown, or the pose is malformed or not on the track.
    """
    pose = pose_from(options, -MAX_SPEED_M_S, MAX_SPEED_M_S)
    x_px, y_px = pose.x_m / METERS_PER_PX, IMAGE_HEIGHT_PX - pose.y_m / METERS_PER_PX
    speed_px = pose.speed_m_s * STEP_S / METERS_PER_PX
    car = placed(track, x_px, y_px, -pose.yaw_rad, speed_px, 0.0)
    half_width_m = HALF_WIDTH_PX * METERS_PER_PX
    if abs(car.offset_m) > half_width_m or walls_hit(track, car):
        raise UsageError(
            f"pose ({pose.x_m}, {pose.y_m}) is {abs(car.offset_m):.1f} m from the middle of the"
            f" track: the whole car must be inside the walls at {half_width_m} m"
        )
    return car
