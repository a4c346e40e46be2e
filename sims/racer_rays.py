"""What a car of the racer sim sees: the lengths of 18 rays to the walls."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.compiled import compiled
from mcaprl.sims.racer_car import Racer, corner_at
from mcaprl.sims.racer_track import METRES_PER_PX
from mcaprl.sims.ray_code import FAR_M

FAR_PX = FAR_M / METRES_PER_PX
JOINT = 1e-9
"""Walls are longer by this share at both ends, so that no ray slips through between two."""
CENTRE_RAYS_DEG = (0, -30, 30, 45, -45, 90, -90, 180, 10, -10, 135, -135, 20, -20)
"""Directions of the rays from the car's centre; right is positive."""
CENTRE_RAYS_RAD = tuple(math.radians(angle) for angle in CENTRE_RAYS_DEG)
CENTRE_RAYS = len(CENTRE_RAYS_DEG)
RAYS = CENTRE_RAYS + 4
RAY_NAMES = (
    "ahead",
    "left_30",
    "right_30",
    "right_45",
    "left_45",
    "right_90",
    "left_90",
    "behind",
    "right_10",
    "left_10",
    "right_135",
    "left_135",
    "right_20",
    "left_20",
    "left_corner_sideways",
    "right_corner_sideways",
    "left_corner_ahead",
    "right_corner_ahead",
)


@compiled
def crossing(
    x: float, y: float, dx: float, dy: float, line: NDArray[np.float64]
) -> tuple[float, float]:
    """Find where the line through two points meets another.

    Args:
        x: of the first point.
        y: of the first point.
        dx: from the first point to the second.
        dy: from the first point to the second.
        line: (4,) x1, y1, x2, y2.

    Returns:
        The shares of the way from the first point to the second, and along `line`; both lie
        between 0 and 1 where the segments cross. Infinite for parallels.
    """
    ex, ey = line[2] - line[0], line[3] - line[1]
    cross = dx * ey - dy * ex
    if cross == 0.0:
        return math.inf, math.inf
    ax, ay = line[0] - x, line[1] - y
    return (ax * ey - ay * ex) / cross, (ax * dy - ay * dx) / cross


@compiled
def ray_length(walls: NDArray[np.float64], x_px: float, y_px: float, angle_rad: float) -> float:
    """Give the distance from a point to the nearest wall in a direction, at most 1000 pixels.

    As `crossing` has it, but divided only for the few walls that the ray does cross.
    """
    dx, dy = FAR_PX * math.cos(angle_rad), FAR_PX * math.sin(angle_rad)
    nearest = 1.0
    for i in range(len(walls)):
        x1, y1 = walls[i, 0], walls[i, 1]
        ex, ey, ax, ay = walls[i, 2] - x1, walls[i, 3] - y1, x1 - x_px, y1 - y_px
        cross = dx * ey - dy * ex
        size = abs(cross)
        along = math.copysign(1.0, cross) * (ax * dy - ay * dx)
        if size > 0.0 and -JOINT * size <= along <= (1.0 + JOINT) * size:
            share = (ax * ey - ay * ex) / cross
            if 0.0 < share < nearest:
                nearest = share
    return nearest * FAR_PX


@compiled
def floored_distance(car: Racer, line: NDArray[np.float64], share: float) -> float:
    """Give the distance from a car's centre to the pixel at a share of the way along a line."""
    hit_x = math.floor(line[0] + share * (line[2] - line[0]))
    hit_y = math.floor(line[1] + share * (line[3] - line[1]))
    return math.hypot(hit_x - car.x_px, hit_y - car.y_px)


@compiled
def floored_ray_length(
    walls: NDArray[np.float64], car: Racer, x_px: float, y_px: float, angle_rad: float
) -> float:
    """Give the classic length of a ray: from the car's centre to the nearest floored hit.

    Hits are floored to whole pixels before they are compared; without a hit it is 1000.
    """
    dx, dy = FAR_PX * math.cos(angle_rad), FAR_PX * math.sin(angle_rad)
    nearest = math.inf
    for wall in walls:
        share, along_wall = crossing(x_px, y_px, dx, dy, wall)
        if 0.0 < share < 1.0 and 0.0 < along_wall < 1.0:
            nearest = min(nearest, floored_distance(car, wall, along_wall))
    return nearest if nearest < math.inf else FAR_PX


@compiled
def ray_start(car: Racer, ray: int, classic: bool) -> tuple[float, float, float]:
    """Give where a ray starts, x and y in pixels, and its direction, radians clockwise from x.

    The left corner's sideways ray looks to the left; in the classic rules across the car's nose.
    """
    if ray < CENTRE_RAYS:
        return car.x_px, car.y_px, car.heading_rad + CENTRE_RAYS_RAD[ray]
    right = 1.0 if (ray - CENTRE_RAYS) % 2 else -1.0
    x_px, y_px = corner_at(car, 1.0, right)
    if ray >= CENTRE_RAYS + 2:
        return x_px, y_px, car.heading_rad
    side = -right if classic else right
    return x_px, y_px, car.heading_rad + 0.5 * math.pi * side


@compiled
def measure(
    walls: NDArray[np.float64], car: Racer, classic: bool, lengths_px: NDArray[np.float64]
) -> None:
    """Write the lengths (18,) of the car's rays; the classic ones are all from its centre."""
    for ray in range(RAYS):
        x_px, y_px, angle_rad = ray_start(car, ray, classic)
        if classic:
            lengths_px[ray] = floored_ray_length(walls, car, x_px, y_px, angle_rad)
        else:
            lengths_px[ray] = ray_length(walls, x_px, y_px, angle_rad)


def ray_ends(walls: NDArray[np.float64], car: Racer) -> NDArray[np.float64]:
    """Give the rays as lines (18, 2, 2) from their start to the wall, x and y in pixels."""
    ends = []
    for ray in range(RAYS):
        x_px, y_px, angle_rad = ray_start(car, ray, False)
        length_px = ray_length(walls, x_px, y_px, angle_rad)
        hit = (x_px + length_px * math.cos(angle_rad), y_px + length_px * math.sin(angle_rad))
        ends.append(((x_px, y_px), hit))
    return np.array(ends)


@compiled
def classic_code(length_px: float) -> float:
    """Pack a length into (1000 px - d) / 1000 px: 1 is near."""
    return (FAR_PX - length_px) / FAR_PX
