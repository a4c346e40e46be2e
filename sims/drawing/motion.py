"""Motion of a vehicle between two poses, for sims that compute only these two poses."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mcaprl.sims.drawing.scene import Frame
from mcaprl.sims.drawing.shapes import car_frame
from mcaprl.sims.geometry.paths import wrap_angle

LONGEST_S = 0.05
"""Longest time between two drawn positions of a vehicle."""

Pose = tuple[float, float, float]
"""x and y in meters, and yaw in radians."""


def arc(start: Pose, end: Pose, share: float) -> Pose:
    """Return a pose on the way from `start` to `end` at constant speed and yaw rate.

    The way is an arc with the turn angle w. Compare the chord of a fraction s of the arc with the
    chord of the whole arc: the ratio of their lengths is s sinc(s w / 2) / sinc(w / 2), and the
    angle between them is (s - 1) w / 2. Here, sinc(a) = sin(a) / a.

    Args:
        start: First pose.
        end: Last pose.
        share: Fraction of the way, 0 to 1.
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
