"""Courses along a highway-env road: chains of consecutive lanes, in ROS axes.

In highway-env's images, y points down. In this module, y and all angles have the opposite sign, so
that z is up, angles are counter-clockwise, and left is positive.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SAMPLE_M = 1.0
FLIP = np.array([1.0, -1.0])
"""Factors that transform (x, y) of highway-env to ROS axes and back."""


class Place(NamedTuple):
    """Point of a course that is nearest to a position."""

    along_m: float
    offset_m: float
    """Distance of the position from the course, positive to the left of its direction."""
    yaw_rad: float
    """Direction of the course at the nearest point."""


class Course(NamedTuple):
    """Center line of a lane from one end of the road to the other, or around a closed road."""

    points_m: Floats
    """(N + 1, 2) points about 1 m apart; on a closed course, the last point equals the first."""
    along_m: Floats
    """(N + 1,) distance of each point from the first, along the course."""
    lengths_m: Floats
    """(N,) lengths of the legs from each point to the next."""
    directions: Floats
    """(2, N) cosines and sines of the legs' directions."""
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
        """Return the point (x, y) at a distance along the course.

        Beyond an open end, the course continues straight.
        """
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
    edges = list(_edges(network.graph))
    return tuple(
        _course([lanes[number] for _, _, lanes in edges], edges[0][0] == edges[-1][1])
        for number in range(len(edges[0][2]))
    )


def _edges(graph: dict[str, dict[str, list[Any]]]) -> Iterator[tuple[str, str, list[Any]]]:
    """Yield start node, end node and lanes of each edge, in the direction of travel.

    The first edge starts at the node without a predecessor. A closed road has no such node; its
    first edge starts at the first node of the graph.
    """
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
