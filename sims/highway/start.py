"""Starting states that the highway-lane sim adds to those of highway-env."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from mcaprl.errors import UsageError
from mcaprl.sims.highway.course import Course
from mcaprl.sims.highway.scene import Car
from mcaprl.sims.vehicle.arguments import Pose, pose_from

FASTEST_M_S = 15.0
FREE_M = 20.0
"""Minimum distance of random starts from other cars."""
LAST_START_M = 60.0
"""Minimum distance of random starts from the end of a road."""


def drawn_pose(
    random: np.random.Generator, courses: Sequence[Course], others: Sequence[Car], speed_m_s: float
) -> Pose:
    """Draw a pose away from other cars, up to 1.5 m and 0.2 rad off the middle of a lane."""
    course = courses[int(random.integers(len(courses)))]
    last_m = course.length_m - (0.0 if course.is_closed else LAST_START_M)
    while True:
        along_m = random.uniform(0.0, last_m)
        offset_m, error_rad = random.uniform(-1.5, 1.5), random.uniform(-0.2, 0.2)
        x_m, y_m = course.point(along_m)
        yaw_rad = course.nearest(x_m, y_m).yaw_rad
        x_m -= offset_m * math.sin(yaw_rad)
        y_m += offset_m * math.cos(yaw_rad)
        if _is_free(x_m, y_m, others, FREE_M):
            return Pose(x_m, y_m, yaw_rad + error_rad, speed_m_s)


def pose_from_options(
    options: dict[str, Any], courses: Sequence[Course], others: Sequence[Car], own: Car
) -> Pose:
    """Return the pose from the options of `reset`. The default speed is the car's current speed.

    Raises:
        UsageError: An option is unknown, or the pose is malformed, occupied, or not on a lane.
    """
    pose = pose_from(options, 0.0, FASTEST_M_S)
    if len(options["pose"]) < len(Pose._fields):
        pose = pose._replace(speed_m_s=own.speed_m_s)
    offset_m = min(abs(course.nearest(pose.x_m, pose.y_m).offset_m) for course in courses)
    half_width_m = courses[0].half_width_m
    if offset_m > half_width_m:
        raise UsageError(
            f"pose ({pose.x_m}, {pose.y_m}) is {offset_m:.1f} m from the middle of a lane:"
            f" the lane's edge is at {half_width_m} m"
        )
    if not _is_free(pose.x_m, pose.y_m, others, own.length_m):
        raise UsageError(f"pose ({pose.x_m}, {pose.y_m}) is occupied by another car")
    return pose


def _is_free(x_m: float, y_m: float, others: Sequence[Car], clear_m: float) -> bool:
    return all(math.hypot(x_m - car.x_m, y_m - car.y_m) > clear_m for car in others)
