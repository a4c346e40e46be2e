"""Course of the lane sim: its path, its streets, and the rails, barriers and houses beside them.

The path is 1,026 m long. It consists of two squares of about 130 m that share a leg; the first is
driven clockwise, the second counter-clockwise. Coordinates are right-handed with z up. The sign of
y is opposite to the published course, so that right turns remain right turns. The course is the
same on every machine.

`geometry.paths` supports any path, but its loops have variable lengths. The functions here support
only this course, eight legs, each longer than the lookahead distance, without branches, so that
loops over cars can be vectorized.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import inlined
from mcaprl.sims.geometry import Projection, closed_path, scattered

CORNERS_M = (
    (0.0, 1.0),
    (130.0, 1.0),
    (130.0, -125.0),
    (0.0, -125.0),
    (0.0, 1.0),
    (130.0, 1.0),
    (130.0, 128.0),
    (0.0, 128.0),
    (0.0, 1.0),
)
COURSE = closed_path(CORNERS_M)
NEXT_TURN: NDArray[np.float64] = np.sign(np.sin(np.roll(COURSE.yaw_rad, -1) - COURSE.yaw_rad))
"""(N,) direction of the turn at the end of each leg: 1 left, -1 right."""

SECOND_SQUARE_M = float(COURSE.along_m[4])
"""Distance along the path at which the second square begins."""

LANE_HALF_WIDTH_M = 3.5
RAIL_OFFSET_M = 4.0  # Distance from the center line to the inner faces of the rails
RAIL_HEIGHT_M = 0.7
RAIL_THICKNESS_M = 0.12
BARRIER_HEIGHT_M = 3.0  # Height of the barriers, which is above the camera
GROUND_HALF_SIDE_M = 1000.0
"""Half of the ground's side; large enough to cover the last row of pixels below the horizon."""

CAMERA_FORWARD_M = 0.4
"""Distance of the camera from the middle of the wheelbase, the origin of the car's frame."""
CAMERA_HEIGHT_M = 1.4

HOUSE_GAP_M = 1.0  # Minimum distance between houses


class Box(NamedTuple):
    """Axis-aligned box on the ground, meters; x and y are the coordinates of its center."""

    x_m: float
    y_m: float
    length_m: float
    width_m: float
    height_m: float


def streets() -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return the start and end point of each leg, (2,) each, meters; that of both squares once."""
    legs = {tuple(sorted(ends)) for ends in itertools.pairwise(CORNERS_M)}
    return [(np.array(start), np.array(end)) for start, end in sorted(legs)]


def street_bounds(half_width_m: float) -> NDArray[np.float64]:
    """Return the streets as (K, 4) rectangles x0, y0, x1, y1 in meters."""
    # Each extends `half_width_m` beyond both ends of its leg.
    ends = np.array(streets())
    return np.hstack([ends.min(axis=1) - half_width_m, ends.max(axis=1) + half_width_m])


def pavement(
    half_width_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return x and y of a grid along all street edges, and a mask of its cells on a street."""
    bounds = street_bounds(half_width_m)
    x_m, y_m = np.unique(bounds[:, [0, 2]]), np.unique(bounds[:, [1, 3]])
    middle_x, middle_y = (x_m[:-1] + x_m[1:]) / 2, (y_m[:-1] + y_m[1:]) / 2
    paved = np.zeros((len(middle_x), len(middle_y)), dtype=np.bool_)
    for x0, y0, x1, y1 in bounds:
        inside_x, inside_y = (middle_x > x0) & (middle_x < x1), (middle_y > y0) & (middle_y < y1)
        paved |= np.outer(inside_x, inside_y)
    return x_m, y_m, paved


def outline(half_width_m: float) -> NDArray[np.float64]:
    """Return the outline of all streets as (M, 2, 2) segments: x and y of start and end, meters."""
    x_m, y_m, paved = pavement(half_width_m)
    padded = np.pad(paved, 1)
    across_x = np.argwhere(padded[1:, 1:-1] != padded[:-1, 1:-1])
    across_y = np.argwhere(padded[1:-1, 1:] != padded[1:-1, :-1])
    edges = [((x_m[i], y_m[j]), (x_m[i], y_m[j + 1])) for i, j in across_x]
    edges += [((x_m[i], y_m[j]), (x_m[i + 1], y_m[j])) for i, j in across_y]
    return np.array(edges)


def rails() -> list[Box]:
    """Return the guard rails: thin boxes along the outline of the streets."""
    boxes = []
    for (x0, y0), (x1, y1) in outline(RAIL_OFFSET_M + RAIL_THICKNESS_M / 2):
        length_m, width_m = x1 - x0 + RAIL_THICKNESS_M, y1 - y0 + RAIL_THICKNESS_M
        boxes.append(Box((x0 + x1) / 2, (y0 + y1) / 2, length_m, width_m, RAIL_HEIGHT_M))
    return boxes


def barriers() -> tuple[tuple[Box, ...], tuple[Box, ...]]:
    """Return the barriers for a car on the first square, and those for a car on the second."""
    # They close the streets of the other square at both crossings of the shared leg. Without them,
    # the leg would look the same on both squares, but the car must turn right at its end on the
    # first square, and left on the second.
    (x0, y0), (x1, _) = CORNERS_M[:2]
    aside_m = RAIL_OFFSET_M + RAIL_THICKNESS_M / 2
    size = (2 * RAIL_OFFSET_M, RAIL_THICKNESS_M, BARRIER_HEIGHT_M)
    first, second = (
        tuple(Box(x_m, y0 + side * aside_m, *size) for x_m in (x0, x1)) for side in (1, -1)
    )
    return first, second


def _overlaps(box: Box, bounds: NDArray[np.float64]) -> bool:
    apart_x = np.minimum(bounds[:, 2] - box.x_m, box.x_m - bounds[:, 0]) <= -box.length_m / 2
    apart_y = np.minimum(bounds[:, 3] - box.y_m, box.y_m - bounds[:, 1]) <= -box.width_m / 2
    return bool(np.any(~(apart_x | apart_y)))


def _house(
    index: int, at: NDArray[np.float64], forward: NDArray[np.float64], left: NDArray[np.float64]
) -> Box:
    """Return a house beside the point `at`; `index` gives its size and its distance."""
    front_m, deep_m = scattered(index, 8.0, 18.0), scattered(3 * index, 8.0, 15.0)
    garden_m = scattered(5 * index, 7.5, 11.5)
    middle = at + forward * (front_m / 2) + left * (garden_m + deep_m / 2)
    size = np.abs(forward) * front_m + np.abs(left) * deep_m
    height_m = scattered(7 * index, 4.0, 12.0) + scattered(11 * index, 0.0, 3.0) ** 3
    return Box(float(middle[0]), float(middle[1]), float(size[0]), float(size[1]), height_m)


@functools.cache
def buildings() -> tuple[Box, ...]:
    """Return non-overlapping houses on both sides of each street."""
    taken = street_bounds(RAIL_OFFSET_M + 2.0)
    boxes: list[Box] = []
    index = 0
    for (start, end), side in itertools.product(streets(), (1, -1)):
        length_m = float(np.hypot(*(end - start)))
        forward = (end - start) / length_m
        left = side * np.array([-forward[1], forward[0]])
        along_m = -12.0
        while along_m < length_m + 12.0:
            index += 1
            box = _house(index, start + forward * along_m, forward, left)
            if not _overlaps(box, taken):
                boxes.append(box)
                half = np.array([box.length_m, box.width_m]) / 2 + HOUSE_GAP_M
                middle = np.array([box.x_m, box.y_m])
                taken = np.vstack([taken, [*(middle - half), *(middle + half)]])
            front_m = abs(float(forward @ [box.length_m, box.width_m]))
            along_m += front_m + scattered(13 * index, 2.0, 6.0)
    return tuple(boxes)


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
    """Return the point (x, y), meters, at less than `LONGEST_LOOK_M` ahead along the course."""
    leg, following = here.leg, here.after
    on_leg_m = here.rest_m + ahead_m
    is_beyond = on_leg_m >= leg.length_m
    on_leg_m = on_leg_m - leg.length_m if is_beyond else on_leg_m
    x_m, cos = (following.x_m, following.cos) if is_beyond else (leg.x_m, leg.cos)
    y_m, sin = (following.y_m, following.sin) if is_beyond else (leg.y_m, leg.sin)
    return x_m + on_leg_m * cos, y_m + on_leg_m * sin


@inlined
def course_project(x_m: float, y_m: float, from_m: float, to_m: float) -> Projection:
    """Return the course point nearest to (x_m, y_m) between two distances along the course."""
    # As `geometry.project`; the distances must differ by less than `LONGEST_LOOK_M`.
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
    """Return the nearest point's distance along the leg, squared distance, and offset."""
    dx, dy = x_m - leg.x_m, y_m - leg.y_m
    along_m = min(max(dx * leg.cos + dy * leg.sin, first_m), last_m)
    off_x, off_y = dx - along_m * leg.cos, dy - along_m * leg.sin
    return along_m, off_x * off_x + off_y * off_y, leg.cos * dy - leg.sin * dx


@inlined
def _at(lap_m: float, numbers: Eight) -> float:
    """Return the number of the leg at a distance."""
    # The compiler vectorizes comparisons, not lookups.
    number = numbers[1] if lap_m >= _ALONG_M[1] else numbers[0]
    number = numbers[2] if lap_m >= _ALONG_M[2] else number
    number = numbers[3] if lap_m >= _ALONG_M[3] else number
    number = numbers[4] if lap_m >= _ALONG_M[4] else number
    number = numbers[5] if lap_m >= _ALONG_M[5] else number
    number = numbers[6] if lap_m >= _ALONG_M[6] else number
    return numbers[7] if lap_m >= _ALONG_M[7] else number
