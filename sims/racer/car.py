"""One car of the racer sim: its state, its corners, and how it is put on a track.

Pixels and angles are those of the picture: y points down, so angles grow clockwise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.geometry.compiled import compiled
from mcaprl.sims.geometry.paths import project, wrap_angle
from mcaprl.sims.racer.track import METRES_PER_PX, PICTURE_HEIGHT_PX, Track

CAR_LENGTH_PX, CAR_WIDTH_PX = 30.0, 14.0


class Racer(NamedTuple):
    """The whole state of one car; a row of a (cars, 12) array holds the same."""

    x_px: float
    y_px: float
    heading_rad: float
    """Clockwise from the picture's x, in [-pi, pi)."""
    course_rad: float
    """Direction of travel; the heading, unless the car drifts."""
    speed_px: float
    """Along the course, pixels a step; negative backwards."""
    next_gate: float
    gates: float
    """How many were passed since the start."""
    idle_steps: float
    """Steps since the last gate."""
    steps: float
    """Since the start."""
    along_m: float
    """Distance of the nearest path point along the path; grows beyond one lap."""
    offset_m: float
    """Distance from the path, left positive."""
    heading_error_rad: float
    """Of the heading from the path's direction, counter-clockwise, in [-pi, pi)."""


STARTED_AT = len(Racer._fields)
"""Where a row has, behind all that, how far along the path the car was at its start."""


@compiled
def racer_at(row: NDArray[np.float64]) -> Racer:
    """Read a car from a row of 12 floats."""
    return Racer(
        row[0],
        row[1],
        row[2],
        row[3],
        row[4],
        row[5],
        row[6],
        row[7],
        row[8],
        row[9],
        row[10],
        row[11],
    )


@compiled
def store_racer(car: Racer, row: NDArray[np.float64]) -> None:
    """Write a car into a row of 12 floats."""
    for i, value in enumerate(car):
        row[i] = value


@compiled
def placed(
    track: Track, x_px: float, y_px: float, heading_rad: float, speed_px: float, near_m: float
) -> Racer:
    """Put a car on a track at rest in time: no steps taken, its next gate the first one ahead.

    Its place on the path is looked for within half a lap of `near_m`.
    """
    half_lap_m = 0.5 * track.path.length_m
    x_m, y_m = METRES_PER_PX * x_px, METRES_PER_PX * (PICTURE_HEIGHT_PX - y_px)
    place = project(track.path, x_m, y_m, near_m - half_lap_m, near_m + half_lap_m)
    along_m, count = place.along_m % track.path.length_m, len(track.gates_px)
    gate = int(along_m / track.path.length_m * count) % count
    if is_beyond(x_px, y_px, track.gates_px[gate]):
        gate = (gate + 1) % count
    error_rad = wrap_angle(-heading_rad - place.yaw_rad)
    heading_rad = wrap_angle(heading_rad)
    return Racer(
        x_px,
        y_px,
        heading_rad,
        heading_rad,
        speed_px,
        float(gate),
        0.0,
        0.0,
        0.0,
        along_m,
        place.offset_m,
        error_rad,
    )


@compiled
def is_beyond(x_px: float, y_px: float, gate: NDArray[np.float64]) -> bool:
    """Say whether a point is ahead of the line through a gate (4,), in the direction of travel."""
    across_x, across_y = gate[2] - gate[0], gate[3] - gate[1]
    return bool(across_x * (y_px - gate[1]) - across_y * (x_px - gate[0]) < 0.0)


@compiled
def corner_at(car: Racer, forward: float, right: float) -> tuple[float, float]:
    """Give a corner of the car: `forward` 1 is the front, `right` 1 the right side; -1 others."""
    cos, sin = math.cos(car.heading_rad), math.sin(car.heading_rad)
    ahead, aside = 0.5 * CAR_LENGTH_PX * forward, 0.5 * CAR_WIDTH_PX * right
    return car.x_px + ahead * cos - aside * sin, car.y_px + ahead * sin + aside * cos
