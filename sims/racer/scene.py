"""Scene of the racer sim (track, walls, gates, the car and its rays), and its top view.

Frames: `map` (x and y on the ground, z up) and `car` (on the ground under the car's middle, x
forward, y left). The rules use pixels; the scene draws a pixel as 0.1 m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing import shapes
from mcaprl.sims.drawing.scene import Color, Frame, Shape, cut, raised
from mcaprl.sims.drawing.shapes import car_part
from mcaprl.sims.drawing.top_view import Canvas, Patch, Rgb, patches, placed
from mcaprl.sims.racer.course import (
    IMAGE_HEIGHT_PX,
    IMAGE_WIDTH_PX,
    METERS_PER_PX,
    Car,
    Track,
    asphalt,
    to_map,
)
from mcaprl.sims.racer.rays import ray_ends
from mcaprl.sims.racer.rules import STEP_S, Command, speed_of

Floats = NDArray[np.float64]

GRASS: Color = (0.33, 0.45, 0.32, 1.0)
ASPHALT: Color = (0.23, 0.24, 0.26, 1.0)
WHITE: Color = (0.93, 0.93, 0.91, 1.0)
RED: Color = (0.80, 0.20, 0.17, 1.0)
GATE: Color = (0.42, 0.45, 0.48, 1.0)
NEXT_GATE: Color = (0.25, 0.85, 0.42, 1.0)
PAINT: Color = (0.12, 0.36, 0.84, 1.0)
CARBON: Color = (0.10, 0.10, 0.12, 1.0)
RUBBER: Color = (0.05, 0.05, 0.06, 1.0)
HELMET: Color = (0.97, 0.88, 0.30, 1.0)

WALL_HEIGHT_M, WALL_THICKNESS_M = 0.6, 0.3
WHEEL_RADIUS_M, WHEEL_WIDTH_M = 0.3, 0.26


def _wall(index: int, ends_m: Floats) -> Shape:
    """Return the wall between two points (2, 2); odd and even walls have different colors."""
    along, middle = ends_m[1] - ends_m[0], ends_m.mean(axis=0)
    size = (float(np.hypot(*along)) + WALL_THICKNESS_M, WALL_THICKNESS_M, WALL_HEIGHT_M)
    at = (float(middle[0]), float(middle[1]), WALL_HEIGHT_M / 2)
    color, yaw_rad = RED if index % 2 else WHITE, math.atan2(along[1], along[0])
    return Shape(f"wall_{index}", "box", color, size=size, position=at, yaw_rad=yaw_rad)


def _car() -> list[Shape]:
    return [
        car_part("floor", CARBON, (2.0, 0.9, 0.10), (-0.2, 0.0, 0.16)),
        car_part("body", PAINT, (2.1, 0.5, 0.32), (-0.35, 0.0, 0.37)),
        car_part("pods", PAINT, (0.9, 0.86, 0.24), (-0.3, 0.0, 0.33)),
        car_part("nose", PAINT, (0.8, 0.26, 0.18), (1.05, 0.0, 0.32)),
        car_part("front_wing", WHITE, (0.28, 1.4, 0.06), (1.36, 0.0, 0.16)),
        car_part("rear_wing", WHITE, (0.26, 1.1, 0.08), (-1.37, 0.0, 0.80)),
        car_part("rear_wing_left", CARBON, (0.3, 0.05, 0.45), (-1.35, 0.55, 0.62)),
        car_part("rear_wing_right", CARBON, (0.3, 0.05, 0.45), (-1.35, -0.55, 0.62)),
        car_part("helmet", HELMET, (0.44, 0.44, 0.44), (0.0, 0.0, 0.62), "sphere"),
        *shapes.wheels(RUBBER, 0.95, -1.0, 0.55, WHEEL_RADIUS_M, WHEEL_WIDTH_M),
    ]


def static_shapes(track: Track) -> tuple[Shape, ...]:
    """Return the shapes that never change: the world in `map`, the car's parts in `car`."""
    walls_m = to_map(track.walls_px.reshape(-1, 2, 2))
    gates_m = to_map(track.gates_px.reshape(-1, 2, 2))
    width_m, height_m = IMAGE_WIDTH_PX * METERS_PER_PX, IMAGE_HEIGHT_PX * METERS_PER_PX
    return (
        shapes.ground(GRASS, (width_m / 2, height_m / 2), (width_m, height_m)),
        Shape("road", "triangles", ASPHALT, raised(to_map(asphalt(track)), 0.0)),
        Shape("gates", "segments", GATE, cut(raised(gates_m, 0.02), 4.0), size=(0.15, 0.0, 0.0)),
        *(_wall(index, ends_m) for index, ends_m in enumerate(walls_m)),
        *_car(),
    )


def moving_shapes(
    track: Track, car: Car, trail_m: Sequence[tuple[float, ...]]
) -> tuple[Shape, ...]:
    """Return the shapes that change with each step."""
    gate_m = to_map(track.gates_px[int(car.next_gate)].reshape(2, 2))
    rays_m = to_map(ray_ends(track.walls_px, car))
    return (
        shapes.trail(trail_m, 0.15),
        Shape("next_gate", "segments", NEXT_GATE, raised(gate_m, 0.04), size=(0.35, 0.0, 0.0)),
        # The rays are drawn above the walls, so that the ends of the rays are visible.
        *shapes.rays(rays_m, car_frame(car), WALL_HEIGHT_M + 0.025),
        shapes.label(speed_of(car), 2.5),
    )


def pose_of(car: Car) -> tuple[float, float, float]:
    """Return the car's x, y and yaw in the map, meters and radians."""
    height_px = IMAGE_HEIGHT_PX - car.y_px
    return METERS_PER_PX * car.x_px, METERS_PER_PX * height_px, -car.heading_rad


def car_frame(car: Car) -> Frame:
    """Return the car's frame in the map."""
    return shapes.car_frame(*pose_of(car))


INK: Rgb = (255, 255, 255)
PRESSED: Rgb = (64, 217, 107)
PANEL_PX = (765, 18)
KEY_PX = 32
_KEYS = {"forward": (1, 0), "left": (0, 1), "back": (1, 1), "right": (2, 1)}
"""Column and row of each key."""
_ARROWS = {"forward": (0, -1), "left": (-1, 0), "back": (0, 1), "right": (1, 0)}
"""Direction of the arrow on each key: components to the right and down."""


class RacerView:
    """Renderer of one image per step, shown in a window in mode `human`."""

    def __init__(self, render_mode: Literal["human", "rgb_array"], track: Track) -> None:
        """Prepare the shapes that never change."""
        size_px = (IMAGE_WIDTH_PX, IMAGE_HEIGHT_PX)
        self._canvas = Canvas(render_mode, size_px, "mcaprl racer", round(1 / STEP_S))
        self._track = track
        self._static = patches(static_shapes(track))

    def draw(
        self, car: Car, trail_m: Sequence[tuple[float, ...]], command: Command
    ) -> NDArray[np.uint8]:
        """Render the track, the car and its last command, (600, 1000, 3)."""
        moving = patches(moving_shapes(self._track, car, trail_m))
        for patch in sorted([*self._static, *moving], key=lambda each: each.top_m):
            self._fill(patch, car)
        self._canvas.flatten()
        self._write(car)
        self._draw_keys(command)
        return self._canvas.finish()

    def close(self) -> None:
        """Close the window."""
        self._canvas.close()

    def _fill(self, patch: Patch, car: Car) -> None:
        corners_m = patch.corners_m
        if patch.frame == "car":
            x_m, y_m, _ = car_frame(car).position
            corners_m = placed(corners_m, x_m, y_m, -car.heading_rad)
        corners_px = corners_m / METERS_PER_PX * [1.0, -1.0] + [0.0, IMAGE_HEIGHT_PX]
        self._canvas.polygon(corners_px, patch.color)

    def _write(self, car: Car) -> None:
        left, top = PANEL_PX
        self._canvas.text(f"score {int(car.gates)}", (left, top), 32, INK)
        self._canvas.text(f"speed {car.speed_px:.0f}", (left, top + 26), 32, INK)
        self._canvas.text(f"step {int(car.steps)}", (left, top + 52), 32, INK)

    def _draw_keys(self, command: Command) -> None:
        """Draw the four keys, each filled up to the share of the command in its direction."""
        pressed = {
            "forward": command.acceleration,
            "back": -command.acceleration,
            "left": command.turn,
            "right": -command.turn,
        }
        left, top = PANEL_PX[0] + 115, PANEL_PX[1]
        for name, (column, row) in _KEYS.items():
            box_px = (left + column * (KEY_PX + 5), top + row * (KEY_PX + 5), KEY_PX, KEY_PX)
            if (height_px := round(KEY_PX * pressed[name])) > 0:
                below_px = (box_px[0], box_px[1] + KEY_PX - height_px, KEY_PX, height_px)
                self._canvas.rectangle(below_px, PRESSED)
            self._canvas.rectangle(box_px, INK, edge_px=2)
            middle_px = (box_px[0] + KEY_PX // 2, box_px[1] + KEY_PX // 2)
            self._canvas.arrowhead(middle_px, _ARROWS[name], INK)
