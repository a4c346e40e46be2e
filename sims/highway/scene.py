"""Courses along a highway-env road, and the scene: asphalt, lines, cars, and observations.

The frame `map` has x and y on the ground and z up. The frame `car` has its origin on the ground
under the car's center, x forward and y left.

In highway-env's images, y points down. In this module, y and all angles have the opposite sign, so
that z is up, angles are counter-clockwise, and left is positive.
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

Floats = NDArray[np.float64]

SAMPLE_M = 1.0
FLIP = np.array([1.0, -1.0])  # Factors that transform (x, y) of highway-env to ROS axes and back


class Place(NamedTuple):
    """Point of a course that is nearest to a position."""

    along_m: float
    offset_m: float
    """Distance of the position from the course, positive to the left of its direction."""
    yaw_rad: float  # Direction of the course at the nearest point


class Course(NamedTuple):
    """Center line of a lane from one end of the road to the other, or around a closed road."""

    points_m: Floats
    """(N + 1, 2) points about 1 m apart; on a closed course, the last point equals the first."""
    along_m: Floats  # (N + 1,) distance of each point from the first, along the course
    lengths_m: Floats  # (N,) lengths of the legs from each point to the next
    directions: Floats  # (2, N) cosines and sines of the legs' directions
    half_width_m: float
    is_closed: bool

    @property
    def length_m(self) -> float:
        """Distance from the first point to the last, along the course."""
        return float(self.along_m[-1])

    def nearest(self, x_m: float, y_m: float) -> Place:
        """Return the point of the course that is nearest to a position."""
        dx_m, dy_m = x_m - self.points_m[:-1, 0], y_m - self.points_m[:-1, 1]
        cos, sin = self.directions
        along_m = np.clip(dx_m * cos + dy_m * sin, 0.0, self.lengths_m)
        squares = (dx_m - along_m * cos) ** 2 + (dy_m - along_m * sin) ** 2
        leg = int(np.argmin(squares))
        side = 1.0 if cos[leg] * dy_m[leg] >= sin[leg] * dx_m[leg] else -1.0
        return Place(
            along_m=float(self.along_m[leg] + along_m[leg]),
            offset_m=side * math.sqrt(squares[leg]),
            yaw_rad=math.atan2(sin[leg], cos[leg]),
        )

    def point(self, along_m: float) -> tuple[float, float]:
        """Return (x, y) at a distance along the course; it goes straight on at an open end."""
        x_m, y_m = self.points_m.T
        if self.is_closed:
            along_m %= self.length_m
        beyond_m = max(0.0, along_m - self.length_m)
        cos, sin = self.directions[:, -1].tolist()
        return (
            float(np.interp(along_m, self.along_m, x_m)) + beyond_m * cos,
            float(np.interp(along_m, self.along_m, y_m)) + beyond_m * sin,
        )


def courses_of(network: Any) -> tuple[Course, ...]:
    """Return the courses of a road: one for each parallel lane."""
    edges = list(_lanes_between(network.graph))
    return tuple(
        _course([lanes[number] for _, _, lanes in edges], edges[0][0] == edges[-1][1])
        for number in range(len(edges[0][2]))
    )


def _lanes_between(graph: dict[str, dict[str, list[Any]]]) -> Iterator[tuple[str, str, list[Any]]]:
    """Yield start node, end node and lanes of each edge, in the direction of travel."""
    # The first edge starts at the node without a predecessor; of a closed road, at the first node.
    reached = {end for ends in graph.values() for end in ends}
    first = next((node for node in graph if node not in reached), next(iter(graph)))
    node, is_new = first, True
    while node in graph and (is_new or node != first):
        end, lanes = next(iter(graph[node].items()))
        yield node, end, lanes
        node, is_new = end, False


def _course(lanes: list[Any], is_closed: bool) -> Course:
    points: list[Floats] = []
    for lane in lanes:
        # A lane may overlap the previous lane. Its samples begin where the previous lane ends.
        first_m = lane.local_coordinates(points[-1] * FLIP)[0] if points else 0.0
        count = int(np.ceil((lane.length - first_m) / SAMPLE_M))
        sampled = np.linspace(max(0.0, first_m), lane.length, count + 1)
        points += [lane.position(along_m, 0.0) * FLIP for along_m in sampled[bool(points) :]]
    if is_closed:
        # The last lane may end beyond the start of the first lane.
        while lanes[0].local_coordinates(points[-1] * FLIP)[0] > -SAMPLE_M / 2:
            points.pop()
        points.append(points[0])
    corners = np.array(points)
    legs = np.diff(corners, axis=0)
    lengths_m = np.hypot(legs[:, 0], legs[:, 1])
    along_m = np.concatenate([[0.0], np.cumsum(lengths_m)])
    half_width_m = lanes[0].width / 2
    return Course(
        corners, along_m, lengths_m, (legs / lengths_m[:, None]).T, half_width_m, is_closed
    )


GRASS: Color = (0.33, 0.43, 0.34, 1.0)
ASPHALT: Color = (0.22, 0.23, 0.25, 1.0)
PAINT: Color = (0.13, 0.55, 0.47, 1.0)
OTHER_PAINT: Color = (0.86, 0.62, 0.16, 1.0)

MARGIN_M = 60.0  # Width of the grass around the road
CAR_HEIGHT_M = 1.4
PIECE_M = 3.0
"""Approximate length of the pieces of lanes and lines; dashed lines omit every second piece."""
STRIPED, CONTINUOUS = 1, 2  # Values of highway-env's `LineType`


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
    """Return the shapes that never change."""
    points_m = np.concatenate([course.points_m for course in courses])
    low, high = points_m.min(axis=0) - MARGIN_M, points_m.max(axis=0) + MARGIN_M
    return (
        shapes.ground(GRASS, (low + high) / 2, high - low),
        Shape("road", "triangles", ASPHALT, raised(_asphalt(network), 0.0)),
        Shape("lines", "segments", WHITE, raised(_lines(network), 0.02), size=(0.15, 0.0, 0.0)),
        *_own_car(),
    )


def _sides(network: Any) -> Iterator[tuple[Any, Floats, Floats]]:
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
    for _, left, right in _sides(network):
        first = np.stack([right[:-1], right[1:], left[1:]], axis=1)
        second = np.stack([right[:-1], left[1:], left[:-1]], axis=1)
        strips += [first, second]
    return np.concatenate(strips)


def _lines(network: Any) -> Floats:
    """Return the painted lines as pairs of points, (S, 2, 2)."""
    pieces = []
    for lane, *sides in _sides(network):
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
