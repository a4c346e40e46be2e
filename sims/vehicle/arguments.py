"""Checks of what a user hands to a sim; each refusal says what is allowed."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UnknownNameError, UsageError


class Pose(NamedTuple):
    """Where a caller wants a vehicle on the ground to start, in the map."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_m_s: float


def check_name(argument: str, value: object, allowed: Sequence[object]) -> None:
    """Refuse a value that is not in the list.

    Raises:
        UnknownNameError: it is not; the message lists those that are.
    """
    if value not in allowed:
        raise UnknownNameError(argument, str(value), [str(name) for name in allowed])


def check_range(argument: str, value: float, low: float, high: float) -> None:
    """Refuse a number outside [low, high].

    Raises:
        UsageError: it is outside, or no number.
    """
    if not low <= value <= high:
        raise UsageError(f"{argument} is {low:g} to {high:g}, not {value}")


def check_action(action: int | np.integer[Any], count: int) -> int:
    """Give an action as an int; refuse one that is not 0 to count - 1.

    Raises:
        UsageError: it is not, or no whole number.
    """
    try:
        number = operator.index(action)
    except TypeError:
        raise UsageError(f"action {action!r} is no whole number") from None
    if not 0 <= number < count:
        raise UsageError(f"action {action} does not exist: 0 to {count - 1} do")
    return number


def check_actions(actions: Any, vehicles: int, count: int) -> NDArray[np.int64]:
    """Give the actions of many vehicles; refuse any that is not 0 to count - 1.

    Raises:
        UsageError: it is not; or there is not one whole number for each vehicle.
    """
    numbers = np.asarray(actions)
    if numbers.shape != (vehicles,) or numbers.dtype.kind not in "iu":
        raise UsageError(
            f"actions are an array of {vehicles} whole numbers,"
            f" not {numbers.dtype} of shape {numbers.shape}"
        )
    numbers = numbers.astype(np.int64, copy=False)
    # Without a sign, those below 0 are the largest.
    does_not_exist = numbers.view(np.uint64) >= count
    if does_not_exist.any():
        wrong = numbers[does_not_exist][0]
        raise UsageError(f"action {wrong} does not exist: 0 to {count - 1} do")
    return numbers


def check_one(observations: Any) -> None:
    """Refuse a pilot's observations, which may be a dict of arrays, unless there is just one.

    Raises:
        ValueError: there are more.
    """
    rows = next(iter(observations.values())) if isinstance(observations, dict) else observations
    count = len(rows)
    if count != 1:
        raise ValueError(f"one pilot has one environment, not {count}")


def read_pose(options: dict[str, Any], names: Sequence[str], least: int) -> list[float]:
    """Read the one option of `reset`, `pose`.

    Args:
        options: of `reset`.
        names: of all the numbers that a pose can have, with units.
        least: how many it must have; those left out are 0.

    Raises:
        UsageError: there is another option, or the pose is not so many finite numbers.
    """
    if set(options) != {"pose"}:
        raise UsageError(f"reset knows only the option 'pose', not {sorted(set(options))}")
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
    """Read the start of a vehicle on the ground: (x_m, y_m, yaw_rad), or with speed_m_s.

    Raises:
        UsageError: there is another option, no such pose, or a speed beyond the vehicle's.
    """
    pose = Pose(*read_pose(options, Pose._fields, least=3))
    check_range("a pose's speed_m_s", pose.speed_m_s, slowest_m_s, fastest_m_s)
    return pose
