"""What every sim asks of the arguments it is given."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from mcaprl.errors import UnknownNameError, UsageError


class Pose(NamedTuple):
    """Where a caller wants a vehicle to start, in the map."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_m_s: float


def check_name(argument: str, value: object, allowed: Sequence[object]) -> None:
    """Make sure that an argument has one of the values that it may have.

    Raises:
        UnknownNameError: it has another one; the message lists them.
    """
    if value not in allowed:
        raise UnknownNameError(argument, str(value), [str(name) for name in allowed])


def check_action(action: int | np.integer[Any], count: int) -> None:
    """Make sure that there is such an action.

    Raises:
        UsageError: it is not 0 to `count` - 1.
    """
    if not 0 <= action < count:
        raise UsageError(f"action {action} does not exist: 0 to {count - 1} do")


def pose_from(options: dict[str, Any], slowest_m_s: float, fastest_m_s: float) -> Pose:
    """Read a start from the options of `reset`.

    Args:
        options: `{"pose": (x_m, y_m, yaw_rad)}`; a fourth number is the speed in m/s, 0 if missing.
        slowest_m_s: a vehicle can be.
        fastest_m_s: a vehicle can be.

    Raises:
        UsageError: there is another key, or no such pose.
    """
    if set(options) != {"pose"}:
        raise UsageError(f"reset knows only the option 'pose', not {sorted(set(options))}")
    try:
        pose = np.asarray(options["pose"], dtype=np.float64)
    except (TypeError, ValueError):
        pose = np.full(1, math.nan)
    if pose.shape not in ((3,), (4,)) or not np.isfinite(pose).all():
        raise UsageError(
            f"pose {options['pose']!r} is not (x_m, y_m, yaw_rad) or (x_m, y_m, yaw_rad, speed_m_s)"
        )
    x_m, y_m, yaw_rad, speed_m_s = [*pose.tolist(), 0.0][:4]
    if not slowest_m_s <= speed_m_s <= fastest_m_s:
        raise UsageError(f"a pose's speed is {slowest_m_s:g} to {fastest_m_s} m/s, not {speed_m_s}")
    return Pose(x_m, y_m, yaw_rad, speed_m_s)
