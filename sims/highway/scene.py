"""What a 3D viewer shows of a road of highway-env: asphalt, lines, cars, and where one looks.

Frames: `map` (x and y on the ground, z up) and `car` (on the ground under the car's middle, x
forward, y left).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.car_parts import part, wheel
from mcaprl.sims.drawing.scene import Color, Frame, Shape, raised, yaw_rotation
from mcaprl.sims.highway.course import FLIP, Course

Floats = NDArray[np.float64]

GRASS: Color = (0.33, 0.43, 0.34, 1.0)
ASPHALT: Color = (0.22, 0.23, 0.25, 1.0)
WHITE: Color = (0.92, 0.92, 0.90, 1.0)
PAINT: Color = (0.13, 0.55, 0.47, 1.0)
OTHER_PAINT: Color = (0.86, 0.62, 0.16, 1.0)
GLASS: Color = (0.12, 0.17, 0.22, 1.0)
RUBBER: Color = (0.07, 0.07, 0.08, 1.0)
LAMP: Color = (1.0, 0.96, 0.78, 1.0)
TRAIL: Color = (0.20, 0.62, 0.95, 0.9)
LOOK: Color = (0.99, 0.55, 0.10, 1.0)

MARGIN_M = 60.0
"""Of grass around the road."""
CAR_HEIGHT_M = 1.4
DASH_SAMPLES, DASH_PERIOD = 3, 6
"""A dashed line is drawn for 3 of 6 pieces of about 1 m."""
STRIPED, CONTINUOUS = 1, 2
"""Numbers of highway-env's `LineType`; its other kinds are drawn as they are named."""


class Car(NamedTuple):
    """A car on the road, by its middle."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_m_s: float
    length_m: float
    width_m: float

    def sees(self, point_m: tuple[float, float]) -> tuple[float, float]:
        """Give where a point of the map is from here: (forward, left), metres."""
        dx_m, dy_m = point_m[0] - self.x_m, point_m[1] - self.y_m
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return dx_m * cos + dy_m * sin, dy_m * cos - dx_m * sin


def static_shapes(network: Any, courses: Sequence[Course]) -> tuple[Shape, ...]:
    """Give what never changes: the world in `map`, and the car's parts in `car`.

    Args:
        network: the `highway_env.road.road.RoadNetwork`.
        courses: along it.
    """
    points_m = np.concatenate([course.points_m for course in courses])
    low, high = points_m.min(axis=0) - MARGIN_M, points_m.max(axis=0) + MARGIN_M
    middle = (low + high) / 2
    return (
        Shape(
            name="ground",
            kind="box",
            color=GRASS,
            size=(float(high[0] - low[0]), float(high[1] - low[1]), 0.1),
            position=(float(middle[0]), float(middle[1]), -0.1),
        ),
        Shape("road", "triangles", ASPHALT, raised(_asphalt(network), 0.0)),
        Shape("lines", "segments", WHITE, raised(_lines(network), 0.02), size=(0.15, 0.0, 0.0)),
        *_own_car(),
    )


def _edges(network: Any) -> Iterator[tuple[Any, Floats, Floats]]:
    """Give each lane with its left and right edge, (N, 2) in the map, samples about 1 m apart."""
    for lane in network.lanes_list():
        along_m = np.linspace(0.0, lane.length, 2 + int(lane.length))
        half_m = [lane.width_at(each) / 2 for each in along_m]
        # Their left is on the negative side.
        sides = [
            np.array([lane.position(s, sign * h) for s, h in zip(along_m, half_m, strict=True)])
            for sign in (-1.0, 1.0)
        ]
        yield lane, sides[0] * FLIP, sides[1] * FLIP


def _asphalt(network: Any) -> Floats:
    """Cover the lanes with triangles, (T, 3, 2)."""
    strips = []
    for _, left, right in _edges(network):
        first = np.stack([right[:-1], right[1:], left[1:]], axis=1)
        second = np.stack([right[:-1], left[1:], left[:-1]], axis=1)
        strips += [first, second]
    return np.concatenate(strips)


def _lines(network: Any) -> Floats:
    """Give the painted lines as pairs of points, (S, 2, 2)."""
    pieces = []
    for lane, *sides in _edges(network):
        for line, points in zip(lane.line_types, sides, strict=True):
            pairs = np.stack([points[:-1], points[1:]], axis=1)
            if line == STRIPED:
                pairs = pairs[np.arange(len(pairs)) % DASH_PERIOD < DASH_SAMPLES]
            if line >= STRIPED:
                pieces.append(pairs)
    return np.concatenate(pieces)


def _own_car() -> list[Shape]:
    wheels = {
        "front_left": (1.5, 0.85),
        "front_right": (1.5, -0.85),
        "rear_left": (-1.5, 0.85),
        "rear_right": (-1.5, -0.85),
    }
    return [
        part("body", PAINT, (5.0, 1.9, 0.55), (0.0, 0.0, 0.6)),
        part("cabin", GLASS, (2.5, 1.65, 0.45), (-0.35, 0.0, 1.1)),
        part("roof", PAINT, (2.0, 1.6, 0.08), (-0.4, 0.0, CAR_HEIGHT_M - 0.04)),
        part("lamp_left", LAMP, (0.08, 0.4, 0.16), (2.5, 0.68, 0.66)),
        part("lamp_right", LAMP, (0.08, 0.4, 0.16), (2.5, -0.68, 0.66)),
        *(wheel(name, RUBBER, (x_m, y_m, 0.34), 0.34, 0.26) for name, (x_m, y_m) in wheels.items()),
    ]


def moving_shapes(
    car: Car,
    others: Sequence[Car],
    trail_m: Sequence[tuple[float, float]],
    aims_m: Sequence[tuple[float, float]],
    steering_rad: float,
) -> tuple[Shape, ...]:
    """Give what changes with each step.

    Args:
        car: that is driven.
        others: that are not.
        trail_m: the last positions of the car, (x, y) in the map; at least one.
        aims_m: points of the lane ahead that the agent sees.
        steering_rad: of the front wheels, left positive.
    """
    trail = np.array([*trail_m, trail_m[-1]])
    axle = np.array([1.5, 0.0, 1.0])
    tip = axle + 2.0 * np.array([math.cos(steering_rad), math.sin(steering_rad), 0.0])
    return (
        Shape("trail", "line", TRAIL, raised(trail, 0.06), size=(0.25, 0.0, 0.0)),
        Shape("lookahead", "points", LOOK, raised(np.array(aims_m), 0.3), size=(0.6, 0.6, 0.6)),
        Shape("steering", "arrow", LOOK, np.array([axle, tip]), size=(0.12, 0.3, 0.4), frame="car"),
        Shape(
            name="speed",
            kind="text",
            color=WHITE,
            size=(1.0, 1.0, 0.8),
            position=(0.0, 0.0, 2.4),
            frame="car",
            text=f"{car.speed_m_s:.1f} m/s",
        ),
        *(_other_car(f"other_{number}", other) for number, other in enumerate(others)),
    )


def _other_car(name: str, car: Car) -> Shape:
    return Shape(
        name=name,
        kind="box",
        color=OTHER_PAINT,
        size=(car.length_m, car.width_m, CAR_HEIGHT_M),
        position=(car.x_m, car.y_m, CAR_HEIGHT_M / 2),
        yaw_rad=car.yaw_rad,
    )


def car_frame(car: Car) -> Frame:
    """Give the car's frame in the map."""
    return Frame("car", (car.x_m, car.y_m, 0.0), yaw_rotation(car.yaw_rad))
