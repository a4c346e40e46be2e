"""Colors, shapes and motions that several sims use: ground, observations, and parts of cars.

The parts of a car are fixed to the frame `car`: x forward, y left, z up. `arc` moves a vehicle
between the two poses that a sim computes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.scene import Color, Frame, Kind, Shape, coarse, path, raised, yaw_rotation
from mcaprl.sims.geometry import wrap_angle

Vector = tuple[float, float, float]

WHITE: Color = (0.92, 0.92, 0.90, 1.0)
STEEL: Color = (0.66, 0.69, 0.72, 1.0)
GLASS: Color = (0.12, 0.17, 0.22, 1.0)
RUBBER: Color = (0.07, 0.07, 0.08, 1.0)
LAMP: Color = (1.0, 0.96, 0.78, 1.0)
TRAIL: Color = (0.20, 0.62, 0.95, 0.9)
RAY: Color = (0.98, 0.80, 0.28, 0.8)
LOOK: Color = (0.99, 0.55, 0.10, 1.0)
TAIL_LAMP: Color = (0.48, 0.02, 0.03, 1.0)

BORDER_PIECE_M = 3.0  # Length of the pieces of painted lines; see `cut`


def ground(color: Color, middle_m: tuple[float, float], size_m: tuple[float, float]) -> Shape:
    """Return a flat box just below z = 0, with the given center and edge lengths in x and y."""
    at = (float(middle_m[0]), float(middle_m[1]), -0.1)
    size = (float(size_m[0]), float(size_m[1]), 0.1)
    return Shape("ground", "box", color, size=size, position=at)


def label(speed_m_s: float, height_m: float, frame: str = "car") -> Shape:
    """Return a text shape named `speed` above the origin of a frame."""
    at, size, text = (0.0, 0.0, height_m), (1.0, 1.0, 0.4), f"{speed_m_s:.1f} m/s"
    return Shape("speed", "text", WHITE, size=size, position=at, frame=frame, text=text)


def trail(places_m: Sequence[tuple[float, ...]], width_m: float) -> Shape:
    """Return a line through the last positions in the map; at least one position is required."""
    return Shape("trail", "line", TRAIL, raised(path(places_m), 0.1), size=(width_m, 0.0, 0.0))


def lookahead(points_m: NDArray[np.float64]) -> Shape:
    """Return a shape that marks the path points (N, 2) in the agent's observation."""
    points = raised(coarse(points_m), 0.3)
    return Shape("lookahead", "spheres", LOOK, points, size=(0.6, 0.6, 0.6))


def rays(lines_m: NDArray[np.float64], car: Frame, height_m: float) -> tuple[Shape, Shape]:
    """Return distance rays (R, 2, 2) as lines, with dots at their ends."""
    # Dots and lines share one array of points, because repeated bytes compress well in logs.
    _, _, sin, cos = car.rotation
    turn = np.array([[cos * cos - sin * sin, -2 * sin * cos], [2 * sin * cos, cos**2 - sin**2]])
    points = raised(coarse((lines_m - np.array(car.position[:2])) @ turn), height_m)
    return (
        Shape("rays", "segments", RAY, points, size=(0.06, 0.0, 0.0), frame=car.name),
        Shape("hits", "spheres", LOOK, points, size=(0.3, 0.3, 0.3), frame=car.name),
    )


def steering_arrow(axle_m: float, wheel_rad: float) -> Shape:
    """Return an arrow above the front axle that points where the front wheels point."""
    axle = np.array([axle_m, 0.0, 1.0])
    tip = axle + 2.0 * np.array([math.cos(wheel_rad), math.sin(wheel_rad), 0.0])
    ends = np.array([axle, tip])
    return Shape("steering", "arrow", LOOK, ends, size=(0.12, 0.3, 0.4), frame="car")


def car_part(
    name: str, color: Color, size_m: Vector, middle_m: Vector, kind: Kind = "box"
) -> Shape:
    """Return a solid shape that is fixed to a car."""
    return Shape(f"car_{name}", kind, color, size=size_m, position=middle_m, frame="car")


def car_frame(x_m: float, y_m: float, yaw_rad: float) -> Frame:
    """Return the frame `car` for a car's pose in the map."""
    return Frame("car", (x_m, y_m, 0.0), yaw_rotation(yaw_rad))


def wheels(
    color: Color, front_m: float, rear_m: float, side_m: float, radius_m: float, width_m: float
) -> list[Shape]:
    """Return the four wheels of a car, with hubs at x = `front_m` or `rear_m`, y = +-`side_m`."""
    return [
        _wheel(f"{end}_{side}", color, (x_m, y_m, radius_m), radius_m, width_m)
        for end, x_m in (("front", front_m), ("rear", rear_m))
        for side, y_m in (("left", side_m), ("right", -side_m))
    ]


def _wheel(name: str, color: Color, hub_m: Vector, radius_m: float, width_m: float) -> Shape:
    """Return a wheel as triangles: the tread and both sides of a 16-gon."""
    turn = np.linspace(0.0, 2 * math.pi, 17)
    rim = radius_m * np.column_stack([np.cos(turn), np.zeros(17), np.sin(turn)])
    half = np.array([0.0, width_m / 2, 0.0])
    triangles = []
    for a, b in itertools.pairwise(rim):
        triangles += [a - half, b - half, b + half, a - half, b + half, a + half]
        triangles += [-half, b - half, a - half, half, a + half, b + half]
    points = np.array(hub_m) + np.array(triangles)
    return Shape(f"car_wheel_{name}", "triangles", color, points, frame="car")


LONGEST_S = 0.05  # Longest time between two drawn positions of a vehicle

Pose = tuple[float, float, float]  # x and y in meters, and yaw in radians


def arc(start: Pose, end: Pose, share: float) -> Pose:
    """Return a pose on the way from `start` to `end` at constant speed and yaw rate.

    The way is an arc with the turn angle w. Compare the chord of a fraction s of the arc with the
    chord of the whole arc: the ratio of their lengths is s sinc(s w / 2) / sinc(w / 2), and the
    angle between them is (s - 1) w / 2. Here, sinc(a) = sin(a) / a.
    """
    dx_m, dy_m = end[0] - start[0], end[1] - start[1]
    turn_rad = wrap_angle(end[2] - start[2])
    length = share * _sinc(share * turn_rad / 2) / _sinc(turn_rad / 2)
    aside_rad = (share - 1.0) * turn_rad / 2
    cos, sin = length * math.cos(aside_rad), length * math.sin(aside_rad)
    x_m, y_m = start[0] + cos * dx_m - sin * dy_m, start[1] + sin * dx_m + cos * dy_m
    return x_m, y_m, wrap_angle(start[2] + share * turn_rad)


def car_moments(start: Pose, end: Pose, duration_s: float) -> list[Sequence[Frame]]:
    """Return the car's poses on an arc, at equal intervals of at most 0.05 s up to the end."""
    count = math.ceil(duration_s / LONGEST_S - 1e-9)
    return [(car_frame(*arc(start, end, (1 + k) / count)),) for k in range(count)]


def _sinc(angle_rad: float) -> float:
    return math.sin(angle_rad) / angle_rad if abs(angle_rad) > 1e-6 else 1.0
