"""Pieces that cars are drawn from, fixed to the frame `car`: x forward, y left, z up."""

from __future__ import annotations

import itertools
import math

import numpy as np

from mcaprl.sims.drawing.scene import Color, Shape

Metres = tuple[float, float, float]


def part(name: str, color: Color, size: Metres, at: Metres) -> Shape:
    """Give a box of a car by its edges and its middle."""
    return Shape(f"car_{name}", "box", color, size=size, position=at, frame="car")


def wheel(name: str, color: Color, hub: Metres, radius_m: float, width_m: float) -> Shape:
    """Build a wheel from triangles: the rolling face and two sides of a 16-gon."""
    turn = np.linspace(0.0, 2 * math.pi, 17)
    rim = radius_m * np.column_stack([np.cos(turn), np.zeros(17), np.sin(turn)])
    half = np.array([0.0, width_m / 2, 0.0])
    triangles = []
    for a, b in itertools.pairwise(rim):
        triangles += [a - half, b - half, b + half, a - half, b + half, a + half]
        triangles += [-half, b - half, a - half, half, a + half, b + half]
    points = np.array(hub) + np.array(triangles)
    return Shape(f"car_wheel_{name}", "triangles", color, points, frame="car")
