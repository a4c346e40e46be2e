"""Starting states and wind of the powerline sim's episodes."""

from __future__ import annotations

from typing import Any

import numpy as np

from mcaprl.errors import UsageError
from mcaprl.sims.geometry.vectors import Vector, norm
from mcaprl.sims.powerline.classic import classic_end
from mcaprl.sims.powerline.course import (
    LENGTH_M,
    POINTS_M,
    TANGENTS,
    nearest_on_line,
    point_on_line,
)
from mcaprl.sims.powerline.rules import (
    FLYING,
    MAX_COMMAND_M_S,
    REASONS,
    VELOCITY_STEP_M_S,
    Flight,
    approach,
    begin,
    collides,
    end_of,
)
from mcaprl.sims.vehicle.arguments import check_range, read_pose

POSE_NAMES = ("x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")
FIRST_POINT_NOISE_M = 0.2
NOISE_M = 1.0
LAST_START_M = 20.0
"""Minimum distance of random starts from the line's end."""
MAX_SPEED_M_S = 5.0


def draw_wind(random: np.random.Generator, greatest_m_s: float) -> Vector:
    """Draw an episode's steady horizontal wind, with a random speed and direction."""
    if not greatest_m_s:
        return Vector(0.0, 0.0, 0.0)
    speed_m_s = random.uniform(0.0, greatest_m_s)
    toward_rad = random.uniform(-np.pi, np.pi)
    return Vector(float(speed_m_s * np.cos(toward_rad)), float(speed_m_s * np.sin(toward_rad)), 0.0)


def start_on_line(
    random: np.random.Generator, plant: int, command: tuple[float, float, float], wind: Vector
) -> Flight:
    """Return a flight that hovers near the first point, then follows a command for 5 s."""
    noise = random.uniform(-FIRST_POINT_NOISE_M, FIRST_POINT_NOISE_M, 3)
    position = Vector(*(POINTS_M[0] + noise).tolist())
    return approach(plant, position, Vector(*command), wind)


def start_anywhere(random: np.random.Generator, wind: Vector) -> Flight:
    """Return a flight that begins at a random position and moves along the line.

    The speed is random. The velocity is rounded to 0.5 m/s on each axis.
    """
    along_m = float(random.uniform(0.0, LENGTH_M - LAST_START_M))
    point = point_on_line(along_m)
    speed_m_s = random.uniform(0.0, MAX_SPEED_M_S)
    steps = np.rint(speed_m_s * TANGENTS[nearest_on_line(point).leg] / VELOCITY_STEP_M_S)
    # The factor 1 / sqrt(3) limits the length of the offset vector to NOISE_M.
    noise = random.uniform(-NOISE_M, NOISE_M, 3) / np.sqrt(3.0)
    position = Vector(*np.add(point, noise).tolist())
    return begin(position, Vector(*(VELOCITY_STEP_M_S * steps).tolist()), wind)


def flight_from(options: dict[str, Any], wind: Vector, classic: bool) -> Flight:
    """Return the starting state in the options of `reset`.

    Raises:
        UsageError: An option is unknown, or the pose is malformed, too fast, or would end the
            episode at once.
    """
    pose = read_pose(options, POSE_NAMES, least=3)
    position, velocity = Vector(*pose[:3]), Vector(*pose[3:])
    check_range("a pose's speed in m/s", norm(velocity), 0.0, MAX_COMMAND_M_S)
    place = nearest_on_line(position)
    end = classic_end(position, collides(position)) if classic else end_of(position, place)
    if end != FLYING:
        raise UsageError(
            f"pose {tuple(pose[:3])} ends the episode at once: {REASONS[end]},"
            f" {place.distance_m:.1f} m from the line (z points down)"
        )
    return begin(position, velocity, wind)
