"""Scene of the highway-lane sim: asphalt, lines, cars, and the agent's observations.

The frame `map` has x and y on the ground and z up. The frame `car` has its origin on the ground
under the car's center, x forward and y left.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing import shapes
from mcaprl.sims.drawing.scene import Color, Shape, raised
from mcaprl.sims.drawing.shapes import LAMP, TAIL_LAMP, WHITE, car_part
from mcaprl.sims.highway.course import FLIP, Course

Floats = NDArray[np.float64]

GRASS: Color = (0.33, 0.43, 0.34, 1.0)
ASPHALT: Color = (0.22, 0.23, 0.25, 1.0)
PAINT: Color = (0.13, 0.55, 0.47, 1.0)
OTHER_PAINT: Color = (0.86, 0.62, 0.16, 1.0)

MARGIN_M = 60.0
"""Width of the grass around the road."""
CAR_HEIGHT_M = 1.4
PIECE_M = 3.0
"""Approximate length of the pieces of lanes and lines; dashed lines omit every second piece."""
STRIPED, CONTINUOUS = 1, 2
"""Values of highway-env's `LineType`."""


class Car(NamedTuple):
    """State and size of a car; x and y are the position of its center."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_m_s: float
    length_m: float
    width_m: float

    @property
    def pose(self) -> tuple[float, float, float]:
        """Position x and y in meters, and yaw in radians."""
        return self.x_m, self.y_m, self.yaw_rad

    def to_body_frame(self, point_m: tuple[float, float]) -> tuple[float, float]:
        """Transform a map point into this car's frame: (forward, left), meters."""
        dx_m, dy_m = point_m[0] - self.x_m, point_m[1] - self.y_m
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return dx_m * cos + dy_m * sin, dy_m * cos - dx_m * sin


def static_shapes(network: Any, courses: Sequence[Course]) -> tuple[Shape, ...]:
    """Return the shapes that never change.

    The world is in the frame `map`, and the parts of the car are in the frame `car`.
    """
    points_m = np.concatenate([course.points_m for course in courses])
    low, high = points_m.min(axis=0) - MARGIN_M, points_m.max(axis=0) + MARGIN_M
    return (
        shapes.ground(GRASS, (low + high) / 2, high - low),
        Shape("road", "triangles", ASPHALT, raised(_asphalt(network), 0.0)),
        Shape("lines", "segments", WHITE, raised(_lines(network), 0.02), size=(0.15, 0.0, 0.0)),
        *_own_car(),
    )


def _edges(network: Any) -> Iterator[tuple[Any, Floats, Floats]]:
    """Yield each lane and its two edges, left first: (N, 2) points in the map, about 3 m apart."""
    for lane in network.lanes_list():
        along_m = np.linspace(0.0, lane.length, 2 + int(lane.length / PIECE_M))
        half_m = [lane.width_at(each) / 2 for each in along_m]
        # In highway-env, lateral distances to the left are negative.
        sides = [
            np.array([lane.position(s, sign * h) for s, h in zip(along_m, half_m, strict=True)])
            for sign in (-1.0, 1.0)
        ]
        yield lane, sides[0] * FLIP, sides[1] * FLIP


def _asphalt(network: Any) -> Floats:
    """Return triangles that cover the lanes, (T, 3, 2)."""
    strips = []
    for _, left, right in _edges(network):
        first = np.stack([right[:-1], right[1:], left[1:]], axis=1)
        second = np.stack([right[:-1], left[1:], left[:-1]], axis=1)
        strips += [first, second]
    return np.concatenate(strips)


def _lines(network: Any) -> Floats:
    """Return the painted lines as pairs of points, (S, 2, 2)."""
    pieces = []
    for lane, *sides in _edges(network):
        for line, points in zip(lane.line_types, sides, strict=True):
            pairs = np.stack([points[:-1], points[1:]], axis=1)
            if line == STRIPED:
                pairs = pairs[::2]
            if line >= STRIPED:
                pieces.append(pairs)
    return np.concatenate(pieces)


def _own_car() -> list[Shape]:
    return [
        car_part("body", PAINT, (5.0, 1.9, 0.55), (0.0, 0.0, 0.6)),
        car_part("cabin", shapes.GLASS, (2.5, 1.65, 0.45), (-0.35, 0.0, 1.1)),
        car_part("roof", PAINT, (2.0, 1.6, 0.08), (-0.4, 0.0, CAR_HEIGHT_M - 0.04)),
        car_part("lamp_left", LAMP, (0.08, 0.4, 0.16), (2.5, 0.68, 0.66)),
        car_part("lamp_right", LAMP, (0.08, 0.4, 0.16), (2.5, -0.68, 0.66)),
        car_part("tail_left", TAIL_LAMP, (0.08, 0.35, 0.16), (-2.5, 0.72, 0.68)),
        car_part("tail_right", TAIL_LAMP, (0.08, 0.35, 0.16), (-2.5, -0.72, 0.68)),
        *shapes.wheels(shapes.RUBBER, 1.5, -1.5, 0.85, 0.34, 0.26),
    ]


def moving_shapes(
    car: Car,
    others: Sequence[Car],
    trail_m: Sequence[tuple[float, float]],
    aims_m: Sequence[tuple[float, float]],
    steering_rad: float,
) -> tuple[Shape, ...]:
    """Return the shapes that change with each step; `aims_m` are the observed lane points."""
    return (
        shapes.trail(trail_m, 0.25),
        shapes.lookahead(np.array(aims_m)),
        shapes.steering_arrow(1.5, steering_rad),
        shapes.label(car.speed_m_s, 2.8),
        *(_other_car(f"other_{number}", other) for number, other in enumerate(others)),
    )


def _other_car(name: str, car: Car) -> Shape:
    size, at = (car.length_m, car.width_m, CAR_HEIGHT_M), (car.x_m, car.y_m, CAR_HEIGHT_M / 2)
    return Shape(name, "box", OTHER_PAINT, size=size, position=at, yaw_rad=car.yaw_rad)
