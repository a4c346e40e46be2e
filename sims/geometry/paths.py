"""Plane geometry: closed paths, the nearest point of a path, angles and directions."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mcaprl.compiled import compiled, inlined


class Path(NamedTuple):
    """Closed polyline of N legs."""

    points_m: NDArray[np.float64]
    """(N + 1, 2) corners; the last one equals the first."""
    along_m: NDArray[np.float64]
    """(N + 1,) distance of each corner from the start, along the path."""
    yaw_rad: NDArray[np.float64]
    """(N,) direction of each leg, counter-clockwise from x."""
    forward: NDArray[np.float64]
    """(N, 2) direction of each leg as a unit vector."""
    length_m: float


class Projection(NamedTuple):
    """Path point nearest to a position."""

    along_m: float
    offset_m: float
    """Distance of the position from the path, positive to the left of its direction."""
    yaw_rad: float
    """Direction of the path at the nearest point."""


def closed_path(corners: ArrayLike) -> Path:
    """Return the path through corners (N + 1, 2), meters; the last corner equals the first."""
    points = np.array(corners, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3:
        raise ValueError(f"corners have shape {points.shape}: at least (3, 2) is needed")
    if not np.array_equal(points[0], points[-1]):
        raise ValueError(f"the path is open: it starts at {points[0]} and ends at {points[-1]}")
    legs = np.diff(points, axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])
    if not np.all(lengths > 0):
        raise ValueError("two neighboring corners are the same point")
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    yaw_rad = np.arctan2(legs[:, 1], legs[:, 0])
    return Path(points, along, yaw_rad, legs / lengths[:, np.newaxis], float(along[-1]))


@inlined
def wrap_angle(angle_rad: float) -> float:
    """Wrap an angle to [-pi, pi)."""
    turns = np.floor((angle_rad + math.pi) / (2.0 * math.pi))
    wrapped = max(angle_rad - 2.0 * math.pi * turns, -math.pi)
    # Rounding may push the result to pi.
    return wrapped if wrapped < math.pi else -math.pi


@inlined
def sine(angle_rad: float) -> float:
    """Return the sine of an angle from -45 to 45 degrees, accurate to about the last bit.

    The function has no branches or calls, so that the compiler can vectorize loops. The series is
    x - x^3/3! + x^5/5! - ...; the first omitted term is below 6e-17 times the sine.
    """
    square = angle_rad * angle_rad
    rest = 1.0 / 6227020800.0 - square * (1.0 / 1307674368000.0)
    rest = 1.0 / 39916800.0 - square * rest
    rest = 1.0 / 362880.0 - square * rest
    rest = 1.0 / 5040.0 - square * rest
    rest = 1.0 / 120.0 - square * rest
    rest = 1.0 / 6.0 - square * rest
    return angle_rad * (1.0 - square * rest)


@inlined
def cosine(angle_rad: float) -> float:
    """Return the cosine of an angle from -45 to 45 degrees, computed as in `sine`.

    The series is 1 - x^2/2! + x^4/4! - ...; the first omitted term is below 2e-18.
    """
    square = angle_rad * angle_rad
    rest = 1.0 / 87178291200.0 - square * (1.0 / 20922789888000.0)
    rest = 1.0 / 479001600.0 - square * rest
    rest = 1.0 / 3628800.0 - square * rest
    rest = 1.0 / 40320.0 - square * rest
    rest = 1.0 / 720.0 - square * rest
    rest = 1.0 / 24.0 - square * rest
    return 1.0 - square * (0.5 - square * rest)


_QUARTER_RAD, _QUARTER_REST_RAD = math.pi / 2, 6.123233995736766e-17
"""A quarter turn, and the rounding error of its float64 value."""


class Heading(NamedTuple):
    """Direction of a yaw angle as a unit vector."""

    cos: float
    sin: float


@inlined
def heading_of(yaw_rad: float) -> Heading:
    """Return the direction of a yaw angle, accurate to about the last bit.

    Like `sine`, the function has no branches or calls. It splits the angle into quarter turns and
    a remainder of at most 45 degrees, and computes the sine and cosine of the remainder. The number
    of quarter turns determines which of these two values is the cosine of the yaw, and the signs
    of both.
    """
    quarters = np.floor(yaw_rad * (2.0 / math.pi) + 0.5)
    rest_rad = (yaw_rad - quarters * _QUARTER_RAD) - quarters * _QUARTER_REST_RAD
    sin, cos = sine(rest_rad), cosine(rest_rad)
    # This is `quarters` modulo 4.
    quarter = quarters - 4.0 * np.floor(0.25 * quarters)
    is_odd = (quarter == 1.0) | (quarter == 3.0)
    size_of_cos, size_of_sin = (sin, cos) if is_odd else (cos, sin)
    is_left, is_below = (quarter == 1.0) | (quarter == 2.0), quarter >= 2.0
    return Heading(
        -size_of_cos if is_left else size_of_cos, -size_of_sin if is_below else size_of_sin
    )


@inlined
def turned(heading: Heading, angle_rad: float) -> Heading:
    """Rotate a direction counter-clockwise by an angle from -12 to 12 degrees.

    The function uses the angle addition formulas and cos(a) = 1 - 2 sin^2(a / 2). The sine is the
    series of `sine` with fewer terms; the first omitted term is below 5e-18 times the sine.
    """
    half_rad = 0.5 * angle_rad
    square = half_rad * half_rad
    rest = 1.0 / 5040.0 - square * (1.0 / 362880.0)
    rest = 1.0 / 120.0 - square * rest
    rest = 1.0 / 6.0 - square * rest
    half = half_rad * (1.0 - square * rest)
    cos = 1.0 - 2.0 * half * half
    sin = 2.0 * half * math.sqrt(1.0 - half * half)
    return Heading(heading.cos * cos - heading.sin * sin, heading.sin * cos + heading.cos * sin)


class Spot(NamedTuple):
    """Position on a path: the index of its leg, and the distance from the leg's start."""

    leg: int
    rest_m: float


@compiled
def spot_at(path: Path, along_m: float) -> Spot:
    """Return the position at a distance along the path; distances wrap around."""
    rest_m = along_m % path.length_m
    leg, beyond = 0, len(path.yaw_rad)
    while beyond - leg > 1:
        middle = (leg + beyond) // 2
        if path.along_m[middle] <= rest_m:
            leg = middle
        else:
            beyond = middle
    return Spot(leg, rest_m - path.along_m[leg])


@compiled
def further(path: Path, spot: Spot, ahead_m: float) -> Spot:
    """Return the position that is `ahead_m` further along the path; `ahead_m` is at least 0."""
    leg, rest_m = spot.leg, spot.rest_m + ahead_m
    length_m = path.along_m[leg + 1] - path.along_m[leg]
    while rest_m >= length_m:
        rest_m -= length_m
        leg = leg + 1 if leg + 1 < len(path.yaw_rad) else 0
        length_m = path.along_m[leg + 1] - path.along_m[leg]
    return Spot(leg, rest_m)


@compiled
def point_of(path: Path, spot: Spot) -> tuple[float, float]:
    """Return the coordinates (x, y) of a position, meters."""
    start, forward = path.points_m[spot.leg], path.forward[spot.leg]
    return start[0] + spot.rest_m * forward[0], start[1] + spot.rest_m * forward[1]


@compiled
def leg_at(path: Path, along_m: float) -> int:
    """Return the index of the leg at a distance along the path; distances wrap around."""
    return spot_at(path, along_m).leg


@compiled
def point_at(path: Path, along_m: float) -> tuple[float, float]:
    """Return the point (x, y), meters, at a distance along the path; distances wrap around."""
    return point_of(path, spot_at(path, along_m))


@compiled
def project(path: Path, x_m: float, y_m: float, from_m: float, to_m: float) -> Projection:
    """Return the path point nearest to (x_m, y_m) between two distances along the path.

    Where the path crosses itself, the window [from_m, to_m] selects the vehicle's branch. The
    window may begin on any lap. The result's `along_m` is within the window.
    """
    leg, rest_m = spot_at(path, from_m)
    leg_start_m = from_m - rest_m
    nearest, along_m, leftward, yaw_rad = math.inf, from_m, True, 0.0
    while leg_start_m <= to_m:
        leg_length_m = path.along_m[leg + 1] - path.along_m[leg]
        cos, sin = path.forward[leg, 0], path.forward[leg, 1]
        dx, dy = x_m - path.points_m[leg, 0], y_m - path.points_m[leg, 1]
        first_m = max(0.0, from_m - leg_start_m)
        last_m = min(leg_length_m, to_m - leg_start_m)
        along_leg_m = min(max(dx * cos + dy * sin, first_m), last_m)
        square = (dx - along_leg_m * cos) ** 2 + (dy - along_leg_m * sin) ** 2
        if square < nearest:
            nearest, along_m, yaw_rad = square, leg_start_m + along_leg_m, path.yaw_rad[leg]
            leftward = cos * dy - sin * dx >= 0.0
        leg_start_m += leg_length_m
        leg = leg + 1 if leg + 1 < len(path.yaw_rad) else 0
    distance_m = math.sqrt(nearest)
    return Projection(along_m, distance_m if leftward else -distance_m, yaw_rad)


@inlined
def in_body_frame(dx_m: float, dy_m: float, cos_yaw: float, sin_yaw: float) -> tuple[float, float]:
    """Transform a map vector into a body's frame: (forward, left), meters."""
    return dx_m * cos_yaw + dy_m * sin_yaw, dy_m * cos_yaw - dx_m * sin_yaw


def scattered(index: int, low: float, high: float) -> float:
    """Return element `index` of a golden-ratio sequence that covers `low` to `high` evenly."""
    return low + (high - low) * (index * 0.6180339887498949 % 1.0)
