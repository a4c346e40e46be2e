"""Branch-free geometry of the lane sim's course, so that loops over cars can be vectorized.

`mcaprl.sims.geometry.paths` supports any path, but its loops have variable lengths. This module
supports only the lane sim's course: eight legs, each longer than the lookahead distance.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from mcaprl.compiled import inlined
from mcaprl.sims.geometry.paths import Projection
from mcaprl.sims.lane.course import COURSE

LONGEST_LOOK_M: Final = float(np.diff(COURSE.along_m).min())
"""Length of the shortest leg; a shorter part of the path contains at most one corner."""
_LENGTH_M: Final = COURSE.length_m
_LAST_LEG: Final = 7.0
assert len(COURSE.yaw_rad) == _LAST_LEG + 1
Eight = tuple[float, float, float, float, float, float, float, float]
# These are tuples because numba treats tuples, but not arrays, as compile-time constants.
_ALONG_M: Final[Eight] = tuple(COURSE.along_m[:-1].tolist())
_LEG_M: Final[Eight] = tuple(np.diff(COURSE.along_m).tolist())
_X_M: Final[Eight] = tuple(COURSE.points_m[:-1, 0].tolist())
_Y_M: Final[Eight] = tuple(COURSE.points_m[:-1, 1].tolist())
_COS: Final[Eight] = tuple(COURSE.forward[:, 0].tolist())
_SIN: Final[Eight] = tuple(COURSE.forward[:, 1].tolist())
_YAW_RAD: Final[Eight] = tuple(COURSE.yaw_rad.tolist())


class CourseSpot(NamedTuple):
    """Position on the course: a leg, and the distance from the start of that leg."""

    leg: float
    """Index of the leg; a float, so that comparisons need no conversion."""
    rest_m: float


class Leg(NamedTuple):
    """Straight leg of the course: start point, unit vector along the leg, and length."""

    x_m: float
    y_m: float
    cos: float
    sin: float
    length_m: float


@inlined
def course_spot_at(along_m: float) -> CourseSpot:
    """Return the position at a distance along the course; equivalent to `paths.spot_at`."""
    rest_m = along_m - _LENGTH_M * np.floor(along_m / _LENGTH_M)
    leg = 1.0 if rest_m >= _ALONG_M[1] else 0.0
    leg = 2.0 if rest_m >= _ALONG_M[2] else leg
    leg = 3.0 if rest_m >= _ALONG_M[3] else leg
    leg = 4.0 if rest_m >= _ALONG_M[4] else leg
    leg = 5.0 if rest_m >= _ALONG_M[5] else leg
    leg = 6.0 if rest_m >= _ALONG_M[6] else leg
    leg = 7.0 if rest_m >= _ALONG_M[7] else leg
    return CourseSpot(leg, rest_m - _of(leg, _ALONG_M))


@inlined
def course_leg(leg: float) -> Leg:
    """Return the leg with this index."""
    return Leg(_of(leg, _X_M), _of(leg, _Y_M), _of(leg, _COS), _of(leg, _SIN), _of(leg, _LEG_M))


@inlined
def course_next(leg: float) -> float:
    """Return the index of the next leg; leg 0 follows the last leg."""
    return leg + 1.0 if leg < _LAST_LEG else 0.0


@inlined
def course_point_ahead(
    leg: Leg, following: Leg, rest_m: float, ahead_m: float
) -> tuple[float, float]:
    """Return the point (x, y), meters, at a distance `ahead_m` along the course from a position.

    The position is `rest_m` after the start of `leg`; `ahead_m` must be less than `LONGEST_LOOK_M`.
    """
    on_leg_m = rest_m + ahead_m
    is_beyond = on_leg_m >= leg.length_m
    on_leg_m = on_leg_m - leg.length_m if is_beyond else on_leg_m
    x_m, cos = (following.x_m, following.cos) if is_beyond else (leg.x_m, leg.cos)
    y_m, sin = (following.y_m, following.sin) if is_beyond else (leg.y_m, leg.sin)
    return x_m + on_leg_m * cos, y_m + on_leg_m * sin


@inlined
def course_project(x_m: float, y_m: float, from_m: float, to_m: float) -> Projection:
    """Return the course point nearest to (x_m, y_m) between two distances along the course.

    The result equals that of `paths.project`. The distances must differ by less than
    `LONGEST_LOOK_M`.
    """
    here = course_spot_at(from_m)
    leg, after = course_leg(here.leg), course_next(here.leg)
    start_m = from_m - here.rest_m
    last_m = min(leg.length_m, to_m - start_m)
    near_m, near_square, near_left = _on_leg(leg, x_m, y_m, max(0.0, from_m - start_m), last_m)
    after_start_m = start_m + leg.length_m
    far_m, far_square, far_left = _on_leg(course_leg(after), x_m, y_m, 0.0, to_m - after_start_m)
    is_after = (after_start_m <= to_m) & (far_square < near_square)
    along_m = after_start_m + far_m if is_after else start_m + near_m
    distance_m = math.sqrt(far_square if is_after else near_square)
    leftward = far_left if is_after else near_left
    yaw_rad = _of(after if is_after else here.leg, _YAW_RAD)
    return Projection(along_m, distance_m if leftward >= 0.0 else -distance_m, yaw_rad)


@inlined
def _on_leg(
    leg: Leg, x_m: float, y_m: float, first_m: float, last_m: float
) -> tuple[float, float, float]:
    """Find the point nearest to (x_m, y_m) on a leg, between `first_m` and `last_m` on the leg.

    Returns:
        Distance along the leg, squared distance from (x_m, y_m), and the offset of (x_m, y_m) to
        the left of the leg's line.
    """
    dx, dy = x_m - leg.x_m, y_m - leg.y_m
    along_m = min(max(dx * leg.cos + dy * leg.sin, first_m), last_m)
    off_x, off_y = dx - along_m * leg.cos, dy - along_m * leg.sin
    return along_m, off_x * off_x + off_y * off_y, leg.cos * dy - leg.sin * dx


@inlined
def _of(leg: float, numbers: Eight) -> float:
    """Return `numbers[leg]` without an array lookup, which the compiler cannot vectorize."""
    number = numbers[1] if leg >= 1.0 else numbers[0]
    number = numbers[2] if leg >= 2.0 else number
    number = numbers[3] if leg >= 3.0 else number
    number = numbers[4] if leg >= 4.0 else number
    number = numbers[5] if leg >= 5.0 else number
    number = numbers[6] if leg >= 6.0 else number
    return numbers[7] if leg >= 7.0 else number
