"""Branch-free geometry of the lane sim's course, so that loops over cars can be vectorized.

`mcaprl.sims.geometry.paths` supports any path, but its loops have variable lengths. This module
supports only the lane sim's course: eight legs, each longer than the lookahead distance.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import inlined
from mcaprl.sims.geometry.paths import Projection
from mcaprl.sims.lane.course import COURSE

LONGEST_LOOK_M: Final = float(np.diff(COURSE.along_m).min())
"""Length of the shortest leg; a shorter part of the path contains at most one corner."""
_LENGTH_M: Final = COURSE.length_m
Eight = tuple[float, float, float, float, float, float, float, float]


def _eight(values: NDArray[np.float64], first: int = 0) -> Eight:
    """Return the values of the eight legs as a tuple, from leg `first` on."""
    # These are tuples because numba treats tuples, but not arrays, as compile-time constants.
    one, two, three, four, five, six, seven, eight = np.roll(values, -first).tolist()
    return one, two, three, four, five, six, seven, eight


_ALONG_M: Final = _eight(COURSE.along_m[:-1])
_LEG_M: Final = _eight(np.diff(COURSE.along_m))
_X_M: Final = _eight(COURSE.points_m[:-1, 0])
_Y_M: Final = _eight(COURSE.points_m[:-1, 1])
_COS: Final = _eight(COURSE.forward[:, 0])
_SIN: Final = _eight(COURSE.forward[:, 1])
_YAW_RAD: Final = _eight(COURSE.yaw_rad)
# The values of the following legs.
_NEXT_LEG_M: Final = _eight(np.diff(COURSE.along_m), 1)
_NEXT_X_M: Final = _eight(COURSE.points_m[:-1, 0], 1)
_NEXT_Y_M: Final = _eight(COURSE.points_m[:-1, 1], 1)
_NEXT_COS: Final = _eight(COURSE.forward[:, 0], 1)
_NEXT_SIN: Final = _eight(COURSE.forward[:, 1], 1)
_NEXT_YAW_RAD: Final = _eight(COURSE.yaw_rad, 1)


class Leg(NamedTuple):
    """Straight leg of the course: start point, direction, unit vector along the leg, and length."""

    x_m: float
    y_m: float
    yaw_rad: float
    cos: float
    sin: float
    length_m: float


class CourseSpot(NamedTuple):
    """Position on the course: the distance from the start of a leg, the leg, and the next leg."""

    rest_m: float
    leg: Leg
    after: Leg


@inlined
def course_spot_at(along_m: float) -> CourseSpot:
    """Return the position at a distance along the course; equivalent to `paths.spot_at`."""
    lap_m = along_m - _LENGTH_M * np.floor(along_m / _LENGTH_M)
    leg = Leg(
        _at(lap_m, _X_M),
        _at(lap_m, _Y_M),
        _at(lap_m, _YAW_RAD),
        _at(lap_m, _COS),
        _at(lap_m, _SIN),
        _at(lap_m, _LEG_M),
    )
    after = Leg(
        _at(lap_m, _NEXT_X_M),
        _at(lap_m, _NEXT_Y_M),
        _at(lap_m, _NEXT_YAW_RAD),
        _at(lap_m, _NEXT_COS),
        _at(lap_m, _NEXT_SIN),
        _at(lap_m, _NEXT_LEG_M),
    )
    return CourseSpot(lap_m - _at(lap_m, _ALONG_M), leg, after)


@inlined
def course_point_ahead(here: CourseSpot, ahead_m: float) -> tuple[float, float]:
    """Return the point (x, y), meters, at a distance along the course from a position.

    The distance `ahead_m` must be less than `LONGEST_LOOK_M`.
    """
    leg, following = here.leg, here.after
    on_leg_m = here.rest_m + ahead_m
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
    leg, after = here.leg, here.after
    start_m = from_m - here.rest_m
    last_m = min(leg.length_m, to_m - start_m)
    near_m, near_square, near_left = _on_leg(leg, x_m, y_m, max(0.0, from_m - start_m), last_m)
    after_start_m = start_m + leg.length_m
    far_m, far_square, far_left = _on_leg(after, x_m, y_m, 0.0, to_m - after_start_m)
    is_after = (after_start_m <= to_m) & (far_square < near_square)
    along_m = after_start_m + far_m if is_after else start_m + near_m
    distance_m = math.sqrt(far_square if is_after else near_square)
    leftward = far_left if is_after else near_left
    yaw_rad = after.yaw_rad if is_after else leg.yaw_rad
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
def _at(lap_m: float, numbers: Eight) -> float:
    """Return the number of the leg at a distance from the start of the lap.

    The compiler cannot vectorize lookups in an array, but it can vectorize these comparisons. In
    calls with the same distance, it compares only once.
    """
    number = numbers[1] if lap_m >= _ALONG_M[1] else numbers[0]
    number = numbers[2] if lap_m >= _ALONG_M[2] else number
    number = numbers[3] if lap_m >= _ALONG_M[3] else number
    number = numbers[4] if lap_m >= _ALONG_M[4] else number
    number = numbers[5] if lap_m >= _ALONG_M[5] else number
    number = numbers[6] if lap_m >= _ALONG_M[6] else number
    return numbers[7] if lap_m >= _ALONG_M[7] else number
