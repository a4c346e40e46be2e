"""Course of the lane sim: its path, its streets, and the rails, barriers and houses beside them.

The path is 1,026 m long. It consists of two squares of about 130 m that share a leg; the first is
driven clockwise, the second counter-clockwise. Coordinates are right-handed with z up. The sign of
y is opposite to the published course, so that right turns remain right turns. The course is the
same on every machine.
"""

from __future__ import annotations

import functools
import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.geometry.paths import closed_path, scattered

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
RAIL_OFFSET_M = 4.0
"""Distance from the center line to the inner faces of the rails."""
RAIL_HEIGHT_M = 0.7
RAIL_THICKNESS_M = 0.12
BARRIER_HEIGHT_M = 3.0
"""Height of the barriers, which is above the camera."""
GROUND_HALF_SIDE_M = 1000.0
"""Half of the ground's side; large enough to cover the last row of pixels below the horizon."""

CAMERA_FORWARD_M = 0.4
"""Distance of the camera from the middle of the wheelbase, the origin of the car's frame."""
CAMERA_HEIGHT_M = 1.4

HOUSE_GAP_M = 1.0
"""Minimum distance between houses."""


class Box(NamedTuple):
    """Axis-aligned box on the ground, meters; x and y are the coordinates of its center."""

    x_m: float
    y_m: float
    length_m: float
    width_m: float
    height_m: float


def streets() -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return the start point and the end point of each leg, (2,) each, meters.

    The leg that belongs to both squares of the course is listed once.
    """
    legs = {tuple(sorted(ends)) for ends in itertools.pairwise(CORNERS_M)}
    return [(np.array(start), np.array(end)) for start, end in sorted(legs)]


def street_bounds(half_width_m: float) -> NDArray[np.float64]:
    """Return the streets as (K, 4) rectangles x0, y0, x1, y1, meters.

    Each rectangle extends `half_width_m` beyond both ends of the street's leg.
    """
    ends = np.array(streets())
    return np.hstack([ends.min(axis=1) - half_width_m, ends.max(axis=1) + half_width_m])


def pavement(
    half_width_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Divide the ground into a grid whose lines pass through the edges of all streets.

    Returns:
        (M + 1,) x and (N + 1,) y of the grid lines, and a mask (M, N) of the cells on a street.
    """
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
    """Return the barriers for a car on the first square, and those for a car on the second.

    Both ends of the shared leg are crossings. Barriers close the streets of the other square there,
    so that the street to take is visible. Without the barriers, the shared leg would look the same
    on both squares, but the car must turn right at its end on the first square, and left on the
    second.
    """
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
    """Return a house; `index` determines its size and its distance from the street.

    The house's front begins beside the point `at` (2,) on the center line. `forward` is the unit
    vector along the street, and `left` is the unit vector from the street to the house.
    """
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
