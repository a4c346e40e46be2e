"""Ray observation of the racer sim: the lengths of 18 rays to the walls."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled
from mcaprl.sims.geometry import FAR_M, heading_of, ray_name
from mcaprl.sims.racer.course import METERS_PER_PX, Car, corner_at

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
SLOTS = 20  # Number of rays in a block: `RAYS`, rounded up to a multiple of 4, the width of AVX2
X, Y, DX, DY, SHARE, BLOCK_SIZE = (SLOTS * part for part in range(6))
LENGTH = SHARE
"""Indices of the parts of a block. The offsets between parts are constants, so that the compiler
can prove that they do not overlap. Lengths replace the shares."""
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
    """Return where two lines cross, as fractions of both; infinite if they are parallel."""
    ex, ey = line[2] - line[0], line[3] - line[1]
    cross = dx * ey - dy * ex
    if cross == 0.0:
        return math.inf, math.inf
    ax, ay = line[0] - x, line[1] - y
    return (ax * ey - ay * ex) / cross, (ax * dy - ay * dx) / cross


@compiled
def write_rays(car: Car, classic: bool, block: NDArray[np.float64]) -> None:
    """Write a car's rays into a block: x, y, dx and dy."""
    # A ray ends at (x + dx, y + dy), 1000 pixels away. The sideways ray of the left corner points
    # left; in the classic rules, it points right.
    cos, sin = heading_of(car.heading_rad)
    for ray in range(CENTER_RAYS):
        block[X + ray], block[Y + ray] = car.x_px, car.y_px
        block[DX + ray] = FAR_PX * (cos * _COS[ray] - sin * _SIN[ray])
        block[DY + ray] = FAR_PX * (sin * _COS[ray] + cos * _SIN[ray])
    for corner in range(2):
        right = 2.0 * corner - 1.0
        side = -right if classic else right
        sideways, ahead = CENTER_RAYS + corner, CENTER_RAYS + 2 + corner
        x_px, y_px = corner_at(car, 1.0, right)
        block[X + sideways], block[Y + sideways] = x_px, y_px
        block[X + ahead], block[Y + ahead] = x_px, y_px
        block[DX + sideways], block[DY + sideways] = -FAR_PX * side * sin, FAR_PX * side * cos
        block[DX + ahead], block[DY + ahead] = FAR_PX * cos, FAR_PX * sin
    for ray in range(RAYS, SLOTS):
        block[X + ray], block[Y + ray], block[DX + ray], block[DY + ray] = 0.0, 0.0, 0.0, 0.0


@compiled
def cast(walls: NDArray[np.float64], block: NDArray[np.float64]) -> None:
    """Compute each ray's first hit on a wall, as a fraction of its length; 1 without one."""
    # The equations are those of `crossing`, without branches, so that the compiler can vectorize
    # the loop over rays. Parallel lines result in inf or NaN, which fail the comparisons.
    for ray in range(SLOTS):
        block[SHARE + ray] = 1.0
    for wall in range(len(walls)):
        x1, y1 = walls[wall, 0], walls[wall, 1]
        ex, ey = walls[wall, 2] - x1, walls[wall, 3] - y1
        for ray in range(SLOTS):
            dx, dy = block[DX + ray], block[DY + ray]
            ax, ay = x1 - block[X + ray], y1 - block[Y + ray]
            inverse = 1.0 / (dx * ey - dy * ex)
            share = (ax * ey - ay * ex) * inverse
            along = (ax * dy - ay * dx) * inverse
            nearest = block[SHARE + ray]
            is_nearer = (share > 0.0) & (share < nearest)
            is_hit = is_nearer & (along >= -JOINT) & (along <= 1.0 + JOINT)
            block[SHARE + ray] = share if is_hit else nearest


@compiled
def floored_distance(car: Car, line: NDArray[np.float64], share: float) -> float:
    """Return the distance from the center to a point of a line, rounded down to whole pixels."""
    hit_x = math.floor(line[0] + share * (line[2] - line[0]))
    hit_y = math.floor(line[1] + share * (line[3] - line[1]))
    return math.hypot(hit_x - car.x_px, hit_y - car.y_px)


@compiled
def floored_ray_length(
    walls: NDArray[np.float64], car: Car, block: NDArray[np.float64], ray: int
) -> float:
    """Return the classic length of a ray, from the center to the nearest floored hit."""
    nearest = math.inf
    x, y, dx, dy = block[X + ray], block[Y + ray], block[DX + ray], block[DY + ray]
    for wall in walls:
        share, along_wall = crossing(x, y, dx, dy, wall)
        if 0.0 < share < 1.0 and 0.0 < along_wall < 1.0:
            nearest = min(nearest, floored_distance(car, wall, along_wall))
    return nearest if nearest < math.inf else FAR_PX


@compiled
def measure(
    walls: NDArray[np.float64], car: Car, classic: bool, block: NDArray[np.float64]
) -> None:
    """Write the car's rays and their lengths in pixels, classic ones from the center."""
    write_rays(car, classic, block)
    if classic:
        for ray in range(RAYS):
            block[LENGTH + ray] = floored_ray_length(walls, car, block, ray)
    else:
        cast(walls, block)
        for ray in range(RAYS):
            block[LENGTH + ray] *= FAR_PX


def ray_ends(walls: NDArray[np.float64], car: Car) -> NDArray[np.float64]:
    """Return the rays as segments from the car to the walls, (18, 2, 2) pixels."""
    block = np.empty(BLOCK_SIZE)
    write_rays(car, False, block)
    cast(walls, block)
    x, y, dx, dy, shares = block.reshape(-1, SLOTS)[:, :RAYS]
    starts = np.column_stack([x, y])
    return np.stack([starts, starts + np.column_stack([shares * dx, shares * dy])], axis=1)


@compiled
def classic_code(length_px: float) -> float:
    """Encode a length d as (1000 px - d) / 1000 px."""
    return (FAR_PX - length_px) / FAR_PX
