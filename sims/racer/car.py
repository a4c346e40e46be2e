"""Car of the racer sim: its state, its corners, and its placement on a track.

Coordinates are those of the image: y points down, so angles are clockwise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled
from mcaprl.sims.geometry.paths import project, wrap_angle
from mcaprl.sims.racer.course import IMAGE_HEIGHT_PX, METERS_PER_PX, Track

CAR_LENGTH_PX, CAR_WIDTH_PX = 30.0, 14.0


class Car(NamedTuple):
    """State of one car: the first 12 values of its row in an (N, 13) array of cars."""

    x_px: float
    y_px: float
    heading_rad: float
    """Heading clockwise from the image's x, in [-pi, pi)."""
    course_rad: float
    """Direction of travel; equals the heading unless the car drifts."""
    speed_px: float
    """Speed in the direction `course_rad`, pixels per step; negative when reversing."""
    next_gate: float
    gates: float
    """Number of gates passed since the start."""
    idle_steps: float
    """Number of steps since the last gate."""
    steps: float
    """Number of steps since the start."""
    along_m: float
    """Distance along the path to the point nearest to the car, summed over all laps."""
    offset_m: float
    """Distance from the path, left positive."""
    heading_error_rad: float
    """Heading relative to the path's direction, counter-clockwise, in [-pi, pi)."""


STARTED_AT = len(Car._fields)
"""Index of the last value in a car's row: the distance along the path at the episode's start."""


@compiled
def car_at(row: NDArray[np.float64]) -> Car:
    """Read a car from a row of 12 floats."""
    motion, counts = (row[0], row[1], row[2], row[3], row[4]), (row[5], row[6], row[7], row[8])
    return Car(*motion, *counts, row[9], row[10], row[11])


@compiled
def store_car(car: Car, row: NDArray[np.float64]) -> None:
    """Write a car into a row of 12 floats."""
    for i, value in enumerate(car):
        row[i] = value


@compiled
def placed(
    track: Track,
    x_px: float,
    y_px: float,
    heading_rad: float,
    speed_px: float,
    near_m: float,
    within_m: float = math.inf,
) -> Car:
    """Return a car on a track before its first step. Its next gate is the nearest gate ahead.

    The function searches for the car's position along the path within a distance of `near_m`, at
    most half a lap.
    """
    reach_m = min(within_m, 0.5 * track.path.length_m)
    x_m, y_m = METERS_PER_PX * x_px, METERS_PER_PX * (IMAGE_HEIGHT_PX - y_px)
    place = project(track.path, x_m, y_m, near_m - reach_m, near_m + reach_m)
    along_m, count = place.along_m % track.path.length_m, len(track.gates_px)
    gate = int(along_m / track.path.length_m * count) % count
    if is_beyond(x_px, y_px, track.gates_px[gate]):
        gate = (gate + 1) % count
    error_rad = wrap_angle(-heading_rad - place.yaw_rad)
    heading_rad = wrap_angle(heading_rad)
    motion, counts = (x_px, y_px, heading_rad, heading_rad, speed_px), (float(gate), 0.0, 0.0, 0.0)
    return Car(*motion, *counts, along_m, place.offset_m, error_rad)


@compiled
def is_beyond(x_px: float, y_px: float, gate: NDArray[np.float64]) -> bool:
    """Return whether a point is past the line through a gate (4,), in the direction of travel."""
    across_x, across_y = gate[2] - gate[0], gate[3] - gate[1]
    return bool(across_x * (y_px - gate[1]) - across_y * (x_px - gate[0]) < 0.0)


@compiled
def corner_at(car: Car, forward: float, right: float) -> tuple[float, float]:
    """Return a corner of the car.

    `forward` is 1 (front) or -1 (rear); `right` is 1 (right) or -1 (left).
    """
    cos, sin = math.cos(car.heading_rad), math.sin(car.heading_rad)
    ahead, aside = 0.5 * CAR_LENGTH_PX * forward, 0.5 * CAR_WIDTH_PX * right
    return car.x_px + ahead * cos - aside * sin, car.y_px + ahead * sin + aside * cos
