"""Validation of the arguments that a user passes to a sim."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from mcaprl.errors import UnknownNameError, UsageError


class Pose(NamedTuple):
    """Starting pose and speed of a ground vehicle in the map."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_m_s: float


def check_name(argument: str, value: object, allowed: Sequence[object]) -> None:
    """Validate that a value is allowed."""
    if value not in allowed:
        raise UnknownNameError(argument, str(value), [str(name) for name in allowed])


def check_actions(actions: object, allowed: Sequence[object], rules: str) -> None:
    """Validate the argument `actions`; the published rules have discrete actions only."""
    check_name("actions", actions, allowed)
    if not isinstance(actions, int) and actions != "discrete" and rules != "default":
        raise UsageError(
            f"actions '{actions}' need the rules 'default': the rules '{rules}' are published with"
            " discrete actions"
        )


def check_range(argument: str, value: float, low: float, high: float) -> None:
    """Validate that a number is in [low, high]."""
    if not low <= value <= high:
        raise UsageError(f"{argument} must be {low:g} to {high:g}, not {value}")


def check_action(action: int | np.integer[Any], count: int) -> int:
    """Validate an action and return it as an int."""
    try:
        number = operator.index(action)
    except TypeError:
        raise UsageError(f"action {action!r} is not an integer") from None
    if not 0 <= number < count:
        raise UsageError(f"action {action} does not exist: actions are 0 to {count - 1}")
    return number


def read_pose(options: dict[str, Any], names: Sequence[str], least: int) -> list[float]:
    """Read `pose`, the only option of `reset`."""
    if set(options) != {"pose"}:
        raise UsageError(f"reset accepts only the option 'pose', not {sorted(set(options))}")
    try:
        pose = np.asarray(options["pose"], dtype=np.float64)
    except (TypeError, ValueError):
        pose = np.full(1, math.nan)
    if pose.shape not in ((least,), (len(names),)) or not np.isfinite(pose).all():
        raise UsageError(
            f"pose {options['pose']!r} is not ({', '.join(names[:least])}) or ({', '.join(names)})"
        )
    return [*pose.tolist(), *[0.0] * (len(names) - len(pose))]


def pose_from(options: dict[str, Any], slowest_m_s: float, fastest_m_s: float) -> Pose:
    """Read the start of a ground vehicle: (x_m, y_m, yaw_rad) or (x_m, y_m, yaw_rad, speed_m_s)."""
    pose = Pose(*read_pose(options, Pose._fields, least=3))
    check_range("a pose's speed_m_s", pose.speed_m_s, slowest_m_s, fastest_m_s)
    return pose
