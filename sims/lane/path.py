"""Places on the lane sim's course, found without a branch.

`geometry` finds the same on any path, with searches and loops that end when they are done. Here
they are sums and choices of one length, so that the compiler can do several cars at once. It counts
on what is particular to the course: few legs, all longer than any car looks in one step.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from mcaprl.sims.geometry.compiled import inlined
from mcaprl.sims.geometry.paths import Projection
from mcaprl.sims.lane.course import COURSE

LONGEST_LOOK_M: Final = float(np.diff(COURSE.along_m).min())
"""Who looks less far along the path sees at most one corner."""
_LENGTH_M: Final = COURSE.length_m
_LAST_LEG: Final = 7.0
assert len(COURSE.yaw_rad) == _LAST_LEG + 1
Eight = tuple[float, float, float, float, float, float, float, float]
# Tuples of numbers are constants to the compiler, and arrays are not.
_ALONG_M: Final[Eight] = tuple(COURSE.along_m[:-1].tolist())
_LEG_M: Final[Eight] = tuple(np.diff(COURSE.along_m).tolist())
_X_M: Final[Eight] = tuple(COURSE.points_m[:-1, 0].tolist())
_Y_M: Final[Eight] = tuple(COURSE.points_m[:-1, 1].tolist())
_COS: Final[Eight] = tuple(COURSE.forward[:, 0].tolist())
_SIN: Final[Eight] = tuple(COURSE.forward[:, 1].tolist())
_YAW_RAD: Final[Eight] = tuple(COURSE.yaw_rad.tolist())


class CourseSpot(NamedTuple):
    """A place on the course: on which leg, and how far from the leg's start."""

    leg: float
    """Its number; numbers of which to choose are sooner compared as floats."""
    rest_m: float


class Leg(NamedTuple):
    """A straight part of the course."""

    x_m: float
    y_m: float
    """Where it starts."""
    cos: float
    sin: float
    """Its direction."""
    length_m: float


@inlined
def course_spot_at(along_m: float) -> CourseSpot:
    """Find the place at a distance along the course, as `geometry.spot_at` does."""
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
    """Give a leg by its number."""
    return Leg(_of(leg, _X_M), _of(leg, _Y_M), _of(leg, _COS), _of(leg, _SIN), _of(leg, _LEG_M))


@inlined
def course_next(leg: float) -> float:
    """Give the number of the leg behind one."""
    return leg + 1.0 if leg < _LAST_LEG else 0.0


@inlined
def course_point_ahead(
    leg: Leg, following: Leg, rest_m: float, ahead_m: float
) -> tuple[float, float]:
    """Give the point (x, y), metres, less than `LONGEST_LOOK_M` ahead of a place on a leg."""
    on_leg_m = rest_m + ahead_m
    is_beyond = on_leg_m >= leg.length_m
    on_leg_m = on_leg_m - leg.length_m if is_beyond else on_leg_m
    x_m, cos = (following.x_m, following.cos) if is_beyond else (leg.x_m, leg.cos)
    y_m, sin = (following.y_m, following.sin) if is_beyond else (leg.y_m, leg.sin)
    return x_m + on_leg_m * cos, y_m + on_leg_m * sin


@inlined
def course_project(x_m: float, y_m: float, from_m: float, to_m: float) -> Projection:
    """Find the nearest of the course's points between two distances along it.

    As `geometry.project` does; less than `LONGEST_LOOK_M` may lie between the two.
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
    distance_m = np.sqrt(far_square if is_after else near_square)
    leftward = far_left if is_after else near_left
    yaw_rad = _of(after if is_after else here.leg, _YAW_RAD)
    return Projection(along_m, distance_m if leftward >= 0.0 else -distance_m, yaw_rad)


@inlined
def _on_leg(
    leg: Leg, x_m: float, y_m: float, first_m: float, last_m: float
) -> tuple[float, float, float]:
    """The nearest point of a part of a leg: where, how far squared, and how far to the left."""
    dx, dy = x_m - leg.x_m, y_m - leg.y_m
    along_m = min(max(dx * leg.cos + dy * leg.sin, first_m), last_m)
    off_x, off_y = dx - along_m * leg.cos, dy - along_m * leg.sin
    return along_m, off_x * off_x + off_y * off_y, leg.cos * dy - leg.sin * dx


@inlined
def _of(leg: float, numbers: Eight) -> float:
    """Choose a leg's number: to look it up would be one load for each car, and not for several."""
    number = numbers[1] if leg >= 1.0 else numbers[0]
    number = numbers[2] if leg >= 2.0 else number
    number = numbers[3] if leg >= 3.0 else number
    number = numbers[4] if leg >= 4.0 else number
    number = numbers[5] if leg >= 5.0 else number
    number = numbers[6] if leg >= 6.0 else number
    return numbers[7] if leg >= 7.0 else number
