"""Scene of the lane sim: streets, rails, houses, the car and its observations.

The frame `map` has x and y on the ground and z up. The frame `car` has its origin on the ground
under the middle of the wheelbase, x forward and y left. The frame `camera` has ROS optical axes: x
right, y down, z forward.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing import shapes
from mcaprl.sims.drawing.scene import Color, Frame, Shape, coarse, cut, raised
from mcaprl.sims.drawing.shapes import LOOK, TAIL_LAMP, WHITE, car_part
from mcaprl.sims.geometry import point_at
from mcaprl.sims.lane import course
from mcaprl.sims.lane.rays import BODY_FORWARD_M, BODY_LENGTH_M, BODY_WIDTH_M, ray_lines, world_at
from mcaprl.sims.lane.rules import LOOKAHEADS_M, WHEELBASE_M, Car, wheel_angle

GRASS: Color = (0.36, 0.44, 0.33, 1.0)
ASPHALT: Color = (0.21, 0.22, 0.24, 1.0)
YELLOW: Color = (0.93, 0.76, 0.22, 1.0)
BARRIER: Color = (0.85, 0.35, 0.12, 1.0)
PAINT: Color = (0.83, 0.18, 0.16, 1.0)
WALLS: tuple[Color, ...] = (
    (0.80, 0.73, 0.63, 1.0),
    (0.69, 0.48, 0.39, 1.0),
    (0.60, 0.64, 0.69, 1.0),
    (0.86, 0.83, 0.77, 1.0),
    (0.47, 0.53, 0.59, 1.0),
)

WHEEL_RADIUS_M = 0.34
WHEEL_WIDTH_M = 0.24
TRACK_M = 1.6
DASH_M = 3.0


def _asphalt() -> NDArray[np.float64]:
    """Return the corners (6 C, 3) of the triangles of C paved cells, two triangles per cell."""
    x_m, y_m, paved = course.pavement(course.RAIL_OFFSET_M)
    corners = []
    for i, j in np.argwhere(paved):
        low, right = (x_m[i], y_m[j]), (x_m[i + 1], y_m[j])
        left, high = (x_m[i], y_m[j + 1]), (x_m[i + 1], y_m[j + 1])
        corners += [low, right, high, low, high, left]
    return raised(np.array(corners), 0.0)


def _dashes() -> NDArray[np.float64]:
    """Return the dashes of the center line; the points (N, 3) are start, end, start, end, ..."""
    pairs = []
    for start, end in course.streets():
        length_m = float(np.hypot(*(end - start)))
        forward = (end - start) / length_m
        for along_m in np.arange(DASH_M, length_m - DASH_M, 2 * DASH_M):
            pairs += [start + forward * along_m, start + forward * (along_m + DASH_M)]
    return raised(np.array(pairs), 0.02)


def _road() -> list[Shape]:
    side_m = 420.0
    middle = course.COURSE.points_m.mean(axis=0)
    borders = raised(course.outline(course.LANE_HALF_WIDTH_M), 0.02)
    borders = cut(borders, shapes.BORDER_PIECE_M)
    return [
        shapes.ground(GRASS, middle, (side_m, side_m)),
        Shape("road", "triangles", ASPHALT, _asphalt()),
        Shape("lane_borders", "segments", WHITE, borders, size=(0.15, 0.0, 0.0)),
        Shape("center_line", "segments", YELLOW, _dashes(), size=(0.12, 0.0, 0.0)),
    ]


def _upright(name: str, box: course.Box, color: Color) -> Shape:
    size, at = (box.length_m, box.width_m, box.height_m), (box.x_m, box.y_m, box.height_m / 2)
    return Shape(name, "box", color, size=size, position=at)


def _surroundings() -> list[Shape]:
    rails, houses = enumerate(course.rails()), enumerate(course.buildings())
    return [
        *(_upright(f"rail_{i}", box, shapes.STEEL) for i, box in rails),
        *(_upright(f"building_{i}", box, WALLS[i % len(WALLS)]) for i, box in houses),
    ]


def _car() -> list[Shape]:
    axle_m, side_m = WHEELBASE_M / 2, TRACK_M / 2
    return [
        car_part("body", PAINT, (BODY_LENGTH_M, BODY_WIDTH_M, 0.5), (BODY_FORWARD_M, 0.0, 0.58)),
        car_part("bonnet", PAINT, (1.2, 1.65, 0.12), (1.45, 0.0, 0.88)),
        car_part("cabin", shapes.GLASS, (2.1, 1.5, 0.5), (-0.35, 0.0, 1.08)),
        car_part("roof", PAINT, (1.7, 1.45, 0.08), (-0.40, 0.0, 1.36)),
        car_part("lamp_left", shapes.LAMP, (0.08, 0.35, 0.15), (2.2, 0.62, 0.66)),
        car_part("lamp_right", shapes.LAMP, (0.08, 0.35, 0.15), (2.2, -0.62, 0.66)),
        car_part("tail_left", TAIL_LAMP, (0.08, 0.3, 0.15), (-2.12, 0.62, 0.68)),
        car_part("tail_right", TAIL_LAMP, (0.08, 0.3, 0.15), (-2.12, -0.62, 0.68)),
        *shapes.wheels(shapes.RUBBER, axle_m, -axle_m, side_m, WHEEL_RADIUS_M, WHEEL_WIDTH_M),
    ]


@functools.cache
def static_shapes() -> tuple[Shape, ...]:
    """Return the shapes that never change."""
    return (*_road(), *_surroundings(), *_car())


def moving_shapes(
    car: Car, trail_m: Sequence[tuple[float, ...]], *, has_rays: bool, has_barriers: bool
) -> tuple[Shape, ...]:
    """Return the shapes that change with each step, with rays and barriers if there are any."""
    aims = np.array([point_at(course.COURSE, car.along_m + ahead) for ahead in LOOKAHEADS_M])
    nearest = point_at(course.COURSE, car.along_m)
    link = coarse(np.array([(car.x_m, car.y_m), nearest]))
    wheel_rad = wheel_angle(car.steering, car.speed_m_s)
    seen: tuple[Shape, ...] = (
        shapes.trail(trail_m, 0.25),
        shapes.lookahead(aims),
        Shape("offset", "line", LOOK, raised(link, 0.08), size=(0.12, 0.0, 0.0)),
        shapes.steering_arrow(WHEELBASE_M / 2, wheel_rad),
        shapes.label(car.speed_m_s, 2.8),
    )
    if has_barriers:
        closed = enumerate(course.barriers()[world_at(car.along_m) - 1])
        seen = (*seen, *(_upright(f"barrier_{i}", box, BARRIER) for i, box in closed))
    if not has_rays:
        return seen
    frame = shapes.car_frame(car.x_m, car.y_m, car.yaw_rad)
    return (*seen, *shapes.rays(ray_lines(car, has_barriers), frame, 0.75))


def camera_frame() -> Frame:
    """Return the front camera's frame in the car: optical axes, level, facing forward."""
    at = (course.CAMERA_FORWARD_M, 0.0, course.CAMERA_HEIGHT_M)
    return Frame("camera", at, (-0.5, 0.5, -0.5, 0.5), parent="car")
