"""Ray observation of the racer sim: the lengths of 18 rays to the walls."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled
from mcaprl.sims.geometry.paths import heading_of
from mcaprl.sims.geometry.ray_code import FAR_M, ray_name
from mcaprl.sims.racer.car import Car, corner_at
from mcaprl.sims.racer.course import METERS_PER_PX

FAR_PX = FAR_M / METERS_PER_PX
JOINT = 1e-9
"""Fraction by which walls are extended at both ends, so that no ray passes between two walls."""
CENTER_RAYS_DEG = (0, -30, 30, 45, -45, 90, -90, 180, 10, -10, 135, -135, 20, -20)
"""Directions of the rays from the car's center; right is positive."""
CENTER_RAYS_RAD = tuple(math.radians(angle) for angle in CENTER_RAYS_DEG)
_COS: NDArray[np.float64] = np.cos(CENTER_RAYS_RAD)
_SIN: NDArray[np.float64] = np.sin(CENTER_RAYS_RAD)
CENTER_RAYS = len(CENTER_RAYS_DEG)
RAYS = CENTER_RAYS + 4
RAY_NAMES = (
    *(ray_name(angle if angle == 180 else -angle) for angle in CENTER_RAYS_DEG),
    "left_corner_sideways",
    "right_corner_sideways",
    "left_corner_ahead",
    "right_corner_ahead",
)


@compiled
def crossing(
    x: float, y: float, dx: float, dy: float, line: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the intersection of the line through two points with another line.

    Args:
        x: x of the first point.
        y: y of the first point.
        dx: Difference in x from the first point to the second.
        dy: Difference in y from the first point to the second.
        line: (4,) x1, y1, x2, y2.

    Returns:
        Position of the intersection as a fraction of the segment between the points, and as a
        fraction of `line`. Both are between 0 and 1 if the segments intersect, and infinite if
        the lines are parallel.
    """
    ex, ey = line[2] - line[0], line[3] - line[1]
    cross = dx * ey - dy * ex
    if cross == 0.0:
        return math.inf, math.inf
    ax, ay = line[0] - x, line[1] - y
    return (ax * ey - ay * ex) / cross, (ax * dy - ay * dx) / cross


@compiled
def write_rays(car: Car, classic: bool, rays: NDArray[np.float64]) -> None:
    """Write a car's rays (4, 18): x, y, dx and dy.

    A ray starts at (x, y) and ends at (x + dx, y + dy), 1000 pixels away.

    The sideways ray of the left corner points left; in the classic rules, it points right.
    """
    cos, sin = heading_of(car.heading_rad)
    for ray in range(CENTER_RAYS):
        rays[0, ray], rays[1, ray] = car.x_px, car.y_px
        rays[2, ray] = FAR_PX * (cos * _COS[ray] - sin * _SIN[ray])
        rays[3, ray] = FAR_PX * (sin * _COS[ray] + cos * _SIN[ray])
    for corner in range(2):
        right = 2.0 * corner - 1.0
        side = -right if classic else right
        sideways, ahead = CENTER_RAYS + corner, CENTER_RAYS + 2 + corner
        x_px, y_px = corner_at(car, 1.0, right)
        rays[0, sideways], rays[1, sideways] = x_px, y_px
        rays[0, ahead], rays[1, ahead] = x_px, y_px
        rays[2, sideways], rays[3, sideways] = -FAR_PX * side * sin, FAR_PX * side * cos
        rays[2, ahead], rays[3, ahead] = FAR_PX * cos, FAR_PX * sin


@compiled
def cast(
    walls: NDArray[np.float64], rays: NDArray[np.float64], shares: NDArray[np.float64]
) -> None:
    """Compute the first hit of each ray on a wall.

    The equations are those of `crossing`, without branches, so that the compiler can vectorize the
    loop over rays. Parallel lines result in inf or NaN, which fail the comparisons.

    Args:
        walls: (W, 4) walls.
        rays: (4, R) rays as written by `write_rays`.
        shares: (R,) output: distance of the hit as a fraction of the ray's length; 1 without a hit.
    """
    x_px, y_px, dx, dy = rays[0], rays[1], rays[2], rays[3]
    shares[:] = 1.0
    for wall in range(len(walls)):
        x1, y1 = walls[wall, 0], walls[wall, 1]
        ex, ey = walls[wall, 2] - x1, walls[wall, 3] - y1
        for ray in range(len(shares)):
            ax, ay = x1 - x_px[ray], y1 - y_px[ray]
            inverse = 1.0 / (dx[ray] * ey - dy[ray] * ex)
            share = (ax * ey - ay * ex) * inverse
            along = (ax * dy[ray] - ay * dx[ray]) * inverse
            is_nearer = (share > 0.0) & (share < shares[ray])
            is_hit = is_nearer & (along >= -JOINT) & (along <= 1.0 + JOINT)
            shares[ray] = share if is_hit else shares[ray]


@compiled
def floored_distance(car: Car, line: NDArray[np.float64], share: float) -> float:
    """Return the distance from a car's center to a point on a line.

    The coordinates of the point are rounded down to whole pixels. `share` is the position of the
    point as a fraction of the line, 0 to 1.
    """
    hit_x = math.floor(line[0] + share * (line[2] - line[0]))
    hit_y = math.floor(line[1] + share * (line[3] - line[1]))
    return math.hypot(hit_x - car.x_px, hit_y - car.y_px)


@compiled
def floored_ray_length(
    walls: NDArray[np.float64], car: Car, rays: NDArray[np.float64], ray: int
) -> float:
    """Return the classic length of a ray: the distance from the car's center to the nearest hit.

    The coordinates of hits are rounded down to whole pixels. Without a hit, the length is 1000.
    """
    nearest = math.inf
    for wall in walls:
        share, along_wall = crossing(rays[0, ray], rays[1, ray], rays[2, ray], rays[3, ray], wall)
        if 0.0 < share < 1.0 and 0.0 < along_wall < 1.0:
            nearest = min(nearest, floored_distance(car, wall, along_wall))
    return nearest if nearest < math.inf else FAR_PX


@compiled
def measure(
    walls: NDArray[np.float64], car: Car, classic: bool, lengths_px: NDArray[np.float64]
) -> None:
    """Write the lengths (18,) of the car's rays. Classic lengths begin at the car's center."""
    rays = np.empty((4, RAYS))
    write_rays(car, classic, rays)
    if classic:
        for ray in range(RAYS):
            lengths_px[ray] = floored_ray_length(walls, car, rays, ray)
    else:
        cast(walls, rays, lengths_px)
        for ray in range(RAYS):
            lengths_px[ray] *= FAR_PX


def ray_ends(walls: NDArray[np.float64], car: Car) -> NDArray[np.float64]:
    """Return the rays as segments from the car to the walls, (18, 2, 2) pixels."""
    rays, shares = np.empty((4, RAYS)), np.empty(RAYS)
    write_rays(car, False, rays)
    cast(walls, rays, shares)
    starts = rays[:2].T
    return np.stack([starts, starts + shares[:, np.newaxis] * rays[2:].T], axis=1)


@compiled
def classic_code(length_px: float) -> float:
    """Encode a length d as (1000 px - d) / 1000 px."""
    return (FAR_PX - length_px) / FAR_PX
